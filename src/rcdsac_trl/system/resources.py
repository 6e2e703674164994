"""Disk and memory: what can be known before work starts, and the sentence for what shows only then.

Nothing here imports torch: entry points read it before they know that their input is right.
"""

import errno
import os
import shutil
import tempfile
from contextlib import suppress
from pathlib import Path

from rcdsac_trl.errors import UserInputError
from rcdsac_trl.system import cgroups

_DISK = {
    errno.ENOSPC: "the disk is full",
    errno.EDQUOT: "the disk quota is used up",
    errno.EFBIG: "a file became larger than this system or its limits allow",
    errno.EROFS: "the disk is read-only",
    errno.EACCES: "writing is not allowed",
    errno.EPERM: "writing is not allowed",
    errno.EIO: "the disk fails",
}
_NO_MEMORY = ("can't allocate memory", "cannot allocate memory", "out of memory")


def fault_sentence(error: BaseException) -> str | None:
    """Say in words that the disk or the memory failed; None for an error of another kind.

    Example:
        >>> fault_sentence(OSError(errno.ENOSPC, "No space left on device", "runs/a/replay"))
        'the disk is full (runs/a/replay: No space left on device)'
    """
    if isinstance(error, OSError) and (told := _temporary_fault(str(error))) is not None:
        return told
    if isinstance(error, OSError) and error.errno in _DISK:
        what = f"{error.filename}: {error.strerror}" if error.filename is not None else str(error.strerror)
        return f"{_DISK[error.errno]} ({what})"
    text = str(error).lower()
    if isinstance(error, MemoryError) or (isinstance(error, RuntimeError) and any(t in text for t in _NO_MEMORY)):
        told = " ".join(str(error).split())
        return "there is not enough memory" + (f" ({told})" if told else "")
    return None


def _temporary_fault(text: str) -> str | None:
    """Say what is wrong with the folder for temporary files, through whose sockets processes talk to each other."""
    if "No usable temporary directory" in text:
        return "there is no folder for temporary files: set TMPDIR to one that can be written"
    if "AF_UNIX path too long" in text:
        return f"the folder for temporary files has too long a path ({tempfile.gettempdir()}): set TMPDIR to another"
    return None


def check_writable(folder: Path) -> None:
    """Refuse a folder that cannot be made or written into.

    Raises:
        UserInputError: naming the nearest folder that exists, and is not one or takes nothing new.
    """
    try:
        folder.exists()
    except OSError as error:  # such as a name that is too long
        raise UserInputError(f"{folder} cannot be a folder ({error.strerror}): choose another") from error
    existing = next(path for path in (folder, *folder.absolute().parents) if path.exists())
    if not existing.is_dir():
        raise UserInputError(f"{folder} cannot be a folder: {existing} is a file, choose another")
    try:
        with tempfile.TemporaryFile(dir=existing):  # permissions alone do not tell
            pass
    except OSError as error:
        raise UserInputError(
            f"nothing can be written into {existing} ({error.strerror}): choose a folder elsewhere than {folder}"
        ) from error


def check_out(folder: Path) -> None:
    """Refuse what cannot be the folder ``out`` of some results.

    Raises:
        UserInputError: naming it.
    """
    if os.path.exists(folder) and not folder.is_dir():  # false for a name that is too long, which is told below
        raise UserInputError(f"out={folder} is not a folder: give another with out=<folder>")
    check_writable(folder)


def check_empty(out: Path) -> None:
    """Refuse what cannot be the folder ``out`` of files that are to lie there alone.

    Raises:
        UserInputError: naming it.
    """
    check_out(out)
    if out.is_dir() and any(out.iterdir()):
        raise UserInputError(f"out={out} is not empty: choose another folder, or remove what is there")


def check_picture(out: Path) -> None:
    """Refuse what is no PNG file, or cannot be written.

    Raises:
        UserInputError: naming the file.
    """
    if out.suffix != ".png":
        raise UserInputError(f"out={out} does not name a PNG file: end it in .png")
    check_writable(out.parent)
    try:
        taken = out.is_dir()
    except OSError as error:  # such as a name that is too long
        raise UserInputError(f"out={out} cannot be a file ({error.strerror}): give another") from error
    if taken:
        raise UserInputError(f"out={out} is a folder: give a file")


def available_memory_bytes(system: Path = cgroups.SYSTEM) -> int | None:
    """Return how much memory this process can still take: of the machine's with its swap, and of its container's.

    Args:
        system: holds ``proc`` and ``sys``.

    Returns:
        None where the system does not say (not Linux).
    """
    found = []
    with suppress(OSError, KeyError, ValueError):
        lines = dict(line.split(":", 1) for line in (system / "proc/meminfo").read_text(encoding="utf-8").splitlines())
        found.append(sum(int(lines[key].split()[0]) for key in ("MemAvailable", "SwapFree")) * 1024)
    if (room := cgroups.memory_room_bytes(system)) is not None:
        found.append(room)
    return min(found, default=None)


def check_memory(what: str, needed_bytes: int, remedy: str) -> None:
    """Refuse what does not fit into the memory that is available now.

    Raises:
        UserInputError: with both numbers.
    """
    available = available_memory_bytes()
    if available is not None and needed_bytes > available:
        raise UserInputError(f"{what}: {_size(needed_bytes)} of memory needed, {_size(available)} available: {remedy}")


def disk_shortage(folder: Path, needed_bytes: int) -> str | None:
    """Say that a folder's disk has too little space for what will be written; None if it has enough."""
    free = shutil.disk_usage(folder).free
    if needed_bytes <= free:
        return None
    return (
        f"WARNING: the run needs up to {_size(needed_bytes)} in {folder}, whose disk has {_size(free)} free: make "
        "room, else it ends when the disk is full"
    )


def _size(number: int) -> str:
    return f"{number / 1e9:.1f} GB" if number >= 1e8 else f"{number / 1e6:.1f} MB"
