"""An evaluation over processes: each drives whole maps by itself, so that none waits for another within a map."""

import contextlib
import multiprocessing
import os
import signal
from collections.abc import Callable, Generator
from contextlib import AbstractContextManager
from multiprocessing.connection import Connection, wait
from typing import Any, Literal, cast

from rcdsac_trl.errors import FaultError, UserInputError
from rcdsac_trl.world.workers import START_METHOD

Rows = list[dict[str, Any]]
Drive = Callable[[int], Rows]
"""Drives all episodes of the map of a number, one row an episode."""

_PRELOADED = "rcdsac_trl.pipeline.build"


def resolve_processes(num_workers: int | Literal["auto"], num_maps: int) -> int:
    """Return how many processes drive besides this one; 0: this one drives itself.

    Args:
        num_workers: ``"auto"`` takes one for each core that this process may use, none where that is one.
        num_maps: there is no use for more processes than maps.

    Raises:
        UserInputError: if there is no such number of processes.

    Example:
        >>> resolve_processes(4, num_maps=3), resolve_processes(4, num_maps=1)
        (3, 0)
    """
    if num_workers == "auto":
        num_workers = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
    if not isinstance(num_workers, int) or num_workers < 0:
        raise UserInputError(f"num_workers={num_workers!r} is not a number of processes: give 0 or more, or auto")
    used = min(num_workers, num_maps)
    return used if used > 1 else 0


def drive_maps(
    make: Callable[[], AbstractContextManager[Drive]], num_maps: int, processes: int
) -> Generator[Rows, None, None]:
    """Drive maps 0, 1, ... and yield the rows of each as it is done, in any order.

    A map's rows follow from its number alone, so they are the same for any number of processes.

    Args:
        make: makes what drives; called once in every process that drives, so with processes it must pickle.
        num_maps: how many maps.
        processes: from :func:`resolve_processes`.

    Raises:
        FaultError: if a process ends before its work does; it has written why to stderr.
    """
    if processes == 0:
        with make() as drive:
            yield from map(drive, range(num_maps))
        return
    # What the processes import, imported once.
    multiprocessing.set_forkserver_preload([_PRELOADED])
    context: Any = multiprocessing.get_context(START_METHOD)
    workers: dict[Connection, Any] = {}
    try:
        for _ in range(processes):
            ours, theirs = context.Pipe()
            # A daemon is ended with this process, however that ends.
            worker = context.Process(target=_work, args=(theirs, make), daemon=True)
            worker.start()
            theirs.close()
            workers[ours] = worker
        yield from _share_out(num_maps, workers)
    finally:
        for worker in workers.values():
            worker.terminate()
        for connection, worker in workers.items():
            worker.join()
            connection.close()


def _share_out(num_maps: int, workers: dict[Connection, Any]) -> Generator[Rows, None, None]:
    """Give each worker the next map whenever it has finished one."""
    waiting = iter(range(num_maps))
    busy = list(workers)
    for connection in busy:
        connection.send(next(waiting))
    while busy:
        for connection in cast(list[Connection], wait(busy)):
            try:
                rows: Rows = connection.recv()
            except EOFError as error:
                workers[connection].join()
                code = workers[connection].exitcode
                raise FaultError(
                    f"a process of the evaluation ended too early (exit code {code}): nothing is written, start again"
                ) from error
            yield rows
            following = next(waiting, None)
            if following is None:
                busy.remove(connection)
            else:
                connection.send(following)


def _work(connection: Connection, make: Callable[[], AbstractContextManager[Drive]]) -> None:
    """Drive the maps whose numbers arrive, until nobody is there to tell."""
    # A terminal sends Ctrl-C to all processes; the main one ends the others.
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    with make() as drive, contextlib.suppress(EOFError, BrokenPipeError, ConnectionResetError):
        while True:
            connection.send(drive(connection.recv()))
