"""What an action means: desired velocities, and what the motor controller makes of them.

Pure functions; the simulated world and the policy on a robot call the same ones.
"""

from collections.abc import Sequence

from numpy.typing import NDArray

from rcdsac_trl.robot.robot_settings import PAPER, RobotSettings

LOG_STD_RANGE = (-20.0, 2.0)
"""Bounds of the log standard deviation of an action before tanh."""

# A bound given in degrees must hold for a float that went through radians: 15 deg/s itself is kept.
_ANGULAR_TOLERANCE = 1e-6


def desired_velocities(action: Sequence[float] | NDArray, robot: RobotSettings = PAPER) -> tuple[float, float]:
    """Return the desired velocities (v_u, omega_u) of an action, m/s and rad/s.

    The linear velocity runs over the robot's range with u_0 (the paper's: -0.2 to 0.6 m/s); the angular one is the
    robot's largest (90 deg/s) times u_1, and 0 inside of its dead band (15 deg/s).

    Args:
        action: u, [2], in [-1, 1]; what is outside is clipped.
        robot: whose limits count.

    Example:
        >>> desired_velocities([1.0, 0.1])
        (0.6, 0.0)
    """
    u0, u1 = float(action[0]), float(action[1])
    u0 = 1.0 if u0 > 1.0 else -1.0 if u0 < -1.0 else u0
    u1 = 1.0 if u1 > 1.0 else -1.0 if u1 < -1.0 else u1
    linear = robot.min_linear_velocity * (1.0 - u0) / 2.0 + robot.max_speed_m_per_s * (1.0 + u0) / 2.0
    angular = robot.max_angular_velocity * u1
    return linear, 0.0 if inside_dead_band(angular, robot) else angular


def action_of(linear: float, angular: float, robot: RobotSettings = PAPER) -> tuple[float, float]:
    """Return the action u of desired velocities. Undoes :func:`desired_velocities`.

    Args:
        linear: m/s; what is beyond the robot's range is clipped.
        angular: rad/s; likewise.
        robot: whose limits count.

    Example:
        >>> action_of(0.6, 0.0)
        (1.0, 0.0)
    """
    low, high, fastest_turn = robot.min_linear_velocity, robot.max_speed_m_per_s, robot.max_angular_velocity
    v = min(max(linear, low), high)
    omega = min(max(angular, -fastest_turn), fastest_turn)
    return 2.0 * (v - low) / (high - low) - 1.0, omega / fastest_turn


def inside_dead_band(angular_velocity: float, robot: RobotSettings = PAPER) -> bool:
    """Return whether |omega| is inside of the robot's dead band; its border is outside, float rounding or not."""
    return abs(angular_velocity) < robot.dead_band * (1.0 - _ANGULAR_TOLERANCE)


def clip_command(
    v_u: float,
    omega_u: float,
    v_c: float,
    omega_c: float,
    period_s: float | None = None,
    robot: RobotSettings = PAPER,
) -> tuple[float, float]:
    """Return the velocities the motor controller commands: the desired ones, within the acceleration limits.

    Args:
        v_u: desired linear velocity, m/s.
        omega_u: desired angular velocity, rad/s.
        v_c: current linear velocity, m/s.
        omega_c: current angular velocity, rad/s.
        period_s: control period of the motor controller; None: the robot's.
        robot: whose limits count.

    Example:
        >>> clip_command(0.6, 0.0, 0.0, 0.0)
        (0.03, 0.0)
    """
    period_s = robot.motor_period_s if period_s is None else period_s
    dv, domega = robot.max_acceleration_m_per_s2 * period_s, robot.max_angular_acceleration * period_s
    # Comparisons cost a third of min and max, and this runs in every motor step.
    v = v_c + dv if v_u > v_c + dv else v_c - dv if v_u < v_c - dv else v_u
    omega = (
        omega_c + domega if omega_u > omega_c + domega else omega_c - domega if omega_u < omega_c - domega else omega_u
    )
    return v, omega
