"""What the critics expect, as Bokeh figures: the return's quantile curve, and the value of every action."""

import math
from collections.abc import Mapping

import numpy as np
from bokeh.models import BasicTicker, ColorBar, ColumnDataSource, LinearAxis, LinearColorMapper, Plot, Range1d
from bokeh.palettes import Viridis256
from bokeh.plotting import figure

from rcdsac_trl.playground.view_state import ReturnView, RobotView, ValueView

Colors = Mapping[str, str]

_STEP = 5.0
_HEAVY = 4.0
_BAR_PX = 70
_ROOM = 0.05


class ReturnFigure:
    """The quantile curve of the chosen action's return, above it the weight that beta puts on each part.

    Attributes:
        figure: the Bokeh model.
    """

    def __init__(self, name: str) -> None:
        self._range = Range1d(0.0, _STEP)
        self.figure = plot = figure(
            name=name,
            sizing_mode="stretch_both",
            x_range=Range1d(0.0, 1.0),
            y_range=self._range,
            tools="",
            toolbar_location=None,
            x_axis_label="quantile fraction τ",
            y_axis_label="return",
            title="the return it expects, worst to best",
            min_border=2,
            output_backend="canvas",
        )
        self._weight_range = Range1d(0.0, _HEAVY)
        plot.extra_y_ranges = {"weight": self._weight_range}
        weights = BasicTicker(desired_num_ticks=4, num_minor_ticks=0)
        plot.add_layout(LinearAxis(y_range_name="weight", axis_label="weight", ticker=weights), "right")
        self._curve = ColumnDataSource(data={"x": [], "quantile": [], "weight": [], "width": []})
        self._levels = ColumnDataSource(data={"y": [], "color": [], "dash": []})
        self._bars = plot.vbar(
            "x",
            width="width",
            top="weight",
            source=self._curve,
            y_range_name="weight",
            fill_alpha=0.22,
            line_color=None,
        )
        plot.segment(0.0, "y", 1.0, "y", source=self._levels, line_color="color", line_dash="dash", line_width=1.5)
        self._line = plot.line("x", "quantile", source=self._curve, line_width=2.5)
        self._points = plot.scatter("x", "quantile", source=self._curve, size=5)

    def restyle(self, colors: Colors) -> None:
        """Take another theme's colours, but for what is copied."""
        restyle_plot(self.figure, colors)
        self._bars.glyph.fill_color = colors["alarm"]
        self._line.glyph.line_color = colors["accent"]
        self._points.glyph.update(fill_color=colors["accent"], line_color=colors["accent"])

    def copy(self, returns: ReturnView | None, colors: Colors) -> None:
        """Show what is expected; None: nothing is known."""
        if returns is None:
            if len(self._curve.data["x"]):
                self._curve.data = {key: [] for key in self._curve.data}
                self._levels.data = {key: [] for key in self._levels.data}
            return
        self._curve.data = {
            "x": returns.fractions,
            "quantile": returns.quantiles,
            "weight": returns.weights,
            "width": np.full(len(returns.fractions), 0.92 / len(returns.fractions)),
        }
        self._levels.data = {
            "y": [returns.mean, returns.value],
            "color": [colors["faint"], colors["alarm"]],
            "dash": ["dotted", "dashed"],
        }
        self._fit(float(returns.quantiles[0]), float(returns.quantiles[-1]))
        self._weight_range.end = max(_HEAVY, 2.0 ** math.ceil(math.log2(returns.weights.max())))

    def _fit(self, low: float, high: float) -> None:
        """Widen the axis when the curve leaves it; narrow it only when most of it is empty, so that it rests."""
        start, end = self._range.start, self._range.end
        wanted = _STEP * math.floor((low - 1.0) / _STEP), _STEP * math.ceil((high + 1.0) / _STEP)
        if low < start or high > end or end - start > 4.0 * (wanted[1] - wanted[0]):
            self._range.update(start=wanted[0], end=wanted[1])


class ValueFigure:
    """The risk-adjusted value over both action axes, with what was chosen and what the wheels were told.

    Attributes:
        figure: the Bokeh model.
    """

    def __init__(self, name: str) -> None:
        self._mapper = LinearColorMapper(palette=Viridis256)
        self.figure = plot = figure(
            name=name,
            sizing_mode="stretch_both",
            x_range=Range1d(-0.2, 0.6),
            y_range=Range1d(-90.0, 90.0),
            tools="",
            toolbar_location=None,
            x_axis_label="speed, m/s",
            y_axis_label="turn left, °/s",
            title="value of every action at this β",
            min_border=2,
            output_backend="canvas",
        )
        plot.grid.visible = False
        plot.yaxis.ticker = [-90, -45, 0, 45, 90]
        plot.xaxis.ticker.desired_num_ticks = 5
        self._image = ColumnDataSource(data={"image": [], "x": [], "y": [], "dw": [], "dh": []})
        self._chosen = ColumnDataSource(data={"x": [], "y": [], "marker": [], "size": []})
        plot.image("image", x="x", y="y", dw="dw", dh="dh", source=self._image, color_mapper=self._mapper)
        self._marks = plot.scatter(
            "x",
            "y",
            marker="marker",
            size="size",
            source=self._chosen,
            line_width=2,
        )
        self._bar = ColorBar(color_mapper=self._mapper, width=8, padding=4, title="value", background_fill_alpha=0.0)
        plot.add_layout(self._bar, "right")
        plot.min_border_right = _BAR_PX  # its labels change, and it is laid out once
        self._shown: ValueView | None = None

    def restyle(self, colors: Colors) -> None:
        """Take another theme's colours."""
        restyle_plot(self.figure, colors)
        self._marks.glyph.update(fill_color=colors["arrow"], line_color=colors["alarm"])
        self._bar.update(
            major_label_text_color=colors["faint"],
            title_text_color=colors["faint"],
            title_text_font_style="normal",
            title_text_font_size="11px",
            title_standoff=3,
        )

    def copy(self, view: RobotView) -> None:
        """Show what is chosen now, and the values if there are new ones."""
        marks = [(view.told, "circle", 8), (view.wanted, "star", 18)]
        known = [(*place, marker, size) for place, marker, size in marks if place is not None]
        columns = list(zip(*known, strict=True)) if known else [()] * 4
        self._chosen.data = {key: list(c) for key, c in zip(("x", "y", "marker", "size"), columns, strict=True)}
        values = view.values
        if values is self._shown:
            return
        self._shown = values
        if values is None:
            self._image.data = {key: [] for key in self._image.data}
            return
        (x, x_end), (y, y_end) = values.speeds_m_per_s, values.turns_deg_per_s
        for range_, low, high in ((self.figure.x_range, x, x_end), (self.figure.y_range, y, y_end)):
            room = _ROOM * (high - low)  # for a star at the edge, where it is most of the time
            range_.update(start=low - room, end=high + room)
        self._image.data = {
            "image": [values.values.astype(np.float32)],
            "x": [x],
            "y": [y],
            "dw": [x_end - x],
            "dh": [y_end - y],
        }


def restyle_plot(plot: Plot, colors: Colors) -> None:
    """Give a figure with axes a theme's colours."""
    plot.background_fill_color = plot.border_fill_color = colors["card"]
    plot.outline_line_color = colors["edge"]
    plot.title.text_color = colors["ink"]
    plot.title.text_font_size = "12px"
    for axis in plot.axis:
        axis.update(
            axis_label_text_color=colors["faint"],
            axis_label_text_font_style="normal",
            axis_label_text_font_size="11px",
            major_label_text_color=colors["faint"],
            axis_line_color=colors["edge"],
            major_tick_line_color=colors["edge"],
            minor_tick_line_color=None,
        )
    for grid in plot.grid:
        grid.grid_line_color = colors["edge"]
