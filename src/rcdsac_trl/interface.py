"""What passes between an agent and its robot: range bins, waypoints and velocities in, desired velocities out.

Pure functions and the constants of the paper's sections "States and Observations" and "Actions". The simulated world
and the policy on a robot read the same ones, so that what an agent sees there is what it was trained on.
"""

import math
from collections.abc import Sequence
from typing import Literal, get_args

import numpy as np
from numpy.typing import ArrayLike, NDArray

from rcdsac_trl.errors import UserInputError

# The range sensor (paper, section "States and Observations").
NUM_BINS = 180
"""Number of sectors; bin i (counted from 1) covers [2i-2, 2i) degrees counter-clockwise from the x axis."""

MAX_RANGE_M = 3.0
"""What is this far away or farther is not sensed."""

Sensor = Literal["narrow", "sparse", "full"]
"""Which bins the sensor has; see :func:`sensor_mask`."""

SENSORS: frozenset[str] = frozenset(get_args(Sensor))

# Actions (paper, section "Actions").
MIN_LINEAR_VELOCITY = -0.2
"""w_minv, m/s."""
MAX_LINEAR_VELOCITY = 0.6
"""w_maxv, m/s."""
MAX_ANGULAR_VELOCITY = math.radians(90.0)
"""w_maxomega, rad/s."""
DEAD_BAND = math.radians(15.0)
"""Desired angular velocities below this are taken as 0, rad/s."""
MAX_LINEAR_ACCELERATION = 1.5
"""w_accv, m/s^2."""
MAX_ANGULAR_ACCELERATION = math.radians(120.0)
"""w_accomega, rad/s^2."""
MOTOR_PERIOD_S = 0.02
"""Control period of the motor controller, Delta t."""

# Observations (paper, section "States and Observations").
MIN_RANGE_M = 0.01
"""Ranges are seen strictly between this and :data:`MAX_RANGE_M`."""
RANGE_OFFSET = 2.5
"""What is added to log10 of the distance, so that 0 can mean "nothing there"."""
MAX_RANGE_OBSERVATION = RANGE_OFFSET + math.log10(MAX_RANGE_M)
"""Upper limit of a range observation."""
WAYPOINT_DISTANCE_LIMITS_M = (0.01, 100.0)

# A bound given in degrees must hold for a float that went through radians: 15 deg/s itself is kept.
_ANGULAR_TOLERANCE = 1e-6

Point = tuple[float, float]
"""x and y in the map frame, m."""


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
    number = np.arange(1, NUM_BINS + 1)
    if name == "narrow":
        return (number < 22) | (number > 158)
    if name == "sparse":
        return number % 10 == 0
    return np.ones(NUM_BINS, dtype=np.bool_)


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


def range_observation(distances: ArrayLike, mask: ArrayLike) -> NDArray[np.float32]:
    """Return o_rng: 2.5 + log10 of the distance, 0 where nothing is within (0.01, 3) m or the mask is false.

    Args:
        distances: [..., 180], m; ``inf`` where nothing is.
        mask: bool [180], the bins the sensor has; see :func:`sensor_mask`.

    Returns:
        float32 [..., 180].

    Example:
        >>> range_observation([1.0, 0.1, 3.0], [True, True, True]).tolist()
        [2.5, 1.5, 0.0]
    """
    d = np.asarray(distances, dtype=np.float64)
    observed = np.zeros(d.shape, dtype=np.float32)
    seen = (d > MIN_RANGE_M) & (d < MAX_RANGE_M) & np.asarray(mask, dtype=np.bool_)
    # Of the logarithms, the expensive part, only those that are seen.
    observed[seen] = RANGE_OFFSET + np.log10(d[seen])
    return observed


def range_distances(observed: ArrayLike) -> NDArray[np.float64]:
    """Return the distances of range observations, m; ``inf`` where nothing was seen. Undoes :func:`range_observation`.

    Args:
        observed: o_rng, [..., 180].

    Example:
        >>> range_distances([2.5, 1.5, 0.0]).tolist()
        [1.0, 0.1, inf]
    """
    o = np.asarray(observed, dtype=np.float64)
    return np.where(o > 0.0, 10.0 ** (o - RANGE_OFFSET), np.inf)


def waypoint_observation(pose: tuple[float, float, float], waypoint_1: Point, waypoint_2: Point) -> tuple[float, ...]:
    """Return o_waypoint: log10 of the distance, cosine and sine of the bearing, of the next two waypoints.

    Args:
        pose: the robot's x, y in m and yaw in rad, map frame.
        waypoint_1: the next waypoint, map frame, m.
        waypoint_2: the one after it; on the last leg both are the goal.

    Returns:
        Six numbers; distances are clipped to [0.01, 100] m before the logarithm.

    Example:
        >>> observed = waypoint_observation((0.0, 0.0, 0.0), (10.0, 0.0), (0.0, 100.0))
        >>> [round(value, 6) for value in observed]
        [1.0, 1.0, 0.0, 2.0, 0.0, 1.0]
    """
    low, high = WAYPOINT_DISTANCE_LIMITS_M
    distance_1, bearing_1 = distance_and_bearing(pose, waypoint_1)
    distance_2, bearing_2 = distance_and_bearing(pose, waypoint_2)
    return (
        math.log10(min(max(distance_1, low), high)),
        math.cos(bearing_1),
        math.sin(bearing_1),
        math.log10(min(max(distance_2, low), high)),
        math.cos(bearing_2),
        math.sin(bearing_2),
    )


def distance_and_bearing(pose: tuple[float, float, float], point: Point) -> tuple[float, float]:
    """Return the distance to a point in m and its angle from the robot's x axis in rad, any full turns apart.

    Args:
        pose: the robot's x, y in m and yaw in rad, map frame.
        point: map frame, m.
    """
    x, y, yaw = pose
    dx, dy = point[0] - x, point[1] - y
    return math.hypot(dx, dy), math.atan2(dy, dx) - yaw
