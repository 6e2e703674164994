"""How all figures look."""

from collections.abc import Sequence

from matplotlib.axes import Axes
from matplotlib.colors import LinearSegmentedColormap

from rcdsac_trl.colors import LIGHT, SERIES

INK, FAINT, GRID, PAPER = LIGHT.ink, LIGHT.faint, LIGHT.grid, LIGHT.card
VERDICTS = {
    "holds": LIGHT.good,
    "does not hold": LIGHT.alarm,
    "cannot be told": LIGHT.unsure,
    "runs missing": LIGHT.faint,
}
"""Colours of the words of verdicts."""
MARKERS = "osD^vP"
"""Shapes tell lines apart where colours do not."""
SIGNED = LinearSegmentedColormap.from_list("signed", (LIGHT.robot, LIGHT.card, LIGHT.unmapped))
"""From below zero over nothing to above it."""


def series(number: int) -> list[str]:
    """Return so many colours for things that have names; from the seventh on they come again, with other markers."""
    return [SERIES[i % len(SERIES)] for i in range(number)]


def style(axes: Axes, title: str = "", x: str = "", y: str = "") -> None:
    """Give axes the common look, a title at the left and labels."""
    axes.spines[["top", "right"]].set_visible(False)
    axes.spines[["left", "bottom"]].set_color(FAINT)
    axes.tick_params(color=FAINT, labelcolor=INK, labelsize=9)
    axes.grid(color=GRID, linewidth=0.8)
    axes.set_axisbelow(True)
    if title:
        axes.set_title(title, loc="left", fontsize=10, color=INK)
    if x:
        axes.set_xlabel(x, fontsize=9, color=INK)
    if y:
        axes.set_ylabel(y, fontsize=9, color=INK)


def limits(values: Sequence[float], margin: float = 0.05) -> tuple[float, float]:
    """Return limits that hold all values and a share of their range beyond."""
    low, high = min(values), max(values)
    beyond = margin * max(high - low, 1e-3)
    return low - beyond, high + beyond
