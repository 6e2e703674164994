"""The object that drives: observations in, a velocity command and the risk of it out, one call a control period."""

import copy
from collections.abc import Sequence
from dataclasses import replace
from typing import TYPE_CHECKING, Any, Literal

import numpy as np
from numpy.typing import NDArray

from rcdsac_trl.deploy.policy.acting import ActingSettings
from rcdsac_trl.deploy.policy.action_choice import ActionChoice
from rcdsac_trl.deploy.policy.command import Command, Outlook
from rcdsac_trl.deploy.policy.distortion import fractions_of
from rcdsac_trl.deploy.policy.inference import Actor, Array, Critics, Encoders
from rcdsac_trl.deploy.policy.input_checks import (
    BadInputError,
    InputLimits,
    Stamps,
    as_given_now,
    check_stamps,
    sectors_of,
    velocity_of,
    waypoints_of,
)
from rcdsac_trl.deploy.policy.observed import observed
from rcdsac_trl.deploy.policy.weights import Weights
from rcdsac_trl.deploy.sensors.arrays import described, numbers_of
from rcdsac_trl.errors import UserInputError
from rcdsac_trl.robot.action import desired_velocities
from rcdsac_trl.robot.guard import Guard
from rcdsac_trl.robot.observation import range_observation, waypoint_observation
from rcdsac_trl.robot.robot_settings import RobotSettings
from rcdsac_trl.robot.sectors import Sectors, is_finite_number
from rcdsac_trl.seeding import stream

if TYPE_CHECKING:
    from rcdsac_trl.deploy.navigation.navigator import Advice, Navigator
    from rcdsac_trl.robot.remembered_ranges import RememberedRanges

# After so many calls without good input in a row, or so many of the longest periods of training without one, the memory
# is of another situation.
_FORGET_AFTER = 3
_RECOVERS = "it stands until good input comes"
_AT_ORIGIN = (0.0, 0.0, 0.0)


def _span(values: Sequence[float], digits: int) -> str:
    """Write the smallest and the largest of some numbers, or the only one."""
    low, high = (f"{value:.{digits}f}" for value in (min(values), max(values)))
    return low if low == high else f"{low} to {high}"


def _memory_of(memory_s: float, sensed: NDArray[np.bool_], robot: RobotSettings) -> "RememberedRanges | None":
    """Make what remembers for so long, if anything does; alone of all that drives a robot, that needs numba."""
    if memory_s == 0.0:
        return None
    from rcdsac_trl.robot.remembered_ranges import RememberedRanges

    return RememberedRanges(sensed, memory_s, robot)


def _guard_of(robot: RobotSettings, guard: Guard | Literal["robot"] | None) -> Guard | None:
    """Return the guard of a robot's policy.

    Raises:
        UserInputError: if the one that was given is another robot's.
    """
    if guard == "robot":
        return Guard.of(robot)
    if not isinstance(guard, Guard | None):
        raise UserInputError(f"guard={guard!r} is none: give Guard.of(robot), None to drive without, or leave it out")
    if guard is not None and guard.robot != robot:
        raise UserInputError(
            f"the guard has the limits of robot={guard.robot.name}, and this agent drives robot={robot.name}: give "
            "Guard.of(policy.robot, ..), or leave it out"
        )
    return guard


class Policy:
    """A trained agent that drives a robot.

    Call :meth:`act` once in every control period, which is about 0.14 s. It never raises for what a message holds: on
    bad input the command is to stand, with the reason. Not for use from several threads at once.

    Args:
        weights: of the agent, from :func:`rcdsac_trl.deploy.read_weights`.
        guard: speed limit and stop zone, of its robot: ``Guard.of(robot, ..)``; ``"robot"``: that with its defaults;
            None drives without, which is for simulations that count collisions.
        limits: how old, and how gappy, input may be.
        num_quantiles: at how many fractions the return's distribution is told.
        navigator: hands out other waypoints where the way is blocked, and helps where the robot gets nowhere; None:
            the agent is on its own.
        acting: by the actor's mean or by the critics' choice among some actions; None: as the agent's config says.

    Attributes:
        config: what the agent is.
        robot: that it drives.
        measured: what is known of how it drives; None where nothing is.
        fractions: of the quantiles, the midpoints of equal parts of [0, 1], float32 [N].
        default_beta: what ``beta`` is where none is given, the middle of the trained range (-1 for the power law);
            None for an agent that is told none.

    Raises:
        UserInputError: if the guard is another robot's, or the critics are to choose by a measure of your own.
    """

    def __init__(
        self,
        weights: Weights,
        *,
        guard: Guard | Literal["robot"] | None = "robot",
        limits: InputLimits = InputLimits(),  # noqa: B008 (frozen)
        num_quantiles: int = 16,
        navigator: "Navigator | None" = None,
        acting: ActingSettings | None = None,
    ) -> None:
        self.config = weights.config
        self.measured = weights.measured
        self.robot = self.config.robot
        self.guard = _guard_of(self.robot, guard)
        self.limits = limits
        self.navigator = navigator
        self.fractions = fractions_of(num_quantiles)
        context = self.config.context_range
        middle = None if context is None else (context[0] + context[1]) / 2.0
        self.default_beta = middle if self.config.context == "beta" else None
        self._default_weight = middle if self.config.context == "collision_weight" else None
        self._mask = self.config.sensor_mask
        self._remembered = _memory_of(self.config.memory_s, self._mask, self.robot)
        parts = ["actor", *(f"critics.{number}" for number in range(self.config.num_critics))]
        self._encoders = Encoders(
            [weights.part(f"{part}.encoder") for part in parts],
            self._mask,
            self.config.padding,
            self.config.range_code,
            self.config.restart_steps,
            self.config.foreseen,
        )
        self._actor = Actor(weights)
        self._critics = Critics(weights, self.fractions)
        self.acting = weights.config.acting if acting is None else acting
        self._halted = False
        self._states: Array
        self._read: Array
        self._steps: int
        self._commanded: tuple[float, float]
        self.reset()

    def reset(self) -> None:
        """Forget everything before: call it where the robot is put somewhere else, or gets a new task."""
        self._forget()
        self._refused = 0
        self._last: Stamps | None = None
        self._last_fresh: Stamps | None = None
        self._wanted: tuple[float, float] | None = None
        self._told: Outlook | None = None
        self._advice: Advice | None = None
        self._noise = stream(0, "drawn actions of a policy")
        if self.navigator is not None:
            self.navigator.reset()
        self._others: list[Policy] = []

    def __repr__(self) -> str:
        """Say what the agent is, and what its card says of how it drives."""
        config = self.config
        parts = [config.name, f"sensor {config.sensor}"]
        if config.memory_s > 0.0:
            parts.append(f"remembers {config.memory_s:g} s")
        if config.context is not None and config.context_range is not None:
            parts.append(f"{config.context} in [{config.context_range[0]:g}, {config.context_range[1]:g}]")
        elif config.fixed_beta is not None:
            parts.append(f"for beta={config.fixed_beta:g} alone")
        parts.append(f"robot {self.robot.name}")
        if self.acting.chooses:
            parts.append(f"chooses among {self.acting.num_candidates} actions")
        if self.measured is not None:
            conditions = self.measured.conditions
            collisions, rewards = ([c.metrics[name].mean for c in conditions] for name in ("collisions", "reward"))
            parts.append(f"an episode: collisions {_span(collisions, 2)}, reward {_span(rewards, 0)}")
        return f"Policy({', '.join(parts)})"

    def __copy__(self) -> "Policy":
        """Copy the situation, and share what never changes."""
        copied = object.__new__(type(self))
        own = {name: copy.deepcopy(self.__dict__[name]) for name in ("_remembered", "navigator", "_noise")}
        own["_others"] = [copy.copy(other) for other in self._others]
        copied.__dict__ |= self.__dict__ | own
        return copied

    @property
    def acting(self) -> ActingSettings:
        """How it acts: by tanh(mean), or by its critics' choice among some actions. It may be changed.

        Raises:
            UserInputError: if the critics are to choose by a risk measure that is known to torch alone.
        """
        return self._acting

    @acting.setter
    def acting(self, acting: ActingSettings) -> None:
        self._choice = ActionChoice(acting, self.config, self._actor, self._critics) if acting.chooses else None
        self._acting = acting
        # Offsets were fitted while it acted as its config says: acting otherwise it earns something else.
        fitted = self.config.recalibration if acting == self.config.acting else None
        self._recalibration = None if fitted is None else fitted.at(self.fractions)

    @property
    def recalibrated(self) -> bool:
        """Whether the quantiles that it tells are what its critics say, shifted by ``config.recalibration``.

        So only while it acts as ``config.acting``, and what it does follows from what they say.
        """
        return self._recalibration is not None

    @property
    def world(self) -> dict[str, Any]:
        """What the agent was trained to see with and drive, as an environment takes it: sensor, memory and robot."""
        return {"sensor": self.config.sensor, "memory_s": self.config.memory_s, "robot": self.robot}

    def act_on(
        self, observation: Any, beta: float | None = None, *, collision_weight: float | None = None
    ) -> NDArray[np.float32]:
        """Return the action for an observation of the Gymnasium or the TorchRL environment.

        Call it once in every step. It does what :meth:`act` does for a robot, without guard, :meth:`stop` and the
        checks of what a robot's sensors say. Call :meth:`reset` when an episode begins; a TorchRL environment with an
        ``InitTracker`` says so itself.

        Args:
            observation: what the environment returned, a dict or a TensorDict, of one agent or of many: each has a
                memory of its own.
            beta: as in :meth:`act`.
            collision_weight: as in :meth:`act`.

        Returns:
            float32 [2], each in [-1, 1]; [N, 2] of N agents.

        Raises:
            UserInputError: if the observation is of another sensor or memory than the agent's, or :meth:`act` would
                refuse `beta` or `collision_weight`.

        Example:
            >>> import gymnasium, rcdsac_trl
            >>> policy = rcdsac_trl.load("rcdsac_pow-narrow")
            >>> env = gymnasium.make("RCDSACNavigation-v0", map="easy", **policy.world)
            >>> observation, _ = env.reset(seed=0)
            >>> policy.act_on(observation, beta=-1.0).shape
            (2,)
        """
        seen = observed(observation, self.config)
        try:
            context = self._context(beta, collision_weight)
        except BadInputError as error:
            raise UserInputError(str(error)) from None
        agents = self._agents(len(seen.bins))
        for agent in np.flatnonzero(seen.begins):
            agents[agent]._forget()
        actions = [
            agent._see(bins, vectors, context).action
            for agent, bins, vectors in zip(agents, seen.bins, seen.vectors, strict=True)
        ]
        return np.array(actions, dtype=np.float32).reshape(*seen.batch, 2)

    def _agents(self, number: int) -> "list[Policy]":
        """Return this one and others with memories of their own, which are there until a :meth:`reset`."""
        if len(self._others) != number - 1:
            self.reset()
            self._others = [copy.copy(self) for _ in range(number - 1)]
        return [self, *self._others]

    def foresee(self, beta: float | None = None, *, action: Any = None) -> Outlook:
        """Return what the agent would do with another `beta` where it stands now, and what it expects of that.

        It changes nothing: the memory, which does not depend on `beta`, is that of the last :meth:`act`. A copy,
        ``copy.copy(policy)``, keeps the situation for later.

        Args:
            beta: how much risk to take; None: :attr:`default_beta`.
            action: what to expect of another action than its own, [2], each in [-1, 1].

        Raises:
            UserInputError: if nothing was seen since :meth:`reset`, the agent is told a collision weight, which is
                part of its memory, `beta` is refused by :meth:`act`, too, or `action` is no action.

        Example:
            >>> import rcdsac_trl
            >>> policy = rcdsac_trl.load("rcdsac_pow-narrow")
            >>> bold = policy.act(np.full(180, np.inf), [(2.0, 0.0), (3.0, 1.0)], (0.0, 0.0), beta=0.0).wanted
            >>> policy.foresee(0.0).wanted == bold, policy.foresee(-2.0).wanted == bold
            (True, False)
        """
        if self._steps == 0:
            raise UserInputError("nothing was seen since the memory was cleared: call act() first")
        if self.config.context == "collision_weight":
            raise UserInputError(
                f"the memory of {self.config.name} depends on its collision weight: call act() instead"
            )
        context = self.check_beta(beta)
        if action is None:
            return self._outlook(context)
        asked = numbers_of(action, "action").astype(np.float32)
        if asked.shape != (2,) or not np.all(np.abs(asked) <= 1.0):
            raise UserInputError(f"action={action} is not two numbers from -1 to 1: give u_0 and u_1")
        return self._outlook(context, asked)

    def outlooks(self, actions: NDArray[np.float32], beta: float | None = None) -> NDArray[np.float32]:
        """Return what the critics expect of many actions where the agent stands now, as :meth:`foresee` of each.

        Unlike that it also takes an agent that is told a collision weight: it answers for the one of the last
        :meth:`act`.

        Args:
            actions: [K, 2], each number in [-1, 1].
            beta: how much risk to take; None: :attr:`default_beta`.

        Returns:
            Quantiles of the return at :attr:`fractions`, float32 [K, N]; of critics that know the mean alone, [K, 1].

        Raises:
            UserInputError: if nothing was seen since :meth:`reset`, or `beta` is refused by :meth:`act`, too.
        """
        if self._steps == 0:
            raise UserInputError("nothing was seen since the memory was cleared: call act() first")
        context = self.check_beta(beta)
        lower = self._critics.of_actions(self._read[1:], np.asarray(actions, np.float32), self._embedded(context))
        return self._tell(lower, context)

    def check_beta(self, beta: float | None) -> float | None:
        """Return what the agent is told for a `beta`, None where that is nothing.

        Raises:
            UserInputError: if :meth:`act` would refuse to drive with it.
        """
        try:
            return self._context(beta, None)
        except BadInputError as error:
            raise UserInputError(str(error)) from None

    def stop(self) -> None:
        """Make every command one to stand, until :meth:`resume`."""
        self._halted = True

    def resume(self) -> None:
        """End a :meth:`stop`."""
        self._halted = False

    def act(
        self,
        ranges: Any,
        waypoints: Any,
        velocity: Any,
        beta: float | None = None,
        *,
        collision_weight: float | None = None,
        stamps: Stamps | None = None,
    ) -> Command:
        """Return the command for this control period.

        Args:
            ranges: what the range sensor says: distances [180] in m by sector, ``inf`` where nothing is;
                :class:`~rcdsac_trl.deploy.Sectors` from clouds; or a :class:`~rcdsac_trl.deploy.Scan`.
            waypoints: the next two, x and y in m in the robot's frame, [2, 2]; on the last leg the goal alone, [2].
            velocity: measured, m/s and rad/s, [2].
            beta: how much risk to take; may change at every call. None: :attr:`default_beta`.
            collision_weight: what agents of the row RCWR are told instead; None: the middle of the trained range.
            stamps: when the input was measured; without them nobody notices what is late, repeated or out of order.
        """
        try:
            if self._halted:
                raise BadInputError("stop() was called")
            if stamps is not None:
                stamps = as_given_now(stamps)
                check_stamps(stamps, self._last, self.limits)
            sectors = sectors_of(ranges, self._mask, self.limits, self.robot)
            next_two = waypoints_of(waypoints)
            measured = velocity_of(velocity, self.robot)
            context = self._context(beta, collision_weight)
        except UserInputError as error:
            return self.refuse(str(error))
        except Exception as error:  # whatever was given: what it does when it is read is not ours to know
            return self.refuse(f"the input cannot be read ({described(error)})")
        return self._drive(sectors, next_two, measured, context, stamps)

    def _drive(
        self,
        sectors: Sectors,
        next_two: tuple[tuple[float, float], tuple[float, float]],
        measured: tuple[float, float],
        context: float | None,
        stamps: Stamps | None,
    ) -> Command:
        fresh = self._is_due(stamps)
        forgot = self._steps == 0
        elapsed_s = self._elapsed_s(stamps)
        self._refused = 0
        self._last = stamps
        if fresh:
            self._last_fresh = stamps
            if self.navigator is not None:
                self._advice = self.navigator.advise(
                    sectors.distances_m, sectors.covered, next_two, measured, elapsed_s
                )
                next_two, context = self._advice.waypoints, self._bolder(context, self._advice.boldness)
            self._ask(sectors, next_two, measured, context, elapsed_s)
        return self._command(sectors, measured, fresh, fresh and forgot)

    def _bolder(self, context: float | None, boldness: float) -> float | None:
        """Return a beta that is turned towards the boldest of training; a collision weight stays."""
        if context is None or self.config.context != "beta" or self.config.context_range is None:
            return context
        return context + boldness * (self.config.context_range[1] - context)

    def _is_due(self, stamps: Stamps | None) -> bool:
        """Return whether the agent is asked; else the robot goes on as it was told last, guarded anew."""
        last = self._last_fresh
        if stamps is None or last is None:
            return True
        shortest, longest = self.config.period_s
        since = stamps.now_s - last.now_s
        if since > _FORGET_AFTER * longest:
            self._forget()
            return True
        # The recurrent network counts time in steps: a second look at one scan, or one in half the time, is none.
        return stamps.scan_s > last.scan_s and since > shortest / 2.0

    def _elapsed_s(self, stamps: Stamps | None) -> float:
        """Return the time since the last observation; without stamps a call is the middle of training's periods."""
        if self._steps == 0:
            return 0.0
        if stamps is None or self._last_fresh is None:
            return (1 + self._refused) * sum(self.config.period_s) / 2.0
        return stamps.scan_s - self._last_fresh.scan_s

    def _ask(
        self,
        sectors: Sectors,
        waypoints: tuple[tuple[float, float], tuple[float, float]],
        measured: tuple[float, float],
        context: float | None,
        elapsed_s: float,
    ) -> None:
        bins = range_observation(sectors.distances_m, self._mask, self.robot.lidar.max_range_m)
        vectors = [*waypoint_observation(_AT_ORIGIN, *waypoints), *measured, *self._commanded]
        if self._remembered is not None:
            vectors += self._remembered.observe(sectors.distances_m, *measured, elapsed_s, sectors.covered).tolist()
        self._see(bins, vectors, context)

    def _see(self, bins: Array, vectors: Sequence[float] | Array, context: float | None) -> Outlook:
        """Let the networks take a step, and return what they want and expect."""
        weight = (context,) if self.config.context == "collision_weight" and context is not None else ()
        told = np.array((*vectors, *weight), dtype=np.float32)
        self._states = self._encoders.step(bins, told, self._states)
        self._read = self._encoders.heads_read(self._states, told)
        self._steps += 1
        drawn = None
        if self._advice is not None and self._advice.draws:
            noise = self._noise.standard_normal(2, np.float32)
            drawn = self._actor.action(self._read[0], self._embedded(context), noise)
        outlook = self._outlook(context, drawn)
        self._wanted = outlook.wanted
        self._told = outlook
        return outlook

    def _embedded(self, context: float | None) -> float | None:
        """Return what the heads are told; None where they are told nothing."""
        if self.config.embedding is None or context is None:
            return None
        return self.config.embedding[0] * context + self.config.embedding[1]

    def _chosen(self, context: float | None, embedded: float | None) -> Array:
        """Return what the agent does where it stands, [2]."""
        if self._choice is None:
            return self._actor.action(self._read[0], embedded)
        return self._choice.best(self._read, context if self.config.context == "beta" else None, embedded)

    def _outlook(self, context: float | None, action: Array | None = None) -> Outlook:
        embedded = self._embedded(context)
        if action is None:
            action = self._chosen(context, embedded)
        lower = self._critics.values(self._read[1:], action, embedded)
        told = self._tell(lower, context)
        raw, quantiles = (lower, told) if self.config.critic == "quantile" else (None, None)
        values = told.tolist()  # of so few, Python's sum is the fastest mean
        velocities = desired_velocities(action.tolist(), self.robot)
        return Outlook(action, velocities, quantiles, sum(values) / len(values), raw)

    def _tell(self, lower: Array, context: float | None) -> Array:
        """Return what is told where the critics say this, [.., N]."""
        if self._recalibration is None:
            return lower
        return self._recalibration.tell(lower, context if self.config.context == "beta" else None)

    def _command(self, sectors: Sectors, measured: tuple[float, float], fresh: bool, forgot: bool) -> Command:
        assert self._wanted is not None
        assert self._told is not None
        (v, omega), reason, been = self._wanted, None, None
        told = None
        if self._advice is not None:
            if fresh:
                sectors = replace(sectors, distances_m=self._advice.distances_m)
            been = self._advice.been
            if self._advice.instead is not None:
                v, omega = self._advice.instead
                told = "it got nowhere and backs off; the agent drives on then"
        if self.guard is not None:
            v, omega, reason = self.guard.limit(v, omega, sectors, measured, been)
        # Networks are told what the robot was told: the limits are part of the world.
        self._commanded = (v, omega)
        quantiles, value, raw = self._told.quantiles, self._told.value, self._told.raw_quantiles
        if reason is not None:
            told = f"limited by {reason}; it ends when the cause does"
        return Command(v, omega, False, told, self._wanted, quantiles, value, fresh, forgot, raw)

    def refuse(self, reason: str) -> Command:
        """Return the command to stand for a reason that lies outside, and count it as bad input."""
        self._refused += 1
        self._commanded = (0.0, 0.0)
        if self._refused >= _FORGET_AFTER:
            self._forget()
            self._last = self._last_fresh = None  # a clock that was set back is a clock
        how = "resume() ends it" if self._halted else _RECOVERS
        return Command(0.0, 0.0, True, f"{reason}; {how}")

    def _context(self, beta: float | None, collision_weight: float | None) -> float | None:
        config = self.config
        given = {"beta": beta, "collision_weight": collision_weight}
        for name, value in given.items():
            if value is not None and not is_finite_number(value):
                raise BadInputError(f"{name} is no finite number ({type(value).__name__}): give one, as a float")
            if value is None or name == config.context or (name == "beta" and value == config.fixed_beta):
                continue
            raise BadInputError(f"{name}={value:g} means nothing to this agent ({config.name}): leave it out")
        if config.context is None or config.context_range is None:
            return None
        value = given[config.context]
        if value is None:
            value = self.default_beta if config.context == "beta" else self._default_weight
        assert value is not None
        low, high = config.context_range
        if not low <= value <= high:
            raise BadInputError(
                f"{config.context}={value:g} is outside [{low:g}, {high:g}], where this agent was trained"
            )
        return float(value)

    def _forget(self) -> None:
        self._states = np.zeros((self._encoders.number, self._encoders.state_size), dtype=np.float32)
        if self._remembered is not None:
            self._remembered.reset()
        self._commanded = (0.0, 0.0)
        self._steps = 0
