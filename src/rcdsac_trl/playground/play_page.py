"""One visitor's page: figures and widgets of a Bokeh document, and the drive behind them.

The drive has a thread of its own; the page looks for its newest view several times a second and shows it, unless the
browser has not drawn the last ones yet. So a slow browser shows fewer views, and nothing waits for it.
"""

import json
import time
from collections import deque
from collections.abc import Callable, Mapping
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

from bokeh.document import Document
from bokeh.events import DocumentReady, Tap
from bokeh.models import (
    Button,
    ColumnDataSource,
    CustomJS,
    Div,
    InlineStyleSheet,
    RadioButtonGroup,
    Select,
    Slider,
    Spinner,
    Toggle,
    UIElement,
)

from rcdsac_trl.errors import UserInputError
from rcdsac_trl.playground.critic_figures import ReturnFigure, ValueFigure
from rcdsac_trl.playground.drive_clock import SPEEDS, DriveClock, View
from rcdsac_trl.playground.map_figure import MapFigure, MapRanges
from rcdsac_trl.playground.offers import Offers
from rcdsac_trl.playground.palette import PALETTES, THEMES, style_sheet
from rcdsac_trl.playground.play_film import FilmStudio
from rcdsac_trl.playground.scene_choice import AS_TRAINED, LARGEST_SEED, NOBODY, SceneChoice, shortened
from rcdsac_trl.playground.view_state import RobotView
from rcdsac_trl.robot.range_sensor import SENSORS

_HERE = Path(__file__).parent
_PERIOD_MS = 30
# So many views may be under way to the browser; one that takes longer than this to be drawn is not waited for.
_UNDER_WAY = 3
_LONGEST_DRAWING_S = 2.0
# An obstacle is put this far ahead of the first robot.
_AHEAD_M = 1.2
_RATE_S = 4.0
# What a link may say of the page itself.
_OWN_KEYS: Mapping[str, tuple[str, ...]] = {"theme": THEMES, "paused": ("on", "off")}
# The critics' figures follow less often than the map: to draw axes takes a browser as long as everything else.
_CRITICS_PERIOD_S = 0.35


class PlayPage:
    """A page and its drive.

    Args:
        document: that becomes the page.
        query: of the link, by key; beside a scene's keys it may hold ``theme`` (light or dark; else as the browser has
            it) and ``paused`` (on or off).
        offers: what can be chosen.
        studio: makes films.
        admit: called before a drive begins; refuses where there are too many.
        gone: called when the drive has ended.
    """

    def __init__(
        self,
        document: Document,
        query: Mapping[str, str],
        offers: Offers,
        studio: FilmStudio,
        admit: Callable[[], None],
        gone: Callable[[], None],
    ) -> None:
        self._document, self._offers, self._studio = document, offers, studio
        self._admit, self._gone = admit, gone
        self._query = dict(query)
        self._own = {key: self._query.pop(key) for key in _OWN_KEYS if key in self._query}
        self._theme = "light"
        self._clock: DriveClock | None = None
        self._refused: str | None = None
        self._view: View | None = None
        self._scene_number = 0
        self._sent: dict[int, tuple[float, int]] = {}  # when, and how many steps it shows
        self._drawn: deque[tuple[float, int]] = deque()
        self._film_told, self._film_files = "", list[str]()
        self._updating = False
        self._keys_heard = self._steps_drawn = 0
        self._critics_s = 0.0
        self._make_figures()
        self._make_widgets()
        self._compose()

    # ------------------------------------------------------------------------------------------- what it consists of
    def _make_figures(self) -> None:
        self._ranges = MapRanges()
        self._obstacles = ColumnDataSource(data={key: [] for key in ("x", "y", "radius", "fill", "line")})
        self._obstacles.on_change("data", self._dragged)
        self._maps = [MapFigure(self._ranges, self._obstacles, f"map{number}") for number in (0, 1)]
        self._curves = [ReturnFigure(f"curve{number}") for number in (0, 1)]
        self._values = [ValueFigure(f"values{number}") for number in (0, 1)]
        self._plots: list[MapFigure | ReturnFigure | ValueFigure] = [*self._maps, *self._curves, *self._values]
        for map_ in self._maps:
            map_.figure.on_event(Tap, self._tapped)

    def _make_widgets(self) -> None:
        style = InlineStyleSheet(css=(_HERE / "widget.css").read_text("utf-8"))

        def made(kind: type, name: str, **given: Any) -> Any:
            return kind(name=name, stylesheets=[style], margin=0, **given)

        def button(name: str, label: str, click: Callable[[], None]) -> Button:
            widget = made(Button, name, label=label)
            widget.on_click(click)
            return widget

        self._betas = [
            made(
                Slider,
                f"beta{number}",
                start=-1.0,
                end=0.0,
                value=0.0,
                step=0.01,
                title="β",
                sizing_mode="stretch_width",
            )
            for number in (0, 1)
        ]
        for number, slider in enumerate(self._betas):
            slider.on_change("value", self._by_hand(partial(self._tell_beta, number)))
        self._pause = made(Toggle, "pause", label="❚❚ pause", active=False)
        self._pause.on_change("active", self._by_hand(lambda on: self._drive(lambda clock: clock.run(not on))))
        self._speed = made(RadioButtonGroup, "speed", labels=["½×", "1×", "2×", "4×"], active=SPEEDS.index(1.0))
        self._speed.on_change("active", self._by_hand(lambda n: self._drive(lambda clock: clock.set_speed(SPEEDS[n]))))
        self._stop = made(Toggle, "stop", label="stop zone", active=False)
        self._stop.on_change(
            "active", self._by_hand(lambda on: self._drive(lambda c: c.tell(lambda d: d.set_stop_zone(on))))
        )
        self._follow = made(Toggle, "follow", label="zoom in", active=False)
        self._follow.on_change("active", lambda attr, old, new: self._look_around())
        self._theme_toggle = made(Toggle, "theme", label="◐", active=False)
        self._theme_toggle.on_change("active", lambda attr, old, new: self._restyle("dark" if new else "light"))
        link = made(Button, "link", label="copy link")
        link.js_on_click(CustomJS(code="navigator.clipboard && navigator.clipboard.writeText(window.location.href)"))
        self._selects = {
            "agent": made(Select, "agent", title="who drives", options=self._offers.drivers, width=190),
            "second": made(Select, "second", title="beside it", options=[NOBODY, *self._offers.drivers], width=190),
            "map": made(Select, "map", title="map", options=self._offers.places, width=110),
            "sensor": made(Select, "sensor", title="sensor", options=[AS_TRAINED, *sorted(SENSORS)], width=100),
            "seed": made(Spinner, "seed", title="seed", low=0, high=LARGEST_SEED, step=1, value=0, width=90),
        }
        for key, widget in self._selects.items():
            widget.on_change("value", self._by_hand(partial(self._choose_one, key)))
        self._wire = Div(name="wire", text="", visible=False, tags=[])
        self._wire.js_on_change(
            "text",
            CustomJS(
                args={"wire": self._wire, "beta0": self._betas[0], "beta1": self._betas[1]},
                code=(_HERE / "page.js").read_text("utf-8"),
            ),
        )
        self._wire.on_change("tags", self._answered)
        self._widgets: list[UIElement] = [
            *self._betas,
            self._pause,
            self._speed,
            self._stop,
            self._follow,
            self._theme_toggle,
            link,
            *self._selects.values(),
            self._wire,
            button("step", "step", lambda: self._drive(lambda clock: clock.step_once())),
            button("obstacle", "+ obstacle", self._put_ahead),
            button("left", "⇐ push", lambda: self._push(1.0)),
            button("right", "push ⇒", lambda: self._push(-1.0)),
            button("next", "next map", lambda: self._next_map()),
            button("save", "save film", self._save),
        ]

    def _compose(self) -> None:
        document = self._document
        for plot in self._plots:
            document.add_root(plot.figure)
        for widget in self._widgets:
            document.add_root(widget)
        document.title = "rcdsac_trl: play"
        document.template = (_HERE / "page.html").read_text("utf-8")
        document.template_variables.update(palettes=style_sheet(), page_css=(_HERE / "page.css").read_text("utf-8"))
        document.js_on_event(
            DocumentReady,
            CustomJS(
                args={"theme": self._theme_toggle, "asked": self._own.get("theme", "")},
                code=(
                    "const dark = window.matchMedia('(prefers-color-scheme: dark)').matches;"
                    "theme.active = asked ? asked === 'dark' : dark;"
                ),
            ),
        )
        document.on_event(DocumentReady, lambda event: self._begin())
        document.on_session_destroyed(lambda context: self.close())
        self._restyle(self._theme)

    # ------------------------------------------------------------------------------------------- its life
    def _begin(self) -> None:
        """Drive: somebody looks at the page now."""
        if self._clock is not None or self._refused is not None:
            return
        try:
            _check_own(self._own)
            choice = SceneChoice.of_query(self._query, next(iter(self._offers.agents)))
            self._admit()
        except UserInputError as error:
            self._refused = str(error)
            self._show_refusal()
            return
        self._clock = DriveClock(choice, self._offers, self._gone, running=self._own.get("paused") != "on")
        self._document.add_periodic_callback(self._look, _PERIOD_MS)

    def close(self) -> None:
        """End the drive: nobody looks any more."""
        if self._clock is not None:
            self._clock.close()

    def _look(self) -> None:
        """Show the newest view, if there is one that was not shown and the browser has room for it."""
        clock = self._clock
        assert clock is not None
        if clock.refused is not None and self._refused is None:
            self._refused = clock.refused
            self._show_refusal()
        view, now_s = clock.newest, time.monotonic()
        self._sent = {number: sent for number, sent in self._sent.items() if now_s - sent[0] < _LONGEST_DRAWING_S}
        if view is None or view is self._view or len(self._sent) >= _UNDER_WAY or self._refused is not None:
            return
        self._view = view
        self._sent[view.number] = now_s, view.robots[0].steps
        self._show(view)

    def _show_refusal(self) -> None:
        self._wire.text = json.dumps(
            {
                "number": 0,
                "theme": self._theme,
                "refused": self._refused,
                "robots": [],
                "message": "",
                "rate": "",
                "scene": "",
                "query": "",
                "film": {"told": "", "files": []},
            }
        )

    def _show(self, view: View) -> None:
        colors = PALETTES[self._theme]
        if view.scene_number != self._scene_number:
            self._scene_number = view.scene_number
            for map_ in self._maps:
                map_.draw_map(view.map, colors)
            self._look_around()
            self._take_over(view)
        elif self._follow.active:
            self._look_around()
        self._show_obstacles(view.robots[0])
        for robot, map_ in zip(view.robots, self._maps, strict=False):
            map_.copy(robot, colors)
        if (now_s := time.monotonic()) - self._critics_s > _CRITICS_PERIOD_S:
            self._critics_s = now_s
            for robot, curve, values in zip(view.robots, self._curves, self._values, strict=False):
                curve.copy(robot.returns, colors)
                values.copy(robot)
        self._update(self._pause, active=not view.running)
        self._pause.label = "❚❚ pause" if view.running else "▶ drive"
        self._wire.text = json.dumps(self._state(view))

    def _state(self, view: View) -> dict[str, Any]:
        """Return what page.js writes down."""
        self._told_film()
        choice = replace(view.choice, stop=self._stop.active)
        second = "" if choice.second == NOBODY else f" beside {choice.second}"
        return {
            "number": view.number,
            "theme": self._theme,
            "refused": None,
            "message": view.message,
            "query": choice.query,
            "scene": f"{choice.agent}{second}, {choice.map}, seed {choice.seed}",
            "rate": f"{self._rate():.0f} agent steps/s shown, {view.steps_per_s:.0f} driven",
            "film": {"told": self._film_told, "files": self._film_files},
            "robots": [_told(robot) for robot in view.robots],
        }

    def _rate(self) -> float:
        """Return how many agent steps a second the browser has drawn lately."""
        if len(self._drawn) < 2:
            return 0.0
        (first_s, first), (last_s, last) = self._drawn[0], self._drawn[-1]
        return (last - first) / (last_s - first_s)

    def _answered(self, attr: str, old: list[Any], new: list[Any]) -> None:
        """Hear what the browser says: which view it has drawn, which key was pressed."""
        number, key = [*new, None, None][:2]
        sent = self._sent.pop(number, None)
        if sent is not None and sent[1] != self._steps_drawn and self._view is not None:
            # One more step of every robot was seen, however many were left out before it.
            self._steps_drawn = sent[1]
            now_s = time.monotonic()
            drawn = (self._drawn[-1][1] if self._drawn else 0) + len(self._view.robots)
            self._drawn.append((now_s, drawn))
            while now_s - self._drawn[0][0] > _RATE_S:
                self._drawn.popleft()
        if key is not None and key[1] != self._keys_heard:
            self._keys_heard = key[1]
            self._pressed(key[0])

    def _pressed(self, key: str) -> None:
        match key:
            case " ":
                running = self._view is None or self._view.running
                self._drive(lambda clock: clock.run(not running))
            case ".":
                self._drive(lambda clock: clock.step_once())
            case "o":
                self._put_ahead()
            case "a" | "d":
                self._push(1.0 if key == "a" else -1.0)

    # ------------------------------------------------------------------------------------------- what a visitor does
    def _by_hand(self, act: Callable[[Any], None]) -> Callable[[str, Any, Any], None]:
        """Make a listener that hears visitors alone, not what the page itself writes into a widget."""

        def changed(attr: str, old: Any, new: Any) -> None:
            if not self._updating:
                act(new)

        return changed

    def _update(self, widget: Any, **values: Any) -> None:
        self._updating = True
        try:
            widget.update(**values)
        finally:
            self._updating = False

    def _drive(self, order: Callable[[DriveClock], None]) -> None:
        if self._clock is not None:
            order(self._clock)

    def _tell_beta(self, number: int, value: float) -> None:
        self._drive(lambda clock: clock.tell(lambda drive: drive.set_beta(number, value)))

    def _push(self, side: float) -> None:
        self._drive(lambda clock: clock.tell(lambda drive: drive.push(side)))

    def _tapped(self, event: Tap) -> None:
        x, y = event.x, event.y
        if x is None or y is None:
            return
        if event.modifiers is not None and event.modifiers["shift"]:
            self._drive(lambda clock: clock.tell(lambda drive: drive.put_obstacle(x, y)))
        else:
            self._drive(lambda clock: clock.tell(lambda drive: drive.set_goal(x, y)))

    def _put_ahead(self) -> None:
        """Put an obstacle into the first robot's way."""
        if self._view is not None:
            x, y = _ahead(self._view.robots[0])
            self._drive(lambda clock: clock.tell(lambda drive: drive.put_obstacle(x, y)))

    def _dragged(self, attr: str, old: dict[str, Any], new: dict[str, Any]) -> None:
        if self._updating or self._view is None:
            return
        shown = self._view.robots[0].obstacles
        if len(new["x"]) != len(shown):  # the tool deletes what is selected with Backspace
            self._show_obstacles(self._view.robots[0])
            return
        for number, (x, y, _) in enumerate(shown.tolist()):
            there = float(new["x"][number]), float(new["y"][number])
            if there != (x, y):
                self._move_obstacle(number, *there)

    def _move_obstacle(self, number: int, x: float, y: float) -> None:
        self._drive(lambda clock: clock.tell(lambda drive: drive.move_obstacle(number, x, y)))

    def _choose_one(self, key: str, value: Any) -> None:
        self._choose(**{key: value})

    def _choose(self, **changes: Any) -> None:
        """Open another scene; betas go with who they belong to."""
        if self._view is None or None in changes.values():  # a number's field is empty while somebody types
            return
        choice = replace(self._view.choice, stop=self._stop.active, **changes)
        if "agent" in changes:
            choice = replace(choice, beta=None)
        if "second" in changes:
            choice = replace(choice, beta2=None)
        self._drive(lambda clock: clock.open(choice))

    def _next_map(self) -> None:
        if self._view is not None:
            self._choose(seed=(self._view.choice.seed + 1) % LARGEST_SEED)

    def _save(self) -> None:
        self._film_told, self._film_files = self._studio.queue(self._clock)

    # ------------------------------------------------------------------------------------------- how it looks
    def _take_over(self, view: View) -> None:
        """Let the widgets show a scene that was opened."""
        choice = view.choice
        for key, widget in self._selects.items():
            self._update(widget, value=getattr(choice, key))
        self._update(self._stop, active=choice.stop)
        for slider, robot in zip(self._betas, view.robots, strict=False):
            dial = robot.dial
            slider.show_value = dial is not None
            if dial is None:
                slider.title = f"{robot.name} has no β"
                slider.disabled = True
            else:
                self._update(slider, start=dial.low, end=dial.high, value=robot.dialled, disabled=False)
                slider.title = f"{dial.symbol} of {robot.name}"

    def _look_around(self) -> None:
        if self._view is not None:
            around = self._view.robots[0].pose[:2] if self._follow.active else None
            self._ranges.show(self._view.map, around)

    def _restyle(self, theme: str) -> None:
        self._theme = theme
        colors = PALETTES[theme]
        for plot in self._plots:
            plot.restyle(colors)
        self._scene_number = 0  # what stands is drawn anew with the next view
        if self._refused is not None:
            self._show_refusal()

    def _show_obstacles(self, robot: RobotView) -> None:
        colors = PALETTES[self._theme]
        placed = robot.obstacles
        data = {
            "x": placed[:, 0].tolist(),
            "y": placed[:, 1].tolist(),
            "radius": placed[:, 2].tolist(),
            "fill": [colors["obstacle"]] * len(placed),
            "line": [colors["ink"]] * len(placed),
        }
        if data != self._obstacles.data:
            self._update(self._obstacles, data=data)

    def _told_film(self) -> None:
        self._film_told, self._film_files = self._studio.told(self._clock)


def _check_own(keys: Mapping[str, str]) -> None:
    for key, value in keys.items():
        if value not in _OWN_KEYS[key]:
            raise UserInputError(f"{key}={shortened(value)} is none of {', '.join(_OWN_KEYS[key])}: choose one of them")


def _ahead(robot: RobotView) -> tuple[float, float]:
    """Return the place on a robot's way that is so far ahead that it can still evade."""
    (x, y), (x_1, y_1) = robot.way[:2].tolist()
    length = max(((x_1 - x) ** 2 + (y_1 - y) ** 2) ** 0.5, 1e-6)
    share = _AHEAD_M / length
    return x + share * (x_1 - x), y + share * (y_1 - y)


def _told(robot: RobotView) -> dict[str, Any]:
    """Return a robot's numbers as the page writes them."""
    beta = "" if robot.dial is None else f"{robot.dial.symbol} = {robot.dialled:.2f}"
    returns = robot.returns
    value = "" if returns is None else f"mean {returns.mean:.1f} (dotted), at this β {returns.value:.1f} (dashed)"
    nothing = ""
    if robot.values is None and robot.wanted is not None:
        nothing = "A planner: it expects no return."
    elif returns is None and robot.wanted is not None:
        nothing = "Its critics know the mean return alone, no distribution."
    return {
        "name": robot.name,
        "beta": beta,
        "limited": ""
        if robot.limited is None
        else f"held by {robot.limited.removeprefix('limited by ').split(';')[0]}",
        "speed": f"{robot.speed_m_per_s + 0.0:.2f} m/s",
        "clearance": f"{robot.clearance_m:.2f} m",
        "reward": "–" if robot.reward is None else f"{robot.reward:.1f}",
        "time": f"{robot.time_s:.1f} s",
        "goals": str(robot.goals),
        "collisions": str(robot.collisions),
        "value": value,
        "nothing": nothing,
        "blind": returns is None,
        "deaf": robot.values is None,
        "touching": robot.in_contact,
    }
