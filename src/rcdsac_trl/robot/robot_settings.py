"""Which robot it is: its shape, its limits, its sensor; what simulation, agents and guard take from it.

The paper's robot is the default, :data:`PAPER`. Whoever needs a robot is given one: nothing here can be set for all.
"""

import math
from collections.abc import Mapping
from dataclasses import asdict, dataclass, field, fields
from functools import cached_property
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from rcdsac_trl.errors import UserInputError
from rcdsac_trl.robot.limits import (
    DEAD_BAND_DEG_PER_S,
    MAX_LINEAR_ACCELERATION,
    MAX_LINEAR_VELOCITY,
    MAX_TURN_ACCELERATION_DEG_PER_S2,
    MAX_TURN_DEG_PER_S,
    MIN_LINEAR_VELOCITY,
    MOTOR_PERIOD_S,
)
from rcdsac_trl.robot.range_sensor import LidarSettings, is_number, sensor_mask

Shape = Literal["disc", "polygon", "rectangle"]

RADII_M = (0.05, 0.6)
"""Smallest and largest circumradius: the planner's grid has cells of 0.1 m, and maps have passages of 0.9 to 2.4 m."""

# The sizes that a shape has; those of the others are null.
_SIZES: dict[str, tuple[str, ...]] = {
    "disc": ("radius_m",),
    "polygon": ("radius_m", "corners"),
    "rectangle": ("length_m", "width_m"),
}
_MOST_CORNERS = 64
# A turning robot whose corners stand out by less than this share touches a wall beside it all the time.
_ROUND = 0.9
# What is nearer to the centre than these shares of the two radii is the robot itself.
_OWN_SHARE_OF_CIRCUMRADIUS, _OWN_SHARE_OF_INRADIUS = 0.8, 0.9
_DISC_OUTLINE = 48

# Least (exclusive unless 0) and largest value of what moves; more is in another unit.
_LIMITS = {
    "max_speed_m_per_s": (0.0, 2.0),
    "max_turn_deg_per_s": (0.0, 360.0),
    "max_acceleration_m_per_s2": (0.0, 20.0),
    "max_turn_acceleration_deg_per_s2": (0.0, 3600.0),
    "motor_period_s": (0.0, 0.1),
}


@dataclass(frozen=True)
class RobotSettings:
    """A differential-drive robot; every field is a key of ``conf/robot/*.yaml``.

    Its centre is the point that it turns about.

    Attributes:
        name: what it is called in weights, cards and messages.
        shape: ``disc``, ``polygon`` (regular, a flat side faces forward) or ``rectangle``.
        radius_m: of the circle around its corners (polygon), or of the disc; None for a rectangle.
        corners: of the polygon; None for others.
        length_m: of the rectangle, ahead; None for others.
        width_m: of the rectangle, aside; None for others.
        middle_x_m: where the middle of the shape lies, ahead of the centre.
        max_speed_m_per_s: forwards.
        max_reverse_m_per_s: backwards, as a positive number; 0: it does not reverse.
        max_turn_deg_per_s: either way.
        max_acceleration_m_per_s2: speeding up and braking.
        max_turn_acceleration_deg_per_s2: likewise, of turns.
        dead_band_deg_per_s: desired angular velocities below this are taken as 0.
        motor_period_s: control period of the motor controller, and step of the physics. An agent acts every
            ``task.motor_steps`` of them.
        lidar: its range sensor.

    Raises:
        UserInputError: a value is outside its limits.

    Example:
        >>> box = RobotSettings("box", "rectangle", None, None, length_m=0.6, width_m=0.8)
        >>> round(box.circumradius_m, 6), round(box.inradius_m, 6)
        (0.5, 0.3)
    """

    name: str = "paper"
    shape: Shape = "polygon"
    radius_m: float | None = 0.25
    corners: int | None = 8
    length_m: float | None = None
    width_m: float | None = None
    middle_x_m: float = 0.0
    max_speed_m_per_s: float = MAX_LINEAR_VELOCITY
    max_reverse_m_per_s: float = -MIN_LINEAR_VELOCITY
    max_turn_deg_per_s: float = MAX_TURN_DEG_PER_S
    max_acceleration_m_per_s2: float = MAX_LINEAR_ACCELERATION
    max_turn_acceleration_deg_per_s2: float = MAX_TURN_ACCELERATION_DEG_PER_S2
    dead_band_deg_per_s: float = DEAD_BAND_DEG_PER_S
    motor_period_s: float = MOTOR_PERIOD_S
    lidar: LidarSettings = field(default_factory=LidarSettings)

    def __post_init__(self) -> None:
        """Refuse what is no robot."""
        if not isinstance(self.name, str) or not self.name.replace("-", "_").isidentifier():
            raise UserInputError(f"robot.name={self.name!r} is no name: letters, digits, - and _, such as my_robot")
        if self.shape not in _SIZES:
            raise UserInputError(f"robot.shape={self.shape!r} does not exist: choose one of {', '.join(_SIZES)}")
        if not isinstance(self.lidar, LidarSettings):
            raise UserInputError(f"robot.lidar is a {type(self.lidar).__name__}: give its settings")
        self._check_sizes()
        self._check_motion()
        low, high = RADII_M
        if not low <= self.circumradius_m <= high:
            raise UserInputError(
                f"robot={self.name} reaches {self.circumradius_m:g} m from its centre, outside [{low:g}, {high:g}], "
                "for which there are no maps: give its sizes in metres"
            )
        if self.lidar.max_range_m < self.circumradius_m + 0.5:
            raise UserInputError(
                f"robot.lidar.max_range_m={self.lidar.max_range_m:g} is less than 0.5 m beyond the robot, which "
                f"reaches {self.circumradius_m:g} m from its centre: let it see farther"
            )

    def _check_sizes(self) -> None:
        for name in ("radius_m", "corners", "length_m", "width_m"):
            value, needed = getattr(self, name), name in _SIZES[self.shape]
            if not needed and value is not None:
                raise UserInputError(f"robot.{name}={value} means nothing to a {self.shape}: set it to null")
            if needed and not (is_number(value) and value > 0):
                raise UserInputError(f"robot.{name}={value} of a {self.shape} must be a positive number: give one")
        if self.corners is not None and (self.corners != int(self.corners) or not 3 <= self.corners <= _MOST_CORNERS):
            raise UserInputError(
                f"robot.corners={self.corners:g} makes no polygon: give a whole number from 3 to {_MOST_CORNERS}"
            )
        if not is_number(self.middle_x_m):
            raise UserInputError(f"robot.middle_x_m={self.middle_x_m!r} is no finite number: give metres")
        if not self.inradius_m > 0.0:
            raise UserInputError(
                f"robot.middle_x_m={self.middle_x_m:g} puts the point that the robot turns about outside of it: give a "
                "smaller one"
            )

    def _check_motion(self) -> None:
        for name, (low, high) in _LIMITS.items():
            value = getattr(self, name)
            if not (is_number(value) and low < value <= high):
                raise UserInputError(
                    f"robot.{name}={value} must be above {low:g} and at most {high:g}: give such a one"
                )
        if not (is_number(self.max_reverse_m_per_s) and 0.0 <= self.max_reverse_m_per_s <= 2.0):
            raise UserInputError(
                f"robot.max_reverse_m_per_s={self.max_reverse_m_per_s} must be from 0 to 2: give a positive number"
            )
        if not (is_number(self.dead_band_deg_per_s) and 0.0 <= self.dead_band_deg_per_s < self.max_turn_deg_per_s):
            raise UserInputError(
                f"robot.dead_band_deg_per_s={self.dead_band_deg_per_s} must be from 0 to less than "
                f"robot.max_turn_deg_per_s={self.max_turn_deg_per_s:g}, or the robot never turns"
            )

    @classmethod
    def from_mapping(cls, values: Mapping[str, Any]) -> "RobotSettings":
        """Make a robot of plain values, as ``asdict`` and JSON have them.

        Raises:
            UserInputError: for a key that does not exist or is missing, and what a robot cannot be.
        """
        lidar = values.get("lidar")
        for kind, given, section in ((cls, values, "robot"), (LidarSettings, lidar, "robot.lidar")):
            if not isinstance(given, Mapping):
                raise UserInputError(f"{section} is {given!r}: give a section with its keys")
            known = {each.name for each in fields(kind)}
            if wrong := sorted(known ^ set(given)):
                raise UserInputError(f"{section} has the wrong keys ({wrong[0]}): it has {', '.join(sorted(known))}")
        assert isinstance(lidar, Mapping)
        return cls(**{**values, "lidar": LidarSettings(**lidar)})

    # ---------------------------------------------------------------------------------------------- shape
    @cached_property
    def outline(self) -> NDArray[np.float64]:
        """Its corners in its frame, counter-clockwise, m, float64 [n, 2]; of a disc a fine polygon, for pictures."""
        if self.shape == "rectangle":
            assert self.length_m is not None
            assert self.width_m is not None
            half_x, half_y = self.length_m / 2.0, self.width_m / 2.0
            corners = [(half_x, half_y), (-half_x, half_y), (-half_x, -half_y), (half_x, -half_y)]
        else:
            assert self.radius_m is not None
            number = _DISC_OUTLINE if self.corners is None else int(self.corners)
            angles = [math.radians((k + 0.5) * 360.0 / number) for k in range(number)]
            corners = [(self.radius_m * math.cos(angle), self.radius_m * math.sin(angle)) for angle in angles]
        outline = np.array([(x + self.middle_x_m, y) for x, y in corners])
        outline.flags.writeable = False
        return outline

    @cached_property
    def circumradius_m(self) -> float:
        """Radius of the circle around its centre that holds it."""
        if self.shape != "rectangle":
            assert self.radius_m is not None
            if self.shape == "disc" or self.middle_x_m == 0.0:
                return self.radius_m + abs(self.middle_x_m)
        return float(np.hypot(*self.outline.T).max())

    @cached_property
    def inradius_m(self) -> float:
        """Radius of the circle around its centre that it holds; not above 0 where its centre is outside."""
        if self.shape == "disc":
            assert self.radius_m is not None
            return self.radius_m - abs(self.middle_x_m)
        ends = np.roll(self.outline, -1, axis=0)
        sides = ends - self.outline
        # Of a convex outline run counter-clockwise: how far to the left of each side's line the centre lies.
        left = self.outline[:, 0] * sides[:, 1] - self.outline[:, 1] * sides[:, 0]
        return float((left / np.hypot(*sides.T)).min())

    @cached_property
    def is_round(self) -> bool:
        """Whether the circle around it stands for it: it may turn beside a wall without hitting it with its corners."""
        return self.shape == "disc" or self.inradius_m > _ROUND * self.circumradius_m

    @cached_property
    def body_radius_m(self) -> float:
        """What a sensor says is nearer to the centre than this is the robot itself: nothing else gets there."""
        return min(_OWN_SHARE_OF_CIRCUMRADIUS * self.circumradius_m, _OWN_SHARE_OF_INRADIUS * self.inradius_m)

    # ---------------------------------------------------------------------------------------------- motion
    @cached_property
    def min_linear_velocity(self) -> float:
        """The most negative linear velocity, m/s."""
        return -self.max_reverse_m_per_s

    @cached_property
    def fastest_m_per_s(self) -> float:
        """The larger of its two linear limits."""
        return max(self.max_speed_m_per_s, self.max_reverse_m_per_s)

    @cached_property
    def max_angular_velocity(self) -> float:
        """Either way, rad/s."""
        return math.radians(self.max_turn_deg_per_s)

    @cached_property
    def max_angular_acceleration(self) -> float:
        """Either way, rad/s^2."""
        return math.radians(self.max_turn_acceleration_deg_per_s2)

    @cached_property
    def dead_band(self) -> float:
        """Desired angular velocities below this are taken as 0, rad/s."""
        return math.radians(self.dead_band_deg_per_s)

    @cached_property
    def reward_per_speed(self) -> float:
        """What a linear velocity counts in the reward, in units of the paper's: full speed pays 0.6 on every robot."""
        return MAX_LINEAR_VELOCITY / self.max_speed_m_per_s

    @cached_property
    def reward_per_turn(self) -> float:
        """What an angular velocity counts in the reward: a full turn costs on every robot what it costs the paper's."""
        return MAX_TURN_DEG_PER_S / self.max_turn_deg_per_s

    def stopping_distance_m(self, v: float) -> float:
        """Return how far it drives from a speed, m/s, until it stands, if it brakes at once.

        Example:
            >>> round(PAPER.stopping_distance_m(0.6), 3)
            0.12
        """
        return v * v / (2.0 * self.max_acceleration_m_per_s2)

    # ---------------------------------------------------------------------------------------------- sensor
    def sensor_mask(self, sensor: str) -> NDArray[np.bool_]:
        """Return the sectors that an agent is told of: those that its robot's sensor has, and `sensor` names.

        Args:
            sensor: one of :data:`rcdsac_trl.robot.range_sensor.SENSORS`.

        Raises:
            UserInputError: if there is no such sensor, or nothing is left.
        """
        mask = sensor_mask(sensor) & self.lidar.mask
        if not mask.any():
            raise UserInputError(
                f"sensor={sensor} has no sector that robot={self.name} has in view: choose another sensor, or widen "
                "robot.lidar.field_of_view_deg"
            )
        return mask

    def plain(self) -> dict[str, Any]:
        """Return its fields as plain values, for results that say what drove; undone by :meth:`from_mapping`."""
        return asdict(self)


PAPER = RobotSettings()
"""The robot of the paper: an octagon of 0.25 m."""
