"""What a robot will meet when the command that it is about to get begins to act.

A command acts late: messages, the base's own controller, motors. Until then the robot drives on by the commands before
it, which are known. So an agent can be told what it will meet by then, as a Smith predictor tells a controller (Smith
1957). It needs to know of no latency, as in training.
"""

import math
from collections import deque
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from rcdsac_trl.errors import UserInputError
from rcdsac_trl.robot.action import clip_command
from rcdsac_trl.robot.planar import placed, seen_from
from rcdsac_trl.robot.robot_settings import PAPER, RobotSettings

MOST_LATENCY_S = 1.0
"""Farther ahead nobody knows what people do."""

# Times nearer to each other than this are one: they are sums of floats.
_SAME_S = 1e-6


def check_latency(latency_s: float, memory_s: float) -> None:
    """Refuse a latency that nobody can allow for.

    Args:
        latency_s: from a measurement until the command that follows it acts, s.
        memory_s: for how long the agent remembers points, s.

    Raises:
        UserInputError: if it is negative, or longer than :data:`MOST_LATENCY_S`, or the agent remembers nothing: only
            what is remembered can be told as it will be.
    """
    if not 0.0 <= latency_s <= MOST_LATENCY_S:
        raise UserInputError(f"latency_s={latency_s} must be from 0 to {MOST_LATENCY_S:g} seconds")
    if latency_s and not memory_s:
        raise UserInputError(
            f"latency_s={latency_s:g} is allowed for by what an agent remembers, and this one remembers nothing "
            "(sensor.memory_s=0): leave it out, or take an agent that does"
        )


class Ahead(NamedTuple):
    """Where a robot will be when its next command begins to act.

    Attributes:
        pose: x, y in m and yaw in rad, in the frame of where it is now.
        velocities: by then, m/s and rad/s.
        latency_s: from now until then, s.
    """

    pose: tuple[float, float, float]
    velocities: tuple[float, float]
    latency_s: float

    def seen(self, points: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return points of the robot's frame now, [n, 2] in m, in its frame then."""
        return seen_from(points, self.pose)

    def after(self, pose: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return where it will be in the frame in which it is at a pose now, [3], m and rad."""
        x, y, yaw = self.pose
        return np.append(placed(np.array([[x, y]]), pose)[0], pose[2] + yaw)


class Latency:
    """The commands of one robot that are under way, and where they lead.

    Args:
        latency_s: from a measurement until the command that follows it acts, s.
        robot: whose limits of acceleration count.

    Example:
        >>> latency = Latency(0.2)  # at 0.5 m/s, told to stand: by then it brakes at 1.5 m/s^2
        >>> ahead = latency.ahead(measured=(0.5, 0.0), commanded=(0.0, 0.0), elapsed_s=0.0)
        >>> [round(each, 3) for each in (*ahead.pose, *ahead.velocities)]
        [0.067, 0.0, 0.0, 0.2, 0.0]
    """

    def __init__(self, latency_s: float, robot: RobotSettings = PAPER) -> None:
        self._latency_s = latency_s
        self._robot = robot
        # A whole number of periods of about the motor's.
        self._steps = math.ceil(latency_s / robot.motor_period_s - _SAME_S)
        self._period_s = latency_s / max(self._steps, 1)
        self.reset()

    def reset(self) -> None:
        """Forget the commands; the robot stands."""
        # When each begins to act, s from now, and its velocities; the first acts already.
        self._commands: deque[tuple[float, float, float]] = deque([(-math.inf, 0.0, 0.0)])

    def ahead(self, measured: tuple[float, float], commanded: tuple[float, float], elapsed_s: float) -> Ahead:
        """Take in the last command, and return where the robot will be when the next one begins to act.

        Args:
            measured: velocities now, m/s and rad/s.
            commanded: what the robot was told at the measurement before, m/s and rad/s.
            elapsed_s: since then, s.
        """
        self._take(commanded, elapsed_s)
        commands = list(self._commands)
        x = y = yaw = 0.0
        v, omega = measured
        for step in range(self._steps):
            while len(commands) > 1 and commands[1][0] <= step * self._period_s + _SAME_S:
                commands.pop(0)
            _, wanted_v, wanted_omega = commands[0]
            v, omega = clip_command(wanted_v, wanted_omega, v, omega, self._period_s, self._robot)
            yaw += omega * self._period_s
            x += v * self._period_s * math.cos(yaw)
            y += v * self._period_s * math.sin(yaw)
        return Ahead((x, y, yaw), (v, omega), self._latency_s)

    def _take(self, commanded: tuple[float, float], elapsed_s: float) -> None:
        """Let time pass, note a command, and drop those that no longer act."""
        self._commands = deque((due_s - elapsed_s, v, omega) for due_s, v, omega in self._commands)
        self._commands.append((self._latency_s - elapsed_s, *commanded))
        while len(self._commands) > 1 and self._commands[1][0] <= _SAME_S:
            self._commands.popleft()
