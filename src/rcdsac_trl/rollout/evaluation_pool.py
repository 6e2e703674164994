"""Maps over processes: each drives whole maps by itself, so that none waits for another within a map.

An evaluation waits for them (:func:`drive_maps`), a training goes on meanwhile (:class:`Drivers`).
"""

import contextlib
import multiprocessing
import signal
import time
from collections.abc import Callable, Generator
from contextlib import AbstractContextManager
from dataclasses import dataclass
from multiprocessing import forkserver
from multiprocessing.connection import Connection, wait
from typing import Any

from rcdsac_trl.errors import FaultError
from rcdsac_trl.system.interrupts import interruption_point
from rcdsac_trl.system.processes import START_METHOD, WorkerError, ending

Rows = list[dict[str, Any]]
Drive = Callable[[int, Callable[[], None]], Rows]
"""Drives all episodes of the map of a number, one row an episode; before each step it calls what it is given."""

_PRELOADED = "rcdsac_trl.rollout.map_evaluator"
# Seconds between two looks at Ctrl-C and at processes that say nothing, while one waits for them.
_LOOK_S = 0.2


def prepare() -> None:
    """Begin to import what the processes import, in the one they are forked from, and do not wait for it."""
    _preload()
    if START_METHOD == "forkserver":
        forkserver.ensure_running()


def _preload() -> None:
    multiprocessing.set_forkserver_preload([_PRELOADED])


@dataclass
class _Driver:
    """A process that drives, how many maps it was given, and when it was last seen driving."""

    process: Any
    steps: Any
    maps_to_do: int = 0
    seen_steps: int = 0
    seen_s: float = 0.0


class Drivers:
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
        self._timeout_s = timeout_s
        self._waiting = iter(range(num_maps))
        self._drivers: dict[Connection, _Driver] = {}
        _preload()
        context: Any = multiprocessing.get_context(START_METHOD)
        try:
            for _ in range(processes):
                ours, theirs = context.Pipe()
                steps = context.RawValue("L", 0)
                # A daemon is ended with this process, and ends by itself where this one cannot see to it any more.
                process = context.Process(target=_work, args=(theirs, make, steps), daemon=True)
                process.start()
                theirs.close()
                self._drivers[ours] = _Driver(process, steps)
            for _ in range(num_maps if at_once else 1):
                for connection in self._drivers:
                    self._give(connection)
        except BaseException as error:
            number = len(self._drivers) + 1
            self.close()
            if isinstance(error, EOFError | ConnectionError):  # the process that they are forked from is gone
                raise WorkerError(f"driving process {number} of {processes} did not start") from error
            raise

    def _give(self, connection: Connection) -> None:
        if (map_index := next(self._waiting, None)) is not None:
            self._drivers[connection].maps_to_do += 1
            with contextlib.suppress(BrokenPipeError, ConnectionResetError):  # who receives is told of a dead process
                connection.send(map_index)

    @property
    def _busy(self) -> list[Connection]:
        return [connection for connection, driver in self._drivers.items() if driver.maps_to_do]

    def receive(self, *, until_done: bool) -> Generator[Rows, None, None]:
        """Yield the rows of every map that is done and was not yielded before, in any order.

        Args:
            until_done: wait for the maps that are not done; else yield what there is.

        Raises:
            WorkerError: if a process ends before its work does, or hangs.
        """
        for driver in self._drivers.values():
            driver.seen_s = time.monotonic()  # nobody looked before
        while busy := self._busy:
            answered = wait(busy, timeout=_LOOK_S if until_done else 0.0)
            if not answered and not until_done:
                return
            for connection in busy:
                if connection in answered:
                    yield self._answer_of(connection)
                else:
                    self._check_steps(connection)
            interruption_point()

    def _answer_of(self, connection: Connection) -> Rows:
        driver = self._drivers[connection]
        try:
            rows: Rows = connection.recv()
        except (EOFError, OSError) as error:
            driver.process.join()
            raise WorkerError(f"{self._name_of(connection)} {ending(driver.process.exitcode)}") from error
        driver.maps_to_do -= 1
        self._give(connection)
        return rows

    def _check_steps(self, connection: Connection) -> None:
        driver, now = self._drivers[connection], time.monotonic()
        if driver.steps.value != driver.seen_steps:
            driver.seen_steps, driver.seen_s = driver.steps.value, now
        elif self._timeout_s is not None and now - driver.seen_s > self._timeout_s:
            raise WorkerError(f"{self._name_of(connection)} made no step within {self._timeout_s:g} s")

    def _name_of(self, connection: Connection) -> str:
        number = list(self._drivers).index(connection) + 1
        return f"driving process {number} of {len(self._drivers)}"

    def close(self) -> None:
        """End the processes, whatever they do."""
        for driver in self._drivers.values():
            driver.process.kill()  # also ends those that are stopped
        for connection, driver in self._drivers.items():
            driver.process.join()
            connection.close()
        self._drivers = {}


def drive_maps(
    make: Callable[[], AbstractContextManager[Drive]], num_maps: int, processes: int
) -> Generator[Rows, None, None]:
    """Drive maps 0, 1, ... and yield the rows of each as it is done, in any order.

    Args:
        make: makes what drives; called once in every process that drives, so with processes it must pickle.
        num_maps: how many maps.
        processes: from :func:`resolve_processes`; 0: this one drives.

    Raises:
        FaultError: if a process ends before its work does; it has written why to stderr.
    """
    if processes == 0:
        with make() as drive:
            yield from (drive(map_index, interruption_point) for map_index in range(num_maps))
        return
    with contextlib.closing(Drivers(make, num_maps, processes)) as drivers:
        try:
            yield from drivers.receive(until_done=True)
        except WorkerError as error:
            raise FaultError(f"{error}: nothing is written, start again") from error


def _work(connection: Connection, make: Callable[[], AbstractContextManager[Drive]], steps: Any) -> None:
    """Drive the maps whose numbers arrive, until nobody is there to tell."""
    # A terminal sends Ctrl-C to all processes; the main one ends the others.
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    main = multiprocessing.parent_process()
    assert main is not None

    def step() -> None:
        steps.value += 1
        if not main.is_alive():
            raise SystemExit

    with make() as drive, contextlib.suppress(EOFError, BrokenPipeError, ConnectionResetError):
        while connection in wait([connection, main.sentinel]):
            connection.send(drive(connection.recv(), step))
