"""What the figures of a report share: panels as figures of their own, their size, their legend."""

from dataclasses import dataclass

from matplotlib.axes import Axes
from matplotlib.figure import Figure

from rcdsac_trl.report.style import INK

PANEL = (4.6, 3.3)
"""Size of a panel in inches: its texts can be read on a telephone, and two of them stand side by side on a desk."""


@dataclass(frozen=True)
class Panels:
    """Panels as figures of their own, for pages of any width.

    Attributes:
        figures: a panel each.
        legend: names their lines; None where there is one line.
    """

    figures: list[Figure]
    legend: Figure | None


def legend_of(axes: Axes) -> Figure | None:
    """Draw the legend of a panel alone; None where there is one line."""
    handles, names = axes.get_legend_handles_labels()
    if len(names) < 2:
        return None
    figure = Figure(figsize=(PANEL[0], 0.1 + 0.2 * len(names)))
    figure.legend(handles, names, loc="center left", frameon=False, fontsize=9, labelcolor=INK)
    return figure


def include_zero(axes: Axes) -> None:
    """Let an axis begin at 0 where all values are above it: what is small shall not look large."""
    low, high = axes.get_ylim()
    axes.set_ylim(0.0 if axes.dataLim.y0 >= 0.0 else low, high + 0.05 * (high - min(low, 0.0)))
