"""What the process itself needs: an allocator that keeps its pages, a device and threads.

This module is imported before torch, so that a re-executed process has paid nothing twice.
"""

import io
import os
import re
import sys
from contextlib import suppress

from rcdsac_trl.errors import UserInputError
from rcdsac_trl.system.cores import allowed_cores, usable_cores

# glibc maps and unmaps every large temporary by default, which costs more than the arithmetic on it.
_GLIBC_KEEPS_PAGES = {
    "MALLOC_MMAP_MAX_": "0",
    "MALLOC_TRIM_THRESHOLD_": str(1 << 40),
    "MALLOC_TOP_PAD_": str(1 << 26),
}
# From some such number on the libraries that start them die instead of refusing.
_MAX_THREADS = 1024


def keep_pages() -> None:
    """Start this process again with an allocator that keeps its pages, once, where the C library is glibc.

    The settings only work from a process's first moment. A user who has set one of them, or preloads another
    allocator, is left alone. Where the process cannot be started again it goes on as it is.
    """
    if not _has_glibc() or "LD_PRELOAD" in os.environ or not sys.executable:
        return
    if any(name in os.environ for name in _GLIBC_KEEPS_PAGES):
        return
    with suppress(OSError):
        os.execve(sys.executable, sys.orig_argv, os.environ | _GLIBC_KEEPS_PAGES)


def bound_threads() -> None:
    """Keep OpenMP and BLAS from starting more threads than there are cores to use.

    They count the cores they may run on, and see neither a container's quota nor a share. A user's own number stays.

    Raises:
        UserInputError: if the share is no number.
    """
    cores = usable_cores()
    if cores < allowed_cores():
        os.environ.setdefault("OMP_NUM_THREADS", str(cores))


def _has_glibc() -> bool:
    """Return whether the C library is glibc: no other knows its version's name."""
    try:
        return bool(os.confstr("CS_GNU_LIBC_VERSION"))
    except (AttributeError, OSError, ValueError):
        return False


def quiet_libraries() -> None:
    """Keep TorchRL's own notes (every storage it makes) out of the user's log, unless they ask for them."""
    os.environ.setdefault("RL_LOGGING_LEVEL", "WARNING")


def speak_anywhere() -> None:
    """Let what a program prints be read wherever it goes, and when it is printed.

    A terminal may have no letter for it, such as a β where the locale is C; a pipe or a file would get it at the end.
    Where nobody reads, since the stream was closed from the start or its reader leaves (``| head -1``), what is printed
    goes nowhere and the work goes on.
    """
    for number, name in enumerate(("stdin", "stdout", "stderr")):
        if getattr(sys, name) is None:
            _to_nowhere(number)
            setattr(sys, name, open(number, "w" if number else "r", encoding="utf-8", closefd=False))  # noqa: SIM115
    for name in ("stdout", "stderr"):
        stream = getattr(sys, name)
        # A stream that somebody has put in its place is theirs, and theirs to close.
        if type(stream) is io.TextIOWrapper and stream is getattr(sys, f"__{name}__"):
            lasting = _Lasting(stream.detach(), encoding=stream.encoding)
            setattr(sys, name, lasting)
            setattr(sys, f"__{name}__", lasting)
        if isinstance(stream := getattr(sys, name), io.TextIOWrapper):
            stream.reconfigure(errors="backslashreplace", line_buffering=True)


class _Lasting(io.TextIOWrapper):
    """A stream that outlasts its reader."""

    def write(self, text: str) -> int:
        try:
            return super().write(text)
        except BrokenPipeError:
            _to_nowhere(self.fileno())
            return len(text)

    def flush(self) -> None:
        try:
            super().flush()
        except BrokenPipeError:
            _to_nowhere(self.fileno())
            super().flush()


def _to_nowhere(descriptor: int) -> None:
    """Let a file descriptor, open or not, lead to where all is swallowed and nothing can be read."""
    nowhere = os.open(os.devnull, os.O_RDWR)
    if nowhere == descriptor:
        os.set_inheritable(descriptor, True)
        return
    os.dup2(nowhere, descriptor)
    os.close(nowhere)


def let_workers_rest() -> None:
    """Let the workers of a ``ParallelEnv`` wait for days, unless a user says otherwise.

    They would give up after three hours without work, which a learner may well take. TorchRL reads this as it is
    imported; they end with the process that started them all the same.
    """
    os.environ.setdefault("BATCHED_PIPE_TIMEOUT", "1000000")


def allocator() -> str:
    """Name the allocator's state for the log."""
    if "LD_PRELOAD" in os.environ:
        return f"preloaded ({os.environ['LD_PRELOAD']})"
    given = {name: os.environ[name] for name in _GLIBC_KEEPS_PAGES if name in os.environ}
    if not given or not _has_glibc():
        return "the system's default"
    if given == _GLIBC_KEEPS_PAGES:
        return "glibc that keeps its pages"
    return f"glibc with {', '.join(f'{name}={value}' for name, value in given.items())}"


def resolve_device(name: str) -> str:
    """Turn ``auto`` into CUDA where there is one, else the CPU.

    Raises:
        UserInputError: if the named device is not on this machine.
    """
    check_device_name(name)
    import torch

    if name == "auto":
        return "cuda" if torch.cuda.is_available() else "cpu"
    if name != "cpu" and (torch.device(name).index or 0) >= torch.cuda.device_count():
        raise UserInputError(f"device={name}, but torch does not see it here: use device=auto or device=cpu")
    return name


def check_device_name(name: str) -> None:
    """Refuse what names no device; whether it is there only torch knows.

    Raises:
        UserInputError: naming those that there are.
    """
    if not re.fullmatch(r"auto|cpu|cuda(:\d+)?", name):
        raise UserInputError(f"device={name} is not supported: use auto, cpu, cuda or cuda:<number>")


def resolve_threads(threads: int | str) -> int:
    """Turn ``auto`` into the cores this process may use.

    Raises:
        UserInputError: if there is no such number of threads.
    """
    if threads == "auto":
        return usable_cores()
    if not isinstance(threads, int) or threads < 1:
        raise UserInputError(f"threads={threads} is not a whole number of at least 1: use that or auto")
    if threads > _MAX_THREADS:
        raise UserInputError(f"threads={threads} is above {_MAX_THREADS}: use as many as there are cores, or auto")
    return threads


def set_threads(threads: int | str) -> int:
    """Set how many threads torch uses for one operation, see :func:`resolve_threads`, and return the number."""
    import torch

    number = resolve_threads(threads)
    torch.set_num_threads(number)
    return number
