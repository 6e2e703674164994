"""When a robot is in contact: how that begins with a touch, and how it ends."""

import math
from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from rcdsac_trl.robot.robot_settings import RobotSettings
from rcdsac_trl.world.maps.geometry import outline_clearance, segment_clearance

CONTACT_DISTANCE_M = 1e-3
"""A contact begins with something nearer to the robot's body than this.

The solver lets a pushing robot rest within about 0.01 mm of a wall, on either side of it; with a limit of 0
mm, leaning on a wall would read as a series of collisions.
"""
CONTACT_END_GAP_M = 0.005
"""A contact can only end while nothing is within this gap of the circle around the robot's corners.

Of the circle, not of the body: a robot that turns beside a wall touches it with one corner after the other, between
which its flat sides are up to 19 mm away. The circle does not turn. Of a robot that is not nearly round, such as a
rectangle, it is the body: its circle is far from its sides.
"""
CONTACT_END_S = 0.4
"""A contact ends when the gap has been that wide at the end of every agent step for so long."""


class Touch(NamedTuple):
    """How the robot touched something first in an agent step, as it stood when that was noticed.

    Attributes:
        x: where on the thing, map frame, m.
        y: likewise.
        mover: number of the mover that was touched; None: something that stands.
        pose: the robot's x, y in m and yaw in rad.
        v: linear velocity it drove with, before contact took any of it away, m/s.
        omega: angular velocity likewise, rad/s.
        motor_step: number of the motor step in the agent step, from 0.
    """

    x: float
    y: float
    mover: int | None
    pose: tuple[float, float, float]
    v: float
    omega: float
    motor_step: int


def first_touch(
    points: Sequence[Sequence[Any]],
    movers: Sequence[int],
    before: tuple[float, float, float, float, float],
    motor_step: int,
) -> Touch | None:
    """Describe the deepest of PyBullet's contact points; None if even that is no contact.

    Args:
        points: of the robot's body, at least one, as a motor step found them; it looks for contact first, and then
            moves the robot.
        movers: PyBullet's numbers of the movers' bodies.
        before: pose before that step, and velocities that the motor set in the step before it. In that one PyBullet
            already slows down what would else go through a thing.
        motor_step: its number.
    """
    deepest = min(points, key=lambda point: point[8])
    if deepest[8] > CONTACT_DISTANCE_M:
        return None
    body, (x, y, _) = deepest[2], deepest[6]
    x_robot, y_robot, yaw, v, omega = before
    pose = x_robot, y_robot, math.remainder(yaw, 2.0 * math.pi)
    return Touch(x, y, movers.index(body) if body in movers else None, pose, v, omega, motor_step)


class Contact:
    """Whether a robot is in contact; it is not at first.

    Args:
        robot: which one it is.
    """

    def __init__(self, robot: RobotSettings) -> None:
        self._robot = robot
        self._lasts = False
        self._apart_steps = 0  # motor steps without anything near, since the last touch

    def end(self) -> None:
        """Forget a contact: the robot was put somewhere else."""
        self._lasts = False

    def after_step(
        self,
        touched: bool,
        motor_steps: int,
        pose: tuple[float, float, float],
        boxes: NDArray[np.float64],
        circles: NDArray[np.float64],
    ) -> bool:
        """Let a contact begin with a touch, and end when nothing has been near for long enough.

        Args:
            touched: whether the robot touched anything in an agent step.
            motor_steps: of that step.
            pose: the robot's after it, x, y in m and yaw in rad.
            boxes: what stands, [n, 6], as :meth:`rcdsac_trl.world.maps.shapes.Map.solids` returns it.
            circles: what else stands, and what moves, [m, 3], likewise.

        Returns:
            Whether the robot is in contact.
        """
        if touched:
            self._lasts, self._apart_steps = True, 0
        elif self._lasts:
            self._apart_steps = self._apart_steps + motor_steps if self._is_apart(pose, boxes, circles) else 0
            self._lasts = self._apart_steps * self._robot.motor_period_s < CONTACT_END_S
        return self._lasts

    def _is_apart(
        self, pose: tuple[float, float, float], boxes: NDArray[np.float64], circles: NDArray[np.float64]
    ) -> bool:
        """Return whether nothing is within the gap in which a contact goes on."""
        if not self._robot.is_round:
            gap_m = outline_clearance(self._robot.outline, pose, boxes, circles, CONTACT_END_GAP_M)
            return bool(gap_m >= CONTACT_END_GAP_M)
        x, y, _ = pose
        wide_m = self._robot.circumradius_m + CONTACT_END_GAP_M
        return bool(segment_clearance(x, y, x, y, boxes, circles, wide_m) >= wide_m)
