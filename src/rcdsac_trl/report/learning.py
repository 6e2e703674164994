"""How runs learnt, over updates and over time."""

from collections.abc import Sequence
from pathlib import Path

import pandas as pd


def validation_of_runs(folders: Sequence[Path]) -> dict[str, pd.DataFrame]:
    """Return the validation episodes of those folders that are runs and have validated, by the folder's name.

    A column `elapsed_s`, the time since the start of the run, is added where the run has logged it.
    """
    found = {}
    for folder in folders:
        episodes = folder / "validation_episodes.csv"
        # One line an iteration: agent steps, seconds.
        clock = folder / "csv" / "scalars" / "time" / "elapsed_s.csv"
        if not episodes.is_file():
            continue
        rows = pd.read_csv(episodes)
        if clock.is_file():
            elapsed_s = pd.read_csv(clock, header=None, names=["steps", "elapsed_s"])["elapsed_s"]
            rows["elapsed_s"] = rows["iteration"].map(elapsed_s)
        found[folder.name] = rows
    return found
