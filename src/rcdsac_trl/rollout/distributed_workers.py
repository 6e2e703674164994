"""Teams in processes of a ``torch.distributed`` group, held by TorchRL's ``DistributedCollector``.

Import this module only where it is wanted: it takes a second.
"""

import contextlib
import multiprocessing
import multiprocessing.connection
import signal
import socket
import sys
import time
import warnings
from collections.abc import Iterator, Mapping, Sequence
from concurrent.futures import Future, wait
from datetime import timedelta
from itertools import count
from multiprocessing.process import BaseProcess
from typing import Any

import torch
import torch.distributed
from tensordict import TensorDict, TensorDictBase
from torch.distributed import TCPStore
from torchrl.collectors.distributed import DistributedCollector

from rcdsac_trl.errors import first_line
from rcdsac_trl.rollout.torchrl_worker import TeamCollector, beside, watch
from rcdsac_trl.rollout.worker_processes import MakeDrive, Request
from rcdsac_trl.system.processes import WorkerError, ending

# How often a process that drives says so.
_ALIVE_EVERY_S = 0.25
# The group notices an instant before the operating system that a process is dead.
_DEATH_S = 1.0
# How long who waits for processes may take to notice that they were killed.
_NOTICE_S = 10.0
# Who waits for a request is ended by the end of the store, not by the clock.
_FOR_EVER = timedelta(days=365)


class StoreTeamCollector(TeamCollector):
    """Takes its requests from a store, and writes its steps there: the group's own messages carry neither.

    Args:
        create_env_fn: as for :class:`TeamCollector`.
        store: host and port of the store.
        worker: which of the collectors this is.
        settings: what TorchRL passes on to collectors that step an environment; there is none here.
    """

    def __init__(
        self, create_env_fn: Sequence[MakeDrive], *, store: tuple[str, int], worker: int, **settings: Any
    ) -> None:
        if multiprocessing.parent_process() is not None:
            # A terminal sends Ctrl-C to all processes; the main one ends the others.
            signal.signal(signal.SIGINT, signal.SIG_IGN)
        super().__init__(create_env_fn, worker_idx=worker)
        self._worker = worker
        self._store = TCPStore(*store, is_master=False)
        self._store.set_timeout(_FOR_EVER)
        self._told_s = time.monotonic()
        self._tell()

    def iterator(self) -> Iterator[TensorDictBase]:
        """Yield what one request after another asks for, ``[N, T]``."""
        batches = super().iterator()
        for number in count():
            self.prepare(_unpacked(self._store.get(_request_key(number))))
            self._tell()
            driven = next(batches).contiguous()
            self._tell()
            yield driven

    def _count(self) -> None:
        super()._count()
        if time.monotonic() - self._told_s > _ALIVE_EVERY_S:
            self._tell()

    def _tell(self) -> None:
        self._store.set(_steps_key(self._worker), str(self._shown))
        self._told_s = time.monotonic()


class _Collector(DistributedCollector):
    """A ``DistributedCollector`` that one can look into while it starts.

    It also knows what a batch looks like, where the original drives one in this process to find out.

    Args:
        makes: what makes the drive of each process.
        example: a batch of one process.
        given: as for ``DistributedCollector``.
    """

    def __init__(self, makes: Sequence[MakeDrive], example: TensorDict, **given: Any) -> None:
        self._example = example
        self._given = {"create_env_fn": list(makes), **given}
        self.jobs: list[Any] = []

    def start(self) -> None:
        """Start the processes and wait until all are ready, for ever if one dies meanwhile."""
        with warnings.catch_warnings():
            # Weights come with a request.
            warnings.filterwarnings("ignore", "The policy is not an nn.Module", UserWarning)
            super().__init__(**self._given)

    def _make_container(self) -> None:
        self._tensordict_out = (
            self._example.expand(self.num_workers, *self._example.shape).clone().to_lazystack(0).lock_()
        )
        self._tensordict_out_unbind = self._tensordict_out.unbind(0)


class DistributedTeams:
    """A process of a ``torch.distributed`` group for each team. Nothing but :meth:`close` works after an error.

    The episodes are messages of the group, by gloo. Requests, with their weights, and steps go through a store beside
    it: TorchRL's own way for weights, ``DistributedWeightSyncScheme``, carries nothing else, and waits for ever for a
    process that died. A group cannot replace a member: after a fault it is made anew.

    Args:
        makes: what makes each team's drive, by what describes the team in messages; teams are of one size, and what
            makes them must pickle.
        example: what a team returns, with any numbers.
        slurm: options of the jobs, as submitit names them, by which processes are started on other machines; None
            starts them on this one.
        timeout_s: seconds in which a process must be ready, and take a step, else it counts as hung; None: it never
            does.
    """

    def __init__(
        self,
        makes: Mapping[str, MakeDrive],
        example: TensorDict,
        *,
        slurm: Mapping[str, Any] | None,
        timeout_s: float | None,
    ) -> None:
        self._described = list(makes)
        self._timeout_s = timeout_s
        self._waiting: Future[TensorDictBase] | None = None
        self._batches: Iterator[TensorDictBase] | None = None
        self._asked = 0
        host = "localhost" if slurm is None else socket.gethostbyname(socket.gethostname())
        self._store = TCPStore(host, 0, is_master=True, wait_for_workers=False, timeout=_FOR_EVER)
        store = (host, self._store.port)
        self._collector = _Collector(
            list(makes.values()),
            example,
            collector_class=StoreTeamCollector,
            collector_kwargs=[{"store": store, "worker": process} for process in range(len(makes))],
            # Teams drive what they are asked for: nobody counts frames.
            frames_per_batch=len(makes),
            total_frames=sys.maxsize,
            sync=True,
            weight_sync_schemes={},
            launcher="mp" if slurm is None else "submitit",
            slurm_kwargs=slurm,
            tcp_port=_free_port(),
        )

    def ask(self, request: Request) -> TensorDictBase:
        """See :class:`~rcdsac_trl.rollout.worker_processes.Teams`.

        Raises:
            WorkerError: if a process dies or hangs.
        """
        for process in range(len(self._described)):
            self._store.delete_key(_steps_key(process))  # what it tells from here on is of this request
        self._store.set(_request_key(self._asked), _packed(request))  # type: ignore[arg-type]  # takes bytes, too
        self._waiting = beside(self._collect)
        hung = watch(self._waiting, self._steps, len(self._described), self._timeout_s)
        if hung is not None:
            raise WorkerError(f"{self._name(hung)} gave no answer within {self._timeout_s:g} s")
        try:
            batch = self._waiting.result()
        except RuntimeError as error:  # of the group, or of its store
            sentinels = [job.sentinel for job in self._collector.jobs if isinstance(job, BaseProcess)]
            multiprocessing.connection.wait(sentinels, timeout=_DEATH_S)
            self._check_jobs(error)
            raise WorkerError(f"the distributed group failed: {first_line(error)}") from error
        self._store.delete_key(_request_key(self._asked))
        self._asked += 1
        return batch

    def _collect(self) -> TensorDictBase:
        if self._batches is None:
            self._collector.start()
            self._batches = iter(self._collector)
        return torch.cat(list(next(self._batches).unbind(0)))

    def _steps(self) -> dict[int, float]:
        """Return how many steps each process has taken, of those that are ready."""
        self._check_jobs(None)
        keys = {process: _steps_key(process) for process in range(len(self._described))}
        return {process: float(self._store.get(key)) for process, key in keys.items() if self._store.check([key])}

    def _check_jobs(self, cause: BaseException | None) -> None:
        for process, job in enumerate(self._collector.jobs):
            if (how := _ended(job)) is not None:
                raise WorkerError(f"{self._name(process)} {how}") from cause

    def _name(self, process: int) -> str:
        return f"distributed process {process + 1} of {len(self._described)} ({self._described[process]})"

    def close(self) -> None:
        """See :class:`~rcdsac_trl.rollout.worker_processes.Teams`."""
        # They hold nothing that must be kept; TorchRL would ask each of them to end, and wait for its answer.
        for job in self._collector.jobs:
            if isinstance(job, BaseProcess):
                job.kill()
                job.join()
            else:
                with contextlib.suppress(Exception):  # whatever SLURM is by now
                    job.cancel(check=False)
        if self._waiting is not None:
            wait([self._waiting], timeout=_NOTICE_S)
        if torch.distributed.is_initialized():
            torch.distributed.destroy_process_group()


def _packed(request: Request) -> bytes:
    return f"{request.iteration} {request.map_index} ".encode() + request.weights


def _unpacked(packed: bytes) -> Request:
    iteration, map_index, weights = packed.split(b" ", 2)
    return Request(int(iteration), int(map_index), weights)


def _request_key(number: int) -> str:
    return f"request {number}"


def _steps_key(process: int) -> str:
    return f"steps {process}"


def _ended(job: Any) -> str | None:
    """Say how a process or a job of SLURM ended; None if it did not."""
    if isinstance(job, BaseProcess):
        return None if job.is_alive() else ending(job.exitcode)
    return f"ended, {job.state} in SLURM" if job.done() else None


def _free_port() -> int:
    with socket.socket() as free:
        free.bind(("", 0))
        return int(free.getsockname()[1])
