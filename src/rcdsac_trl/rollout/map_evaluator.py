"""What drives whole maps, for an evaluation and for validation, in this process or in one of its own."""

import contextlib
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field
from functools import partial
from typing import NamedTuple

import safetensors.torch
import torch
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModuleBase
from torch import Tensor

from rcdsac_trl.config.baseline_name import PURSUIT
from rcdsac_trl.config.conditions import Condition
from rcdsac_trl.config.evaluation_settings import ControllerSettings
from rcdsac_trl.config.navigation_settings import EvaluationNavigationSettings
from rcdsac_trl.config.training_settings import TrainingSettings
from rcdsac_trl.deploy.navigation.navigator import Navigator, NavigatorSettings
from rcdsac_trl.deploy.policy.acting import BY_MEAN, ActingSettings
from rcdsac_trl.deploy.policy.beta_controllers import BetaController, ClearanceBeta, FixedBeta, TailVarianceBeta
from rcdsac_trl.robot.compiled_guard import CompiledGuard
from rcdsac_trl.rollout.beta_control import AdaptivePolicy
from rcdsac_trl.rollout.choosing_policy import ChoosingPolicy
from rcdsac_trl.rollout.collisions import COLLISIONS, CollisionRecorder
from rcdsac_trl.rollout.environments import evaluation_worker
from rcdsac_trl.rollout.evaluation_pool import Drive, Rows
from rcdsac_trl.rollout.foresight import ForesightedPolicy
from rcdsac_trl.rollout.make_agent import make_actor, make_policy, unpacked_loss
from rcdsac_trl.rollout.measurement import measure_map
from rcdsac_trl.rollout.navigation import NavigatedPolicy
from rcdsac_trl.rollout.navigation_metrics import navigation_metrics
from rcdsac_trl.rollout.planners.baselines import baseline_policy
from rcdsac_trl.rollout.planners.controller import ControllerPolicy
from rcdsac_trl.rollout.policies import AgentNoise
from rcdsac_trl.rollout.quantile_predictor import QuantilePredictor
from rcdsac_trl.rollout.timed import Timed
from rcdsac_trl.rollout.worker import RolloutWorker
from rcdsac_trl.system import runtime
from rcdsac_trl.world.maps.generator import Split
from rcdsac_trl.world.task.episode import draw_motor_steps, load_map
from rcdsac_trl.world.task.world_settings import WorldSettings

Wrap = Callable[[RolloutWorker, TensorDictModuleBase], TensorDictModuleBase]
"""Makes the policy that drives a worker of the one that would."""
Measure = Callable[[int, TensorDictBase], dict[str, Tensor]]
"""Measures the episodes of the map of a number, ``[N]`` a column."""


@dataclass(frozen=True)
class EvaluationSpec:
    """What is driven, and how; it pickles.

    Attributes:
        trained: settings of the run's training.
        world: what is driven in, without worker processes.
        conditions: what the agents of each block are told.
        split: which maps.
        seed: root seed of the maps, and of the noise of sampled actions.
        num_episodes: episodes a map and a condition.
        sampled: draw actions instead of taking tanh(mean).
        device: where the policy acts.
        threads: that torch uses for one operation while it drives.
        detailed: measure the ways driven and say of each collision what was hit, too.
        controller: settings of controllers, which then tell all agents beta; None: nothing turns it.
        baseline: what drives where there is no actor.
        one_trip: drive to the first goal alone; see :func:`~rcdsac_trl.rollout.measurement.measure_map`.
        navigation: what navigates around the agents.
        latency_s: that the agents allow for, s.
        acting: by tanh(mean) or by the critics' choice.
    """

    trained: TrainingSettings
    world: WorldSettings
    conditions: Sequence[Condition]
    split: Split
    seed: int
    num_episodes: int
    sampled: bool
    device: str
    threads: int
    detailed: bool = False
    controller: ControllerSettings | None = None
    baseline: str = PURSUIT
    one_trip: bool = False
    navigation: EvaluationNavigationSettings = field(default_factory=EvaluationNavigationSettings)
    latency_s: float = 0.0
    acting: ActingSettings = BY_MEAN


class Agent(NamedTuple):
    """A trained agent as bytes, which go from process to process.

    Attributes:
        actor: the actor that drives, packed.
        loss: the loss with its critics, packed.
    """

    actor: bytes
    loss: bytes


@contextlib.contextmanager
def map_evaluator(
    spec: EvaluationSpec, actor: bytes | None, loss: bytes | None = None, *, wrap: Wrap | None = None
) -> Iterator[Drive]:
    """Make what drives one map after another, in this process.

    Args:
        spec: what is driven.
        actor: the actor's weights, packed; None: the baseline drives, which is told nothing.
        loss: the loss with the critics, packed; read where these choose actions, or a condition's controller needs
            their quantiles.
        wrap: puts something around the policy, which may change nothing of what it does.
    """
    with contextlib.ExitStack() as stack:
        stack.callback(torch.set_num_threads, torch.get_num_threads())
        runtime.set_threads(spec.threads)
        worker = stack.enter_context(contextlib.closing(_worker(spec, told=actor is not None)))
        noise = AgentNoise(_agent_ids(spec))
        driver = _baseline(spec) if actor is None else _agent(spec, actor, loss, noise)
        planner = driver if isinstance(driver, ControllerPolicy) else None
        policy, timed, more = _wrapped(spec, driver, loss)
        if wrap is not None:
            policy = wrap(worker, policy)

        def drive(map_index: int, before_step: Callable[[], None]) -> Rows:
            # By the map's number, so that it does not matter which process drives it.
            noise.begin(spec.seed, "evaluation actions", map_index)
            if planner is not None:
                planner.set_map(map_index)
            periods_s = _periods_s(spec, map_index).tolist()
            for each in timed:
                each.set_periods(periods_s)
            return measure_map(
                worker,
                policy,
                conditions=spec.conditions,
                num_agents=spec.num_episodes,
                map_index=map_index,
                sampled=spec.sampled,
                controlled=spec.controller is not None,
                one_trip=spec.one_trip,
                before_step=before_step,
                more=partial(_all, more, map_index) if more else None,
            )

        yield partial(_with_collisions, spec, worker, drive) if spec.detailed else drive


def _worker(spec: EvaluationSpec, *, told: bool) -> RolloutWorker:
    """Make the agents of all conditions; a baseline's are told nothing."""
    algo = spec.trained.algo if told else None
    state_size = spec.trained.network.state_size
    return evaluation_worker(spec.world, algo, spec.conditions, spec.split, spec.seed, spec.num_episodes, state_size)


def _agent_ids(spec: EvaluationSpec) -> list[int]:
    """Number the episodes of every condition alike: what an episode draws is the same under each, in any order."""
    return [*range(spec.num_episodes)] * len(spec.conditions)


def _baseline(spec: EvaluationSpec) -> TensorDictModuleBase:
    return baseline_policy(
        spec.baseline, sensor=spec.world.sensor, agent_ids=_agent_ids(spec), seed=spec.seed, robot=spec.world.robot
    )


def _agent(spec: EvaluationSpec, actor: bytes, loss: bytes | None, noise: AgentNoise) -> TensorDictModuleBase:
    """Make the policy of an agent, which acts by its mean or by its critics' choice."""
    module = make_actor(spec.trained)
    module.load_state_dict(safetensors.torch.load(actor))
    policy = make_policy(module.to(spec.device), noise, spec.device)
    return _choosing(spec, policy, loss) if spec.acting.chooses else policy


def _wrapped(
    spec: EvaluationSpec, policy: TensorDictModuleBase, loss: bytes | None
) -> tuple[TensorDictModuleBase, list[Timed], list[Measure]]:
    """Put around a policy what the evaluation asks for: foresight, navigators, controllers of beta.

    Returns:
        The policy, what is to be told how long its agents' steps take, and what measures more than every map is.
    """
    number = len(_agent_ids(spec))
    timed: list[Timed] = [policy] if isinstance(policy, ControllerPolicy) else []
    more: list[Measure] = [partial(_trips, spec)] if spec.detailed else []
    if spec.latency_s:
        policy = _foresighted(spec, policy, number)
        timed.append(policy)
    if spec.navigation.is_on:
        policy = _navigated(spec, policy, number)
        timed.append(policy)
    if spec.controller is not None:
        policy = adaptive = _adaptive(spec, spec.controller, policy, loss)
        more.append(lambda *_: {"mean_beta": adaptive.mean_betas()})
    return policy, timed, more


def _choosing(spec: EvaluationSpec, policy: TensorDictModuleBase, loss: bytes | None) -> ChoosingPolicy:
    """Let the critics choose among actions around those of a policy."""
    assert loss is not None
    algo = spec.trained.algo
    return ChoosingPolicy(
        policy,
        unpacked_loss(spec.trained, loss).critics,
        spec.acting,
        measure=algo.distortion.measure,
        beta=algo.beta,
        num_agents=spec.num_episodes * len(spec.conditions),
    )


def _navigated(spec: EvaluationSpec, policy: TensorDictModuleBase, num_agents: int) -> NavigatedPolicy:
    """Put navigators around the agents of a policy, and a stop zone behind them."""
    asked, algo, robot = spec.navigation, spec.trained.algo, spec.world.robot
    return NavigatedPolicy(
        policy,
        partial(Navigator, NavigatorSettings.switched(replan=asked.replan, watchdog=asked.watchdog), robot),
        robot.sensor_mask(spec.world.sensor),
        num_agents,
        boldest=algo.distortion.measure.high if asked.watchdog and algo.context_key == "risk" else None,
        robot=robot,
        guard=CompiledGuard.of(robot) if asked.stop_zone else None,
    )


def _foresighted(spec: EvaluationSpec, policy: TensorDictModuleBase, num_agents: int) -> ForesightedPolicy:
    """Let the agents of a policy allow for a latency."""
    world = spec.world
    sensed = world.robot.sensor_mask(world.sensor)
    return ForesightedPolicy(policy, spec.latency_s, sensed, world.memory_s, num_agents, world.robot)


def _all(measures: Sequence[Measure], map_index: int, episodes: TensorDictBase) -> dict[str, Tensor]:
    return {name: value for measure in measures for name, value in measure(map_index, episodes).items()}


def _with_collisions(
    spec: EvaluationSpec, worker: RolloutWorker, drive: Drive, map_index: int, before_step: Callable[[], None]
) -> Rows:
    """Drive a map, and put the collisions of each episode into its row."""
    recorder = CollisionRecorder(worker.env.agents)

    def noted() -> None:
        before_step()
        recorder.note()

    rows = drive(map_index, noted)
    recorder.note()  # what the last step led to
    robot = spec.world.robot
    map_, _ = load_map(spec.world.map_settings, spec.split, spec.seed, map_index, robot.circumradius_m)
    mask = robot.sensor_mask(spec.world.sensor)
    found = recorder.collisions(map_, mask, _periods_s(spec, map_index).tolist(), robot)
    return [row | {COLLISIONS: collisions} for row, collisions in zip(rows, found, strict=True)]


def _adaptive(
    spec: EvaluationSpec, settings: ControllerSettings, policy: TensorDictModuleBase, loss: bytes | None
) -> AdaptivePolicy:
    """Let controllers tell the agents beta, also those whose beta is fixed."""
    betas = [condition.beta for condition in spec.conditions if condition.beta is not None]
    low, high = min(betas), max(betas)
    controllers: list[BetaController] = []
    for condition in spec.conditions:
        for _ in range(spec.num_episodes):
            if condition.beta is not None:
                controllers.append(FixedBeta(condition.beta))
            elif condition.controller == "clearance":
                # What the agent does not see is not among its observations.
                controllers.append(_clearance_beta(low, high, settings, spec))
            else:
                controllers.append(TailVarianceBeta(low, high, window_steps=settings.window_steps))
    readers = [row for row, controller in enumerate(controllers) if isinstance(controller, TailVarianceBeta)]
    predictor = None
    if readers:
        assert loss is not None
        predictor = QuantilePredictor(unpacked_loss(spec.trained, loss).critics, readers)
    return AdaptivePolicy(policy, controllers, predictor, spec.world.robot.lidar.max_range_m)


def _clearance_beta(low: float, high: float, settings: ControllerSettings, spec: EvaluationSpec) -> ClearanceBeta:
    return ClearanceBeta(low, high, near_m=settings.near_m, far_m=settings.far_m, robot=spec.world.robot)


def _trips(spec: EvaluationSpec, map_index: int, episodes: TensorDictBase) -> dict[str, Tensor]:
    """Measure the ways of the episodes on a map."""
    world = spec.world
    _, planner = load_map(world.map_settings, spec.split, spec.seed, map_index, world.robot.circumradius_m)
    return navigation_metrics(episodes, planner, _periods_s(spec, map_index))


def _periods_s(spec: EvaluationSpec, map_index: int) -> Tensor:
    """Return the length of an agent step in each episode on a map, ``[N]``, s."""
    agents = range(spec.num_episodes)
    steps = [draw_motor_steps(spec.world.task, spec.split, spec.seed, map_index, agent) for agent in agents]
    return spec.world.robot.motor_period_s * torch.tensor(
        steps * len(spec.conditions), dtype=torch.float64, device="cpu"
    )
