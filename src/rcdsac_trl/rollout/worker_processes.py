"""Processes that each hold a part of the agents and drive whole episodes when asked; they talk once an episode.

TorchRL's ``MultiSyncCollector`` would do as much, but runs TorchRL's loop in each process, which costs five agents
more than driving them, and neither tells which process died or hung, nor how, nor can be closed then.
"""

import contextlib
import multiprocessing
import signal
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import AbstractContextManager
from multiprocessing.connection import Connection, wait
from typing import Any, NamedTuple, Protocol, cast

import torch
from tensordict import TensorDictBase

from rcdsac_trl.rollout.worker import Driven, side_by_side
from rcdsac_trl.system.interrupts import interruption_point
from rcdsac_trl.system.processes import START_METHOD, WorkerError, ending

_PRELOADED = "rcdsac_trl.rollout.make_collector"
# How often a process that drives says so, and how often this one looks for Ctrl-C meanwhile.
_ALIVE_EVERY_S = 0.25


class Request(NamedTuple):
    """What is to be driven: an iteration's episodes, on a map, with an actor's weights (packed)."""

    iteration: int
    map_index: int
    weights: bytes


Drive = Callable[[Request, Callable[[], None]], Driven]
"""Drives what is asked for; calls its second argument before every step."""
MakeDrive = Callable[[], AbstractContextManager[Drive]]


class Teams(Protocol):
    """Teams that together hold all agents."""

    def ask(self, request: Request) -> TensorDictBase:
        """Return the episodes of all agents, ``[N, T]``, team after team."""

    def close(self) -> None:
        """End the teams."""


class LocalTeam:
    """One team, in this process.

    Args:
        make: makes what drives.
    """

    def __init__(self, make: MakeDrive) -> None:
        self._stack = contextlib.ExitStack()
        self._drive = self._stack.enter_context(make())

    def ask(self, request: Request) -> TensorDictBase:
        """See :class:`Teams`."""
        return self._drive(request, interruption_point).tensordict()

    def close(self) -> None:
        """See :class:`Teams`."""
        self._stack.close()


class TeamProcesses:
    """A process for each team. Nothing but :meth:`close` works after an error.

    Args:
        makes: what makes each team's drive, in its process; must pickle.
        described: the team of each, for messages.
        timeout_s: seconds in which a process must take a step, else it counts as hung; None: it never does.
    """

    def __init__(self, makes: Sequence[MakeDrive], described: Sequence[str], timeout_s: float | None) -> None:
        self._described = described
        self._timeout_s = timeout_s
        self._hung: set[int] = set()
        self._connections: list[Connection] = []
        self._processes: list[Any] = []
        # What the processes import, imported once.
        multiprocessing.set_forkserver_preload([_PRELOADED])
        context: Any = multiprocessing.get_context(START_METHOD)
        try:
            for make in makes:
                ours, theirs = context.Pipe()
                # A daemon is ended with this process, however that ends.
                process = context.Process(target=_work, args=(theirs, make), daemon=True)
                process.start()
                theirs.close()
                self._connections.append(ours)
                self._processes.append(process)
        except BaseException:
            self.close()
            raise

    def ask(self, request: Request) -> TensorDictBase:
        """See :class:`Teams`.

        Raises:
            WorkerError: if a process dies or hangs.
        """
        for number, connection in enumerate(self._connections):
            with self._reporting(number):
                connection.send(request)
        answers: dict[int, Driven] = {}
        heard_s = dict.fromkeys(range(len(self._connections)), time.monotonic())
        while len(answers) < len(self._connections):
            interruption_point()
            missing = {each: n for n, each in enumerate(self._connections) if n not in answers}
            for connection in cast(list[Connection], wait(list(missing), timeout=_ALIVE_EVERY_S)):
                number = missing[connection]
                with self._reporting(number):
                    answer: Driven | None = connection.recv()
                heard_s[number] = time.monotonic()
                if answer is not None:
                    answers[number] = answer
            for number in missing.values():
                if self._timeout_s is not None and time.monotonic() - heard_s[number] > self._timeout_s:
                    self._hung.add(number)
                    raise self._error(number)
        return side_by_side([answers[number] for number in range(len(self._connections))]).tensordict()

    @contextlib.contextmanager
    def _reporting(self, number: int) -> Iterator[None]:
        """Say which process failed while one talks to it; kill it if it stops in the middle of that."""
        timer = None
        if self._timeout_s is not None:
            timer = threading.Timer(self._timeout_s, self._kill, (number,))
            timer.start()
        try:
            yield
        except (EOFError, OSError) as error:
            self._processes[number].join()
            raise self._error(number) from error
        finally:
            if timer is not None:
                timer.cancel()

    def _kill(self, number: int) -> None:
        self._hung.add(number)
        self._processes[number].kill()

    def _error(self, number: int) -> WorkerError:
        if number in self._hung:
            how = f"gave no answer within {self._timeout_s:g} s"
        else:
            how = ending(self._processes[number].exitcode)
        return WorkerError(f"worker process {number + 1} of {len(self._processes)} ({self._described[number]}) {how}")

    def close(self) -> None:
        """See :class:`Teams`."""
        # They hold nothing that must be kept; SIGKILL also ends those that are stopped.
        for process in self._processes:
            process.kill()
        for process, connection in zip(self._processes, self._connections, strict=True):
            process.join()
            connection.close()
        self._processes, self._connections = [], []


def _work(connection: Connection, make: MakeDrive) -> None:
    """Drive what is asked for until nobody asks any more."""
    # A terminal sends Ctrl-C to all processes; the main one ends the others.
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    torch.set_num_threads(1)
    told_s = time.monotonic()

    def alive() -> None:
        nonlocal told_s
        if time.monotonic() - told_s > _ALIVE_EVERY_S:
            connection.send(None)
            told_s = time.monotonic()

    with make() as drive, contextlib.suppress(EOFError, BrokenPipeError, ConnectionResetError):
        while True:
            connection.send(drive(connection.recv(), alive))
