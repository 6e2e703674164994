"""How near a robot would come to what it knows of, were it to drive this way or that; part of what agents remember.

A few centimetres beside the way decide whether a corner is clipped, and networks read them badly off ranges in sectors.
A planner computes them (Fox, Burgard and Thrun 1997), and an agent may as well be told (DWA-RL, Patel et al. 2021, does
so): for a fan of commands, the smallest distance within two horizons, by the robot's own motion model. The near one
tells what is about to be touched: a robot stops within 0.4 s. The far one tells which way to pass where there is room;
in narrow places no command can be held so long.
"""

import math

import numpy as np
from numpy.typing import NDArray

from rcdsac_trl.robot.action import desired_velocities
from rcdsac_trl.robot.limits import MEAN_PERIOD_S
from rcdsac_trl.robot.look_ahead import FORESEEN_ACTIONS, FORESEEN_SPAN_M
from rcdsac_trl.robot.robot_settings import PAPER, RobotSettings
from rcdsac_trl.system.jit import njit

_ACTIONS = np.array([(speed, turn) for speed, turns in FORESEEN_ACTIONS for turn in turns])

MIRRORED_COMMANDS: NDArray[np.intp] = np.array(
    [int(np.flatnonzero((action * (1.0, -1.0) == _ACTIONS).all(axis=1))[0]) for action in _ACTIONS]
)
"""Which command each one is in the mirrored world, intp [22]."""

# Steps of the horizons: 0.42 and 1.4 s.
_SOON, _LATER = 3, 10


class ForeseenClearance:
    """How near each of 22 commands would lead a robot, within 0.42 s and within 1.4 s.

    Args:
        robot: its limits, and from where distances count.

    Attributes:
        commands: float64 [22, 2], in m/s and rad/s, those of :data:`~rcdsac_trl.robot.look_ahead.FORESEEN_ACTIONS`.

    Example:
        >>> clearance = ForeseenClearance()
        >>> clearance.commands[[0, 4, 12, 20]].round(2).tolist()
        [[0.6, -1.57], [0.6, 0.0], [0.3, 0.0], [-0.2, 0.0]]
        >>> ahead = np.array([[0.84 + 0.28, 0.0]])  # full speed ahead ends 0.28 m before it
        >>> told = clearance.nearness(ahead, np.empty((0, 6)), np.zeros(3), v=0.6, omega=0.0)
        >>> [round(float(each), 2) for each in told[[4, 22 + 4]]]  # within 0.42 s it comes no nearer than 0.87 m
        [0.08, 1.0]
    """

    def __init__(self, robot: RobotSettings = PAPER) -> None:
        self.commands: NDArray[np.float64] = np.array([desired_velocities(action, robot) for action in _ACTIONS])
        self._changes = robot.max_acceleration_m_per_s2 * MEAN_PERIOD_S, robot.max_angular_acceleration * MEAN_PERIOD_S
        self._inner_radius_m = robot.body_radius_m
        # No command leads farther than this from where the robot is.
        self._reach_m = robot.fastest_m_per_s * MEAN_PERIOD_S * _LATER

    def nearness(
        self,
        points: NDArray[np.float64],
        moving: NDArray[np.float64],
        pose: NDArray[np.float64],
        v: float,
        omega: float,
    ) -> NDArray[np.float32]:
        """Return how near each command would lead to anything, if it were held.

        Args:
            points: what stands, float64 [n, >= 2], x and y in m.
            moving: what moves, float64 [k, >= 5], x and y in m, their velocities in m/s, the radius in m; each keeps
                its velocity.
            pose: the robot's x and y in m and yaw in rad, in the points' frame.
            v: its linear velocity now, m/s.
            omega: its angular velocity now, rad/s.

        Returns:
            float32 [44], the 22 within 0.42 s and the 22 within 1.4 s: log10(0.8 m / (distance - r)) of the smallest
            distance from the robot's centre, with r its inside, 0.2 m of the paper's robot; 0 where the distance is
            0.8 m more than that.
        """
        told = np.zeros(2 * len(self.commands), np.float32)
        radii_m = self._inner_radius_m, self._reach_m
        _foresee(told, self.commands, self._changes, radii_m, FORESEEN_SPAN_M, points, moving, pose, v, omega)
        return told


# ------------------------------------------------------------------------------------------------ compiled
# All that the compiled code uses stands in this file: Numba's cache notices no change of another one.
@njit
def _foresee(
    told: np.ndarray,
    commands: np.ndarray,
    changes: tuple[float, float],
    radii_m: tuple[float, float],
    span_m: tuple[float, float],
    points: np.ndarray,
    moving: np.ndarray,
    pose: np.ndarray,
    v: float,
    omega: float,
) -> None:
    """Write what :meth:`ForeseenClearance.nearness` returns."""
    inner_radius_m, reach_m = radii_m
    least_gap_m, far_gap_m = span_m
    far_m = inner_radius_m + far_gap_m
    near = np.empty((len(points), 2))
    number = 0
    for row in range(len(points)):
        dx, dy = points[row, 0] - pose[0], points[row, 1] - pose[1]
        if dx * dx + dy * dy < (reach_m + far_m) ** 2:
            near[number, 0], near[number, 1] = dx, dy
            number += 1
    for command in range(len(commands)):
        x = y = 0.0
        yaw, speed, turning = pose[2], v, omega
        least_m2, least_m = far_m * far_m, far_m
        for step in range(1, _LATER + 1):
            before_v, before_omega = speed, turning
            speed = _towards(speed, commands[command, 0], changes[0])
            turning = _towards(turning, commands[command, 1], changes[1])
            half_turn = 0.25 * (before_omega + turning) * MEAN_PERIOD_S
            moved_m = 0.5 * (before_v + speed) * MEAN_PERIOD_S
            x += moved_m * math.cos(yaw + half_turn)
            y += moved_m * math.sin(yaw + half_turn)
            yaw += 2.0 * half_turn
            for row in range(number):
                dx, dy = near[row, 0] - x, near[row, 1] - y
                least_m2 = min(least_m2, dx * dx + dy * dy)
            for mover in moving:
                time_s = step * MEAN_PERIOD_S
                dx, dy = mover[0] + time_s * mover[2] - pose[0] - x, mover[1] + time_s * mover[3] - pose[1] - y
                least_m = min(least_m, math.hypot(dx, dy) - mover[4])
            if step in (_SOON, _LATER):
                gap_m = min(least_m, math.sqrt(least_m2)) - inner_radius_m
                told[command + len(commands) * (step // _LATER)] = math.log10(far_gap_m / max(gap_m, least_gap_m))


@njit
def _towards(value: float, target: float, by: float) -> float:
    """Return the value after a change towards the target by at most so much."""
    return min(max(target, value - by), value + by)
