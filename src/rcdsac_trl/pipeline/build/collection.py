"""What collects the episodes of a training: the choices of ``conf/collector/``."""

import contextlib
from collections.abc import Callable, Iterator, Sequence
from functools import partial

import numpy as np
import safetensors.torch
import torch
from tensordict.nn import TensorDictModuleBase, TensorDictSequential
from torchrl.collectors import Collector
from torchrl.envs.utils import ExplorationType, set_exploration_type

from rcdsac_trl.pipeline.build.agent import make_actor, make_policy
from rcdsac_trl.pipeline.build.world import environment, team
from rcdsac_trl.pipeline.collection import CollectorEpisodes, Episodes, TeamEpisodes
from rcdsac_trl.pipeline.drivers import resolve_processes
from rcdsac_trl.pipeline.policies import AgentNoise, CollectionPolicy
from rcdsac_trl.pipeline.run_settings import TrainingSettings
from rcdsac_trl.pipeline.saved import Progress
from rcdsac_trl.pipeline.team_processes import Drive, LocalTeam, Request, TeamProcesses, Teams
from rcdsac_trl.pipeline.teams import Driven
from rcdsac_trl.pipeline.validation import packed
from rcdsac_trl.world.maps import Split
from rcdsac_trl.world.spaces import AGENT_OBSERVATIONS

SPLIT: Split = "train"
# What the replay and the metrics read of a step, beside the observations.
_HAPPENED = ("contact", "goal_reached", "reward_components")


def make_episodes(settings: TrainingSettings, actor: TensorDictSequential, device: str, progress: Progress) -> Episodes:
    """Make what collects the episodes of each iteration.

    Args:
        settings: of the training.
        actor: drives, with the weights that it has when an iteration begins.
        device: where the actor is.
        progress: what is done already.
    """
    return _COLLECTORS[settings.collector.name](settings, actor, device, progress)


def _multi(settings: TrainingSettings, actor: TensorDictSequential, device: str, progress: Progress) -> Episodes:
    """Share the agents out over processes; they drive on the CPU, wherever the learner is."""
    given = settings.world
    processes = resolve_processes(settings.collector.num_processes, given.num_agents, "collector.num_processes")
    shares = [part.tolist() for part in np.array_split(np.arange(given.num_agents), max(processes, 1))]
    makes = [partial(_team, settings, agent_ids) for agent_ids in shares]
    described = [f"split {SPLIT}, seed {settings.seed}, agents {', '.join(map(str, ids))}" for ids in shares]

    def teams() -> Teams:
        if processes == 0:
            return LocalTeam(makes[0])
        return TeamProcesses(makes, described, given.worker_timeout_s)

    return TeamEpisodes(teams, lambda: packed(actor))


@contextlib.contextmanager
def _team(settings: TrainingSettings, agent_ids: Sequence[int]) -> Iterator[Drive]:
    """Make what drives some of the agents, in this process."""
    agents = team(
        settings.training_world,
        settings.algo,
        split=SPLIT,
        seed=settings.seed,
        agent_ids=agent_ids,
        memory=settings.network.memory,
    )
    actor = make_actor(settings)
    policy = _collection_policy(settings, partial(make_policy, actor, device="cpu"), agent_ids)

    def drive(request: Request, before_step: Callable[[], None]) -> Driven:
        actor.load_state_dict(safetensors.torch.load(request.weights))
        policy.set_iteration(request.iteration)
        with torch.no_grad(), set_exploration_type(ExplorationType.RANDOM):
            return agents.drive(
                policy,
                request.map_index,
                observed=AGENT_OBSERVATIONS,
                happened=_HAPPENED,
                before_step=before_step,
            )

    try:
        yield drive
    finally:
        agents.close()


def _single(settings: TrainingSettings, actor: TensorDictSequential, device: str, progress: Progress) -> Episodes:
    """Let TorchRL's own collector drive in this process, over the workers of a ``ParallelEnv`` where there are any."""
    world, schedule = settings.training_world, settings.schedule
    agent_ids = range(world.num_agents)
    policy = _collection_policy(settings, partial(make_policy, actor, device=device), agent_ids)
    iteration_steps = world.num_agents * world.task.episode_steps

    def collector(iteration: int, map_index: int) -> Collector:
        env = environment(
            world,
            settings.algo,
            split=SPLIT,
            seed=settings.seed,
            agent_ids=agent_ids,
            memory=settings.network.memory,
            first_episode=map_index,  # episode k of every agent is on map k
        )
        return Collector(
            env,
            policy,
            frames_per_batch=iteration_steps,
            total_frames=(schedule.iterations - iteration) * iteration_steps,
            exploration_type=ExplorationType.RANDOM,
            trust_policy=True,
            use_buffers=False,
        )

    done = progress.iterations
    return CollectorEpisodes(collector, policy.set_iteration, iteration=done, map_index=done + progress.skipped_maps)


def _collection_policy(
    settings: TrainingSettings, make: Callable[[AgentNoise], TensorDictModuleBase], agent_ids: Sequence[int]
) -> CollectionPolicy:
    noise = AgentNoise(agent_ids)
    return CollectionPolicy(
        make(noise),
        noise=noise,
        seed=settings.seed,
        pursuit_iterations=settings.schedule.pursuit_iterations,
        pursuit_noise=settings.schedule.pursuit_noise,
    )


_COLLECTORS = {"multi": _multi, "single": _single}
