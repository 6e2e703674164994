"""The dynamic window approach (Fox et al. 1997), as in a navigation stack, with an agent's inputs."""

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from rcdsac_trl.errors import UserInputError
from rcdsac_trl.robot.robot_settings import PAPER, RobotSettings
from rcdsac_trl.rollout.planners.trajectory_costs import PlannerSettings, TrajectoryCosts


@dataclass(frozen=True)
class DwaSettings:
    """What DWA looks at.

    Attributes:
        linear: linear velocities, evenly over the robot's range; their steps are 0.057 m/s.
        angular: angular velocities, evenly over the robot's range, 0 among them; their steps are 9 deg/s.
        steps: of a trajectory, 0.14 s each: 2 s.
        common: what it remembers and what counts.

    Raises:
        UserInputError: if there is no pair to choose from.
    """

    linear: int = 15
    angular: int = 21
    steps: int = 14
    common: PlannerSettings = field(default_factory=PlannerSettings)

    def __post_init__(self) -> None:
        """Refuse what leaves no choice."""
        for name, lowest in (("linear", 2), ("angular", 3), ("steps", 1)):
            if getattr(self, name) < lowest:
                raise UserInputError(f"{name}={getattr(self, name)} must be at least {lowest}")


class Dwa:
    """A :class:`.controller.Controller`: the best of all pairs of velocities that the robot could hold for a while.

    The classic window holds the velocities that can be reached within a period. Here a pair is what the motor
    controller is told: the robot reaches it within its limits, as fast as it can, and holds it.

    Args:
        settings: what it looks at.
        robot: that it drives.
    """

    def __init__(self, settings: DwaSettings | None = None, robot: RobotSettings = PAPER) -> None:
        self.settings = settings or DwaSettings()
        self._robot = robot
        v = np.linspace(robot.min_linear_velocity, robot.max_speed_m_per_s, self.settings.linear)
        omega = np.linspace(-robot.max_angular_velocity, robot.max_angular_velocity, self.settings.angular)
        self._pairs = np.stack(np.meshgrid(v, omega, indexing="ij"), axis=-1).reshape(-1, 2)
        self._controls = np.repeat(self._pairs[:, None], self.settings.steps, axis=1)

    def reset(self, sensed: NDArray[np.bool_], rng: np.random.Generator, period_s: float) -> None:
        """Begin an episode, and forget the last one; nothing is random."""
        settings = self.settings
        self._costs = TrajectoryCosts(settings.common, sensed, settings.steps, self._robot, period_s)

    def act(
        self, ranges_m: NDArray[np.float64], waypoints_m: NDArray[np.float64], velocity: NDArray[np.float64]
    ) -> tuple[float, float]:
        """Return the desired velocities, m/s and rad/s."""
        self._costs.observe(ranges_m, waypoints_m, velocity)
        v, omega = self._pairs[self._costs.of(self._controls).argmin()].tolist()
        return v, omega
