"""Maps on a contact sheet, each with one start and goal and the paths between them."""

from collections.abc import Callable, Sequence

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Circle, Patch, Polygon
from matplotlib.ticker import MaxNLocator
from numpy.typing import NDArray

from rcdsac_trl.colors import CAPTIONS, LIGHT, mixed
from rcdsac_trl.seeding import stream
from rcdsac_trl.world.maps.generator import Split
from rcdsac_trl.world.maps.geometry import ROBOT_RADIUS_M
from rcdsac_trl.world.maps.planner import Planner
from rcdsac_trl.world.maps.shapes import Map
from rcdsac_trl.world.render import GOAL_OPACITY

_PANEL_INCHES = 3.6
_HEAD_INCHES, _LEGEND_LINE_INCHES = 0.7, 0.38
# Points; a sheet of four columns is shown at half its size.
_FONT_SIZE, _SMALL_FONT_SIZE = 18, 13
_MOST_COLUMNS = 4
_TICKS = 4
_GOAL_RADII_M = (0.42, 0.2)
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
    columns = min(count, _MOST_COLUMNS)
    rows = -(-count // columns)
    meanings = _legend()
    legend_inches = (-(-len(meanings) // columns) + 0.5) * _LEGEND_LINE_INCHES
    size = (columns * _PANEL_INCHES, rows * (_PANEL_INCHES + _HEAD_INCHES) + legend_inches)
    figure = Figure(figsize=size, layout="constrained")
    for index, map_ in enumerate(maps):
        axes = figure.add_subplot(rows, columns, index + 1)
        axes.set_title(f"{split} {index} · {map_.layout}", fontsize=_FONT_SIZE, color=LIGHT.ink)
        draw_map(axes, map_, Planner(map_), stream(seed, f"draw/{split}", index))
        drawn()
    figure.legend(
        handles=meanings,
        loc="outside lower center",
        ncols=columns,
        frameon=False,
        fontsize=_FONT_SIZE,
        labelcolor=LIGHT.ink,
    )
    return figure


def draw_map(axes: Axes, map: Map, planner: Planner, rng: np.random.Generator) -> None:
    """Draw one map, with a start and a goal and the paths between them, and metres along its lower edge.

    Args:
        axes: where to draw.
        map: the map.
        planner: the map's planner.
        rng: draws start, goal and the movers' places.
    """
    axes.set(xlim=(0, map.size_m), ylim=(0, map.size_m), aspect="equal", yticks=[])
    axes.xaxis.set_major_locator(MaxNLocator(_TICKS, steps=[1, 2, 5, 10]))
    axes.xaxis.set_major_formatter("{x:g} m")
    axes.tick_params(length=3, color=LIGHT.faint, labelcolor=LIGHT.faint, labelsize=_SMALL_FONT_SIZE)
    axes.set_facecolor(LIGHT.floor)
    axes.spines[:].set_visible(False)
    for box in map.boxes:
        fill, edge = (LIGHT.wall, LIGHT.wall) if box.wall else _clutter(box.mapped)
        axes.add_patch(Polygon(box.corners(), facecolor=fill, edgecolor=edge))
    for cylinder in map.cylinders:
        fill, edge = _clutter(cylinder.mapped)
        axes.add_patch(Circle((cylinder.x, cylinder.y), cylinder.radius, facecolor=fill, edgecolor=edge))
    for mover in map.movers:
        x, y = planner.sample_mover_point(rng)
        axes.add_patch(Circle((x, y), mover.radius, facecolor=LIGHT.mover, edgecolor=LIGHT.card, linewidth=0.6))
    start, goal = _places(map, planner, rng)
    true_path = np.vstack([start, planner.true_path(start, goal)])
    waypoints = np.vstack([start, planner.waypoints(start, goal)])
    axes.plot(*true_path.T, color=LIGHT.ink, linewidth=1.5, linestyle=_DOTS)
    axes.plot(*waypoints.T, color=LIGHT.way, linewidth=1.6, marker="o", markersize=4)
    axes.add_patch(Circle((start[0], start[1]), ROBOT_RADIUS_M, facecolor=LIGHT.robot, zorder=3))
    for radius, fill in zip(_GOAL_RADII_M, (mixed(LIGHT.floor, LIGHT.goal, GOAL_OPACITY), LIGHT.goal), strict=True):
        axes.add_patch(Circle((goal[0], goal[1]), radius, facecolor=fill, edgecolor=LIGHT.goal, zorder=3))


def _clutter(mapped: bool) -> tuple[str, str]:
    """Return the colours of a piece of clutter and of its outline."""
    return (LIGHT.mapped, LIGHT.mapped_edge) if mapped else (LIGHT.unmapped, LIGHT.unmapped_edge)


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
    def dot(name: str, caption: str, opacity: float = 1.0) -> Line2D:
        color: str = getattr(LIGHT, name)
        fill = mixed(LIGHT.card, color, opacity)
        return Line2D([], [], color=color, markerfacecolor=fill, marker="o", linestyle="", markersize=9, label=caption)

    areas = [Patch(color=getattr(LIGHT, name), label=CAPTIONS[name]) for name in ("wall", "mapped", "unmapped")]
    return [
        *areas,
        dot("mover", CAPTIONS["mover"]),
        dot("robot", "start"),
        dot("goal", "goal", GOAL_OPACITY),
        dot("way", "waypoint"),
        Line2D([], [], color=LIGHT.way, linewidth=1.8, label="way by what is known"),
        Line2D([], [], color=LIGHT.ink, linewidth=1.8, linestyle=_DOTS, label="true shortest way"),
    ]
