"""How near a robot would come to what it knows of, were it to drive this way or that; part of what agents remember.

A few centimetres beside the way decide whether a corner is clipped, and networks read them badly off ranges in sectors.
A planner computes them (Fox, Burgard and Thrun 1997), and an agent may as well be told (DWA-RL, Patel et al. 2021, does
so): for a fan of commands, the smallest distance within the next 1.4 s, by the robot's own motion model.
"""

import math

import numpy as np
from numpy.typing import NDArray

from rcdsac_trl.robot.limits import (
    MAX_ANGULAR_ACCELERATION,
    MAX_ANGULAR_VELOCITY,
    MAX_LINEAR_ACCELERATION,
    MAX_LINEAR_VELOCITY,
    MIN_LINEAR_VELOCITY,
)
from rcdsac_trl.system.jit import njit

_ROWS = (
    (MAX_LINEAR_VELOCITY, np.arange(-4, 5) / 4.0),
    (MAX_LINEAR_VELOCITY / 2.0, np.arange(-3, 4) / 3.0),
    (MIN_LINEAR_VELOCITY, np.arange(-1, 2) / 2.0),
)
COMMANDS: NDArray[np.float64] = np.array([(v, MAX_ANGULAR_VELOCITY * share) for v, row in _ROWS for share in row])
"""The commands, float64 [19, 2], in m/s and rad/s: full speed, half of it and back, each from right to left."""

MIRRORED_COMMANDS: NDArray[np.intp] = np.array(
    [int(np.flatnonzero((command * (1.0, -1.0) == COMMANDS).all(axis=1))[0]) for command in COMMANDS]
)
"""Which command each one is in the mirrored world, intp [19]."""

_STEPS = 10
_PERIOD_S = 0.14
# What is farther from the way than the first is not near; distances count from the second, which is inside the robot.
_FAR_M = 1.0
_INNER_RADIUS_M = 0.2
_LEAST_GAP_M = 0.02
# No command leads farther than this from where the robot is.
_REACH_M = MAX_LINEAR_VELOCITY * _PERIOD_S * _STEPS


def foreseen_nearness(
    points: NDArray[np.float64],
    moving: NDArray[np.float64],
    pose: NDArray[np.float64],
    v: float,
    omega: float,
) -> NDArray[np.float32]:
    """Return how near each of :data:`COMMANDS` would lead to anything within 1.4 s, if it were held.

    Args:
        points: what stands, float64 [n, >= 2], x and y in m.
        moving: what moves, float64 [k, >= 5], x and y in m, their velocities in m/s, the radius in m; each keeps its
            velocity.
        pose: the robot's x and y in m and yaw in rad, in the points' frame.
        v: its linear velocity now, m/s.
        omega: its angular velocity now, rad/s.

    Returns:
        float32 [19]: log10(0.8 m / (distance - 0.2 m)) of the smallest distance from the robot's middle, 0 from 1 m on.

    Example:
        >>> ahead = np.array([[0.84 + 0.28, 0.0]])  # full speed ahead stops 0.28 m before it
        >>> told = foreseen_nearness(ahead, np.empty((0, 6)), np.zeros(3), v=0.6, omega=0.0)
        >>> round(float(told[4]), 3), float(told[-2])
        (1.0, 0.0)
    """
    told = np.zeros(len(COMMANDS), np.float32)
    _foresee(told, COMMANDS, points, moving, pose, v, omega)
    return told


@njit
def _foresee(
    told: np.ndarray,
    commands: np.ndarray,
    points: np.ndarray,
    moving: np.ndarray,
    pose: np.ndarray,
    v: float,
    omega: float,
) -> None:
    """Write what :func:`foreseen_nearness` returns."""
    near = np.empty((len(points), 2))
    number = 0
    for row in range(len(points)):
        dx, dy = points[row, 0] - pose[0], points[row, 1] - pose[1]
        if dx * dx + dy * dy < (_REACH_M + _FAR_M) ** 2:
            near[number, 0], near[number, 1] = dx, dy
            number += 1
    for command in range(len(commands)):
        x = y = 0.0
        yaw, speed, turning = pose[2], v, omega
        least_m2, least_m = _FAR_M * _FAR_M, _FAR_M
        for step in range(1, _STEPS + 1):
            before_v, before_omega = speed, turning
            speed = _towards(speed, commands[command, 0], MAX_LINEAR_ACCELERATION * _PERIOD_S)
            turning = _towards(turning, commands[command, 1], MAX_ANGULAR_ACCELERATION * _PERIOD_S)
            half_turn = 0.25 * (before_omega + turning) * _PERIOD_S
            moved_m = 0.5 * (before_v + speed) * _PERIOD_S
            x += moved_m * math.cos(yaw + half_turn)
            y += moved_m * math.sin(yaw + half_turn)
            yaw += 2.0 * half_turn
            for row in range(number):
                dx, dy = near[row, 0] - x, near[row, 1] - y
                least_m2 = min(least_m2, dx * dx + dy * dy)
            for mover in moving:
                time_s = step * _PERIOD_S
                dx, dy = mover[0] + time_s * mover[2] - pose[0] - x, mover[1] + time_s * mover[3] - pose[1] - y
                least_m = min(least_m, math.hypot(dx, dy) - mover[4])
        least_m = min(least_m, math.sqrt(least_m2))
        gap_m = max(least_m - _INNER_RADIUS_M, _LEAST_GAP_M)
        told[command] = math.log10((_FAR_M - _INNER_RADIUS_M) / gap_m)


@njit
def _towards(value: float, target: float, by: float) -> float:
    """Return the value after a change towards the target by at most so much."""
    return min(max(target, value - by), value + by)
