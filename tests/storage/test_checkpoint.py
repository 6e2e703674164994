"""Checkpoints: everything comes back exactly, without a pickle; damage is named and the last good one is used."""

import json
import os
import pickle
import shutil
from collections.abc import Callable
from dataclasses import replace
from hashlib import sha256
from pathlib import Path

import pytest
import torch
from test_replay import make_replay, narrow, numbered_episodes
from torchrl.objectives import LossModule, SoftUpdate

from rcdsac_trl.errors import UserInputError
from rcdsac_trl.rollout.make_agent import make_average, make_loss
from rcdsac_trl.storage.checkpoint import Checkpoints, Generators, load_weights
from rcdsac_trl.storage.checkpoint_record import Progress, best_damage, find, folders, newest
from rcdsac_trl.storage.replay_files import ReplayFiles
from tiny import tiny_settings

PROGRESS = Progress(iterations=3, steps=120, updates=8, elapsed_s=1.5, best_score=-1.25, best_iterations=3)
SMALL = "network={conv: 4, range: 8, vector: 4, memory: 8, head: 8, cosines: 4}"


def make(seed: int, row: str = "rcdsac_pow") -> LossModule:
    loss = make_loss(tiny_settings(row, f"seed={seed}"), "cpu")
    SoftUpdate(loss, tau=0.5)  # TorchRL warns of targets that nothing moves
    return loss


def weights(loss: LossModule) -> dict[str, torch.Tensor]:
    """Everything that is learnt; the generator's state, which drawing changes, has a test of its own."""
    return {key: value.clone() for key, value in loss.state_dict().items() if "extra_state" not in key}


def same(a: LossModule, b: LossModule) -> bool:
    first, second = weights(a), weights(b)
    assert first.keys() == second.keys()
    return all(torch.equal(first[key], second[key]) for key in first)


@pytest.fixture(scope="module")
def saved(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, LossModule]:
    folder = tmp_path_factory.mktemp("checkpoints")
    loss = make(seed=0)
    torch.rand(5, generator=loss._generator)  # the generator has moved on, and that is saved too
    Checkpoints(folder, {"loss": loss}, replay=None, keep=2).save(PROGRESS, {})
    return folder, loss


# ------------------------------------------------------------------------------------------------ what comes back
@pytest.mark.parametrize("row", ["rcdsac_pow", "rcwr"])
def test_round_trip_restores_every_weight(tmp_path: Path, row: str) -> None:
    loss, other = make(0, row), make(1, row)
    with torch.no_grad():  # targets and temperature of their own, so that mixing them up would show
        loss.log_alpha.fill_(-0.75)
        for target in loss.target_critic_network_params.values(True, True):
            target.mul_(0.5)
    Checkpoints(tmp_path, {"loss": loss}, replay=None, keep=1).save(PROGRESS, {})
    assert not same(loss, other)
    assert load_weights(tmp_path, "best", loss=other) == []
    assert find(tmp_path, "best")[0].progress == PROGRESS
    assert same(loss, other)
    assert other.log_alpha.item() == -0.75


def test_loss_and_average_come_back_each_by_itself(tmp_path: Path) -> None:
    learner = tiny_settings().learner
    loss, other = make(seed=0), make(seed=1)
    average, again = make_average(loss, learner), make_average(other, learner)
    with torch.no_grad():
        for parameter in average.parameters():
            parameter.mul_(0.5)
    Checkpoints(tmp_path, {"loss": loss, "average": average}, replay=None, keep=1).save(PROGRESS, {})
    untouched = weights(other)
    load_weights(tmp_path, "last", average=again)
    pairs = zip(average.module.parameters(), again.module.parameters(), strict=True)
    assert all(torch.equal(a, b) for a, b in pairs)
    assert all(torch.equal(value, untouched[key]) for key, value in weights(other).items())


def test_the_state_of_the_generators_comes_back(saved: tuple[Path, LossModule], tmp_path: Path) -> None:
    folder, loss = saved
    other = make(seed=1)
    load_weights(folder, "last", loss=other)
    assert torch.equal(torch.rand(3, generator=other._generator), torch.rand(3, generator=loss._generator))

    a, b = torch.Generator().manual_seed(1), torch.Generator().manual_seed(2)
    Checkpoints(tmp_path, {"generators": Generators(a=a, b=b)}, replay=None, keep=1).save(PROGRESS, {})
    drawn = torch.rand(3, generator=a), torch.rand(3, generator=b)
    Checkpoints(tmp_path, {"generators": Generators(a=a, b=b)}, replay=None, keep=1).restore(newest(tmp_path)[0])
    assert torch.equal(torch.rand(3, generator=a), drawn[0])
    assert torch.equal(torch.rand(3, generator=b), drawn[1])


def test_nothing_is_pickled(tiny_run: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    files = [path for name in ("checkpoints", "replay") for path in (tiny_run / name).rglob("*") if path.is_file()]
    assert {path.suffix for path in files} == {".json", ".tdc", ".safetensors"}
    for path in files:
        # A pickle of protocol 2 and later begins so, a zip archive of torch.save like this.
        assert not path.read_bytes().startswith((b"\x80\x02", b"\x80\x04", b"\x80\x05", b"PK\x03\x04")), path

    def refuse(*_: object, **__: object) -> None:
        raise AssertionError("something was unpickled")

    for name in ("load", "loads", "Unpickler"):
        monkeypatch.setattr(pickle, name, refuse)
    monkeypatch.setattr(torch, "load", refuse)
    loss = make(seed=1)
    load_weights(tiny_run / "checkpoints", "last", loss=loss)
    assert not same(loss, make(seed=1)), "training changed the weights that were saved"
    replay = make_replay(capacity_steps=80, sensor_mask=narrow())
    ReplayFiles(tiny_run / "replay", replay).load(newest(tiny_run / "checkpoints")[0].segments)
    assert len(replay) == 80


def test_another_shape_is_one_sentence(saved: tuple[Path, LossModule]) -> None:
    wider = make_loss(tiny_settings("rcdsac_pow", SMALL), "cpu")
    with pytest.raises(UserInputError, match=r"checkpoint .*iteration-000003 does not fit this version \(.*size"):
        load_weights(saved[0], "last", loss=wider)


# ------------------------------------------------------------------------------------------------ which ones stay
class Number:
    """The smallest component there is."""

    def __init__(self, value: float) -> None:
        self.value = torch.tensor(value)

    def state_dict(self) -> dict[str, torch.Tensor]:
        return {"value": self.value}

    def load_state_dict(self, state: dict[str, torch.Tensor]) -> None:
        self.value = state["value"]


def progress(iterations: int, best: int | None = None) -> Progress:
    return Progress(iterations=iterations, best_score=None if best is None else 1.0, best_iterations=best)


def names(folder: Path) -> list[int]:
    return [int(path.name.removeprefix("iteration-")) for path in folders(folder)]


def test_the_newest_stay_and_the_best(tmp_path: Path) -> None:
    checkpoints = Checkpoints(tmp_path, {"number": Number(0.0)}, replay=None, keep=2)
    seen = []
    for iterations, best in [(0, None), (1, None), (2, 2), (3, 2), (4, 2), (5, 2), (6, 6), (7, 6), (8, 6)]:
        checkpoints.save(progress(iterations, best), {})
        seen.append(names(tmp_path))
    # The best one goes when no checkpoint that stays names it.
    assert seen == [[0], [0, 1], [1, 2], [2, 3], [2, 3, 4], [2, 4, 5], [2, 5, 6], [6, 7], [6, 7, 8]]
    assert [path.name for path in tmp_path.iterdir() if path.name.startswith(".")] == []
    assert find(tmp_path, "best")[0].path.name == "iteration-000006"
    assert find(tmp_path, "last")[0].path.name == "iteration-000008"


def test_the_one_under_validation_stays_until_a_checkpoint_knows_the_result(tmp_path: Path) -> None:
    checkpoints = Checkpoints(tmp_path, {"number": Number(0.0)}, replay=None, keep=1)
    seen = []
    for iterations, best, validating in [(1, None, 1), (2, None, 1), (3, 1, 3), (4, 1, 3), (5, 1, 5), (6, 5, None)]:
        checkpoints.save(replace(progress(iterations, best), validating_iterations=validating), {})
        seen.append(names(tmp_path))
    assert seen == [[1], [1, 2], [1, 3], [1, 3, 4], [1, 5], [5, 6]]


def test_nothing_is_ever_written_over(tmp_path: Path) -> None:
    checkpoints = Checkpoints(tmp_path, {"number": Number(1.0)}, replay=None, keep=2)
    checkpoints.save(progress(1), {})
    before = {path: path.read_bytes() for path in tmp_path.rglob("*") if path.is_file()}
    with pytest.raises(OSError):
        checkpoints.save(progress(1), {})
    assert all(path.read_bytes() == content for path, content in before.items())


def test_what_an_interruption_left_is_cleared_and_never_read(tmp_path: Path) -> None:
    checkpoints = Checkpoints(tmp_path, {"number": Number(1.0)}, replay=None, keep=2)
    checkpoints.save(progress(1), {})
    shutil.copytree(tmp_path / "iteration-000001", tmp_path / ".unfinished-iteration-000002")
    (tmp_path / ".removed-iteration-000000").mkdir()
    assert newest(tmp_path)[0].progress.iterations == 1
    checkpoints.save(progress(2), {})
    assert sorted(path.name for path in tmp_path.iterdir()) == ["iteration-000001", "iteration-000002"]


def test_everything_is_on_the_disk_before_it_gets_its_name(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    run = tmp_path / "run"
    done: list[tuple[str, Path]] = []
    fsync, rename = os.fsync, os.rename

    def noted_fsync(descriptor: int) -> None:
        done.append(("sync", Path(os.readlink(f"/proc/self/fd/{descriptor}"))))
        fsync(descriptor)

    def noted_rename(old: Path, new: Path) -> None:
        done.append(("rename", Path(new)))
        rename(old, new)

    monkeypatch.setattr(os, "fsync", noted_fsync)
    monkeypatch.setattr(os, "rename", noted_rename)
    folder = three_checkpoints(run)
    for checkpoint in folders(folder):
        named = done.index(("rename", checkpoint))
        temporary = checkpoint.with_name(f".unfinished-{os.getpid()}-{checkpoint.name}")
        inside = list(checkpoint.rglob("*"))
        assert len(inside) > 4
        for path in inside:
            assert ("sync", temporary / path.relative_to(checkpoint)) in done[:named], path
        assert ("sync", temporary) in done[:named]
        assert ("sync", folder) in done[named:]
        # What a checkpoint names is there before it is.
        for segment in newest(folder)[0].segments[: int(checkpoint.name[-1])]:
            path = run / "replay" / segment.file
            written = path.with_name(f".unfinished-{os.getpid()}-{path.name}")
            assert ("sync", written) in done[: done.index(("rename", path))]
            assert done.index(("rename", path)) < named


def test_restoring_forgets_what_came_after(tmp_path: Path) -> None:
    number = Number(1.0)
    checkpoints = Checkpoints(tmp_path, {"number": number}, replay=None, keep=3)
    checkpoints.save(progress(1), {})
    number.value = torch.tensor(2.0)
    checkpoints.save(progress(2), {})
    (tmp_path / "iteration-000002" / "checkpoint.json").unlink()
    again = Number(0.0)
    restored = Checkpoints(tmp_path, {"number": again}, replay=None, keep=3)
    restored.restore(newest(tmp_path)[0])
    assert again.value.item() == 1.0
    assert restored.saved_iterations == 1
    assert names(tmp_path) == [1]
    restored.save(progress(2), {})
    assert newest(tmp_path)[0].progress.iterations == 2


# ------------------------------------------------------------------------------------------------ damage
def flip(path: Path) -> None:
    content = bytearray(path.read_bytes())
    content[len(content) // 2] ^= 1
    path.write_bytes(content)


def halve(path: Path) -> None:
    path.write_bytes(path.read_bytes()[: path.stat().st_size // 2])


def empty(path: Path) -> None:
    shutil.rmtree(path)
    path.mkdir()


STATE = "iteration-000003/components/0000-number/state.tdc"
RECORD = "iteration-000003/checkpoint.json"
DAMAGE: dict[str, tuple[str, Callable[[Path], None], str]] = {
    "flipped byte": (STATE, flip, "components/0000-number/state.tdc does not hold what was written"),
    "truncated": (STATE, halve, "components/0000-number/state.tdc does not hold what was written"),
    "missing": (STATE, Path.unlink, "components/0000-number/state.tdc is missing"),
    "schema flipped": (STATE.replace("tdc", "json"), flip, "components/0000-number/state.json does not hold what"),
    "record flipped": (RECORD, flip, "checkpoint.json "),
    "record truncated": (RECORD, halve, "checkpoint.json cannot be read"),
    "record missing": (RECORD, Path.unlink, "checkpoint.json is missing"),
    "empty folder": ("iteration-000003", empty, "checkpoint.json is missing"),
    "segment flipped": ("../replay/episodes-00000002.safetensors", flip, "does not hold what was written"),
    "segment truncated": ("../replay/episodes-00000002.safetensors", halve, "does not hold what was written"),
    "segment missing": ("../replay/episodes-00000002.safetensors", Path.unlink, "is missing"),
}


def three_checkpoints(run: Path) -> Path:
    """Save after one, two and three episodes."""
    replay = make_replay()
    folder = run / "checkpoints"
    folder.mkdir(parents=True)
    checkpoints = Checkpoints(folder, {"number": Number(1.0)}, replay=ReplayFiles(run / "replay", replay), keep=3)
    for episode in range(3):
        replay.add_episodes(numbered_episodes(episode))
        checkpoints.save(progress(episode + 1), {})
    return folder


@pytest.mark.parametrize("kind", DAMAGE)
def test_a_damaged_newest_is_named_and_the_last_good_one_is_used(tmp_path: Path, kind: str) -> None:
    folder = three_checkpoints(tmp_path)
    assert newest(folder, replay=tmp_path / "replay")[0].progress.iterations == 3
    where, damage, reason = DAMAGE[kind]
    damage(folder / where)
    found, told = newest(folder, replay=tmp_path / "replay")
    assert found.progress.iterations == 2
    assert len(told) == 1
    assert told[0].startswith(f"checkpoint {folder / 'iteration-000003'} is damaged: ")
    assert reason in told[0]
    # Whoever needs the weights alone does not look at the replay.
    assert (newest(folder)[0].progress.iterations == 3) == kind.startswith("segment")


def test_a_byte_of_a_record_cannot_change_unnoticed(tmp_path: Path) -> None:
    folder = three_checkpoints(tmp_path)
    path = folder / RECORD
    content = path.read_bytes()
    for position in range(0, len(content), 7):
        changed = bytearray(content)
        changed[position] ^= 1
        path.write_bytes(changed)
        if json.loads(content) != _parsed(changed):
            assert newest(folder)[0].progress.iterations == 2, position


def _parsed(content: bytearray) -> object:
    try:
        return json.loads(content)
    except ValueError:
        return None


def test_without_a_good_one_there_is_one_clear_error(tmp_path: Path) -> None:
    folder = three_checkpoints(tmp_path)
    flip(tmp_path / "replay" / "episodes-00000000.safetensors")  # all need it
    with pytest.raises(UserInputError) as caught:
        newest(folder, replay=tmp_path / "replay")
    assert str(caught.value).startswith(f"no checkpoint in {folder} is whole: checkpoint ")
    assert str(caught.value).count("is damaged") == 3
    assert "\n" not in str(caught.value)


def test_a_damaged_best_one_is_named(tmp_path: Path) -> None:
    checkpoints = Checkpoints(tmp_path, {"number": Number(1.0)}, replay=None, keep=2)
    for iterations in range(4):
        checkpoints.save(progress(iterations, best=1 if iterations else None), {})
    last = newest(tmp_path)[0].progress
    assert best_damage(tmp_path, last) is None
    flip(tmp_path / STATE.replace("3", "1", 1))
    assert "the next validation finds a new best one" in str(best_damage(tmp_path, last))
    with pytest.raises(UserInputError, match=r"best checkpoint .*iteration-000001 is damaged: .*checkpoint=last is wh"):
        find(tmp_path, "best")
    assert find(tmp_path, "last")[0].progress.iterations == 3


def test_a_checkpoint_goes_by_its_iterations(tmp_path: Path) -> None:
    checkpoints = Checkpoints(tmp_path, {"number": Number(1.0)}, replay=None, keep=2)
    for iterations in range(4):
        checkpoints.save(progress(iterations, best=0 if iterations else None), {})
    assert [find(tmp_path, n)[0].progress.iterations for n in (0, 2, 3)] == [0, 2, 3]
    with pytest.raises(UserInputError) as caught:
        find(tmp_path, 1)
    assert str(caught.value) == (
        f"checkpoint=1 is not in {tmp_path}, which holds iteration-000000, iteration-000002, iteration-000003: "
        "a training keeps more with checkpoint.keep"
    )
    flip(tmp_path / STATE.replace("3", "2", 1))
    with pytest.raises(UserInputError, match=r"^checkpoint .*iteration-000002 is damaged: .*checkpoint=last is whole$"):
        find(tmp_path, 2)


def test_a_missing_checkpoint_is_one_sentence(tmp_path: Path) -> None:
    told = f"there is no checkpoint in {tmp_path}: has this run saved one yet?"
    for call in (lambda: find(tmp_path, "best"), lambda: load_weights(tmp_path, "last", loss=make(0))):
        with pytest.raises(UserInputError) as caught:
            call()
        assert str(caught.value) == told
    Checkpoints(tmp_path, {"number": Number(1.0)}, replay=None, keep=2).save(Progress(), {})
    with pytest.raises(UserInputError, match=r"there is no best checkpoint in .*: has this run validated yet"):
        find(tmp_path, "best")


@pytest.mark.parametrize("version", [0, 2])
def test_another_format_is_refused_in_one_sentence(tmp_path: Path, version: int) -> None:
    folder = three_checkpoints(tmp_path)
    record = json.loads((folder / RECORD).read_text())
    content = {key: value for key, value in record.items() if key not in ("format_version", "sha256")}
    digest = sha256(json.dumps([version, content], sort_keys=True).encode()).hexdigest()
    (folder / RECORD).write_text(json.dumps({"format_version": version, "sha256": digest, **content}))
    with pytest.raises(UserInputError, match=f"is of format {version}, this version reads format 1: use the commit"):
        newest(folder)


def test_a_run_from_before_this_format_is_refused_in_one_sentence(tmp_path: Path) -> None:
    (tmp_path / "last").mkdir()
    with pytest.raises(UserInputError, match="was written by an earlier version, this one reads format 1"):
        newest(tmp_path)


def test_a_checkpoint_that_is_replaced_while_it_is_read_is_looked_for_again(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    checkpoints = Checkpoints(tmp_path, {"number": Number(1.0)}, replay=None, keep=1)
    checkpoints.save(progress(1), {})
    listed = folders(tmp_path)
    checkpoints.save(progress(2), {})
    answers = iter([listed])
    monkeypatch.setattr("rcdsac_trl.storage.checkpoint_record.folders", lambda folder: next(answers, folders(folder)))
    found, told = newest(tmp_path)
    assert (found.progress, told) == (progress(2), [])
