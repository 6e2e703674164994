"""The runs of an evaluation of BARN's protocol, one row each, with the protocol's metrics."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import pandas as pd

from rcdsac_trl.evaluation.measured_run import Findings
from rcdsac_trl.rollout.collisions import COLLISIONS
from rcdsac_trl.rollout.evaluation_pool import Rows
from rcdsac_trl.rollout.measurement import CONDITION_COLUMNS, table_of
from rcdsac_trl.world.maps.files.barn import TIME_LIMIT_S, optimal_time_s, score, world_number


class World(NamedTuple):
    """What the metrics need of one of BARN's worlds: its number, and its optimal time, s."""

    number: int
    optimal_s: float


def timed(worlds: Sequence[Path]) -> list[World]:
    """Return the numbers and the optimal times of worlds.

    Raises:
        UserInputError: a world's path is missing.
    """
    return [World(world_number(world), optimal_time_s(world)) for world in worlds]


def barn_runs(worlds: Sequence[World], rows: Rows) -> Findings:
    """Return the table of runs through BARN's worlds, ``runs.csv``.

    Args:
        worlds: in the order of the maps.
        rows: one an episode, with navigation metrics and collisions.
    """
    measured = table_of([rows])
    conditions = [key for key in CONDITION_COLUMNS if key in measured]
    runs = [
        {key: row[key] for key in conditions}
        | {"world": worlds[row["map"]].number, "run": row["episode"]}
        | run_metrics(row, worlds[row["map"]].optimal_s)
        for row in measured.to_dict("records")
    ]
    return Findings({"runs.csv": pd.DataFrame(runs).to_csv(index=False, float_format="%.6g")})


def run_metrics(row: Mapping[Any, Any], optimal_s: float) -> dict[str, float]:
    """Return the metrics of a run, which its goal, its first collision or the time limit ends.

    Args:
        row: its episode's row.
        optimal_s: optimal time of its world.

    Returns:
        `success`, `collision` and `timeout`, one of which is 1; `time_s` to the goal, NaN where it was not reached;
        `optimal_time_s`; `score` as the challenge began, and `later_score`, which rewards speed up to
        twice the optimal time.
    """
    arrived = bool(row["success"]) and row["time_to_goal_s"] <= TIME_LIMIT_S
    collided = bool(row["collided"]) and row[COLLISIONS][0]["time_s"] <= TIME_LIMIT_S
    time_s = row["time_to_goal_s"] if arrived else float("nan")
    return {
        "success": float(arrived),
        "collision": float(collided),
        "timeout": float(not arrived and not collided),
        "time_s": time_s,
        "optimal_time_s": optimal_s,
        "score": score(arrived, time_s, optimal_s),
        "later_score": score(arrived, time_s, optimal_s, fastest=2.0),
    }
