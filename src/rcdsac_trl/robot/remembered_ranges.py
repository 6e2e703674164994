"""What a robot remembers of what it saw, as an agent is told it; our option beyond the paper (``sensor.memory_s``).

It knows what a robot knows: the sectors that its sensor has, and measured velocities. Points that were seen are carried
along by dead reckoning, cleared by sectors that see farther, and forgotten after a while; what walks is tracked instead
and goes on at its velocity while it is out of view. The simulated world and the policy on a robot run the same code.
"""

import math

import numpy as np
from numpy.typing import NDArray

from rcdsac_trl.robot.dead_reckoning import DeadReckoning
from rcdsac_trl.robot.foreseen_clearance import ForeseenClearance
from rcdsac_trl.robot.latency import Ahead
from rcdsac_trl.robot.mover_tracks import MoverTracks, TrackSettings
from rcdsac_trl.robot.observation import (
    NUM_FORESEEN_COMMANDS,
    NUM_REMEMBERED_MOVERS,
    NUM_REMEMBERED_SECTORS,
    REMEMBERED_MOVER_SIZE,
    REMEMBERED_SIZE,
)
from rcdsac_trl.robot.planar import placed, seen_from
from rcdsac_trl.robot.range_sensor import BIN_RAD, NUM_BINS
from rcdsac_trl.robot.robot_settings import PAPER, RobotSettings
from rcdsac_trl.system.jit import njit

_SECTOR_RAD = 2.0 * math.pi / NUM_REMEMBERED_SECTORS
# A cell holds the last point seen in it; the ring of cells is wider than what is remembered, 3 m around the robot, by
# so many cells.
_CELL_M = 0.1
_SPARE_CELLS = 4
# A point stands for what is around it, up to the points of the next cells.
_POINT_RADIUS_M = 0.07
# A remembered point goes when its sector sees this much farther: about what cell, sector and odometry have moved it by.
_CLEARING_MARGIN_M = 0.1
# Points this near to a thing that moves are its own: about what its place is uncertain by.
_MOVER_MARGIN_M = 0.2
# What is nearer than this to the circle inside the robot, from which nearness counts, is alike.
_LEAST_GAP_M = 0.02


class RememberedRanges:
    """What one robot remembers.

    Args:
        sensed: which of the 180 sectors the sensor has, bool [180].
        memory_s: age at which a point is forgotten, above 0, s.
        robot: its sensor's reach; its limits; and a circle inside it, of 0.2 m in the paper's robot, whose sides are
            0.23 m from its middle: nearness counts from there, so that it changes fast where the robot nearly touches.

    Example:
        >>> from rcdsac_trl.robot.range_sensor import sensor_mask
        >>> remembered = RememberedRanges(sensor_mask("narrow"), memory_s=12.0)
        >>> ranges_m = np.full(180, np.inf)
        >>> ranges_m[0] = 0.48
        >>> told = remembered.observe(ranges_m, v=0.0, omega=0.0, elapsed_s=0.0)
        >>> told.shape, round(float(told[0]), 6)
        ((90,), 1.0)
    """

    def __init__(self, sensed: NDArray[np.bool_], memory_s: float, robot: RobotSettings = PAPER) -> None:
        max_range_m = robot.lidar.max_range_m
        self._sensed = np.ascontiguousarray(sensed, np.bool_)
        self._memory_s = memory_s
        self._max_range_m = max_range_m
        self._reach_m = max_range_m, robot.body_radius_m
        self._foreseen = ForeseenClearance(robot)
        num_cells = math.ceil(round(2.0 * max_range_m / _CELL_M, 6)) + _SPARE_CELLS
        # Rows of x and y in m, frame of the dead reckoning, and when it was seen, s; a row for every cell at most.
        self._points = np.empty((num_cells**2, 3))
        self._cells = np.empty((num_cells**2, 2), np.int32)  # of each point
        self._rows = np.full((num_cells, num_cells), -1, np.int32)  # of each cell's point, -1 without one
        self.reset()

    def reset(self) -> None:
        """Forget everything."""
        self._rows.fill(-1)
        self._number = 0
        self._reckoning = DeadReckoning()
        self._tracks = MoverTracks(TrackSettings(), self._sensed, self._max_range_m)
        self._moving = np.empty((0, 6))

    def places(self, pose: tuple[float, float, float]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Return where what is remembered lies if the robot is at a pose: for pictures.

        Args:
            pose: x, y in m and yaw in rad, in the frame that is asked for.

        Returns:
            Points float64 [n, 2] in m, and what moves, float64 [k, 3]: x, y and radius in m.
        """
        own, moving = self._reckoning.pose, self._moving
        points, centres = (placed(seen_from(each[:, :2], own), pose) for each in (self._points[: self._number], moving))
        return points, np.column_stack([centres, moving[:, 4]])

    def observe(
        self,
        ranges_m: NDArray[np.float64],
        v: float,
        omega: float,
        elapsed_s: float,
        measured: NDArray[np.bool_] | None = None,
        ahead: Ahead | None = None,
    ) -> NDArray[np.float32]:
        """Move on, take in what is seen now, and return what is remembered.

        Args:
            ranges_m: smallest distance in each sector, float64 [180], m; ``inf`` where nothing is in reach. Those
                that the sensor lacks are not read.
            v: linear velocity measured now, m/s.
            omega: angular velocity measured now, rad/s.
            elapsed_s: since the last observation, 0 at the first, s.
            measured: which sectors say something now, bool [180]; None: all that the sensor has. The others are not
                read either, so what is remembered there stays.
            ahead: tell what is remembered as from there, and what moves where it will be then as well as where it was
                seen; None: as it is now.

        Returns:
            float32 [90]. First the nearness of the nearest thing, seen now or remembered, in each of 36 sectors of 10
            degrees, counter-clockwise from straight ahead: log10((R - r) / (distance - r)) with the sensor's reach R
            and the inner radius r, 3 m and 0.2 m of the paper's robot; 0 where nothing is known within R.
            Then, for each of the two nearest things that move: its nearness, that times the cosine and the sine of its
            bearing, and its velocity ahead and to the left, m/s; zeros where there is none.
            Last, for each of 22 commands, how near it would lead to all that soon, and then later; see
            :class:`~rcdsac_trl.robot.foreseen_clearance.ForeseenClearance`.
        """
        self._reckoning.move(v, omega, elapsed_s)
        sensed = self._sensed if measured is None else self._sensed & measured
        seen_m = np.where(sensed, ranges_m, np.inf)
        pose, time_s = self._reckoning.pose, self._reckoning.time_s
        self._tracks.observe(seen_m, pose, elapsed_s, sensed)
        moving = self._tracks.moving
        told = np.zeros(REMEMBERED_SIZE, np.float32)
        points, cells, rows = self._points, self._cells, self._rows
        far_m, oldest_s = self._max_range_m, time_s - self._memory_s
        number = _forget(points, cells, rows, self._number, pose, oldest_s, seen_m, sensed, moving, far_m)
        # As old as what is forgotten when the mover's track ends.
        of_mover_s = oldest_s + min(self._tracks.settings.coast_s, self._memory_s)
        self._number = _add(points, cells, rows, number, pose, time_s, of_mover_s, seen_m, sensed, moving, far_m)
        self._moving = moving
        known = points[: self._number]
        if ahead is not None:
            pose, (v, omega) = ahead.after(pose), ahead.velocities
            # What was seen of it just now stays beside it: whoever walks may as well stop.
            moving = moving.copy()
            moving[:, :2] += ahead.latency_s * moving[:, 2:4]
        _tell_points(told[:NUM_REMEMBERED_SECTORS], known, pose, self._reach_m)
        _tell_movers(told, moving, pose, self._reach_m)
        told[-2 * NUM_FORESEEN_COMMANDS :] = self._foreseen.nearness(known, moving, pose, v, omega)
        return told


# ------------------------------------------------------------------------------------------------ compiled
# All that the compiled code uses stands in this file: Numba's cache notices no change of another one.
@njit
def _forget(
    points: np.ndarray,
    cells: np.ndarray,
    rows: np.ndarray,
    number: int,
    pose: np.ndarray,
    before_s: float,
    seen_m: np.ndarray,
    sensed: np.ndarray,
    moving: np.ndarray,
    far_m: float,
) -> int:
    """Drop what is old, far, seen through, or a mover's; return how many points are left, in the first rows."""
    for row in range(number - 1, -1, -1):
        x, y, time_s = points[row]
        distance_m = math.hypot(x - pose[0], y - pose[1])
        gone = time_s < before_s or distance_m >= far_m
        if not gone:
            bin_ = math.floor((math.atan2(y - pose[1], x - pose[0]) - pose[2]) / BIN_RAD) % NUM_BINS
            seen_through = distance_m < min(seen_m[bin_], far_m) - _CLEARING_MARGIN_M
            gone = (sensed[bin_] and seen_through) or _is_of_a_seen_mover(x, y, moving)
        if gone:
            rows[cells[row, 0], cells[row, 1]] = -1
            number -= 1
            if row != number:
                points[row], cells[row] = points[number], cells[number]
                rows[cells[row, 0], cells[row, 1]] = row
    return number


@njit
def _add(
    points: np.ndarray,
    cells: np.ndarray,
    rows: np.ndarray,
    number: int,
    pose: np.ndarray,
    time_s: float,
    of_mover_s: float,
    seen_m: np.ndarray,
    sensed: np.ndarray,
    moving: np.ndarray,
    far_m: float,
) -> int:
    """Put a point into the middle of each sector that sees one, those of movers with a time of their own."""
    for bin_ in range(NUM_BINS):
        if not sensed[bin_] or seen_m[bin_] >= far_m:
            continue
        bearing = pose[2] + (bin_ + 0.5) * BIN_RAD
        x, y = pose[0] + seen_m[bin_] * math.cos(bearing), pose[1] + seen_m[bin_] * math.sin(bearing)
        i, j = math.floor(y / _CELL_M) % rows.shape[0], math.floor(x / _CELL_M) % rows.shape[1]
        row = rows[i, j]
        if row < 0:
            row = rows[i, j] = number
            cells[row, 0], cells[row, 1] = i, j
            number += 1
        points[row, 0], points[row, 1] = x, y
        points[row, 2] = of_mover_s if _is_of_a_seen_mover(x, y, moving) else time_s
    return number


@njit
def _is_of_a_seen_mover(x: float, y: float, moving: np.ndarray) -> bool:
    """Say whether a point belongs to what is seen moving."""
    for mover_x, mover_y, _, _, radius, unseen_s in moving:
        if unseen_s == 0.0 and math.hypot(x - mover_x, y - mover_y) < radius + _MOVER_MARGIN_M:
            return True
    return False


@njit
def _nearness(distance_m: float, reach_m: tuple[float, float]) -> float:
    """Return, of the paper's robot, 0 at 3 m, 1 at 0.48 m, 2 at 0.23 m, from its middle.

    Args:
        distance_m: from the robot's middle.
        reach_m: of the sensor, and radius of the circle from which nearness counts.
    """
    far_m, inner_m = reach_m
    return math.log10((far_m - inner_m) / (max(distance_m, inner_m + _LEAST_GAP_M) - inner_m))


@njit
def _cover(told: np.ndarray, bearing: float, radius_m: float, centre_m: float, nearness: float) -> None:
    """Raise the sectors that a disc covers to its nearness."""
    half = math.asin(min(1.0, radius_m / max(centre_m, radius_m)))
    first, last = math.floor((bearing - half) / _SECTOR_RAD), math.floor((bearing + half) / _SECTOR_RAD)
    for sector in range(first, last + 1):
        told[sector % NUM_REMEMBERED_SECTORS] = max(told[sector % NUM_REMEMBERED_SECTORS], nearness)


@njit
def _tell_points(told: np.ndarray, points: np.ndarray, pose: np.ndarray, reach_m: tuple[float, float]) -> None:
    """Write the nearness of the nearest point of each sector."""
    for x, y, _ in points:
        distance_m, bearing = math.hypot(x - pose[0], y - pose[1]), math.atan2(y - pose[1], x - pose[0]) - pose[2]
        _cover(told, bearing, _POINT_RADIUS_M, distance_m, _nearness(distance_m, reach_m))


@njit
def _tell_movers(told: np.ndarray, moving: np.ndarray, pose: np.ndarray, reach_m: tuple[float, float]) -> None:
    """Write what moves into the sectors that it covers, and the nearest ones behind them."""
    cos, sin = math.cos(pose[2]), math.sin(pose[2])
    centres_m = np.hypot(moving[:, 0] - pose[0], moving[:, 1] - pose[1])
    order = np.argsort(centres_m)
    for place in range(len(order)):
        x, y, vx, vy, radius, _ = moving[order[place]]
        dx, dy, centre_m = x - pose[0], y - pose[1], centres_m[order[place]]
        nearness = _nearness(centre_m - radius, reach_m)
        if nearness <= 0.0:
            break  # those behind it are farther away, movers are alike
        bearing = math.atan2(dy, dx) - pose[2]
        _cover(told, bearing, radius, centre_m, nearness)
        if place < NUM_REMEMBERED_MOVERS:
            at = NUM_REMEMBERED_SECTORS + REMEMBERED_MOVER_SIZE * place
            told[at] = nearness
            told[at + 1], told[at + 2] = nearness * math.cos(bearing), nearness * math.sin(bearing)
            told[at + 3], told[at + 4] = cos * vx + sin * vy, cos * vy - sin * vx
