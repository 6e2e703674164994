"""The server without a browser: who may connect, what may be fetched, how many may drive, and what is refused."""

import gc
import os
import re
import signal
import socket
import subprocess
import sys
import urllib.error
import urllib.request
import weakref
from asyncio import sleep
from collections.abc import Iterator
from pathlib import Path

import pytest
from bokeh.document.models import DocumentModelManager
from scenes_to_play import offers
from tornado.httpclient import AsyncHTTPClient, HTTPClientError, HTTPRequest
from tornado.ioloop import IOLoop
from tornado.websocket import websocket_connect

from rcdsac_trl.config.compose import compose
from rcdsac_trl.config.first_look import look_at_play
from rcdsac_trl.config.play_settings import PlaySettings
from rcdsac_trl.config.run_config import read_config
from rcdsac_trl.errors import UserInputError
from rcdsac_trl.playground import play_server
from rcdsac_trl.playground.play_server import PlayServer, what_it_means


@pytest.fixture
def server(tmp_path: Path) -> Iterator[PlayServer]:
    made = PlayServer(
        offers(), host="localhost", port=0, origins=("tunnel.example:80",), max_sessions=1, films=tmp_path / "films"
    )
    made.start()
    yield made
    made.stop()


def status_of(server: PlayServer, origin: str | None) -> int:
    """Ask for a websocket as a page of some origin does; 101 is what lets it in."""
    headers = {} if origin is None else {"Origin": origin}
    token = re.search(r'"token":"([^"]+)"', _get(server, "/"))
    assert token is not None
    headers["Sec-WebSocket-Protocol"] = f"bokeh, {token[1]}"

    async def connect() -> int:
        request = HTTPRequest(f"ws://localhost:{server.port}/ws", headers=headers)
        try:
            connection = await websocket_connect(request, subprotocols=["bokeh", token[1]])
        except HTTPClientError as error:
            return int(error.code)
        connection.close()
        return 101

    return IOLoop.current().run_sync(connect)


def _get(server: PlayServer, path: str, name: str | None = None, **further: str) -> str:
    """Fetch a page, as a browser does that knows the server by some name."""
    headers = further if name is None else {"Host": name, **further}
    asked = urllib.request.Request(f"http://localhost:{server.port}{path}", headers=headers)

    async def fetch() -> str:
        loop = IOLoop.current()
        return await loop.run_in_executor(None, lambda: _read(asked))

    return IOLoop.current().run_sync(fetch)


def _refused(server: PlayServer, path: str, name: str | None = None, **further: str) -> tuple[int, str]:
    """Return the status of an answer, and its sentence."""
    with pytest.raises(urllib.error.HTTPError) as refused:
        _get(server, path, name, **further)
    with refused.value as answer:
        page = answer.read().decode()
    told = re.search(r'<p id="sentence">(.*?)\. ?(<a|</p>)', page)
    assert told is not None
    return refused.value.code, told[1]


def _read(url: str | urllib.request.Request) -> str:
    with urllib.request.urlopen(url, timeout=60) as answer:
        return str(answer.read().decode())


def test_a_page_names_no_other_server(server: PlayServer) -> None:
    page = _get(server, "/")
    assert "static/js/bokeh.min.js" in page
    assert not re.findall(r"(?:src|href)=\"https?://", page)
    assert server.num_drives == 0  # nobody has opened it in a browser


@pytest.mark.parametrize(
    ("origin", "status"),
    [
        ("http://localhost:{port}", 101),
        ("http://127.0.0.1:{port}", 101),
        ("http://tunnel.example", 101),
        ("http://evil.example", 403),
        ("http://evil.example:{port}", 403),
        ("http://localhost:1", 403),
    ],
)
def test_only_known_origins_are_let_in(server: PlayServer, origin: str, status: int) -> None:
    assert status_of(server, origin.format(port=server.port)) == status


@pytest.mark.parametrize(
    ("site", "dest", "comes_in"),
    [
        ("cross-site", "image", False),
        ("cross-site", "empty", False),
        ("cross-site", "document", True),  # a link
        ("cross-site", "iframe", True),  # a notebook's
        ("same-origin", "empty", True),
        ("none", "document", True),
    ],
)
def test_a_page_of_elsewhere_takes_no_place_with_what_it_does_not_show(
    server: PlayServer, site: str, dest: str, comes_in: bool
) -> None:
    asked = {"Sec-Fetch-Site": site, "Sec-Fetch-Dest": dest}
    if comes_in:
        assert "static/js/bokeh.min.js" in _get(server, "/", **asked)
    else:
        assert _refused(server, "/", **asked)[0] == 403
    assert len(server._pages) == comes_in


@pytest.mark.parametrize(
    ("query", "sentence"),
    [
        ("seed=-1", "seed=-1 is no whole number"),
        ("agent=%3Cb%3E", "no agent &lt;b&gt; is offered"),
        ("map=" + "x" * 3000, "no map " + "x" * 100 + ".. is offered"),
        ("sensor=eyes", "sensor=eyes does not exist"),
        ("agent=rcdsac_pow-narrow&beta=1", "beta=1 is outside [-2, 0]"),
        ("beta2=-1", "beta2=-1 is for a second robot"),
        ("map=office&sensor=full&agent=sac-narrow", "the office is driven by four cameras"),
        ("theme=pink", "theme=pink is none of light, dark"),
        ("paused=%ff%00", "paused=\ufffd? is none of on, off"),
        (
            "bokeh-session-id=x",
            "the link has no key bokeh-session-id: it may have agent, beta, map, seed, sensor, second, beta2, "
            "stop, detours, theme",
        ),
    ],
)
def test_a_bad_link_gets_a_sentence_before_a_page_is_made(
    server: PlayServer, monkeypatch: pytest.MonkeyPatch, query: str, sentence: str
) -> None:
    monkeypatch.setattr(play_server, "PlayPage", None)
    status, told = _refused(server, f"/?{query}")
    assert status == 400
    assert told.startswith(sentence)
    assert not server._server.get_sessions()


def test_a_closed_tab_ends_its_page_and_one_that_loads_slowly_keeps_its_own(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(play_server, "_CHECK_UNUSED_MS", 20)
    server = PlayServer(offers(), host="localhost", port=0, max_sessions=2, films=tmp_path)
    server.start()
    for seed in (0, 1):
        _get(server, f"/?agent=dwa&paused=on&seed={seed}")
    shown, loading = server._pages
    shown._begin()  # and no browser is connected any more
    for _ in range(100):
        IOLoop.current().run_sync(lambda: sleep(0.1))
        if shown not in server._pages:
            break
    assert server._pages == [loading]
    server.stop()


def test_one_page_too_many_gets_a_sentence(server: PlayServer) -> None:
    assert "static/js/bokeh.min.js" in _get(server, "/")
    status, told = _refused(server, "/")
    assert status == 503
    assert told.startswith("max_sessions=1, and so many pages drive already")


def test_a_name_is_known_however_it_is_spelt(server: PlayServer) -> None:
    assert "static/js/bokeh.min.js" in _get(server, "/", f"LocalHost:{server.port}")


@pytest.mark.parametrize("path", ["/play", "/autoload.js?bokeh-autoload-element=x", "/metadata", "//", "/films/a/b"])
def test_where_nothing_is_a_sentence_says_so(server: PlayServer, path: str) -> None:
    status, told = _refused(server, path)
    assert status == 404
    assert told == f"there is no {path.partition('?')[0]} here: the page is at /"
    assert not server._server.get_sessions()


def test_no_browser_keeps_a_page_for_another_tab(server: PlayServer) -> None:
    async def fetched(path: str) -> str | None:
        answer = await AsyncHTTPClient().fetch(f"{server.address}{path}")
        return answer.headers.get("Cache-Control")

    assert IOLoop.current().run_sync(lambda: fetched("")) == "no-store"
    assert IOLoop.current().run_sync(lambda: fetched("static/js/bokeh.min.js")) != "no-store"


@pytest.mark.parametrize("path", ["/", "/films/play-1.gif", "/static/js/bokeh.min.js"])
def test_a_name_that_is_not_known_gets_a_sentence_with_the_remedy(server: PlayServer, path: str) -> None:
    sentence = "this server is not known as evil.example:8000: start it with origins=[evil.example:8000]"
    status, told = _refused(server, path, "evil.example:8000")
    assert status == 403
    assert told.startswith(sentence)


def test_a_page_is_made_without_going_through_all_models_again_and_again(
    server: PlayServer, monkeypatch: pytest.MonkeyPatch
) -> None:
    seen = []
    recompute = DocumentModelManager.recompute
    monkeypatch.setattr(DocumentModelManager, "recompute", lambda self: (seen.append(1), recompute(self))[1])
    _get(server, "/")
    assert 1 <= len(seen) <= 3


@pytest.mark.parametrize("name", ["play-1.gif", "..%2Fsecret", "%2Fetc%2Fpasswd", "../secret"])
def test_only_films_that_were_made_can_be_fetched(server: PlayServer, tmp_path: Path, name: str) -> None:
    (tmp_path / "films").mkdir()
    (tmp_path / "secret").write_text("secret")
    (tmp_path / "films" / "play-1.gif").write_text("of another server")
    with pytest.raises(urllib.error.HTTPError, match="404") as refused:
        _get(server, f"/films/{name}")
    refused.value.close()


def test_a_port_that_is_taken_is_refused(tmp_path: Path) -> None:
    with socket.socket() as taken:
        taken.bind(("127.0.0.1", 0))
        taken.listen()
        port = taken.getsockname()[1]
        with pytest.raises(UserInputError, match=rf"^port={port} on host=127.0.0.1 is in use: choose another one"):
            PlayServer(offers(), host="127.0.0.1", port=port, max_sessions=1, films=tmp_path)
        with pytest.raises(UserInputError, match="is in use"):  # told before anything is loaded
            look_at_play(compose("play", [f"port={port}", "host=127.0.0.1"]))


def test_what_listening_elsewhere_means_is_said() -> None:
    for host in ("localhost", "127.0.0.1", "127.0.0.9", "::1"):
        assert what_it_means(host, 5006) is None
    sentence = what_it_means("0.0.0.0", 5006)
    assert sentence is not None
    assert "without a password" in sentence
    assert f"http://{socket.gethostname().lower()}:5006/" in sentence


@pytest.mark.parametrize(
    ("override", "sentence"),
    [
        ("port=70000", "port=70000 is no port"),
        ("host=''", "host names nothing"),
        ("origins=[http://a.example]", "origins holds 'http://a.example': give <name>:<port>"),
        ("max_sessions=0", "max_sessions=0"),
        ("run=[sac-narrow,sac-narrow]", "run=sac-narrow is given more than once"),
        ("maps=[a.yaml,a.yaml]", "maps=a.yaml is given more than once"),
    ],
)
def test_settings_that_cannot_work_are_refused(override: str, sentence: str) -> None:
    with pytest.raises(UserInputError, match=re.escape(sentence)):
        read_config(compose("play", [override]), PlaySettings)


def test_without_the_package_it_says_how_to_get_it(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("importlib.util.find_spec", lambda name: None)
    with pytest.raises(UserInputError, match=r"pip install 'rcdsac-trl\[play\]'"):
        read_config(compose("play", []), PlaySettings)


def test_no_ctrl_c_is_lost_to_what_collects_garbage(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(gc, "freeze", lambda: None)  # what this test leaves is collected like all else

    class Garbage:
        pass

    def collect() -> None:
        garbage = Garbage()
        last_words = weakref.ref(garbage, lambda ref: signal.raise_signal(signal.SIGINT))
        del garbage
        assert last_words() is None

    server = PlayServer(offers(), host="localhost", port=0, max_sessions=1, films=tmp_path)
    loop = IOLoop.current()
    loop.call_later(0.1, collect)
    over = loop.call_later(60.0, loop.stop)  # else it would serve for good
    try:
        with pytest.raises(KeyboardInterrupt):
            server.run(browser=False)
    finally:
        loop.remove_timeout(over)


def test_the_program_says_where_it_is_and_ends_with_ctrl_c(tmp_path: Path) -> None:
    command = [sys.executable, "-m", "rcdsac_trl.play", "browser=false", "port=0"]
    environment = os.environ | {"MALLOC_MMAP_MAX_": "0"}
    with subprocess.Popen(
        command, cwd=tmp_path, env=environment, stdout=subprocess.PIPE, stderr=subprocess.PIPE
    ) as run:
        try:
            assert run.stdout is not None
            said = run.stdout.readline().decode()
            found = re.match(r"http://localhost:(\d+)/ drives ", said)
            assert found, said
            assert "<title>" in _read(f"http://localhost:{found[1]}/")
            run.send_signal(signal.SIGINT)
            _, told = run.communicate(timeout=120)
        finally:
            run.kill()  # harmless where it has ended; else the test would wait for it for good
    assert told.decode().splitlines()[-1] == "rcdsac_trl: interrupted"
    assert not list(tmp_path.iterdir())
