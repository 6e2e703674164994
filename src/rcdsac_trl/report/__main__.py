"""The paper's table, statistics and figures of evaluations: ``python -m rcdsac_trl.report runs=[<folder>,...]``."""

from pathlib import Path

from omegaconf import DictConfig

from rcdsac_trl.cli import entry_point
from rcdsac_trl.errors import UserInputError
from rcdsac_trl.report.read import Episodes, read_episodes
from rcdsac_trl.system.resources import check_writable


def _read(cfg: DictConfig) -> tuple[Episodes, list[Path], Path]:
    runs = cfg.runs
    named = [runs] if isinstance(runs, str) else list(runs or [])
    folders = [Path(str(run)) for run in named]
    out = Path(str(cfg.out))
    if out.exists() and not out.is_dir():
        raise UserInputError(f"out={out} is not a folder: give another with out=<folder>")
    check_writable(out)
    return read_episodes(folders), folders, out


def check(cfg: DictConfig) -> None:
    """Refuse what cannot be compared, before anything is written."""
    _read(cfg)


@entry_point("report", check=check)
def main(cfg: DictConfig) -> None:
    """Write the report and print the table."""
    from rcdsac_trl.report import table
    from rcdsac_trl.report.write import write_report

    episodes, folders, out = _read(cfg)
    write_report(episodes, folders, out)
    print(table.flattened(table.comparison(episodes)).to_string(index=False))
    print(f"written to {out}")


if __name__ == "__main__":
    main()
