"""The baseline on the course: it drives to the next waypoint at full speed, and looks at nothing."""

from typing import Any

import torch

from rcdsac_trl.deploy.policy.command import Command
from rcdsac_trl.deploy.policy.input_checks import Stamps
from rcdsac_trl.evaluation.course.odometry import Pose
from rcdsac_trl.robot.action import desired_velocities
from rcdsac_trl.robot.observation import AT_ORIGIN, waypoint_observation
from rcdsac_trl.rollout.planners.pursuit import pursuit_action
from rcdsac_trl.world.task.rules import TaskSettings


class PursuitPilot:
    """A pilot without ranges, memory or limits; see :mod:`rcdsac_trl.rollout.planners.pursuit`."""

    def __init__(self) -> None:
        self.config = TaskSettings()  # has the two radii

    def reset(self) -> None:
        """There is nothing to forget."""

    def act(
        self, ranges: Any, waypoints: Any, velocity: Any, beta: float | None, *, stamps: Stamps | None, pose: Pose
    ) -> Command:
        """Return the command towards the first of the waypoints."""
        observed = waypoint_observation(AT_ORIGIN, *waypoints.tolist())
        v, omega = desired_velocities(
            pursuit_action(torch.tensor(observed, dtype=torch.float32, device="cpu")).tolist()
        )
        return Command(v, omega, False, None, (v, omega))
