"""Weights folders: what is written is read, what is damaged is refused, names are found."""

import json
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from torchrl.objectives import LossModule

import rcdsac_trl
from rcdsac_trl.deploy import Policy, read_weights
from rcdsac_trl.deploy.policy.weights import Weights, packed
from rcdsac_trl.errors import UserInputError
from rcdsac_trl.release.run_weights import weights_of_run
from rcdsac_trl.storage import checkpoint_record
from robots import AHEAD, OPEN, ROWS, STANDING, agent
from tiny import untrained_run


def written(folder: Path, weights: Weights) -> Path:
    folder.mkdir(parents=True, exist_ok=True)
    for name, content in packed(weights).items():
        (folder / name).write_bytes(content)
    return folder


@pytest.mark.parametrize("row", ROWS)
def test_what_is_written_is_read(row: str, tmp_path: Path) -> None:
    weights = agent(**ROWS[row])
    found = read_weights(written(tmp_path / "agent", weights))
    assert found.config == weights.config
    assert found.tensors.keys() == weights.tensors.keys()
    assert all(np.array_equal(found.tensors[name], value) for name, value in weights.tensors.items())
    card = (tmp_path / "agent" / "README.md").read_text()
    assert f"# {row}, narrow sensor" in card
    if weights.config.context is not None:
        assert f"`{weights.config.context}` in [" in card


def test_damage_is_refused_in_one_sentence(tmp_path: Path) -> None:
    folder = written(tmp_path, agent())
    config, tensors = folder / "config.json", folder / "weights.safetensors"
    good = config.read_text(), tensors.read_bytes()
    values = json.loads(good[0])

    def refusal() -> str:
        with pytest.raises(UserInputError) as raised:
            read_weights(folder)
        config.write_text(good[0])
        tensors.write_bytes(good[1])
        return str(raised.value)

    flipped = bytearray(good[1])
    flipped[-1] ^= 1
    tensors.write_bytes(flipped)
    assert "is not what config.json says" in refusal()
    tensors.unlink()
    assert "holds no weights.safetensors" in refusal()
    config.write_text("{")
    assert "cannot be read" in refusal()
    config.write_text("[]")
    assert "cannot be read" in refusal()
    for key, value, told in [
        ("format_version", 99, "is of format 99, this version reads 1 to 6"),
        ("format_version", [4], "is of format [4], this version"),
        ("sensor", "wide", "sensor='wide' does not exist"),
        ("padding", "zeros", "neither 'circular' nor 'none'"),
        ("range_code", "metres", "none of paper, nearness"),
        ("memory_s", -1.0, "is outside [0, 3600]"),
        ("critic", "none", "neither 'quantile' nor 'scalar'"),
        ("num_critics", 3, "differ in critics.2"),
        ("context", "mood", "neither 'beta' nor 'collision_weight'"),
        ("context_range", None, "do not fit together"),
        ("network", {"conv": 0}, "does not give a positive width"),
        ("network", values["network"] | {"head": 9}, "its config.json says float32"),
        ("period_s", [0.1], "not two finite numbers"),
        ("period_s", [120.0, 160.0], "does not rise within [0, 10]: give seconds"),
        ("period_s", [0.16, 0.12], "does not rise within"),
        ("waypoint_radius_m", 500.0, "is not above 0 and at most 20: give metres"),
        ("goal_radius_m", 0.0, "is not above 0"),
    ]:
        config.write_text(json.dumps(values | {key: value}))
        assert told in refusal(), key
    config.write_text(json.dumps(values | {"more": 1}))
    assert "does not have the keys" in refusal()


def test_weights_that_are_not_finite_are_refused() -> None:
    weights = agent()
    broken = dict(weights.tensors)
    broken["actor.head.output.bias"] = np.full_like(broken["actor.head.output.bias"], np.nan)
    with pytest.raises(UserInputError, match="not finite"):
        Weights(weights.config, broken)


def test_loading_and_driving_needs_none_of_the_training(tmp_path: Path) -> None:
    folder = written(tmp_path / "agent", agent())
    code = f"""
import sys
import rcdsac_trl
policy = rcdsac_trl.load({str(folder)!r})
policy.act([2.0] * 180, [[2.0, 0.0], [4.0, 0.0]], [0.0, 0.0], beta=-1.0)
heavy = {{"torch", "torchrl", "tensordict", "pybullet", "hydra", "omegaconf", "numba", "scipy", "pandas", "matplotlib"}}
print(sorted(heavy & {{name.split(".")[0] for name in sys.modules}}))
"""
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False)
    assert (done.stdout.strip(), done.stderr) == ("[]", "")


@pytest.mark.parametrize("row", ["rcwr", "sac", "dsac_cvar", "rcdsac_cvar"])
def test_every_kind_of_row_leaves(row: str, tmp_path: Path) -> None:
    run, loss, average = untrained_run(tmp_path / "run", row)
    weights = weights_of_run(run, "last")
    policy = Policy(read_weights(written(tmp_path / "agent", weights)))
    command = policy.act(OPEN, AHEAD, STANDING)
    assert command.fresh
    assert (command.quantiles is None) == (row in ("rcwr", "sac"))
    assert policy.default_beta == (pytest.approx(0.505) if row == "rcdsac_cvar" else None)
    assert weights.config.provenance["updates"] == 7
    assert weights.config.period_s == (0.12, 0.16)
    # The averaged actor leaves, not the learning one; and the critics, not their targets.
    assert np.array_equal(weights.tensors["actor.head.hidden.bias"], average.module[1].module.hidden.bias.detach())
    assert not np.array_equal(weights.tensors["actor.head.hidden.bias"], actor_bias(loss))
    for number in range(2):
        bias = loss.critic_network_params[str(number)]["module", "1", "module", "hidden", "bias"]
        assert np.array_equal(weights.tensors[f"critics.{number}.head.hidden.bias"], bias.detach())


def actor_bias(loss: LossModule) -> torch.Tensor:
    return loss.actor_network_params["module", "1", "module", "hidden", "bias"].detach()


def test_a_run_folder_is_loaded_as_it_is(tmp_path: Path) -> None:
    run, _, _ = untrained_run(tmp_path / "run", "rcdsac_pow")
    with pytest.raises(UserInputError, match="there is no best checkpoint"):
        rcdsac_trl.load(run)
    last = next((run / "checkpoints").iterdir())
    progress = checkpoint_record.record(last).progress
    (last / "checkpoint.json").unlink()
    checkpoint_record.write_record(last, replace(progress, best_score=1.0, best_iterations=0), [], {})
    wanted = Policy(weights_of_run(run, "last")).act(OPEN, AHEAD, STANDING).wanted
    assert rcdsac_trl.load(run).act(OPEN, AHEAD, STANDING).wanted == wanted


def test_a_folder_without_a_checkpoint_is_refused(tmp_path: Path) -> None:
    (tmp_path / "checkpoints").mkdir()
    with pytest.raises(UserInputError, match=r"holds no config\.yaml"):
        rcdsac_trl.load(tmp_path)
