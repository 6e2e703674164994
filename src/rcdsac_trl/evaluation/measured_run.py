"""Work in units that are measured one by one, maps or drives, and the folder that its tables go into."""

import contextlib
import sys
from collections.abc import Callable, Generator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from rcdsac_trl.rollout.evaluation_pool import Rows
from rcdsac_trl.storage.results_folder import UNFINISHED, ResultsFolder
from rcdsac_trl.system.interrupts import at_safe_points
from rcdsac_trl.system.invocation import program
from rcdsac_trl.system.progress import Watch, Work, counted


@dataclass(frozen=True)
class Findings:
    """What all rows amount to.

    Attributes:
        tables: contents of the files, by name.
    """

    tables: Mapping[str, str]


class MeasuredRun:
    """An evaluation, a calibration or a course of drives.

    Args:
        kind: which of them; ``<kind>.json`` says what a folder holds.
        out: the folder; made when the tables are there.
        described: what is measured and how; equal descriptions give equal tables.
        unit: what a unit is called.
        num_units: how many there are.
        unit_steps: about how many steps a unit takes.
        processes: how many measure; 0: this one does.
        measure: yields the rows of each unit once it is measured, in any order; tells how many steps are done.
        findings: makes the tables of the rows of all units.
        film: makes films of them, given the folder and the rows, and returns the files; None: there are none.
        next_step: verb and overrides of what a user does next, which is told at the end; empty: nothing is.

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
        unit_steps: int,
        processes: int,
        measure: Callable[[Watch], Generator[Rows, None, None]],
        findings: Callable[[Rows], Findings],
        film: Callable[[Path, Rows], Sequence[Path]] | None = None,
        next_step: Sequence[str] = (),
    ) -> None:
        self.results = ResultsFolder(out, f"{kind}.json", described)
        self.measure = measure
        self._unit = unit
        self._num_units = num_units
        self._unit_steps = unit_steps
        self._processes = processes
        self._findings = findings
        self._film = film
        self._next_step = next_step

    def run(self, describe: Callable[[Path], str] | None = None) -> None:
        """Measure, write, and print what was found.

        What has ended of work that breaks off lies in the folder ``unfinished`` of the results.

        Args:
            describe: puts the folder's tables into words, and may write more into it.

        Raises:
            UserInputError: if something else was written into the folder meanwhile.
        """
        rows = self.measure_and_write()  # first: what follows may find the disk full that the output goes to
        if describe is not None:
            with Work("tables and figures of them", 1, "report"):
                described = describe(self.results.path)
            print(described)
        print(f"written to {self.results.path}")
        if self._film is not None:
            print(f"filmed: {', '.join(map(str, self._film(self.results.path, rows)))}")
        if self._next_step:
            print(f"next: {' '.join([program(), *self._next_step])}")

    def measure_and_write(self) -> Rows:
        """Measure all units, write the tables, and return the rows.

        Raises:
            UserInputError: as :meth:`run`.
        """
        rows = self._measured()
        self.results.write(self._findings(rows).tables)
        return rows

    def _measured(self) -> Rows:
        """Measure all units, and keep the tables of those that have ended."""
        rows: Rows = []
        kept = 0
        units = counted(self._num_units, self._unit)
        where = f" in {self._processes} processes" if self._processes else ""
        with Work(f"{units}{where}, for {self.results.path}", self._num_units, self._unit) as work, at_safe_points():
            if (left := self.results.left_unfinished()) is not None:
                _say(f"an earlier call ended after {left[0]} of {counted(left[1], self._unit)}: all are measured anew")
            try:
                # Closed here and now where Ctrl-C comes between two units, and with it the processes that measure.
                with contextlib.closing(self.measure(lambda steps: work.reach(steps / self._unit_steps))) as measured:
                    for of_unit in measured:
                        rows += of_unit
                        work.end_unit()
                        self.results.write_unfinished(self._findings(rows).tables, work.ended, self._num_units)
                        kept = work.ended
            except BaseException:
                if kept:
                    _say(f"{kept} of {units} are in {self.results.path / UNFINISHED}")
                raise
        return rows


def _say(sentence: str) -> None:
    print(f"rcdsac_trl: {sentence}", file=sys.stderr)
