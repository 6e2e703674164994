"""Everything that drives the course, run after run, and the tables of it."""

import contextlib
import json
import math
from collections.abc import Callable, Generator, Iterator, Sequence
from dataclasses import asdict, dataclass
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
from omegaconf import DictConfig

from rcdsac_trl.config.course_settings import PERIOD_S, CourseSettings
from rcdsac_trl.config.run_config import read_config
from rcdsac_trl.deploy import Policy
from rcdsac_trl.evaluation.course.course_collisions import collisions_of
from rcdsac_trl.evaluation.course.course_drive import (
    DIRECTIONS,
    Conditions,
    Direction,
    Trace,
    course_of,
    drive_course,
    measures,
)
from rcdsac_trl.evaluation.course.course_film import FPS, frames
from rcdsac_trl.evaluation.course.entries import Entry, entries_of
from rcdsac_trl.evaluation.film.video import check_extra, write_video
from rcdsac_trl.evaluation.measured_run import Findings, MeasuredRun
from rcdsac_trl.rollout.evaluation_pool import Drive, Rows, evaluate_maps
from rcdsac_trl.system import resources, runtime
from rcdsac_trl.system.processes import resolve_processes
from rcdsac_trl.system.progress import Watch, Work, counted
from rcdsac_trl.system.provenance import commit
from rcdsac_trl.world.maps.shapes import Box
from rcdsac_trl.world.office.building import COURSE_M, Office, make_office
from rcdsac_trl.world.sim.simulation import SIMULATION_BYTES
from rcdsac_trl.world.task.rules import RULES_VERSION

# Of an agent on the course, for a guess of how long a run will take.
_USUAL_SPEED_M_PER_S = 0.45


@dataclass(frozen=True)
class Job:
    """One run over the course."""

    entry: int
    direction: Direction
    repetition: int


def jobs_of(entries: int, repetitions: int) -> list[Job]:
    """Return all runs over the course, an entry's together."""
    return [
        Job(entry, direction, repetition)
        for entry in range(entries)
        for direction in DIRECTIONS
        for repetition in range(repetitions)
    ]


def make_course(cfg: DictConfig) -> MeasuredRun:
    """Make a drive of agents over the course; refuses before anything is written.

    It writes ``runs.csv``, one row a run; ``traces.csv``, one row a control period; ``collisions.csv``, one row a
    collision; ``office.json``, what stands where; ``course.json``; and, if asked for, films of the first repetition of
    each.

    Raises:
        UserInputError: for an agent that is missing or sees what the cameras do not, a beta outside its range, or a
            package that is not installed.
    """
    settings = read_config(cfg, CourseSettings)
    if settings.record:
        check_extra()
    entries = entries_of(settings)
    jobs = jobs_of(len(entries), settings.repetitions)
    processes = resolve_processes(settings.num_workers, len(jobs))
    simulations = 2 * max(1, processes)  # the physics, and what the cameras see
    resources.check_memory(f"{simulations} simulations", simulations * SIMULATION_BYTES, "lower num_workers")
    conditions = conditions_of(settings)
    office = partial(make_office, settings.people, settings.hollow)

    def drives(watch: Watch) -> Generator[Rows, None, None]:
        make = partial(_driver, office, entries, jobs, conditions, settings.record)
        return evaluate_maps(make, len(jobs), processes, watch)

    return MeasuredRun(
        kind="course",
        out=_default_out(settings, entries) if settings.out is None else Path(settings.out),
        described=_described(settings, entries),
        unit="run",
        num_units=len(jobs),
        unit_steps=math.ceil(min(COURSE_M / _USUAL_SPEED_M_PER_S, settings.time_limit_s) / PERIOD_S),
        processes=processes,
        measure=drives,
        findings=partial(_findings, office),
        film=partial(_films, office, entries) if settings.record else None,
    )


def conditions_of(settings: CourseSettings) -> Conditions:
    """Return what all runs have in common."""
    return Conditions(settings.camera, settings.odometry, settings.time_limit_s, settings.seed, settings.ranges)


def _described(settings: CourseSettings, entries: Sequence[Entry]) -> dict[str, Any]:
    """Say who drives and how."""
    return {
        "entries": [{"run": entry.run, "agent": entry.agent, "beta": entry.beta} for entry in entries],
        "agents": {entry.run: asdict(entry.pilot.config) for entry in entries if isinstance(entry.pilot, Policy)},
        "acting": {entry.run: asdict(entry.pilot.acting) for entry in entries if isinstance(entry.pilot, Policy)},
        "course_m": COURSE_M,
        "guard_margin_m": settings.guard_margin_m,
        "navigation": asdict(settings.navigation),
        "repetitions": settings.repetitions,
        "seed": settings.seed,
        "time_limit_s": settings.time_limit_s,
        "people": settings.people,
        "hollow": settings.hollow,
        "ranges": settings.ranges,
        "camera": asdict(settings.camera),
        "odometry": asdict(settings.odometry),
        "rules_version": RULES_VERSION,
        "commit": commit(),
    }


def _default_out(settings: CourseSettings, entries: Sequence[Entry]) -> Path:
    runs = list(dict.fromkeys(entry.run for entry in entries))
    folder = Path(runs[0]) / "course" if len(runs) == 1 and Path(runs[0]).is_dir() else Path("course")
    betas = "" if settings.beta is None else "-beta" + "_".join(f"{beta:g}" for beta in settings.beta)
    who = "" if folder != Path("course") else "-".join(Path(run).name for run in runs) + "-"
    margin = "none" if settings.guard_margin_m is None else f"{settings.guard_margin_m:g}"
    ideal = asdict(settings.navigation) | {
        "nobody": not settings.people,
        "solid": not settings.hollow,
        "exact": settings.ranges == "exact",
    }
    eased = "".join(f"-{name}" for name, is_so in ideal.items() if is_so)
    acting = "".join(f"-{name}_{value}" for name, value in settings.acting.given.items())
    return folder / f"{who}seed{settings.seed}-{settings.repetitions}x{betas}-guard{margin}{eased}{acting}"


@contextlib.contextmanager
def _driver(
    make: Callable[[], Office], entries: Sequence[Entry], jobs: Sequence[Job], conditions: Conditions, record: bool
) -> Iterator[Drive]:
    """Make what drives one run after another, in this process."""
    runtime.set_threads(1)
    office = make()

    def drive(number: int, before_step: Callable[[], None]) -> Rows:
        job = jobs[number]
        entry = entries[job.entry]
        trace = drive_course(office, entry.pilot, entry.context, job.direction, job.repetition, conditions, before_step)
        labels: dict[str, Any] = {
            "run": entry.run,
            "agent": entry.agent,
            "beta": float("nan") if entry.beta is None else entry.beta,
            "direction": job.direction,
            "repetition": job.repetition,
        }
        row = {
            "number": number,
            "job": job,
            "measures": labels | measures(trace, course_of(office, job.direction)),
            "steps": _steps(trace).assign(**labels),
            "collisions": collisions_of(office, trace).assign(**labels),
        }
        # Only what is filmed is kept whole.
        return [row | {"trace": trace} if record and job.repetition == 0 else row]

    yield drive


def _findings(make: Callable[[], Office], rows: Rows) -> Findings:
    rows = sorted(rows, key=lambda row: row["number"])
    tables = {
        "runs.csv": pd.DataFrame([row["measures"] for row in rows]),
        "traces.csv": pd.concat([row["steps"] for row in rows], ignore_index=True),
        "collisions.csv": pd.concat([row["collisions"] for row in rows], ignore_index=True),
    }
    written = {name: table.to_csv(index=False, float_format="%.6g") for name, table in tables.items()}
    return Findings(written | {"office.json": plan_of(make())})


def _films(make: Callable[[], Office], entries: Sequence[Entry], folder: Path, rows: Rows) -> list[Path]:
    """Film the runs whose traces were kept."""
    office = make()
    kept = sorted((row for row in rows if "trace" in row), key=lambda row: row["number"])
    files = []
    with Work(f"{counted(len(kept), 'film')}, for {folder}", len(kept), "film") as work:
        for row in kept:
            job, trace = row["job"], row["trace"]
            entry = entries[job.entry]
            title = f"{entry.name}, {job.direction}{'' if trace.finished else ', not finished'}"
            stem = f"{job.entry}-{entry.name}-{job.direction}".replace(" ", "-")
            course = course_of(office, job.direction)
            pictures = work.within(frames(office, entry.pilot, trace, course, title), len(trace.commands))
            files += write_video(pictures, folder / stem, FPS)
            work.end_unit()
    return files


def plan_of(office: Office) -> str:
    """Return what stands where, and the course, as JSON for whoever draws it.

    ``shapes`` holds, for each piece, its ``kind`` (wall, glass, known or unknown to the planner) and either ``corners``
    or ``centre`` and ``radius``, m.
    """
    shapes: list[dict[str, Any]] = []
    for piece in office.pieces:
        shape = piece.footprint
        known = "known" if shape.mapped else "unknown"
        if isinstance(shape, Box):
            kind = "glass" if piece.glass else "wall" if shape.wall else known
            shapes.append({"kind": kind, "corners": shape.corners().round(6).tolist()})
        else:
            shapes.append({"kind": known, "centre": [shape.x, shape.y], "radius": shape.radius})
    return json.dumps({"size_m": office.map.size_m, "course": office.course.round(6).tolist(), "shapes": shapes}) + "\n"


def _steps(trace: Trace) -> pd.DataFrame:
    """Return a run step by step."""
    columns = {
        "time_s": [step * PERIOD_S for step in range(len(trace.poses))],
        "x_m": trace.poses[:, 0],
        "y_m": trace.poses[:, 1],
        "yaw_rad": trace.poses[:, 2],
        "estimate_x_m": trace.estimates[:, 0],
        "estimate_y_m": trace.estimates[:, 1],
        "nearest_m": trace.nearest_m,
        "in_contact": trace.in_contact.astype(int),
        # Of the command that follows, which the last row has none of.
        "v_m_per_s": np.append(trace.commands[:, 0], np.nan),
        "omega_rad_per_s": np.append(trace.commands[:, 1], np.nan),
        "limited": np.append(trace.limited.astype(float), np.nan),
    }
    return pd.DataFrame(columns)
