r"""Does beta do what it says? What each beta's measure says of the policy of each beta, from the same states.

Two readings of "the risk" stand side by side. *In a state* measures the roll-outs of one state and averages over
states: they differ by the actions' noise alone, since the world is deterministic. *Over all states* measures all
roll-outs at once: they differ also by what the agent sees. What a policy is to maximise, the risk given what the agent
sees, lies between the two if beta is averse: what is round a corner is unknown to it, but the same in every roll-out.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.patches import Rectangle

from rcdsac_trl.colors import LIGHT
from rcdsac_trl.report.statistics import Array, bootstrap_maps
from rcdsac_trl.report.style import INK, SIGNED

READINGS = {"state": "in a state", "all": "over all states"}
"""What roll-outs a measure is taken of, and how it is called."""


@dataclass(frozen=True)
class CrossValues:
    """Every beta's measure of what every beta earns.

    Attributes:
        value: ``[K, K]``, a row a judging beta, a column a driving beta, in ascending order.
        value_bounds: ``[2, K, K]``, bounds of its 95 % interval.
        advantage: ``[K, K]``, of a column over its row's own beta on the same maps: zero on the diagonal, and below
            zero elsewhere if beta does what it says.
        advantage_bounds: ``[2, K, K]``.
    """

    value: Array
    value_bounds: Array
    advantage: Array
    advantage_bounds: Array


def risk_value(returns: Array, g: Array) -> Array:
    """Return the distortion risk measures of samples, exactly.

    Args:
        returns: ``[.., n]``.
        g: ``[J, n + 1]``, for each of J measures the weight of all quantiles up to 0, 1/n, .., 1.

    Returns:
        ``[.., J]``.

    Example:
        >>> risk_value(np.array([3.0, 1.0]), np.array([[0.0, 0.5, 1.0], [0.0, 1.0, 1.0]]))  # mean and minimum
        array([2., 1.])
    """
    return np.sort(returns, -1) @ np.diff(g).T


def cross_values(returns: pd.DataFrame, distortion: pd.DataFrame) -> dict[str, CrossValues]:
    """Let every beta judge every beta; intervals are over maps.

    Args:
        returns: ``cross_returns.csv``.
        distortion: ``cross_distortion.csv``.

    Returns:
        Values by the keys of :data:`READINGS`.
    """
    ordered = returns.sort_values(["map", "beta", "state", "rollout"])
    shape = [returns[key].nunique() for key in ("map", "beta", "state", "rollout")]
    earned = ordered["discounted_reward"].to_numpy().reshape(shape)
    g = distortion.sort_values(["beta", "u"])["g"].to_numpy().reshape(shape[1], -1)
    # Of the fractions of all roll-outs every so many is one of a state's.
    of_states = risk_value(earned, g[:, :: shape[0] * shape[2]]).mean(2).swapaxes(1, 2)

    def over_all(maps: Array) -> Array:
        return risk_value(maps.swapaxes(0, 1).reshape(shape[1], -1), g).T

    return {
        "state": _against_diagonal(*bootstrap_maps(of_states, lambda maps: _paired(maps.mean(0)))),
        "all": _against_diagonal(*bootstrap_maps(earned, lambda maps: _paired(over_all(maps)))),
    }


def _paired(values: Array) -> Array:
    """Put beside ``[K, K]`` what each is above its row's diagonal: ``[2, K, K]``."""
    return np.stack([values, values - np.diag(values)[:, None]])


def _against_diagonal(value: Array, low: Array, high: Array) -> CrossValues:
    bounds = np.stack([low, high])
    return CrossValues(value[0], bounds[:, 0], value[1], bounds[:, 1])


def cross_table(values: Mapping[str, CrossValues], betas: Array) -> pd.DataFrame:
    """Lay the values out, one row a reading, a judging and a driving beta.

    Returns:
        `reading`, a key of :data:`READINGS`; `judging_beta`, `driving_beta`; `value`, `value_low`, `value_high`;
        `advantage`, `advantage_low`, `advantage_high`, over the row in which the judging beta drives.
    """
    return pd.DataFrame(
        {
            "reading": reading,
            "judging_beta": judging,
            "driving_beta": driving,
            "value": of.value[row, column],
            "value_low": of.value_bounds[0, row, column],
            "value_high": of.value_bounds[1, row, column],
            "advantage": of.advantage[row, column],
            "advantage_low": of.advantage_bounds[0, row, column],
            "advantage_high": of.advantage_bounds[1, row, column],
        }
        for reading, of in values.items()
        for row, judging in enumerate(betas)
        for column, driving in enumerate(betas)
    )


def answer(values: CrossValues) -> str:
    """Say in how many rows the diagonal is best."""
    number = len(values.value)
    low, high = values.advantage_bounds
    highest = int((values.value.argmax(1) == np.arange(number)).sum())
    others = number * (number - 1)
    return (
        f"the diagonal is {_best_rows(values)}; it has the highest value in {highest} (by chance: 1), is clearly above "
        f"{(high < 0.0).sum()} of {others} other cells and clearly below {(low > 0.0).sum()}."
    )


def _best_rows(values: CrossValues) -> str:
    rows = (values.advantage_bounds[0] <= 0.0).all(1)
    return f"best, within its interval, in {rows.sum()} of {len(rows)} rows"


def cross_figure(title: str, values: Mapping[str, CrossValues], betas: Array) -> Figure:
    """Draw a matrix a reading: on the diagonal its value, elsewhere how far above it; blue where beta is as it says."""
    figure = Figure(figsize=(4.0 + 2.3 * len(betas), 1.7 + 0.8 * len(betas)), layout="constrained")
    figure.suptitle(title, x=0.01, ha="left", fontsize=12, color=INK)
    largest = max(max(float(np.abs(of.advantage).max()) for of in values.values()), 1e-9)
    panels = figure.subplots(1, len(values))
    for axes, (reading, of) in zip(panels, values.items(), strict=True):
        image = axes.imshow(of.advantage, cmap=SIGNED, vmin=-largest, vmax=largest, aspect="auto")
        heading = f"{READINGS[reading].capitalize()}: the diagonal is\n{_best_rows(of)}"
        axes.set_title(heading, loc="left", fontsize=10, color=INK)
        axes.set_xticks(range(len(betas)), [f"{beta:g}" for beta in betas])
        axes.set_yticks(range(len(betas)), [f"{beta:g}" for beta in betas])
        axes.set_xlabel("β' that drives", fontsize=9, color=INK)
        axes.set_ylabel("β whose measure judges", fontsize=9, color=INK)
        axes.tick_params(length=0, labelcolor=INK, labelsize=9)
        axes.spines[:].set_visible(False)
        _write_cells(axes, of, 0.6 * largest)
    bar = figure.colorbar(image, ax=panels)
    bar.set_label("above the diagonal of the row\n(framed: its highest value)", fontsize=9, color=INK)
    bar.ax.tick_params(labelcolor=INK, labelsize=8)
    bar.outline.set_visible(False)
    return figure


def _write_cells(axes: Axes, values: CrossValues, dark: float) -> None:
    """Write every cell's number and interval, and frame the highest value of each row."""
    for (row, column), advantage in np.ndenumerate(values.advantage):
        on_diagonal = row == column
        number = f"{values.value[row, column]:.1f}" if on_diagonal else f"{advantage:+.1f}"
        low, high = (values.value_bounds if on_diagonal else values.advantage_bounds)[:, row, column]
        color = LIGHT.card if abs(advantage) > dark else INK
        axes.text(column, row - 0.1, number, ha="center", va="center", fontsize=11, color=color)
        axes.text(column, row + 0.22, f"[{low:.1f}, {high:.1f}]", ha="center", va="center", fontsize=7.5, color=color)
    for row, column in enumerate(values.value.argmax(1)):
        axes.add_patch(Rectangle((column - 0.47, row - 0.47), 0.94, 0.94, fill=False, edgecolor=INK, linewidth=1.6))


def write_cross_evaluation(folder: Path, described: Mapping[str, Any]) -> str:
    """Write ``cross_evaluation.csv`` and ``.png`` of a folder that ``calibrate`` wrote; return both as text.

    Args:
        folder: holds ``cross_returns.csv`` and ``cross_distortion.csv``.
        described: its ``calibration.json``.
    """
    returns, distortion = (pd.read_csv(folder / f"cross_{name}.csv") for name in ("returns", "distortion"))
    betas = np.sort(returns["beta"].unique())
    values = cross_values(returns, distortion)
    table = cross_table(values, betas)
    table.to_csv(folder / "cross_evaluation.csv", index=False, float_format="%.6g")
    title = (
        f"{described['agent']}, sensor {described['sensor']}, {described['checkpoint']}: the {described['measure']} of "
        "discounted reward, from the same states"
    )
    cross_figure(title, values, betas).savefig(folder / "cross_evaluation.png", dpi=130)
    texts = []
    for reading, of in values.items():
        matrix = pd.DataFrame(
            [[f"{value:.2f}" for value in row] for row in of.value],
            index=[f"judged by {beta:g}" for beta in betas],
            columns=[f"driven by {beta:g}" for beta in betas],
        )
        name = READINGS[reading].capitalize()
        texts.append(f"{name}, {described['measure']} of discounted reward:\n{matrix}\n{name}, {answer(of)}")
    return "\n\n".join(texts)
