"""The object that drives: observations in, a velocity command and the risk of it out, one call a control period."""

import copy
from collections.abc import Sequence
from typing import TYPE_CHECKING, Any, Literal, NamedTuple

import numpy as np
from numpy.typing import NDArray

from rcdsac_trl.deploy.policy.acting import ActingSettings
from rcdsac_trl.deploy.policy.command import Command, Outlook
from rcdsac_trl.deploy.policy.companions import guard_of, navigator_of
from rcdsac_trl.deploy.policy.context import bolder, context_of, middle_of_range
from rcdsac_trl.deploy.policy.control_periods import ControlPeriods
from rcdsac_trl.deploy.policy.distortion import NUM_REPORTED_QUANTILES, fractions_of
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
from rcdsac_trl.deploy.policy.model_card import summary
from rcdsac_trl.deploy.policy.observed import observed
from rcdsac_trl.deploy.policy.path import checked_pose
from rcdsac_trl.deploy.policy.recurrent_networks import RecurrentNetworks
from rcdsac_trl.deploy.policy.robot_observer import RobotObserver
from rcdsac_trl.deploy.policy.weights import Weights
from rcdsac_trl.deploy.sensors.arrays import described, numbers_of
from rcdsac_trl.errors import UserInputError
from rcdsac_trl.robot.dead_reckoning import DeadReckoning
from rcdsac_trl.robot.guard import Guard
from rcdsac_trl.robot.latency import Ahead
from rcdsac_trl.robot.planar import seen_from
from rcdsac_trl.robot.sectors import Sectors

if TYPE_CHECKING:
    from rcdsac_trl.deploy.navigation.navigator import Advice, Navigator
    from rcdsac_trl.deploy.navigation.static_layer import Pose


class _Moment(NamedTuple):
    """What the guard limits a command by.

    Attributes:
        sectors: what the range sensor says.
        measured: velocities, m/s and rad/s.
        ahead: where the robot will be when the command begins to act.
        on_map: where it is on its navigator's map; None where that has none.
        moved: how it has moved since the agent and the navigator were asked, x and y in m and yaw in rad, float64 [3].
    """

    sectors: Sectors
    measured: tuple[float, float]
    ahead: Ahead
    on_map: "Pose | None"
    moved: NDArray[np.float64]


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
        latency_s: from a measurement until the command that follows it acts, s. :meth:`act` then tells the agent what
            it will meet by then, and the guard limits from where the robot will be.

    Attributes:
        config: what the agent is.
        robot: that it drives.
        measured: what is known of how it drives; None where nothing is.
        fractions: of the quantiles, the midpoints of equal parts of [0, 1], float32 [N].
        default_beta: what ``beta`` is where none is given, the middle of the trained range (-1 for the power law);
            None for an agent that is told none.

    Raises:
        UserInputError: if guard or navigator is another robot's, the critics are to choose by a measure of your own,
            the latency cannot be allowed for, or something is none of what it should be.
    """

    def __init__(
        self,
        weights: Weights,
        *,
        guard: Guard | Literal["robot"] | None = "robot",
        limits: InputLimits = InputLimits(),  # noqa: B008 (frozen)
        num_quantiles: int = NUM_REPORTED_QUANTILES,
        navigator: "Navigator | None" = None,
        acting: ActingSettings | None = None,
        latency_s: float = 0.0,
    ) -> None:
        self.config = weights.config
        self.measured = weights.measured
        self.robot = self.config.robot
        self._observer = RobotObserver(self.config, latency_s)
        self.guard = guard_of(self.robot, guard)
        if not isinstance(limits, InputLimits):
            raise UserInputError(f"limits={limits!r} are none: give InputLimits(..), or leave them out")
        self.limits = limits
        self._latency_s = latency_s
        self.navigator = navigator
        self.fractions = fractions_of(num_quantiles)
        self.default_beta = middle_of_range(self.config) if self.config.context == "beta" else None
        self._networks = RecurrentNetworks(weights, self.fractions, self.config.acting if acting is None else acting)
        self._periods = ControlPeriods(self.config.period_s)
        self._halted = False
        self._advice: Advice | None
        self._turned_to: float | None
        self.reset()

    def reset(self) -> None:
        """Forget everything before: call it where the robot is put somewhere else, or gets a new task."""
        self._forget()
        self._periods.reset()
        self._told: Outlook | None = None
        self._others: list[Policy] = []

    def __repr__(self) -> str:
        """Say what the agent is, and what its card says of how it drives."""
        return f"Policy({summary(self.config, self.acting, self.measured)})"

    def __copy__(self) -> "Policy":
        """Copy the situation, and share what never changes."""
        copied = object.__new__(type(self))
        own = {name: copy.deepcopy(self.__dict__[name]) for name in ("_observer", "_navigator")}
        own |= {name: copy.copy(self.__dict__[name]) for name in ("_networks", "_periods")}
        own["_others"] = [copy.copy(other) for other in self._others]
        copied.__dict__ |= self.__dict__ | own
        return copied

    @property
    def navigator(self) -> "Navigator | None":
        """What navigates around the agent; it may be changed.

        Raises:
            UserInputError: if another robot's is given.
        """
        return self._navigator

    @navigator.setter
    def navigator(self, navigator: "Navigator | None") -> None:
        self._navigator = navigator_of(self.robot, navigator)

    @property
    def acting(self) -> ActingSettings:
        """How it acts: by tanh(mean), or by its critics' choice among some actions. It may be changed.

        Raises:
            UserInputError: if the critics are to choose by a risk measure that is known to torch alone.
        """
        return self._networks.acting

    @acting.setter
    def acting(self, acting: ActingSettings) -> None:
        self._networks.acting = acting
        for other in self._others:
            other.acting = acting

    @property
    def advice(self) -> "Advice | None":
        """What the navigator made of what was seen last; None without one, or where nothing was seen."""
        return self._advice

    @property
    def turned_to(self) -> float | None:
        """The beta that :attr:`advice` made of the one that was asked for; None where that stayed."""
        return self._turned_to

    @property
    def latency_s(self) -> float:
        """How late commands act that it allows for, s."""
        return self._latency_s

    @property
    def recalibrated(self) -> bool:
        """Whether the quantiles that it tells are what its critics say, shifted by ``config.recalibration``.

        So only while it acts as ``config.acting``, and what it does follows from what they say.
        """
        return self._networks.recalibrated

    @property
    def world(self) -> dict[str, Any]:
        """What the agent was trained to see with and drive, as an environment takes it: sensor, memory and robot."""
        return {"sensor": self.config.sensor, "memory_s": self.config.memory_s, "robot": self.robot}

    def act_on(
        self, observation: Any, beta: float | None = None, *, collision_weight: float | None = None
    ) -> NDArray[np.float32]:
        """Return the action for an observation of the Gymnasium or the TorchRL environment.

        Call it once in every step. It does what :meth:`act` does for a robot, without guard, navigator, :meth:`stop`
        and the checks of what a robot's sensors say. Call :meth:`reset` when an episode begins; a TorchRL environment
        with an ``InitTracker`` says so itself.

        Args:
            observation: what the environment returned, a dict or a TensorDict, of one agent or of many: each has a
                memory of its own.
            beta: as in :meth:`act`.
            collision_weight: as in :meth:`act`.

        Returns:
            float32 [2], each in [-1, 1]; [N, 2] of N agents.

        Raises:
            UserInputError: if the observation is of another sensor or memory than the agent's, :meth:`act` would refuse
                `beta` or `collision_weight`, or the policy allows for a latency, which observations do not tell it of.

        Example:
            >>> import gymnasium, rcdsac_trl
            >>> policy = rcdsac_trl.load("rcdsac_pow-narrow")
            >>> env = gymnasium.make("RCDSACNavigation-v0", map="easy", **policy.world)
            >>> observation, _ = env.reset(seed=0)
            >>> policy.act_on(observation, beta=-1.0).shape
            (2,)
        """
        if self.latency_s:
            raise UserInputError(
                f"latency_s={self.latency_s:g} is allowed for by act(), and act_on() takes observations as they are: "
                "load the agent without it, or give task.action_delay_steps and latency_s to evaluate"
            )
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
        self._check_seen()
        if self.config.context == "collision_weight":
            raise UserInputError(
                f"the memory of {self.config.name} depends on its collision weight: call act() instead"
            )
        context = self.check_beta(beta)
        if action is None:
            return self._networks.outlook(context)
        asked = numbers_of(action, "action").astype(np.float32)
        if asked.shape != (2,) or not np.all(np.abs(asked) <= 1.0):
            raise UserInputError(f"action={action} is not two numbers from -1 to 1: give u_0 and u_1")
        return self._networks.outlook(context, asked)

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
            UserInputError: if nothing was seen since :meth:`reset`, `beta` is refused by :meth:`act`, too, or `actions`
                are none.
        """
        self._check_seen()
        context = self.check_beta(beta)
        asked = numbers_of(actions, "actions").astype(np.float32)
        if asked.ndim != 2 or asked.shape[1] != 2 or not np.all(np.abs(asked) <= 1.0):
            raise UserInputError(f"actions={actions} are not [K, 2] numbers from -1 to 1: give u_0 and u_1 of each")
        return self._networks.outlooks(asked, context)

    def _check_seen(self) -> None:
        """Refuse to say what is expected where nothing was seen."""
        if self._networks.empty:
            raise UserInputError("nothing was seen since the memory was cleared: call act() first")

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
        pose: Any = None,
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
            pose: where the robot is on its navigator's map, x and y in m and yaw in rad; needed where that has one.
        """
        try:
            if self._halted:
                raise BadInputError("stop() was called")
            if stamps is not None:
                stamps = as_given_now(stamps)
                check_stamps(stamps, self._periods.last, self.limits)
            sectors = sectors_of(ranges, self._observer.mask, self.limits, self.robot)
            next_two = waypoints_of(waypoints)
            measured = velocity_of(velocity, self.robot)
            context = self._context(beta, collision_weight)
            on_map = self._on_map(pose)
        except UserInputError as error:
            return self.refuse(str(error))
        except Exception as error:  # whatever was given: what it does when it is read is not ours to know
            return self.refuse(f"the input cannot be read ({described(error)})")
        return self._drive(sectors, next_two, measured, context, stamps, on_map)

    def _on_map(self, pose: Any) -> "Pose | None":
        """Return where the robot is on its navigator's map; None where that has none."""
        if self.navigator is None or self.navigator.static_layer is None:
            return None
        if pose is None:
            raise BadInputError("the navigator has a map, and act() was not told where on it the robot is: give pose=")
        return checked_pose(pose)

    def _drive(
        self,
        sectors: Sectors,
        next_two: tuple[tuple[float, float], tuple[float, float]],
        measured: tuple[float, float],
        context: float | None,
        stamps: Stamps | None,
        on_map: "Pose | None",
    ) -> Command:
        if self._periods.memory_is_old(stamps):
            self._forget()
        forgot = self._networks.empty
        elapsed_s = 0.0 if forgot else self._periods.elapsed_s(stamps)
        fresh = self._periods.is_due(stamps)
        self._periods.accept(stamps, fresh)
        ahead = self._observer.ahead(measured, self._periods.time_s)
        if fresh:
            self._advice, self._turned_to = None, None
            if self.navigator is not None:
                self._advice = self.navigator.advise(
                    sectors.distances_m, sectors.covered, next_two, measured, elapsed_s, on_map
                )
                next_two, asked = self._advice.waypoints, context
                context = bolder(self.config, asked, self._advice.boldness)
                self._turned_to = context if context != asked else None
            seen = self._observer.observe(sectors, next_two, measured, elapsed_s, ahead)
            self._see(*seen, context)
            self._asked_at = measured
        moved = self._moved(measured, self._periods.since_asked_s(stamps))
        return self._command(_Moment(sectors, measured, ahead, on_map, moved), fresh, fresh and forgot)

    def _moved(self, measured: tuple[float, float], elapsed_s: float) -> NDArray[np.float64]:
        """Return how the robot has moved since the agent was asked, by the velocities then and now."""
        way = DeadReckoning()
        way.move(*self._asked_at, 0.0)
        way.move(*measured, elapsed_s)
        return way.pose

    def _see(
        self, bins: NDArray[np.float32], vectors: Sequence[float] | NDArray[np.float32], context: float | None
    ) -> Outlook:
        """Let the networks take a step, and return what they want and expect."""
        self._told = self._networks.see(bins, vectors, context)
        return self._told

    def _command(self, moment: _Moment, fresh: bool, forgot: bool) -> Command:
        outlook = self._told
        assert outlook is not None
        wish, reasons = self._wish(outlook)
        driven, limit = self._limited(wish, moment)
        if limit is not None:
            reasons.insert(0, f"limited by {limit}; it ends when the cause does")
        # Networks are told what the robot was told: the limits are part of the world.
        self._observer.note(driven, self._periods.time_s)
        quantiles, value, raw = outlook.quantiles, outlook.value, outlook.raw_quantiles
        return Command(*driven, False, "; ".join(reasons) or None, outlook.wanted, quantiles, value, fresh, forgot, raw)

    def _wish(self, outlook: Outlook) -> tuple[tuple[float, float], list[str]]:
        """Return the velocities before the guard, and in what the navigator has a hand, sentence by sentence."""
        if self._advice is not None and self._advice.instead is not None:
            return self._advice.instead, ["it stood still and backs off; the agent drives on then"]
        if self._turned_to is not None:
            return outlook.wanted, ["it stands still, so beta turns to its boldest until it gets on"]
        return outlook.wanted, []

    def _limited(self, wish: tuple[float, float], moment: _Moment) -> tuple[tuple[float, float], str | None]:
        """Return the velocities that the guard allows, and what limits them; None where nothing does."""
        if self.guard is None:
            return wish, None
        # A latency is counted from the measurement: what is allowed for there is late no more.
        guard = self.guard.later(max(0.0, self._periods.age_s - self._latency_s))
        been = None if self._advice is None else seen_from(self._advice.been, moment.moved)
        reach_m = guard.reach_m(abs(wish[0]), moment.ahead)
        v, omega, limit = guard.limit(*wish, self._known(moment, reach_m), moment.measured, been, moment.ahead)
        if moment.on_map is not None and limit:
            unmapped = self._known(moment._replace(on_map=None), reach_m)
            if not guard.limit(*wish, unmapped, moment.measured, been, moment.ahead)[2]:
                limit += " around what the map shows"
        return (v, omega), limit

    def _known(self, moment: _Moment, reach_m: float) -> Sectors:
        """Return what the stop zone minds: what is sensed, and what the navigator knows besides."""
        if self.navigator is None:
            return moment.sectors
        return self.navigator.known(moment.sectors, moment.on_map, reach_m, moment.moved)

    def refuse(self, reason: str) -> Command:
        """Return the command to stand for a reason that lies outside, and count it as bad input."""
        if self._periods.refuse():
            self._forget()
        self._observer.note((0.0, 0.0), self._periods.time_s)
        how = "resume() ends it" if self._halted else "it stands until good input comes"
        return Command(0.0, 0.0, True, f"{reason}; {how}")

    def _context(self, beta: float | None, collision_weight: float | None) -> float | None:
        """Return what the networks are told; raise where that is refused."""
        return context_of(self.config, self.default_beta if beta is None else beta, collision_weight)

    def _forget(self) -> None:
        """Forget what was seen: where the robot has got to since, nobody has told."""
        self._networks.forget()
        self._observer.forget()
        self._advice, self._turned_to = None, None
        self._asked_at = (0.0, 0.0)
        if self.navigator is not None:
            self.navigator.reset()
