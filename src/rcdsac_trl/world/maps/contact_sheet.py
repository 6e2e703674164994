"""Maps on a contact sheet, each with one start and goal and the paths between them."""

from collections.abc import Callable, Sequence

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Circle, Patch, Polygon
from numpy.typing import NDArray

from rcdsac_trl.seeding import stream
from rcdsac_trl.world.maps.generator import Split
from rcdsac_trl.world.maps.geometry import ROBOT_RADIUS_M
from rcdsac_trl.world.maps.planner import Planner
from rcdsac_trl.world.maps.shapes import Map

_FLOOR = "#f7f5f0"
_WALL = "#3d4450"
_MAPPED = "#8d99ae"
_UNMAPPED = "#e07a3f"
_MOVER = "#7b4fa3"
_START = "#2a9d5c"
_GOAL = "#d62839"
_WAYPOINTS = "#1d6fd1"
_TRUE_PATH = "#2b2b2b"
_PANEL_INCHES = 3.6
_GOALS_DRAWN = 30
_DOTS = (0, (1.0, 1.2))


def contact_sheet(maps: Sequence[Map], split: Split, seed: int, *, drawn: Callable[[], None] = lambda: None) -> Figure:
    """Return a figure with the first maps of a family.

    Args:
        maps: in their order.
        split: their family.
        seed: the root seed of starts and goals.
        drawn: called after each map.
    """
    count = len(maps)
    columns = min(count, 4)
    rows = -(-count // columns)
    size = (columns * _PANEL_INCHES, rows * (_PANEL_INCHES + 0.25) + 0.7)
    figure = Figure(figsize=size, layout="constrained")
    for index, map_ in enumerate(maps):
        axes = figure.add_subplot(rows, columns, index + 1)
        axes.set_title(f"{split} {index} · {map_.layout}", fontsize=9, color=_WALL)
        draw_map(axes, map_, Planner(map_), stream(seed, f"draw/{split}", index))
        drawn()
    figure.legend(handles=_legend(), loc="outside lower center", ncols=min(columns, 4), frameon=False)
    return figure


def draw_map(axes: Axes, map: Map, planner: Planner, rng: np.random.Generator) -> None:
    """Draw one map, with a start and a goal and the paths between them.

    Args:
        axes: where to draw.
        map: the map.
        planner: the map's planner.
        rng: draws start, goal and the movers' places.
    """
    axes.set(xlim=(0, map.size_m), ylim=(0, map.size_m), aspect="equal", xticks=[], yticks=[])
    axes.set_facecolor(_FLOOR)
    axes.spines[:].set_visible(False)
    for box in map.boxes:
        color = _WALL if box.wall else _MAPPED if box.mapped else _UNMAPPED
        axes.add_patch(Polygon(box.corners(), facecolor=color))
    for cylinder in map.cylinders:
        color = _MAPPED if cylinder.mapped else _UNMAPPED
        axes.add_patch(Circle((cylinder.x, cylinder.y), cylinder.radius, facecolor=color))
    for mover in map.movers:
        x, y = planner.sample_mover_point(rng)
        axes.add_patch(Circle((x, y), mover.radius, facecolor=_MOVER, edgecolor="white", linewidth=0.6))
    start, goal = _places(map, planner, rng)
    true_path = np.vstack([start, planner.true_path(start, goal)])
    waypoints = np.vstack([start, planner.waypoints(start, goal)])
    axes.plot(*true_path.T, color=_TRUE_PATH, linewidth=1.1, linestyle=_DOTS)
    axes.plot(*waypoints.T, color=_WAYPOINTS, linewidth=1.3, marker="o", markersize=3)
    axes.add_patch(Circle((start[0], start[1]), ROBOT_RADIUS_M, facecolor=_START, zorder=3))
    axes.plot(*goal, color=_GOAL, marker="*", markersize=10, markeredgecolor="white", markeredgewidth=0.6)


def _places(map: Map, planner: Planner, rng: np.random.Generator) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return a start and a goal: the map's own, else a goal far away, so that the path shows something of the place."""
    start = planner.sample_free(rng) if map.start is None else np.array(map.start[:2])
    if map.goal is not None:
        return start, np.array(map.goal)
    drawn = [planner.sample_free(rng) for _ in range(_GOALS_DRAWN)]
    straight_m = [float(np.hypot(*(goal - start))) for goal in drawn]
    far = [goal for goal, length_m in zip(drawn, straight_m, strict=True) if length_m >= map.size_m / 2]
    return start, (far or [drawn[int(np.argmax(straight_m))]])[0]


def _legend() -> list[Patch | Line2D]:
    def dot(color: str, marker: str, label: str, size: float = 8) -> Line2D:
        return Line2D([], [], color=color, marker=marker, linestyle="", markersize=size, label=label)

    return [
        Patch(color=_WALL, label="wall"),
        Patch(color=_MAPPED, label="clutter, mapped"),
        Patch(color=_UNMAPPED, label="clutter, unmapped"),
        dot(_MOVER, "o", "mover"),
        dot(_START, "o", "start"),
        dot(_GOAL, "*", "goal", 11),
        Line2D([], [], color=_WAYPOINTS, marker="o", markersize=3, label="waypoints (what the planner knows)"),
        Line2D([], [], color=_TRUE_PATH, linestyle=_DOTS, label="true shortest path"),
    ]
