"""Files that survive: whole or absent, on the disk when a call returns, and told apart from damaged ones.

What is written under a temporary name, brought to the disk and then renamed can be interrupted at any moment: a
reader finds the old state or the new one. Names that begin with a dot are temporary, and nobody reads them.
"""

import errno
import fcntl
import hashlib
import os
import shutil
from pathlib import Path

from rcdsac_trl.errors import UserInputError

_TEMPORARY = ".unfinished-"
_REMOVED = ".removed-"


def sha256_of(path: Path) -> str:
    """Return the SHA-256 of a file's content, in hexadecimal."""
    with path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()


def damage(path: Path, sha256: str) -> str | None:
    """Say what is wrong with a file that was written with a hash; None if nothing is."""
    try:
        whole = sha256_of(path) == sha256
    except FileNotFoundError:
        return "is missing"
    except OSError as error:
        return f"cannot be read ({error.strerror})"
    return None if whole else "does not hold what was written"


def sync(path: Path) -> None:
    """Bring a file's content, or a folder's list of names, to the disk."""
    descriptor = os.open(path, os.O_RDONLY)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)


def write(path: Path, content: bytes) -> None:
    """Write a file that is there as a whole or not at all; its folder must exist."""
    temporary = unfinished(path)
    temporary.write_bytes(content)
    sync(temporary)
    os.rename(temporary, path)
    sync(path.parent)


def reserve(folder: Path, size_bytes: int) -> None:
    """Fail now as writing so much into a folder would fail.

    A file that is written through memory does not fail where the disk is full: the process dies of SIGBUS.

    Raises:
        OSError: if there is no room.
    """
    if not hasattr(os, "posix_fallocate"):
        return
    path = folder / f"{_TEMPORARY}space"
    try:
        with path.open("wb") as file:
            os.posix_fallocate(file.fileno(), 0, size_bytes)
    except OSError as error:
        if error.errno not in (errno.EOPNOTSUPP, errno.EINVAL):  # else the file system cannot tell
            raise OSError(error.errno, error.strerror, str(folder)) from error
    finally:
        path.unlink(missing_ok=True)


def unfinished(path: Path) -> Path:
    """Return the temporary name that this process writes a file or folder under: others may write the same one."""
    return path.with_name(f"{_TEMPORARY}{os.getpid()}-{path.name}")


def publish(folder: Path) -> None:
    """Give a folder that was written as :func:`unfinished` its name, with everything in it on the disk."""
    temporary = unfinished(folder)
    for path in sorted(temporary.rglob("*"), reverse=True):  # what a folder holds before the folder itself
        sync(path)
    sync(temporary)
    os.rename(temporary, folder)
    sync(folder.parent)


def remove_folder(folder: Path) -> None:
    """Remove a folder so that an interruption never leaves half of it under its name."""
    removed = folder.with_name(_REMOVED + folder.name)
    if removed.exists():
        shutil.rmtree(removed)
    os.rename(folder, removed)
    shutil.rmtree(removed)


def clear_leftovers(folder: Path, of: str = "") -> None:
    """Remove what interrupted writers and removers left in a folder, of everything or of one file.

    Nobody may be writing that now.
    """
    for path in folder.glob(f".*{of}"):
        if path.is_dir():
            shutil.rmtree(path)
        else:
            path.unlink()


class FolderLock:
    """Keeps other processes from training in the same folder, for as long as this process lives or until closed.

    The operating system lets go of it when the process ends, however it ends; its file stays.

    Args:
        folder: must exist.
        name: of the file in it.
        wait: until whoever holds it lets go of it, instead of refusing.

    Raises:
        UserInputError: if another process holds it, or it cannot be opened.
    """

    def __init__(self, folder: Path, name: str = "lock", *, wait: bool = False) -> None:
        try:
            self._file = (folder / name).open("a", encoding="utf-8")
        except OSError as error:
            raise UserInputError(f"{folder / name} cannot be opened ({error.strerror}): remove it") from error
        try:
            fcntl.flock(self._file, fcntl.LOCK_EX if wait else fcntl.LOCK_EX | fcntl.LOCK_NB)
        except OSError as error:
            self._file.close()
            if isinstance(error, BlockingIOError):
                sentence = f"{folder} is being trained in by another process: wait for it, or stop it"
            else:
                sentence = f"{folder / name} cannot be locked ({error.strerror}): choose a folder on another disk"
            raise UserInputError(sentence) from error

    def close(self) -> None:
        """Let others train in the folder."""
        self._file.close()
