"""Maps over processes: each drives whole maps by itself, so that none waits for another within a map.

An evaluation waits for them (:func:`evaluate_maps`), a training goes on meanwhile (:class:`EvaluationPool`).
"""

import contextlib
import itertools
from collections.abc import Callable, Generator
from contextlib import AbstractContextManager
from typing import Any

from rcdsac_trl.errors import FaultError
from rcdsac_trl.system import process_pool
from rcdsac_trl.system.interrupts import interruption_point
from rcdsac_trl.system.process_pool import ProcessPool
from rcdsac_trl.system.processes import WorkerError
from rcdsac_trl.system.progress import Watch

Rows = list[dict[str, Any]]
Drive = Callable[[int, Callable[[], None]], Rows]
"""Drives all episodes of the map of a number, one row an episode; before each step it calls what it is given."""

_PRELOADED = "rcdsac_trl.rollout.map_evaluator"


def prepare() -> None:
    """Begin to import what the processes import, and do not wait for it."""
    process_pool.prepare(_PRELOADED)


class EvaluationPool:
    """Processes that drive maps 0, 1, ..., while this one does something else.

    A map's rows follow from its number alone, so they are the same for any number of processes.

    Args:
        make: makes what drives; called once in every process, so it must pickle.
        num_maps: how many maps.
        processes: how many processes, at least one.
        timeout_s: seconds without a step after which a process counts as hung, while one waits for it; None: never.
        at_once: give out all maps now, for one who does not come back for long; else a process that is done gets the
            next one, which shares them better.

    Raises:
        WorkerError: if a process cannot be started.
    """

    def __init__(
        self,
        make: Callable[[], AbstractContextManager[Drive]],
        num_maps: int,
        processes: int,
        *,
        timeout_s: float | None = None,
        at_once: bool = False,
    ) -> None:
        names = [f"driving process {number} of {processes}" for number in range(1, processes + 1)]
        self._waiting = iter(range(num_maps))
        self._pool = ProcessPool([make] * processes, names, module=_PRELOADED, timeout_s=timeout_s)
        try:
            for _ in range(num_maps if at_once else 1):
                for number in range(processes):
                    self._give(number)
        except BaseException:
            self.close()
            raise

    def _give(self, number: int) -> None:
        if (map_index := next(self._waiting, None)) is not None:
            self._pool.send(number, map_index)

    def receive(self, *, until_done: bool, watch: Watch | None = None) -> Generator[Rows, None, None]:
        """Yield the rows of every map that is done and was not yielded before, in any order.

        Args:
            until_done: wait for the maps that are not done; else yield what there is.
            watch: told the steps driven so far, while one waits.

        Raises:
            WorkerError: if a process ends before its work does, or hangs.
            UserInputError: if a process finds that its input is wrong.
        """
        for number, rows in self._pool.answers(until_done=until_done, watch=watch):
            self._give(number)
            yield rows

    def close(self) -> None:
        """End the processes, whatever they do."""
        self._pool.close()


def _nobody(steps: int) -> None:
    """Watch nothing."""


def evaluate_maps(
    make: Callable[[], AbstractContextManager[Drive]], num_maps: int, processes: int, watch: Watch = _nobody
) -> Generator[Rows, None, None]:
    """Drive maps 0, 1, ... and yield the rows of each as it is done, in any order.

    Args:
        make: makes what drives; called once in every process that drives, so with processes it must pickle.
        num_maps: how many maps.
        processes: from :func:`rcdsac_trl.system.processes.resolve_processes`; 0: this one drives.
        watch: told the steps driven so far.

    Raises:
        FaultError: if a process ends before its work does; it has written why to stderr.
        UserInputError: if what drives finds that its input is wrong, in whichever process.
    """
    if processes == 0:
        steps = itertools.count(1)

        def before_step() -> None:
            interruption_point()
            watch(next(steps))

        with make() as drive:
            yield from (drive(map_index, before_step) for map_index in range(num_maps))
        return
    with contextlib.closing(EvaluationPool(make, num_maps, processes)) as pool:
        try:
            yield from pool.receive(until_done=True, watch=watch)
        except WorkerError as error:
            raise FaultError(f"{error}: start again") from error
