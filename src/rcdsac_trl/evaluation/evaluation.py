"""Evaluation: the same maps, starts and goals for every agent, its mean actions or its choice, one row an episode."""

from collections.abc import Generator
from dataclasses import asdict, replace
from functools import cache, partial
from pathlib import Path
from typing import Any

from omegaconf import DictConfig

from rcdsac_trl.config.baseline_name import PURSUIT
from rcdsac_trl.config.chosen_world import ChosenWorld
from rcdsac_trl.config.command_line import assigned
from rcdsac_trl.config.evaluation_settings import EvaluationSettings
from rcdsac_trl.config.named_folder import default_training
from rcdsac_trl.config.run_config import read_config
from rcdsac_trl.config.training_settings import TrainingSettings
from rcdsac_trl.errors import UserInputError
from rcdsac_trl.evaluation.barn_runs import barn_runs, timed
from rcdsac_trl.evaluation.film.filming import write_film
from rcdsac_trl.evaluation.film.video import check_extra
from rcdsac_trl.evaluation.measured_run import Findings, MeasuredRun
from rcdsac_trl.release.named_agent import NamedAgent, named_agent
from rcdsac_trl.robot.robot_settings import PAPER
from rcdsac_trl.rollout.collisions import COLLISIONS, collision_table
from rcdsac_trl.rollout.evaluation_pool import Rows, evaluate_maps
from rcdsac_trl.rollout.make_agent import packed, packed_loss
from rcdsac_trl.rollout.map_evaluator import Agent, EvaluationSpec, map_evaluator
from rcdsac_trl.rollout.measurement import CONDITION_COLUMNS, table_of
from rcdsac_trl.rollout.metrics import summarise
from rcdsac_trl.rollout.planners.baselines import check_baseline, settings_of
from rcdsac_trl.system import resources, runtime
from rcdsac_trl.system.processes import resolve_processes
from rcdsac_trl.system.progress import Watch
from rcdsac_trl.system.provenance import commit
from rcdsac_trl.world.maps.map_source import with_digests
from rcdsac_trl.world.sim.bullet import check_display
from rcdsac_trl.world.sim.simulation import SIMULATION_BYTES


def make_evaluation(cfg: DictConfig) -> MeasuredRun:
    """Make an evaluation of a run or a baseline; refuses before anything is written.

    It writes ``episodes.csv``, ``summary.csv``, ``collisions.csv``, ``evaluation.json`` and, if asked for, films; of
    BARN's protocol ``runs.csv`` and ``barn.json``.

    Raises:
        UserInputError: for a missing run, a beta that is missing or outside its domain, a sensor that does not fit, a
            baseline that cannot drive.
    """
    settings = read_config(cfg, EvaluationSettings)
    if settings.record:
        check_extra()
    if settings.gui:
        check_display()
    named = None
    if settings.run is not None:
        named = named_agent(settings.run, settings.checkpoint, half_precision=settings.half_precision)
    trained = default_training() if named is None else named.settings
    chosen = settings.world_of(trained)
    chosen.check_maps()
    worlds = [] if chosen.barn is None else timed(chosen.barn.worlds()[: settings.num_maps])
    num_maps = len(worlds) or settings.num_maps
    if settings.record and settings.video.map >= num_maps:
        raise UserInputError(
            f"video.map={settings.video.map} is not among the {num_maps} worlds that are there: lower it"
        )
    spec = _spec(settings, trained, chosen)
    if settings.baseline is not None:
        check_baseline(settings.baseline, spec.world.sensor, spec.world.robot)
    processes = 0 if settings.gui else resolve_processes(settings.num_workers, num_maps)
    simulations = max(1, processes) * spec.world.num_agents
    remedy = "lower num_episodes or num_workers, or end other programs"
    resources.check_memory(f"{simulations} simulations", simulations * SIMULATION_BYTES, remedy)
    if named is not None:
        named.check()

    @cache  # Read once: a training that goes on may write another checkpoint meanwhile.
    def agent() -> Agent | None:
        if named is None:
            return None
        loss, average = named.load()
        return Agent(packed(average.module), packed_loss(loss))

    def maps(watch: Watch) -> Generator[Rows, None, None]:
        make = partial(map_evaluator, spec, *(agent() or (None,)))
        return evaluate_maps(make, num_maps, processes, watch)

    def film(folder: Path, rows: Rows) -> list[Path]:
        headings = [f"{_name(settings, trained)}  {condition.heading}".strip() for condition in spec.conditions]
        recalibration = None if named is None else named.recalibration(spec.acting)
        return write_film(spec, agent(), settings.video, headings, folder, recalibration)

    out = Path(settings.out) if settings.out is not None else _default_out(settings, spec, named, num_maps)
    return MeasuredRun(
        kind="barn" if worlds else "evaluation",
        out=out,
        described=_described(settings, spec, named, num_maps),
        unit="map",
        num_units=num_maps,
        unit_steps=spec.world.task.episode_steps,
        processes=processes,
        measure=maps,
        findings=partial(barn_runs, worlds) if worlds else _findings,
        film=film if settings.record else None,
        next_step=() if worlds else ("report", assigned("runs", out.as_posix())),
    )


def _spec(settings: EvaluationSettings, trained: TrainingSettings, chosen: ChosenWorld) -> EvaluationSpec:
    conditions = settings.conditions_of(trained)
    world = chosen.world_for(settings.num_episodes * len(conditions))
    return EvaluationSpec(
        trained=trained,
        world=replace(world, map_settings=with_digests(chosen.maps), gui=settings.gui),
        conditions=conditions,
        split=settings.split,
        seed=settings.seed,
        num_episodes=settings.num_episodes,
        sampled=settings.sampled,
        device=runtime.resolve_device(settings.device),
        threads=1 if settings.threads == "auto" else settings.threads,
        detailed=True,
        controller=settings.controller if settings.beta_controller else None,
        baseline=settings.baseline or PURSUIT,
        one_trip=chosen.barn is not None,
        navigation=settings.navigation,
        latency_s=settings.latency_of(trained),
        acting=settings.acting_of(trained),
    )


def _name(settings: EvaluationSettings, trained: TrainingSettings) -> str:
    """Name what drives."""
    return trained.algo.name if settings.baseline is None else settings.baseline


def _default_out(settings: EvaluationSettings, spec: EvaluationSpec, named: NamedAgent | None, num_maps: int) -> Path:
    maps = "barn" if spec.one_trip else settings.split
    name = f"{maps}-seed{settings.seed}-{num_maps}x{settings.num_episodes}"
    name += "".join(f"-{part}" for part, is_on in asdict(spec.navigation).items() if is_on)
    if named is None:
        if spec.world.robot != PAPER:
            name = f"{spec.world.robot.name}-{name}"
        return Path("evaluation") / f"{settings.baseline}-{spec.world.sensor}-{name}".replace(":", "-")
    name += f"-latency_{spec.latency_s:g}" if spec.latency_s else ""
    name += "".join(f"-{part}_{value}" for part, value in settings.acting.given.items())
    contexts = "".join(f"-{condition}".replace("=", "_") for condition in spec.conditions)
    return named.folder_of("evaluation", f"{name}{contexts}")


def _described(
    settings: EvaluationSettings, spec: EvaluationSpec, named: NamedAgent | None, num_maps: int
) -> dict[str, Any]:
    """Say what is measured and how."""
    trained = spec.trained
    described = {
        "agent": _name(settings, trained),
        "measure": None if named is None else trained.algo.distortion.name,
        "sensor": spec.world.sensor,
        "memory_s": spec.world.memory_s,
        "robot": spec.world.robot.plain(),
        "train_seed": None if named is None else trained.seed,
        **({"checkpoint": None} if named is None else named.described),
        "split": settings.split,
        "seed": settings.seed,
        "num_maps": num_maps,
        "num_episodes": settings.num_episodes,
        "sampled": settings.sampled,
        "acting": None if named is None else asdict(spec.acting),
        "navigation": _navigation(settings),
        "conditions": [str(condition) for condition in spec.conditions],
        "map": asdict(spec.world.map_settings),
        "task": asdict(spec.world.task),
        "commit": commit(),
    }
    if trained.algo.fixed_weight != 1.0:
        described["trained_collision_weight"] = trained.algo.fixed_weight
    if spec.latency_s:
        described["latency_s"] = spec.latency_s
    if spec.controller is not None:
        described["controller"] = asdict(spec.controller)
    return described if settings.baseline is None else described | settings_of(settings.baseline)


def _navigation(settings: EvaluationSettings) -> dict[str, bool]:
    """Say what stands between the agents and the wheels; no stop zone that is off: earlier versions had none."""
    described = asdict(settings.navigation)
    return {name: is_on for name, is_on in described.items() if is_on or name != "stop_zone"}


def _findings(rows: Rows) -> Findings:
    measured = table_of([rows])
    collisions, episodes = collision_table(measured), measured.drop(columns=COLLISIONS)
    summary = summarise(episodes, [key for key in CONDITION_COLUMNS if key in episodes])
    return Findings(
        {
            "episodes.csv": episodes.to_csv(index=False, float_format="%.9g"),
            "summary.csv": summary.to_csv(index=False, float_format="%.6g"),
            "collisions.csv": collisions.to_csv(index=False, float_format="%.6g"),
        }
    )
