"""The episodes that are trained on, iteration after iteration, from a collector that is made anew after a fault."""

import contextlib
from collections.abc import Callable, Iterator

from tensordict import TensorDictBase
from torchrl.collectors import Collector

from rcdsac_trl.world.workers import WorkerError


class Episodes:
    """Collects the episodes of one iteration after another.

    Args:
        make: makes a collector from an iteration and the number of its map; it yields ``[..., T]``, the episodes of
            that iteration, then of the next one on the next map, to the end of the schedule.
        set_iteration: told the iteration whose episodes are about to be collected.
        iteration: the first one.
        map_index: the number of its map.
    """

    def __init__(
        self,
        make: Callable[[int, int], Collector],
        set_iteration: Callable[[int], None],
        *,
        iteration: int,
        map_index: int,
    ) -> None:
        self._make = make
        self._set_iteration = set_iteration
        self._collector: Collector | None = None
        self._batches: Iterator[TensorDictBase] = iter(())
        self._start(iteration, map_index)

    def collect(self, iteration: int, map_index: int) -> TensorDictBase:
        """Return the episodes of an iteration, ``[N, T]``; after a fault they may come from any map.

        Args:
            iteration: the next one, or the one that failed.
            map_index: the next map, or after a fault the one to go on with.

        Raises:
            WorkerError: if a worker process died or hung; what was driven on this map is lost.
        """
        try:
            if self._collector is None:
                self._start(iteration, map_index)
            self._set_iteration(iteration)
            batch = next(self._batches)
        except WorkerError:
            self.close()
            raise
        return batch.reshape(-1, batch.shape[-1])

    def _start(self, iteration: int, map_index: int) -> None:
        self._collector = self._make(iteration, map_index)
        self._batches = iter(self._collector)

    def close(self) -> None:
        """End the worker processes, and bear that they may be gone: it must not hide why training ends."""
        if self._collector is not None:
            with contextlib.suppress(Exception):
                self._collector.shutdown(raise_on_error=False)
        self._collector = None
