"""What any range sensor says about the 180 sectors around the robot, and how it is mounted."""

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from rcdsac_trl.errors import UserInputError
from rcdsac_trl.robot.range_sensor import BIN_RAD, MAX_RANGE_M, NUM_BINS, LidarSettings
from rcdsac_trl.robot.robot_settings import PAPER

BODY_RADIUS_M = PAPER.body_radius_m
"""What is nearer to the paper's robot's centre, 0.2 m, is the robot itself: nothing else gets inside an octagon of
0.25 m, whose sides are 0.23 m away."""

_NUMBER = int | float | np.integer | np.floating
_NO_NUMBER = bool | np.timedelta64  # which Python, and NumPy, count among the integers
# Farther from the centre, or more than a full turn, is another unit (mm, degrees).
_FARTHEST_MOUNT_M = 1.0
# Angles come as float32 and are multiples of an increment: a border itself must not fall to the wrong side.
_BORDER_RAD = 2e-6


@dataclass(frozen=True)
class Sectors:
    """The range sensor's answer, sector by sector; index 0 is [0, 2) degrees counter-clockwise from straight ahead.

    Attributes:
        distances_m: smallest distance from the robot's centre to anything in the sector, ``inf`` where nothing is
            within reach, float64 [180].
        covered: whether the sensor can say anything about the sector, bool [180]; elsewhere the distance is ``inf``.
        max_range_m: that reach: what is farther was left out.
    """

    distances_m: NDArray[np.float64]
    covered: NDArray[np.bool_]
    max_range_m: float = MAX_RANGE_M


@dataclass(frozen=True)
class Mount:
    """Where a planar sensor sits on the robot.

    Attributes:
        x_m: ahead of the robot's centre, m.
        y_m: left of it, m.
        yaw_rad: direction of the sensor's x axis, counter-clockwise from straight ahead.
        upside_down: the sensor hangs: its angles count clockwise, seen from above.
    """

    x_m: float = 0.0
    y_m: float = 0.0
    yaw_rad: float = 0.0
    upside_down: bool = False

    def __post_init__(self) -> None:
        """Refuse what is not finite, or in another unit."""
        check_switches(self, "upside_down")
        if not all(math.isfinite(value) for value in (self.x_m, self.y_m, self.yaw_rad)):
            raise UserInputError(f"mount {self} is not finite: give metres and radians")
        if math.hypot(self.x_m, self.y_m) > _FARTHEST_MOUNT_M:
            raise UserInputError(
                f"a sensor at x_m={self.x_m:g}, y_m={self.y_m:g} is more than {_FARTHEST_MOUNT_M:g} m from the robot's "
                "centre: give metres"
            )
        if abs(self.yaw_rad) > 2.0 * math.pi:
            raise UserInputError(f"yaw_rad={self.yaw_rad:g} of a sensor is more than a full turn: give radians")


def mount_of_lidar(lidar: LidarSettings) -> Mount:
    """Return where a robot's own sensor sits."""
    return Mount(lidar.x_m, lidar.y_m, math.radians(lidar.yaw_deg))


def is_finite_number(value: object) -> bool:
    """Tell whether something is one finite number, whatever it may be."""
    try:
        return isinstance(value, _NUMBER) and not isinstance(value, _NO_NUMBER) and math.isfinite(float(value))
    except (OverflowError, TypeError):
        return False


def is_whole_number(value: object) -> bool:
    """Tell whether something is one integer, whatever it may be."""
    return isinstance(value, int | np.integer) and not isinstance(value, _NO_NUMBER)


def check_switches(thing: object, *names: str) -> None:
    """Refuse switches that are neither true nor false: a text such as "no" would count as true.

    Raises:
        UserInputError: with the first of them.
    """
    for name in names:
        if not isinstance(value := getattr(thing, name), bool | np.bool_):
            raise UserInputError(f"{name}={value!r} of a {type(thing).__name__} is neither True nor False: give one")


def bins_of(angles_rad: NDArray[np.floating]) -> NDArray[np.intp]:
    """Return the sector (from 0) of each angle, any full turns apart; a border belongs to the sector it begins."""
    return np.floor((angles_rad + _BORDER_RAD) / BIN_RAD).astype(np.intp) % NUM_BINS


def nearest_by_sector(
    bins: NDArray[np.intp],
    distances_m: NDArray[np.float64],
    support: int = 1,
    max_range_m: float = MAX_RANGE_M,
) -> NDArray[np.float64]:
    """Return the smallest distance in each sector, ``inf`` where nothing is within reach, float64 [180].

    Args:
        bins: sector of each point, [n].
        distances_m: of each point, [n].
        support: this many points must be at least as near: 1 is the exact minimum, more ignores single outliers.
        max_range_m: that reach.
    """
    near = distances_m < max_range_m
    bins, distances_m = bins[near], distances_m[near]
    nearest = np.full(NUM_BINS, np.inf)
    if support == 1:
        np.minimum.at(nearest, bins, distances_m)
        return nearest
    order = np.lexsort((distances_m, bins))
    bins, distances_m = bins[order], distances_m[order]
    starts, ends = (np.searchsorted(bins, np.arange(NUM_BINS), side=side) for side in ("left", "right"))
    enough = ends - starts >= support
    nearest[enough] = distances_m[starts[enough] + support - 1]
    return nearest
