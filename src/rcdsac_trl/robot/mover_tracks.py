"""What walks: small things that are seen step after step, their velocities, and where they are once out of view.

A local map takes everything as standing. What moves is taken out of it and kept here, at constant velocity.
"""

import math
from dataclasses import dataclass, fields

import numpy as np
from numpy.typing import NDArray

from rcdsac_trl.errors import UserInputError
from rcdsac_trl.robot.range_sensor import BIN_RAD, MAX_RANGE_M, NUM_BINS
from rcdsac_trl.system.jit import njit

_MOST_TRACKS = 12
# Columns of the tracks: place, velocity, time since it was seen, how often it was, and whether there is one.
_X, _Y, _VX, _VY, _UNSEEN_S, _TIMES, _USED = range(7)


@dataclass(frozen=True)
class TrackSettings:
    """What counts as moving.

    Attributes:
        step_m: ranges of neighbouring sectors that differ by more belong to two things, m: less than a gap between
            things, more than a round thing's slope.
        widest_m: wider things are not tracked, m: walls, of which ever other parts are seen.
        radius_m: radius of what moves, m; a person's, and the middle of the movers' 0.2 to 0.3.
        gate_m: a thing this near to where a track expects it is the same one, m: twice what it walks in a step, and
            the sector's width.
        position_gain: share of the way to where it is seen that a track's place goes, in (0, 1].
        velocity_gain: the same for its velocity; smaller, since a sector is 0.1 m wide in 3 m. With 0.15 what turns
            is expected where it no longer goes.
        min_times: a velocity is believed once a thing was seen this often.
        min_speed_m_per_s: what is slower stands, m/s; the slowest movers walk at 0.2.
        coast_s: a track goes on unseen this long, s: as long as it takes to pass a mover. Then it has turned.

    Raises:
        UserInputError: if a value is not positive.
    """

    step_m: float = 0.25
    widest_m: float = 0.75
    radius_m: float = 0.25
    gate_m: float = 0.4
    position_gain: float = 0.5
    velocity_gain: float = 0.25
    min_times: int = 5
    min_speed_m_per_s: float = 0.15
    coast_s: float = 2.0

    def __post_init__(self) -> None:
        """Refuse what tracks nothing."""
        for field in fields(self):
            if not 0.0 < getattr(self, field.name) < math.inf:
                raise UserInputError(f"{field.name}={getattr(self, field.name)} must be a positive number")


class MoverTracks:
    """Tracks of what one robot sees moving.

    An alpha-beta filter each (Kalata 1984), in the odometry frame.

    Args:
        settings: what counts as moving.
        sensed: which of the 180 sectors the sensor has, bool [180]. Sectors without neighbours see no width, so
            nothing is tracked by a sparse sensor.
        max_range_m: reach of the sensor.
    """

    def __init__(self, settings: TrackSettings, sensed: NDArray[np.bool_], max_range_m: float = MAX_RANGE_M) -> None:
        self.settings = settings
        self._max_range_m = max_range_m
        self.sensed = np.asarray(sensed, np.bool_)
        self._tracks = np.zeros((_MOST_TRACKS, 7))

    def observe(
        self,
        ranges_m: NDArray[np.float64],
        pose: NDArray[np.float64],
        elapsed_s: float,
        sensed: NDArray[np.bool_] | None = None,
    ) -> None:
        """Move the tracks on, and correct those that are seen.

        Args:
            ranges_m: smallest distance in each sector, float64 [180], m; ``inf`` where nothing is in reach.
            pose: the robot's x and y in m and yaw in rad, odometry frame.
            elapsed_s: since the last observation, s.
            sensed: those of the sensor's sectors that say something now, bool [180]; None: all of them.
        """
        sensed = self.sensed if sensed is None else sensed
        settings, tracks = self.settings, self._tracks
        _move_on(tracks, elapsed_s, settings.coast_s)
        things = np.empty((NUM_BINS, 2))
        sizes_m = settings.step_m, settings.widest_m, settings.radius_m
        number = _find(things, ranges_m, pose, sensed, *sizes_m, self._max_range_m)
        _correct(tracks, things[:number], settings.gate_m, settings.position_gain, settings.velocity_gain)

    @property
    def moving(self) -> NDArray[np.float64]:
        """What moves, float64 [k, 6], odometry frame.

        In each row x and y in m, their velocities in m/s, the radius in m, and for how long it was not seen, in s.
        """
        settings, tracks = self.settings, self._tracks
        fast = np.hypot(tracks[:, _VX], tracks[:, _VY]) >= settings.min_speed_m_per_s
        known = tracks[(tracks[:, _USED] > 0) & (tracks[:, _TIMES] >= settings.min_times) & fast]
        return np.column_stack([known[:, :_UNSEEN_S], np.full(len(known), settings.radius_m), known[:, _UNSEEN_S]])


# ------------------------------------------------------------------------------------------------ compiled
# All that the compiled code uses stands in this file: Numba's cache notices no change of another one.
@njit
def _move_on(tracks: np.ndarray, elapsed_s: float, coast_s: float) -> None:
    """Move every track by its velocity, and end those that were not seen for long."""
    for track in tracks:
        track[_X] += track[_VX] * elapsed_s
        track[_Y] += track[_VY] * elapsed_s
        track[_UNSEEN_S] += elapsed_s
        if track[_UNSEEN_S] > coast_s:
            track[_USED] = 0.0


@njit
def _find(
    things: np.ndarray,
    ranges_m: np.ndarray,
    pose: np.ndarray,
    sensed: np.ndarray,
    step_m: float,
    widest_m: float,
    radius_m: float,
    max_range_m: float,
) -> int:
    """Write the middles of small things that are seen whole, and return how many there are.

    Seen whole is what has sectors on both sides that see farther: else its edge is another thing's, or the view's.
    """
    # Begin where no thing goes on from the sector before: at one without a sensor, or else where ranges jump.
    start = NUM_BINS // 2
    for _ in range(NUM_BINS):
        if sensed[start]:
            start = (start + 1) % NUM_BINS
    if sensed[start]:
        for _ in range(NUM_BINS):
            if abs(ranges_m[start] - ranges_m[start - 1]) <= step_m:
                start = (start + 1) % NUM_BINS
    number = done = 0
    while done < NUM_BINS:
        first = (start + done) % NUM_BINS
        done += 1
        if not sensed[first] or ranges_m[first] >= max_range_m:
            continue
        last, near_m, count = first, ranges_m[first], 1
        while done < NUM_BINS:
            following = (start + done) % NUM_BINS
            if not sensed[following] or not abs(ranges_m[following] - ranges_m[last]) <= step_m:
                break
            last, near_m, count = following, min(near_m, ranges_m[following]), count + 1
            done += 1
        before, after = (first - 1) % NUM_BINS, (last + 1) % NUM_BINS
        if not sensed[before] or not sensed[after] or near_m * count * BIN_RAD > widest_m:
            continue
        if ranges_m[before] > ranges_m[first] and ranges_m[after] > ranges_m[last]:
            bearing = pose[2] + (first + 0.5 * count) * BIN_RAD
            things[number, 0] = pose[0] + (near_m + radius_m) * math.cos(bearing)
            things[number, 1] = pose[1] + (near_m + radius_m) * math.sin(bearing)
            number += 1
    return number


@njit
def _correct(tracks: np.ndarray, things: np.ndarray, gate_m: float, position_gain: float, velocity_gain: float) -> None:
    """Correct the nearest track of each thing, or begin one."""
    for x, y in things:
        nearest, nearest_m, free = -1, gate_m, -1
        for k in range(len(tracks)):
            if tracks[k, _USED] == 0.0:
                free = k
            elif tracks[k, _UNSEEN_S] > 0.0:  # else another thing is it
                away_m = math.hypot(tracks[k, _X] - x, tracks[k, _Y] - y)
                if away_m < nearest_m:
                    nearest, nearest_m = k, away_m
        if nearest >= 0:
            track = tracks[nearest]
            dx, dy, unseen_s = x - track[_X], y - track[_Y], track[_UNSEEN_S]
            track[_X] += position_gain * dx
            track[_Y] += position_gain * dy
            track[_VX] += velocity_gain * dx / unseen_s
            track[_VY] += velocity_gain * dy / unseen_s
            track[_UNSEEN_S] = 0.0
            track[_TIMES] += 1.0
        elif free >= 0:
            tracks[free, :] = 0.0
            tracks[free, _X], tracks[free, _Y], tracks[free, _TIMES], tracks[free, _USED] = x, y, 1.0, 1.0
