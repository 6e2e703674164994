"""The allocator: set up where that is possible, named truly, never in the way."""

import os
import subprocess
import sys

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
