"""The learner of a run, and its replay, from the run's settings."""

import torch

from rcdsac_trl.agent.loss.target_updates import FusedSoftUpdate
from rcdsac_trl.agent.transforms import Mirror
from rcdsac_trl.config.training_settings import TrainingSettings
from rcdsac_trl.robot.observation import vector_observations
from rcdsac_trl.rollout.make_agent import make_average, make_loss, make_optimizer, make_relabel, parameters
from rcdsac_trl.storage.sequence_replay import SequenceReplay, replay_bytes
from rcdsac_trl.training.learner import Learner


def make_learner(settings: TrainingSettings, device: str, inherited_steps: int = 0) -> Learner:
    """Make the networks and all that updates them, with an empty replay."""
    loss = make_loss(settings, device)
    sensed = torch.from_numpy(settings.sensor_mask)
    return Learner(
        replay=make_replay(settings, device, inherited_steps),
        mirror=Mirror(sensed, device) if settings.learner.mirror else None,
        loss=loss,
        relabel=make_relabel(settings),
        optimizer=make_optimizer(loss, settings.learner),
        targets=FusedSoftUpdate(loss, tau=settings.learner.target_coefficient),
        clipped=[parameters(loss.actor_network_params), parameters(loss.critic_network_params)],
        max_grad_norm=settings.learner.max_grad_norm,
        average=make_average(loss, settings.learner),
    )


def make_replay(settings: TrainingSettings, device: str, inherited_steps: int = 0) -> SequenceReplay:
    """Make the replay, empty and no larger than the run can fill beside the steps that it begins with."""
    return SequenceReplay(
        capacity_steps=settings.replay_steps(inherited_steps),
        episode_steps=settings.task.episode_steps,
        sequence_length=settings.learner.sequence_length,
        batch_size=settings.learner.batch_size,
        sensor_mask=torch.from_numpy(settings.sensor_mask),
        context_keys=_context_keys(settings),
        vectors=vector_observations(settings.sensor.memory_s),
        seed=settings.seed,
        device=device,
        collision_weight=settings.algo.fixed_weight,
    )


def replay_size_bytes(settings: TrainingSettings, steps: int) -> int:
    """Return how much memory, or disk, the replay takes when it holds so many steps."""
    bins = int(settings.sensor_mask.sum())
    vectors = vector_observations(settings.sensor.memory_s)
    return replay_bytes(steps, settings.task.episode_steps, bins, _context_keys(settings), vectors)


def _context_keys(settings: TrainingSettings) -> tuple[str, ...]:
    key = settings.algo.context_key
    return () if key is None else (key,)
