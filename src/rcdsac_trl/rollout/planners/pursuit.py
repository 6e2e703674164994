"""Pursuit: the controller that drives straight to the next waypoint and looks at nothing else.

It is the baseline that shows how much of a map can be done blindly: it follows the planner, which does not
know the unmapped clutter and the movers, and never looks at the range sensor.
"""

import math

import torch

from rcdsac_trl.robot.action import action_of
from rcdsac_trl.robot.robot_settings import PAPER, RobotSettings

# Turning rate per bearing error, 1/s. The paper's robot, where it turns at full rate, needs 34 degrees to stop turning,
# and this gain asks for less than the full rate from 60 degrees on, so the heading does not overshoot.
TURN_GAIN_PER_S = 1.5
# Above this bearing error the robot turns on the spot.
ALIGNED_RAD = math.radians(30.0)


def pursuit_action(waypoint: torch.Tensor, robot: RobotSettings = PAPER) -> torch.Tensor:
    """Turn towards the next waypoint, and drive at full speed once it is roughly ahead.

    Args:
        waypoint: waypoint observations, shape [..., 6], as the environment writes them.
        robot: that is driven.

    Returns:
        Actions, shape [..., 2], in [-1, 1].

    Example:
        >>> ahead = torch.tensor([0.0, 1.0, 0.0, 0.0, 1.0, 0.0])
        >>> pursuit_action(ahead)
        tensor([1., 0.])
    """
    bearing = torch.atan2(waypoint[..., 2], waypoint[..., 1])
    turn = (bearing * (TURN_GAIN_PER_S / robot.max_angular_velocity)).clamp(-1.0, 1.0)
    stand_still, _ = action_of(0.0, 0.0, robot)
    drive = torch.where(bearing.abs() < ALIGNED_RAD, 1.0, stand_still).to(waypoint.dtype)
    return torch.stack((drive, turn), dim=-1)
