"""A calibration from its config."""

import contextlib
import sys
from collections.abc import Callable, Generator, Iterator, Sequence
from functools import partial
from pathlib import Path

from omegaconf import DictConfig

from rcdsac_trl.config.conditions import Condition
from rcdsac_trl.config.evaluation_settings import CalibrationSettings
from rcdsac_trl.config.run_config import CHECKPOINTS, calibration_settings, settings_of_run
from rcdsac_trl.config.training_settings import TrainingSettings
from rcdsac_trl.errors import UserInputError
from rcdsac_trl.evaluation.calibration import CalibrationRun, measure_map
from rcdsac_trl.rollout.environments import environment
from rcdsac_trl.rollout.evaluation_pool import Drive, Rows, drive_maps
from rcdsac_trl.rollout.make_agent import make_loss, packed_loss, unpacked_loss
from rcdsac_trl.seeding import stream, torch_stream
from rcdsac_trl.storage.checkpoint import load_weights
from rcdsac_trl.storage.checkpoint_record import find
from rcdsac_trl.system import runtime
from rcdsac_trl.system.processes import resolve_processes
from rcdsac_trl.system.provenance import commit
from rcdsac_trl.world.task.rules import RULES_VERSION
from rcdsac_trl.world.task.world_settings import WorldSettings


def make_calibration(cfg: DictConfig) -> CalibrationRun:
    """Make a calibration of a run; refuses before anything is written.

    Raises:
        UserInputError: for a missing run, critics without quantiles, a beta that is missing or outside its domain, a
            horizon that leaves no room in an episode.
    """
    settings = calibration_settings(cfg)
    if settings.run is None:
        raise UserInputError("name the run whose critics are measured: run=<folder>")
    folder = Path(settings.run)
    trained = settings_of_run(folder)
    if trained.algo.critic != "quantile":
        raise UserInputError(
            f"run={folder} has {trained.algo.critic} critics, which predict no quantiles: name a run of another row"
        )
    if not 0 < settings.horizon_steps < trained.task.episode_steps:
        raise UserInputError(
            f"horizon_steps={settings.horizon_steps} must be below the {trained.task.episode_steps} steps of an "
            "episode, so that states can be met in it: shorten it"
        )
    conditions = trained.algo.conditions(settings.beta, None)
    checkpoints = folder / CHECKPOINTS
    find(checkpoints, settings.checkpoint)
    told = "".join(f"-{condition}".replace("=", "_") for condition in conditions)
    name = f"{settings.checkpoint}-{settings.split}-seed{settings.seed}-{settings.num_maps}x{settings.num_states}"

    def maps() -> Generator[Rows, None, None]:
        loss = make_loss(trained, "cpu")
        for damaged in load_weights(checkpoints, settings.checkpoint, loss=loss):
            print(f"rcdsac_trl: {damaged}", file=sys.stderr)
        make = partial(_driver, settings, trained, conditions, packed_loss(loss))
        return drive_maps(make, settings.num_maps, resolve_processes(settings.num_workers, settings.num_maps))

    described = {
        "agent": trained.algo.name,
        "measure": trained.algo.distortion.name,
        "sensor": trained.sensor.name,
        "train_seed": trained.seed,
        "checkpoint": settings.checkpoint,
        "split": settings.split,
        "seed": settings.seed,
        "num_maps": settings.num_maps,
        "num_states": settings.num_states,
        "num_rollouts": settings.num_rollouts,
        "horizon_steps": settings.horizon_steps,
        "memory_steps": trained.learner.sequence_length,
        "gamma": trained.learner.gamma,
        "target_over_critics": trained.learner.target_over_critics,
        "conditions": [str(condition) for condition in conditions],
        "rules_version": RULES_VERSION,
        "commit": commit(),
    }
    default_out = folder / "calibration" / f"{name}{told}"
    return CalibrationRun(
        out=default_out if settings.out is None else Path(settings.out),
        described=described,
        num_maps=settings.num_maps,
        maps=maps,
    )


@contextlib.contextmanager
def _driver(
    settings: CalibrationSettings, trained: TrainingSettings, conditions: Sequence[Condition], weights: bytes
) -> Iterator[Drive]:
    """Make what predicts and rolls out on one map after another, in this process."""
    runtime.set_threads(1 if settings.threads == "auto" else settings.threads)
    loss = unpacked_loss(trained, weights)
    group = settings.num_states * settings.num_rollouts
    world = WorldSettings(
        map_settings=trained.map,
        task=trained.task,
        sensor=trained.sensor.name,
        num_agents=group * len(conditions),
        num_workers=0,  # a process drives whole maps
    )
    states = [state for state in range(settings.num_states) for _ in range(settings.num_rollouts)]
    env = environment(
        world,
        trained.algo,
        split=settings.split,
        seed=settings.seed,
        agent_ids=states * len(conditions),
        memory=trained.network.memory,
        conditions=[condition for condition in conditions for _ in range(group)],
    )
    latest = trained.task.episode_steps - settings.horizon_steps

    def drive(map_index: int, before_step: Callable[[], None]) -> Rows:
        steps = stream(settings.seed, "calibration steps", map_index).integers(latest, size=settings.num_states)
        return measure_map(
            env,
            loss,
            betas=[condition.beta for condition in conditions],
            told=trained.algo.network_measure is not None,
            branch_steps=steps.tolist(),
            num_rollouts=settings.num_rollouts,
            horizon_steps=settings.horizon_steps,
            memory_steps=trained.learner.sequence_length,
            gamma=trained.learner.gamma,
            generator=torch_stream(settings.seed, "calibration actions", map_index),
            map_index=map_index,
            before_step=before_step,
        )

    try:
        yield drive
    finally:
        env.close()
