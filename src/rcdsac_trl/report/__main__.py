"""The paper's tables, its claims, statistics and figures of evaluations: ``rcdsac-trl report runs=[<folder>,...]``."""

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from omegaconf import DictConfig

from rcdsac_trl.cli import Command
from rcdsac_trl.errors import UserInputError
from rcdsac_trl.report.evaluation_folders import find_evaluations, is_course, runs_among
from rcdsac_trl.report.folder import check_report_folder
from rcdsac_trl.system.progress import Work
from rcdsac_trl.system.resources import check_out

if TYPE_CHECKING:
    from rcdsac_trl.report.results import Results


@dataclass(frozen=True)
class Report:
    """A report that is about to be written: of what, and where."""

    results: "Results"
    out: Path

    def run(self) -> None:
        """Write the report, print the table and the verdicts."""
        from rcdsac_trl.report import table
        from rcdsac_trl.report.verdict_words import verdict_lines
        from rcdsac_trl.report.write import write_report

        episodes = self.results.episodes
        counted = f"{len(episodes.conditions)} conditions, {len(episodes.table)} episodes"
        with Work(f"statistics and figures of {counted}, for {self.out}", 1, "report"):
            write_report(self.results, self.out)
        print(table.flattened(self.results.paper).to_string(index=False))
        print("\n".join(verdict_lines(self.results.claims)))
        print(f"written to {self.out}: open {self.out / 'report.html'}")


def make_report(cfg: DictConfig) -> Report:
    """Read evaluations; refuses what cannot be compared, before anything is written."""
    runs = cfg.runs
    named = [runs] if isinstance(runs, str) else list(runs or [])
    folders = runs_among([Path(str(run)) for run in named])
    out = Path(str(cfg.out))
    check_out(out)
    check_report_folder(out)
    courses = [folder for folder in folders if is_course(folder)]
    evaluated = [folder for folder in folders if folder not in courses]
    if courses and not evaluated:
        raise UserInputError(
            f"{courses[0]} holds drives over the office course, whose table is table.md in it: name evaluations, too"
        )
    find_evaluations(evaluated)
    # Imported here: what is wrong with the folders does not wait for pandas and Matplotlib.
    from rcdsac_trl.report.read import read_episodes
    from rcdsac_trl.report.read_course import read_courses
    from rcdsac_trl.report.results import Results

    return Report(
        Results(read_episodes(evaluated), evaluated, read_courses(courses) if courses else None),
        out,
    )


main = Command("report", make_report)

if __name__ == "__main__":
    main()
