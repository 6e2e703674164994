"""A run has its folder to itself: two never meet in one, and one that is refused leaves no trace."""

import errno
import fcntl
import json
import os
import sys
import time
from functools import partial
from pathlib import Path

import pandas as pd
import pytest
import yaml

from forked import Forked
from rcdsac_trl import train
from rcdsac_trl.config.compose import output_folder
from rcdsac_trl.errors import UserInputError
from rcdsac_trl.storage.atomic import FolderLock
from rcdsac_trl.storage.checkpoint_record import newest
from rcdsac_trl.training import run_folder
from tiny import AGENTS, ITERATIONS, TINY, tiny_trainer

START = ["+algo=rcdsac_pow", *TINY]


def files_of(folder: Path) -> dict[str, bytes]:
    return {path.relative_to(folder).as_posix(): path.read_bytes() for path in folder.rglob("*") if path.is_file()}


def test_of_two_starts_in_one_folder_one_trains_and_the_other_leaves_no_trace(tmp_path: Path) -> None:
    run, flags = tmp_path / "run", [tmp_path / "first", tmp_path / "second"]

    def start(seed: int) -> None:
        """Train, but wait where nothing speaks against the folder yet until the other one has come as far."""
        check_folder = run_folder.check_folder

        def checked_by_both(folder: Path) -> None:
            check_folder(folder)
            flags[seed].touch()
            while not flags[1 - seed].exists():
                time.sleep(0.01)

        run_folder.check_folder = checked_by_both
        os.environ["MALLOC_MMAP_MAX_"] = "0"  # else the program would start itself again
        sys.argv = ["train", *START, f"seed={seed}", f"hydra.run.dir={run}"]
        train.main()

    started = [Forked(partial(start, seed), tmp_path / f"said by {seed}") for seed in (0, 1)]
    codes = [each.code() for each in started]
    errors = [each.said for each in started]
    assert sorted(codes) == [0, 2], errors
    winner, loser = codes.index(0), codes.index(2)
    assert errors[loser] in (
        f"rcdsac_trl: {run} is being trained in by another process: wait for it, or stop it\n",
        f"rcdsac_trl: {run} already holds a run: choose another hydra.run.dir\n",
    )
    assert {path.name for path in run.iterdir()} == {
        "checkpoints",
        "config.yaml",
        "lock",
        "manifest.json",
        "replay",
        "train.log",
        "training_episodes.csv",
        "validation_episodes.csv",
    }
    assert yaml.safe_load((run / "config.yaml").read_text())["seed"] == winner
    manifest = json.loads((run / "manifest.json").read_text())
    assert manifest["seed"] == winner
    assert manifest["overrides"] == [*START, f"seed={winner}"]
    assert (run / "train.log").read_text().count("iterations; write to") == 1
    assert len(pd.read_csv(run / "training_episodes.csv")) == AGENTS * ITERATIONS
    assert newest(run / "checkpoints", replay=run / "replay")[1] == []


@pytest.mark.parametrize("left", ["config.yaml", "checkpoints", "training_episodes.csv"])
def test_a_folder_that_holds_a_part_of_a_run_holds_a_run(tiny_run: Path, tmp_path: Path, left: str) -> None:
    (tmp_path / left).symlink_to(tiny_run / left)
    before = files_of(tmp_path)
    with pytest.raises(UserInputError, match="already holds a run: choose another"):
        tiny_trainer(tmp_path)
    assert files_of(tmp_path) == before


def test_a_lock_that_cannot_be_opened_is_one_sentence(tmp_path: Path) -> None:
    (tmp_path / "lock").mkdir()
    with pytest.raises(UserInputError, match=rf"^{tmp_path}/lock cannot be opened \(Is a directory\): remove it$"):
        tiny_trainer(tmp_path)
    assert [path.name for path in tmp_path.iterdir()] == ["lock"]


def test_a_disk_without_locks_is_not_taken_for_another_process(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def none(*_: object) -> None:
        raise OSError(errno.ENOLCK, os.strerror(errno.ENOLCK))

    monkeypatch.setattr(fcntl, "flock", none)
    with pytest.raises(UserInputError, match=r"/lock cannot be locked \(No locks available\): choose a folder on"):
        FolderLock(tmp_path)


def test_runs_started_in_the_same_second_get_folders_of_their_own() -> None:
    given = ["+algo=rcdsac_pow"]
    assert len({output_folder("train", given) for _ in range(3)}) == 3
