"""What an action means: desired velocities, and what the motor controller makes of them.

Pure functions; the simulated world and the policy on a robot call the same ones.
"""

from collections.abc import Sequence

from numpy.typing import NDArray

from rcdsac_trl.robot.limits import (
    DEAD_BAND,
    MAX_ANGULAR_ACCELERATION,
    MAX_ANGULAR_VELOCITY,
    MAX_LINEAR_ACCELERATION,
    MAX_LINEAR_VELOCITY,
    MIN_LINEAR_VELOCITY,
    MOTOR_PERIOD_S,
)

# A bound given in degrees must hold for a float that went through radians: 15 deg/s itself is kept.
_ANGULAR_TOLERANCE = 1e-6


def desired_velocities(action: Sequence[float] | NDArray) -> tuple[float, float]:
    """Return the desired velocities (v_u, omega_u) of an action, m/s and rad/s.

    The linear velocity runs from -0.2 to 0.6 m/s over u_0; the angular one is 90 deg/s times u_1, and 0 where
    its size is below 15 deg/s.

    Args:
        action: u, [2], in [-1, 1]; what is outside is clipped.

    Example:
        >>> desired_velocities([1.0, 0.1])
        (0.6, 0.0)
    """
    u0, u1 = float(action[0]), float(action[1])
    u0 = 1.0 if u0 > 1.0 else -1.0 if u0 < -1.0 else u0
    u1 = 1.0 if u1 > 1.0 else -1.0 if u1 < -1.0 else u1
    linear = MIN_LINEAR_VELOCITY * (1.0 - u0) / 2.0 + MAX_LINEAR_VELOCITY * (1.0 + u0) / 2.0
    angular = MAX_ANGULAR_VELOCITY * u1
    return linear, 0.0 if inside_dead_band(angular) else angular


def action_of(linear: float, angular: float) -> tuple[float, float]:
    """Return the action u of desired velocities. Undoes :func:`desired_velocities`.

    Args:
        linear: m/s; what is beyond the robot's range is clipped.
        angular: rad/s; likewise.

    Example:
        >>> action_of(0.6, 0.0)
        (1.0, 0.0)
    """
    v = min(max(linear, MIN_LINEAR_VELOCITY), MAX_LINEAR_VELOCITY)
    omega = min(max(angular, -MAX_ANGULAR_VELOCITY), MAX_ANGULAR_VELOCITY)
    share = (v - MIN_LINEAR_VELOCITY) / (MAX_LINEAR_VELOCITY - MIN_LINEAR_VELOCITY)
    return 2.0 * share - 1.0, omega / MAX_ANGULAR_VELOCITY


def inside_dead_band(angular_velocity: float) -> bool:
    """Return whether |omega| < 15 deg/s; exactly 15 deg/s is outside, float rounding or not."""
    return abs(angular_velocity) < DEAD_BAND * (1.0 - _ANGULAR_TOLERANCE)


def clip_command(
    v_u: float, omega_u: float, v_c: float, omega_c: float, period_s: float = MOTOR_PERIOD_S
) -> tuple[float, float]:
    """Return the velocities the motor controller commands: the desired ones, within the acceleration limits.

    Args:
        v_u: desired linear velocity, m/s.
        omega_u: desired angular velocity, rad/s.
        v_c: current linear velocity, m/s.
        omega_c: current angular velocity, rad/s.
        period_s: control period of the motor controller.

    Example:
        >>> clip_command(0.6, 0.0, 0.0, 0.0)
        (0.03, 0.0)
    """
    dv, domega = MAX_LINEAR_ACCELERATION * period_s, MAX_ANGULAR_ACCELERATION * period_s
    # Comparisons cost a third of min and max, and this runs in every motor step.
    v = v_c + dv if v_u > v_c + dv else v_c - dv if v_u < v_c - dv else v_u
    omega = (
        omega_c + domega if omega_u > omega_c + domega else omega_c - domega if omega_u < omega_c - domega else omega_u
    )
    return v, omega
