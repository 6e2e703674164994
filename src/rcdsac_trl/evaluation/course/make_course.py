"""A drive over the office course from its config."""

import contextlib
from collections.abc import Callable, Generator, Iterator, Sequence
from dataclasses import asdict
from functools import partial
from pathlib import Path

import numpy as np
from omegaconf import DictConfig

import rcdsac_trl
from rcdsac_trl.config.course_settings import CourseSettings
from rcdsac_trl.config.run_config import course_settings
from rcdsac_trl.deploy import Guard, Policy, shipped_names
from rcdsac_trl.deploy.policy.input_checks import InputLimits
from rcdsac_trl.errors import UserInputError
from rcdsac_trl.evaluation.course.camera_rig import camera_poses, covered
from rcdsac_trl.evaluation.course.course_drive import Conditions, drive_course
from rcdsac_trl.evaluation.course.course_run import CourseRun, Entry, Job, jobs_of
from rcdsac_trl.evaluation.course.pursuit_pilot import PursuitPilot
from rcdsac_trl.evaluation.film.video import check_extra
from rcdsac_trl.robot.range_sensor import sensor_mask
from rcdsac_trl.rollout.evaluation_pool import Drive, Rows, drive_maps
from rcdsac_trl.system import resources, runtime
from rcdsac_trl.system.processes import resolve_processes
from rcdsac_trl.system.provenance import commit
from rcdsac_trl.world.office.building import COURSE_M, make_office
from rcdsac_trl.world.sim.simulation import SIMULATION_BYTES
from rcdsac_trl.world.task.rules import RULES_VERSION

# What the paper's second table sets each measure to.
_PAPER_BETAS = {"cvar": (0.25, 0.75), "pow": (-2.0, -1.0)}


def make_course(cfg: DictConfig) -> CourseRun:
    """Make a drive of agents over the course; refuses before anything is written.

    Raises:
        UserInputError: for an agent that is missing or sees what the cameras do not, a beta outside its range, or a
            package that is not installed.
    """
    settings = course_settings(cfg)
    if settings.record:
        check_extra()
    entries = _entries(settings)
    jobs = jobs_of(len(entries), settings.repetitions)
    processes = resolve_processes(settings.num_workers, len(jobs))
    simulations = 2 * max(1, processes)  # the physics, and what the cameras see
    resources.check_memory(f"{simulations} simulations", simulations * SIMULATION_BYTES, "lower num_workers")
    conditions = Conditions(settings.camera, settings.odometry, settings.time_limit_s, settings.seed)

    def drives() -> Generator[Rows, None, None]:
        return drive_maps(partial(_driver, entries, jobs, conditions), len(jobs), processes)

    described = {
        "entries": [{"run": entry.run, "agent": entry.agent, "beta": entry.beta} for entry in entries],
        "agents": {entry.run: asdict(entry.pilot.config) for entry in entries if isinstance(entry.pilot, Policy)},
        "course_m": COURSE_M,
        "guard_margin_m": settings.guard_margin_m,
        "repetitions": settings.repetitions,
        "seed": settings.seed,
        "time_limit_s": settings.time_limit_s,
        "camera": asdict(settings.camera),
        "odometry": asdict(settings.odometry),
        "rules_version": RULES_VERSION,
        "commit": commit(),
    }
    return CourseRun(
        out=_default_out(settings, entries) if settings.out is None else Path(settings.out),
        described=described,
        entries=entries,
        jobs=jobs,
        drives=drives,
        record=settings.record,
    )


def _entries(settings: CourseSettings) -> list[Entry]:
    """Return who drives: every agent at each of its betas, then the baseline."""
    runs = settings.runs
    if not runs and settings.baseline is None:
        runs = tuple(shipped_names())
        if not runs:
            raise UserInputError(
                "no agent is shipped with this version: name who drives with run=<folder> or baseline=pursuit"
            )
    guard = None if settings.guard_margin_m is None else Guard(margin_m=settings.guard_margin_m)
    policies = {run: rcdsac_trl.load(run, guard=guard) for run in runs}
    for run, policy in policies.items():
        _check_sensor(run, policy, settings.camera.view_deg)
    conditioned = [run for run, policy in policies.items() if policy.config.context == "beta"]
    if settings.beta is not None and not conditioned:
        raise UserInputError(f"beta={list(settings.beta)} means nothing to who drives: leave it out")
    entries = [entry for run, policy in policies.items() for entry in _entries_of(run, policy, settings.beta)]
    if settings.baseline is not None:
        entries.append(Entry("pursuit", "pursuit", None, None, PursuitPilot()))
    return entries


def _entries_of(run: str, policy: Policy, betas: Sequence[float] | None) -> list[Entry]:
    config = policy.config
    if config.context != "beta" or config.context_range is None:
        return [Entry(run, config.name, config.fixed_beta, None, policy)]
    if betas is None:
        assert policy.default_beta is not None
        betas = _PAPER_BETAS.get(config.measure, (policy.default_beta,))
    if not betas:
        raise UserInputError("beta=[] leaves nothing to drive with: name one or more, or leave it out")
    low, high = config.context_range
    for beta in betas:
        if not low <= beta <= high:
            raise UserInputError(f"beta={beta:g} is outside [{low:g}, {high:g}], where run={run} was trained")
    return [Entry(run, config.name, beta, beta, policy) for beta in betas]


def _check_sensor(run: str, policy: Policy, view_deg: float) -> None:
    """Refuse an agent that the cameras leave in the dark; its policy would only stand."""
    mask = sensor_mask(policy.config.sensor)
    lost = np.count_nonzero(mask & ~covered(camera_poses(view_deg))) / np.count_nonzero(mask)
    if lost > InputLimits().max_lost_share:
        raise UserInputError(
            f"run={run} sees with sensor={policy.config.sensor}, of which the four cameras cover "
            f"{100 * (1 - lost):.0f} %: name an agent of sensor=narrow, or widen camera.view_deg"
        )


def _default_out(settings: CourseSettings, entries: Sequence[Entry]) -> Path:
    runs = list(dict.fromkeys(entry.run for entry in entries))
    folder = Path(runs[0]) / "course" if len(runs) == 1 and Path(runs[0]).is_dir() else Path("course")
    told = "" if settings.beta is None else "-beta" + "_".join(f"{beta:g}" for beta in settings.beta)
    who = "" if folder != Path("course") else "-".join(Path(run).name for run in runs) + "-"
    margin = "none" if settings.guard_margin_m is None else f"{settings.guard_margin_m:g}"
    return folder / f"{who}seed{settings.seed}-{settings.repetitions}x{told}-guard{margin}"


@contextlib.contextmanager
def _driver(entries: Sequence[Entry], jobs: Sequence[Job], conditions: Conditions) -> Iterator[Drive]:
    """Make what drives one run after another, in this process."""
    runtime.set_threads(1)
    office = make_office()

    def drive(number: int, before_step: Callable[[], None]) -> Rows:
        job = jobs[number]
        entry = entries[job.entry]
        trace = drive_course(office, entry.pilot, entry.told, job.direction, job.repetition, conditions, before_step)
        return [{"job": number, "trace": trace}]

    yield drive
