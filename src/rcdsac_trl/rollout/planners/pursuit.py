"""Pursuit: the controller that drives straight to the next waypoint and looks at nothing else.

It is the baseline that shows how much of a map can be done blindly: it follows the planner, which does not
know the unmapped clutter and the movers, and never looks at the range sensor.
"""

import math

import torch

from rcdsac_trl.robot.limits import MAX_ANGULAR_VELOCITY, MAX_LINEAR_VELOCITY, MIN_LINEAR_VELOCITY

# Turning rate per bearing error, 1/s. A robot that turns at full rate needs 34 degrees to stop turning, and
# this gain asks for less than the full rate from 60 degrees on, so the heading does not overshoot.
TURN_GAIN_PER_S = 1.5
# Above this bearing error the robot turns on the spot.
ALIGNED_RAD = math.radians(30.0)

# The normalised speed action that stands still, from v_u = v_min (1 - u) / 2 + v_max (1 + u) / 2.
STAND_STILL = -(MAX_LINEAR_VELOCITY + MIN_LINEAR_VELOCITY) / (MAX_LINEAR_VELOCITY - MIN_LINEAR_VELOCITY)


def pursuit_action(waypoint: torch.Tensor) -> torch.Tensor:
    """Turn towards the next waypoint, and drive at full speed once it is roughly ahead.

    Args:
        waypoint: waypoint observations, shape [..., 6], as the environment writes them.

    Returns:
        Actions, shape [..., 2], in [-1, 1].

    Example:
        >>> ahead = torch.tensor([0.0, 1.0, 0.0, 0.0, 1.0, 0.0])
        >>> pursuit_action(ahead)
        tensor([1., 0.])
    """
    bearing = torch.atan2(waypoint[..., 2], waypoint[..., 1])
    turn = (bearing * (TURN_GAIN_PER_S / MAX_ANGULAR_VELOCITY)).clamp(-1.0, 1.0)
    drive = torch.where(bearing.abs() < ALIGNED_RAD, 1.0, STAND_STILL).to(waypoint.dtype)
    return torch.stack((drive, turn), dim=-1)
