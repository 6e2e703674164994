"""The allocator: set up where that is possible, named truly, never in the way. Output: never in the way either."""

import os
import subprocess
import sys
from pathlib import Path

import pytest

from rcdsac_trl.system import runtime

KEPT = runtime._GLIBC_KEEPS_PAGES


@pytest.fixture
def restarts(monkeypatch: pytest.MonkeyPatch) -> list[dict[str, str]]:
    """Collect the environments that a process would have been started again with."""
    for name in (*KEPT, "LD_PRELOAD"):
        monkeypatch.delenv(name, raising=False)
    found: list[dict[str, str]] = []
    monkeypatch.setattr(os, "execve", lambda _path, _arguments, environment: found.append(dict(environment)))
    monkeypatch.setattr(os, "confstr", lambda _name: "glibc 2.36", raising=False)
    return found


def test_a_process_is_started_again_once(restarts: list[dict[str, str]], monkeypatch: pytest.MonkeyPatch) -> None:
    assert runtime.allocator() == "the system's default"
    runtime.keep_pages()
    (environment,) = restarts
    assert KEPT.items() <= environment.items()
    for name, value in environment.items():
        monkeypatch.setenv(name, value)
    runtime.keep_pages()
    assert len(restarts) == 1
    assert runtime.allocator() == "glibc that keeps its pages"


@pytest.mark.parametrize("error", [ValueError, AttributeError, OSError])
def test_other_c_libraries_are_left_alone(
    error: type[Exception], restarts: list[dict[str, str]], monkeypatch: pytest.MonkeyPatch
) -> None:
    def confstr(_: str) -> str:
        raise error

    monkeypatch.setattr(os, "confstr", confstr, raising=False)
    runtime.keep_pages()
    assert not restarts
    for name, value in KEPT.items():  # they say nothing there
        monkeypatch.setenv(name, value)
    assert runtime.allocator() == "the system's default"


def test_what_the_user_has_set_stays(restarts: list[dict[str, str]], monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("MALLOC_TOP_PAD_", "1")
    runtime.keep_pages()
    assert runtime.allocator() == "glibc with MALLOC_TOP_PAD_=1"
    monkeypatch.setenv("LD_PRELOAD", "libother.so")
    runtime.keep_pages()
    assert runtime.allocator() == "preloaded (libother.so)"
    assert not restarts


def test_a_process_that_cannot_be_started_again_goes_on(
    restarts: list[dict[str, str]], monkeypatch: pytest.MonkeyPatch
) -> None:
    def execve(*_: object) -> None:
        raise PermissionError

    monkeypatch.setattr(os, "execve", execve)
    runtime.keep_pages()
    monkeypatch.setattr(sys, "executable", "")
    runtime.keep_pages()
    assert runtime.allocator() == "the system's default"


@pytest.mark.skipif(not runtime._has_glibc(), reason="only glibc has the settings")
def test_it_works_from_a_processs_first_moment() -> None:
    code = "from rcdsac_trl.system import runtime as r; r.keep_pages(); print(r.allocator())"
    plain = {name: value for name, value in os.environ.items() if name not in (*KEPT, "LD_PRELOAD")}
    done = subprocess.run([sys.executable, "-c", code], env=plain, capture_output=True, text=True, check=True)
    assert done.stdout == "glibc that keeps its pages\n"


TALKS = """
import os, sys
from pathlib import Path
from rcdsac_trl.system.runtime import speak_anywhere
speak_anywhere()
for _ in range(1000):
    print("β" * 200)
    print("γ" * 200, file=sys.stderr)
sys.stderr.flush()
os.write(1, b"C code talks as well")
import rcdsac_trl.world.sim.bullet
Path(sys.argv[1]).write_text(str([os.get_inheritable(fd) for fd in (0, 1, 2)]))
"""


@pytest.mark.parametrize("stream", ["stdout", "stderr"])
def test_work_goes_on_where_the_reader_of_its_output_has_left(stream: str, tmp_path: Path) -> None:
    done = tmp_path / "done"
    reads, writes = os.pipe()
    os.close(reads)
    other = "stderr" if stream == "stdout" else "stdout"
    command = [sys.executable, "-c", TALKS, str(done)]
    ended = subprocess.run(command, **{stream: writes, other: subprocess.PIPE}, timeout=300, check=False)
    os.close(writes)
    assert ended.returncode == 0
    assert done.read_text() == "[True, True, True]"
    assert b"BrokenPipe" not in (ended.stderr or b"")


@pytest.mark.parametrize("closed", [">&-", "2>&-", "<&-", "<&- >&- 2>&-"])
def test_work_goes_on_where_there_is_nowhere_to_talk_to(closed: str, tmp_path: Path) -> None:
    done = tmp_path / "done"
    command = ["sh", "-c", f'exec "$0" -c "$1" "$2" {closed}', sys.executable, TALKS, str(done)]
    ended = subprocess.run(command, capture_output=True, timeout=300, check=False)
    assert (ended.returncode, done.read_text()) == (0, "[True, True, True]")
