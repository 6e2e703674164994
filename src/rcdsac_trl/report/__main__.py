"""The paper's table, statistics and figures of evaluations: ``python -m rcdsac_trl.report runs=[<folder>,...]``."""

from dataclasses import dataclass
from pathlib import Path

from omegaconf import DictConfig

from rcdsac_trl.cli import Command
from rcdsac_trl.report.read import Episodes, read_episodes
from rcdsac_trl.system.progress import Work
from rcdsac_trl.system.resources import check_out


@dataclass(frozen=True)
class Report:
    """A report that is about to be written: on which episodes, of which folders, where."""

    episodes: Episodes
    folders: list[Path]
    out: Path

    def run(self) -> None:
        """Write the report and print the table."""
        from rcdsac_trl.report import table
        from rcdsac_trl.report.write import write_report

        conditions, episodes = len(self.episodes.conditions), len(self.episodes.table)
        doing = f"statistics and figures of {conditions} conditions, {episodes} episodes, for {self.out}"
        with Work(doing, 1, "report"):
            write_report(self.episodes, self.folders, self.out)
        print(table.flattened(table.comparison(self.episodes)).to_string(index=False))
        print(f"written to {self.out}")


def make_report(cfg: DictConfig) -> Report:
    """Read evaluations; refuses what cannot be compared, before anything is written."""
    runs = cfg.runs
    named = [runs] if isinstance(runs, str) else list(runs or [])
    folders = [Path(str(run)) for run in named]
    out = Path(str(cfg.out))
    check_out(out)
    return Report(read_episodes(folders), folders, out)


main = Command("report", make_report)

if __name__ == "__main__":
    main()
