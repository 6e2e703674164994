"""What beta does: figures over beta."""

import math
from collections.abc import Sequence
from typing import Any

import pandas as pd
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D

from rcdsac_trl.report import statistics
from rcdsac_trl.report.findings import TAILS, bounded
from rcdsac_trl.report.panels import PANEL, Panels, include_zero, legend_of
from rcdsac_trl.report.read import Episodes
from rcdsac_trl.report.rows import condition_label, has_dial
from rcdsac_trl.report.statistics import Interval, Statistic
from rcdsac_trl.report.style import FAINT, INK, MARKERS, PAPER, series, style
from rcdsac_trl.report.training_errors import TrainingErrors, training_errors

_TAIL = TAILS[0]
# What follows beta, in four panels.
_RESPONSES: dict[str, tuple[str, Statistic]] = {
    "collisions an episode": ("collisions", statistics.mean),
    "mean speed, m/s": ("mean_speed_m_per_s", statistics.mean),
    "goals an episode": ("goals", statistics.mean),
    "reward an episode": ("reward", statistics.cvar(_TAIL)),
}
_MEASURES = {
    "cvar": "CVaR",
    "pow": "power law",
    "pow_wide": "wide power law",
    "wang": "Wang",
    "cpw": "CPW",
    "var": "VaR",
}
# One policy over beta is a line; agents for one beta each are points.
_LINE: dict[str, Any] = {"markersize": 6, "linewidth": 1.9}
_POINTS: dict[str, Any] = {"markersize": 7, "linestyle": "none"}
_MEAN_LINE: dict[str, Any] = {"linestyle": "--", "linewidth": 1.2}
_MEAN_POINTS: dict[str, Any] = {"marker": "_", "markersize": 14, "linestyle": "none"}


def beta_response(episodes: Episodes, measure: str) -> Figure | None:
    """Draw what beta does in four panels: collisions, speed, goals and realised tail return, with 95 % intervals.

    What controllers that turn beta reach stands at the beta they used on the mean.

    Args:
        episodes: of all agents.
        measure: its agents are drawn, such as ``pow``; betas of two measures share no axis.

    Returns:
        None where no agent was driven at two betas of the measure.
    """
    if not (groups := _driven_at_several(episodes, measure)):
        return None
    figure = Figure(figsize=(11.0, 6.4), layout="constrained")
    errors = training_errors(episodes)
    known = any(errors.is_known(rows.iloc[0]["sensor"], "reward") for _, rows in groups)
    figure.suptitle(
        f"What β does, {_MEASURES.get(measure, measure)}: averse at the left; "
        f"95 % intervals over maps{' (dark), and trainings, too (pale)' if known else ''}",
        x=0.01,
        ha="left",
        fontsize=13,
        color=INK,
    )
    for axes, heading in zip(figure.subplots(2, 2).flat, _RESPONSES, strict=True):
        _draw_response(axes, episodes, groups, heading)
    if len(groups) > 1:
        handles, names = axes.get_legend_handles_labels()
        figure.legend(handles, names, loc="outside lower center", ncols=3, frameon=False, fontsize=9, labelcolor=INK)
    return figure


def beta_panels(episodes: Episodes, measure: str) -> Panels | None:
    """Draw the panels of :func:`beta_response`; None where it has none.

    Args:
        episodes: of all agents.
        measure: its agents are drawn.
    """
    if not (groups := _driven_at_several(episodes, measure)):
        return None
    figures = []
    for heading in _RESPONSES:
        figure = Figure(figsize=PANEL, layout="constrained")
        _draw_response(figure.subplots(), episodes, groups, heading)
        figures.append(figure)
    return Panels(figures, legend_of(figures[0].axes[0]))


_Groups = list[tuple[str, pd.DataFrame]]


def _driven_at_several(episodes: Episodes, measure: str) -> _Groups:
    """Return agents by name, with their conditions in the order of beta, where there are several of the measure."""
    told = episodes.conditions.dropna(subset="beta")
    groups = told[told["measure"] == measure].groupby(["agent", "sensor"], sort=False)
    sensors = told["sensor"].nunique()
    return [
        (condition_label(str(agent), str(sensor), math.nan, math.nan, None, sensors), rows.sort_values("beta"))
        for (agent, sensor), rows in groups
        if len(rows) > 1
    ]


def _draw_response(axes: Axes, episodes: Episodes, groups: _Groups, heading: str) -> None:
    metric, statistic = _RESPONSES[heading]
    errors = training_errors(episodes)
    for number, ((name, rows), color) in enumerate(zip(groups, series(len(groups)), strict=True)):
        values = [episodes.of(condition, metric) for _, condition in rows.iterrows()]
        marker = MARKERS[number % len(MARKERS)]
        if errors.is_known(rows.iloc[0]["sensor"], metric, statistic):
            of_trainings = [errors.of(condition, metric, statistic) for _, condition in rows.iterrows()]
            wider = [bounded(v, metric, statistic, error) for v, error in zip(values, of_trainings, strict=True)]
            if has_dial(rows.iloc[0]["agent"]):
                _shade(axes, rows["beta"], wider, color, alpha=0.08)
            else:
                axes.vlines(rows["beta"], [i.low for i in wider], [i.high for i in wider], color=color, linewidth=0.7)
        alone = [bounded(statistics.of_these_agents(v), metric, statistic) for v in values]
        middle = [interval.value for interval in alone]
        if has_dial(rows.iloc[0]["agent"]):
            _shade(axes, rows["beta"], alone, color, alpha=0.22)
            dressed, mean_dressed = _LINE, _MEAN_LINE
        else:
            axes.vlines(rows["beta"], [i.low for i in alone], [i.high for i in alone], color=color, linewidth=1.6)
            dressed, mean_dressed = _POINTS, _MEAN_POINTS
        axes.plot(rows["beta"], middle, color=color, marker=marker, label=name, **dressed)
        if metric == "reward":
            axes.plot(rows["beta"], [statistics.mean(v) for v in values], color=color, **mean_dressed)
        _draw_turned(axes, episodes, errors, rows.iloc[0], metric, statistic, color)
    style(axes, heading, "β")
    axes.set_xticks(sorted({beta for _, rows in groups for beta in rows["beta"]}))
    include_zero(axes)
    if metric == "reward":
        lines = [
            Line2D([], [], color=FAINT, linestyle="--", linewidth=1.2, label="mean of all"),
            Line2D([], [], color=FAINT, linewidth=1.9, label=f"mean of the worst {100 * _TAIL:.0f} %"),
        ]
        axes.legend(handles=lines, loc="lower left", ncols=2, frameon=False, fontsize=9, labelcolor=INK)


def _shade(axes: Axes, x: pd.Series, intervals: Sequence[Interval], color: str, alpha: float) -> None:
    low, high = [interval.low for interval in intervals], [interval.high for interval in intervals]
    axes.fill_between(x, low, high, color=color, alpha=alpha, linewidth=0)


def _draw_turned(
    axes: Axes,
    episodes: Episodes,
    errors: TrainingErrors,
    of: pd.Series,
    metric: str,
    statistic: Statistic,
    color: str,
) -> None:
    """Draw the controllers of an agent, each as a point with its interval and name."""
    conditions = episodes.conditions
    same = (conditions["agent"] == of["agent"]) & (conditions["sensor"] == of["sensor"])
    for _, condition in conditions[same & conditions["beta_controller"].notna()].iterrows():
        beta = statistics.mean(episodes.of(condition, "mean_beta"))
        error = errors.of(condition, metric, statistic)
        found = bounded(episodes.of(condition, metric), metric, statistic, error)
        axes.plot([beta, beta], [found.low, found.high], color=color, linewidth=1.2)
        axes.plot(beta, found.value, marker="*", markersize=11, color=color, markeredgecolor=PAPER, linestyle="none")
        name = condition["beta_controller"].replace("_", " ")
        at = (beta, found.value)
        axes.annotate(name, at, textcoords="offset points", xytext=(6, 4), fontsize=8, color=INK)
