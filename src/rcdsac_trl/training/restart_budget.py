"""How often worker processes may fail in a run before it ends."""

from collections.abc import Callable

from rcdsac_trl.errors import TrainingError
from rcdsac_trl.system.processes import WorkerError


class RestartBudget:
    """Counts the faults of worker processes, of collection and validation alike.

    Args:
        limit: faults that a run survives (``world.max_restarts``).
        used: faults so far; a continued run goes on counting.
        message: tells the user a sentence.
        saved: says what is saved, for the sentence that ends a run.
    """

    def __init__(self, limit: int, used: int, *, message: Callable[[str], None], saved: Callable[[], str]) -> None:
        self.limit = limit
        self.used = used
        self._message = message
        self._saved = saved

    def spend(self, where: str, error: WorkerError) -> None:
        """Count a fault and tell it.

        Raises:
            TrainingError: if there were too many.
        """
        if self.used == self.limit:
            raise TrainingError(
                f"{where}: {error}; world.max_restarts={self.limit} allows no further restart: training stops; "
                f"{self._saved()}"
            ) from error
        self.used += 1
        self._message(f"{where}: {error}; restart {self.used} of at most {self.limit}")
