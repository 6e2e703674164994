"""Runs through BARN's worlds as tables, a world and a condition, beside what others have published."""

import json
import math
from pathlib import Path

import pandas as pd

from rcdsac_trl.report.evaluation_folders import BARN
from rcdsac_trl.report.evaluation_summary import summarised
from rcdsac_trl.report.statistics import Interval, bootstrap

METRICS = ("success", "collision", "timeout", "time_s", "score", "later_score")

_CONDITION = ("beta", "collision_weight", "beta_controller")
_WORLDS = 50
# Percent of the runs that succeed and that collide, of robots with a lidar of 270 degrees and 30 m (Xiao et al., 2022,
# and The BARN Challenge 2023; DRL-VO: Xie and Dames, 2023).
_PUBLISHED = (("DWA", "85-88", "5-9"), ("DRL-VO", "93.6", "6.4"), ("best entry of 2023", "99.0", "0.6"))


def describe_evaluation(folder: Path) -> str:
    """Put an evaluation's tables into words, BARN's as another's.

    Args:
        folder: that ``evaluate`` wrote.
    """
    return write_barn(folder) if (folder / BARN).is_file() else summarised(folder)


def write_barn(folder: Path) -> str:
    """Write ``worlds.csv`` (means of a world) and ``summary.csv`` (means over worlds with 95 % intervals), and say it.

    Args:
        folder: with ``runs.csv`` and ``barn.json``.
    """
    runs = pd.read_csv(folder / "runs.csv")
    described = json.loads((folder / BARN).read_text(encoding="utf-8"))
    conditions = [key for key in _CONDITION if key in runs and runs[key].notna().any()]
    by_world = runs.groupby([*conditions, "world"], sort=False, dropna=False)[list(METRICS)].mean().reset_index()
    by_world.to_csv(folder / "worlds.csv", index=False, float_format="%.6g")
    rows, lines = [], [f"{'':30}{'success':>22}{'collision':>22}{'timeout':>10}{'time':>9}{'score':>23}{'later':>7}"]
    groups = runs.groupby(conditions, sort=False, dropna=False) if conditions else [((), runs)]
    for values, of_condition in groups:
        found = {metric: _over_worlds(of_condition, metric) for metric in METRICS}
        condition = dict(zip(conditions, values, strict=True))
        rows.append(condition | {"runs": len(of_condition)} | _columns(found))
        told = ", ".join(
            str(value) if isinstance(value, str) else f"{key}={value:g}" for key, value in condition.items()
        )
        lines.append(_line(f"{described['agent']} {told}", found))
    pd.DataFrame(rows).to_csv(folder / "summary.csv", index=False, float_format="%.6g")
    lines += [f"{name:30}{success + ' %':>22}{collision + ' %':>22}" for name, success, collision in _PUBLISHED]
    known = "; here the planner knew the cylinders, which they had to see" if described["map"]["mapped"] else ""
    lines.append(
        f"({runs['world'].nunique()} of the protocol's {_WORLDS} worlds; intervals of 95 % over worlds. The published "
        f"robots are about three times as fast: compare success and collision, not the score{known}.)"
    )
    return "\n".join(lines)


def _over_worlds(runs: pd.DataFrame, metric: str) -> Interval:
    """Return the mean over worlds: runs in one world are no independent observations.

    Its interval leaves out what cannot be, which those over a few worlds reach: shares and scores lie in [0, 1].
    """
    table = runs.pivot(index="world", columns="run", values=metric)
    return bootstrap(table.to_numpy(float)[None]).within(0.0, math.inf if metric == "time_s" else 1.0)


def _columns(found: dict[str, Interval]) -> dict[str, float]:
    return {
        name: value
        for metric, interval in found.items()
        for name, value in (
            (metric, interval.value),
            (f"{metric}_low", interval.low),
            (f"{metric}_high", interval.high),
        )
    }


def _line(name: str, found: dict[str, Interval]) -> str:
    success, collision = (_percent(found[metric]) for metric in ("success", "collision"))
    score = found["score"]
    shown = f"{score.value:.3f} [{score.low:.3f}, {score.high:.3f}]"
    timeout, time_s = 100 * found["timeout"].value, found["time_s"].value
    rates = f"{success:>22}{collision:>22}{timeout:>8.1f} %"
    time = "-" if math.isnan(time_s) else f"{time_s:.1f} s"
    return f"{name:30}{rates}{time:>9}{shown:>23}{found['later_score'].value:>7.3f}"


def _percent(interval: Interval) -> str:
    return f"{100 * interval.value:.1f} [{100 * interval.low:.0f}, {100 * interval.high:.0f}] %"
