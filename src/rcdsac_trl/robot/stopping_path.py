"""The way a robot still goes: it does what it is told for one more reaction time, and then brakes until it stands."""

import math
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from rcdsac_trl.robot.robot_settings import RobotSettings

STEP_S = 0.05
"""Time from one place on the way to the next, s: 3 cm at the full speed of the paper's robot."""
STANDS_M_PER_S = 1e-9
"""Below, the robot stands."""


def stopping_paths(
    speeds: Sequence[float], omega: float, moving: tuple[float, float], reacting: int, robot: RobotSettings
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return the places that the robot's centre comes by until it stands, itself first, for each wanted speed.

    A robot that is not round has corners that swing: its way ends when it turns no more, either.

    Args:
        speeds: wanted linear velocities, m/s.
        omega: wanted angular velocity, rad/s.
        moving: measured velocities, m/s and rad/s.
        reacting: how many steps of :data:`STEP_S` a command lasts.
        robot: whose acceleration limits count.

    Returns:
        Places [speeds, n, 2], m; who stands before the others do stays where it is. And cosine and sine of the heading
        there, [n, 2], which does not depend on the speed.

    Example:
        >>> from rcdsac_trl.robot.robot_settings import PAPER
        >>> places, _ = stopping_paths([0.0, 0.6], 0.0, (0.6, 0.0), reacting=5, robot=PAPER)
        >>> places[:, -1].round(4).tolist()  # braking at 1.5 m/s^2 takes 0.4 s; 0.25 s more at full speed
        [[0.105, 0.0], [0.255, 0.0]]
    """
    braking, turning = robot.max_acceleration_m_per_s2, robot.max_angular_acceleration
    driven = [_until_it_stands(speed, moving[0], reacting, braking) for speed in speeds]
    turned = _until_it_stands(omega, moving[1], reacting, turning)
    steps = max(len(of_speed) for of_speed in (driven if robot.is_round else [*driven, turned]))
    covered_m = np.array([of_speed + [0.0] * (steps - len(of_speed)) for of_speed in driven]) * STEP_S
    places = np.zeros((len(speeds), steps + 1, 2))
    on_the_way, headings = _directions((turned + [0.0] * steps)[:steps])
    np.cumsum(covered_m[:, :, None] * on_the_way, axis=1, out=places[:, 1:])
    return places, headings


def _until_it_stands(v: float, now: float, reacting: int, acceleration: float) -> list[float]:
    """Return the velocity in each step, linear or angular: `v` is wanted in the first ones, to stand from then on."""
    speeds: list[float] = []
    while len(speeds) < reacting or abs(now) > STANDS_M_PER_S:
        now = _nearer(v if len(speeds) < reacting else 0.0, now, acceleration * STEP_S)
        speeds.append(now)
    return speeds


def _directions(turned: Sequence[float]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return directions as cosine and sine: the mean one in each step, [steps, 2], and at its ends, [steps + 1, 2].

    Args:
        turned: angular velocity in each step, rad/s.
    """
    yaw, directions, headings = 0.0, [], [(1.0, 0.0)]
    for omega in turned:
        half = omega * STEP_S / 2.0
        directions.append((math.cos(yaw + half), math.sin(yaw + half)))
        yaw += 2.0 * half
        headings.append((math.cos(yaw), math.sin(yaw)))
    return np.array(directions), np.array(headings)


def _nearer(wanted: float, now: float, change: float) -> float:
    """Return the velocity after a step, as ``robot.action.clip_command`` has it, of one of the two alone."""
    return now + change if wanted > now + change else now - change if wanted < now - change else wanted
