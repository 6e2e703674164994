"""A training run from its config."""

from collections.abc import Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path

from omegaconf import DictConfig

from rcdsac_trl.agent.kernels import matmul
from rcdsac_trl.config.run_config import CHECKPOINTS, REPLAY, settings_of_new_run, settings_of_run, with_map_digests
from rcdsac_trl.config.training_settings import TrainingSettings
from rcdsac_trl.rollout.make_agent import make_average, make_loss, packed
from rcdsac_trl.rollout.make_collector import make_episodes
from rcdsac_trl.rollout.map_evaluator import EvaluationSpec, map_evaluator
from rcdsac_trl.storage.atomic import FolderLock
from rcdsac_trl.storage.checkpoint import Checkpoints, Generators, load_average, rotate
from rcdsac_trl.storage.checkpoint_record import DamagedError, Progress, Saved, best_damage, folder_name, newest
from rcdsac_trl.storage.replay_files import ReplayFiles
from rcdsac_trl.system import resources, runtime
from rcdsac_trl.system.cores import usable_cores
from rcdsac_trl.system.processes import resolve_processes_beside
from rcdsac_trl.training.learner import Learner
from rcdsac_trl.training.machine_check import check_machine, check_memory, check_processes
from rcdsac_trl.training.make_learner import make_learner, replay_size_bytes
from rcdsac_trl.training.nan_guard import FiniteGuard
from rcdsac_trl.training.restart_budget import RestartBudget
from rcdsac_trl.training.run_folder import check_folder, cut, has_begun, start_run_folder
from rcdsac_trl.training.run_log import RunLog
from rcdsac_trl.training.trainer import IterationHook, Trainer, saved_sentence
from rcdsac_trl.training.validation import Snapshot, SnapshotEvaluator, Validation
from rcdsac_trl.training.warm_start import EndedRun, begin_with_agent, ended_run, go_on, inherited_steps
from rcdsac_trl.world.maps.map_source import check_maps

# Validation looks at the same maps whatever seed a run is trained with.
VALIDATION_SEED = 0


def check_training(cfg: DictConfig) -> TrainingSettings:
    """Read everything, so that what cannot work is refused before anything is written.

    Raises:
        UserInputError: for whatever cannot work, or not on this machine.
    """
    settings = settings_of_new_run(cfg)
    check_machine(settings)
    return settings


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
    settings = settings_of_new_run(cfg)
    ended = check_machine(settings)
    facts = {
        "overrides": list(overrides),
        "device": runtime.resolve_device(settings.device),
        "threads": settings.update_threads,
        "allocator": runtime.allocator(),
        "matrix_products": matmul.LIBRARY,
    }
    check_folder(folder)
    # Before anything is written: it may not fit into the memory, or not be that of `init`.
    learner, progress, messages = _begin(settings, ended)
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
        UserInputError: if another process trains in it, it has checkpoints and none is whole, or what an unfinished one
            logs or collects with cannot be had.
    """
    settings = settings_of_run(folder, key="resume")
    resources.check_writable(folder)
    check_maps(settings.map, settings.task.min_path_m, settings.robot.circumradius_m)
    check_processes(settings)
    lock = FolderLock(folder)
    try:
        saved, damaged = newest(folder / CHECKPOINTS, replay=folder / REPLAY) if has_begun(folder) else (None, [])
        if saved is not None and saved.progress.iterations == settings.schedule.iterations:
            if not damaged:  # it may have died after its last checkpoint, before what is then too old was removed
                rotate(folder / CHECKPOINTS, keep=settings.checkpoint.keep, replay=folder / REPLAY)
            lock.close()
            return None
        settings.logger.check_backends()
        settings.collector.check_package()
        if saved is None:
            ended = ended_run(settings)
            check_memory(settings, inherited_steps(settings, ended))
            learner, progress, messages = _begin(settings, ended)
            return _assemble(settings, learner, folder, lock, progress, messages, on_iteration_end)
        begun_with = _steps_begun_with(settings, saved)
        check_memory(settings, begun_with)
        learner = _learner_here(settings, begun_with)
        return _assemble(settings, learner, folder, lock, saved, damaged, on_iteration_end)
    except BaseException:
        lock.close()
        raise


def _steps_begun_with(settings: TrainingSettings, saved: Saved) -> int:
    """Return how many steps the replay of a run had begun with, from what it has added and driven since."""
    added = saved.segments[-1].end * settings.task.episode_steps if saved.segments else 0
    return added - saved.progress.steps


def _learner_here(settings: TrainingSettings, steps: int) -> Learner:
    """Make the learner on this machine's device, with its threads; its replay begins with so many steps."""
    # The loss has threads of its own. Torch's, which wait actively, would only take its time.
    runtime.set_threads(1)
    return make_learner(settings, runtime.resolve_device(settings.device), steps)


def _begin(settings: TrainingSettings, ended: EndedRun | None) -> tuple[Learner, Progress, list[str]]:
    """Make the learner of a new run, where that begins, and say what `init` gave it."""
    learner = _learner_here(settings, inherited_steps(settings, ended))
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
    device, threads = runtime.resolve_device(settings.device), settings.update_threads
    checkpoints = _checkpoints(settings, learner, folder)
    shortage = _disk_shortage(settings, learner, checkpoints)
    if isinstance(begin, Saved):
        progress, pending, restored = _restore(settings, folder, checkpoints, begin)
        log = RunLog(folder, settings.logger.backends, continued_at=progress.steps)
    else:
        progress, pending, restored = begin, None, []
        log = RunLog(folder, settings.logger.backends, continued_at=None)
    active = f"allocator: {runtime.allocator()}, matrix products by {matmul.LIBRARY} BLAS"
    for sentence in [*messages, *shortage, *restored, f"device {device}, {threads} threads, {active}"]:
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
        episodes=make_episodes(settings, learner.loss.actor_network, device),
        learner=learner,
        guard=FiniteGuard(folder, learner.loss, learner.optimizer),
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


def _checkpoints(settings: TrainingSettings, learner: Learner, folder: Path) -> Checkpoints:
    """Name all that outlives an iteration."""
    generators = {"replay": learner.replay.generator}
    if learner.relabel is not None and learner.relabel.generator is not None:
        generators["relabel"] = learner.relabel.generator
    return Checkpoints(
        folder / CHECKPOINTS,
        {
            "loss": learner.loss,
            "average": learner.average,
            "optimizer": learner.optimizer,
            "generators": Generators(**generators),
        },
        replay=ReplayFiles(folder / REPLAY, learner.replay),
        keep=settings.checkpoint.keep,
    )


def _disk_shortage(settings: TrainingSettings, learner: Learner, checkpoints: Checkpoints) -> list[str]:
    """Say what the disk lacks for the replay and the checkpoints that the run will have; nothing if it is enough."""
    folder = checkpoints.folder.parent
    replay_size = replay_size_bytes(settings, learner.replay.capacity_episodes * settings.task.episode_steps)
    written = sum(path.stat().st_size for path in (folder / REPLAY).glob("*"))
    # Those that stay, the best, the one being validated, the one being written; a checkpoint doubles when the optimiser
    # has its state.
    checkpoints_bytes = 2 * checkpoints.size_bytes() * (settings.checkpoint.keep + 3)
    shortage = resources.disk_shortage(folder, max(0, replay_size - written) + checkpoints_bytes)
    return [] if shortage is None else [shortage]


def _restore(
    settings: TrainingSettings, folder: Path, checkpoints: Checkpoints, saved: Saved
) -> tuple[Progress, Snapshot | None, list[str]]:
    """Bring components and logs back to a checkpoint.

    Returns:
        The progress, the agent whose validation was under way, and what the user should know.
    """
    checkpoints.restore(saved)
    messages, progress = cut(folder, saved.logs), saved.progress
    if (damage := best_damage(checkpoints.folder, progress)) is not None:
        progress = replace(progress, best_score=None, best_iterations=None)
        messages = [*messages, damage]
    pending, progress, left_out = _pending(settings, checkpoints.folder, progress)
    done, total = progress.iterations, settings.schedule.iterations
    goes_on = f"continue after {done} of {total} iterations, from {saved.path}"
    return progress, pending, [*messages, *left_out, goes_on]


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
    world, given = settings.world_for(settings.world.num_agents), settings.validation
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
        timeout_s=settings.world.worker_timeout_s,
    )
