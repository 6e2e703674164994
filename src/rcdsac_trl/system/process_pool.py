"""The one pool of processes: collection, validation and evaluation all drive in it."""

import contextlib
import multiprocessing
import signal
import threading
from collections.abc import Callable, Iterator, Sequence
from contextlib import AbstractContextManager
from multiprocessing import forkserver
from multiprocessing.connection import Connection, wait
from typing import Any, cast

from rcdsac_trl.errors import UserInputError
from rcdsac_trl.system.interrupts import interruption_point
from rcdsac_trl.system.liveness import Liveness
from rcdsac_trl.system.processes import START_METHOD, WorkerError, check_may_start_processes, ending
from rcdsac_trl.system.progress import Watch

Serve = Callable[[Any, Callable[[], None]], Any]
"""Answers a request; calls its second argument before every step, which shows that it does not hang.

A ``UserInputError`` of it, or as it is made, is an answer, too: it is raised where the answers are asked for.
"""
MakeServe = Callable[[], AbstractContextManager[Serve]]

# Seconds between two looks at Ctrl-C and at processes that say nothing, while one waits for them.
_LOOK_S = 0.2


def preload(module: str) -> None:
    """Let the processes to come be forked from one that has imported a module."""
    multiprocessing.set_forkserver_preload([module])


def prepare(module: str) -> None:
    """Begin to import a module in the process that others are forked from, and do not wait for it."""
    preload(module)
    if START_METHOD == "forkserver":
        forkserver.ensure_running()


class ProcessPool:
    """Processes that each make a server once and answer requests. Nothing but :meth:`close` works after an error.

    Args:
        makes: what makes each process's server, there; must pickle.
        names: of the processes, for messages.
        module: what they import, imported once.
        timeout_s: seconds without a step after which a process counts as hung, while one waits for it; see
            :class:`~rcdsac_trl.system.liveness.Liveness`. None: it never does.

    Attributes:
        processes: the processes, in the order of their names.

    Raises:
        WorkerError: if a process cannot be started.
        UserInputError: if this process may start none.
    """

    def __init__(
        self, makes: Sequence[MakeServe], names: Sequence[str], *, module: str, timeout_s: float | None
    ) -> None:
        check_may_start_processes()
        self.processes: list[Any] = []
        self._names = names
        self._timeout_s = timeout_s
        self._connections: list[Connection] = []
        self._steps: list[Any] = []
        self._open_requests = [0] * len(makes)
        self._liveness: dict[int, Liveness] = {}
        self._hung: set[int] = set()
        preload(module)
        context: Any = multiprocessing.get_context(START_METHOD)
        try:
            for make in makes:
                ours, theirs = context.Pipe()
                steps = context.RawValue("L", 0)
                # A daemon is ended with this process, and ends by itself where this one cannot see to it any more.
                process = context.Process(target=_serve, args=(theirs, make, steps), daemon=True)
                process.start()
                theirs.close()
                self._connections.append(ours)
                self._steps.append(steps)
                self.processes.append(process)
        except BaseException as error:
            number = len(self.processes)
            self.close()
            if isinstance(error, EOFError | ConnectionError):  # the process that they are forked from is gone
                raise WorkerError(f"{names[number]} did not start") from error
            raise

    def __len__(self) -> int:
        """Return the number of processes."""
        return len(self.processes)

    def send(self, number: int, request: Any) -> None:
        """Ask one process for something, behind what it was asked for before.

        Raises:
            WorkerError: if it is dead, or stops in the middle of taking the request.
        """
        with self._reporting(number):
            self._connections[number].send(request)
        self._open_requests[number] += 1

    def answers(self, *, until_done: bool, watch: Watch | None = None) -> Iterator[tuple[int, Any]]:
        """Yield number of the process and answer, for every request that is answered, in any order.

        Args:
            until_done: wait for all requests, also those that are sent meanwhile; else yield what there is.
            watch: told the steps of all processes while one waits.

        Raises:
            WorkerError: if a process ends before its work does, or hangs.
            UserInputError: if a process finds that its input is wrong.
        """
        if self._timeout_s is not None:  # nobody looked before
            self._liveness = {
                number: Liveness(process.pid, self._timeout_s, self._steps[number].value)
                for number, process in enumerate(self.processes)
            }
        while busy := [number for number, requests in enumerate(self._open_requests) if requests]:
            by_connection = {self._connections[number]: number for number in busy}
            answered = cast(list[Connection], wait(list(by_connection), timeout=_LOOK_S if until_done else 0.0))
            if not answered and not until_done:
                return
            for connection, number in by_connection.items():
                if connection in answered:
                    with self._reporting(number):
                        answer = connection.recv()
                    if isinstance(answer, UserInputError):
                        raise answer
                    self._open_requests[number] -= 1
                    if number in self._liveness:
                        self._liveness[number].renew(self._steps[number].value)
                    yield number, answer
                else:
                    self._check_steps(number)
            interruption_point()
            if watch is not None:
                watch(sum(steps.value for steps in self._steps))

    def _check_steps(self, number: int) -> None:
        if number in self._liveness and self._liveness[number].hangs(self._steps[number].value):
            self._hung.add(number)
            raise self._error(number)

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
            self.processes[number].join()
            interruption_point()  # what supervisors send goes to all processes: then this is no fault
            raise self._error(number) from error
        finally:
            if timer is not None:
                timer.cancel()

    def _kill(self, number: int) -> None:
        self._hung.add(number)
        self.processes[number].kill()

    def _error(self, number: int) -> WorkerError:
        how = ending(self.processes[number].exitcode)
        if number in self._hung:
            how = f"made no step within {self._timeout_s:g} s"
        return WorkerError(f"{self._names[number]} {how}")

    def close(self) -> None:
        """End the processes, whatever they do."""
        # They hold nothing that must be kept; SIGKILL also ends those that are stopped.
        for process in self.processes:
            process.kill()
        for process, connection in zip(self.processes, self._connections, strict=True):
            process.join()
            connection.close()
        self.processes, self._connections, self._steps = [], [], []
        self._open_requests = []


def _serve(connection: Connection, make: MakeServe, steps: Any) -> None:
    """Answer what arrives until nobody is there to ask."""
    # A terminal sends Ctrl-C to all processes; the main one ends the others.
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    main = multiprocessing.parent_process()
    assert main is not None

    def step() -> None:
        steps.value += 1
        if not main.is_alive():
            raise SystemExit

    nobody_asks = contextlib.suppress(EOFError, BrokenPipeError, ConnectionResetError)
    try:
        with make() as serve, nobody_asks:
            while connection in wait([connection, main.sentinel]):
                connection.send(serve(connection.recv(), step))
    except UserInputError as error:
        with nobody_asks:
            connection.send(UserInputError(str(error)))
            # Who still asks is to read that, not to find that this process is gone.
            while connection in wait([connection, main.sentinel]):
                connection.recv()
