"""What a policy refuses to drive on: messages that are missing, old, out of order, of another unit, or no numbers."""

import math
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rcdsac_trl.deploy.sensors.scan import Scan, scan_sectors
from rcdsac_trl.deploy.sensors.sectors import Sectors, is_finite_number
from rcdsac_trl.errors import UserInputError
from rcdsac_trl.robot.observation import MIN_RANGE_M, WAYPOINT_DISTANCE_LIMITS_M
from rcdsac_trl.robot.range_sensor import MAX_RANGE_M, NUM_BINS

# Beyond these, a number is in another unit (mm, deg/s) or wrong: robots of this kind drive a third of it.
_FASTEST_M_PER_S = 2.0
_FASTEST_RAD_PER_S = 2.0 * math.pi
_FARTHEST_RANGE_M = 200.0
_EVERYWHERE = np.ones(NUM_BINS, dtype=np.bool_)
_EVERYWHERE.flags.writeable = False
# Clocks of two computers differ a little.
_CLOCK_SLACK_S = 0.05


class BadInputError(Exception):
    """Input that nobody should drive on; the message says what is wrong with it."""


@dataclass(frozen=True)
class Stamps:
    """When the parts of the input were measured, and when they are used; one clock, s.

    Attributes:
        now_s: time of the call.
        scan_s: of the range sensor's message.
        waypoints_s: of the pose from which the waypoints were seen.
        velocity_s: of the odometry.
    """

    now_s: float
    scan_s: float
    waypoints_s: float
    velocity_s: float


@dataclass(frozen=True)
class InputLimits:
    """What is still good enough to drive on.

    Attributes:
        max_age_s: of any part of the input.
        max_lost_share: of the agent's range bins, how many may be without measurement; those read "nothing there".
    """

    max_age_s: float = 0.35
    max_lost_share: float = 0.1

    def __post_init__(self) -> None:
        """Refuse what is no limit."""
        if not 0.0 < self.max_age_s < math.inf:
            raise UserInputError(f"max_age_s={self.max_age_s} must be a positive number of seconds")
        if not 0.0 <= self.max_lost_share < 1.0:
            raise UserInputError(f"max_lost_share={self.max_lost_share} is a share: give 0 or more, and less than 1")


def check_stamps(stamps: Stamps, last: Stamps | None, limits: InputLimits) -> None:
    """Refuse stamps that are no numbers, old, from the future, or older than the last ones.

    Raises:
        BadInputError: with the first of these.
    """
    now = stamps.now_s
    for name in ("now_s", "scan_s", "waypoints_s", "velocity_s"):
        stamp = getattr(stamps, name)
        if not is_finite_number(stamp):
            raise BadInputError(f"stamp {name} is no finite number")
        if last is not None and stamp < getattr(last, name):
            raise BadInputError(f"stamp {name} goes back by {getattr(last, name) - stamp:.2f} s")
        if stamp > now + _CLOCK_SLACK_S:
            raise BadInputError(f"stamp {name} is {stamp - now:.2f} s in the future")
        if now - stamp > limits.max_age_s:
            raise BadInputError(f"stamp {name} is {now - stamp:.2f} s old, more than {limits.max_age_s:g} s")


def sectors_of(ranges: Any, mask: NDArray[np.bool_], limits: InputLimits) -> Sectors:
    """Return the sectors of what a range sensor gave, if the agent may drive on them.

    Args:
        ranges: distances [180] in m (``inf`` where nothing is), :class:`Sectors`, or a :class:`Scan`.
        mask: the agent's range bins, bool [180].
        limits: how many of them may be lost.

    Raises:
        BadInputError: if it may not.
    """
    if isinstance(ranges, Scan):
        try:
            ranges = scan_sectors(ranges)
        except UserInputError as error:
            raise BadInputError(str(error)) from error
    covered = _EVERYWHERE
    if isinstance(ranges, Sectors):
        covered = _array(ranges.covered, (NUM_BINS,), "covered").astype(np.bool_)
        ranges = ranges.distances_m
    distances = _array(ranges, (NUM_BINS,), "ranges")
    _check_ranges(distances if covered is _EVERYWHERE else distances[covered])
    if covered is not _EVERYWHERE:
        _check_lost(mask, covered, limits)
    return Sectors(np.where(covered & (distances < MAX_RANGE_M), distances, math.inf), covered)


def _check_ranges(known: NDArray[np.float64]) -> None:
    """Refuse measured ranges, [n], if one of them is none."""
    # Counting is the cheapest way to look at all of them; NaN is not above anything.
    above = np.count_nonzero(known > MIN_RANGE_M) == len(known)
    if above and np.count_nonzero(known > _FARTHEST_RANGE_M) == np.count_nonzero(known == math.inf):
        return
    if np.isnan(known).any():
        raise BadInputError("ranges hold NaN: mark what is not measured as not covered (Sectors), or pass the Scan")
    if not above:
        raise BadInputError(
            f"ranges go down to {known.min():g} m, below {MIN_RANGE_M:g} m is no measurement: inf means nothing there"
        )
    raise BadInputError(f"a range of {known[np.isfinite(known)].max():g} is not in metres: inf means nothing there")


def _check_lost(mask: NDArray[np.bool_], covered: NDArray[np.bool_], limits: InputLimits) -> None:
    """Refuse a sensor that says too little about the agent's range bins."""
    lost = np.count_nonzero(mask & ~covered) / np.count_nonzero(mask)
    if lost > limits.max_lost_share:
        raise BadInputError(
            f"{100 * lost:.0f} % of the range bins this agent sees are not measured, more than "
            f"{100 * limits.max_lost_share:g} %: is the sensor blind, or of another kind?"
        )


def waypoints_of(waypoints: Any) -> tuple[tuple[float, float], tuple[float, float]]:
    """Return the next two waypoints, x and y in m in the robot's frame; one stands for both.

    Raises:
        BadInputError: if they are no such.
    """
    array = _array(waypoints, None, "waypoints")
    if array.shape in ((2,), (1, 2)):
        array = np.broadcast_to(array, (2, 2))
    if array.shape != (2, 2):
        raise BadInputError(f"waypoints have shape {list(array.shape)}: give x and y of the next two, [2, 2]")
    (x_1, y_1), (x_2, y_2) = array.tolist()
    if not all(math.isfinite(value) for value in (x_1, y_1, x_2, y_2)):
        raise BadInputError("waypoints are not all finite numbers")
    farthest = max(abs(x_1), abs(y_1), abs(x_2), abs(y_2))
    if farthest > WAYPOINT_DISTANCE_LIMITS_M[1]:
        raise BadInputError(
            f"a waypoint {farthest:g} m away is out of sight: give metres in the robot's frame, at most "
            f"{WAYPOINT_DISTANCE_LIMITS_M[1]:g}"
        )
    return (x_1, y_1), (x_2, y_2)


def velocity_of(velocity: Any) -> tuple[float, float]:
    """Return the measured velocities, m/s and rad/s.

    Raises:
        BadInputError: if they are no such.
    """
    v, omega = _array(velocity, (2,), "velocity").tolist()
    if not (math.isfinite(v) and math.isfinite(omega)):
        raise BadInputError("velocity is not finite")
    if abs(v) > _FASTEST_M_PER_S or abs(omega) > _FASTEST_RAD_PER_S:
        raise BadInputError(f"velocity ({v:g}, {omega:g}) is not in m/s and rad/s")
    return v, omega


def _array(value: Any, shape: tuple[int, ...] | None, name: str) -> NDArray[np.float64]:
    try:
        array = np.asarray(value)
        if array.dtype.kind not in "fiub":
            raise BadInputError(f"{name} are not numbers")
        array = array.astype(np.float64, copy=False)
    except (TypeError, ValueError, OverflowError) as error:
        raise BadInputError(f"{name} are not numbers") from error
    if shape is not None and array.shape != shape:
        raise BadInputError(f"{name} have shape {list(array.shape)}: give {list(shape)}")
    return array
