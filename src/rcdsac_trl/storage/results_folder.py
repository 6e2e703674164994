"""A folder of results: tables, and a file that says what they are of."""

import json
import shutil
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from rcdsac_trl.errors import UserInputError
from rcdsac_trl.storage import atomic
from rcdsac_trl.system.resources import check_out

UNFINISHED = "unfinished"
"""The folder, in a folder of results, of what has ended of work that has not."""

DESCRIPTIONS = ("evaluation.json", "barn.json", "calibration.json", "course.json", "replay.json")
"""What says of a folder of results what its tables are of."""

# Keys of the description of what is unfinished.
_ENDED, _TOTAL = "units_ended", "units"


class ResultsFolder:
    """Takes the tables of one piece of work, and never mixes them with those of another.

    While the work goes on, the tables of what has ended of it lie in a folder of their own, ``unfinished``, with the
    description and how much that is. Tables that are whole stay where they are until then.

    Args:
        path: the folder; made when the tables are there.
        name: file in it that says what the tables are of.
        described: what that file says; equal descriptions give equal tables. What differs in ``commit`` alone may take
            the place of what is there.

    Raises:
        UserInputError: if the folder cannot take results, or holds those of something else.
    """

    def __init__(self, path: Path, name: str, described: Mapping[str, Any]) -> None:
        self.path = path
        self.described = json.dumps(described, indent=2) + "\n"
        self._description = path / name
        self._unfinished = path / UNFINISHED
        self._check()

    def write_unfinished(self, tables: Mapping[str, str], ended: int, total: int) -> None:
        """Write the tables of what has ended so far: how many units of how many.

        Raises:
            UserInputError: as :meth:`write`.
        """
        self._check()
        self._unfinished.mkdir(parents=True, exist_ok=True)
        for name, content in tables.items():
            atomic.write(self._unfinished / name, content.encode())
        described = {_ENDED: ended, _TOTAL: total} | json.loads(self.described)
        atomic.write(self._unfinished / self._description.name, (json.dumps(described, indent=2) + "\n").encode())

    def left_unfinished(self) -> tuple[int, int] | None:
        """Return how many units of how many an earlier call has left behind; None: none did."""
        try:
            described = json.loads((self._unfinished / self._description.name).read_bytes())
            return int(described[_ENDED]), int(described[_TOTAL])
        except (OSError, ValueError, KeyError, TypeError):
            return None

    def write(self, tables: Mapping[str, str]) -> None:
        """Write every table under its name, then the description.

        Raises:
            UserInputError: if results of something else were written into the folder meanwhile.
        """
        self._check()
        self.path.mkdir(parents=True, exist_ok=True)
        for name, content in tables.items():
            atomic.write(self.path / name, content.encode())
        # Last: a folder that has this one has them all.
        atomic.write(self._description, self.described.encode())
        shutil.rmtree(self._unfinished, ignore_errors=True)

    def _check(self) -> None:
        check_out(self.path)
        self._check_ours()
        kind = self._description.stem
        for what, description in ((kind, self._description), (f"unfinished {kind}", self._unfinished / f"{kind}.json")):
            if description.exists() and self._is_another(description):
                raise UserInputError(
                    f"{self.path} holds the {what} of something else: give another folder with out=<folder>"
                )

    def _check_ours(self) -> None:
        """Refuse a folder whose tables nothing here wrote: those of the same name would be lost."""
        tables = sorted(path.name for path in self.path.glob("*.csv"))
        if tables and not self._unfinished.is_dir() and not any((self.path / name).is_file() for name in DESCRIPTIONS):
            raise UserInputError(
                f"{self.path} holds tables of something else, {tables[0]} among them: give another folder with "
                "out=<folder>"
            )

    def _is_another(self, description: Path) -> bool:
        """Say whether a description is of something else; one that cannot be read is."""
        try:
            return _compared(description.read_text(encoding="utf-8")) != _compared(self.described)
        except (OSError, ValueError, AttributeError, RecursionError):
            return True


def _compared(described: str) -> dict[str, Any]:
    values: dict[str, Any] = json.loads(described)
    return {key: value for key, value in values.items() if key not in ("commit", _ENDED, _TOTAL)}
