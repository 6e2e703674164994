"""The server without a browser: who may connect, what may be fetched, how many may drive, and what is refused."""

import os
import re
import signal
import socket
import subprocess
import sys
import urllib.error
import urllib.request
from collections.abc import Iterator
from pathlib import Path

import pytest
from scenes_to_play import offers
from tornado.httpclient import HTTPClientError, HTTPRequest
from tornado.ioloop import IOLoop
from tornado.websocket import websocket_connect

from rcdsac_trl.config.compose import compose
from rcdsac_trl.config.play_settings import PlaySettings
from rcdsac_trl.config.run_config import read_config
from rcdsac_trl.errors import UserInputError
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


def _get(server: PlayServer, path: str) -> str:
    async def fetch() -> str:
        loop = IOLoop.current()
        return await loop.run_in_executor(None, lambda: _read(f"http://localhost:{server.port}{path}"))

    return IOLoop.current().run_sync(fetch)


def _read(url: str) -> str:
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
        with pytest.raises(UserInputError, match=rf"nothing can listen on host=127.0.0.1 port={port} \(.*in use"):
            PlayServer(offers(), host="127.0.0.1", port=port, max_sessions=1, films=tmp_path)


def test_what_listening_elsewhere_means_is_said() -> None:
    assert what_it_means("localhost") is None
    assert what_it_means("127.0.0.1") is None
    sentence = what_it_means("0.0.0.0")
    assert sentence is not None
    assert "without a password" in sentence


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
