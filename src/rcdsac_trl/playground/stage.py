"""All figures of a page: a map, a return's curve and all actions' values for each robot."""

import time
from collections.abc import Callable
from typing import Any

from bokeh.events import Tap
from bokeh.models import ColumnDataSource, Plot

from rcdsac_trl.playground.critic_figures import ReturnFigure, ValueFigure
from rcdsac_trl.playground.drive_clock import View
from rcdsac_trl.playground.map_figure import MapFigure
from rcdsac_trl.playground.palette import PALETTES
from rcdsac_trl.playground.silence import Silence
from rcdsac_trl.playground.view_state import RobotView

# The critics' figures follow less often than the map: to draw axes takes a browser as long as everything else.
_CRITICS_PERIOD_S = 0.35
_CRITICS_VIEWS = 3
_OBSTACLE_COLUMNS = ("x", "y", "radius", "fill", "line")


class Stage:
    """The figures; obstacles can be dragged, in all maps at once.

    Args:
        theme: whose colours they have at first.
        tapped: is told where a map was clicked.
        dragged: is told the number of an obstacle, and where it was dragged, m.
    """

    def __init__(self, theme: str, tapped: Callable[[Tap], None], dragged: Callable[[int, float, float], None]) -> None:
        self._silence = Silence()
        self._tell_dragged = dragged
        self._obstacles = ColumnDataSource(data={key: [] for key in _OBSTACLE_COLUMNS})
        self._obstacles.on_change("data", self._silence.unless_silent(self._dragged))
        self._maps = [MapFigure(self._obstacles, f"map{number}") for number in (0, 1)]
        self._curves = [ReturnFigure(f"curve{number}") for number in (0, 1)]
        self._values = [ValueFigure(f"values{number}") for number in (0, 1)]
        self._plots: list[MapFigure | ReturnFigure | ValueFigure] = [*self._maps, *self._curves, *self._values]
        for map_ in self._maps:
            map_.figure.on_event(Tap, tapped)
        self._scene_number = 0
        self._shown: RobotView | None = None
        self._critics_s = 0.0
        self._views_since = _CRITICS_VIEWS
        self.restyle(theme)

    @property
    def roots(self) -> list[Plot]:
        """All figures, by whose names the page places them."""
        return [plot.figure for plot in self._plots]

    def restyle(self, theme: str) -> None:
        """Take another theme's colours; what stands is drawn anew with the next view."""
        self._colors = PALETTES[theme]
        for plot in self._plots:
            plot.restyle(self._colors)
        self._scene_number = 0

    def show(self, view: View, *, zoomed: bool, settled: bool) -> None:
        """Show a view.

        Args:
            view: newer than what was shown before.
            zoomed: whether to show what is around each robot, not all of the map.
            settled: whether all that was done with the page is in it; if not, an obstacle may be on its way.
        """
        if view.scene_number != self._scene_number:
            self._scene_number = view.scene_number
            for map_ in self._maps:
                map_.draw_map(view.map, view.glass, self._colors)
            self.look(view, zoomed)
        elif zoomed:
            self.look(view, zoomed)
        self._shown = view.robots[0]
        if settled:
            self._show_obstacles(self._shown)
        for robot, map_ in zip(view.robots, self._maps, strict=False):
            map_.copy(robot, self._colors)
        self._views_since += 1
        if not view.running or self._critics_due():
            self._critics_s, self._views_since = time.monotonic(), 0
            for robot, curve, values in zip(view.robots, self._curves, self._values, strict=False):
                curve.copy(robot.returns, self._colors)
                values.copy(robot)

    def _critics_due(self) -> bool:
        waited = time.monotonic() - self._critics_s > _CRITICS_PERIOD_S
        return waited and self._views_since >= _CRITICS_VIEWS  # a slow browser shows maps first

    def look(self, view: View, zoomed: bool) -> None:
        """Show all of a view's map, or what is around each robot."""
        for robot, map_ in zip(view.robots, self._maps, strict=False):
            map_.look(view.map, robot.pose[:2] if zoomed else None)

    def _dragged(self, attr: str, old: dict[str, Any], new: dict[str, Any]) -> None:
        if self._shown is None:
            return
        placed = self._shown.obstacles
        if len(new["x"]) != len(placed):  # the tool deletes what is selected with Backspace
            self._show_obstacles(self._shown)
            return
        for number, (x, y, _) in enumerate(placed.tolist()):
            there = float(new["x"][number]), float(new["y"][number])
            if there != (x, y):
                self._tell_dragged(number, *there)

    def _show_obstacles(self, robot: RobotView) -> None:
        placed = robot.obstacles
        data = {
            "x": placed[:, 0].tolist(),
            "y": placed[:, 1].tolist(),
            "radius": placed[:, 2].tolist(),
            "fill": [self._colors["obstacle"]] * len(placed),
            "line": [self._colors["ink"]] * len(placed),
        }
        if data != self._obstacles.data:
            with self._silence:
                self._obstacles.data = data
