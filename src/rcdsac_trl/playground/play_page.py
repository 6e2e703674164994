"""One visitor's page: figures and widgets of a Bokeh document, and the drive behind them.

The drive has a thread of its own; the page looks for its newest view several times a second and shows it, unless the
browser has not drawn the last ones yet. So a slow browser shows fewer views, and nothing waits for it.
"""

import json
import time
from collections import deque
from pathlib import Path
from typing import Any

from bokeh.document import Document
from bokeh.events import ConnectionLost, DocumentReady
from bokeh.models import CustomJS, Div

from rcdsac_trl.playground.controls import Controls
from rcdsac_trl.playground.drive_clock import DriveClock, View
from rcdsac_trl.playground.offers import Offers
from rcdsac_trl.playground.page_link import PageLink
from rcdsac_trl.playground.page_words import OPENING, refusal_words, view_words
from rcdsac_trl.playground.palette import style_sheet
from rcdsac_trl.playground.play_film import FilmStudio
from rcdsac_trl.playground.stage import Stage
from rcdsac_trl.playground.visitor import Visitor
from rcdsac_trl.robot.limits import MAX_LINEAR_VELOCITY

_HERE = Path(__file__).parent
_TEMPLATE, _STYLE, _CODE, _LOST = (
    (_HERE / name).read_text("utf-8") for name in ("page.html", "page.css", "page.js", "page_lost.js")
)
_TAKE_THEME = (
    "const dark = window.matchMedia('(prefers-color-scheme: dark)').matches;"
    "theme.active = asked ? asked === 'dark' : dark;"
)
_PERIOD_MS = 30
# So many views may be under way to the browser; one that takes longer than this to be drawn is not waited for.
_UNDER_WAY = 3
_LONGEST_DRAWING_S = 2.0
_REMEMBERED = 50
_RATE_S = 4.0


class PlayPage:
    """A page and its drive, which starts when a browser shows the page.

    Args:
        document: that becomes the page.
        clock: the drive.
        link: that it was opened with.
        offers: what can be chosen.
        studio: makes films.

    Attributes:
        document: likewise.
        begun: whether a browser has shown it.
        made_s: when it was made, on the monotonic clock.
    """

    def __init__(
        self, document: Document, clock: DriveClock, link: PageLink, offers: Offers, studio: FilmStudio
    ) -> None:
        self.document, self.begun, self.made_s = document, False, time.monotonic()
        self._clock, self._studio = clock, studio
        self._theme = "light"
        self._ended: str | None = None
        self._view: View | None = None
        self._said_aside: tuple[bool, tuple[str, list[str]]] = False, ("", [])
        # Views that the browser has not drawn yet: number, when it was sent, and how many steps it shows.
        self._sent: deque[tuple[int, float, int]] = deque(maxlen=_REMEMBERED)
        self._drawn: deque[tuple[float, int]] = deque()
        self._keys_heard = self._steps_drawn = 0
        self._visitor = visitor = Visitor(clock)
        self._stage = Stage(self._theme, visitor.tap, visitor.move_obstacle)
        self._controls = Controls(
            offers, visitor, link.zoomed, save=self._save, restyle=self._restyle, zoom=self._look_around
        )
        self._wire = Div(name="wire", text="", visible=False, tags=[])
        self._compose(link.theme)

    # ------------------------------------------------------------------------------------------- its life
    def _compose(self, theme: str | None) -> None:
        document, wire = self.document, self._wire
        (beta0, beta1), switch = self._controls.betas, self._controls.theme
        wire.js_on_change("text", CustomJS(args={"wire": wire, "beta0": beta0, "beta1": beta1}, code=_CODE))
        wire.on_change("tags", self._answered)
        with document.models.freeze():  # else Bokeh would go through all of them again with each
            for root in (*self._stage.roots, *self._controls.roots, wire):
                document.add_root(root)
        document.title = "rcdsac_trl: play"
        document.template = _TEMPLATE
        document.template_variables.update(
            palettes=style_sheet(), page_css=_STYLE, opening=OPENING, fastest=f"{MAX_LINEAR_VELOCITY:g}"
        )
        document.js_on_event(DocumentReady, CustomJS(args={"theme": switch, "asked": theme or ""}, code=_TAKE_THEME))
        document.on_event(DocumentReady, lambda event: self._begin())
        document.config.update(reconnect_session=False, notify_connection_status=False)
        document.js_on_event(ConnectionLost, CustomJS(code=_LOST))
        document.on_session_destroyed(lambda context: self.close())

    def _begin(self) -> None:
        """Drive: somebody looks at the page now."""
        if not self.begun:
            self.begun = True
            self._clock.start()
            self.document.add_periodic_callback(self._look, _PERIOD_MS)

    def close(self, why: str | None = None) -> None:
        """End the drive: nobody looks any more.

        Args:
            why: a sentence for who looks again nevertheless.
        """
        self._clock.close()
        self._ended = why

    # ------------------------------------------------------------------------------------------- what it shows
    def _look(self) -> None:
        """Show the newest view, if there is one that was not shown and the browser has room for it."""
        clock, view, now_s = self._clock, self._clock.newest, time.monotonic()
        if (refused := clock.refused or self._ended) is not None:
            self._write(refusal_words(self._theme, refused))
            return
        if self._view is not None and self._aside() != self._said_aside:
            self._say(self._view)
        under_way = sum(now_s - sent_s < _LONGEST_DRAWING_S for _, sent_s, _ in self._sent)
        if view is None or view is self._view or under_way >= _UNDER_WAY:
            return
        self._view = view
        self._sent.append((view.number, now_s, view.robots[0].steps))
        settled = view.num_orders == clock.num_orders
        self._stage.show(view, zoomed=self._controls.zoomed, settled=settled)
        if settled:  # a choice that was refused has left the scene as it was
            self._controls.take_over(view)
        self._say(view)

    def _aside(self) -> tuple[bool, tuple[str, list[str]]]:
        """Return what changes without a view: whether another scene is made, and what is told about the film."""
        return self._clock.opening, self._studio.told(self._clock)

    def _say(self, view: View) -> None:
        opening, film = self._said_aside = self._aside()
        self._write(view_words(self._theme, self._controls.zoomed, view, opening, self._rate(), film))

    def _write(self, words: dict[str, Any]) -> None:
        self._wire.text = json.dumps(words)

    def _look_around(self) -> None:
        if self._view is not None:
            self._stage.look(self._view, self._controls.zoomed)
            self._say(self._view)

    def _restyle(self, theme: str) -> None:
        self._theme = theme
        with self.document.models.freeze():
            self._stage.restyle(theme)
        self._view = None  # is shown again, in other colours

    def _save(self) -> None:
        self._studio.queue(self._clock)

    # ------------------------------------------------------------------------------------------- what it hears
    def _answered(self, attr: str, old: list[Any], new: list[Any]) -> None:
        """Hear what the browser says: which view it has drawn, which key was pressed."""
        number, key = [*new, None, None][:2]
        drawn = [self._sent.popleft() for _ in range(sum(sent <= (number or 0) for sent, *_ in self._sent))]
        if drawn:
            self._count_drawn(drawn[-1][2])
        if key is not None and key[1] != self._keys_heard:
            self._keys_heard = key[1]
            self._visitor.press(key[0])

    def _count_drawn(self, steps: int) -> None:
        """Count another step of every robot that was seen, however many were left out before it."""
        if steps == self._steps_drawn or self._view is None:
            return
        self._steps_drawn = steps
        now_s = time.monotonic()
        drawn = (self._drawn[-1][1] if self._drawn else 0) + len(self._view.robots)
        self._drawn.append((now_s, drawn))
        while now_s - self._drawn[0][0] > _RATE_S:
            self._drawn.popleft()

    def _rate(self) -> float:
        """Return how many agent steps a second the browser has drawn lately."""
        if len(self._drawn) < 2:
            return 0.0
        (first_s, first), (last_s, last) = self._drawn[0], self._drawn[-1]
        return (last - first) / (last_s - first_s)
