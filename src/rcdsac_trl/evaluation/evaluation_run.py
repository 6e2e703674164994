"""Evaluation: the same maps, starts and goals for every agent, deterministic actions, one row an episode."""

import contextlib
from collections.abc import Callable, Generator, Mapping, Sequence
from pathlib import Path
from typing import Any

import pandas as pd
from tqdm import tqdm

from rcdsac_trl.rollout.evaluation_pool import Rows
from rcdsac_trl.rollout.measurement import CONDITION_COLUMNS, table_of
from rcdsac_trl.rollout.metrics import summarise
from rcdsac_trl.storage.results_folder import ResultsFolder


class EvaluationRun:
    """An evaluation and the folder it writes: ``episodes.csv``, ``summary.csv`` and ``evaluation.json``.

    Args:
        out: the folder; made when the results are there.
        described: what is evaluated and how; equal descriptions give equal files.
        num_maps: maps to drive on.
        maps: yields the rows of each map as it has been driven.
        more: makes further rows of all rows that were driven; None: there are none.
        film: writes a film into the folder of the results and returns its files; None: there is none.

    Raises:
        UserInputError: if the folder holds another evaluation.
    """

    def __init__(
        self,
        *,
        out: Path,
        described: Mapping[str, Any],
        num_maps: int,
        maps: Callable[[], Generator[Rows, None, None]],
        more: Callable[[pd.DataFrame], pd.DataFrame] | None = None,
        film: Callable[[Path], Sequence[Path]] | None = None,
    ) -> None:
        self.results = ResultsFolder(out, "evaluation.json", described)
        self.num_maps = num_maps
        self.maps = maps
        self.more = more
        self.film = film

    def run(self) -> None:
        """Drive, print the summary, and write.

        Raises:
            UserInputError: if another evaluation was written into the folder meanwhile.
        """
        # Closed here and now where Ctrl-C comes between two maps, and with them what drives.
        with contextlib.closing(self.maps()) as maps:
            episodes = table_of(tqdm(maps, total=self.num_maps, unit="map", disable=None))
        if self.more is not None:
            episodes = pd.concat([episodes, self.more(episodes)], ignore_index=True)
        summary = summarise(episodes, [key for key in CONDITION_COLUMNS if key in episodes])
        shown = summary.dropna(axis="columns", how="all").set_index("episodes")
        print(shown.T.to_string(header=True, float_format="{:.3f}".format, na_rep=""))
        self.results.write(
            {
                "episodes.csv": episodes.to_csv(index=False, float_format="%.9g"),
                "summary.csv": summary.to_csv(index=False, float_format="%.6g"),
            }
        )
        print(f"written to {self.results.path}")
        if self.film is not None:
            print(f"filmed: {', '.join(map(str, self.film(self.results.path)))}")
