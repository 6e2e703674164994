"""Calibration: are the quantiles that critics have learnt true? Predictions against the returns of roll-outs."""

import contextlib
from collections.abc import Callable, Generator, Iterator, Sequence
from contextlib import AbstractContextManager
from dataclasses import asdict
from functools import partial
from pathlib import Path
from typing import Any

import pandas as pd
from omegaconf import DictConfig

from rcdsac_trl.agent.risk import RiskMeasure
from rcdsac_trl.config.calibration_settings import CalibrationSettings
from rcdsac_trl.config.conditions import Condition
from rcdsac_trl.config.run_config import read_config
from rcdsac_trl.config.training_settings import TrainingSettings
from rcdsac_trl.errors import UserInputError
from rcdsac_trl.evaluation.branches import measure_states
from rcdsac_trl.evaluation.cross_evaluation import cross_evaluate, cross_tables
from rcdsac_trl.evaluation.driven_returns import driven_findings, driven_returns
from rcdsac_trl.evaluation.measured_run import Findings, MeasuredRun
from rcdsac_trl.release.named_agent import NamedAgent, named_agent
from rcdsac_trl.rollout.environments import environment
from rcdsac_trl.rollout.evaluation_pool import Drive, Rows, evaluate_maps
from rcdsac_trl.rollout.make_agent import packed, packed_loss, unpacked_loss
from rcdsac_trl.rollout.map_evaluator import Agent, EvaluationSpec
from rcdsac_trl.seeding import stream, torch_stream
from rcdsac_trl.system import resources, runtime
from rcdsac_trl.system.processes import resolve_processes
from rcdsac_trl.system.progress import Watch
from rcdsac_trl.system.provenance import commit
from rcdsac_trl.world.sim.simulation import SIMULATION_BYTES
from rcdsac_trl.world.task.rules import RULES_VERSION

Measurer = tuple[Callable[[], AbstractContextManager[Drive]], Callable[[Rows], Findings]]
"""What makes the driver of a process, and what makes tables of all rows."""


def make_calibration(cfg: DictConfig) -> MeasuredRun:
    """Make a calibration of a run; refuses before anything is written.

    It writes ``predictions.csv``, ``returns.csv`` and ``calibration.json``, with ``cross_evaluate`` also
    ``cross_returns.csv`` and ``cross_distortion.csv``.

    Raises:
        UserInputError: for a missing run, critics without quantiles, a beta that is missing or outside its domain, a
            horizon that leaves no room in an episode or too much of a return out, a cross-evaluation of a single beta,
            more simulations at once than the memory holds.
    """
    settings = read_config(cfg, CalibrationSettings)
    if settings.run is None:
        raise UserInputError(
            "name the agent whose critics are measured: run=<folder> of a run or an export, or a shipped agent"
        )
    named = named_agent(settings.run, settings.checkpoint, half_precision=settings.half_precision)
    trained = named.settings
    conditions = settings.conditions_of(trained)
    settings.check_missing(trained.learner.gamma, trained.task.episode_steps)
    named.check()
    processes = resolve_processes(settings.num_workers, settings.num_maps)
    make, findings = (_as_driven if settings.as_driven else _branched)(settings, named, conditions, max(1, processes))

    def maps(watch: Watch) -> Generator[Rows, None, None]:
        return evaluate_maps(make, settings.num_maps, processes, watch)

    return MeasuredRun(
        kind="calibration",
        out=_default_out(settings, named, conditions) if settings.out is None else Path(settings.out),
        described=_described(settings, named, conditions),
        unit="map",
        num_units=settings.num_maps,
        unit_steps=trained.task.episode_steps,
        processes=processes,
        measure=maps,
        findings=findings,
    )


def _branched(settings: CalibrationSettings, named: NamedAgent, conditions: Sequence[Condition], sets: int) -> Measurer:
    """Return what rolls out from states, and what makes tables of it.

    Args:
        settings: of the calibration.
        named: the agent.
        conditions: it is driven under.
        sets: of simulations that there are at once.
    """
    loss = named.load_critics()
    simulations = sets * len(conditions) * settings.num_states * settings.num_rollouts
    remedy = (
        "lower num_rollouts, num_states (and raise num_maps instead) or num_workers, give fewer values of beta, or end "
        "other programs"
    )
    resources.check_memory(f"{simulations} simulations", simulations * SIMULATION_BYTES, remedy)
    make = partial(_driver, settings, named.settings, conditions, packed_loss(loss))
    return make, partial(_findings, named.settings.algo.distortion.measure)


def _as_driven(
    settings: CalibrationSettings, named: NamedAgent, conditions: Sequence[Condition], sets: int
) -> Measurer:
    """Return what drives whole episodes, and what makes tables of them; arguments as for :func:`_branched`."""
    trained = named.settings
    simulations = sets * len(conditions) * settings.num_episodes
    remedy = "lower num_episodes or num_workers, give fewer values of beta, or end other programs"
    resources.check_memory(f"{simulations} simulations", simulations * SIMULATION_BYTES, remedy)
    spec = EvaluationSpec(
        trained=trained,
        world=trained.world_for(settings.num_episodes * len(conditions)),
        conditions=conditions,
        split=settings.split,
        seed=settings.seed,
        num_episodes=settings.num_episodes,
        sampled=False,
        device="cpu",
        threads=_threads(settings),
        acting=settings.acting_of(trained),
    )
    loss, average = named.load()
    agent = Agent(packed(average.module), packed_loss(loss))
    horizon_steps = settings.horizon_in(trained.task.episode_steps)
    make = partial(driven_returns, spec, agent, every_steps=settings.every_steps, horizon_steps=horizon_steps)
    return make, partial(driven_findings, named.recalibration(spec.acting))


def _threads(settings: CalibrationSettings) -> int:
    return 1 if settings.threads == "auto" else settings.threads


def _default_out(settings: CalibrationSettings, named: NamedAgent, conditions: Sequence[Condition]) -> Path:
    size = settings.num_episodes if settings.as_driven else settings.num_states
    name = f"{settings.split}-seed{settings.seed}-{settings.num_maps}x{size}"
    name += "-driven" if settings.as_driven else "-cross" if settings.cross_evaluate else ""
    name += "".join(f"-{part}_{value}" for part, value in settings.acting.given.items())
    contexts = "".join(f"-{condition}".replace("=", "_") for condition in conditions)
    return named.folder_of("calibration", f"{name}{contexts}")


def _described(settings: CalibrationSettings, named: NamedAgent, conditions: Sequence[Condition]) -> dict[str, Any]:
    """Say what is measured and how."""
    trained = named.settings
    described = {
        "agent": trained.algo.name,
        "measure": trained.algo.distortion.name,
        "sensor": trained.sensor.name,
        "memory_s": trained.sensor.memory_s,
        "robot": trained.robot.plain(),
        "train_seed": trained.seed,
        **named.described,
        "split": settings.split,
        "seed": settings.seed,
        "num_maps": settings.num_maps,
        **(_described_as_driven if settings.as_driven else _described_branched)(settings, named),
        "horizon_steps": settings.horizon_in(trained.task.episode_steps),
        "gamma": trained.learner.gamma,
        "target_over_critics": trained.learner.target_over_critics,
        "conditions": [str(condition) for condition in conditions],
        "rules_version": RULES_VERSION,
        "commit": commit(),
    }
    return described | ({"cross_evaluate": True} if settings.cross_evaluate else {})


def _described_branched(settings: CalibrationSettings, named: NamedAgent) -> dict[str, Any]:
    return {
        "num_states": settings.num_states,
        "num_rollouts": settings.num_rollouts,
        "memory_steps": named.settings.learner.sequence_length,
    }


def _described_as_driven(settings: CalibrationSettings, named: NamedAgent) -> dict[str, Any]:
    acting = settings.acting_of(named.settings)
    recalibration = named.recalibration(acting)
    return {
        "as_driven": True,
        "num_episodes": settings.num_episodes,
        "every_steps": settings.every_steps,
        "acting": asdict(acting),
        "betas": [condition.beta for condition in named.settings.algo.conditions(settings.beta, None)],
        "recalibration": None if recalibration is None else asdict(recalibration),
    }


@contextlib.contextmanager
def _driver(
    settings: CalibrationSettings, trained: TrainingSettings, conditions: Sequence[Condition], weights: bytes
) -> Iterator[Drive]:
    """Make what predicts and rolls out on one map after another, in this process."""
    runtime.set_threads(_threads(settings))
    loss = unpacked_loss(trained, weights)
    group = settings.num_states * settings.num_rollouts
    states = [state for state in range(settings.num_states) for _ in range(settings.num_rollouts)]
    env = environment(
        trained.world_for(group * len(conditions)),
        trained.algo,
        split=settings.split,
        seed=settings.seed,
        agent_ids=states * len(conditions),
        state_size=trained.network.state_size,
        conditions=[condition for condition in conditions for _ in range(group)],
    )
    horizon_steps = settings.horizon_in(trained.task.episode_steps)
    latest = trained.task.episode_steps - horizon_steps
    betas = [condition.beta for condition in conditions]

    def drive(map_index: int, before_step: Callable[[], None]) -> Rows:
        drawn = stream(settings.seed, "calibration steps", map_index).integers(latest, size=settings.num_states)
        steps = drawn.tolist()
        rows = measure_states(
            env,
            loss,
            betas=betas,
            conditioned=trained.algo.network_measure is not None,
            branch_steps=steps,
            num_rollouts=settings.num_rollouts,
            horizon_steps=horizon_steps,
            memory_steps=trained.learner.sequence_length,
            gamma=trained.learner.gamma,
            generator=torch_stream(settings.seed, "calibration actions", map_index),
            map_index=map_index,
            before_step=before_step,
        )
        if settings.cross_evaluate:
            rows += cross_evaluate(
                env,
                loss.actor_network,
                betas=betas,
                branch_steps=steps,
                num_rollouts=settings.num_rollouts,
                horizon_steps=horizon_steps,
                gamma=trained.learner.gamma,
                generator=torch_stream(settings.seed, "cross-evaluation actions", map_index),
                map_index=map_index,
                before_step=before_step,
            )
        return rows

    try:
        yield drive
    finally:
        env.close()


def _findings(measure: RiskMeasure, rows: Rows) -> Findings:
    rows = sorted(rows, key=lambda row: (row["beta"] or 0.0, row["map"], row["state"]))
    crossed = [row for row in rows if "history_beta" in row]
    rows = [row for row in rows if "history_beta" not in row]
    tables = {
        "predictions.csv": _predictions(rows).to_csv(index=False, float_format="%.6g"),
        "returns.csv": _returns(rows).to_csv(index=False, float_format="%.6g"),
    }
    return Findings(tables | (cross_tables(crossed, measure) if crossed else {}))


_STATE = ("beta", "map", "state", "step")


def _predictions(rows: Rows) -> pd.DataFrame:
    """One row a state."""
    return pd.DataFrame(
        {key: row[key] for key in _STATE}
        | {"whole_history_mean": row["whole_history_mean"]}
        | {f"critic_{number}_mean": value for number, value in enumerate(row["critic_means"])}
        | {f"q{number}": value for number, value in enumerate(row["quantiles"])}
        for row in rows
    )


def _returns(rows: Rows) -> pd.DataFrame:
    """One row a roll-out."""
    return pd.DataFrame(
        {key: row[key] for key in _STATE} | {"rollout": number, "soft_return": soft, "discounted_reward": plain}
        for row in rows
        for number, (soft, plain) in enumerate(zip(row["soft_returns"], row["discounted_rewards"], strict=True))
    )
