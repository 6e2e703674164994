r"""What predicted quantiles are worth: coverage, PIT, crossings and tails, from what ``calibrate`` wrote.

A state has 100 predicted quantiles and some returns that were really earned from it; of an agent that was measured as
it drives, 16 quantiles and one return. If the prediction is true, a share :math:`\tau` of the returns lies below
:math:`Z_\tau`, whatever :math:`\tau` (*coverage*), and the share of the quantiles below a return (*probability integral
transform*, PIT) is uniform over [0, 1].
"""

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
from matplotlib.figure import Figure

from rcdsac_trl.colors import beta_shades
from rcdsac_trl.report.cross_evaluation_report import write_cross_evaluation
from rcdsac_trl.report.statistics import Array, lower_mean
from rcdsac_trl.report.style import FAINT, INK, MARKERS, limits, style

COVERED = (0.05, 0.1, 0.25, 0.5, 0.75, 0.9, 0.95)
"""Fractions whose coverage is tabulated."""
TAIL = 0.1
"""Share of the worst returns that counts as the tail."""
MOST_PIT_BINS = 10


def coverage(quantiles: Array, returns: Array) -> Array:
    """Return the share of returns at or below each predicted quantile.

    Args:
        quantiles: ``[G, Q]``, one row a state.
        returns: ``[G, M]``.

    Returns:
        ``[Q]``; equal to the quantiles' fractions if the predictions are true.

    Example:
        >>> coverage(np.array([[0.0, 5.0]]), np.array([[1.0, 2.0, 3.0, 9.0]]))
        array([0.  , 0.75])
    """
    return (returns[:, :, None] <= quantiles[:, None, :]).mean((0, 1))


def pit(quantiles: Array, returns: Array) -> Array:
    """Return the share of the quantiles below each return, ``[G, M]``; uniform if the predictions are true.

    Example:
        >>> pit(np.array([[0.0, 1.0, 2.0, 3.0]]), np.array([[-1.0, 1.5, 9.0]]))
        array([[0. , 0.5, 1. ]])
    """
    return (quantiles[:, None, :] < returns[:, :, None]).mean(-1)


def pit_histogram(quantiles: Array, returns: Array) -> tuple[Array, Array]:
    """Return the shares of the returns by their :func:`pit`, and the borders of its bins, as many as divide evenly.

    A return that lies between the quantiles on either side of a border counts half on each, so that all shares are
    equal if the predictions are true.

    Example:
        >>> q = np.array([[1.0, 3.0, 5.0, 7.0]])  # at 1/8, 3/8, 5/8, 7/8: an eighth lies below, a quarter between two
        >>> pit_histogram(q, np.array([[0.0, 2.0, 2.0, 4.0, 4.0, 6.0, 6.0, 8.0]]))[0].tolist()
        [0.25, 0.25, 0.25, 0.25]
    """
    number = quantiles.shape[1]
    bins = max(bins for bins in range(1, MOST_PIT_BINS + 1) if number % bins == 0)
    halves = pit(quantiles, returns)[..., None] + np.array([-0.25, 0.25]) / number
    counts, edges = np.histogram(halves.clip(0.0, 1.0), bins=bins, range=(0.0, 1.0))
    return counts / counts.sum(), edges


def crossing_rate(quantiles: Array) -> float:
    """Return the share of neighbouring quantiles of which the higher fraction's is smaller.

    Example:
        >>> crossing_rate(np.array([[0.0, 1.0, 0.5, 2.0]]))
        0.3333333333333333
    """
    return float((np.diff(quantiles, axis=1) < 0.0).mean())


def crossing_depth(quantiles: Array) -> float:
    """Return how far quantiles lie below the largest one of a lower fraction, at worst: a mean over the states.

    Example:
        >>> crossing_depth(np.array([[0.0, 1.0, 0.5, 2.0], [0.0, 1.0, 2.0, 3.0]]))
        0.25
    """
    return float((np.maximum.accumulate(quantiles, axis=1) - quantiles).max(1).mean())


def errors(quantiles: Array, returns: Array) -> Array:
    """Return what returns exceed the predicted mean of their state by, ``[G, M]``."""
    return returns - quantiles.mean(1, keepdims=True)


def calibration_table(predictions: pd.DataFrame, returns: pd.DataFrame, gamma: float, horizon: int) -> pd.DataFrame:
    """Sum up a calibration, one row a beta.

    Args:
        predictions: ``predictions.csv``.
        returns: ``returns.csv``.
        gamma: discount.
        horizon: steps of a roll-out.

    Returns:
        `states`; `soft_return`, of an agent as it drives `discounted_reward`, and `predicted`, means, and `bias`, their
        difference; `missing`, what the horizon cuts off if later steps earn what the earlier ones do;
        `predicted_whole_history`, where the critics were also asked so; `correlation` over states of
        predicted and realised mean; `scatter`, standard deviation of the returns around the predicted mean of their
        state, and `predicted_scatter`; `rollout_scatter`, that around the realised mean of their state; `tail_depth`,
        how far the worst tenth of the returns lies below what their states let expect, and `predicted_tail_depth`;
        `coverage_<fraction>` and `recentred_coverage_<fraction>`; `crossing_rate` and `crossing_depth`.
    """
    rows = []
    earned, whole = _earned(returns), "whole_history_mean"
    for beta, states in predictions.groupby("beta", dropna=False):
        quantiles, realised = _arrays(states, returns)
        mean, error = realised.mean(), errors(quantiles, realised)
        centred = (error - error.mean()).reshape(1, -1)
        row = {
            "beta": beta,
            "states": len(states),
            earned: mean,
            "predicted": quantiles.mean(),
            "bias": -error.mean(),
            "missing": mean * gamma**horizon / (1.0 - gamma**horizon),
            **({"predicted_whole_history": states[whole].mean()} if whole in states else {}),
            "correlation": _correlation(quantiles.mean(1), realised.mean(1)),
            "scatter": error.std(),
            "predicted_scatter": quantiles.std(1).mean(),
            "rollout_scatter": np.sqrt(realised.var(1, ddof=1).mean()) if realised.shape[1] > 1 else np.nan,
            "tail_depth": -lower_mean(centred, TAIL)[0],
            "predicted_tail_depth": (quantiles.mean(1) - lower_mean(quantiles, TAIL)).mean(),
        }
        for fraction in COVERED:
            below = error <= (_at(quantiles, fraction) - quantiles.mean(1))[:, None]
            recentred = error - error.mean() <= (_at(quantiles, fraction) - quantiles.mean(1))[:, None]
            row |= {f"coverage_{fraction:g}": below.mean(), f"recentred_coverage_{fraction:g}": recentred.mean()}
        rows.append(row | {"crossing_rate": crossing_rate(quantiles), "crossing_depth": crossing_depth(quantiles)})
    return pd.DataFrame(rows)


def calibration_figure(title: str, predictions: pd.DataFrame, returns: pd.DataFrame) -> Figure:
    """Draw coverage, PIT, mean against mean, and the shape of the distribution; a colour a beta."""
    figure = Figure(figsize=(11.0, 7.6), layout="constrained")
    figure.suptitle(title, x=0.01, ha="left", fontsize=13, color=INK)
    covered, transformed, means, shape = figure.subplots(2, 2).flat
    groups = list(predictions.groupby("beta", dropna=False))
    extremes: list[float] = []
    for number, ((beta, states), color) in enumerate(zip(groups, beta_shades(len(groups)), strict=True)):
        quantiles, realised = _arrays(states, returns)
        error = errors(quantiles, realised)
        marker = MARKERS[number % len(MARKERS)]
        label = "all" if pd.isna(beta) else f"β = {float(str(beta)):g}"
        fractions = (np.arange(quantiles.shape[1]) + 0.5) / quantiles.shape[1]
        covered.plot(fractions, coverage(quantiles, realised), color=color, linewidth=1.9, label=label)
        covered.plot(fractions, coverage(quantiles, realised - error.mean()), color=color, linewidth=1.2, linestyle=":")
        shares, edges = pit_histogram(quantiles, realised)
        transformed.stairs(shares, edges, color=color, linewidth=1.9)
        predicted, real = quantiles.mean(1), realised.mean(1)
        means.scatter(predicted, real, s=22, color=color, marker=marker, alpha=0.75, linewidths=0)
        extremes += [*predicted, *real]
        shape.plot(fractions, (quantiles - quantiles.mean(1, keepdims=True)).mean(0), color=color, linewidth=1.9)
        around = np.quantile(error - error.mean(), fractions)
        shape.plot(fractions, around, color=color, linewidth=1.2, linestyle="--")
    style(covered, "coverage (dotted: after shifting the level)", "τ", "share of returns below Z_τ")
    style(transformed, "PIT: where returns lie among the quantiles", "share of quantiles below the return", "returns")
    style(means, "mean return of a state, higher is better", "predicted", "earned")
    style(shape, "around the predicted mean: Z_τ (dashed: returns)", "τ", "return, higher is better")
    covered.set(xlim=(0, 1), ylim=(0, 1))
    covered.plot([0, 1], [0, 1], color=FAINT, linewidth=1.2, linestyle="--", label="true quantiles")
    transformed.axhline(1 / len(shares), color=FAINT, linewidth=1.2, linestyle="--")
    transformed.set(xlim=(0, 1), ylim=(0, None))
    means.plot(limits(extremes), limits(extremes), color=FAINT, linewidth=1.2, linestyle="--")
    shape.set_xlim(0, 1)
    covered.legend(frameon=False, fontsize=9, labelcolor=INK)
    return figure


Tell = Callable[[Array, float | None], Array]
"""Returns what an agent tells where its critics say some quantiles, [G, Q], at a beta."""


def driven_calibration_of(folder: Path, tell: Tell | None) -> list[tuple[str, pd.DataFrame]]:
    """Return the :func:`calibration_table` of what critics say of an agent that drove, and of what it tells.

    Args:
        folder: that ``calibrate as_driven=true`` wrote.
        tell: recalibrates; None: the agent tells what its critics say.
    """
    described, predictions, returns = _read(folder)
    versions = {"raw": predictions}
    if tell is not None:
        groups = predictions.groupby("beta", dropna=False)
        versions["recalibrated"] = pd.concat([_told(states, tell, beta) for beta, states in groups])
    gamma, horizon = described["gamma"], described["horizon_steps"]
    return [(name, calibration_table(version, returns, gamma, horizon)) for name, version in versions.items()]


def _told(states: pd.DataFrame, tell: Tell, beta: Any) -> pd.DataFrame:
    """Return the states of a beta with what the agent tells in the place of what its critics say."""
    said = states.filter(regex=r"^q\d+$")
    told = tell(said.to_numpy(), None if pd.isna(beta) else float(beta))
    return states.assign(**{str(name): column for name, column in zip(said, told.T, strict=True)})


def calibration_of(folder: Path) -> pd.DataFrame:
    """Return the :func:`calibration_table` of a folder that ``calibrate`` wrote."""
    described, predictions, returns = _read(folder)
    return calibration_table(predictions, returns, described["gamma"], described["horizon_steps"])


def _read(folder: Path) -> tuple[dict[str, Any], pd.DataFrame, pd.DataFrame]:
    """Return the description, the predictions and the returns of a calibration."""
    described = json.loads((folder / "calibration.json").read_text(encoding="utf-8"))
    return described, pd.read_csv(folder / "predictions.csv"), pd.read_csv(folder / "returns.csv")


def write_calibration(folder: Path) -> str:
    """Write ``calibration.csv`` and ``.png`` of a folder that ``calibrate`` wrote; return the table as text.

    Where the folder holds a cross-evaluation, or what an agent tells beside what its critics say, it is written and
    said, too; the latter as ``calibration-told.csv`` and ``.png``.
    """
    described, predictions, returns = _read(folder)
    what = f"{described['agent']}, sensor {described['sensor']}, {described['checkpoint']}"
    title = f"{what}: predicted and real returns"
    text = _write_table(folder, "calibration", title, described, predictions, returns)
    if (told := told_predictions(predictions)) is not None:
        title = f"{what}: returns as it tells them, recalibrated, and real ones"
        table = _write_table(folder, "calibration-told", title, described, told, returns)
        text += f"\n\nas the agent tells it, recalibrated:\n{table}"
    # Folders of before it could be asked for do not mention it.
    if described.get("cross_evaluate", False):
        text += f"\n\n{write_cross_evaluation(folder, described)}"
    return text


def _write_table(
    folder: Path, name: str, title: str, described: dict[str, Any], predictions: pd.DataFrame, returns: pd.DataFrame
) -> str:
    """Write a table and its figure, and return the table as text."""
    table = calibration_table(predictions, returns, described["gamma"], described["horizon_steps"])
    table.to_csv(folder / f"{name}.csv", index=False, float_format="%.6g")
    calibration_figure(title, predictions, returns).savefig(folder / f"{name}.png", dpi=130)
    return str(table.set_index("beta").T.to_string(float_format="%.3f"))


def told_predictions(predictions: pd.DataFrame) -> pd.DataFrame | None:
    """Return the predictions with what the agent tells in the place of what its critics say; None: it tells that."""
    told = predictions.filter(regex=r"^told\d+$")
    if told.empty:
        return None
    return predictions.drop(columns=list(told)).assign(**{f"q{name[4:]}": told[name] for name in map(str, told)})


def _earned(returns: pd.DataFrame) -> str:
    """Name what was earned: an agent as it drives draws no actions, so that no entropy counts."""
    return "soft_return" if "soft_return" in returns else "discounted_reward"


def _arrays(states: pd.DataFrame, returns: pd.DataFrame) -> tuple[Array, Array]:
    """Return the quantiles ``[G, Q]`` and the returns ``[G, M]`` of some states, in one order."""
    wanted = states[["beta", "map", "state"]]
    quantiles = states.filter(regex=r"^q\d+$").to_numpy()
    earned = wanted.merge(returns, on=["beta", "map", "state"], how="left", validate="one_to_many")
    return quantiles, earned[_earned(returns)].to_numpy().reshape(len(states), -1)


def _at(quantiles: Array, fraction: float) -> Array:
    """Return the quantile ``[G]`` of a fraction, between the neighbours that were read."""
    fractions = (np.arange(quantiles.shape[1]) + 0.5) / quantiles.shape[1]
    return np.array([np.interp(fraction, fractions, row) for row in quantiles])


def _correlation(a: Array, b: Array) -> float:
    varies = len(a) > 1 and a.std() > 0 and b.std() > 0
    return float(np.corrcoef(a, b)[0, 1]) if varies else float("nan")
