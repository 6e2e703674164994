"""Work in units that are measured one by one, maps or drives, and the folder that its tables go into."""

import contextlib
from collections.abc import Callable, Generator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from tqdm import tqdm

from rcdsac_trl.rollout.evaluation_pool import Rows
from rcdsac_trl.storage.results_folder import ResultsFolder


@dataclass(frozen=True)
class Findings:
    """What all rows amount to.

    Attributes:
        tables: contents of the files, by name.
        text: what is printed of them, if anything.
    """

    tables: Mapping[str, str]
    text: str | None = None


class MeasuredRun:
    """An evaluation, a calibration or a course of drives.

    Args:
        kind: which of them; ``<kind>.json`` says what a folder holds.
        out: the folder; made when the tables are there.
        described: what is measured and how; equal descriptions give equal tables.
        unit: what a unit is called.
        num_units: how many there are.
        measure: yields the rows of each unit once it is measured, in any order.
        findings: makes the tables of the rows of all units.
        film: makes films of them, given the folder and the rows, and returns the files; None: there are none.

    Raises:
        UserInputError: if the folder holds something else, or cannot be written.
    """

    def __init__(
        self,
        *,
        kind: str,
        out: Path,
        described: Mapping[str, Any],
        unit: str,
        num_units: int,
        measure: Callable[[], Generator[Rows, None, None]],
        findings: Callable[[Rows], Findings],
        film: Callable[[Path, Rows], Sequence[Path]] | None = None,
    ) -> None:
        self.results = ResultsFolder(out, f"{kind}.json", described)
        self.measure = measure
        self._unit = unit
        self._num_units = num_units
        self._findings = findings
        self._film = film

    def run(self, describe: Callable[[Path], str] | None = None) -> None:
        """Measure, write, and print what was found.

        Args:
            describe: puts the folder's tables into words, and may write more into it.

        Raises:
            UserInputError: if something else was written into the folder meanwhile.
        """
        # Closed here and now where Ctrl-C comes between two units, and with it the processes that measure.
        with contextlib.closing(self.measure()) as units:
            shown = tqdm(units, total=self._num_units, unit=self._unit, disable=None)
            rows = [row for rows in shown for row in rows]
        found = self._findings(rows)
        if found.text is not None:
            print(found.text)
        self.results.write(found.tables)
        if describe is not None:
            print(describe(self.results.path))
        print(f"written to {self.results.path}")
        if self._film is not None:
            print(f"filmed: {', '.join(map(str, self._film(self.results.path, rows)))}")
