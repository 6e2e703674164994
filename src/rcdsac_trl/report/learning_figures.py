"""What validations during training say: figures over updates and wall time."""

from collections.abc import Mapping

import pandas as pd
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator, StrMethodFormatter

from rcdsac_trl.report.panels import PANEL, Panels, include_zero, legend_of
from rcdsac_trl.report.read import METRIC_NAMES
from rcdsac_trl.report.style import INK, MARKERS, series, style

_LEARNT = ("reward", "collisions")


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
    return Panels(figures, legend_of(figures[0].axes[0]))


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
    include_zero(axes)
