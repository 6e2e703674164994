"""Everything that drives the course, run after run, and the folder that the runs are written into."""

import contextlib
import json
from collections.abc import Callable, Generator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import pandas as pd
from tqdm import tqdm

from rcdsac_trl.config.course_settings import PERIOD_S
from rcdsac_trl.evaluation.course.course_drive import DIRECTIONS, Direction, Pilot, Trace, course_of, measures
from rcdsac_trl.evaluation.course.course_film import FPS, frames
from rcdsac_trl.evaluation.film.video import write_video
from rcdsac_trl.rollout.evaluation_pool import Rows
from rcdsac_trl.storage.results_folder import ResultsFolder
from rcdsac_trl.world.maps.shapes import Box
from rcdsac_trl.world.office.building import Office, make_office


@dataclass(frozen=True)
class Entry:
    """Who drives, and what it is told.

    Attributes:
        run: as it was named: a folder, a shipped agent, or ``"pursuit"``.
        agent: row of the paper's table, or ``"pursuit"``.
        beta: how much risk it takes; of an agent that was trained for one, that one; None where there is none.
        told: what it is told of that; None for nothing.
        pilot: the driver.
    """

    run: str
    agent: str
    beta: float | None
    told: float | None
    pilot: Pilot

    @property
    def name(self) -> str:
        """Who it is, for people and for file names."""
        return self.agent if self.beta is None else f"{self.agent} beta={self.beta:g}"


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


class CourseRun:
    """All runs, and the folder they are written into.

    It writes ``runs.csv``, one row a run; ``traces.csv``, one row a control period; ``office.json``, what stands where;
    ``course.json``; and films of the first repetition of each.

    Args:
        out: the folder; made when the results are there.
        described: who drives and how; equal descriptions give equal files.
        entries: who drives.
        jobs: the runs.
        drives: yields ``{"job": number, "trace": Trace}`` of each run as it has been driven.
        record: whether to make films.

    Raises:
        UserInputError: if the folder holds something else.
    """

    def __init__(
        self,
        *,
        out: Path,
        described: Mapping[str, Any],
        entries: Sequence[Entry],
        jobs: Sequence[Job],
        drives: Callable[[], Generator[Rows, None, None]],
        record: bool,
    ) -> None:
        self.results = ResultsFolder(out, "course.json", described)
        self._entries = entries
        self._jobs = jobs
        self._drives = drives
        self._record = record

    def run(self) -> None:
        """Drive and write.

        Raises:
            UserInputError: if something else was written into the folder meanwhile.
        """
        office = make_office()
        rows: dict[int, dict[str, Any]] = {}
        traces: dict[int, pd.DataFrame] = {}
        recorded: dict[int, Trace] = {}
        with contextlib.closing(self._drives()) as drives:
            for driven in tqdm(drives, total=len(self._jobs), unit="run", disable=None):
                for result in driven:
                    number, trace = result["job"], result["trace"]
                    job = self._jobs[number]
                    rows[number] = self._labels(job) | measures(trace, course_of(office, job.direction))
                    traces[number] = _table(trace).assign(**self._labels(job))
                    if self._record and job.repetition == 0:
                        recorded[number] = trace
        order = range(len(self._jobs))
        tables = {
            "runs.csv": pd.DataFrame([rows[number] for number in order]),
            "traces.csv": pd.concat([traces[number] for number in order], ignore_index=True),
        }
        written = {name: table.to_csv(index=False, float_format="%.6g") for name, table in tables.items()}
        self.results.write(written | {"office.json": plan_of(office)})
        for number, trace in tqdm(sorted(recorded.items()), unit="film", disable=None if recorded else True):
            self._film(office, self._jobs[number], trace)

    def _labels(self, job: Job) -> dict[str, Any]:
        entry = self._entries[job.entry]
        beta = float("nan") if entry.beta is None else entry.beta
        labels = {"run": entry.run, "agent": entry.agent, "beta": beta}
        return labels | {"direction": job.direction, "repetition": job.repetition}

    def _film(self, office: Office, job: Job, trace: Trace) -> None:
        entry = self._entries[job.entry]
        course = course_of(office, job.direction)
        title = f"{entry.name}, {job.direction}{'' if trace.finished else ', not finished'}"
        stem = f"{job.entry}-{entry.name}-{job.direction}".replace(" ", "-")
        write_video(frames(office, entry.pilot, trace, course, title), self.results.path / stem, FPS)


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


def _table(trace: Trace) -> pd.DataFrame:
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
    }
    return pd.DataFrame(columns)
