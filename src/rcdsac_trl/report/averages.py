"""Kinds of agents, averaged as the paper's text does, and how RC-DSAC (resample) differs from each.

Section "Performance Comparison" of Choi, Dance, Kim, Hwang and Park (2021), *Risk-Conditioned Distributional Soft
Actor-Critic for Risk-Sensitive Navigation*.
"""

import math

import pandas as pd

from rcdsac_trl.report.read import Episodes, possible
from rcdsac_trl.report.rows import called, paper_table
from rcdsac_trl.report.statistics import Interval
from rcdsac_trl.report.table import TABULATED
from rcdsac_trl.report.training_errors import training_errors

FIRST = "RC-DSAC (resample)"
"""What the others are compared with."""

_NOTHING = Interval(math.nan, math.nan, math.nan)
_COLUMNS = [
    *("name", "sensor", "fewest_trainings", "most_trainings"),
    *(f"{metric}{of}{part}" for metric in TABULATED for of in ("", "_from") for part in ("", "_low", "_high")),
]


def averaged_rows(rows: pd.DataFrame) -> dict[tuple[str, str], pd.DataFrame]:
    """Return which rows are averaged, by kind of agent and sensor: at the settings of beta that the paper has of DSAC.

    Args:
        rows: conditions, or rows of the paper's table, with `agent`, `beta` and `sensor`.

    Returns:
        Of kinds without beta all rows; kinds that lack one of the settings are left out.
    """
    paper = paper_table()
    dsac = paper[paper["name"] == "DSAC"]
    settings = set(zip(dsac["psi"], dsac["beta"], strict=True))
    names = [called(agent) for agent in rows["agent"]]
    kept = [
        pd.isna(beta) or (measure, beta) in settings for (_, measure), beta in zip(names, rows["beta"], strict=True)
    ]
    kinds = pd.Series([kind for kind, _ in names], rows.index)
    return {
        (str(kind), str(sensor)): of_kind
        for (kind, sensor), of_kind in rows[kept].groupby([kinds[kept], "sensor"], sort=False)
        if of_kind["beta"].notna().sum() in (0, len(settings))
    }


def paper_averages() -> pd.DataFrame:
    """Return the averages of the paper's own table: `name`, `sensor`, `collisions` and `reward`."""
    means = [f"{metric}_mean" for metric in TABULATED]
    rows = [(*kind, *rows[means].mean()) for kind, rows in averaged_rows(paper_table()).items()]
    return pd.DataFrame(rows, columns=["name", "sensor", *TABULATED])


def averages(episodes: Episodes) -> pd.DataFrame:
    """Average what was driven at settings of beta, over maps and trainings.

    Returns:
        One row a kind and sensor: `name`, `sensor`; `fewest_trainings` and `most_trainings` of its rows, missing of
        planners; and for `collisions` and `reward` the mean, its `_low` and `_high`, and with `_from` behind the
        metric's name how much more :data:`FIRST` has, with its `_low` and `_high`, missing of itself.
    """
    errors, conditions = training_errors(episodes), episodes.conditions
    kinds = averaged_rows(conditions[conditions["beta_controller"].isna()])
    rows = []
    for (name, sensor), of_kind in kinds.items():
        row: dict[str, object] = {"name": name, "sensor": sensor} | _trainings(episodes, of_kind)
        for metric in TABULATED:
            found = errors.contrast(_share(of_kind, 1.0), metric).within(*possible(metric))
            more = _NOTHING
            if name != FIRST and (FIRST, sensor) in kinds:
                sides = [*_share(kinds[FIRST, sensor], 1.0), *_share(of_kind, -1.0)]
                more = errors.contrast(sides, metric)
            for key, of in ((metric, found), (f"{metric}_from", more)):
                row |= {key: of.value, f"{key}_low": of.low, f"{key}_high": of.high}
        rows.append(row)
    return pd.DataFrame(rows, columns=_COLUMNS).astype({"fewest_trainings": "Int64", "most_trainings": "Int64"})


def _share(conditions: pd.DataFrame, weight: float) -> list[tuple[float, pd.Series]]:
    """Share a weight out over some conditions."""
    return [(weight / len(conditions), condition) for _, condition in conditions.iterrows()]


def _trainings(episodes: Episodes, conditions: pd.DataFrame) -> dict[str, object]:
    trained = conditions[conditions["trained"]]
    numbers = [len(episodes.seeds(condition)) for _, condition in trained.iterrows()]
    return {"fewest_trainings": min(numbers, default=None), "most_trainings": max(numbers, default=None)}


def trainings_told(row: pd.Series) -> str:
    """Say how many trainings a row of :func:`averages` is of; of planners, and of the paper's, nothing.

    Example:
        >>> trainings_told(pd.Series({"fewest_trainings": 1, "most_trainings": 3}))
        '1 to 3'
    """
    fewest, most = row["fewest_trainings"], row["most_trainings"]
    if pd.isna(fewest):
        return ""
    return f"{fewest}" if fewest == most else f"{fewest} to {most}"
