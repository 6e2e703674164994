"""A training run from its config."""

from collections.abc import Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path

import torch
from hydra.core.hydra_config import HydraConfig
from omegaconf import DictConfig
from tensordict import TensorDict
from torchrl.objectives import LossModule, SoftUpdate

from rcdsac_trl.agent.kernels import matmul
from rcdsac_trl.agent.loss.target_updates import FusedSoftUpdate
from rcdsac_trl.agent.transforms import Mirror
from rcdsac_trl.config.run_config import CHECKPOINTS, REPLAY, settings_of_new_run, settings_of_run, with_map_digests
from rcdsac_trl.config.training_settings import TrainingSettings
from rcdsac_trl.robot.observation import vector_observations
from rcdsac_trl.rollout.make_agent import make_average, make_loss, make_optimizer, make_relabel, packed, parameters
from rcdsac_trl.rollout.make_collector import make_episodes
from rcdsac_trl.rollout.map_evaluator import EvaluationSpec, map_evaluator
from rcdsac_trl.storage.atomic import FolderLock
from rcdsac_trl.storage.checkpoint import Checkpoints, Generators, load_average, rotate
from rcdsac_trl.storage.checkpoint_record import DamagedError, Progress, Saved, best_damage, folder_name, newest
from rcdsac_trl.storage.replay_files import ReplayFiles
from rcdsac_trl.storage.sequence_replay import SequenceReplay, replay_bytes
from rcdsac_trl.system import resources, runtime
from rcdsac_trl.system.cores import usable_cores
from rcdsac_trl.system.processes import check_may_start_processes, resolve_processes, resolve_processes_beside
from rcdsac_trl.training.learner import Learner
from rcdsac_trl.training.nan_guard import FiniteGuard, load_failure
from rcdsac_trl.training.restart_budget import RestartBudget
from rcdsac_trl.training.run_folder import check_folder, cut, has_begun, start_run_folder
from rcdsac_trl.training.run_log import RunLog
from rcdsac_trl.training.trainer import IterationHook, Trainer, saved_sentence
from rcdsac_trl.training.validation import Snapshot, SnapshotEvaluator, Validation
from rcdsac_trl.training.warm_start import EndedRun, begin_with_agent, ended_run, go_on
from rcdsac_trl.world.maps.map_source import check_maps
from rcdsac_trl.world.sim.simulation import SIMULATION_BYTES

# Validation looks at the same maps whatever seed a run is trained with.
VALIDATION_SEED = 0


def run_folder() -> Path:
    """Return the folder Hydra made for this job."""
    return Path(HydraConfig.get().runtime.output_dir)


def given_overrides() -> list[str]:
    """Return the overrides Hydra was given for this job, without those of Hydra itself."""
    return list(HydraConfig.get().overrides.task)


def check_training(cfg: DictConfig) -> TrainingSettings:
    """Read everything, so that what cannot work is refused before anything is written.

    Raises:
        UserInputError: for whatever cannot work, or not on this machine.
    """
    settings = settings_of_new_run(cfg)
    check_machine(settings)
    return settings


def check_machine(settings: TrainingSettings) -> None:
    """Refuse what cannot be done here: there is no such device, too little memory, or no leave to start processes.

    Raises:
        UserInputError: naming what there is.
    """
    runtime.resolve_device(settings.device)
    _check_processes(settings)
    _check_memory(settings, _inherited_steps(settings, ended_run(settings)))


def _check_processes(settings: TrainingSettings) -> None:
    """Refuse processes where none may be started, those of validation before hours of training too."""
    threads = runtime.resolve_threads(settings.threads)
    of_validation = resolve_processes_beside(settings.validation.processes, settings.validation.num_maps, threads)
    collecting = resolve_processes(settings.collector.num_processes, settings.world.num_agents)
    if of_validation or collecting or settings.training_world.num_workers:
        check_may_start_processes()


def _check_memory(settings: TrainingSettings, inherited_steps: int) -> None:
    """Refuse what surely does not fit; of a mini-batch its range observations alone are counted."""
    learner, others = settings.learner, "or end other programs"
    replay = _replay_bytes(settings, settings.replay_steps(inherited_steps))
    resources.check_memory("the replay", replay, f"lower replay.capacity_steps, {others}")
    observations = learner.batch_size * (learner.sequence_length + 1)
    batch_bytes = observations * settings.sensor_mask.size * torch.float32.itemsize
    resources.check_memory("a mini-batch", batch_bytes, f"lower learner.batch_size, {others}")
    # Those of the training stay while a map is validated.
    simulations = settings.world.num_agents * (1 + len(settings.algo.default_conditions))
    needed_bytes = simulations * SIMULATION_BYTES
    resources.check_memory(f"{simulations} simulations", needed_bytes, f"lower world.num_agents, {others}")


def _inherited_steps(settings: TrainingSettings, ended: EndedRun | None) -> int:
    """Return how many steps the replay of a new run begins with."""
    return 0 if ended is None else ended.replay_episodes * settings.task.episode_steps


def _inherited_steps_of(settings: TrainingSettings, saved: Saved) -> int:
    """Return how many steps the replay of a run had begun with, from what it has added and driven since."""
    added = saved.segments[-1].end * settings.task.episode_steps if saved.segments else 0
    return added - saved.progress.steps


def _replay_bytes(settings: TrainingSettings, steps: int) -> int:
    algo = settings.algo
    keys = (algo.context_key,) if algo.context_key is not None else ()
    bins = int(settings.sensor_mask.sum())
    vectors = vector_observations(settings.sensor.memory_s)
    return replay_bytes(steps, settings.task.episode_steps, bins, keys, vectors)


def make_replay(settings: TrainingSettings, device: str, inherited_steps: int = 0) -> SequenceReplay:
    """Make the replay, empty and no larger than the run can fill beside the steps that it begins with."""
    algo = settings.algo
    return SequenceReplay(
        capacity_steps=settings.replay_steps(inherited_steps),
        episode_steps=settings.task.episode_steps,
        sequence_length=settings.learner.sequence_length,
        batch_size=settings.learner.batch_size,
        sensor_mask=torch.from_numpy(settings.sensor_mask),
        context_keys=(algo.context_key,) if algo.context_key is not None else (),
        vectors=vector_observations(settings.sensor.memory_s),
        seed=settings.seed,
        device=device,
    )


def make_learner(settings: TrainingSettings, device: str, inherited_steps: int = 0) -> Learner:
    """Make the networks and all that updates them, with an empty replay."""
    loss = make_loss(settings, device)
    sensed = torch.from_numpy(settings.sensor_mask)
    return Learner(
        replay=make_replay(settings, device, inherited_steps),
        mirror=Mirror(sensed, device) if settings.learner.mirror else None,
        loss=loss,
        relabel=make_relabel(settings, device),
        optimizer=make_optimizer(loss, settings.learner),
        targets=FusedSoftUpdate(loss, tau=settings.learner.target_coefficient),
        clipped=[parameters(loss.actor_network_params), parameters(loss.critic_network_params)],
        max_grad_norm=settings.learner.max_grad_norm,
        average=make_average(loss, settings.learner),
    )


def make_trainer(
    cfg: DictConfig,
    folder: Path,
    overrides: Sequence[str] = (),
    *,
    on_iteration_end: IterationHook | None = None,
) -> Trainer:
    """Make a new training run that writes into a folder.

    Args:
        cfg: of the run.
        folder: made if it is not there.
        overrides: that made the config; noted for whoever continues the run.
        on_iteration_end: called after every iteration with the trainer and the iteration's scalars.

    Raises:
        UserInputError: as :func:`check_training`, or if another process trains in the folder, or it holds a run.
    """
    cfg = with_map_digests(cfg)
    settings = check_training(cfg)
    facts = {
        "overrides": list(overrides),
        "device": runtime.resolve_device(settings.device),
        "threads": runtime.resolve_threads(settings.threads),
        "allocator": runtime.allocator(),
        "matrix_products": matmul.LIBRARY,
    }
    check_folder(folder)
    # Before anything is written: it may not fit into the memory, or not be that of `init`.
    learner, progress, messages = _begin(settings)
    folder.mkdir(parents=True, exist_ok=True)
    lock = FolderLock(folder)
    try:
        start_run_folder(folder, cfg, facts)
        return _assemble(settings, learner, folder, lock, progress, messages, on_iteration_end)
    except BaseException:
        lock.close()
        raise


def resume_training(folder: Path, *, on_iteration_end: IterationHook | None = None) -> Trainer | None:
    """Make the trainer that continues a run in its folder, as its config says; None if the run is finished.

    Raises:
        UserInputError: if another process trains in it, or it has checkpoints and none is whole.
    """
    settings = settings_of_run(folder, key="resume")
    resources.check_writable(folder)
    settings.collector.check_package()
    check_maps(settings.map, settings.task.min_path_m, settings.robot.circumradius_m)
    _check_processes(settings)
    lock = FolderLock(folder)
    try:
        saved, damaged = newest(folder / CHECKPOINTS, replay=folder / REPLAY) if has_begun(folder) else (None, [])
        if saved is not None and saved.progress.iterations == settings.schedule.iterations:
            if not damaged:  # it may have died after its last checkpoint, before what is then too old was removed
                rotate(folder / CHECKPOINTS, keep=settings.checkpoint.keep, replay=folder / REPLAY)
            lock.close()
            return None
        if saved is None:
            _check_memory(settings, _inherited_steps(settings, ended_run(settings)))
            learner, progress, messages = _begin(settings)
            return _assemble(settings, learner, folder, lock, progress, messages, on_iteration_end)
        inherited_steps = _inherited_steps_of(settings, saved)
        _check_memory(settings, inherited_steps)
        learner = _learner_here(settings, inherited_steps)
        return _assemble(settings, learner, folder, lock, saved, damaged, on_iteration_end)
    except BaseException:
        lock.close()
        raise


def reproduce_failure(dump: Path) -> tuple[LossModule, TensorDict]:
    """Make what shows a NaN or an infinity again: called with the batch, the loss returns what it returned then.

    Args:
        dump: a folder below ``failure/`` of a run folder.
    """
    settings = settings_of_run(dump.parents[1])
    loss = make_loss(settings, "cpu")
    SoftUpdate(loss, tau=settings.learner.target_coefficient)  # TorchRL warns of targets that nothing moves
    return loss, load_failure(dump, loss)


def _learner_here(settings: TrainingSettings, inherited_steps: int) -> Learner:
    """Make the learner with the threads and on the device that this machine gives the run."""
    runtime.set_threads(settings.threads)
    return make_learner(settings, runtime.resolve_device(settings.device), inherited_steps)


def _begin(settings: TrainingSettings) -> tuple[Learner, Progress, list[str]]:
    """Make the learner of a new run, where that begins, and say what `init` gave it."""
    ended = ended_run(settings)
    learner = _learner_here(settings, _inherited_steps(settings, ended))
    if settings.init is None:
        return learner, Progress(), []
    if ended is None:
        return learner, Progress(), [begin_with_agent(learner, settings)]
    return learner, Progress(skipped_maps=ended.maps), [go_on(learner, settings, ended)]


def _assemble(
    settings: TrainingSettings,
    learner: Learner,
    folder: Path,
    lock: FolderLock,
    begin: Progress | Saved,
    messages: list[str],
    on_iteration_end: IterationHook | None,
) -> Trainer:
    """Put the run together; it goes on from what is saved, or begins with a progress of no iterations."""
    device, threads = runtime.resolve_device(settings.device), runtime.resolve_threads(settings.threads)
    loss, average, optimizer, relabel = learner.loss, learner.average, learner.optimizer, learner.relabel
    generators = {"replay": learner.replay.generator}
    if relabel is not None and relabel.generator is not None:
        generators["relabel"] = relabel.generator
    checkpoints = Checkpoints(
        folder / CHECKPOINTS,
        {"loss": loss, "average": average, "optimizer": optimizer, "generators": Generators(**generators)},
        replay=ReplayFiles(folder / REPLAY, learner.replay),
        keep=settings.checkpoint.keep,
    )
    replay_size = _replay_bytes(settings, learner.replay.capacity_episodes * settings.task.episode_steps)
    written = sum(path.stat().st_size for path in (folder / REPLAY).glob("*"))
    # Those that stay, the best, the one being validated, the one being written; a checkpoint doubles when the optimiser
    # has its state.
    checkpoints_bytes = 2 * checkpoints.size_bytes() * (settings.checkpoint.keep + 3)
    shortage = resources.disk_shortage(folder, max(0, replay_size - written) + checkpoints_bytes)
    messages = [*messages, *([] if shortage is None else [shortage])]
    pending = None
    if isinstance(begin, Progress):
        progress = begin
    else:
        progress, more = _restore(folder, checkpoints, begin)
        pending, progress, left_out = _pending(settings, checkpoints.folder, progress)
        total = settings.schedule.iterations
        messages = [
            *messages,
            *more,
            *left_out,
            f"continue after {progress.iterations} of {total} iterations, from {begin.path}",
        ]
    log = RunLog(folder, settings.logger.backends, continued_at=None if isinstance(begin, Progress) else progress.steps)
    active = f"allocator: {runtime.allocator()}, matrix products by {matmul.LIBRARY} BLAS"
    for sentence in [*messages, f"device {device}, {threads} threads, {active}"]:
        log.message(sentence)
    restarts = RestartBudget(
        settings.world.max_restarts,
        progress.restarts,
        message=log.message,
        saved=partial(saved_sentence, checkpoints, log),
    )
    return Trainer(
        schedule=settings.schedule,
        progress=progress,
        episodes=make_episodes(settings, loss.actor_network, device, progress),
        learner=learner,
        guard=FiniteGuard(folder, loss, optimizer),
        validation=Validation(
            _snapshot_evaluator(settings, device, threads),
            iterations=settings.schedule.iterations,
            every_iterations=settings.validation.every_iterations,
            restarts=restarts,
            log=log,
            pending=pending,
        ),
        checkpoints=checkpoints,
        checkpoint_every=settings.checkpoint.every_iterations,
        restarts=restarts,
        log=log,
        lock=lock,
        context_key=settings.algo.context_key,
        on_iteration_end=on_iteration_end,
    )


def _restore(folder: Path, checkpoints: Checkpoints, saved: Saved) -> tuple[Progress, list[str]]:
    """Bring components and logs back to a checkpoint; return the progress, and what the user should know."""
    checkpoints.restore(saved)
    messages = cut(folder, saved.logs)
    damage = best_damage(checkpoints.folder, saved.progress)
    if damage is None:
        return saved.progress, messages
    return replace(saved.progress, best_score=None, best_iterations=None), [*messages, damage]


def _pending(
    settings: TrainingSettings, checkpoints: Path, progress: Progress
) -> tuple[Snapshot | None, Progress, list[str]]:
    """Load the agent whose validation was under way; without it that validation is left out, and the user told."""
    if progress.validating_iterations is None:
        return None, progress, []
    path = checkpoints / folder_name(progress.validating_iterations)
    average = make_average(make_loss(settings, "cpu"), settings.learner)
    try:
        then = load_average(path, average).progress
    except DamagedError as error:
        message = f"checkpoint {path} is damaged: {error}; its validation was under way and is left out"
        return None, replace(progress, validating_iterations=None), [message]
    return Snapshot(then, packed(average.module)), progress, []


def _snapshot_evaluator(settings: TrainingSettings, device: str, threads: int) -> SnapshotEvaluator:
    world, given = replace(settings.training_world, num_workers=0), settings.validation
    course = EvaluationSpec(
        trained=settings,
        world=world,
        conditions=settings.algo.default_conditions,
        split="validation",
        seed=VALIDATION_SEED,
        num_episodes=world.num_agents,
        sampled=False,
        device=device,
        threads=1,
    )
    beside = resolve_processes_beside(given.processes, given.num_maps, threads)
    alone = min(usable_cores(), given.num_maps) if given.processes == "auto" else beside
    return SnapshotEvaluator(
        partial(map_evaluator, course),
        num_maps=given.num_maps,
        steps=world.task.episode_steps,
        processes=beside,
        processes_alone=alone,
        timeout_s=world.worker_timeout_s,
    )
