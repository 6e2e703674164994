"""The server: pages on one port, for who may look at them."""

import gc
import queue
import socket
import threading
import time
import webbrowser
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from ipaddress import ip_address
from pathlib import Path
from weakref import WeakSet

from bokeh.application import Application
from bokeh.application.handlers.function import FunctionHandler
from bokeh.document import Document
from bokeh.server.server import BaseServer
from bokeh.server.tornado import BokehTornado
from bokeh.server.util import bind_sockets
from tornado.httpserver import HTTPServer
from tornado.httputil import HTTPHeaders
from tornado.ioloop import IOLoop, PeriodicCallback
from tornado.web import HTTPError, OutputTransform, RequestHandler

from rcdsac_trl.errors import UserInputError
from rcdsac_trl.playground.drive_clock import DriveClock
from rcdsac_trl.playground.gate import TooManyPages, guarded, query_of
from rcdsac_trl.playground.offers import Offers
from rcdsac_trl.playground.page_link import PageLink, read_link
from rcdsac_trl.playground.play_film import FilmStudio
from rcdsac_trl.playground.play_page import PlayPage
from rcdsac_trl.system.interrupts import at_safe_points, interruption_point
from rcdsac_trl.system.listening import cannot_listen, check_can_listen

_LOOPBACK_NAMES = ("localhost", "127.0.0.1", "[::1]")
_ALL_ADDRESSES = ("0.0.0.0", "::")
# A page that no browser has shown ends after this: a slow one, or a slow way to it, takes its time. Where there is no
# room, it gives its place away sooner.
_UNUSED_MS = 120_000
_WAITED_FOR_S = 15.0
# So often it looks which pages nobody looks at any more.
_CHECK_UNUSED_MS = 1000
_LARGEST_MESSAGE_BYTES = 1_000_000
# So often it looks whether Ctrl-C was pressed.
_LISTEN_MS = 200
_PATH = "/"


class PlayServer:
    """Serves pages until it is stopped.

    Args:
        offers: what can be chosen.
        host: name or address that it listens on.
        port: likewise; 0 takes a free one.
        origins: further ``<name>:<port>`` under which browsers may open pages.
        max_sessions: so many drives at a time.
        films: folder for films.

    Attributes:
        port: that it listens on.

    Raises:
        UserInputError: if it cannot listen there.
    """

    def __init__(
        self, offers: Offers, *, host: str, port: int, origins: Sequence[str] = (), max_sessions: int, films: Path
    ) -> None:
        self._offers, self._host, self._max_sessions = offers, host, max_sessions
        self._studio = FilmStudio(films)
        self._pages: list[PlayPage] = []
        self._clocks: WeakSet[DriveClock] = WeakSet()  # one that drives is kept by its thread
        check_can_listen(host, port)  # Tornado leaves sockets open that it could not bind
        try:
            sockets, self.port = bind_sockets(host, port)
        except OSError as error:
            raise cannot_listen(host, port, error) from None
        known = [f"{name}:{self.port}" for name in names_of(host)] + [origin.lower() for origin in origins]
        pages = BokehTornado(
            {_PATH: Application(FunctionHandler(self._make_page))},
            extra_websocket_origins=known,
            extra_patterns=[(r"/films/([^/]+)", _FilmHandler, {"studio": self._studio})],
            unused_session_lifetime_milliseconds=_UNUSED_MS,
            check_unused_sessions_milliseconds=_CHECK_UNUSED_MS,
            websocket_max_message_size_bytes=_LARGEST_MESSAGE_BYTES,
            transforms=[_NotKept],
        )
        self._http = HTTPServer(guarded(pages, known, self._check))
        self._http.add_sockets(sockets)
        self._server = BaseServer(IOLoop.current(), pages, self._http)
        self._closed_tabs = PeriodicCallback(self._let_go, _CHECK_UNUSED_MS)

    @property
    def address(self) -> str:
        """Where a browser finds it."""
        return f"http://{names_of(self._host)[0]}:{self.port}/"

    @property
    def num_drives(self) -> int:
        """How many robots, or pairs of them, drive now."""
        return sum(clock.alive for clock in self._clocks)

    def start(self) -> None:
        """Answer whoever asks, while the thread's event loop runs."""
        self._server.start()
        self._closed_tabs.start()

    def run(self, *, browser: bool) -> None:
        """Serve until Ctrl-C.

        Args:
            browser: open a page.
        """
        self.start()
        # Bokeh collects garbage as a whole for every page that ends, and all others wait: what is loaded now stays out.
        gc.collect()
        gc.freeze()
        if browser:
            webbrowser.open(self.address)
        # Python would lose a Ctrl-C that comes while garbage is collected, as it is for every page that ends.
        listening = PeriodicCallback(interruption_point, _LISTEN_MS)
        listening.start()
        try:
            with at_safe_points():
                self._server.io_loop.start()
        finally:
            listening.stop()
            self.stop()

    def stop(self) -> None:
        """Answer no more, and end all drives."""
        self._http.stop()
        self._closed_tabs.stop()
        for page in self._pages:
            page.close()
        self._server.stop(wait=False)

    def _make_page(self, document: Document) -> None:
        context = document.session_context
        assert context is not None
        query = query_of(context.request.arguments)
        try:
            link = self._check(query)
        except UserInputError:  # the gate has said so to who came through it
            return
        clock = DriveClock(link.choice, self._offers, running=link.running)
        self._clocks.add(clock)
        page = PlayPage(document, clock, link, self._offers, self._studio)
        self._pages.append(page)
        document.on_session_destroyed(lambda context: self._forget(page))

    def _let_go(self) -> None:
        """End pages that were shown and whose tab was closed."""
        shown = [page.document for page in self._pages if page.begun]
        for session in self._server.get_sessions(_PATH):
            if not session.connection_count and session.document in shown:
                session.request_expiration()

    def _forget(self, page: PlayPage) -> None:
        if page in self._pages:
            self._pages.remove(page)

    def _check(self, query: Mapping[str, str]) -> PageLink:
        """Read a link, and see whether there is room for its page: where there is none, who has left makes room.

        Raises:
            UserInputError: for a bad link, and if there are too many pages.
        """
        link = read_link(query, self._offers)
        if len(self._pages) < self._max_sessions:
            return link
        watched = [session.document for session in self._server.get_sessions(_PATH) if session.connection_count]
        now_s = time.monotonic()
        waited_for = [page.document for page in self._pages if not page.begun and now_s - page.made_s < _WAITED_FOR_S]
        for page in [page for page in self._pages if page.document not in [*watched, *waited_for]]:
            page.close("this page was out of reach for a moment, and another one took its place: open it again")
            self._forget(page)
        if len(self._pages) >= self._max_sessions:
            raise TooManyPages(
                f"max_sessions={self._max_sessions}, and so many pages drive already: close one of them, or start the "
                "server with a larger number"
            )
        return link


@contextmanager
def in_thread(make: Callable[[], PlayServer]) -> Iterator[PlayServer]:
    """Serve from a thread with an event loop of its own, as long as it is needed.

    Args:
        make: makes the server, in that thread.

    Yields:
        The server.
    """
    ready: queue.SimpleQueue[tuple[PlayServer, IOLoop] | BaseException] = queue.SimpleQueue()

    def serve() -> None:
        loop = IOLoop(make_current=False)
        loop.add_callback(begin, loop)
        loop.start()
        loop.close(all_fds=True)  # so that open pages notice

    def begin(loop: IOLoop) -> None:
        try:
            server = make()
            server.start()
        except BaseException as error:  # for who waits
            ready.put(error)
            loop.stop()
        else:
            ready.put((server, loop))

    thread = threading.Thread(target=serve, name="play server", daemon=True)
    thread.start()
    made = ready.get()
    if isinstance(made, BaseException):
        raise made
    server, loop = made
    try:
        yield server
    finally:
        loop.add_callback(server.stop)
        loop.add_callback(loop.stop)
        thread.join()


class _NotKept(OutputTransform):
    """Keeps pages out of browsers' caches, from which they are taken when one goes back, or doubles a tab.

    Each page is of one drive: from there it would be shared, or of a drive that has ended.
    """

    def transform_first_chunk(
        self, status_code: int, headers: HTTPHeaders, chunk: bytes, finishing: bool
    ) -> tuple[int, HTTPHeaders, bytes]:
        """Mark pages."""
        if headers.get("Content-Type", "").startswith("text/html"):
            headers["Cache-Control"] = "no-store"
        return status_code, headers, chunk


class _FilmHandler(RequestHandler):
    """Hands out films by name."""

    def initialize(self, studio: FilmStudio) -> None:
        self._studio = studio

    def get(self, name: str) -> None:
        path = self._studio.path(name)
        if path is None or not path.is_file():
            raise HTTPError(404)
        self.set_header("Content-Type", "video/mp4" if path.suffix == ".mp4" else "image/gif")
        self.write(path.read_bytes())


def names_of(host: str) -> Sequence[str]:
    """Return the names under which browsers come to who listens on a host; those of the loopback are one another's.

    Example:
        >>> names_of("192.168.0.7")
        ('192.168.0.7',)
    """
    if is_loopback(host):
        return _LOOPBACK_NAMES
    if host in _ALL_ADDRESSES:
        return (*_LOOPBACK_NAMES, socket.gethostname().lower())
    return (f"[{host}]" if ":" in host else host.lower(),)


def is_loopback(host: str) -> bool:
    """Return whether only this machine reaches a host."""
    try:
        return ip_address(host).is_loopback
    except ValueError:
        return host == "localhost"


def what_it_means(host: str, port: int) -> str | None:
    """Return what follows of listening on a host; None for the loopback, which only this machine reaches."""
    if is_loopback(host):
        return None
    return (
        f"host={host}: whoever reaches this machine there can open pages, without a password, as "
        f"http://{names_of(host)[-1]}:{port}/ or by another name that is in origins. They can drive what is offered, "
        "which takes processor time, and fetch films that were saved; no file is read by a path of theirs"
    )
