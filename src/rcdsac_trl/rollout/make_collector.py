"""What collects the episodes of a training: the choices of ``conf/collector/``."""

import contextlib
from collections.abc import Callable, Iterator, Sequence
from functools import partial
from typing import Any

import numpy as np
import safetensors.torch
import torch
from numpy.typing import NDArray
from tensordict import TensorDict
from tensordict.nn import TensorDictModuleBase, TensorDictSequential
from torchrl.collectors import Collector
from torchrl.envs.utils import ExplorationType, set_exploration_type

from rcdsac_trl.config.training_settings import TrainingSettings
from rcdsac_trl.rollout.environments import environment, team
from rcdsac_trl.rollout.episode_collectors import CollectorEpisodes, Episodes, TeamEpisodes
from rcdsac_trl.rollout.make_agent import make_actor, make_policy, packed
from rcdsac_trl.rollout.policies import AgentNoise, CollectionPolicy
from rcdsac_trl.rollout.worker import Driven
from rcdsac_trl.rollout.worker_processes import Drive, LocalTeam, MakeDrive, Request, TeamProcesses, Teams
from rcdsac_trl.storage.checkpoint_record import Progress
from rcdsac_trl.system.cores import usable_cores
from rcdsac_trl.system.extras import needs
from rcdsac_trl.system.processes import largest_divisor, resolve_processes
from rcdsac_trl.world.maps.generator import Split
from rcdsac_trl.world.task.spaces import ACTION_SIZE, AGENT_OBSERVATIONS, SPACES

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


def check_collector(settings: TrainingSettings) -> None:
    """Refuse a collector whose package is missing.

    Raises:
        UserInputError: if it is.
    """
    if settings.collector.name == "ray":
        needs("ray", "collector=ray", extra="ray", instead="collector=multi")
    if settings.collector.slurm is not None:
        needs("submitit", "collector.slurm", extra="slurm", instead="collector.slurm=null")


def _multi(settings: TrainingSettings, actor: TensorDictSequential, device: str, progress: Progress) -> Episodes:
    """Share the agents out over processes; they drive on the CPU, wherever the learner is."""
    given = settings.world
    processes = resolve_processes(settings.collector.num_processes, given.num_agents, "collector.num_processes")

    def teams() -> Teams:
        if processes == 0:
            return LocalTeam(partial(_team, settings, range(given.num_agents)))
        shares = _shares(settings, processes)
        return TeamProcesses(list(shares.values()), list(shares), given.worker_timeout_s)

    return TeamEpisodes(teams, lambda: packed(actor))


def _ray(settings: TrainingSettings, actor: TensorDictSequential, device: str, progress: Progress) -> Episodes:
    """Share the agents out over processes of a Ray cluster; they drive on the CPU, wherever the learner is."""
    from rcdsac_trl.rollout.ray_workers import RayTeams  # imports Ray, which takes long and may not be there

    given, number = settings.world, settings.collector.num_processes
    cores = usable_cores() if number == "auto" else max(number, usable_cores())

    def shares(cores_of_cluster: int) -> dict[str, MakeDrive]:
        return _shares(settings, largest_divisor(given.num_agents, cores_of_cluster) if number == "auto" else number)

    def teams() -> Teams:
        return RayTeams(shares, address=settings.collector.address, cores=cores, timeout_s=given.worker_timeout_s)

    return TeamEpisodes(teams, lambda: packed(actor))


def _distributed(settings: TrainingSettings, actor: TensorDictSequential, device: str, progress: Progress) -> Episodes:
    """Share the agents out over processes of a group; they drive on the CPU, wherever the learner is."""
    from rcdsac_trl.rollout.distributed_workers import DistributedTeams

    given, slurm = settings.world, settings.collector.slurm
    number = settings.collector.num_processes
    processes = largest_divisor(given.num_agents, usable_cores()) if number == "auto" else number
    options: dict[str, Any] = {"slurm_cpus_per_task": 1, "slurm_gpus_per_node": 0}
    if slurm is not None:
        options |= {"timeout_min": slurm.timeout_min, "slurm_partition": slurm.partition}

    def teams() -> Teams:
        return DistributedTeams(
            _shares(settings, processes),
            _example(settings, given.num_agents // processes),
            slurm=None if slurm is None else options,
            timeout_s=given.worker_timeout_s,
        )

    return TeamEpisodes(teams, lambda: packed(actor))


def _example(settings: TrainingSettings, num_agents: int) -> TensorDict:
    """Return what a team of some agents returns, with zeros for all numbers."""

    def zeros(key: str, times: int) -> NDArray:
        return np.zeros((num_agents, times, SPACES[key].size), SPACES[key].dtype)

    steps, told = settings.task.episode_steps, settings.algo.context_key
    observed = {key: zeros(key, steps + 1) for key in AGENT_OBSERVATIONS}
    done = {key: zeros(key, steps) for key in _HAPPENED}
    done["action"] = np.zeros((num_agents, steps, ACTION_SIZE), np.float32)
    whole = {} if told is None else {told: np.zeros((num_agents, 1), np.float32)}
    return Driven(observed, done, whole).tensordict().contiguous()


def _shares(settings: TrainingSettings, processes: int) -> dict[str, MakeDrive]:
    """Share the agents out; return what makes each team, by what describes it."""
    parts = [part.tolist() for part in np.array_split(np.arange(settings.world.num_agents), processes)]
    return {
        f"split {SPLIT}, seed {settings.seed}, agents {', '.join(map(str, ids))}": partial(_team, settings, ids)
        for ids in parts
    }


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


_COLLECTORS = {"multi": _multi, "single": _single, "ray": _ray, "distributed": _distributed}
