"""The figures of a report."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import pandas as pd
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Patch
from matplotlib.ticker import MaxNLocator, StrMethodFormatter

from rcdsac_trl.colors import LIGHT
from rcdsac_trl.report import statistics
from rcdsac_trl.report.collision_report import THINGS
from rcdsac_trl.report.findings import TAILS, bounded, labels
from rcdsac_trl.report.read import METRIC_NAMES, Episodes
from rcdsac_trl.report.statistics import Interval, Statistic
from rcdsac_trl.report.style import FAINT, INK, MARKERS, PAPER, series, style
from rcdsac_trl.report.table import called, condition_label, has_dial, setting_label

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
# What less of a metric is called, where it is counted.
_LESS = {"collisions": "fewer", "goals": "fewer"}
_LEARNT = ("reward", "collisions")
THING_COLORS = {
    "outer_wall": LIGHT.wall,
    "inner_wall": LIGHT.inner_wall,
    "mapped_clutter": LIGHT.mapped,
    "unmapped_clutter": LIGHT.unmapped,
    "mover": LIGHT.mover,
}
"""Colours of what is hit."""
_OUTSIDE = "////"  # hatching
PANEL = (4.6, 3.3)
"""Size of a panel in inches: its texts can be read on a telephone, and two of them stand side by side on a desk."""
_ROW_INCHES = 0.5
# Of differences, whose names stand in a margin of two lines beside the panel.
_PAIR_ROW_INCHES, _MARGIN_INCHES = 0.38, 1.3


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
    seeds = any(_several_seeds(episodes, rows) for _, rows in groups)
    figure.suptitle(
        f"What β does, {_MEASURES.get(measure, measure)}: averse at the left; "
        f"95 % intervals over maps{' (dark), and training seeds, too (pale)' if seeds else ''}",
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


def _several_seeds(episodes: Episodes, conditions: pd.DataFrame) -> bool:
    """Return whether any of these conditions was driven by agents of several training seeds."""
    return any(len(episodes.of(condition, "reward")) > 1 for _, condition in conditions.iterrows())


@dataclass(frozen=True)
class Panels:
    """Panels as figures of their own, for pages of any width.

    Attributes:
        figures: a panel each.
        legend: names their lines; None where there is one line.
    """

    figures: list[Figure]
    legend: Figure | None


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
    return Panels(figures, _legend(figures[0].axes[0]))


def _legend(axes: Axes) -> Figure | None:
    """Draw the legend of a panel alone."""
    handles, names = axes.get_legend_handles_labels()
    if len(names) < 2:
        return None
    figure = Figure(figsize=(PANEL[0], 0.1 + 0.2 * len(names)))
    figure.legend(handles, names, loc="center left", frameon=False, fontsize=9, labelcolor=INK)
    return figure


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
    for number, ((name, rows), color) in enumerate(zip(groups, series(len(groups)), strict=True)):
        values = [episodes.of(condition, metric) for _, condition in rows.iterrows()]
        marker = MARKERS[number % len(MARKERS)]
        if any(len(v) > 1 for v in values):
            _shade(axes, rows["beta"], [bounded(v, metric, statistic) for v in values], color, alpha=0.08)
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
        _draw_turned(axes, episodes, rows.iloc[0], metric, statistic, color)
    style(axes, heading, "β")
    axes.set_xticks(sorted({beta for _, rows in groups for beta in rows["beta"]}))
    _include_zero(axes)
    if metric == "reward":
        lines = [
            Line2D([], [], color=FAINT, linestyle="--", linewidth=1.2, label="mean of all"),
            Line2D([], [], color=FAINT, linewidth=1.9, label=f"mean of the worst {100 * _TAIL:.0f} %"),
        ]
        axes.legend(handles=lines, loc="lower left", ncols=2, frameon=False, fontsize=9, labelcolor=INK)


def _include_zero(axes: Axes) -> None:
    """Let an axis begin at 0 where all values are above it: what is small shall not look large."""
    low, high = axes.get_ylim()
    axes.set_ylim(0.0 if axes.dataLim.y0 >= 0.0 else low, high + 0.05 * (high - min(low, 0.0)))


def paired_differences(episodes: Episodes, reference: int, metric: str) -> Figure:
    """Draw each condition's mean difference from one of them on the same maps: a dot a map, mean and 95 % interval.

    Args:
        episodes: of all agents.
        reference: number of the condition that the others are compared with.
        metric: which one.
    """
    conditions = episodes.conditions
    base = conditions.iloc[reference]
    others = [i for i in range(len(conditions)) if i != reference and conditions.iloc[i]["sensor"] == base["sensor"]]
    size = (PANEL[0] + _MARGIN_INCHES, 1.7 + _PAIR_ROW_INCHES * len(others))
    figure = Figure(figsize=size, layout="constrained")
    axes = figure.subplots()
    rng = np.random.default_rng(0)
    for row, i in enumerate(others):
        first, second = episodes.of(conditions.iloc[i], metric), episodes.of(base, metric)
        maps = np.nanmean(first, axis=(0, 2)) - np.nanmean(second, axis=(0, 2))
        same = conditions.iloc[i]["agent"] == base["agent"]
        found = statistics.compare(first, second, same_agents=same).difference
        alone = statistics.compare(*map(statistics.of_these_agents, (first, second))).difference
        axes.scatter(maps, row + rng.uniform(-0.1, 0.1, len(maps)), s=9, color=FAINT, alpha=0.6, linewidths=0)
        axes.plot([found.low, found.high], [row, row], color=INK, linewidth=1.0, solid_capstyle="butt")
        axes.plot([alone.low, alone.high], [row, row], color=INK, linewidth=3.0, solid_capstyle="butt")
        axes.plot(found.value, row, "o", color=INK, markersize=6)
    heading = f"{METRIC_NAMES[metric]}:\ndifference from {labels(episodes)[reference]} on the same maps"
    style(axes, heading, f"{_LESS.get(metric, 'less')} ← difference in {METRIC_NAMES[metric]} → more")
    axes.axvline(0, color=INK, linewidth=0.9, linestyle=(0, (1, 2)))
    axes.set_yticks(range(len(others)), [_beside(conditions.iloc[i]) for i in others])
    _dress_rows(axes, len(others))
    handles = _difference_legend(_several_seeds(episodes, conditions.iloc[[reference, *others]]))
    figure.legend(handles=handles, loc="outside lower center", ncols=2, frameon=False, fontsize=9, labelcolor=INK)
    return figure


def _beside(condition: pd.Series) -> str:
    """Name a condition beside its row: the agent, and below it the setting, if there is one."""
    name, measure = called(condition["agent"])
    setting = setting_label(condition["beta"], condition["collision_weight"], condition["beta_controller"])
    return f"{name}\n{measure}{setting}" if measure else f"{name}{setting}"


def _difference_legend(several_seeds: bool) -> list[Line2D]:
    """Say what dots and lines of differences are."""
    interval = "mean, 95 % interval over maps"
    handles = [
        Line2D([], [], color=FAINT, marker="o", markersize=3, linestyle="", alpha=0.6, label="a map"),
        Line2D([], [], color=INK, marker="o", markersize=6, linewidth=3.0, label=interval),
    ]
    if several_seeds:
        handles.append(Line2D([], [], color=INK, linewidth=1.0, label="and over training seeds"))
    return handles


def _name_rows(axes: Axes, names: Sequence[str]) -> None:
    """Write a name above each row: beside the axes, long names would leave a narrow figure no room."""
    for row, name in enumerate(names):
        axes.text(0.0, row - 0.33, name, transform=axes.get_yaxis_transform(), fontsize=9, color=INK, va="center")
    axes.set_yticks([])
    _dress_rows(axes, len(names))


def _dress_rows(axes: Axes, number: int) -> None:
    """Put the first of so many rows at the top, and take away what only an axis of numbers needs."""
    axes.spines["left"].set_visible(False)
    axes.tick_params(axis="y", length=0)
    axes.grid(visible=False, axis="y")
    axes.set_ylim(number - 0.4, -0.6)


def collision_causes(summary: pd.DataFrame) -> Figure:
    """Draw how many collisions an episode had with what, a bar a condition; hatched: outside the sensor's sectors.

    Args:
        summary: from :func:`rcdsac_trl.report.collision_report.of_episodes`.
    """
    names = summary["condition"].drop_duplicates().tolist()
    figure = Figure(figsize=(PANEL[0], 2.2 + _ROW_INCHES * len(names)), layout="constrained")
    axes = figure.subplots()
    for row, name in enumerate(names):
        parts = summary[summary["condition"] == name].set_index("thing")
        left = 0.0
        for thing in (thing for thing in THINGS if thing in parts.index):
            outside = parts.at[thing, "per_episode"] * parts.at[thing, "outside_share"]
            for width, hatch in ((parts.at[thing, "per_episode"] - outside, ""), (outside, _OUTSIDE)):
                axes.barh(row, width, 0.34, left, color=THING_COLORS[thing], hatch=hatch, edgecolor=PAPER, linewidth=0)
                left += width
        axes.annotate(f"{left:.2f}", (left, row), xytext=(5, 0), textcoords="offset points", va="center", color=INK)
    style(axes, "What was hit", "collisions an episode")
    axes.set_xlim(left=0)
    axes.margins(x=0.14)
    _name_rows(axes, names)
    handles = [Patch(color=THING_COLORS[thing], label=name) for thing, name in THINGS.items()]
    handles.append(Patch(facecolor=FAINT, hatch=_OUTSIDE, edgecolor=PAPER, label="outside the sensor's sectors"))
    figure.legend(handles=handles, loc="outside lower left", ncols=1, frameon=False, fontsize=9, labelcolor=INK)
    return figure


def learning_curves(runs: Mapping[str, pd.DataFrame]) -> Figure:
    """Draw validation reward and collisions over updates and over wall time, a line a run (mean over its betas).

    Args:
        runs: validation episodes by the run's name, with `updates`; one without `elapsed_s` is drawn over updates.
    """
    figure = Figure(figsize=(11.0, 6.4), layout="constrained")
    figure.suptitle("Validation during training", x=0.01, ha="left", fontsize=13, color=INK)
    clocks = _clocks(runs)
    panels = figure.subplots(2, len(clocks), squeeze=False)
    for column, clock in enumerate(clocks):
        for row, metric in enumerate(_LEARNT):
            _draw_learning(panels[row][column], runs, metric, clock)
    panels[0][0].legend(frameon=False, fontsize=9, labelcolor=INK)
    return figure


def learning_panels(runs: Mapping[str, pd.DataFrame]) -> Panels:
    """Draw the panels of :func:`learning_curves`.

    Args:
        runs: as there.
    """
    figures = []
    for metric in _LEARNT:
        for clock in _clocks(runs):
            figure = Figure(figsize=PANEL, layout="constrained")
            _draw_learning(figure.subplots(), runs, metric, clock)
            figures.append(figure)
    return Panels(figures, _legend(figures[0].axes[0]))


_Clock = tuple[str, str, float]


def _clocks(runs: Mapping[str, pd.DataFrame]) -> list[_Clock]:
    """Return what time is told by: column, name, and what its values are multiplied by."""
    clocks: tuple[_Clock, ...] = (("updates", "updates", 1.0), ("elapsed_s", "minutes", 1 / 60))
    return [clock for clock in clocks if any(clock[0] in rows for rows in runs.values())]


def _draw_learning(axes: Axes, runs: Mapping[str, pd.DataFrame], metric: str, clock: _Clock) -> None:
    column, label, scale = clock
    for number, ((name, rows), color) in enumerate(zip(runs.items(), series(len(runs)), strict=True)):
        if column in rows:
            means = rows.groupby(column)[metric].mean()
            marker = MARKERS[number % len(MARKERS)]
            axes.plot(means.index * scale, means, color=color, marker=marker, markersize=4, linewidth=1.9, label=name)
    style(axes, METRIC_NAMES[metric], label)
    axes.set_xlim(left=0)
    axes.xaxis.set_major_locator(MaxNLocator(5))
    axes.xaxis.set_major_formatter(StrMethodFormatter("{x:,.0f}"))
    _include_zero(axes)


def _shade(axes: Axes, x: pd.Series, intervals: Sequence[Interval], color: str, alpha: float) -> None:
    low, high = [interval.low for interval in intervals], [interval.high for interval in intervals]
    axes.fill_between(x, low, high, color=color, alpha=alpha, linewidth=0)


def _draw_turned(
    axes: Axes,
    episodes: Episodes,
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
        found = bounded(episodes.of(condition, metric), metric, statistic)
        axes.plot([beta, beta], [found.low, found.high], color=color, linewidth=1.2)
        axes.plot(beta, found.value, marker="*", markersize=11, color=color, markeredgecolor=PAPER, linestyle="none")
        name = condition["beta_controller"].replace("_", " ")
        at = (beta, found.value)
        axes.annotate(name, at, textcoords="offset points", xytext=(6, 4), fontsize=8, color=INK)
