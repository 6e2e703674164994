"""Where a robot thinks it is: wheels that slip a little, and a localisation that corrects them now and then."""

import math

import numpy as np

from rcdsac_trl.config.course_settings import OdometrySettings

Pose = tuple[float, float, float]

# Errors are normal, cut off here: so the estimate's error is bounded.
_CUT_OFF = 2.0


class Odometry:
    """The estimate of one run.

    Args:
        settings: how wrong it is.
        start: true pose at the beginning, which is known: x, y in m and yaw in rad.
        rng: stream of all errors.

    Attributes:
        pose: the estimate, x, y in m and yaw in rad.

    Example:
        >>> exact = OdometrySettings(0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.5, (0.0, 0.0))
        >>> odometry = Odometry(exact, (1.0, 2.0, 0.0), np.random.default_rng(0))
        >>> odometry.move((1.1, 2.0, 0.5), 0.15)
        >>> [round(value, 9) for value in odometry.pose]
        [1.1, 2.0, 0.5]
    """

    def __init__(self, settings: OdometrySettings, start: Pose, rng: np.random.Generator) -> None:
        self._settings = settings
        self._rng = rng
        self._true = self.pose = start
        self._travel_scale, self._turn_scale = (1.0 + settings.scale_std * error for error in self._errors(2))
        self._since_fix_s = 0.0

    def move(self, true: Pose, period_s: float) -> None:
        """Take a motion in.

        Args:
            true: where the robot really is now.
            period_s: how long it took.
        """
        settings = self._settings
        x, y, yaw = self._true
        self._true = true
        # The motion in the robot's frame, as wheels measure it.
        dx, dy, turn = true[0] - x, true[1] - y, math.remainder(true[2] - yaw, 2.0 * math.pi)
        cos, sin = math.cos(yaw), math.sin(yaw)
        ahead, left = cos * dx + sin * dy, cos * dy - sin * dx
        travel_error, turn_error = self._errors(2)
        slip = settings.travel_noise * math.sqrt(math.hypot(dx, dy)) * travel_error
        ahead, left = self._travel_scale * ahead + slip, self._travel_scale * left
        turn = self._turn_scale * turn + settings.turn_noise * math.sqrt(abs(turn)) * turn_error
        x, y, yaw = self.pose
        cos, sin = math.cos(yaw), math.sin(yaw)
        self.pose = (x + cos * ahead - sin * left, y + sin * ahead + cos * left, _wrapped(yaw + turn))
        self._since_fix_s += period_s
        # Periods add up to a fix's time only within rounding.
        if self._since_fix_s > settings.fix_period_s - 1e-9:
            self._since_fix_s = 0.0
            self._correct()

    def velocity(self, v: float, omega: float) -> tuple[float, float]:
        """Return the velocities that are measured, m/s and rad/s, of the true ones."""
        v_error, omega_error = self._errors(2)
        std_v, std_omega = self._settings.velocity_std
        return v + std_v * v_error, omega + std_omega * omega_error

    def _correct(self) -> None:
        settings = self._settings
        error_x, error_y, error_yaw = self._errors(3)
        x, y, yaw = self.pose
        weight = settings.fix_weight
        x += weight * (self._true[0] + settings.fix_std_m * error_x - x)
        y += weight * (self._true[1] + settings.fix_std_m * error_y - y)
        yaw += weight * _wrapped(self._true[2] + settings.fix_std_rad * error_yaw - yaw)
        self.pose = (x, y, _wrapped(yaw))

    def _errors(self, number: int) -> list[float]:
        errors: list[float] = np.clip(self._rng.standard_normal(number), -_CUT_OFF, _CUT_OFF).tolist()
        return errors


def _wrapped(angle: float) -> float:
    return math.remainder(angle, 2.0 * math.pi)
