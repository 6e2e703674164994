"""Checkpoints: weights come back exactly, without a pickle; progress is kept with them."""

import pickle
from pathlib import Path

import pytest
import torch
from torchrl.objectives import LossModule, SoftUpdate

from rcdsac_trl.errors import UserInputError
from rcdsac_trl.pipeline.build.agent import make_average, make_loss, make_optimizer
from rcdsac_trl.pipeline.checkpoint import Checkpoints, load_manifest, load_weights
from tiny import tiny_settings

PROGRESS = {"iteration": 3, "steps": 120, "updates": 8, "best_score": -1.25}


def make(seed: int, row: str = "rcdsac_pow") -> LossModule:
    return make_loss(tiny_settings(row, f"seed={seed}"), "cpu")


def checkpoints_of(folder: Path, loss: LossModule) -> Checkpoints:
    learner = tiny_settings().learner
    return Checkpoints(folder, loss, make_average(loss, learner), make_optimizer(loss, learner))


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
    checkpoints_of(folder, loss).save("last", PROGRESS)
    return folder, loss


@pytest.mark.parametrize("row", ["rcdsac_pow", "rcwr"])
def test_round_trip_restores_every_weight(tmp_path: Path, row: str) -> None:
    loss, other = make(0, row), make(1, row)
    SoftUpdate(loss, tau=0.5)  # TorchRL warns of targets that nothing moves
    with torch.no_grad():  # targets and temperature of their own, so that mixing them up would show
        loss.log_alpha.fill_(-0.75)
        for target in loss.target_critic_network_params.values(True, True):
            target.mul_(0.5)
    checkpoints_of(tmp_path, loss).save("best", PROGRESS)
    assert not same(loss, other)
    assert load_weights(tmp_path, "best", loss=other) == PROGRESS
    assert same(loss, other)
    assert other.log_alpha.item() == -0.75


def test_loss_and_average_come_back_each_by_itself(tmp_path: Path) -> None:
    learner = tiny_settings().learner
    loss, other = make(seed=0), make(seed=1)
    average, again = make_average(loss, learner), make_average(other, learner)
    with torch.no_grad():
        for parameter in average.parameters():
            parameter.mul_(0.5)
    Checkpoints(tmp_path, loss, average, make_optimizer(loss, learner)).save("last", PROGRESS)
    untouched = weights(other)
    assert load_weights(tmp_path, "last", average=again) == PROGRESS
    pairs = zip(average.module.parameters(), again.module.parameters(), strict=True)
    assert all(torch.equal(a, b) for a, b in pairs)
    assert all(torch.equal(value, untouched[key]) for key, value in weights(other).items())


def test_the_state_of_the_generator_comes_back(saved: tuple[Path, LossModule]) -> None:
    folder, loss = saved
    other = make(seed=1)
    load_weights(folder, "last", loss=other)
    assert torch.equal(torch.rand(3, generator=other._generator), torch.rand(3, generator=loss._generator))


def test_saving_again_replaces(tmp_path: Path) -> None:
    loss = make(seed=0)
    checkpoints = checkpoints_of(tmp_path, loss)
    checkpoints.save("last", PROGRESS)
    with torch.no_grad():
        loss.log_alpha.fill_(1.5)
    checkpoints.save("last", PROGRESS | {"updates": 9})
    other = make(seed=1)
    assert load_weights(tmp_path, "last", loss=other)["updates"] == 9
    assert other.log_alpha.item() == 1.5
    assert [path.name for path in tmp_path.iterdir()] == ["last"], "nothing is left beside it"


def test_nothing_is_pickled(saved: tuple[Path, LossModule], monkeypatch: pytest.MonkeyPatch) -> None:
    folder, loss = saved
    files = [path for path in folder.rglob("*") if path.is_file()]
    assert files
    assert {path.suffix for path in files} <= {".json", ".memmap"}
    for path in files:
        # A pickle of protocol 2 and later begins so, a zip archive of torch.save like this.
        assert not path.read_bytes().startswith((b"\x80\x02", b"\x80\x04", b"\x80\x05", b"PK\x03\x04")), path

    def refuse(*_: object, **__: object) -> None:
        raise AssertionError("something was unpickled")

    for name in ("load", "loads", "Unpickler"):
        monkeypatch.setattr(pickle, name, refuse)
    monkeypatch.setattr(torch, "load", refuse)
    other = make(seed=1)
    load_weights(folder, "last", loss=other)
    assert same(other, loss)


def test_a_missing_checkpoint_is_one_sentence(tmp_path: Path) -> None:
    for call in (lambda: load_manifest(tmp_path, "best"), lambda: load_weights(tmp_path, "best", loss=make(0))):
        with pytest.raises(UserInputError) as caught:
            call()
        assert str(caught.value) == f"there is no checkpoint {tmp_path / 'best'}: has this run saved one yet?"


def test_a_training_leaves_best_and_last_with_their_progress(tiny_run: Path) -> None:
    for name in ("best", "last"):
        progress = load_manifest(tiny_run / "checkpoints", name)
        assert set(progress) == set(PROGRESS)
    assert load_manifest(tiny_run / "checkpoints", "last")["updates"] == 4
    assert load_manifest(tiny_run / "checkpoints", "last")["steps"] == 80
    trained = make_loss(tiny_settings(), "cpu")
    load_weights(tiny_run / "checkpoints", "last", loss=trained)
    assert not same(trained, make_loss(tiny_settings(), "cpu")), "training changed the weights that were saved"
