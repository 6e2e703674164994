"""The page's widgets: made once, they tell a visitor's acts, and show the scene that stands."""

from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

from bokeh.models import (
    Button,
    CustomJS,
    InlineStyleSheet,
    RadioButtonGroup,
    Select,
    Slider,
    Spinner,
    Toggle,
    UIElement,
)

from rcdsac_trl.playground.drive_clock import SPEEDS, View
from rcdsac_trl.playground.offers import Offers
from rcdsac_trl.playground.scene_choice import AS_TRAINED, NOBODY
from rcdsac_trl.playground.silence import Silence
from rcdsac_trl.playground.visitor import Visitor
from rcdsac_trl.robot.range_sensor import SENSORS

_STYLE = (Path(__file__).parent / "widget.css").read_text("utf-8")
_COPY_LINK = "navigator.clipboard && navigator.clipboard.writeText(window.location.href)"


class Controls:
    """All widgets of a page.

    Args:
        offers: what can be chosen.
        visitor: is told what is done with them, but for what the page does by itself.
        zoomed: whether it begins with what is around each robot.
        save: makes a film.
        restyle: gives the page the theme of a name.
        zoom: shows what is around each robot, or all of the map.

    Attributes:
        betas: the sliders.
        theme: the switch; on for the dark one.
        roots: all widgets, by whose names the page places them.
    """

    def __init__(
        self,
        offers: Offers,
        visitor: Visitor,
        zoomed: bool,
        *,
        save: Callable[[], None],
        restyle: Callable[[str], None],
        zoom: Callable[[], None],
    ) -> None:
        self._silence = Silence()
        self._style = InlineStyleSheet(css=_STYLE)
        self.betas: list[Slider] = [
            self._made(
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
        for number, slider in enumerate(self.betas):
            self._hear(slider, "value", partial(visitor.turn, number))
        self._pause = self._made(Toggle, "pause", label="❚❚ pause", active=False)
        self._hear(self._pause, "active", visitor.pause)
        speed = self._made(RadioButtonGroup, "speed", labels=["½×", "1×", "2×", "4×"], active=SPEEDS.index(1.0))
        self._hear(speed, "active", visitor.choose_speed)
        self._stop = self._made(Toggle, "stop", label="stop zone", active=False)
        self._hear(self._stop, "active", visitor.switch_stop_zone)
        self._detours = self._made(Toggle, "detours", label="detours", active=False)
        self._hear(self._detours, "active", visitor.switch_detours)
        self._zoom = self._made(Toggle, "follow", label="zoom in", active=zoomed)
        self._hear(self._zoom, "active", lambda on: zoom())
        self.theme: Toggle = self._made(Toggle, "theme", label="◐", active=False)
        self._hear(self.theme, "active", lambda dark: restyle("dark" if dark else "light"))
        link = self._made(Button, "link", label="copy link")
        link.js_on_click(CustomJS(code=_COPY_LINK))
        self._fields = self._made_fields(offers)
        for key, field in self._fields.items():
            self._hear(field, "value", partial(visitor.choose, key))
        self.roots: list[UIElement] = [
            *self.betas,
            self._pause,
            speed,
            self._stop,
            self._detours,
            self._zoom,
            self.theme,
            link,
            *self._fields.values(),
            self._button("step", "step", visitor.step),
            self._button("obstacle", "+ obstacle", visitor.put_ahead),
            self._button("left", "⇐ push", partial(visitor.push, 1.0)),
            self._button("right", "push ⇒", partial(visitor.push, -1.0)),
            self._button("next", "next map", visitor.choose_next_map),
            self._button("save", "save film", save),
        ]

    @property
    def zoomed(self) -> bool:
        """Whether what is around each robot is shown, not all of the map."""
        return bool(self._zoom.active)

    def _made_fields(self, offers: Offers) -> dict[str, Select | Spinner]:
        """Make what a scene is chosen with, by the scene's fields."""
        select = partial(self._made, Select)
        return {
            "agent": select("agent", title="who drives", options=offers.drivers, width=215),
            "second": select("second", title="beside it", options=[NOBODY, *offers.drivers], width=215),
            "map": select("map", title="map", options=offers.places, width=110),
            "sensor": select("sensor", title="sensor", options=[AS_TRAINED, *sorted(SENSORS)], width=100),
            "seed": self._made(Spinner, "seed", title="seed", step=1, value=0, width=90),
        }

    def _made(self, kind: type, name: str, **given: Any) -> Any:
        return kind(name=name, stylesheets=[self._style], margin=0, **given)

    def _button(self, name: str, label: str, click: Callable[[], None]) -> Button:
        button: Button = self._made(Button, name, label=label)
        button.on_click(click)
        return button

    def _hear(self, widget: Any, attribute: str, act: Callable[[Any], None]) -> None:
        widget.on_change(attribute, self._silence.unless_silent(lambda attr, old, new: act(new)))

    def take_over(self, view: View) -> None:
        """Show what stands, whatever was chosen before; Bokeh sends on what differs alone."""
        choice = view.choice
        with self._silence:
            self._pause.update(active=not view.running, label="❚❚ pause" if view.running else "▶ drive")
            for key, field in self._fields.items():
                field.update(value=getattr(choice, key))
            self._stop.active = choice.stop
            self._detours.active = choice.detours
            sides = ("left", "right") if len(view.robots) == 2 else ("",)
            for slider, robot, side in zip(self.betas, view.robots, sides, strict=False):
                dial = robot.dial
                slider.update(visible=dial is not None, disabled=dial is None)
                if dial is not None:
                    slider.update(start=dial.low, end=dial.high, value=robot.dialled)
                    slider.title = f"{dial.symbol} {side}" if side else f"{dial.symbol} of {robot.name}"
