"""Why robots still collide: what was hit, and whether it was sensed, from ``collisions.csv``."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from rcdsac_trl.report.read import CONDITION, TOLD, Episodes, read_evaluation, under

THINGS = {
    "outer_wall": "outer wall",
    "inner_wall": "inner wall",
    "mapped_clutter": "clutter the planner knows",
    "unmapped_clutter": "clutter it does not know",
    "mover": "mover",
}
"""What can be hit, and what it is called in reports."""
ALL = "all"
"""In the place of a thing: whatever was hit."""


def collision_summary(
    collisions: pd.DataFrame, episodes: pd.DataFrame, conditions: pd.DataFrame, by: Sequence[str]
) -> pd.DataFrame:
    """Sum collisions up, one row a condition and thing that it hit, after one for all things.

    Args:
        collisions: ``collisions.csv``.
        episodes: those that were looked at for collisions; conditions without any are left out.
        conditions: one row a condition; its columns are repeated.
        by: columns that tell conditions apart.

    Returns:
        The columns of `conditions`, `thing`, `collisions`; `per_episode`; `share` of the condition's collisions;
        `outside_share`, of these how many had the contact outside the sectors that the sensor has; `never_share`, how
        many hit what the agent had never sensed; `median_unsensed_s`, how long ago it last sensed it, where it ever
        did; `median_abs_bearing_rad` of the contact.
    """
    rows = []
    for _, condition in conditions.iterrows():
        driven = under(episodes, condition, by)
        if driven.empty:
            continue
        hit = under(collisions, condition, by)
        parts = {ALL: hit} | {thing: hit[hit["thing"] == thing] for thing in THINGS}
        for thing, part in parts.items():
            if thing == ALL or len(part):
                rows.append({**condition, "thing": thing} | _summed(part, len(driven), len(hit)))
    return pd.DataFrame(rows)


def _summed(part: pd.DataFrame, episodes: int, all_collisions: int) -> dict[str, Any]:
    unsensed_s = part["unsensed_s"].astype(float)
    return {
        "collisions": len(part),
        "per_episode": len(part) / episodes,
        "share": len(part) / all_collisions if all_collisions else float("nan"),
        "outside_share": 1.0 - part["bearing_sensed"].astype(float).mean(),
        "never_share": unsensed_s.isna().astype(float).mean(),
        "median_unsensed_s": unsensed_s.median(),
        "median_abs_bearing_rad": part["bearing_rad"].astype(float).abs().median(),
    }


def of_episodes(episodes: Episodes, labels: Sequence[str]) -> pd.DataFrame:
    """Return the :func:`collision_summary` of evaluations that have one, each condition under its label.

    Args:
        episodes: of all evaluations; those of older versions say nothing of collisions.
        labels: one a condition, in their order.
    """
    conditions = episodes.conditions[[*CONDITION]].assign(condition=list(labels))
    diagnosed = episodes.table[episodes.table["diagnosed"]]
    return collision_summary(episodes.collisions, diagnosed, conditions, CONDITION)


def wide(summary: pd.DataFrame) -> pd.DataFrame:
    """Lay the summary of a report out with a row a condition, as text."""
    rows = []
    for condition, parts in summary.groupby("condition", sort=False):
        per_episode = parts.set_index("thing")["per_episode"]
        total = {str(name): value for name, value in parts[parts["thing"] == ALL].iloc[0].items()}
        row = {"condition": condition, "collisions an episode": f"{per_episode[ALL]:.2f}"}
        row |= {name: f"{per_episode.get(thing, 0.0):.2f}" for thing, name in THINGS.items()}
        row |= {
            "outside the sensor's sectors": _unless_missing(total["outside_share"], "{:.0%}"),
            "never sensed": _unless_missing(total["never_share"], "{:.0%}"),
            "last sensed, median": _unless_missing(total["median_unsensed_s"], "{:.2f} s before"),
            "bearing to either side, median": _unless_missing(np.degrees(total["median_abs_bearing_rad"]), "{:.0f}°"),
        }
        rows.append(row)
    return pd.DataFrame(rows)


def _unless_missing(value: float, form: str) -> str:
    return "" if pd.isna(value) else form.format(value)


def write_collisions(folder: Path) -> pd.DataFrame:
    """Write ``collision_summary.csv`` of a folder that ``evaluate`` wrote, and return it."""
    evaluation = read_evaluation(folder)
    episodes, collisions = evaluation.episodes, evaluation.collisions
    assert collisions is not None  # evaluate has just written it
    by = [key for key in TOLD if key in episodes]
    summary = collision_summary(collisions, episodes, episodes[by].drop_duplicates(), by)
    summary.to_csv(folder / "collision_summary.csv", index=False, float_format="%.6g")
    return summary
