"""The worker processes of a ``ParallelEnv``, seen from outside: who died, who hangs.

TorchRL's environment says that a worker is dead or that an answer took too long, but neither who it was nor how it
ended, and when it is closed it waits for those that are stopped.
"""

import multiprocessing
import time
from collections.abc import Sequence
from multiprocessing.process import BaseProcess

from rcdsac_trl.system.processes import WorkerError, ending

# A pipe can be broken an instant before its process counts as dead.
_DEATH_S = 1.0
_LOOK_S = 0.01


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
        """Take the processes that came since as the workers, in the order in which they were started."""
        if self._described:
            new = [each for each in multiprocessing.active_children() if each.pid not in self._before]
            self._processes = sorted(new, key=lambda process: int(process.name.rpartition("-")[2]))

    def fault(self, error: Exception) -> WorkerError | None:
        """Say which worker is to blame for an error of the environment; None: none is.

        Workers that died are named with how they ended. Where all live and TorchRL gave up waiting, they hang.
        """
        until_s = time.monotonic() + _DEATH_S
        while self._processes and time.monotonic() < until_s:
            for number, process in enumerate(self._processes):
                if not process.is_alive():
                    return self._error(number, ending(process.exitcode))
            if "time limit" in str(error):
                return WorkerError(
                    f"one of {len(self._processes)} worker processes ({'; '.join(self._described)}) gave no answer "
                    f"within {self._timeout_s:g} s"
                )
            time.sleep(_LOOK_S)
        return None

    def _error(self, number: int, how: str) -> WorkerError:
        return WorkerError(f"worker process {number + 1} of {len(self._processes)} ({self._described[number]}) {how}")

    def kill(self) -> None:
        """End the workers whatever they do, those that are stopped, too."""
        for process in self._processes:
            process.kill()
        self._processes = []
