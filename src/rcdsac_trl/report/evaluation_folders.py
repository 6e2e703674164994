"""Which folders hold results that reports read; told without pandas, so that a mistyped one is told at once."""

import os
from collections.abc import Sequence
from pathlib import Path

from rcdsac_trl.errors import UserInputError

DESCRIPTION = "evaluation.json"
"""What makes a folder one of an evaluation."""
BARN = "barn.json"
"""The same of runs through BARN's worlds."""
COURSE = "course.json"
"""The same of drives over the office course."""


def runs_among(folders: Sequence[Path]) -> list[Path]:
    """Return some folders, with the evaluated runs of each folder of runs in its place.

    Args:
        folders: as a user names them; those that are not there, or hold no evaluated run, stay as they are.
    """
    return [run for folder in folders for run in (_evaluated_runs_in(folder) or [folder])]


def _evaluated_runs_in(folder: Path) -> list[Path]:
    """Return the runs of a folder that have evaluations; none if it is a run, or an evaluation, itself."""
    if any(folder.glob("evaluation/*")) or any((folder / name).is_file() for name in (DESCRIPTION, BARN, COURSE)):
        return []
    return sorted({path.parents[2] for path in folder.glob(f"*/evaluation/*/{DESCRIPTION}")})


def all_trainings(results: Path, name: str) -> list[Path]:
    """Return the folders of all trainings of an agent, or of a baseline, in a folder that ``publish`` wrote to.

    Args:
        results: with the first training's in ``<name>``, and others in ``seed-*/<name>``.
        name: such as ``sac-narrow``.
    """
    return [results / name, *sorted(results.glob(f"seed-*/{name}"))]


def find_evaluations(folders: Sequence[Path]) -> list[Path]:
    """Return the evaluations among and in some folders.

    Args:
        folders: of evaluations, or of runs, whose ``evaluation/`` holds some.

    Raises:
        UserInputError: if no folder is named, or for one that is not there, or has none.
    """
    if not folders:
        raise UserInputError("name what to report on: runs=[<folder>,...] of runs or of their evaluations")
    found: list[Path] = []
    for folder in folders:
        if not os.path.isdir(folder):  # false for a name that is too long, too
            raise UserInputError(f"there is no folder {folder}: name runs, evaluations of them, or a folder of runs")
        inside = [folder] if (folder / DESCRIPTION).is_file() else []
        inside += sorted(path.parent for path in folder.glob(f"evaluation/*/{DESCRIPTION}"))
        if not inside and (folder / BARN).is_file():
            raise UserInputError(
                f"{folder} holds runs through BARN's worlds, which its summary.csv sums up: name evaluations on maps"
            )
        if not inside:
            raise UserInputError(f"{folder} holds no {DESCRIPTION}: evaluate it first, or name another folder")
        found += [path for path in inside if path not in found]
    return found


def is_course(folder: Path) -> bool:
    """Say whether ``course`` wrote a folder."""
    return (folder / COURSE).is_file()
