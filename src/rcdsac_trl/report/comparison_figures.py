"""Conditions beside each other: differences on the same maps, and what was hit."""

from collections.abc import Sequence

import numpy as np
import pandas as pd
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Patch

from rcdsac_trl.colors import LIGHT
from rcdsac_trl.report import statistics
from rcdsac_trl.report.collision_report import THINGS
from rcdsac_trl.report.findings import labels
from rcdsac_trl.report.panels import PANEL
from rcdsac_trl.report.read import METRIC_NAMES, Episodes
from rcdsac_trl.report.rows import called, setting_label
from rcdsac_trl.report.style import FAINT, INK, PAPER, style
from rcdsac_trl.report.training_errors import training_errors

# What less of a metric is called, where it is counted.
_LESS = {"collisions": "fewer", "goals": "fewer"}
THING_COLORS = {
    "outer_wall": LIGHT.wall,
    "inner_wall": LIGHT.inner_wall,
    "mapped_clutter": LIGHT.mapped,
    "unmapped_clutter": LIGHT.unmapped,
    "mover": LIGHT.mover,
}
"""Colours of what is hit."""
_OUTSIDE = "////"  # hatching
_ROW_INCHES = 0.5
# Of differences, whose names stand in a margin of two lines beside the panel.
_PAIR_ROW_INCHES, _MARGIN_INCHES = 0.38, 1.3


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
    errors = training_errors(episodes)
    for row, i in enumerate(others):
        first, second = episodes.of(conditions.iloc[i], metric), episodes.of(base, metric)
        maps = np.nanmean(first, axis=(0, 2)) - np.nanmean(second, axis=(0, 2))
        same = errors.same(conditions.iloc[i], base)
        error = errors.between(conditions.iloc[i], base, metric)
        found = statistics.compare(first, second, same_agents=same, error=error).difference
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
    handles = _difference_legend(errors.is_known(base["sensor"], metric))
    figure.legend(handles=handles, loc="outside lower center", ncols=2, frameon=False, fontsize=9, labelcolor=INK)
    return figure


def _beside(condition: pd.Series) -> str:
    """Name a condition beside its row: the agent, and below it the setting, if there is one."""
    name, measure = called(condition["agent"])
    setting = setting_label(condition["beta"], condition["collision_weight"], condition["beta_controller"])
    return f"{name}\n{measure}{setting}" if measure else f"{name}{setting}"


def _difference_legend(over_trainings: bool) -> list[Line2D]:
    """Say what dots and lines of differences are."""
    interval = "mean, 95 % interval over maps"
    handles = [
        Line2D([], [], color=FAINT, marker="o", markersize=3, linestyle="", alpha=0.6, label="a map"),
        Line2D([], [], color=INK, marker="o", markersize=6, linewidth=3.0, label=interval),
    ]
    if over_trainings:
        handles.append(Line2D([], [], color=INK, linewidth=1.0, label="and over trainings"))
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
