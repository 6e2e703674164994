"""What ``course`` left behind, of one or several folders, checked to be comparable."""

import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import pandas as pd

from rcdsac_trl.errors import UserInputError
from rcdsac_trl.report.evaluation_folders import COURSE

# Who drove, and what the version of the code was called, may differ; all else decides what they met.
_MAY_DIFFER = ("entries", "agents", "commit")
# Says of each run by its name how it acted: one that is in two folders must have acted alike.
_BY_RUN = "acting"
_WHO = ["run", "agent", "beta"]
_RUN = ["direction", "repetition"]


def read_courses(folders: Sequence[Path]) -> pd.DataFrame:
    """Return ``runs.csv`` of all folders that ``course`` wrote, together.

    Args:
        folders: each must be one.

    Raises:
        UserInputError: if one cannot be read, if they were driven under different conditions, or if two hold the same
            agent at the same beta.
    """
    tables = [_read(folder) for folder in folders]
    for folder, (described, _) in zip(folders[1:], tables[1:], strict=True):
        first = tables[0][0]
        for key in sorted((first.keys() | described.keys()) - {*_MAY_DIFFER, _BY_RUN}):
            if first.get(key) != described.get(key):
                raise UserInputError(
                    f"{folders[0]} and {folder} drove the course under different conditions ({key} is {first.get(key)} "
                    f"and {described.get(key)}): report on them apart"
                )
    _check_same_acting(folders, [dict(described.get(_BY_RUN, {})) for described, _ in tables])
    runs = pd.concat([table for _, table in tables], ignore_index=True)
    if (twice := runs.duplicated([*_WHO, *_RUN])).any():
        run, agent = runs.loc[twice, ["run", "agent"]].iloc[0]
        raise UserInputError(f"{agent} of {run} is in two of the folders of courses: leave one out")
    return runs


def _check_same_acting(folders: Sequence[Path], acting: Sequence[dict[str, object]]) -> None:
    firsts: dict[str, tuple[Path, object]] = {}
    for folder, by_run in zip(folders, acting, strict=True):
        for run, how in by_run.items():
            other, before = firsts.setdefault(run, (folder, how))
            if how != before:
                raise UserInputError(
                    f"{other} and {folder} let {run} act differently ({before} and {how}): report on them apart"
                )


def _read(folder: Path) -> tuple[dict[str, Any], pd.DataFrame]:
    try:
        described = dict(json.loads((folder / COURSE).read_text(encoding="utf-8")))
        runs = pd.read_csv(folder / "runs.csv")
    except (OSError, ValueError, TypeError) as error:
        raise UserInputError(f"{folder} cannot be read ({error}): drive the course into another folder") from error
    if missing := {*_WHO, *_RUN, "finished", "time_s", "collisions"} - set(runs):
        raise UserInputError(f"{folder} does not say {', '.join(sorted(missing))}: drive the course with this version")
    return described, runs
