"""A folder of results: tables, and a file that says what they are of."""

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from rcdsac_trl.errors import UserInputError
from rcdsac_trl.storage import atomic
from rcdsac_trl.system.resources import check_out


class ResultsFolder:
    """Takes the tables of one piece of work, and never mixes them with those of another.

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
        self._check()

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

    def _check(self) -> None:
        check_out(self.path)
        if self._description.exists() and self._holds_another():
            kind = self._description.stem
            raise UserInputError(
                f"{self.path} holds the {kind} of something else: give another folder with out=<folder>"
            )

    def _holds_another(self) -> bool:
        """Say whether the folder's description is of something else; one that cannot be read is."""
        try:
            return _without_commit(self._description.read_text(encoding="utf-8")) != _without_commit(self.described)
        except (OSError, ValueError, AttributeError, RecursionError):
            return True


def _without_commit(described: str) -> dict[str, Any]:
    values: dict[str, Any] = json.loads(described)
    return {key: value for key, value in values.items() if key != "commit"}
