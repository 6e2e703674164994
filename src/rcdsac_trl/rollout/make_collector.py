"""What collects the episodes of a training: the choices of ``conf/collector/``."""

import contextlib
from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from functools import partial

import numpy as np
import safetensors.torch
import torch
from tensordict.nn import TensorDictModuleBase, TensorDictSequential
from torchrl.collectors import Collector
from torchrl.envs import EnvBase
from torchrl.envs.utils import ExplorationType, set_exploration_type

from rcdsac_trl.config.training_settings import TrainingSettings
from rcdsac_trl.rollout.env_workers import EnvWorkers
from rcdsac_trl.rollout.environments import environment, rollout_worker
from rcdsac_trl.rollout.episode_collectors import EpisodeCollector, TorchRLEpisodeCollector, WorkerEpisodeCollector
from rcdsac_trl.rollout.make_agent import make_actor, make_policy, packed
from rcdsac_trl.rollout.metrics import HAPPENED
from rcdsac_trl.rollout.policies import AgentNoise, CollectionPolicy
from rcdsac_trl.rollout.worker import EpisodeBatch
from rcdsac_trl.rollout.worker_processes import (
    Drive,
    LocalWorker,
    MakeDrive,
    RolloutRequest,
    WorkerGroup,
    WorkerProcesses,
)
from rcdsac_trl.system.cores import usable_cores
from rcdsac_trl.system.processes import largest_divisor, resolve_num_workers, resolve_processes
from rcdsac_trl.world.maps.generator import Split
from rcdsac_trl.world.task.world_settings import WorldSettings

SPLIT: Split = "train"


def make_episodes(settings: TrainingSettings, actor: TensorDictSequential, device: str) -> EpisodeCollector:
    """Make what collects the episodes of each iteration.

    Args:
        settings: of the training.
        actor: drives, with the weights that it has when an iteration begins.
        device: where the actor is.
    """
    return _COLLECTORS[settings.collector.name](settings, actor, device)


def _multi(settings: TrainingSettings, actor: TensorDictSequential, device: str) -> EpisodeCollector:
    """Share the agents out over processes; they drive on the CPU, wherever the learner is."""
    given = settings.world
    processes = resolve_processes(settings.collector.num_processes, given.num_agents, "collector.num_processes")

    def group() -> WorkerGroup:
        if processes == 0:
            return LocalWorker(partial(_worker, settings, range(given.num_agents)))
        shares = _shares(settings, processes)
        return WorkerProcesses(list(shares.values()), list(shares), given.worker_timeout_s)

    return WorkerEpisodeCollector(group, lambda: packed(actor))


def _ray(settings: TrainingSettings, actor: TensorDictSequential, device: str) -> EpisodeCollector:
    """Share the agents out over processes of a Ray cluster; they drive on the CPU, wherever the learner is."""
    from rcdsac_trl.rollout.ray_workers import RayWorkers  # imports Ray, which takes long and may not be there

    given, number = settings.world, settings.collector.num_processes
    cores = usable_cores() if number == "auto" else max(number, usable_cores())

    def shares(cores_of_cluster: int) -> dict[str, MakeDrive]:
        return _shares(settings, largest_divisor(given.num_agents, cores_of_cluster) if number == "auto" else number)

    def group() -> WorkerGroup:
        return RayWorkers(shares, address=settings.collector.address, cores=cores, timeout_s=given.worker_timeout_s)

    return WorkerEpisodeCollector(group, lambda: packed(actor))


def _shares(settings: TrainingSettings, processes: int) -> dict[str, MakeDrive]:
    """Share the agents out; return what makes each worker, by what describes it."""
    parts = [part.tolist() for part in np.array_split(np.arange(settings.world.num_agents), processes)]
    return {
        f"split {SPLIT}, seed {settings.seed}, agents {', '.join(map(str, ids))}": partial(_worker, settings, ids)
        for ids in parts
    }


@contextlib.contextmanager
def _worker(settings: TrainingSettings, agent_ids: Sequence[int]) -> Iterator[Drive]:
    """Make what drives some of the agents, in this process."""
    agents = rollout_worker(
        settings.training_world,
        settings.algo,
        split=SPLIT,
        seed=settings.seed,
        agent_ids=agent_ids,
        state_size=settings.network.state_size,
    )
    with contextlib.closing(agents):
        actor = make_actor(settings)
        policy = _collection_policy(settings, partial(make_policy, actor, device="cpu"), agent_ids)

        def drive(request: RolloutRequest, before_step: Callable[[], None]) -> EpisodeBatch:
            actor.load_state_dict(safetensors.torch.load(request.weights))
            policy.set_iteration(request.iteration)
            with torch.no_grad(), set_exploration_type(ExplorationType.RANDOM):
                return agents.rollout(
                    policy,
                    request.map_index,
                    observed=agents.env.agents.observations,
                    happened=HAPPENED,
                    before_step=before_step,
                )

        yield drive


def _by_torchrl(settings: TrainingSettings, actor: TensorDictSequential, device: str) -> EpisodeCollector:
    """Let TorchRL's own collector drive in this process, over the workers of a ``ParallelEnv`` where there are any."""
    world, schedule = settings.training_world, settings.schedule
    agent_ids = range(world.num_agents)
    policy = _collection_policy(settings, partial(make_policy, actor, device=device), agent_ids)
    iteration_steps = world.num_agents * world.task.episode_steps

    def env(map_index: int, of: WorldSettings) -> EnvBase:
        return environment(
            of,
            settings.algo,
            split=SPLIT,
            seed=settings.seed,
            agent_ids=agent_ids,
            state_size=settings.network.state_size,
            first_episode=map_index,  # episode k of every agent is on map k
        )

    def begin(map_index: int) -> None:
        with contextlib.closing(env(map_index, replace(world, num_workers=0))) as begun:
            begun.reset()

    def collector(iteration: int, map_index: int) -> Collector:
        return Collector(
            env(map_index, world),
            policy,
            frames_per_batch=iteration_steps,
            total_frames=(schedule.iterations - iteration) * iteration_steps,
            exploration_type=ExplorationType.RANDOM,
            trust_policy=True,
            use_buffers=False,
        )

    workers = resolve_num_workers(world.num_workers, world.num_agents)
    described = list(_shares(settings, workers)) if workers else []
    return TorchRLEpisodeCollector(
        collector,
        policy.set_iteration,
        workers=EnvWorkers(described, world.worker_timeout_s),
        begin=begin,
    )


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
        robot=settings.robot,
    )


_COLLECTORS = {"multi": _multi, "parallel_env": _by_torchrl, "single": _by_torchrl, "ray": _ray}
