"""The journal of a search: Optuna's file of operations, one a line, behind a lock that dies with its process.

Optuna's own lock is a link that a killed process leaves behind, and to which it waits for ever where the journal's path
is relative. And a line that was cut, as a full disk leaves it, is fatal as soon as another one is written behind it.
"""

import fcntl
import json
import os
import sys
import time
from collections.abc import Generator
from contextlib import suppress
from pathlib import Path
from typing import IO, Any

from optuna.storages import JournalStorage
from optuna.storages.journal import JournalFileBackend

from rcdsac_trl.errors import FaultError, UserInputError, first_line

# Others hold the lock for as long as one line takes.
_NOTICE_S = 5.0
_PATIENCE_S = 60.0
_POLL_S = 0.01


def open_journal(path: Path) -> JournalStorage:
    """Return the storage of a search whose journal is a file; it is made if it is not there, its folder must be.

    Raises:
        FaultError: if another process does not let go of it.
        UserInputError: if a line of it cannot be read; the storage's methods raise both, too.
    """
    return JournalStorage(_Journal(path.absolute()))


class JournalLock:
    """What Optuna holds while it writes: a lock of the operating system on the journal itself.

    Whoever holds it finds a journal of whole lines: what a writer that failed has left of a line is dropped.

    Args:
        path: of the journal; it must exist.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        self._file: IO[bytes] | None = None

    def acquire(self) -> bool:
        """Wait for the lock, and drop what is left of a line that was cut.

        Raises:
            FaultError: if another process holds it for a minute, or the disk has no locks.
        """
        file = self.path.open("ab")
        try:
            self._wait_for(file)
            self._drop_cut_line(file)
        except BaseException:
            file.close()
            raise
        self._file = file
        return True

    def release(self) -> None:
        """Let others write."""
        assert self._file is not None
        self._file.close()
        self._file = None

    def _wait_for(self, file: IO[bytes]) -> None:
        begun, noticed = time.monotonic(), False
        while True:
            try:
                return fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
            except BlockingIOError:
                waited = time.monotonic() - begun
            except OSError as error:
                raise FaultError(
                    f"{self.path} cannot be locked ({error.strerror}): search on another disk, or in a database "
                    "(search.storage=sqlite:///<file>)"
                ) from error
            if waited > _PATIENCE_S:
                raise FaultError(
                    f"another process has locked {self.path} for {_PATIENCE_S:.0f} s: end it (`fuser` names it), then "
                    "repeat the call, which goes on with this search"
                )
            if waited > _NOTICE_S and not noticed:
                noticed = True
                print(f"rcdsac_trl: waiting for {self.path}, which another process has locked", file=sys.stderr)
            time.sleep(_POLL_S)

    def _drop_cut_line(self, file: IO[bytes]) -> None:
        size = os.fstat(file.fileno()).st_size
        with self.path.open("rb") as journal:
            journal.seek(max(0, size - 1))
            if journal.read() in (b"", b"\n"):
                return
            journal.seek(0)
            whole = journal.read().rfind(b"\n") + 1
        file.truncate(whole)
        os.fsync(file.fileno())
        print(
            f"rcdsac_trl: the last line of {self.path} was cut, as a full disk does it: its {size - whole} bytes are "
            "dropped, and the search goes on",
            file=sys.stderr,
        )


class _Journal(JournalFileBackend):
    """Optuna's journal that says in a sentence which line cannot be read."""

    def __init__(self, path: Path) -> None:
        lock: Any = JournalLock(path)  # the class that names its two methods is not Optuna's to give
        super().__init__(str(path), lock_obj=lock)
        self._path = path

    def read_logs(self, log_number_from: int) -> Generator[dict[str, Any], None, None]:
        try:
            yield from super().read_logs(log_number_from)
        except ValueError as error:
            whole = _readable_lines(self._path)
            raise UserInputError(
                f"line {whole + 1} of {self._path} cannot be read ({first_line(error)}): remove what follows line "
                f"{whole} to go on from there, or choose another search.name"
            ) from error


def _readable_lines(path: Path) -> int:
    """Count the lines before the first one that cannot be read."""
    count = 0
    with suppress(ValueError):
        for line in path.read_bytes().splitlines():
            json.loads(line)
            count += 1
    return count
