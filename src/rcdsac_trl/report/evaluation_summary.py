"""An evaluation in a few lines: a row a condition with units and spread, and what was hit."""

from collections.abc import Sequence
from pathlib import Path

import pandas as pd

from rcdsac_trl.report.collision_report import ALL, THINGS, write_collisions
from rcdsac_trl.report.read import TOLD, Evaluation, read_evaluation

# What is shown of an episode, how its numbers are written, and what stands above them.
_COLUMNS = (
    ("collisions", ".2f", "collisions"),
    ("reward", ".0f", "reward"),
    ("goals", ".2f", "goals"),
    ("mean_speed_m_per_s", ".2f", "speed, m/s"),
    ("contact_fraction", ".1%", "in contact"),
)


def summarised(folder: Path) -> str:
    """Write ``collision_summary.csv`` of a folder that ``evaluate`` wrote, and put its episodes into a few lines."""
    evaluation = read_evaluation(folder)
    return "\n".join([*_table(evaluation), _hit(write_collisions(folder))])


def _table(evaluation: Evaluation) -> list[str]:
    """Return a heading and a row a condition: mean and standard deviation over its episodes."""
    told, episodes = evaluation.described, evaluation.episodes
    by = [key for key in TOLD if key in episodes and episodes[key].notna().any()]
    groups = episodes.groupby(by, dropna=False, sort=False) if by else [((), episodes)]
    rows = [
        [
            _named(dict(zip(by, values, strict=True))) or told["agent"],
            *(_with_spread(of[key], form) for key, form, _ in _COLUMNS),
            f"{(of['collisions'] == 0).mean():.0%}",
        ]
        for values, of in groups
    ]
    driven = f"{told['agent']}, {told['split']} maps {told['num_maps']} × {told['num_episodes']} episodes"
    heading = ["", *(heading for *_, heading in _COLUMNS), "without collision"]
    return [
        f"{driven} of {told['task']['episode_steps']} steps; mean ± standard deviation of an episode:",
        *_aligned([heading, *rows]),
    ]


def _with_spread(values: pd.Series, form: str) -> str:
    """Write mean and standard deviation, which one value does not have."""
    return f"{values.mean():{form}} ± {format(values.std(ddof=0), form) if len(values) > 1 else '–'}"


def _named(condition: dict[str, object]) -> str:
    """Name what an agent was told: a controller, or else a value."""
    if isinstance(controller := condition.pop("beta_controller", None), str):
        return controller
    names = {"beta": "beta", "collision_weight": "w_coll"}
    return " ".join(f"{names[key]}={value:g}" for key, value in condition.items() if pd.notna(value))  # type: ignore[call-overload]


def _aligned(rows: Sequence[Sequence[str]]) -> list[str]:
    widths = [max(map(len, column)) for column in zip(*rows, strict=True)]
    forms = [f"<{widths[0]}", *(f">{width}" for width in widths[1:])]
    return ["  ".join(format(cell, form) for cell, form in zip(row, forms, strict=True)) for row in rows]


def _hit(summary: pd.DataFrame) -> str:
    """Say what was hit, over all conditions."""
    by_thing = summary[summary["thing"] != ALL].groupby("thing")["collisions"].sum().sort_values(ascending=False)
    if by_thing.empty:
        return "nothing was hit"
    shares = by_thing / by_thing.sum()
    return "hit: " + ", ".join(f"{THINGS[str(thing)]} {share:.0%}" for thing, share in shares.items())
