"""Motors that follow a command for one control period, for tests that close the loop around a guard."""

import math
from collections import deque

from rcdsac_trl.robot.action import clip_command
from rcdsac_trl.robot.robot_settings import PAPER, RobotSettings

Pose = tuple[float, float, float]
Moving = tuple[float, float]


def driven(command: Moving, pose: Pose, moving: Moving, robot: RobotSettings = PAPER) -> tuple[list[Pose], Moving]:
    """Return the poses after each of the seven motor steps of 0.02 s in a control period, and the last velocities."""
    return LateMotors(0.0, robot).driven(command, pose, moving)


class LateMotors:
    """Motors to which a command comes late; until the first one has come the robot stands.

    Args:
        latency_s: by so much, a multiple of a motor step.
        robot: whose they are.
    """

    def __init__(self, latency_s: float, robot: RobotSettings = PAPER) -> None:
        self._robot = robot
        self._under_way: deque[Moving] = deque([(0.0, 0.0)] * round(latency_s / 0.02))

    def driven(self, command: Moving, pose: Pose, moving: Moving) -> tuple[list[Pose], Moving]:
        """Return the same as :func:`driven`."""
        (x, y, yaw), (v, omega), poses = pose, moving, []
        for _ in range(7):
            self._under_way.append(command)
            v, omega = clip_command(*self._under_way.popleft(), v, omega, 0.02, self._robot)
            yaw += omega * 0.02
            x, y = x + v * 0.02 * math.cos(yaw), y + v * 0.02 * math.sin(yaw)
            poses.append((x, y, yaw))
        return poses, (v, omega)
