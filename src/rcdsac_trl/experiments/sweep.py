"""Several trainings as one piece of work: each in a process of its own; finished ones are skipped, others continued.

A sweep is a folder with an index of its runs, ``sweep.json``, and one run folder for each. How a run stands is written
in the run's own folder (``state.json``), by whoever runs it, on whichever machine: nothing is said in two places.
"""

import json
import os
import sys
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, Literal, Protocol

from rcdsac_trl.errors import FaultError, UserInputError
from rcdsac_trl.storage import atomic
from rcdsac_trl.system.cores import SHARE
from rcdsac_trl.system.subprocess_job import STOPPED, call

INDEX = "sweep.json"
STATE = "state.json"
CONSOLE = "console.log"
_CONFIG = "config.yaml"  # what makes a folder a run

# What Ctrl-C leaves behind, see cli.py.
_INTERRUPTED = 130


@dataclass(frozen=True)
class State:
    """How a run of a sweep stands.

    Attributes:
        name: ``waiting`` (nobody has begun it), ``started`` (it is running, or was when its machine went down),
            ``interrupted`` (by Ctrl-C), ``stopped`` (a search gave it up), ``failed`` or ``finished`` (evaluated too,
            if that was asked for).
        sentence: why it failed.
        evaluated: overrides of the evaluation that is done.
    """

    name: Literal["waiting", "started", "interrupted", "stopped", "failed", "finished"]
    sentence: str | None = None
    evaluated: tuple[str, ...] | None = None


@dataclass(frozen=True)
class Job:
    """One training of a sweep.

    Attributes:
        name: of its folder; no two jobs of a sweep share it.
        run: the experiment's name for what it tries; None where the command line alone says it.
        algo: its row.
        sensor: its sensor.
        seed: its seed.
        overrides: of `train`, without a folder.
        evaluate: overrides of `evaluate` for the finished run, without the run; None: it is not evaluated.
        folder: the run folder, absolute.
    """

    name: str
    run: str | None
    algo: str
    sensor: str
    seed: int
    overrides: tuple[str, ...]
    evaluate: tuple[str, ...] | None
    folder: Path

    @property
    def state(self) -> State:
        """How it stands; what cannot be read counts as nothing."""
        return _state_of(self.folder)

    @property
    def is_done(self) -> bool:
        """Whether nothing is left to do."""
        state = self.state
        return state.name == "finished" and self.evaluate in (None, state.evaluated)

    def note(self, state: State) -> None:
        """Write down how it stands."""
        self.folder.mkdir(parents=True, exist_ok=True)
        atomic.write(self.folder / STATE, (json.dumps(asdict(state)) + "\n").encode())


class Launcher(Protocol):
    """Where jobs run."""

    def run(self, jobs: Sequence[Job]) -> Iterator[tuple[Job, State]]:
        """Run every job by :func:`execute`, and yield each as it ends; a job that fails stops no other."""


def execute(job: Job, cores: int | None = None, should_stop: Callable[[], bool] | None = None) -> State:
    """Train a job and evaluate it, each in a process of its own, so that whatever happens to it happens to it alone.

    What they print goes to ``console.log`` in the run folder.

    Args:
        job: what to do.
        cores: its share of this machine's; None: all of them.
        should_stop: asked again and again while it trains; once it says so, the job is stopped.
    """
    job.folder.mkdir(parents=True, exist_ok=True)
    if (taken := _taken(job)) is not None:
        return taken
    job.note(State("started"))
    try:
        state = _train_and_evaluate(job, {} if cores is None else {SHARE: str(cores)}, should_stop)
    except KeyboardInterrupt:
        job.note(State("interrupted"))
        raise
    # Others may have found the folder free as well, and a training takes seconds to lock it: theirs was first.
    if state.name == "failed" and (taken := _taken(job)) is not None:
        return taken
    job.note(state)
    return state


def _taken(job: Job) -> State | None:
    """Say that somebody else trains in a job's folder, who says there how it goes; None if nobody does."""
    try:
        atomic.FolderLock(job.folder).close()
    except UserInputError as error:
        return State("failed", str(error))
    return None


def _train_and_evaluate(job: Job, variables: Mapping[str, str], should_stop: Callable[[], bool] | None) -> State:
    folder = _quoted(job.folder)
    has_begun = (job.folder / _CONFIG).exists()
    where = [f"resume={folder}"] if has_begun else [*job.overrides, f"hydra.run.dir={folder}"]
    if (state := _call(job, ["rcdsac_trl.train", *where], variables, should_stop)) is not None:
        return state
    if job.evaluate is not None:
        state = _call(job, ["rcdsac_trl.evaluate", f"run={folder}", *job.evaluate], variables)
    return state or State("finished", evaluated=job.evaluate)


def _call(
    job: Job, module: list[str], variables: Mapping[str, str], should_stop: Callable[[], bool] | None = None
) -> State | None:
    """Run a module's main; return how the job stands if it did not succeed."""
    console = job.folder / CONSOLE
    code = call([sys.executable, "-m", *module], console, variables, should_stop)
    if code == 0:
        return None
    if code == _INTERRUPTED:
        return State("interrupted")
    if code == STOPPED:
        return State("stopped")
    ended = f"exit code {code}" if code > 0 else f"killed by signal {-code}"
    return State("failed", f"{ended}: {_last_line(console)}")


def _last_line(path: Path) -> str:
    lines = path.read_text(errors="replace").split("\n")
    messages = [line.rpartition("\r")[2].strip() for line in lines if line.strip()]
    return messages[-1].removeprefix("rcdsac_trl: ") if messages else "it said nothing"


def _quoted(path: Path) -> str:
    """Write a path so that Hydra reads it as it is."""
    text = str(path).replace("'", "\\'")
    return f"'{text}'"


class Sweep:
    """Jobs, and where they run.

    Args:
        folder: of the sweep.
        experiment: its name.
        jobs: all of them, finished ones too.
        launcher: runs those that are not.
    """

    def __init__(self, folder: Path, experiment: str, jobs: Sequence[Job], launcher: Launcher) -> None:
        self.folder = folder
        self.experiment = experiment
        self.jobs = jobs
        self.launcher = launcher

    def run(self) -> None:
        """Run what is not finished.

        Raises:
            FaultError: when all have ended and some failed; it names them and their folders.
            UserInputError: if another process runs this sweep.
        """
        self.folder.mkdir(parents=True, exist_ok=True)
        lock = atomic.FolderLock(self.folder)
        try:
            self._write_index()
            left = [job for job in self.jobs if not job.is_done]
            done = len(self.jobs) - len(left)
            print(f"{len(self.jobs)} runs in {self.folder}, {done} of them finished before", flush=True)
            self._run(left, done)
        finally:
            lock.close()

    def _run(self, jobs: Sequence[Job], done: int) -> None:
        failed: list[tuple[Job, State]] = []
        for job, state in self.launcher.run(jobs) if jobs else ():
            done += 1
            reason = f" ({state.sentence})" if state.sentence is not None else ""
            print(f"{done}/{len(self.jobs)} {state.name} {job.name}{reason}", flush=True)
            if state.name == "interrupted":  # the job had the Ctrl-C that was meant for all
                raise KeyboardInterrupt
            if state.name != "finished":
                failed.append((job, state))
        if failed:
            named = "; ".join(f"{job.name}: {state.sentence}, see {job.folder / CONSOLE}" for job, state in failed)
            raise FaultError(f"{len(failed)} of {len(self.jobs)} runs failed, the same call continues them: {named}")

    def _write_index(self) -> None:
        """Add the jobs to those that earlier calls put into this folder."""
        entries = {entry["name"]: entry for entry in _index_of(self.folder)}
        for job in self.jobs:
            entries[job.name] = asdict(job) | {"folder": os.path.relpath(job.folder, self.folder)}
        written = {"experiment": self.experiment, "runs": list(entries.values())}
        atomic.write(self.folder / INDEX, (json.dumps(written, indent=1) + "\n").encode())


def runs_of(folder: Path) -> list[tuple[Job, State]]:
    """List the runs of a sweep and how each stands, while it goes on, too.

    Args:
        folder: of the sweep; it may have been moved.

    Raises:
        UserInputError: if it holds none.
    """
    if not (folder / INDEX).exists():
        raise UserInputError(f"{folder} holds no {INDEX}: name a folder that a sweep wrote")
    jobs = [_job(entry, folder) for entry in _index_of(folder)]
    return [(job, job.state) for job in jobs]


def _job(entry: dict[str, Any], folder: Path) -> Job:
    evaluate = entry["evaluate"]
    return Job(
        **entry
        | {
            "overrides": tuple(entry["overrides"]),
            "evaluate": None if evaluate is None else tuple(evaluate),
            "folder": folder.absolute() / entry["folder"],
        }
    )


def _index_of(folder: Path) -> list[dict[str, Any]]:
    path = folder / INDEX
    try:
        entries: list[dict[str, Any]] = json.loads(path.read_bytes())["runs"]
    except FileNotFoundError:
        return []
    except (OSError, ValueError, KeyError, TypeError) as error:
        raise UserInputError(f"{path} cannot be read ({error}): choose another hydra.sweep.dir") from error
    return entries


def _state_of(folder: Path) -> State:
    try:
        values = json.loads((folder / STATE).read_bytes())
        evaluated = values["evaluated"]
        return State(values["name"], values["sentence"], None if evaluated is None else tuple(evaluated))
    except (OSError, ValueError, KeyError, TypeError):
        return State("waiting")
