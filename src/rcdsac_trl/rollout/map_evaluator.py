"""What drives whole maps, for an evaluation and for validation, in this process or in one of its own."""

import contextlib
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from functools import partial
from typing import NamedTuple

import safetensors.torch
import torch
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModuleBase
from torch import Tensor

from rcdsac_trl.config.conditions import Condition
from rcdsac_trl.config.evaluation_settings import ControllerSettings
from rcdsac_trl.config.training_settings import TrainingSettings
from rcdsac_trl.deploy.policy.beta_controllers import BetaController, ClearanceBeta, FixedBeta, TailVarianceBeta
from rcdsac_trl.robot.limits import MOTOR_PERIOD_S
from rcdsac_trl.rollout.beta_control import AdaptivePolicy
from rcdsac_trl.rollout.environments import evaluation_team
from rcdsac_trl.rollout.evaluation_pool import Drive, Rows
from rcdsac_trl.rollout.make_agent import make_actor, make_policy, unpacked_loss
from rcdsac_trl.rollout.measurement import measure_map
from rcdsac_trl.rollout.navigation_metrics import trip_metrics
from rcdsac_trl.rollout.planners.baselines import PURSUIT, baseline_policy
from rcdsac_trl.rollout.planners.controller import ControllerPolicy
from rcdsac_trl.rollout.policies import AgentNoise
from rcdsac_trl.rollout.quantile_predictor import QuantilePredictor
from rcdsac_trl.rollout.worker import Team
from rcdsac_trl.system import runtime
from rcdsac_trl.world.maps.generator import Split
from rcdsac_trl.world.task.episode import draw_motor_steps, load_map
from rcdsac_trl.world.task.world_settings import WorldSettings

Wrap = Callable[[Team, TensorDictModuleBase], TensorDictModuleBase]
"""Makes the policy that drives a team of the one that would."""
Measure = Callable[[int, TensorDictBase], dict[str, Tensor]]
"""Measures the episodes of the map of a number, ``[N]`` a column."""


@dataclass(frozen=True)
class Course:
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
        trips: measure the ways driven, too.
        controller: settings of controllers, which then tell all agents beta; None: nothing turns it.
        baseline: what drives where there is no actor.
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
    trips: bool = False
    controller: ControllerSettings | None = None
    baseline: str = PURSUIT


class Agent(NamedTuple):
    """A trained agent as bytes, which go from process to process.

    Attributes:
        actor: the actor that drives, packed.
        loss: the loss with its critics, packed.
    """

    actor: bytes
    loss: bytes


@contextlib.contextmanager
def driver(
    course: Course, actor: bytes | None, loss: bytes | None = None, *, wrap: Wrap | None = None
) -> Iterator[Drive]:
    """Make what drives one map after another, in this process.

    Args:
        course: what is driven.
        actor: the actor's weights, packed; None: the baseline drives, which is told nothing.
        loss: the loss with the critics, packed; read where a condition's controller needs their quantiles.
        wrap: puts something around the policy, which may change nothing of what it does.
    """
    threads = torch.get_num_threads()
    runtime.set_threads(course.threads)
    algo = None if actor is None else course.trained.algo
    memory = course.trained.network.memory
    team = evaluation_team(
        course.world, algo, course.conditions, course.split, course.seed, course.num_episodes, memory
    )
    # An episode's noise is its own: the same under every condition, whichever they are and in whatever order.
    agent_ids = [*range(course.num_episodes)] * len(course.conditions)
    noise = AgentNoise(agent_ids)
    if actor is None:
        policy = baseline_policy(course.baseline, sensor=course.world.sensor, agent_ids=agent_ids, seed=course.seed)
    else:
        policy = _policy(course, actor, noise)
    planner = policy if isinstance(policy, ControllerPolicy) else None
    more: list[Measure] = [partial(_trips, course)] if course.trips else []
    if course.controller is not None:
        policy = adaptive = _adaptive(course, course.controller, policy, loss)
        more.append(lambda *_: {"mean_beta": adaptive.mean_betas()})
    if wrap is not None:
        policy = wrap(team, policy)

    def drive(map_index: int, before_step: Callable[[], None]) -> Rows:
        # By the map's number, so that it does not matter which process drives it.
        noise.begin(course.seed, "evaluation actions", map_index)
        if planner is not None:
            planner.set_map(map_index)
        return measure_map(
            team,
            policy,
            conditions=course.conditions,
            num_agents=course.num_episodes,
            map_index=map_index,
            sampled=course.sampled,
            controlled=course.controller is not None,
            before_step=before_step,
            more=partial(_all, more, map_index) if more else None,
        )

    try:
        yield drive
    finally:
        team.close()
        torch.set_num_threads(threads)


def _all(measures: Sequence[Measure], map_index: int, episodes: TensorDictBase) -> dict[str, Tensor]:
    return {name: value for measure in measures for name, value in measure(map_index, episodes).items()}


def _adaptive(
    course: Course, settings: ControllerSettings, policy: TensorDictModuleBase, loss: bytes | None
) -> AdaptivePolicy:
    """Let controllers tell the agents beta, also those whose beta is fixed."""
    betas = [condition.beta for condition in course.conditions if condition.beta is not None]
    low, high = min(betas), max(betas)
    controllers: list[BetaController] = []
    for condition in course.conditions:
        for _ in range(course.num_episodes):
            if condition.beta is not None:
                controllers.append(FixedBeta(condition.beta))
            elif condition.controller == "clearance":
                # What the agent does not see is not among its observations.
                controllers.append(ClearanceBeta(low, high, near_m=settings.near_m, far_m=settings.far_m))
            else:
                controllers.append(TailVarianceBeta(low, high, window_steps=settings.window_steps))
    readers = [row for row, controller in enumerate(controllers) if isinstance(controller, TailVarianceBeta)]
    predictor = None
    if readers:
        assert loss is not None
        predictor = QuantilePredictor(unpacked_loss(course.trained, loss).critics, readers)
    return AdaptivePolicy(policy, controllers, predictor)


def _trips(course: Course, map_index: int, episodes: TensorDictBase) -> dict[str, Tensor]:
    """Measure the ways of the episodes on a map."""
    task = course.world.task
    _, planner = load_map(course.world.map_settings, course.split, course.seed, map_index)
    agents = range(course.num_episodes)
    steps = [draw_motor_steps(task, course.split, course.seed, map_index, agent) for agent in agents]
    period_s = MOTOR_PERIOD_S * torch.tensor(steps * len(course.conditions), dtype=torch.float64, device="cpu")
    return trip_metrics(episodes, planner, period_s)


def _policy(course: Course, actor: bytes, noise: AgentNoise) -> TensorDictModuleBase:
    module = make_actor(course.trained)
    module.load_state_dict(safetensors.torch.load(actor))
    return make_policy(module.to(course.device), noise, course.device)
