"""What a policy refuses to drive on: messages that are missing, old, out of order, of another unit, or no numbers."""

import math
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rcdsac_trl.deploy.sensors.arrays import is_plural, masked, numbers_of
from rcdsac_trl.deploy.sensors.scan import Scan, scan_sectors, unsaid_readings, unswept_rad
from rcdsac_trl.errors import UserInputError
from rcdsac_trl.robot.observation import MIN_RANGE_M, WAYPOINT_DISTANCE_LIMITS_M
from rcdsac_trl.robot.range_sensor import BIN_RAD, NUM_BINS
from rcdsac_trl.robot.robot_settings import PAPER, RobotSettings
from rcdsac_trl.robot.sectors import Sectors, is_finite_number

# Beyond these, or so many times what the robot can, a number is in another unit (mm, deg/s) or wrong: the paper's robot
# drives a third of it.
_FASTEST_M_PER_S = 2.0
_FASTEST_RAD_PER_S = 2.0 * math.pi
_FASTER_THAN_IT_CAN = 1.5
_FARTHEST_RANGE_M = 200.0
# Something is nearer than this wherever a robot of this kind drives; else distances are in cm, or mm.
_NEAREST_RANGE_M = 20.0
_EVERYWHERE = np.ones(NUM_BINS, dtype=np.bool_)
_EVERYWHERE.flags.writeable = False
# Clocks of two computers differ a little.
_CLOCK_SLACK_S = 0.05
# A clock that counts seconds gets there in the year 5138; one that counts milliseconds since 1970 did in 1973.
_LAST_STAMP_S = 1e11
# Stamps that count in larger steps cannot tell one period from the next.
_COARSEST_STAMP_S = 0.01
# So far apart are clocks that have nothing to do with each other.
_OTHER_CLOCK_S = 60.0
# A 5 Hz scanner on a robot that turns at 2 rad/s.
_MOST_LEFT_OUT_RAD = 0.4
_LARGEST_AGE_S = 10.0


class BadInputError(UserInputError):
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
        max_lost_share: of the agent's range bins, how many may be without measurement; those read "nothing there". What
            a scanner leaves out that turns against its sweep does not count, up to 0.4 rad.
    """

    max_age_s: float = 0.35
    max_lost_share: float = 0.1

    def __post_init__(self) -> None:
        """Refuse what is no limit."""
        if not 0.0 < self.max_age_s < math.inf:
            raise UserInputError(f"max_age_s={self.max_age_s} must be a positive number of seconds")
        if self.max_age_s > _LARGEST_AGE_S:
            raise UserInputError(f"max_age_s={self.max_age_s:g} is above {_LARGEST_AGE_S:g}: give seconds")
        if not 0.0 <= self.max_lost_share < 1.0:
            raise UserInputError(f"max_lost_share={self.max_lost_share} is a share: give 0 or more, and less than 1")


def as_given_now(stamps: Stamps) -> Stamps:
    """Return stamps of any class as ones that stay what they are when the caller's object is filled anew."""
    return Stamps(stamps.now_s, stamps.scan_s, stamps.waypoints_s, stamps.velocity_s)


def check_stamps(stamps: Stamps, last: Stamps | None, limits: InputLimits) -> None:
    """Refuse stamps that are no numbers, old, from the future, or older than the last ones.

    Raises:
        BadInputError: with the first of these.
    """
    now = stamps.now_s
    for name in ("now_s", "scan_s", "waypoints_s", "velocity_s"):
        stamp = getattr(stamps, name)
        if not is_finite_number(stamp):
            raise BadInputError(f"stamp {name} is no finite number: give seconds")
        _check_seconds(name, stamp)
        if last is not None and stamp < getattr(last, name):
            raise BadInputError(f"stamp {name} goes back by {getattr(last, name) - stamp:.2f} s")
        if stamp > now + _CLOCK_SLACK_S:
            raise BadInputError(f"stamp {name} is {stamp - now:.2f} s in the future{_other_clock(stamp, now)}")
        if now - stamp > limits.max_age_s:
            raise BadInputError(
                f"stamp {name} is {now - stamp:.2f} s old, more than {limits.max_age_s:g} s{_other_clock(stamp, now)}"
            )


def _check_seconds(name: str, stamp: Any) -> None:
    """Refuse a stamp that counts something else than seconds, or too coarsely."""
    if abs(stamp) > _LAST_STAMP_S:
        raise BadInputError(
            f"stamp {name}={float(stamp):g} is above {_LAST_STAMP_S:g}, so not in seconds: nanoseconds times 1e-9 are"
        )
    if isinstance(stamp, np.floating) and np.spacing(stamp) > _COARSEST_STAMP_S:
        raise BadInputError(
            f"stamp {name} is {stamp.dtype}, which counts in steps of {float(np.spacing(stamp)):g} s: give float64"
        )


def _other_clock(stamp: float, now: float) -> str:
    """Return what may be wrong with a stamp that is far from now."""
    if stamp == 0.0:
        return ": 0 is what messages hold that nobody stamped"
    return (
        "" if abs(now - stamp) < _OTHER_CLOCK_S else ": are both in seconds, of one clock (simulated time, wall time)?"
    )


def sectors_of(ranges: Any, mask: NDArray[np.bool_], limits: InputLimits, robot: RobotSettings = PAPER) -> Sectors:
    """Return the sectors of what a range sensor gave, if the agent may drive on them.

    Args:
        ranges: distances [180] in m (``inf`` where nothing is), :class:`Sectors`, or a :class:`Scan`.
        mask: the agent's range bins, bool [180].
        limits: how many of them may be lost.
        robot: whose sensor it is.

    Raises:
        BadInputError: if it may not.
    """
    scan, reach_m = ranges if isinstance(ranges, Scan) else None, robot.lidar.max_range_m
    if scan is not None:
        ranges = scan_sectors(scan, body_radius_m=robot.body_radius_m, max_range_m=reach_m)
    covered = _EVERYWHERE
    if isinstance(ranges, Sectors):
        if ranges.max_range_m < reach_m:
            raise BadInputError(
                f"sectors were filled up to {ranges.max_range_m:g} m, and robot={robot.name} of this agent sees up to "
                f"{reach_m:g} m: make them with max_range_m={reach_m:g}"
            )
        covered, ranges = _covered(ranges), ranges.distances_m
    if (unknown := masked(ranges)) is not None and unknown.shape == covered.shape:
        covered = covered & ~unknown
    distances = _array(ranges, (NUM_BINS,), "ranges")
    _check_ranges(distances if covered is _EVERYWHERE else distances[covered])
    if covered is not _EVERYWHERE:
        _check_lost(mask, covered, limits, scan)
    return Sectors(np.where(covered & (distances < reach_m), distances, math.inf), covered, reach_m)


def _covered(sectors: Sectors) -> NDArray[np.bool_]:
    """Return which sectors are measured, [180]."""
    covered = sectors.covered
    if isinstance(covered, np.ma.MaskedArray):
        covered = covered.filled(False)
    covered = np.asarray(covered)
    if covered.dtype != np.bool_ or covered.shape != (NUM_BINS,):
        raise BadInputError(
            f"covered is {covered.dtype} {list(covered.shape)}: say for each sector whether it was measured, bool "
            f"[{NUM_BINS}]"
        )
    return covered


def _check_ranges(known: NDArray[np.float64]) -> None:
    """Refuse measured ranges, [n], if one of them is none, or all are in another unit."""
    # Counting is the cheapest way to look at all of them; NaN is not above anything.
    above = np.count_nonzero(known > MIN_RANGE_M) == len(known)
    if above and np.count_nonzero(known > _FARTHEST_RANGE_M) == np.count_nonzero(known == math.inf):
        near = np.count_nonzero(known < _NEAREST_RANGE_M)
        if near or np.count_nonzero(known == math.inf) == len(known):
            return
        raise BadInputError(
            f"no range is below {_NEAREST_RANGE_M:g} m, the smallest is {known.min():g}: give metres, and inf where "
            "nothing is"
        )
    if np.isnan(known).any():
        raise BadInputError("ranges hold NaN: mark what is not measured as not covered (Sectors), or pass the Scan")
    if not above:
        raise BadInputError(
            f"ranges go down to {known.min():g} m, below {MIN_RANGE_M:g} m is no measurement: inf means nothing there"
        )
    raise BadInputError(
        f"a range of {known[np.isfinite(known)].max():g} is above {_FARTHEST_RANGE_M:g}, so not in metres: inf means "
        "nothing there"
    )


def _check_lost(mask: NDArray[np.bool_], covered: NDArray[np.bool_], limits: InputLimits, scan: Scan | None) -> None:
    """Refuse a sensor that says too little about the agent's range bins."""
    # A sensor that leaves out what it turns away from is not blind: that was seen a sweep before.
    left_out = 0 if scan is None else math.ceil(min(unswept_rad(scan), _MOST_LEFT_OUT_RAD) / BIN_RAD)
    lost = max(0, int(np.count_nonzero(mask & ~covered)) - left_out) / np.count_nonzero(mask)
    if lost <= limits.max_lost_share:
        return
    why = "is the sensor blind, or of another kind?"
    if scan is not None:
        option, number = max(unsaid_readings(scan).items(), key=lambda found: found[1])
        if number:
            read = "0" if option == "zero_means" else "NaN"
            why = (
                f"{number} of {np.size(scan.ranges)} rays read {read}; if the driver writes {read} where nothing is, "
                f"set {option}=far; where something is too near, {option}=near"
            )
    raise BadInputError(
        f"{100 * lost:.0f} % of the range bins this agent sees are not measured, more than "
        f"{100 * limits.max_lost_share:g} %: {why}"
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
        raise BadInputError("waypoints are not all finite numbers: give x and y in metres")
    farthest = max(abs(x_1), abs(y_1), abs(x_2), abs(y_2))
    if farthest > WAYPOINT_DISTANCE_LIMITS_M[1]:
        raise BadInputError(
            f"a waypoint {farthest:g} m away is out of sight: give metres in the robot's frame, at most "
            f"{WAYPOINT_DISTANCE_LIMITS_M[1]:g}"
        )
    return (x_1, y_1), (x_2, y_2)


def velocity_of(velocity: Any, robot: RobotSettings = PAPER) -> tuple[float, float]:
    """Return the measured velocities of a robot, m/s and rad/s.

    Raises:
        BadInputError: if they are no such.
    """
    v, omega = _array(velocity, (2,), "velocity").tolist()
    if not (math.isfinite(v) and math.isfinite(omega)):
        raise BadInputError("velocity is not finite: give measured m/s and rad/s")
    fastest = max(_FASTEST_M_PER_S, _FASTER_THAN_IT_CAN * robot.fastest_m_per_s)
    fastest_turn = max(_FASTEST_RAD_PER_S, _FASTER_THAN_IT_CAN * robot.max_angular_velocity)
    if abs(v) > fastest or abs(omega) > fastest_turn:
        raise BadInputError(
            f"velocity ({v:g}, {omega:g}) is not in m/s and rad/s: no robot of this kind exceeds "
            f"{fastest:g} m/s or {fastest_turn:.2f} rad/s"
        )
    return v, omega


def _array(value: Any, shape: tuple[int, ...] | None, name: str) -> NDArray[np.float64]:
    array = numbers_of(value, name)
    if shape is not None and array.shape != shape:
        has = "have" if is_plural(name) else "has"
        raise BadInputError(f"{name} {has} shape {list(array.shape)}: give {list(shape)}")
    return array
