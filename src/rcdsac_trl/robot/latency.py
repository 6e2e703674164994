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
from rcdsac_trl.robot.sectors import is_finite_number

MOST_LATENCY_S = 0.5
"""Farther ahead neither people nor the way into a stop zone can be told."""

# Times nearer to each other than this are one: they are sums of floats.
_SAME_S = 1e-6


def check_latency(latency_s: object, memory_s: float) -> None:
    """Refuse a latency that nobody can allow for.

    Args:
        latency_s: from a measurement until the command that follows it acts, s.
        memory_s: for how long the agent remembers points, s.

    Raises:
        UserInputError: if it is no number, negative, or longer than :data:`MOST_LATENCY_S`, or the agent remembers
            nothing: only what is remembered can be told as it will be.
    """
    if not is_finite_number(latency_s) or not 0.0 <= float(latency_s) <= MOST_LATENCY_S:  # type: ignore[arg-type]
        raise UserInputError(f"latency_s={latency_s!r} must be a number from 0 to {MOST_LATENCY_S:g} seconds")
    if latency_s and not memory_s:
        raise UserInputError(
            f"latency_s={latency_s} is allowed for by what an agent remembers, and this one remembers nothing "
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


def at_once(velocities: tuple[float, float]) -> Ahead:
    """Return where a robot will be whose next command acts at once: where it is, as fast as it is, m/s and rad/s."""
    return Ahead((0.0, 0.0, 0.0), velocities, 0.0)


class Latency:
    """The commands of one robot that are under way, and where they lead.

    Args:
        latency_s: from a measurement until the command that follows it acts, s.
        robot: whose limits of acceleration count.

    Example:
        >>> latency = Latency(0.2)
        >>> latency.note((0.0, 0.0), at_s=1.0)
        >>> ahead = latency.ahead((0.5, 0.0), at_s=1.2)  # it brakes at 1.5 m/s^2
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
        """Forget the commands: whatever they were, the robot goes on as it moves until the next one acts."""
        # When each begins to act, s, and its velocities.
        self._commands: deque[tuple[float, float, float]] = deque()

    def note(self, command: tuple[float, float], at_s: float) -> None:
        """Take down a command.

        Args:
            command: m/s and rad/s.
            at_s: time of the measurement that it follows, s. Commands of that time or later are forgotten: it stands
                for them, or the clock was set back.
        """
        due_s = at_s + self._latency_s
        while self._commands and self._commands[-1][0] >= due_s - _SAME_S:
            self._commands.pop()
        self._commands.append((due_s, *command))

    def ahead(self, measured: tuple[float, float], at_s: float) -> Ahead:
        """Return where the robot will be when the command that follows a measurement begins to act.

        Args:
            measured: velocities, m/s and rad/s.
            at_s: time of the measurement, s.
        """
        if not self._commands or self._commands[0][0] > at_s + _SAME_S:
            self._commands.appendleft((-math.inf, *measured))
        while len(self._commands) > 1 and self._commands[1][0] <= at_s + _SAME_S:
            self._commands.popleft()
        under_way = list(self._commands)
        x = y = yaw = 0.0
        v, omega = measured
        for step in range(self._steps):
            while len(under_way) > 1 and under_way[1][0] <= at_s + step * self._period_s + _SAME_S:
                under_way.pop(0)
            _, wanted_v, wanted_omega = under_way[0]
            v, omega = clip_command(wanted_v, wanted_omega, v, omega, self._period_s, self._robot)
            yaw += omega * self._period_s
            x += v * self._period_s * math.cos(yaw)
            y += v * self._period_s * math.sin(yaw)
        return Ahead((x, y, yaw), (v, omega), self._latency_s)
