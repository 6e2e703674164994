"""Files that two processes write at once, and what those leave that die."""

import os
from pathlib import Path

import pytest

from rcdsac_trl.storage import atomic


def test_two_processes_may_write_a_file_at_once(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = tmp_path / "state.json"
    rename = os.rename

    def late(old: Path, new: Path) -> None:
        """Give a file its name after another process has begun and ended to write it."""
        monkeypatch.setattr(os, "rename", rename)
        child = os.fork()
        if child == 0:
            try:
                atomic.write(path, b"the other's")
            finally:
                os._exit(0)
        os.waitpid(child, 0)
        assert path.read_bytes() == b"the other's"
        rename(old, new)

    monkeypatch.setattr(os, "rename", late)
    atomic.write(path, b"mine")
    assert path.read_bytes() == b"mine"
    assert list(tmp_path.iterdir()) == [path]


def test_leftovers_of_one_file_are_cleared_and_no_others(tmp_path: Path) -> None:
    for name in (".unfinished-1-config.yaml", ".unfinished-2-config.yaml", ".unfinished-3-state.json", "config.yaml"):
        (tmp_path / name).touch()
    (tmp_path / ".hydra").mkdir()
    atomic.clear_leftovers(tmp_path, "config.yaml")
    assert sorted(path.name for path in tmp_path.iterdir()) == [".hydra", ".unfinished-3-state.json", "config.yaml"]
    atomic.clear_leftovers(tmp_path)
    assert [path.name for path in tmp_path.iterdir()] == ["config.yaml"]
