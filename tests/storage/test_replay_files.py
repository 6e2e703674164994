"""The replay on disk: each episode written once, and back in its place."""

from pathlib import Path

import pytest
import torch
from test_replay import EPISODE_STEPS, make_replay, numbered_episodes

from rcdsac_trl.storage import replay_files
from rcdsac_trl.storage.replay_files import ReplayFiles, inherit, remove_others
from rcdsac_trl.storage.sequence_replay import SequenceReplay, bytes_per_slot

SLOTS = EPISODE_STEPS + 1


def add(replay: SequenceReplay, number: int) -> None:
    replay.add_episodes(numbered_episodes(replay.episodes_added, number))


@pytest.mark.parametrize("added", [1, 2, 3, 4, 5, 9])
def test_every_episode_comes_back_where_it_was_and_goes_on_there(tmp_path: Path, added: int) -> None:
    replay = make_replay(capacity_steps=7 * EPISODE_STEPS)
    files = ReplayFiles(tmp_path / "replay", replay)
    for _ in range(added):  # three at a time do not divide seven: the ring wraps inside a segment
        add(replay, 3)
        segments = files.save()
    other = make_replay(capacity_steps=7 * EPISODE_STEPS)
    again = ReplayFiles(tmp_path / "replay", other)
    again.load(segments)
    other.generator.set_state(replay.generator.get_state())
    for _ in range(2):
        assert (other.episodes_added, len(other)) == (replay.episodes_added, len(replay))
        assert (other.buffer.storage[:] == replay.buffer.storage[:]).all()
        assert (other.sample() == replay.sample()).all()
        add(replay, 3)
        add(other, 3)
    assert again.save() == files.save()


def test_saving_costs_what_is_new_whatever_the_replay_holds(tmp_path: Path) -> None:
    replay = make_replay(capacity_steps=100 * EPISODE_STEPS, sensor_mask=torch.ones(180, dtype=torch.bool))
    files = ReplayFiles(tmp_path, replay)
    written = []
    for _ in range(20):
        before = {path: path.stat().st_mtime_ns for path in tmp_path.iterdir()}
        add(replay, 2)
        files.save()
        new = [path for path in tmp_path.iterdir() if path not in before]
        written.append(sum(path.stat().st_size for path in new))
        assert all(path.stat().st_mtime_ns == time for path, time in before.items()), "an old file was touched"
    data = 2 * SLOTS * bytes_per_slot(180, ("risk",))
    # As compact as in memory: the rest is the header.
    assert all(data < size < data + 1024 for size in written)
    size = sum(path.stat().st_size for path in tmp_path.iterdir())
    files.save()
    assert sum(path.stat().st_size for path in tmp_path.iterdir()) == size, "nothing is new"


def test_files_go_when_their_episodes_have_left_and_nobody_names_them(tmp_path: Path) -> None:
    replay = make_replay(capacity_steps=7 * EPISODE_STEPS)
    files = ReplayFiles(tmp_path, replay)
    named: list[list[str]] = []
    for _ in range(6):
        add(replay, 3)
        named.append([segment.file for segment in files.save()])
        remove_others(files.folder, {name for names in named[-2:] for name in names})
    starts = [[int(name[9:17]) for name in names] for names in named]
    # Seven episodes lie in three files of three, of which the oldest may hold some that have left.
    assert starts == [[0], [0, 3], [0, 3, 6], [3, 6, 9], [6, 9, 12], [9, 12, 15]]
    assert sorted(int(path.name[9:17]) for path in tmp_path.iterdir()) == [6, 9, 12, 15]


def test_episodes_that_leave_before_they_are_saved_are_not_saved(tmp_path: Path) -> None:
    replay = make_replay(capacity_steps=7 * EPISODE_STEPS)
    for _ in range(5):
        add(replay, 3)
    (segment,) = ReplayFiles(tmp_path, replay).save()
    assert (segment.first_episode, segment.episodes) == (8, 7)
    with pytest.raises(ValueError, match="episodes 7 to 9 are not all in the replay"):
        replay.stored_episodes(7, 3)
    with pytest.raises(ValueError, match="only an empty replay"):
        replay.restore(0, [])


def test_another_run_begins_with_the_newest_episodes_in_files_of_its_own(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    ended = make_replay(capacity_steps=7 * EPISODE_STEPS)
    files = ReplayFiles(tmp_path / "ended", ended)
    for _ in range(4):
        add(ended, 3)
        segments = files.save()
    replay = make_replay(capacity_steps=5 * EPISODE_STEPS)
    inherit(files.folder, segments, replay)
    assert replay.episodes_added == 5
    assert (replay.stored_episodes(0, 5) == ended.stored_episodes(7, 5)).all()
    monkeypatch.setattr(replay_files, "_EPISODES_A_FILE", 2)
    written = ReplayFiles(tmp_path / "new", replay).save()
    assert [(segment.first_episode, segment.episodes) for segment in written] == [(0, 2), (2, 2), (4, 1)]
    again = make_replay(capacity_steps=5 * EPISODE_STEPS)
    ReplayFiles(tmp_path / "new", again).load(written)
    assert (again.buffer.storage[:] == replay.buffer.storage[:]).all()
