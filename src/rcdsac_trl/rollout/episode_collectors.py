"""The episodes that are trained on, iteration after iteration; what drives them is made anew after a fault."""

import contextlib
from collections.abc import Callable, Iterator
from typing import Protocol

import torch
from tensordict import TensorDictBase
from torchrl.collectors import Collector

from rcdsac_trl.rollout.env_workers import EnvWorkers
from rcdsac_trl.rollout.worker_processes import RolloutRequest, WorkerGroup
from rcdsac_trl.system.processes import WorkerError


class EpisodeCollector(Protocol):
    """Collects the episodes of one iteration after another."""

    def collect(self, iteration: int, map_index: int) -> TensorDictBase:
        """Return the episodes of an iteration, ``[N, T]``, with at least what the replay and the metrics read.

        Args:
            iteration: the next one, or the one that failed.
            map_index: the next map, or after a fault the one to go on with.

        Raises:
            WorkerError: if a worker process died or hung; what was driven on this map is lost.
            UserInputError: if the input of a worker is wrong.
        """

    def close(self) -> None:
        """End the worker processes, and bear that they may be gone: it must not hide why training ends."""


class WorkerEpisodeCollector:
    """Has whole episodes driven by a group of workers, each with a copy of the actor that comes with every request.

    Args:
        make: makes the group.
        weights: packs the actor's weights as they are now.
    """

    def __init__(self, make: Callable[[], WorkerGroup], weights: Callable[[], bytes]) -> None:
        self._make = make
        self._weights = weights
        self._group: WorkerGroup | None = make()

    def collect(self, iteration: int, map_index: int) -> TensorDictBase:
        """See :class:`EpisodeCollector`."""
        try:
            if self._group is None:
                self._group = self._make()
            return self._group.ask(RolloutRequest(iteration, map_index, self._weights()))
        except WorkerError:
            self.close()
            raise

    def close(self) -> None:
        """See :class:`EpisodeCollector`."""
        if self._group is not None:
            self._group.close()
        self._group = None


class TorchRLEpisodeCollector:
    """Takes the episodes from one of TorchRL's collectors.

    Args:
        make: makes a collector from an iteration and the number of its map; it yields ``[..., T]``, the episodes of
            that iteration, then of the next one on the next map, to the end of the schedule.
        set_iteration: told the iteration whose episodes are about to be collected.
        workers: the processes of its environment.
        begin: begins the episodes on a map in this process, for a worker that dies of wrong input says nothing of it.
    """

    def __init__(
        self,
        make: Callable[[int, int], Collector],
        set_iteration: Callable[[int], None],
        *,
        workers: EnvWorkers,
        begin: Callable[[int], object],
    ) -> None:
        self._make = make
        self._set_iteration = set_iteration
        self._workers = workers
        self._begin = begin
        self._collector: Collector | None = None
        self._batches: Iterator[TensorDictBase] = iter(())

    def collect(self, iteration: int, map_index: int) -> TensorDictBase:
        """See :class:`EpisodeCollector`."""
        try:
            if self._collector is None:
                self._start(iteration, map_index)
            self._set_iteration(iteration)
            batch = next(self._batches)
        except WorkerError:
            self.close()
            raise
        except (RuntimeError, EOFError, OSError) as error:
            fault = self._workers.fault(error)
            if fault is None:
                raise
            self._workers.kill()
            self.close()
            self._begin(map_index)
            raise fault from error
        return batch.reshape(-1, batch.shape[-1])

    def _start(self, iteration: int, map_index: int) -> None:
        self._workers.before_start()
        self._collector = self._make(iteration, map_index)
        self._workers.started()
        self._batches = iter(self._collector)

    def close(self) -> None:
        """See :class:`EpisodeCollector`."""
        threads = torch.get_num_threads()
        if self._collector is not None:
            with contextlib.suppress(Exception):
                self._collector.shutdown(raise_on_error=False)
        self._collector = None
        self._workers.kill()
        torch.set_num_threads(threads)  # a ParallelEnv changes it when it is closed
