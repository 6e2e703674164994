"""Model predictive path integral control (Williams et al. 2017), as in a navigation stack, with an agent's inputs."""

import math
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from rcdsac_trl.errors import UserInputError
from rcdsac_trl.robot.robot_settings import PAPER, RobotSettings
from rcdsac_trl.rollout.planners.trajectory_costs import PlannerSettings, TrajectoryCosts
from rcdsac_trl.system.jit import njit

# Samples that are held from the first step to the last; see :func:`_held`.
_NUM_HELD = 5


@dataclass(frozen=True)
class MppiSettings:
    """What MPPI looks at.

    Attributes:
        samples: trajectories a decision; they take as long as all the rest of it, and more were not tried.
        steps: of a trajectory, 0.14 s each: 2.8 s, in which the robot and a mover come 3 m nearer, as far as it senses.
        knot_steps: steps from one draw of noise to the next; it is linear in between, so that a robot that needs
            0.4 s to 0.6 m/s can follow. With 2 it is slower.
        std_v: standard deviation of the noise on the linear velocity, m/s: a third of its range. With 0.4 it collides
            more often.
        std_omega: standard deviation of the noise on the angular velocity, rad/s: so that turns beyond the dead band
            are common and full turns are seen.
        temperature_m: a trajectory that costs this much more than another counts 1/e of it, m. From 0.15 on the mean
            is of too many to be like any, and slow.
        common: what it remembers and what counts.

    Raises:
        UserInputError: if a value is outside its limits.
    """

    samples: int = 350
    steps: int = 20
    knot_steps: int = 3
    std_v: float = 0.25
    std_omega: float = 1.0
    temperature_m: float = 0.03
    common: PlannerSettings = field(default_factory=PlannerSettings)

    def __post_init__(self) -> None:
        """Refuse what samples nothing."""
        if self.samples <= _NUM_HELD + 1:
            raise UserInputError(f"samples={self.samples} must be above {_NUM_HELD + 1}: those are not random")
        for name in ("steps", "knot_steps", "std_v", "std_omega", "temperature_m"):
            if not getattr(self, name) > 0:
                raise UserInputError(f"{name}={getattr(self, name)} must be above 0")


class Mppi:
    """A :class:`.controller.Controller`: the mean of random trajectories, weighted by what they cost.

    Trajectories scatter around the last plan, a step on. Among them are that plan itself and five simple ones, so that
    a good one is there where noise finds none.

    Args:
        settings: what it looks at.
        robot: that it drives.
    """

    def __init__(self, settings: MppiSettings | None = None, robot: RobotSettings = PAPER) -> None:
        self.settings = settings or MppiSettings()
        self._robot = robot
        self._held = _held(robot)
        self._limits = robot.min_linear_velocity, robot.max_speed_m_per_s, robot.max_angular_velocity
        self._knots = (self.settings.steps - 1) // self.settings.knot_steps + 2

    def reset(self, sensed: NDArray[np.bool_], rng: np.random.Generator, period_s: float) -> None:
        """Begin an episode, and forget the last one."""
        settings = self.settings
        self._costs = TrajectoryCosts(settings.common, sensed, settings.steps, self._robot, period_s)
        self._rng = rng
        self._plan = np.zeros((settings.steps, 2))

    def act(
        self, ranges_m: NDArray[np.float64], waypoints_m: NDArray[np.float64], velocity: NDArray[np.float64]
    ) -> tuple[float, float]:
        """Return the desired velocities, m/s and rad/s."""
        settings = self.settings
        self._costs.observe(ranges_m, waypoints_m, velocity)
        noise = self._rng.standard_normal((settings.samples, self._knots, 2), np.float32)
        controls = np.empty((settings.samples, settings.steps, 2))
        self._plan[:-1] = self._plan[1:]
        _scatter(controls, self._plan, noise, settings.knot_steps, settings.std_v, settings.std_omega, *self._limits)
        controls[0] = self._plan
        controls[1 : 1 + _NUM_HELD] = self._held[:, None]
        _average(self._plan, controls, self._costs.of(controls), settings.temperature_m)
        v, omega = self._plan[0].tolist()
        return v, omega


def _held(robot: RobotSettings) -> NDArray[np.float64]:
    """Return the velocities of simple ways, [5, 2]: stand, turn left, turn right, drive on, back out."""
    turn = robot.max_angular_velocity
    return np.array(
        [(0.0, 0.0), (0.0, turn), (0.0, -turn), (robot.max_speed_m_per_s, 0.0), (robot.min_linear_velocity, 0.0)]
    )


# ------------------------------------------------------------------------------------------------ compiled
@njit
def _scatter(
    controls: np.ndarray,
    plan: np.ndarray,
    noise: np.ndarray,
    knot_steps: int,
    std_v: float,
    std_omega: float,
    min_v: float,
    max_v: float,
    max_omega: float,
) -> None:
    """Write a plan with noise, linear from knot to knot, within the robot's velocities."""
    for k in range(controls.shape[0]):
        for t in range(controls.shape[1]):
            knot = t // knot_steps
            share = (t - knot * knot_steps) / knot_steps
            v = plan[t, 0] + std_v * ((1.0 - share) * noise[k, knot, 0] + share * noise[k, knot + 1, 0])
            omega = plan[t, 1] + std_omega * ((1.0 - share) * noise[k, knot, 1] + share * noise[k, knot + 1, 1])
            controls[k, t, 0] = min(max(v, min_v), max_v)
            controls[k, t, 1] = min(max(omega, -max_omega), max_omega)


@njit
def _average(plan: np.ndarray, controls: np.ndarray, costs: np.ndarray, temperature_m: float) -> None:
    """Write the mean of the controls, weighted by what they cost."""
    best, total = costs.min(), 0.0
    plan[:] = 0.0
    for k in range(len(costs)):
        weight = math.exp((best - costs[k]) / temperature_m)
        total += weight
        for t in range(len(plan)):
            plan[t, 0] += weight * controls[k, t, 0]
            plan[t, 1] += weight * controls[k, t, 1]
    plan /= total
