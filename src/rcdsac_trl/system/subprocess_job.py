"""A program in a process that ends with the one that called it: what a sweep runs its jobs as.

Run as a program, this module takes the caller's process number and a command, and becomes that command. So nothing has
to happen between fork and exec, where a caller with threads could come to a standstill.
"""

import ctypes
import os
import signal
import subprocess
import sys
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from pathlib import Path

from rcdsac_trl.system.interrupts import ended_by

_PR_SET_PDEATHSIG = 1
_PATIENCE_S = 60
_POLL_S = 1.0
STOPPED = 1000
"""What :func:`call` returns for a program that was stopped on purpose: no exit code is as large."""


def call(
    command: Sequence[str], output: Path, variables: Mapping[str, str], should_stop: Callable[[], bool] | None = None
) -> int:
    """Run a program to its end; what it prints is appended to a file.

    On Linux it is ended if this process dies: else it would hold its run folder, and the sweep that is started
    again could not go on there. Ctrl-C, which a terminal gives to both, is waited out.

    Args:
        command: program and arguments.
        output: the file; its folder must exist.
        variables: added to the environment.
        should_stop: asked about every second; once it says so, the program is ended.

    Returns:
        The exit code; the negative number of the signal that ended it; :data:`STOPPED`.
    """
    started = [sys.executable, "-m", __name__, str(os.getpid()), *command]
    with output.open("ab") as file:
        process = subprocess.Popen(
            started,
            stdin=subprocess.DEVNULL,
            stdout=file,
            stderr=subprocess.STDOUT,
            env=os.environ | variables,
        )
        try:
            return process.wait() if should_stop is None else _watch(process, should_stop)
        except BaseException:
            _end(process)
            raise


def _watch(process: subprocess.Popen[bytes], should_stop: Callable[[], bool]) -> int:
    while True:
        with suppress(subprocess.TimeoutExpired):
            return process.wait(timeout=_POLL_S)
        if should_stop():
            _terminate(process)
            return STOPPED


def _end(process: subprocess.Popen[bytes]) -> None:
    """Wait for a process that had the same Ctrl-C; end it if it did not stop by that, or had none."""
    if ended_by() is signal.SIGINT:  # what a supervisor sends goes to this process alone
        with suppress(subprocess.TimeoutExpired):
            process.wait(timeout=_PATIENCE_S)
            return
    _terminate(process)


def _terminate(process: subprocess.Popen[bytes]) -> None:
    """Ask a process to end, and end it if it does not: it may ignore the signal, or be stuck where it sees none."""
    process.terminate()
    try:
        process.wait(timeout=_PATIENCE_S)
    except subprocess.TimeoutExpired:
        process.kill()
        process.wait()


def _become(caller: int, command: list[str]) -> None:
    """Tie this process to its caller and turn it into a command; both survive the change of program."""
    # By these a cluster tells of an end to come; whoever supervises sees to it, and the work goes on until then.
    signal.signal(signal.SIGUSR1, signal.SIG_IGN)
    signal.signal(signal.SIGUSR2, signal.SIG_IGN)
    if sys.platform == "linux":
        ctypes.CDLL(None).prctl(_PR_SET_PDEATHSIG, signal.SIGTERM)
        if os.getppid() != caller:  # it died before this was asked for
            raise SystemExit(1)
    os.execvp(command[0], command)


if __name__ == "__main__":
    _become(int(sys.argv[1]), sys.argv[2:])
