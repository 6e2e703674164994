"""Where a robot is by its measured velocities alone, since it began to count."""

import math

import numpy as np


class DeadReckoning:
    """A pose that follows measured velocities, and drifts with their errors.

    Attributes:
        pose: x and y in m and yaw in [-pi, pi) rad, float64 [3], in the frame of where it began.
        time_s: since it began, s.

    Example:
        >>> robot = DeadReckoning()
        >>> robot.move(1.0, 0.0, 0.5)  # it speeds up evenly from rest
        >>> robot.pose.tolist()
        [0.25, 0.0, 0.0]
    """

    def __init__(self) -> None:
        self.pose = np.zeros(3)
        self.time_s = 0.0
        self._velocities = 0.0, 0.0

    def move(self, v: float, omega: float, elapsed_s: float) -> None:
        """Go on along an arc.

        Args:
            v: linear velocity measured now, m/s.
            omega: angular velocity measured now, rad/s.
            elapsed_s: since the last measurement, s.
        """
        before_v, before_omega = self._velocities
        # Velocities are measured at an observation; in between the robot had about their mean.
        distance, half_turn = 0.5 * (before_v + v) * elapsed_s, 0.25 * (before_omega + omega) * elapsed_s
        x, y, yaw = self.pose.tolist()
        # The chord of the arc; a turn of a step is small, so the sine's series is exact to rounding.
        chord = distance * (1.0 - half_turn * half_turn / 6.0)
        x += chord * math.cos(yaw + half_turn)
        y += chord * math.sin(yaw + half_turn)
        self.pose[:] = x, y, (yaw + 2.0 * half_turn + math.pi) % (2.0 * math.pi) - math.pi
        self._velocities = v, omega
        self.time_s += elapsed_s
