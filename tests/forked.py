"""Programs in children of this process: what is imported here, they need not import again, which takes seconds."""

import os
import sys
from collections.abc import Callable
from multiprocessing.context import ForkProcess
from pathlib import Path


class Forked(ForkProcess):
    """A function that runs in a child, as the main program of a process group of its own.

    Args:
        program: may leave by ``SystemExit``, or be killed.
        errors: the file that is its standard error; its standard output goes to one beside it.
    """

    def __init__(self, program: Callable[[], None], errors: Path) -> None:
        super().__init__(target=self._run)
        self._program, self._errors = program, errors
        self.start()

    def code(self, *, wait: bool = True) -> int | None:
        """Return its exit code, minus the signal's number if one has ended it; None while it runs."""
        if wait:
            self.join()
        return self.exitcode

    @property
    def said(self) -> str:
        """What it has written to its standard error so far."""
        return self._errors.read_text()

    def _run(self) -> None:
        os.setsid()
        for number, path in ((1, self._errors.with_suffix(".out")), (2, self._errors)):
            with path.open("w") as file:
                os.dup2(file.fileno(), number)
        sys.stdout, sys.stderr = (os.fdopen(number, "w", buffering=1, closefd=False) for number in (1, 2))
        self._program()
