"""A program in a process that dies with this one: what a sweep runs its jobs as."""

import ctypes
import os
import signal
import subprocess
import sys
from collections.abc import Callable, Sequence
from pathlib import Path

_PR_SET_PDEATHSIG = 1
_PATIENCE_S = 60
_libc = ctypes.CDLL(None) if sys.platform == "linux" else None


def call(command: Sequence[str], output: Path) -> int:
    """Run a program to its end; what it prints is appended to a file.

    On Linux it is ended if this process dies: else it would hold its run folder, and the sweep that is started
    again could not go on there. Ctrl-C, which a terminal gives to both, is waited out.

    Returns:
        The exit code; the negative number of the signal that ended it.
    """
    with output.open("ab") as file:
        process = subprocess.Popen(
            command,
            stdin=subprocess.DEVNULL,
            stdout=file,
            stderr=subprocess.STDOUT,
            preexec_fn=_before_exec(os.getpid()),
        )
        try:
            return process.wait()
        except BaseException:
            _end(process)
            raise


def _end(process: subprocess.Popen[bytes]) -> None:
    """Wait for a process that had the same Ctrl-C; end it if it did not stop by that."""
    try:
        process.wait(timeout=_PATIENCE_S)
    except subprocess.TimeoutExpired:
        process.terminate()
        process.wait()


def _before_exec(parent: int) -> Callable[[], None]:
    def prepare() -> None:
        # By these a cluster tells of an end to come; whoever supervises sees to it, and the work goes on until then.
        signal.signal(signal.SIGUSR1, signal.SIG_IGN)
        signal.signal(signal.SIGUSR2, signal.SIG_IGN)
        if _libc is not None:
            _libc.prctl(_PR_SET_PDEATHSIG, signal.SIGTERM)
            if os.getppid() != parent:  # it died before this was asked for
                os._exit(1)

    return prepare
