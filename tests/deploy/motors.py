"""Motors that follow a command for one control period, for tests that close the loop around a guard."""

import math

from rcdsac_trl.robot.action import clip_command
from rcdsac_trl.robot.robot_settings import PAPER, RobotSettings

Pose = tuple[float, float, float]
Moving = tuple[float, float]


def driven(command: Moving, pose: Pose, moving: Moving, robot: RobotSettings = PAPER) -> tuple[list[Pose], Moving]:
    """Return the poses after each of the seven motor steps of 0.02 s in a control period, and the last velocities."""
    (x, y, yaw), (v, omega), poses = pose, moving, []
    for _ in range(7):
        v, omega = clip_command(*command, v, omega, 0.02, robot)
        yaw += omega * 0.02
        x, y = x + v * 0.02 * math.cos(yaw), y + v * 0.02 * math.sin(yaw)
        poses.append((x, y, yaw))
    return poses, (v, omega)
