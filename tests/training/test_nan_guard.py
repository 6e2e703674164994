"""NaN and infinity end a training before they are saved, and what they came from can be looked at again."""

import json
import math
from pathlib import Path

import pytest
import torch
from tensordict import TensorDict, TensorDictBase

from rcdsac_trl import train
from rcdsac_trl.errors import TrainingError
from rcdsac_trl.rollout.make_agent import make_loss
from rcdsac_trl.training.learner import Learner
from rcdsac_trl.training.nan_guard import load_failure, reproduce_failure
from rcdsac_trl.training.setup import resume_training
from rcdsac_trl.training.trainer import Trainer
from tiny import ITERATIONS, TINY, load_progress, tiny_settings, tiny_trainer


def failing(trainer: Trainer) -> str:
    """Run what must fail; return the sentence."""
    with pytest.raises(TrainingError) as caught:
        trainer.run()
    assert "\n" not in str(caught.value)
    return str(caught.value)


def spoil_rewards(trainer: Trainer, monkeypatch: pytest.MonkeyPatch, value: float, update: int) -> None:
    """Put a number into the rewards of one update's batch."""
    sample, drawn = trainer.learner.replay.sample, iter(range(100))

    def spoilt() -> TensorDict:
        batch = sample()
        if next(drawn) == update:
            batch["next", "reward"][0, 0] = value
        return batch

    monkeypatch.setattr(trainer.learner.replay, "sample", spoilt)


@pytest.mark.parametrize("value", [math.nan, math.inf])
def test_an_update_that_is_not_finite_ends_the_run_and_is_shown_again(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, value: float
) -> None:
    trainer = tiny_trainer(tmp_path / "run")
    spoil_rewards(trainer, monkeypatch, value, update=3)  # the second of the second iteration
    told = failing(trainer)
    dump = tmp_path / "run" / "failure" / "iteration-000002-update-000002"
    assert f"is NaN or infinite in iteration 2: training stops; {dump} shows it again" in told
    assert told.startswith("loss_qvalue = ")
    assert (tmp_path / "run" / "train.log").read_text().splitlines()[-1] == told
    # No weight has moved: what is in memory and in the dump is from before the update.
    assert all(p.isfinite().all() for p in trainer.learner.loss.parameters())
    assert load_progress(tmp_path / "run" / "checkpoints", "last").iterations == 1

    loss, batch = reproduce_failure(dump)
    assert batch.batch_size == torch.Size([2, 5])
    assert {key: value.stride(1) == 0 for key, value in batch.items(True, True)} == {
        key: value.stride(1) == 0 for key, value in trainer.guard._batch.items(True, True)
    }
    again = loss(batch)
    seen = trainer.guard._losses
    for key in ("loss_qvalue", "loss_actor", "loss_alpha"):
        torch.testing.assert_close(again[key], seen[key], rtol=0, atol=0, equal_nan=True)
    assert not again["loss_qvalue"].isfinite()
    assert again["loss_actor"].isfinite()
    assert json.loads((dump / "failure.json").read_text())["iteration"] == 2


def test_a_gradient_that_is_not_finite_ends_the_run_although_the_losses_are(tmp_path: Path) -> None:
    trainer = tiny_trainer(tmp_path / "run")
    trainer.learner.loss.log_alpha.register_hook(lambda gradient: gradient * math.nan)
    assert failing(trainer).startswith("gradient norm of parameter group 2 = nan is NaN or infinite in iteration 1")
    assert load_progress(tmp_path / "run" / "checkpoints", "last").iterations == 0


@pytest.mark.parametrize(
    ("key", "step", "name"),
    [
        ("range", 0, "range"),
        (("next", "range"), 7, "next.range"),
        (("next", "velocity"), 7, "next.velocity"),
        (("next", "reward_components"), 7, "next.reward_components"),
    ],
)
def test_an_episode_that_is_not_finite_is_never_stored(
    tmp_path: Path, key: str | tuple[str, str], step: int, name: str
) -> None:
    trainer = tiny_trainer(tmp_path / "run")
    collect = trainer.episodes.collect

    def spoilt(iteration: int, map_index: int) -> TensorDictBase:
        batch = collect(iteration, map_index)
        batch[key][1, step, 0] = -math.inf
        return batch

    trainer.episodes.collect = spoilt  # type: ignore[method-assign]
    assert failing(trainer).startswith(f"{name} of episode 1 at step {step} is NaN or infinite in iteration 1: ")
    assert len(trainer.learner.replay) == 0
    dump = load_failure(tmp_path / "run" / "failure" / "iteration-000001", make_loss(tiny_settings(), "cpu"))
    assert dump[key][1, step, 0] == -math.inf
    assert dump[key].isfinite().sum() == dump[key].numel() - 1


def test_the_same_failure_again_leaves_the_dump_as_it_is(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    run = tmp_path / "run"
    trainer = tiny_trainer(run)
    spoil_rewards(trainer, monkeypatch, math.nan, update=3)
    told = failing(trainer)
    before = {path: path.read_bytes() for path in (run / "failure").rglob("*") if path.is_file()}
    again = resume_training(run)
    assert again is not None
    spoil_rewards(again, monkeypatch, math.nan, update=1)
    assert failing(again) == told
    assert {path: path.read_bytes() for path in (run / "failure").rglob("*") if path.is_file()} == before


def test_a_device_that_is_not_waited_for_is_asked_once_an_iteration(tmp_path: Path) -> None:
    trainer = tiny_trainer(tmp_path / "run")
    trainer.guard._failed = torch.tensor(False)
    trainer.guard.end_iteration()
    trainer.guard._failed = torch.tensor(True)
    with pytest.raises(TrainingError, match="became NaN or infinite in iteration 1: training stops"):
        trainer.guard.end_iteration()
    trainer.guard.start_iteration(1)
    trainer.guard.end_iteration()
    trainer.run()
    assert trainer.progress.iterations == ITERATIONS


def test_the_command_ends_with_code_1_and_one_sentence(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]
) -> None:
    def fails(self: Learner) -> None:
        raise TrainingError("it is NaN")

    monkeypatch.setattr(Learner, "update", fails)
    monkeypatch.setenv("MALLOC_MMAP_MAX_", "0")
    monkeypatch.setattr("sys.argv", ["prog", "+algo=rcdsac_pow", *TINY, f"hydra.run.dir={tmp_path / 'run'}"])
    with pytest.raises(SystemExit) as left:
        train.main()
    assert left.value.code == 1
    assert capfd.readouterr().err == "rcdsac_trl: it is NaN\n"
