"""How a run learnt, in one figure.

Every panel shows one metric against the number of updates: bold lines are validation, one for each beta (or
collision weight) and the mean over its episodes; the faint line is the mean over an iteration's training episodes,
which are driven with exploration and with betas of all kinds. It may leave the panels of reward and collisions for a
while: a few disastrous iterations at the start would flatten all that follows.
"""

from collections.abc import Mapping
from dataclasses import dataclass

import pandas as pd
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.ticker import MaxNLocator, PercentFormatter, StrMethodFormatter

from rcdsac_trl.colors import beta_shades
from rcdsac_trl.report.style import FAINT, INK, MARKERS, style

PANELS: Mapping[str, str] = {
    "reward": "reward per episode",
    "collisions": "collisions per episode",
    "goals": "goals per episode",
    "mean_speed_m_per_s": "mean speed, m/s",
    "contact_fraction": "steps in contact",
}
"""The metrics of :mod:`rcdsac_trl.rollout.metrics` in the order of the panels, and what stands above each."""

CONDITIONS = ("beta", "collision_weight")
_SYMBOLS = {"beta": "β", "collision_weight": "w_coll"}
_DOTS = (0, (1, 2))
# Metrics that have no bound, and the share of the training iterations at either end that may leave their panels.
_UNBOUNDED = ("reward", "collisions")
_OUTSIDE = 0.05


@dataclass(frozen=True)
class Curve:
    """One line of every panel: the means of each metric, indexed by the number of updates."""

    label: str
    color: str
    marker: str
    means: pd.DataFrame


def validation_curves(episodes: pd.DataFrame) -> list[Curve]:
    """Return one curve for each beta or collision weight, from the lowest to the highest.

    Args:
        episodes: one row an episode, as training writes ``validation_episodes.csv``.
    """
    # Groups come in ascending order.
    groups = list(episodes.groupby(list(CONDITIONS), dropna=False))
    curves = []
    for number, ((values, rows), color) in enumerate(zip(groups, beta_shades(len(groups)), strict=True)):
        # A missing value is not equal to itself: a condition has one of the two, or neither.
        named = [
            f", {_SYMBOLS[key]} = {value:g}" for key, value in zip(CONDITIONS, values, strict=True) if value == value
        ]
        label = "validation" + "".join(named)
        curves.append(Curve(label, color, MARKERS[number % len(MARKERS)], _means(rows)))
    return curves


def learning_curve(
    title: str, training: pd.DataFrame, validation: pd.DataFrame | None, best: int | None = None
) -> Figure:
    """Return the figure of one run.

    Args:
        title: what stands above the panels.
        training: ``training_episodes.csv``.
        validation: ``validation_episodes.csv``; None before the first validation.
        best: number of updates of the best checkpoint, which is marked.
    """
    curves = [] if validation is None else validation_curves(validation)
    faint = Curve("training episodes", FAINT, "", _means(training))
    figure = Figure(figsize=(11.0, 6.2), layout="constrained")
    figure.suptitle(title, x=0.01, ha="left", fontsize=13, color=INK)
    for number, (metric, heading) in enumerate(PANELS.items(), start=1):
        axes = figure.add_subplot(2, 3, number)
        _draw_curve(axes, faint, metric, linewidth=1.2, alpha=0.8)
        for curve in curves:
            _draw_curve(axes, curve, metric, linewidth=1.9)
        if best is not None:
            axes.axvline(best, color=INK, linewidth=0.9, linestyle=_DOTS, zorder=0)
        style(axes, heading, "updates")
        _style_updates(axes)
        _set_limits(axes, metric, faint, curves)
    _draw_legend(figure, [faint, *curves], best)
    return figure


def _means(episodes: pd.DataFrame) -> pd.DataFrame:
    """Return the means of every panel's metric, indexed by the number of updates."""
    return episodes.groupby("updates")[list(PANELS)].mean()


def _draw_curve(axes: Axes, curve: Curve, metric: str, linewidth: float, alpha: float = 1.0) -> None:
    # A long run has too many validations for a marker at each.
    step = max(1, len(curve.means) // 12)
    axes.plot(
        curve.means.index,
        curve.means[metric],
        color=curve.color,
        linewidth=linewidth,
        alpha=alpha,
        marker=curve.marker,
        markersize=5,
        markevery=step,
    )


def _style_updates(axes: Axes) -> None:
    axes.set_xlim(left=0)
    axes.xaxis.set_major_locator(MaxNLocator(4, integer=True))
    axes.xaxis.set_major_formatter(StrMethodFormatter("{x:,.0f}"))


def _set_limits(axes: Axes, metric: str, training: Curve, validation: list[Curve]) -> None:
    if metric == "contact_fraction":
        axes.yaxis.set_major_formatter(PercentFormatter(1.0, decimals=0))
    outside = _OUTSIDE if metric in _UNBOUNDED else 0.0
    usual = training.means[metric].quantile([outside, 1 - outside])
    shown = pd.concat([usual, *(curve.means[metric] for curve in validation)])
    margin = 0.06 * max(shown.max() - shown.min(), 1e-3)
    # Whatever cannot be negative begins at nothing: a panel that shows it cannot exaggerate.
    axes.set_ylim(shown.min() - margin if metric == "reward" else 0.0, shown.max() + margin)


def _draw_legend(figure: Figure, curves: list[Curve], best: int | None) -> None:
    """Fill the free panel with what the lines mean."""
    axes = figure.add_subplot(2, 3, len(PANELS) + 1)
    axes.set_axis_off()
    handles = [
        Line2D([], [], color=curve.color, marker=curve.marker, markersize=6, linewidth=2, label=curve.label)
        for curve in curves
    ]
    if best is not None:
        label = f"best checkpoint ({best:,} updates)"
        handles.append(Line2D([], [], color=INK, linewidth=0.9, linestyle=_DOTS, label=label))
    axes.legend(handles=handles, loc="center left", frameon=False, fontsize=10, labelcolor=INK)
