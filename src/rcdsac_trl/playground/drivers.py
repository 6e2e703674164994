"""Who drives a robot on the page: a trained agent, or a classical planner with the same inputs."""

from dataclasses import dataclass, replace
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from rcdsac_trl.agent.risk import RiskMeasure, make_measure
from rcdsac_trl.deploy import Command, Guard, Policy, Sectors, Stamps, Weights
from rcdsac_trl.deploy.navigation.navigator import Advice, Navigator, NavigatorSettings
from rcdsac_trl.errors import UserInputError
from rcdsac_trl.robot.robot_settings import RobotSettings
from rcdsac_trl.rollout.planners.controller import Controller
from rcdsac_trl.rollout.planners.dwa import Dwa
from rcdsac_trl.rollout.planners.mppi import Mppi
from rcdsac_trl.seeding import stream

# Up to this share of its range a dial is near its low end, and from that on near its high one.
_NEAR_LOW, _NEAR_HIGH = 0.3, 0.95


@dataclass(frozen=True)
class Situation:
    """What a robot is asked on.

    Attributes:
        sectors: what its range sensor says, all of it.
        waypoints: the next two, m, in its frame, [2, 2].
        velocity: linear and angular velocity measured, m/s and rad/s.
        desired: those it was told last.
    """

    sectors: Sectors
    waypoints: NDArray[np.float64]
    velocity: tuple[float, float]
    desired: tuple[float, float]


@dataclass(frozen=True)
class Dial:
    """What turns a driver.

    Attributes:
        symbol: what it is called.
        low: its smallest value, for beta the most averse one.
        high: its largest.
        default: where it stands unless somebody turns it.
        words: what a driver is at either end.
    """

    symbol: str
    low: float
    high: float
    default: float
    words: tuple[str, str]

    def word(self, value: float) -> str:
        """Return what a driver is with a value that is near an end; else nothing.

        Example:
            >>> dial = Dial("β", -2.0, 0.0, -1.0, ("careful", "neutral"))
            >>> dial.word(-1.5), dial.word(-1.0), dial.word(0.0)
            ('careful', '', 'neutral')
        """
        share = (value - self.low) / (self.high - self.low)
        return self.words[0] if share <= _NEAR_LOW else self.words[1] if share >= _NEAR_HIGH else ""

    def check(self, key: str, value: float | None) -> float:
        """Return a value that may be dialled; None: the default.

        Raises:
            UserInputError: if it is outside the trained range.
        """
        if value is None:
            return self.default
        if not self.low <= value <= self.high:
            raise UserInputError(
                f"{key}={value:g} is outside [{self.low:g}, {self.high:g}], where this agent was trained: "
                "choose a value of that range"
            )
        return value


class Driver(Protocol):
    """Drives one robot."""

    robot: RobotSettings
    sensor: str
    memory_s: float
    dial: Dial | None
    measure: RiskMeasure | None
    """What weighs the return; None where its distribution is not known."""
    guarded: bool
    """Whether the stop zone is on."""
    detour: tuple[float, float] | None
    """The corner that it was sent to last instead of its next waypoint, m, in the robot's frame; None: it was not."""
    helped: str | None
    """How the watchdog helps it now; None: it does not."""

    def set_detours(self, on: bool) -> None:
        """Lead it around what blocks its way, and help it where it stands, or let it alone."""
        ...

    def beta(self, dialled: float | None) -> float | None:
        """Return the beta by which the measure weighs the return; None where there is none."""
        ...

    def begin(self, period_s: float) -> None:
        """Begin anew, in a world in which a control period takes so long, s."""
        ...

    def act(self, situation: Situation, dialled: float | None) -> Command:
        """Return the command for this control period."""
        ...

    def reconsidered(self, command: Command, dialled: float | None) -> Command:
        """Return the last command as it would have been with another beta; the wheels were told what they were told."""
        ...


class _SeeingNavigator(Navigator):
    """What navigates around an agent and sees what that sees, as in an evaluation; the stop zone sees all around.

    Args:
        robot: that the agent drives.
        sensor: that it sees with.
    """

    def __init__(self, robot: RobotSettings, sensor: str) -> None:
        self._mask = robot.sensor_mask(sensor)
        super().__init__(NavigatorSettings(), robot)

    def advise(self, distances_m: NDArray[np.float64], covered: NDArray[np.bool_], *rest: Any) -> Advice:
        """See :meth:`Navigator.advise`."""
        return super().advise(distances_m, covered & self._mask, *rest)


class AgentDriver:
    """A trained agent.

    Args:
        weights: of the agent.
        sensor: that it sees with; None: what it was trained with.

    Attributes:
        policy: that acts.
        fixed_beta: the one beta that it was trained for; None for a range, or none.
    """

    def __init__(self, weights: Weights, sensor: str | None = None) -> None:
        if sensor is not None:
            weights = replace(weights, config=replace(weights.config, sensor=sensor))
        config = weights.config
        self.policy = Policy(weights, guard=None)
        self.robot, self.sensor, self.memory_s = config.robot, config.sensor, config.memory_s
        self._forget_help()
        self.fixed_beta = config.fixed_beta
        self.measure = make_measure(config.measure) if config.critic == "quantile" else None
        self.dial: Dial | None = None
        if config.context is not None and config.context_range is not None:
            low, high = config.context_range
            symbol = "β" if config.context == "beta" else "w"
            self.dial = Dial(symbol, low, high, (low + high) / 2.0, self._words(high))

    def _words(self, high: float) -> tuple[str, str]:
        """Return what it is at the ends of its range, of which one is the highest value."""
        if self.policy.config.context == "collision_weight":
            return "bold", "careful"
        is_neutral = self.measure is not None and high == self.measure.neutral_beta
        return "careful", "neutral" if is_neutral else "bold"

    @property
    def guarded(self) -> bool:
        """Whether the stop zone is on."""
        return self.policy.guard is not None

    @guarded.setter
    def guarded(self, on: bool) -> None:
        self.policy.guard = Guard.of(self.robot) if on else None

    def set_detours(self, on: bool) -> None:
        """Put detours and a watchdog around the agent, as on a robot, or take them away."""
        if on != (self.policy.navigator is not None):
            self.policy.navigator = _SeeingNavigator(self.robot, self.sensor) if on else None
            self._forget_help()

    def beta(self, dialled: float | None) -> float | None:
        """Return the beta by which it acts: as dialled or turned by the watchdog, or the one of the training."""
        if self.policy.config.context == "beta":
            return dialled if self._turned_to is None else self._turned_to
        if self.fixed_beta is not None or self.measure is None:
            return self.fixed_beta
        return self.measure.neutral_beta

    def begin(self, period_s: float) -> None:
        """Forget everything before; the agent is told how long a control period takes, s."""
        self.policy.reset()
        self._period_s, self._periods = period_s, 0

    def act(self, situation: Situation, dialled: float | None) -> Command:
        """Return the agent's command."""
        is_weight = self.policy.config.context == "collision_weight"
        beta, weight = (None, dialled) if is_weight else (dialled, None)
        sectors, waypoints, velocity = situation.sectors, situation.waypoints, situation.velocity
        self._periods += 1
        now = Stamps(*[self._periods * self._period_s] * 4)
        command = self.policy.act(sectors, waypoints, velocity, beta, collision_weight=weight, stamps=now)
        self._forget_help()
        if not command.stopped and self.policy.advice is not None:
            self._note(self.policy.advice, (float(waypoints[0, 0]), float(waypoints[0, 1])))
        return command

    def _forget_help(self) -> None:
        """Forget what the navigator did last."""
        self.detour: tuple[float, float] | None = None
        self.helped: str | None = None
        self._turned_to: float | None = None  # where the watchdog has turned beta; None: it has not

    def _note(self, advice: Advice, waypoint: tuple[float, float]) -> None:
        """Keep what was made of a waypoint that the agent was sent to, and of what was dialled."""
        if advice.waypoints[0] != waypoint:
            self.detour = advice.waypoints[0]
        self._turned_to = self.policy.turned_to
        if self._turned_to is not None:
            self.helped = "it stood still: turned to bold"
        if advice.instead is not None:
            self.helped = "it stood still and backs off"

    def reconsidered(self, command: Command, dialled: float | None) -> Command:
        """Return a command with what the agent would want with another beta, and what it expects of that."""
        if self.policy.config.context != "beta" or self._turned_to is not None:
            return command
        outlook = self.policy.foresee(dialled)
        told = {name: getattr(outlook, name) for name in ("wanted", "quantiles", "value", "raw_quantiles")}
        return replace(command, **told)


class PlannerDriver:
    """A classical planner.

    Args:
        name: one of :data:`~rcdsac_trl.playground.offers.PLANNERS`.
        robot: that it drives.
        sensor: that it sees with.
        seed: root seed of what it draws.
    """

    dial: Dial | None = None
    measure: RiskMeasure | None = None
    detour: tuple[float, float] | None = None
    helped: str | None = None
    memory_s = 0.0

    def __init__(self, name: str, robot: RobotSettings, sensor: str, seed: int) -> None:
        self.robot, self.sensor = robot, sensor
        self.guarded = False
        self._name, self._seed = name, seed
        self._mask = robot.sensor_mask(sensor)
        self._guard = Guard.of(robot)
        self._controller: Controller = Dwa(robot=robot) if name == "dwa" else Mppi(robot=robot)

    def set_detours(self, on: bool) -> None:
        """Do nothing: it navigates by itself."""

    def beta(self, dialled: float | None) -> float | None:
        """Return None: it knows no return."""
        return None

    def begin(self, period_s: float) -> None:
        """Forget everything before, its local map too; the planner is told how long a control period takes, s."""
        self._controller.reset(self._mask, stream(self._seed, self._name, 0, 0), period_s)

    def act(self, situation: Situation, dialled: float | None) -> Command:
        """Return the planner's command."""
        ranges_m = np.where(self._mask, situation.sectors.distances_m, np.inf)
        velocities = np.array([*situation.velocity, *situation.desired])
        wanted = self._controller.act(ranges_m, situation.waypoints, velocities)
        if not self.guarded:
            return Command(*wanted, False, None, wanted, fresh=True)
        v, omega, reason = self._guard.limit(*wanted, situation.sectors, situation.velocity)
        return Command(v, omega, False, reason, wanted, fresh=True)

    def reconsidered(self, command: Command, dialled: float | None) -> Command:
        """Return the command: a planner has no beta."""
        return command
