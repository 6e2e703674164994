"""The map from above, as a Bokeh figure: what stands is drawn once, what moves is copied from each view."""

from collections.abc import Mapping, Sequence

import numpy as np
from bokeh.models import ColumnDataSource, LinearColorMapper, Range1d, ScaleBar
from bokeh.models.tools import PanTool, PointDrawTool, ResetTool, WheelZoomTool
from bokeh.plotting import figure

from rcdsac_trl.playground.palette import trail_shades
from rcdsac_trl.playground.view_state import RobotView
from rcdsac_trl.robot.limits import MAX_LINEAR_VELOCITY
from rcdsac_trl.world.maps.shapes import Box, Map

Colors = Mapping[str, str]

_MARGIN = 0.02
_FOLLOWED_M = 4.5
_GOAL_RADII_M = (0.34, 0.15)
_WAYPOINT_RADIUS_M = 0.11
# What has to be found on a map of any size has so many pixels: a place of contact, and what surrounds the robot.
_CONTACT_PX, _HALO_PX = 13, 30
_REMEMBERED_RADIUS_M = 0.05
_ENDS = ("x0", "y0", "x1", "y1")
# What is drawn, from the ground up, each with one glyph, and its columns.
_COLUMNS = {
    "static": ("xs", "ys", "fill"),
    "round": ("x", "y", "radius", "fill"),
    "fans": ("xs", "ys", "fill", "alpha"),
    "trail": (*_ENDS, "speed"),
    "lines": (*_ENDS, "color", "width", "dash"),
    "discs": ("x", "y", "radius", "fill", "alpha", "line"),
    "marks": ("x", "y", "size", "color", "alpha"),
    "body": ("xs", "ys", "fill", "line"),
}


class MapFigure:
    """One robot's world.

    Args:
        obstacles: x, y and radius of those that were put, shared by all figures: they can be dragged.
        name: of the figure's root.

    Attributes:
        figure: the Bokeh model.
    """

    def __init__(self, obstacles: ColumnDataSource, name: str) -> None:
        self.figure = plot = figure(
            name=name,
            x_range=Range1d(0.0, 1.0),
            y_range=Range1d(0.0, 1.0),
            sizing_mode="stretch_both",
            tools=[PanTool(), WheelZoomTool(), ResetTool()],
            toolbar_location="above",
            toolbar_inner=True,
            min_border=0,
            output_backend="canvas",
        )
        plot.toolbar.autohide = True
        plot.toolbar.logo = None
        plot.toolbar.active_scroll = plot.select_one(WheelZoomTool)
        plot.axis.visible = False
        plot.grid.visible = False
        plot.outline_line_color = None
        self._sources = {name: ColumnDataSource(data={key: [] for key in keys}) for name, keys in _COLUMNS.items()}
        self._speeds = LinearColorMapper(low=0.0, high=MAX_LINEAR_VELOCITY)
        plot.patches("xs", "ys", source=self._sources["static"], fill_color="fill", line_color="fill", line_width=0.5)
        plot.circle("x", "y", radius="radius", source=self._sources["round"], fill_color="fill", line_color=None)
        plot.patches("xs", "ys", source=self._sources["fans"], fill_color="fill", fill_alpha="alpha", line_color=None)
        plot.segment(
            "x0",
            "y0",
            "x1",
            "y1",
            source=self._sources["trail"],
            line_width=3,
            line_cap="round",
            line_color={"field": "speed", "transform": self._speeds},
        )
        plot.segment(
            "x0",
            "y0",
            "x1",
            "y1",
            source=self._sources["lines"],
            line_color="color",
            line_width="width",
            line_dash="dash",
        )
        held = plot.circle(
            "x",
            "y",
            radius="radius",
            source=obstacles,
            fill_color="fill",
            line_color="line",
            line_width=2,
            nonselection_fill_alpha=1.0,
            nonselection_line_alpha=1.0,
        )
        plot.circle(
            "x",
            "y",
            radius="radius",
            source=self._sources["discs"],
            fill_color="fill",
            fill_alpha="alpha",
            line_color="line",
            line_width=1.5,
        )
        plot.scatter(
            "x",
            "y",
            size="size",
            source=self._sources["marks"],
            fill_color="color",
            fill_alpha="alpha",
            line_color=None,
        )
        plot.patches("xs", "ys", source=self._sources["body"], fill_color="fill", line_color="line", line_width=1.5)
        drag = PointDrawTool(renderers=[held], add=False, drag=True)
        plot.add_tools(drag)
        plot.toolbar.active_tap = drag
        self._scale_bar: ScaleBar | None = None
        self._steps = -1

    def _reset(self) -> None:
        self._sources["trail"].data = {key: np.empty(0, np.float32) for key in _COLUMNS["trail"]}
        self._steps = -1

    def restyle(self, colors: Colors) -> None:
        """Take another theme's colours, but for what is copied."""
        self.figure.background_fill_color = self.figure.border_fill_color = colors["outside"]
        self._speeds.palette = trail_shades(colors)
        # A new one: a browser draws it once.
        if self._scale_bar is not None:
            self.figure.center.remove(self._scale_bar)
        self._scale_bar = ScaleBar(
            range=self.figure.x_range,
            unit="m",
            orientation="horizontal",
            location="bottom_left",
            bar_length=0.15,
            bar_line_width=2,
            bar_line_color=colors["ink"],
            label_text_color=colors["ink"],
            label_text_font_size="11px",
            label_standoff=2,
            background_fill_color=colors["floor"],
            background_fill_alpha=0.6,
            border_line_color=None,
            padding=2,
            margin=8,
        )
        self.figure.add_layout(self._scale_bar)

    def look(self, map_: Map, around: tuple[float, float] | None) -> None:
        """Show the whole map, or what is around a place."""
        if around is None:
            margin = _MARGIN * map_.size_m
            ends = [(-margin, map_.size_m + margin)] * 2
        else:
            ends = [(middle - _FOLLOWED_M, middle + _FOLLOWED_M) for middle in around]
        for range_, (low, high) in zip((self.figure.x_range, self.figure.y_range), ends, strict=True):
            range_.update(start=low, end=high, reset_start=low, reset_end=high)

    def draw_map(self, map_: Map, glass: Sequence[Box], colors: Colors) -> None:
        """Draw what stands, and begin the trail anew.

        Args:
            map_: likewise.
            glass: boxes of the map that cameras do not see.
            colors: of the theme.
        """
        boxes = sorted(map_.boxes, key=lambda box: box.wall)
        size_m = map_.size_m
        floor = np.array([(0.0, 0.0), (size_m, 0.0), (size_m, size_m), (0.0, size_m)])
        corners = [floor, *(box.corners() for box in boxes)]
        self._sources["static"].data = {
            "xs": [corner[:, 0] for corner in corners],
            "ys": [corner[:, 1] for corner in corners],
            "fill": [colors["floor"], *(colors["glass"] if box in glass else _box_color(box, colors) for box in boxes)],
        }
        self._sources["round"].data = {
            "x": [piece.x for piece in map_.cylinders],
            "y": [piece.y for piece in map_.cylinders],
            "radius": [piece.radius for piece in map_.cylinders],
            "fill": [_clutter(piece.mapped, colors) for piece in map_.cylinders],
        }
        self._reset()

    def copy(self, view: RobotView, colors: Colors) -> None:
        """Show a robot's newest view."""
        sensor = view.sensor
        fans = [*sensor.silent, *sensor.near]
        self._sources["fans"].data = {
            "xs": [fan[:, 0] for fan in fans],
            "ys": [fan[:, 1] for fan in fans],
            "fill": [colors["silent"]] * len(sensor.silent) + [colors["seen"]] * len(sensor.near),
            "alpha": [0.16] * len(sensor.silent) + [0.30] * len(sensor.near),
        }
        way, detour = (np.concatenate([line[:-1], line[1:]], axis=1) for line in (view.way, view.detour))
        lines = np.concatenate([sensor.hits, way, detour]).astype(np.float32)
        self._sources["lines"].data = {
            **{key: lines[:, column] for column, key in enumerate(_ENDS)},
            "color": [colors["hit"]] * len(sensor.hits) + [colors["way"]] * len(way) + [colors["goal"]] * len(detour),
            "width": [2.5] * len(sensor.hits) + [1.5] * len(way) + [3.0] * len(detour),
            "dash": ["solid"] * len(sensor.hits) + ["dashed"] * len(way) + ["solid"] * len(detour),
        }
        self._sources["discs"].data = _discs(view, colors)
        self._sources["marks"].data = _marks(view, colors)
        self._sources["body"].data = {
            "xs": [view.body[:, 0], view.arrow[:, 0]],
            "ys": [view.body[:, 1], view.arrow[:, 1]],
            "fill": [colors["touching" if view.in_contact else "robot"], colors["arrow"]],
            "line": [colors["robot_edge"], colors["arrow"]],
        }
        self._stream_trail(view)

    def _stream_trail(self, view: RobotView) -> None:
        """Add what was driven since the last view."""
        new = min(view.steps - max(self._steps, 0), len(view.trail) - 1)
        self._steps = view.steps
        if new <= 0:
            return
        points = view.trail[-new - 1 :].astype(np.float32)
        pieces = {
            "x0": points[:-1, 0],
            "y0": points[:-1, 1],
            "x1": points[1:, 0],
            "y1": points[1:, 1],
            "speed": np.abs(points[1:, 2]),
        }
        self._sources["trail"].stream(pieces, rollover=TRAIL_PIECES)


TRAIL_PIECES = 400
"""Pieces of the trail that a browser keeps."""


def _box_color(box: Box, colors: Colors) -> str:
    return colors["wall"] if box.wall else _clutter(box.mapped, colors)


def _clutter(mapped: bool, colors: Colors) -> str:
    return colors["mapped" if mapped else "unmapped"]


def _discs(view: RobotView, colors: Colors) -> dict[str, list]:
    """Return all round things that move or mark a place: x, y, radius, colours."""
    rows: list[tuple[float, float, float, str, float, str]] = []
    for x, y in view.way[1:-1].tolist():
        rows.append((x, y, _WAYPOINT_RADIUS_M, colors["floor"], 1.0, colors["way"]))
    for x, y in view.detour[1:].tolist():
        rows.append((x, y, _WAYPOINT_RADIUS_M, colors["goal"], 1.0, colors["goal"]))
    x, y = view.way[-1].tolist()
    rows += [
        (x, y, radius, colors["goal"], alpha, colors["goal"])
        for radius, alpha in zip(_GOAL_RADII_M, (0.2, 1.0), strict=True)
    ]
    for x, y in view.remembered.tolist():
        rows.append((x, y, _REMEMBERED_RADIUS_M, colors["remembered"], 0.7, colors["remembered"]))
    for x, y, radius in view.movers.tolist():
        rows.append((x, y, radius, colors["mover"], 1.0, colors["mover"]))
    for x, y, radius in view.expected.tolist():
        rows.append((x, y, radius, colors["remembered"], 0.0, colors["remembered"]))
    return {key: list(column) for key, column in zip(_COLUMNS["discs"], zip(*rows, strict=True), strict=True)}


def _marks(view: RobotView, colors: Colors) -> dict[str, list]:
    """Return what marks places where contacts began, and where the robot is: x, y, px, colour."""
    x, y, _ = view.pose
    halo = (x, y, _HALO_PX, colors["touching" if view.in_contact else "robot"], 0.28)
    rows = [(*place, _CONTACT_PX, colors["touching"], 0.6) for place in view.contacts.tolist()] + [halo]
    return {key: list(column) for key, column in zip(_COLUMNS["marks"], zip(*rows, strict=True), strict=True)}
