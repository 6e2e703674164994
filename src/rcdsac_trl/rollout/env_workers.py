"""The worker processes of a ``ParallelEnv``, seen from outside: who died, who hangs.

TorchRL's environment raises errors that name a worker by its number alone, or none where an answer took too long, and
when it is closed it waits for workers that are stopped.
"""

import contextlib
import multiprocessing
import re
from collections.abc import Iterator, Sequence
from multiprocessing.process import BaseProcess

from rcdsac_trl.system.processes import WorkerError, ending

# What TorchRL says of a worker that is gone, and of an answer that took too long.
_GONE = re.compile(r"worker (\d+) \(exit code (-?\d+)\)")
_LATE = "time limit"


class EnvWorkers:
    """Knows the processes that an environment has started.

    Args:
        described: the agents of each worker, for messages; empty where there are no workers.
        timeout_s: seconds in which a worker must answer; None: it may take as long as it likes.
    """

    def __init__(self, described: Sequence[str], timeout_s: float | None) -> None:
        self._described = described
        self._timeout_s = timeout_s
        self._before: set[int | None] = set()
        self._processes: list[BaseProcess] = []

    def before_start(self) -> None:
        """Remember the processes that are there already."""
        self._before = {process.pid for process in multiprocessing.active_children()}

    def started(self) -> None:
        """Take the processes that came since as the workers."""
        if self._described:
            self._processes = [each for each in multiprocessing.active_children() if each.pid not in self._before]

    def fault(self, error: Exception) -> WorkerError | None:
        """Say which worker is to blame for an error of the environment; None: none is."""
        number = len(self._described)
        for cause in _chain(error):
            if gone := _GONE.search(str(cause)):
                worker, how = int(gone[1]), ending(int(gone[2]))
                return WorkerError(f"worker process {worker + 1} of {number} ({self._described[worker]}) {how}")
            if _LATE in str(cause):
                return WorkerError(
                    f"one of {number} worker processes ({'; '.join(self._described)}) gave no answer within "
                    f"{self._timeout_s:g} s"
                )
        return None

    def kill(self) -> None:
        """End the workers whatever they do, those that are stopped, too."""
        for process in self._processes:
            with contextlib.suppress(ValueError):  # TorchRL has closed it
                process.kill()
        self._processes = []


def _chain(error: BaseException | None) -> Iterator[BaseException]:
    """Yield an error and those it was raised from or during."""
    while error is not None:
        yield error
        error = error.__cause__ or error.__context__
