"""How runs learnt, over updates and over time."""

from collections.abc import Sequence
from pathlib import Path

import pandas as pd

from rcdsac_trl.errors import UserInputError, first_line
from rcdsac_trl.tables import read_growing


def validation_of_runs(folders: Sequence[Path]) -> dict[str, pd.DataFrame]:
    """Return the validation episodes of those folders that are runs and have validated, by the folder's name.

    A column `elapsed_s`, the time since the start of the run, is added where the run has logged it. A run may still be
    training.

    Raises:
        UserInputError: if tables of a run are damaged.
    """
    found = {}
    for folder in folders:
        episodes = folder / "validation_episodes.csv"
        # One line an iteration: agent steps, seconds.
        clock = folder / "csv" / "scalars" / "time" / "elapsed_s.csv"
        if not episodes.is_file():
            continue
        try:
            rows = read_growing(episodes)
            if clock.is_file():
                elapsed_s = read_growing(clock, header=None, names=["steps", "elapsed_s"])["elapsed_s"]
                rows["elapsed_s"] = rows["iteration"].map(elapsed_s)
        except pd.errors.EmptyDataError:  # its first line is being written
            continue
        except (OSError, ValueError, KeyError) as error:
            raise UserInputError(f"{folder} cannot be read ({first_line(error)}): leave it out") from error
        found[folder.name] = rows
    return found
