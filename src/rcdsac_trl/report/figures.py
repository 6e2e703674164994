"""The figures of a report."""

from collections.abc import Mapping

import numpy as np
import pandas as pd
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.patches import Patch
from matplotlib.ticker import MaxNLocator, StrMethodFormatter

from rcdsac_trl.colors import LIGHT, mixed
from rcdsac_trl.report import statistics
from rcdsac_trl.report.collision_report import THINGS
from rcdsac_trl.report.findings import TAILS, bounded, labels
from rcdsac_trl.report.read import Episodes
from rcdsac_trl.report.statistics import Statistic
from rcdsac_trl.report.style import FAINT, INK, MARKERS, series, style

# What follows beta, in four panels.
_RESPONSES: dict[str, tuple[str, Statistic]] = {
    "collisions an episode": ("collisions", statistics.mean),
    "mean speed, m/s": ("mean_speed_m_per_s", statistics.mean),
    "goals an episode": ("goals", statistics.mean),
    f"reward: all (dashed) and the worst {TAILS[0]:.0%}": ("reward", statistics.cvar(TAILS[0])),
}
_LEARNT = ("reward", "collisions")
_THING_COLORS = {
    "outer_wall": LIGHT.wall,
    "inner_wall": mixed(LIGHT.wall, LIGHT.mapped, 0.45),
    "mapped_clutter": LIGHT.mapped,
    "unmapped_clutter": LIGHT.unmapped,
    "mover": LIGHT.mover,
}
_OUTSIDE = "////"  # hatching


def beta_response(episodes: Episodes, measure: str) -> Figure | None:
    """Draw what beta does: collisions, speed, goals and realised tail return, with 95 % intervals.

    What controllers that turn beta reach stands at the beta they used on the mean.

    Args:
        episodes: of all agents.
        measure: its agents are drawn, such as ``pow``; betas of two measures share no axis.

    Returns:
        None where no agent was driven at two betas of the measure.
    """
    told = episodes.conditions.dropna(subset="beta")
    told = told[told["measure"] == measure]
    groups = [(key, rows) for key, rows in told.groupby(["agent", "sensor"], sort=False) if len(rows) > 1]
    if not groups:
        return None
    figure = Figure(figsize=(11.0, 6.4), layout="constrained")
    figure.suptitle(
        f"What β does ({measure}): averse at the left; 95 % intervals over maps (and seeds, where there are several)",
        x=0.01,
        ha="left",
        fontsize=13,
        color=INK,
    )
    panels = figure.subplots(2, 2).flat
    for axes, (heading, (metric, statistic)) in zip(panels, _RESPONSES.items(), strict=True):
        for number, ((key, rows), color) in enumerate(zip(groups, series(len(groups)), strict=True)):
            ordered = rows.sort_values("beta")
            values = [episodes.of(condition, metric) for _, condition in ordered.iterrows()]
            marker = MARKERS[number % len(MARKERS)]
            name = ", ".join(map(str, key)) if isinstance(key, tuple) else str(key)
            _draw_intervals(axes, ordered["beta"], [bounded(v, metric, statistic) for v in values], color, marker, name)
            _draw_turned(axes, episodes, rows.iloc[0], metric, statistic, color)
            if metric == "reward":
                axes.plot(
                    ordered["beta"], [statistics.mean(v) for v in values], color=color, linestyle="--", linewidth=1.2
                )
        style(axes, heading, "β")
        axes.set_xticks(sorted(told["beta"].unique()))
        if metric != "reward":
            axes.set_ylim(bottom=0)
    if len(groups) > 1:
        handles, names = axes.get_legend_handles_labels()
        figure.legend(handles, names, loc="outside lower center", ncols=3, frameon=False, fontsize=9, labelcolor=INK)
    return figure


def paired_differences(episodes: Episodes, reference: int, metric: str) -> Figure:
    """Draw each condition's mean difference from one of them on the same maps: a dot a map, mean and 95 % interval.

    Args:
        episodes: of all agents.
        reference: number of the condition that the others are compared with.
        metric: which one.
    """
    conditions, names = episodes.conditions, labels(episodes)
    base = conditions.iloc[reference]
    others = [i for i in range(len(conditions)) if i != reference and conditions.iloc[i]["sensor"] == base["sensor"]]
    figure = Figure(figsize=(11.0, 1.6 + 0.42 * len(others)), layout="constrained")
    axes = figure.subplots()
    rng = np.random.default_rng(0)
    for row, i in enumerate(others):
        first, second = episodes.of(conditions.iloc[i], metric), episodes.of(base, metric)
        maps = np.nanmean(first, axis=(0, 2)) - np.nanmean(second, axis=(0, 2))
        found = statistics.compare(first, second).difference
        axes.scatter(maps, row + rng.uniform(-0.16, 0.16, len(maps)), s=9, color=FAINT, alpha=0.6, linewidths=0)
        axes.plot([found.low, found.high], [row, row], color=INK, linewidth=2.2, solid_capstyle="butt")
        axes.plot(found.value, row, "o", color=INK, markersize=6)
    style(axes, f"{metric}: difference from {names[reference]}, map by map (mean and 95 % interval)")
    axes.axvline(0, color=INK, linewidth=0.9, linestyle=(0, (1, 2)))
    axes.set_yticks(range(len(others)), [names[i] for i in others])
    axes.invert_yaxis()
    return figure


def collision_causes(summary: pd.DataFrame) -> Figure:
    """Draw how many collisions an episode had with what, a bar a condition; hatched: outside the sensor's sectors.

    Args:
        summary: from :func:`rcdsac_trl.report.collision_report.of_episodes`.
    """
    names = summary["condition"].drop_duplicates().tolist()
    figure = Figure(figsize=(11.0, 1.9 + 0.42 * len(names)), layout="constrained")
    axes = figure.subplots()
    for row, name in enumerate(names):
        parts = summary[summary["condition"] == name].set_index("thing")
        left = 0.0
        for thing in (thing for thing in THINGS if thing in parts.index):
            outside = parts.at[thing, "per_episode"] * parts.at[thing, "outside_share"]
            for width, hatch in ((parts.at[thing, "per_episode"] - outside, ""), (outside, _OUTSIDE)):
                axes.barh(
                    row, width, 0.7, left, color=_THING_COLORS[thing], hatch=hatch, edgecolor=LIGHT.card, linewidth=0
                )
                left += width
        axes.annotate(f"{left:.2f}", (left, row), xytext=(5, 0), textcoords="offset points", va="center", color=INK)
    style(axes, "What was hit", "collisions an episode")
    axes.set_yticks(range(len(names)), names)
    axes.grid(visible=False, axis="y")
    axes.set_xlim(left=0)
    axes.margins(x=0.08)
    axes.invert_yaxis()
    handles = [Patch(color=_THING_COLORS[thing], label=name) for thing, name in THINGS.items()]
    handles.append(Patch(facecolor=FAINT, hatch=_OUTSIDE, edgecolor=LIGHT.card, label="outside the sensor's sectors"))
    figure.legend(handles=handles, loc="outside lower center", ncols=3, frameon=False, fontsize=9, labelcolor=INK)
    return figure


def learning_curves(runs: Mapping[str, pd.DataFrame]) -> Figure:
    """Draw validation reward and collisions over updates and over wall time, a line a run (mean over its betas).

    Args:
        runs: validation episodes by the run's name, with `updates`; one without `elapsed_s` is drawn over updates.
    """
    figure = Figure(figsize=(11.0, 6.4), layout="constrained")
    figure.suptitle("Validation during training", x=0.01, ha="left", fontsize=13, color=INK)
    clocks = (("updates", "updates", 1.0), ("elapsed_s", "minutes", 1 / 60))
    shown = [clock for clock in clocks if any(clock[0] in rows for rows in runs.values())]
    panels = figure.subplots(2, len(shown), squeeze=False)
    for column, (clock, label, scale) in enumerate(shown):
        for row, metric in enumerate(_LEARNT):
            axes = panels[row][column]
            for number, ((name, rows), color) in enumerate(zip(runs.items(), series(len(runs)), strict=True)):
                if clock not in rows:
                    continue
                means = rows.groupby(clock)[metric].mean()
                marker = MARKERS[number % len(MARKERS)]
                axes.plot(
                    means.index * scale, means, color=color, marker=marker, markersize=4, linewidth=1.9, label=name
                )
            style(axes, f"{metric} an episode", label)
            axes.set_xlim(left=0)
            axes.xaxis.set_major_locator(MaxNLocator(5))
            axes.xaxis.set_major_formatter(StrMethodFormatter("{x:,.0f}"))
            if metric == "collisions":
                axes.set_ylim(bottom=0)
    panels[0][0].legend(frameon=False, fontsize=9, labelcolor=INK)
    return figure


def _draw_intervals(
    axes: Axes,
    x: pd.Series,
    intervals: list[statistics.Interval],
    color: str,
    marker: str,
    label: str,
) -> None:
    middle = [interval.value for interval in intervals]
    axes.fill_between(x, [i.low for i in intervals], [i.high for i in intervals], color=color, alpha=0.15, linewidth=0)
    axes.plot(x, middle, color=color, marker=marker, markersize=6, linewidth=1.9, label=label)


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
        axes.plot(
            beta, found.value, marker="*", markersize=11, color=color, markeredgecolor=LIGHT.card, linestyle="none"
        )
        name = condition["beta_controller"].replace("_", " ")
        at = (beta, found.value)
        axes.annotate(name, at, textcoords="offset points", xytext=(6, 4), fontsize=8, color=INK)
