"""Worker processes of an environment, and what is said of one that dies or hangs."""

import contextlib
import multiprocessing
import signal
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from multiprocessing.connection import wait
from typing import Any

import torch
import torchrl._utils
from tensordict import TensorDictBase
from torchrl.envs import EnvBase, ParallelEnv

from rcdsac_trl.system.processes import WorkerError, ending

# Looks at the answers of workers between two looks at the clock and at the processes: about a millisecond.
_LOOKS = 10_000
# A pipe can be broken an instant before its process counts as dead.
_DEATH_S = 1.0


class Workers(ParallelEnv):
    """A ``ParallelEnv`` that says which worker died or hung, and can be closed whatever its workers do.

    It also leaves this process's number of threads alone. The original takes a thread a worker from this process as
    long as the workers live, and when it closes sets the number that the process had when TorchRL was imported. Here
    workers rest while the learner computes.

    Args:
        arguments: as for ``ParallelEnv``.
        timeout_s: seconds without an answer after which a worker counts as hung; None: it never does.
        named: as for ``ParallelEnv``.
    """

    def __init__(self, *arguments: Any, timeout_s: float | None, **named: Any) -> None:
        self._limit_s = timeout_s
        self._broken = False
        super().__init__(*arguments, **named)

    def _start_workers(self) -> None:
        self.num_threads = torch.get_num_threads()
        try:
            with self._killing_those_that_never_start():
                super()._start_workers()
        except (EOFError, OSError) as error:  # the original has removed all workers and tells no more
            of = self.create_env_kwargs[0]
            raise WorkerError(
                f"a worker process (split {of['split']}, seed {of['seed']}) ended before it was ready, or took longer "
                f"than {self._limit_s} s"
            ) from error

    def _reset(self, tensordict: TensorDictBase, **named: Any) -> TensorDictBase:
        with self._reporting():
            return super()._reset(tensordict, **named)

    def _step(self, tensordict: TensorDictBase) -> TensorDictBase:
        with self._reporting():
            return super()._step(tensordict)

    def set_seed(self, seed: int | None = None, static_seed: bool = False) -> int | None:
        """Set the root seed of all workers; see :meth:`rcdsac_trl.world.task.env.NavigationEnv.set_seed`."""
        with self._reporting():
            return super().set_seed(seed, static_seed)

    def _wait_for_workers(self, workers_range: Sequence[int]) -> None:
        """Wait for all to answer. The original does not say which one did not, and takes 10 s to give up a dead one."""
        answered = self._shm_done_flags
        started = time.monotonic()
        missing = list(workers_range)
        while missing:
            for _ in range(_LOOKS):
                missing = [number for number in missing if not answered[number]]
                if not missing:
                    break
            else:
                self._check(missing, time.monotonic() - started)
        for number in workers_range:
            answered[number] = 0

    def _check(self, missing: Sequence[int], waited_s: float) -> None:
        for number in missing:
            if not self._workers[number].is_alive() and not self._shm_done_flags[number]:
                self._fail(number, ending(self._workers[number].exitcode))
        if self._limit_s is not None and waited_s > self._limit_s:
            self._fail(missing[0], f"gave no answer within {self._limit_s:g} s")

    @contextlib.contextmanager
    def _reporting(self) -> Iterator[None]:
        """Say which worker is dead, before one talks to it or when that fails."""
        if not self.is_closed:
            self._check_all()
        try:
            yield
        except (EOFError, OSError) as error:
            wait([worker.sentinel for worker in self._workers], timeout=_DEATH_S)
            self._check_all(error)
            raise

    def _check_all(self, cause: BaseException | None = None) -> None:
        for number, worker in enumerate(self._workers):
            if not worker.is_alive():
                self._fail(number, ending(worker.exitcode), cause)

    @contextlib.contextmanager
    def _killing_those_that_never_start(self) -> Iterator[None]:
        """Kill the workers if starting them takes longer than an answer may: one waits for them without a limit."""
        if self._limit_s is None:
            yield
            return
        timer = threading.Timer(self._limit_s, lambda: [worker.kill() for worker in self._workers])
        timer.start()
        try:
            yield
        finally:
            timer.cancel()

    def _fail(self, number: int, how: str, cause: BaseException | None = None) -> None:
        self._broken = True
        of = self.create_env_kwargs[number]
        agents = ", ".join(str(agent) for agent in of["agent_ids"])
        raise WorkerError(
            f"worker process {number + 1} of {self.num_workers} (split {of['split']}, seed {of['seed']}, "
            f"agents {agents}) {how}"
        ) from cause

    def _shutdown_workers(self) -> None:
        if not self._broken:
            super()._shutdown_workers()
            return
        # Nothing can be asked of them any more. SIGKILL also ends those that are stopped.
        for worker in self._workers:
            worker.kill()
        for worker, channel in zip(self._workers, self.parent_channels, strict=True):
            worker.join()
            channel.close()
        self.is_closed = True

    def close(self, *, raise_if_closed: bool = True) -> None:
        """End the worker processes."""
        threads = torch.get_num_threads()
        super().close(raise_if_closed=raise_if_closed)
        torch.set_num_threads(threads)


def worker_env(make: Callable[..., EnvBase], **named: Any) -> EnvBase:
    """Make the environment of a worker.

    Args:
        make: makes it.
        named: its arguments.
    """
    if multiprocessing.parent_process() is not None:  # the main process makes one too, to learn its specs
        # A terminal sends Ctrl-C to all of them; workers that died of it could not be closed properly any more.
        signal.signal(signal.SIGINT, signal.SIG_IGN)
        # A worker would give up after some hours without work, which the learner may well take: it waits for its
        # pipe to close instead, which happens when the main process ends.
        torchrl._utils.BATCHED_PIPE_TIMEOUT = None
    return make(**named)
