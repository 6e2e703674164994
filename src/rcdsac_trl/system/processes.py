"""Worker processes: how they are started, how many there are, and what is said of one that dies or hangs."""

import multiprocessing
import signal
from typing import Literal

from rcdsac_trl.errors import FaultError, UserInputError
from rcdsac_trl.system.cores import usable_cores

# A worker made by "fork" inherits the learner's threads and locks in whatever state they are, one made by "spawn"
# imports everything anew, which takes seconds. A fork server is a clean process that has imported it all once.
START_METHOD = "forkserver" if "forkserver" in multiprocessing.get_all_start_methods() else "spawn"


class WorkerError(FaultError):
    """A worker process died or hung; the environment it belongs to can only be closed.

    The message names the worker, how it ended, and its split, seed and agents.
    """


def check_may_start_processes() -> None:
    """Refuse to start processes where multiprocessing would fail an assertion.

    Raises:
        UserInputError: in a daemonic process, with what to do.
    """
    if multiprocessing.current_process().daemon:
        raise UserInputError(
            "this is a daemonic process, as those of multiprocessing.Pool are, and may start no processes: use "
            "concurrent.futures.ProcessPoolExecutor instead, or let this one drive alone, with num_workers=0, in a "
            "training collector.num_processes=0 validation.processes=0"
        )


def ending(code: int | None) -> str:
    """Say how a process ended that has an exit code."""
    if code is not None and code < 0:
        return f"was killed by {signal.Signals(-code).name}"
    return f"ended with exit code {code}"


def largest_divisor(number: int, limit: int) -> int:
    """Return the largest divisor of a number that is not above a limit; 1 if the limit is below it.

    Example:
        >>> largest_divisor(10, 8)
        5
    """
    return max(n for n in range(1, number + 1) if number % n == 0 and n <= max(limit, 1))


def resolve_processes(num_workers: int | Literal["auto"], at_most: int, key: str = "num_workers") -> int:
    """Return how many processes drive besides this one; 0: this one drives itself.

    Args:
        num_workers: ``"auto"`` takes one for each core that this process may use, none where that is one.
        at_most: there is no use for more processes: the number of maps, or of agents.
        key: of the number, for messages.

    Raises:
        UserInputError: if there is no such number of processes.

    Example:
        >>> resolve_processes(4, at_most=3), resolve_processes(4, at_most=1)
        (3, 0)
    """
    if num_workers == "auto":
        num_workers = usable_cores()
    if not isinstance(num_workers, int) or num_workers < 0:
        raise UserInputError(f"{key}={num_workers!r} is not a number of processes: give 0 or more, or auto")
    used = min(num_workers, at_most)
    return used if used > 1 else 0


def resolve_processes_beside(processes: int | Literal["auto"], num_maps: int, threads: int) -> int:
    """Return how many processes drive while this one computes; 0: this one drives itself, before it goes on.

    Args:
        processes: ``"auto"`` takes one for each core that this process leaves free, at least one; none on one core.
        num_maps: there is no use for more processes than maps.
        threads: of this process.

    Example:
        >>> resolve_processes_beside(4, num_maps=3, threads=1)
        3
    """
    free = max(1, usable_cores() - threads) if usable_cores() > 1 else 0
    return min(free if processes == "auto" else processes, num_maps)


def resolve_num_workers(num_workers: int | Literal["auto"], num_agents: int) -> int:
    """Return the number of worker processes; see :func:`make_env`."""
    if num_workers == "auto":
        return largest_divisor(num_agents, usable_cores())
    if not isinstance(num_workers, int) or num_workers < 0 or (num_workers and num_agents % num_workers):
        raise UserInputError(
            f"num_workers={num_workers!r} cannot share {num_agents} agents evenly: "
            "give 0, a divisor of num_agents, or auto."
        )
    return num_workers
