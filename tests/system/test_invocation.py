"""What a user is told to type is what runs with the Python that told it."""

import sys
from pathlib import Path

import pytest

from rcdsac_trl.system.invocation import from_here, program


@pytest.fixture
def python(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """The Python of a virtual environment below the folder one is in."""
    found = tmp_path / ".venv" / "bin" / "python"
    found.parent.mkdir(parents=True)
    monkeypatch.setattr(sys, "executable", str(found))
    monkeypatch.setenv("PATH", str(tmp_path / "elsewhere"))
    monkeypatch.chdir(tmp_path)
    return found


def script(folder: Path) -> None:
    folder.mkdir(exist_ok=True)
    (folder / "rcdsac-trl").touch(0o755)


def test_without_a_script_python_runs_the_package(python: Path) -> None:
    assert program() == ".venv/bin/python -m rcdsac_trl"


def test_a_script_that_the_shell_does_not_find_is_named_in_full(
    python: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    script(python.parent)
    assert program() == ".venv/bin/rcdsac-trl"
    script(tmp_path / "elsewhere")  # another environment's
    assert program() == ".venv/bin/rcdsac-trl"
    monkeypatch.chdir(tmp_path / "elsewhere")
    assert program() == str(python.with_name("rcdsac-trl"))


def test_a_script_that_the_shell_finds_is_named_alone(python: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    script(python.parent)
    monkeypatch.setenv("PATH", str(python.parent))
    assert program() == "rcdsac-trl"


def test_paths_are_written_from_where_one_is(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    assert [from_here(tmp_path / "runs" / "a"), from_here("runs/a"), from_here(tmp_path.parent)] == [
        "runs/a",
        "runs/a",
        str(tmp_path.parent),
    ]
