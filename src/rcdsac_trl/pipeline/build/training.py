"""A training run from its config."""

from pathlib import Path

import torch
from hydra.core.hydra_config import HydraConfig
from omegaconf import DictConfig
from tensordict.nn import TensorDictSequential
from torchrl.collectors import Collector
from torchrl.envs.utils import ExplorationType
from torchrl.objectives import SoftUpdate

from rcdsac_trl.pipeline import logs, runtime
from rcdsac_trl.pipeline.build.agent import (
    make_average,
    make_loss,
    make_optimizer,
    make_policy,
    make_relabel,
    parameters,
)
from rcdsac_trl.pipeline.build.read import training_settings
from rcdsac_trl.pipeline.build.world import environment, evaluation_environment
from rcdsac_trl.pipeline.checkpoint import Checkpoints
from rcdsac_trl.pipeline.evaluation import Validation
from rcdsac_trl.pipeline.policies import CollectionPolicy
from rcdsac_trl.pipeline.replay import SequenceReplay
from rcdsac_trl.pipeline.run_settings import TrainingSettings
from rcdsac_trl.pipeline.trainer import Learner, Trainer
from rcdsac_trl.world.lidar import sensor_mask

# Validation looks at the same maps whatever seed a run is trained with.
VALIDATION_SEED = 0


def run_folder() -> Path:
    """Return the folder Hydra made for this job."""
    return Path(HydraConfig.get().runtime.output_dir)


def check_training(cfg: DictConfig) -> None:
    """Read everything, so that what cannot work is refused before anything is written."""
    settings = training_settings(cfg)
    runtime.resolve_device(settings.device)
    logs.check_backends(settings.logger.backends)


def make_replay(settings: TrainingSettings, device: str) -> SequenceReplay:
    """Make the replay, no larger than the run can fill."""
    algo = settings.algo
    return SequenceReplay(
        capacity_steps=settings.replay_steps,
        episode_steps=settings.task.episode_steps,
        sequence_length=settings.learner.sequence_length,
        batch_size=settings.learner.batch_size,
        sensor_mask=torch.from_numpy(sensor_mask(settings.sensor.name)),
        context_keys=(algo.context_key,) if algo.context_key is not None else (),
        seed=settings.seed,
        device=device,
    )


def trainer(cfg: DictConfig, folder: Path) -> Trainer:
    """Make a training run that writes into a folder."""
    settings = training_settings(cfg)
    algo, schedule, world = settings.algo, settings.schedule, settings.training_world
    device, threads = runtime.resolve_device(settings.device), runtime.set_threads(settings.threads)
    facts = {"device": device, "threads": threads, "allocator": runtime.allocator()}
    logs.start_run_folder(folder, cfg, facts)

    loss = make_loss(settings, device)
    average = make_average(loss, settings.learner)
    optimizer = make_optimizer(loss, settings.learner)
    env = environment(
        world,
        algo,
        split="train",
        seed=settings.seed,
        agent_ids=range(world.num_agents),
        memory=settings.network.memory,
    )
    exploration = torch.Generator(device=device)
    policy = CollectionPolicy(
        make_policy(loss.actor_network, env, exploration, device),
        generator=exploration,
        seed=settings.seed,
        pursuit_iterations=schedule.pursuit_iterations,
        pursuit_noise=schedule.pursuit_noise,
    )
    collector = Collector(
        env,
        policy,
        frames_per_batch=world.num_agents * world.task.episode_steps,
        total_frames=schedule.iterations * world.num_agents * world.task.episode_steps,
        exploration_type=ExplorationType.RANDOM,
        trust_policy=True,
        use_buffers=False,
    )
    clipped = [parameters(loss.actor_network_params), parameters(loss.critic_network_params)]
    learner = Learner(
        replay=make_replay(settings, device),
        loss=loss,
        relabel=make_relabel(settings, device),
        optimizer=optimizer,
        targets=SoftUpdate(loss, tau=settings.learner.target_coefficient),
        clipped=clipped,
        max_grad_norm=settings.learner.max_grad_norm,
        average=average,
    )
    log = logs.RunLog(folder, settings.logger.backends)
    log.message(f"device {device}, {threads} threads, allocator: {runtime.allocator()}")
    return Trainer(
        schedule=schedule,
        collector=collector,
        set_iteration=policy.set_iteration,
        learner=learner,
        validate=_validation(settings, average.module, device),
        validate_every=settings.validation.every_iterations,
        checkpoints=Checkpoints(folder / "checkpoints", loss, average, optimizer),
        checkpoint_every=settings.checkpoint.every_iterations,
        log=log,
        context_key=algo.context_key,
    )


def _validation(settings: TrainingSettings, actor: TensorDictSequential, device: str) -> Validation:
    algo, world = settings.algo, settings.training_world
    conditions = algo.default_conditions
    env = evaluation_environment(
        world, algo, conditions, "validation", VALIDATION_SEED, world.num_agents, settings.network.memory
    )
    return Validation(
        env,
        make_policy(actor, env, torch.Generator(device=device), device),
        conditions=conditions,
        num_agents=world.num_agents,
        num_maps=settings.validation.num_maps,
        steps=world.task.episode_steps,
        seed=VALIDATION_SEED,
    )
