"""What a model card says of how an agent drives."""

from pathlib import Path

import pandas as pd

from rcdsac_trl.report import findings
from rcdsac_trl.report.read import read_episodes
from rcdsac_trl.report.statistics import CONFIDENCE
from rcdsac_trl.report.table import markdown

# Statistic of `findings.summary`, and what it is called in a card.
_SHOWN = {
    "collisions": "collisions",
    "reward": "reward",
    "collision_free": "free of collision",
    "goals": "goals",
    "mean_speed_m_per_s": "m/s",
    "success": "first goal reached untouched",
}


def driving_section(evaluation: Path) -> str:
    """Return a section of Markdown with the means of an evaluation and their intervals.

    Args:
        evaluation: a folder that ``evaluate`` wrote.

    Raises:
        UserInputError: if it cannot be read.
    """
    episodes = read_episodes([evaluation])
    told = episodes.protocol
    summary = findings.summary(episodes)
    summary = summary[summary["statistic"].isin(_SHOWN)]
    cells = summary.assign(cell=[_cell(*row) for row in summary[["value", "low", "high"]].itertuples(index=False)])
    wide = cells.pivot(index="condition", columns="statistic", values="cell")
    order = list(dict.fromkeys(summary["condition"]))
    shown = [name for name in _SHOWN if name in wide]
    table = wide.loc[order, shown].rename(columns=_SHOWN).rename_axis(columns=None).reset_index()
    number = told["num_maps"] * told["num_episodes"]
    return f"""
## How it drives

Means of {number} episodes of {told["task"]["episode_steps"]} steps on {told["num_maps"]} {told["split"]} maps
(seed {told["seed"]}), which it was never trained on and never chosen by; {CONFIDENCE:.0%} intervals with the map as the
unit. One training seed: another agent of the same recipe will differ.

{markdown(table)}
"""


def _cell(value: float, low: float, high: float) -> str:
    digits = 0 if abs(value) >= 100 else 2
    if pd.isna(value):
        return ""
    return f"{value:.{digits}f} [{low:.{digits}f}, {high:.{digits}f}]"
