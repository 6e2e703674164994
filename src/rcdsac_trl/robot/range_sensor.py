"""The range sensor: its bins, its reach, and which bins a sensor has (paper, "States and Observations")."""

import math
from collections.abc import Sequence
from dataclasses import dataclass, fields
from functools import cached_property
from typing import Literal, get_args

import numpy as np
from numpy.typing import NDArray

from rcdsac_trl.errors import UserInputError

# The range sensor (paper, section "States and Observations").
NUM_BINS = 180
"""Number of sectors; bin i (counted from 1) covers [2i-2, 2i) degrees counter-clockwise from the x axis."""


BIN_RAD = 2.0 * math.pi / NUM_BINS
"""Width of a sector."""


MAX_RANGE_M = 3.0
"""What is this far away or farther is not sensed by the paper's robot; another's reach is in :class:`LidarSettings`."""


Sensor = Literal["narrow", "sparse", "full"]
"""Which bins the sensor has; see :func:`sensor_mask`."""


SENSORS: frozenset[str] = frozenset(get_args(Sensor))


FieldOfView = tuple[tuple[float, float], ...]
"""Intervals of bearings, each from right to left, degrees counter-clockwise from straight ahead."""


_VIEWS: dict[str, tuple[FieldOfView, int]] = {
    "full": (((-180.0, 180.0),), 1),
    "narrow": (((-44.0, 42.0),), 1),
    "sparse": (((-180.0, 180.0),), 10),
}
# Borders that went through radians belong to the interval that they end.
_BORDER_DEG = 1e-6
_NUMBER = int | float | np.integer | np.floating


def is_number(value: object) -> bool:
    """Tell whether something is one finite number; true and false are none."""
    return isinstance(value, _NUMBER) and not isinstance(value, bool) and math.isfinite(float(value))


@dataclass(frozen=True)
class LidarSettings:
    """What a robot's range sensor is; every field is a key of ``robot.lidar`` in ``conf/robot/*.yaml``.

    Whatever it is, an agent is told 180 sectors of 2 degrees around the robot's centre. A sector is one of the sensor's
    if the sensor has it in view, from where it sits, as far away as it looks.

    Attributes:
        field_of_view_deg: what it has in view, intervals of bearings from its own x axis, degrees counter-clockwise:
            ``((-135, 135),)`` looks 270 degrees ahead.
        every_bins: a coarser sensor has only every so many sectors, those whose number (from 1) it divides.
        max_range_m: what is this far from the robot's centre, or farther, is not sensed, m.
        x_m: where it sits, ahead of the robot's centre, m.
        y_m: likewise, to the left, m.
        yaw_deg: direction of its x axis, degrees counter-clockwise from straight ahead.

    Raises:
        UserInputError: a value is outside its limits, or nothing is in view.

    Example:
        >>> int(LidarSettings(field_of_view_deg=((-135.0, 135.0),)).mask.sum())
        134
    """

    field_of_view_deg: FieldOfView = ((-180.0, 180.0),)
    every_bins: int = 1
    max_range_m: float = MAX_RANGE_M
    x_m: float = 0.0
    y_m: float = 0.0
    yaw_deg: float = 0.0

    def __post_init__(self) -> None:
        """Turn the lists of a file into tuples, and refuse what senses nothing."""
        object.__setattr__(self, "field_of_view_deg", _intervals(self.field_of_view_deg))
        for field in fields(self)[1:]:
            if not is_number(value := getattr(self, field.name)):
                raise UserInputError(f"robot.lidar.{field.name}={value!r} is no finite number: give one")
        if self.every_bins != int(self.every_bins) or not 1 <= self.every_bins <= NUM_BINS // 2:
            raise UserInputError(
                f"robot.lidar.every_bins={self.every_bins:g} is no whole number from 1 to {NUM_BINS // 2}: 1 has all "
                f"{NUM_BINS} sectors"
            )
        low, high = LIDAR_RANGES_M
        if not low <= self.max_range_m <= high:
            raise UserInputError(
                f"robot.lidar.max_range_m={self.max_range_m:g} is outside [{low:g}, {high:g}]: give metres, as far as "
                "the agent is to see"
            )
        if math.hypot(self.x_m, self.y_m) > FARTHEST_LIDAR_M:
            raise UserInputError(
                f"robot.lidar.x_m={self.x_m:g} and y_m={self.y_m:g} are more than {FARTHEST_LIDAR_M:g} m from the "
                "robot's centre, around which sectors are counted: give metres, or mount it nearer"
            )
        if abs(self.yaw_deg) > 360.0:
            raise UserInputError(f"robot.lidar.yaw_deg={self.yaw_deg:g} is more than a full turn: give degrees")
        if not self.mask.any():
            raise UserInputError(
                f"robot.lidar.field_of_view_deg={_shown(self.field_of_view_deg)} with every_bins={self.every_bins:g} "
                f"has no whole sector of {360 // NUM_BINS} degrees in view: widen it"
            )

    @cached_property
    def mask(self) -> NDArray[np.bool_]:
        """Which of the 180 sectors it has, bool [180], read-only."""
        borders = np.arange(NUM_BINS + 1) * BIN_RAD
        x, y = self.max_range_m * np.cos(borders) - self.x_m, self.max_range_m * np.sin(borders) - self.y_m
        mask = _in_view(np.degrees(np.arctan2(y, x)) - self.yaw_deg, self.field_of_view_deg, int(self.every_bins))
        mask.flags.writeable = False
        return mask


LIDAR_RANGES_M = (1.0, 30.0)
"""Shortest and longest reach of a sensor: below, robots touch what they do not see yet."""


FARTHEST_LIDAR_M = 0.3
"""Farther from the robot's centre, a sensor sees other sides of things than the sectors around the centre say."""


def _intervals(value: object) -> FieldOfView:
    """Return intervals of bearings as floats.

    Raises:
        UserInputError: if they are none.
    """
    told = "give intervals from right to left in degrees, such as [[-135, 135]]"
    try:
        intervals = tuple((float(low), float(high)) for low, high in value)  # type: ignore[attr-defined]
    except (TypeError, ValueError):
        raise UserInputError(f"robot.lidar.field_of_view_deg={value} is no list of pairs: {told}") from None
    for low, high in intervals:
        # Written so that NaN fails too.
        if not (-360.0 <= low < high <= 360.0 and high - low <= 360.0):
            raise UserInputError(f"robot.lidar.field_of_view_deg holds [{low:g}, {high:g}]: {told}")
    if not intervals:
        raise UserInputError(f"robot.lidar.field_of_view_deg is empty, so the sensor sees nothing: {told}")
    return intervals


def _shown(intervals: FieldOfView) -> str:
    return f"[{', '.join(f'[{low:g}, {high:g}]' for low, high in intervals)}]"


def _in_view(borders_deg: NDArray[np.floating], view: Sequence[tuple[float, float]], every: int) -> NDArray[np.bool_]:
    """Return the sectors whose both borders [181] lie in one of the intervals, as far as `every` has them."""
    seen = np.zeros(NUM_BINS, dtype=np.bool_)
    for low, high in view:
        if high - low >= 360.0 - _BORDER_DEG:
            seen[:] = True
        right = (borders_deg[:-1] - low + _BORDER_DEG) % 360.0
        left = right + (borders_deg[1:] - borders_deg[:-1]) % 360.0
        seen |= left <= high - low + 2.0 * _BORDER_DEG
    return seen & (np.arange(1, NUM_BINS + 1) % every == 0)


LONGEST_MEMORY_S = 3600.0
"""Longer than an episode by far; more than that was meant in other units."""


def check_memory(memory_s: float) -> None:
    """Refuse a time that nothing can be remembered for.

    Raises:
        UserInputError: if it is no number, negative, not finite, or above :data:`LONGEST_MEMORY_S`.
    """
    if isinstance(memory_s, bool) or not isinstance(memory_s, int | float | np.integer | np.floating):
        raise UserInputError(f"sensor.memory_s={memory_s!r} is no number: give seconds, 0 for no memory")
    if not 0.0 <= memory_s <= LONGEST_MEMORY_S:
        raise UserInputError(
            f"sensor.memory_s={memory_s:g} is outside [0, {LONGEST_MEMORY_S:g}]: give seconds, 0 for no memory"
        )


def sensor_mask(name: str) -> NDArray[np.bool_]:
    """Return which of the 180 bins a sensor has, bool [180].

    ``full`` has all of them; ``narrow`` lacks bins 22 to 158 (counted from 1, both inclusive), so 43 remain:
    42 degrees to the left and 44 to the right; ``sparse`` has every tenth bin, 10, 20, ..., 180.

    Args:
        name: one of :data:`SENSORS`.

    Raises:
        UserInputError: there is no such sensor.

    Example:
        >>> int(sensor_mask("narrow").sum()), int(sensor_mask("sparse").sum())
        (43, 18)
    """
    if name not in SENSORS:
        raise UserInputError(f"sensor={name!r} does not exist; choose one of {', '.join(sorted(SENSORS))}")
    borders_deg = np.arange(NUM_BINS + 1, dtype=np.float64) * (360.0 / NUM_BINS)
    return _in_view(borders_deg, *_VIEWS[name])
