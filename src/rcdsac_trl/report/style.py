"""How all figures look."""

from collections.abc import Sequence

import matplotlib
from matplotlib.axes import Axes

INK = "#3d4450"
FAINT = "#9aa3b2"
GRID = "#e9ebef"
MARKERS = "osD^vP"
"""Shapes tell lines apart where colours do not."""

# Dark is the lowest value; the map's pale end is left out.
_COLORS = matplotlib.colormaps["viridis"]
_PALEST = 0.85


def shades(number: int) -> list[tuple[float, float, float, float]]:
    """Return so many colours for ordered values, from the lowest, which is dark, to the highest."""
    return [_COLORS(_PALEST * i / max(number - 1, 1)) for i in range(number)]


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
