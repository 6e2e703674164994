"""A drive without end, for processes that a test ends: it imports next to nothing."""

import contextlib
import os
import time
from collections.abc import Callable, Iterator
from pathlib import Path

from rcdsac_trl.rollout.evaluation_pool import Drive, Rows


@contextlib.contextmanager
def endless(told: Path) -> Iterator[Drive]:
    """Write down the process's number, and take steps for ever."""

    def drive(map_index: int, before_step: Callable[[], None]) -> Rows:
        told.write_text(str(os.getpid()))
        while True:
            before_step()
            time.sleep(0.01)

    yield drive
