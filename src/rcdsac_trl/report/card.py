"""What is measured of an agent, as the numbers that its card, lists and tables are made from."""

import contextlib
import json
import math
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pandas as pd

from rcdsac_trl.errors import UserInputError
from rcdsac_trl.report import findings
from rcdsac_trl.report.calibration_report import COVERED, Tell, calibration_of, driven_calibration_of
from rcdsac_trl.report.collision_report import of_episodes
from rcdsac_trl.report.read import read_episodes
from rcdsac_trl.report.rows import row_label
from rcdsac_trl.report.statistics import CONFIDENCE

_TOLD = (0.05, 0.5, 0.95)
"""Fractions whose coverage a card quotes of the quantiles that an agent tells."""


def measured_values(
    evaluation: Path, calibration: Path | None = None, driven: Path | None = None, tell: Tell | None = None
) -> dict[str, Any]:
    """Return what was measured of an agent, as plain values.

    Args:
        evaluation: a folder that ``evaluate`` wrote, of an agent or a baseline under fixed conditions.
        calibration: a folder that ``calibrate`` wrote; None: there is none.
        driven: one that ``calibrate as_driven=true`` wrote.
        tell: how the agent recalibrates what its critics say; None: it does not.

    Returns:
        The entries of ``measured.json`` that follow from them: `row`, `conditions`, `protocol`, `rules_version`,
        `map_version`, `confidence`, `train_seed`, `commit`, `calibration` and `told_calibration`. See
        :class:`rcdsac_trl.deploy.policy.measured.Measured`.

    Raises:
        UserInputError: if one cannot be read.
    """
    described = json.loads((evaluation / "evaluation.json").read_text(encoding="utf-8"))
    protocol = {key: described[key] for key in ("split", "seed", "num_maps", "num_episodes", "sampled", "map", "task")}
    return {
        "row": row_label(described["agent"]),
        "conditions": _conditions(evaluation),
        "protocol": protocol,
        # Rules of version 1 did not say that they were.
        "rules_version": described["task"].get("version", 1),
        "map_version": described["map"].get("version", 1),
        "confidence": CONFIDENCE,
        "train_seed": described["train_seed"],
        "commit": described["commit"],
        "calibration": [] if calibration is None else _calibration(calibration),
        "told_calibration": [] if driven is None else told_calibration(driven, tell),
    }


def _conditions(evaluation: Path) -> list[dict[str, Any]]:
    episodes = read_episodes([evaluation])
    labels = findings.labels(episodes)
    summary = findings.summary(episodes)
    by_thing = of_episodes(episodes, labels)
    conditions = []
    for (_, condition), label in zip(episodes.conditions.iterrows(), labels, strict=True):
        of_condition = summary[(summary["condition"] == label) & summary["statistic"].isin(episodes.metrics)]
        metrics = {
            row["statistic"]: {"mean": row["value"], "low": row["low"], "high": row["high"]}
            for _, row in of_condition.dropna().iterrows()
        }
        hit = by_thing[by_thing["condition"] == label] if len(by_thing) else by_thing
        conditions.append(
            {
                "label": label,
                "beta": _number(condition["beta"]),
                "collision_weight": _number(condition["collision_weight"]),
                "metrics": metrics,
                "collisions_by_thing": {
                    row["thing"]: {key: _number(row[key]) for key in ("per_episode", "outside_share", "never_share")}
                    for _, row in hit.iterrows()
                },
            }
        )
    return conditions


def _calibration(folder: Path) -> list[dict[str, Any]]:
    with _readable(folder):
        table = calibration_of(folder)
    return [
        {
            "beta": _number(row["beta"]),
            "states": int(row["states"]),
            "tail_depth": _number(row["tail_depth"]),
            "predicted_tail_depth": _number(row["predicted_tail_depth"]),
            "coverage": {f"{fraction:g}": _number(row[f"coverage_{fraction:g}"]) for fraction in COVERED},
        }
        for _, row in table.iterrows()
    ]


def told_calibration(folder: Path, tell: Tell | None) -> list[dict[str, Any]]:
    """Return how true the quantiles are that an agent tells: `told_calibration` of :func:`measured_values`.

    Args:
        folder: that ``calibrate as_driven=true`` wrote.
        tell: how the agent recalibrates what its critics say; None: it does not.

    Raises:
        UserInputError: if it cannot be read.
    """
    with _readable(folder):
        versions = driven_calibration_of(folder, tell)
        described = json.loads((folder / "calibration.json").read_text(encoding="utf-8"))
    return [
        {
            "beta": _number(row["beta"]),
            "told": name,
            "num_maps": described["num_maps"],
            "num_episodes": described["num_episodes"],
            "seed": described["seed"],
            "states": int(row["states"]),
            "earned": _number(row["discounted_reward"]),
            "predicted": _number(row["predicted"]),
            "tail_depth": _number(row["tail_depth"]),
            "predicted_tail_depth": _number(row["predicted_tail_depth"]),
            "coverage": {f"{fraction:g}": _number(row[f"coverage_{fraction:g}"]) for fraction in _TOLD},
        }
        for name, table in versions
        for _, row in table.iterrows()
    ]


@contextlib.contextmanager
def _readable(folder: Path) -> Iterator[None]:
    """Say of a folder that cannot be read what to do."""
    try:
        yield
    except (OSError, ValueError, KeyError) as error:
        raise UserInputError(f"{folder} cannot be read ({error}): calibrate again into another folder") from error


def _number(value: Any) -> float | None:
    """Return a number as JSON has it, which knows no NaN."""
    return None if pd.isna(value) or not math.isfinite(value) else float(value)
