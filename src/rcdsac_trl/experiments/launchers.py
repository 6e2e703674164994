"""Where the runs of a sweep run: one class for each file of ``conf/launcher``, whose keys are its fields.

Each hands jobs to an engine that exists; what a job is, :func:`~rcdsac_trl.experiments.sweep.execute` alone knows.
Every job is a process of its own that is given its share of the cores.
"""

import importlib
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from types import ModuleType
from typing import Any, Literal

from rcdsac_trl.config.typed import read
from rcdsac_trl.errors import FaultError, UserInputError, first_line
from rcdsac_trl.experiments.sweep import Job, Launcher, State, execute
from rcdsac_trl.system.checks import check_least
from rcdsac_trl.system.cores import usable_cores
from rcdsac_trl.system.extras import needs

Ended = Iterator[tuple[Job, State]]
Extra = str | int | float | bool | tuple[str, ...] | Mapping[str, str | int | float | bool]
"""What a parameter of submitit may be."""


def _engine(package: str) -> ModuleType:
    return importlib.import_module(package)


def _check(settings: object, lowest: int, *keys: str) -> None:
    for key in keys:
        check_least(f"launcher.{key}", getattr(settings, key), lowest)


def _fault(error: BaseException) -> State:
    """Say that an engine lost a job: its machine went down, it was cancelled or refused."""
    return State("failed", f"{type(error).__name__}: {first_line(error)}")


@dataclass(frozen=True)
class LocalLauncher:
    """One run after another, on this machine, each with all cores."""

    name: Literal["local"]

    def run(self, jobs: Sequence[Job]) -> Ended:
        """Run every job, see :class:`~rcdsac_trl.experiments.sweep.Launcher`."""
        for job in jobs:
            yield job, execute(job)


@dataclass(frozen=True)
class JoblibLauncher:
    """Several runs at once on this machine, which share its cores."""

    name: Literal["joblib"]
    cores_per_run: int
    runs_at_once: int | Literal["auto"]

    def __post_init__(self) -> None:
        """Refuse what is below 1, and a missing package."""
        _check(self, 1, "cores_per_run")
        if self.runs_at_once != "auto":
            _check(self, 1, "runs_at_once")
        needs("joblib", f"launcher={self.name}", extra=self.name, instead="launcher=local")

    def run(self, jobs: Sequence[Job]) -> Ended:
        """Run every job, see :class:`~rcdsac_trl.experiments.sweep.Launcher`."""
        joblib = _engine("joblib")
        at_once = self.runs_at_once if self.runs_at_once != "auto" else max(1, usable_cores() // self.cores_per_run)

        def one(job: Job) -> tuple[Job, State]:
            return job, execute(job, self.cores_per_run)

        # A thread only waits for its job's process.
        parallel = joblib.Parallel(n_jobs=at_once, backend="threading", return_as="generator_unordered")
        yield from parallel(joblib.delayed(one)(job) for job in jobs)


@dataclass(frozen=True)
class SlurmLauncher:
    """Each run a job of a SLURM array, by submitit."""

    name: Literal["slurm"]
    cluster: Literal["slurm", "local"]
    partition: str | None
    timeout_min: int
    requeues: int
    cores_per_run: int
    gpus_per_run: int
    runs_at_once: int
    extra: Mapping[str, Extra]

    def __post_init__(self) -> None:
        """Refuse what is below its limit, a missing package, and what it does not understand."""
        _check(self, 1, "timeout_min", "cores_per_run", "runs_at_once")
        _check(self, 0, "requeues", "gpus_per_run")
        needs("submitit", f"launcher={self.name}", extra=self.name, instead="launcher=local")
        try:  # its executor for debugging knows the names of all others
            _engine("submitit").AutoExecutor(folder=".", cluster="debug").update_parameters(**self._parameters)
        except (NameError, AssertionError) as error:
            raise UserInputError(f"launcher.extra is not what submitit takes: {first_line(error)}") from error

    @property
    def _parameters(self) -> dict[str, Any]:
        """What submitit is asked for; `extra` wins."""
        asked = {
            "name": "rcdsac_trl",
            "timeout_min": self.timeout_min,
            "nodes": 1,
            "tasks_per_node": 1,
            "cpus_per_task": self.cores_per_run,
            "gpus_per_node": self.gpus_per_run,
            "slurm_array_parallelism": self.runs_at_once,
            "slurm_partition": self.partition,  # None counts as not given
        }
        return asked | {key: list(value) if isinstance(value, tuple) else value for key, value in self.extra.items()}

    def run(self, jobs: Sequence[Job]) -> Ended:
        """Run every job, see :class:`~rcdsac_trl.experiments.sweep.Launcher`."""
        submitit = _engine("submitit")
        logs = jobs[0].folder.parent / ".submitit" / "%j"
        try:
            executor = submitit.AutoExecutor(folder=logs, cluster=self.cluster, slurm_max_num_timeout=self.requeues)
            executor.update_parameters(**self._parameters)
            submitted = executor.map_array(Requeued(self.cores_per_run), list(jobs))
        except Exception as error:  # whatever submitit and SLURM find to say
            raise FaultError(f"launcher=slurm: {first_line(error)}") from error
        of = dict(zip(submitted, jobs, strict=True))
        print(f"submitted {len(jobs)} jobs to {self.cluster}; their logs: {logs.parent}", flush=True)
        for ended in submitit.helpers.as_completed(submitted, poll_frequency=2):
            lost = ended.exception()
            yield of[ended], ended.result() if lost is None else _fault(lost)


class Requeued:
    """Runs a job on a node of SLURM, and on another one after a time-out or a preemption: the run goes on there.

    Args:
        cores: of the job.
    """

    def __init__(self, cores: int) -> None:
        self.cores = cores

    def __call__(self, job: Job) -> State:
        """Run a job."""
        return execute(job, self.cores)

    def checkpoint(self, job: Job) -> Any:
        """Say what is submitted again, where submitit asks: the same, since a job finds what it has saved."""
        return _engine("submitit").helpers.DelayedSubmission(self, job)


@dataclass(frozen=True)
class RayLauncher:
    """Each run a task of a Ray cluster."""

    name: Literal["ray"]
    address: str | None
    cores_per_run: int
    gpus_per_run: int

    def __post_init__(self) -> None:
        """Refuse what is below its limit, and a missing package."""
        _check(self, 1, "cores_per_run")
        _check(self, 0, "gpus_per_run")
        needs("ray", f"launcher={self.name}", extra=self.name, instead="launcher=local")

    def run(self, jobs: Sequence[Job]) -> Ended:
        """Run every job, see :class:`~rcdsac_trl.experiments.sweep.Launcher`."""
        ray = _engine("ray")
        own = {"num_cpus": usable_cores(), "include_dashboard": False} if self.address is None else {}
        try:
            ray.init(address=self.address or "local", log_to_driver=False, **own)
        except Exception as error:
            raise FaultError(f"launcher.address={self.address}: {first_line(error)}") from error
        try:
            task = ray.remote(num_cpus=self.cores_per_run, num_gpus=self.gpus_per_run)(execute)
            waiting = {task.remote(job, self.cores_per_run): job for job in jobs}
            while waiting:
                ended = ray.wait(list(waiting), num_returns=1)[0][0]
                yield waiting.pop(ended), _result(partial(ray.get, ended))
        finally:
            ray.shutdown()


def _result(get: partial[State]) -> State:
    try:
        return get()
    except Exception as error:
        return _fault(error)


LAUNCHERS: Mapping[str, type[Launcher]] = {
    "local": LocalLauncher,
    "joblib": JoblibLauncher,
    "slurm": SlurmLauncher,
    "ray": RayLauncher,
}


def read_launcher(values: Mapping[str, Any]) -> Launcher:
    """Make a launcher of its section.

    Raises:
        UserInputError: for what it does not understand, and if its package is missing.
    """
    if (name := values["name"]) not in LAUNCHERS:
        raise UserInputError(f"launcher.name={name} is unknown: choose one of {', '.join(LAUNCHERS)}")
    return read(LAUNCHERS[name], values, "launcher")
