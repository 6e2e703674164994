"""Recalibrated quantiles: what is told by hand, what is refused, and that nothing is decided by them."""

import json
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from rcdsac_trl.config.acting_override import ActingOverride
from rcdsac_trl.deploy import ActingSettings, Policy, TailVarianceBeta, Weights
from rcdsac_trl.deploy.policy.recalibration import Recalibration
from rcdsac_trl.deploy.policy.weights import packed, read_weights
from rcdsac_trl.errors import UserInputError
from robots import AHEAD, DSAC, OPEN, SAC, STANDING, agent, full_size

FIT: dict[str, Any] = {
    "split": "validation",
    "seed": 3,
    "num_maps": 12,
    "num_episodes": 4,
    "num_states": 2400,
    "horizon_steps": 500,
    "command": "python -m rcdsac_trl.calibrate run=a as_driven=true",
}
# Longer tails on either side than the critics say, at -2 more than at 0.
AT_2, AT_0 = np.linspace(-9.0, 3.0, 16), np.linspace(-1.0, 5.0, 16)


def fitted(betas: tuple[float, ...] = (-2.0, 0.0), rows: Any = (AT_2, AT_0)) -> Recalibration:
    return Recalibration(tuple((np.arange(16) + 0.5) / 16), betas, rows, **FIT)


def telling(weights: Weights, recalibration: Recalibration) -> Weights:
    return replace(weights, config=replace(weights.config, recalibration=recalibration))


# ------------------------------------------------------------------------------------------------ by hand
def test_offsets_are_linear_between_betas_and_between_fractions() -> None:
    recalibration = Recalibration((0.25, 0.75), (-2.0, -1.0, 0.0), ((0.0, 1.0), (4.0, 2.0), (6.0, 10.0)), **FIT)
    assert recalibration.offsets_of(-1.0).tolist() == [4.0, 2.0]
    assert recalibration.offsets_of(-1.25).tolist() == [3.0, 1.75]
    assert recalibration.offsets_of(-0.5).tolist() == [5.0, 6.0]
    assert [recalibration.offsets_of(beta).tolist() for beta in (-9.0, 9.0)] == [[0.0, 1.0], [6.0, 10.0]]
    finer = recalibration.at([0.125, 0.25, 0.5, 0.875])
    assert finer.offsets_of(0.0).tolist() == [6.0, 6.0, 8.0, 10.0]
    assert finer.offsets_of(0.0).dtype == np.float32


def test_what_is_told_never_crosses() -> None:
    steep = Recalibration((0.25, 0.75), (), ((5.0, -5.0),), **FIT)
    assert steep.tell(np.array([[0.0, 1.0], [0.0, 40.0]]), None).tolist() == [[-4.0, 5.0], [5.0, 35.0]]
    assert steep.tell(np.array([0.0, 1.0]), -1.0).tolist() == [-4.0, 5.0]  # one fit is good for every beta


@pytest.mark.parametrize(
    ("changes", "told"),
    [
        ({"fractions": (0.75, 0.25)}, "its fractions do not rise within (0, 1)"),
        ({"fractions": (0.25, 1.0)}, "its fractions do not rise within (0, 1)"),
        ({"fractions": (float("nan"), 0.5)}, "its fractions do not rise within (0, 1)"),
        ({"fractions": (), "offsets": ((),)}, "its fractions do not rise within (0, 1)"),
        ({"betas": (0.0, -1.0)}, "or its betas do not rise"),
        ({"offsets": ((1.0, 2.0),)}, "its offsets are no table of 2 x 2 numbers"),
        ({"offsets": ((1.0, 2.0), (1.0,))}, "its offsets are no table of 2 x 2 numbers"),
        ({"betas": ()}, "its offsets are no table of 1 x 2 numbers"),
        ({"offsets": ((1.0, 2.0), (1.0, float("inf")))}, "not all of its numbers are finite"),
    ],
)
def test_what_no_offsets_are_is_refused(changes: dict[str, Any], told: str) -> None:
    good: dict[str, Any] = {"fractions": (0.25, 0.75), "betas": (-1.0, 0.0), "offsets": ((1.0, 2.0), (3.0, 4.0))}
    with pytest.raises(UserInputError) as raised:
        Recalibration(**good | changes, **FIT)
    assert str(raised.value).startswith("recalibration: ")
    assert told in str(raised.value)


def test_critics_that_know_the_mean_alone_have_none() -> None:
    with pytest.raises(UserInputError, match="critic='scalar' knows no quantiles"):
        agent(**SAC, recalibration=fitted((), (AT_2,)))


# ------------------------------------------------------------------------------------------------ on a robot
def test_a_policy_tells_what_its_critics_say_and_the_offsets_of_its_beta() -> None:
    plain, told = Policy(agent(), guard=None), Policy(telling(agent(), fitted()), guard=None)
    assert (plain.recalibrated, told.recalibrated) == (False, True)
    for beta, offsets in ((-2.0, AT_2), (-1.0, (AT_2 + AT_0) / 2), (0.0, AT_0)):
        said, command = (policy.act(OPEN, AHEAD, STANDING, beta) for policy in (plain, told))
        assert said.quantiles is not None
        assert said.raw_quantiles is said.quantiles
        assert command.raw_quantiles == pytest.approx(said.quantiles, abs=0.0)
        assert command.quantiles == pytest.approx(np.sort(said.quantiles + offsets), abs=1e-5)
        assert command.quantiles.dtype == np.float32
        assert (np.diff(command.quantiles) >= 0.0).all()
        assert command.value == pytest.approx(command.quantiles.mean(), rel=1e-6)
        assert command.value == pytest.approx(said.value + offsets.mean(), rel=1e-5)
    foreseen = told.foresee(-2.0)
    assert foreseen.raw_quantiles == pytest.approx(plain.foresee(-2.0).quantiles, abs=0.0)
    assert foreseen.value == pytest.approx(plain.foresee(-2.0).value + AT_2.mean(), rel=1e-5)
    (many,) = told.outlooks(foreseen.action[None], -2.0)
    assert many == pytest.approx(foreseen.quantiles, abs=1e-5)


def test_an_agent_that_acts_otherwise_than_it_was_fitted_tells_raw_quantiles() -> None:
    weights = telling(agent(), fitted())
    other = ActingSettings(num_candidates=4)
    assert ActingOverride(num_candidates=1).in_weights(weights) is weights
    assert ActingOverride(num_candidates=4).in_weights(weights).config.recalibration is None
    policy = Policy(weights, guard=None, acting=other)
    command = policy.act(OPEN, AHEAD, STANDING, -2.0)
    assert not policy.recalibrated
    assert command.quantiles is command.raw_quantiles
    policy.acting = weights.config.acting
    assert policy.recalibrated


def test_more_or_fewer_quantiles_take_what_lies_between() -> None:
    for number in (1, 5, 40):
        plain, told = (
            Policy(weights, guard=None, num_quantiles=number) for weights in (agent(), telling(agent(), fitted()))
        )
        said, command = (policy.act(OPEN, AHEAD, STANDING, -2.0) for policy in (plain, told))
        offsets = np.interp((np.arange(number) + 0.5) / number, (np.arange(16) + 0.5) / 16, AT_2)
        assert command.quantiles == pytest.approx(np.sort(said.quantiles + offsets), abs=1e-5)


def test_an_agent_for_one_beta_has_one_row() -> None:
    weights = agent(**DSAC)
    plain, told = Policy(weights, guard=None), Policy(telling(weights, fitted((), (AT_2,))), guard=None)
    said, command = (policy.act(OPEN, AHEAD, STANDING) for policy in (plain, told))
    assert command.quantiles == pytest.approx(np.sort(said.quantiles + AT_2), abs=1e-5)


@pytest.mark.parametrize("acting", [ActingSettings(), ActingSettings(num_candidates=8, spread=1.5)])
def test_nothing_is_decided_by_what_is_told(acting: ActingSettings) -> None:
    """To the last bit: actions, commands, and the beta that a controller makes of the quantiles before."""
    weights = full_size(acting=acting)
    driven = []
    for policy in (Policy(weights), Policy(telling(weights, fitted()))):
        rng = np.random.default_rng(0)
        controller = TailVarianceBeta(-2.0, 0.0)
        quantiles, commands, betas = None, [], []
        for _ in range(25):
            ranges = rng.uniform(0.3, 4.0, 180)
            beta = controller(ranges, quantiles)
            command = policy.act(ranges, rng.uniform(-2.0, 2.0, (2, 2)), STANDING, beta)
            quantiles = command.raw_quantiles
            commands.append(command)
            betas.append(beta)
        driven.append((betas, commands))
    (betas, plain), (betas_told, told) = driven
    assert betas == betas_told
    controller = TailVarianceBeta(-2.0, 0.0)
    assert betas[1:] != [controller(OPEN, command.quantiles) for command in told[:-1]]  # it would read another tail
    assert len(set(betas)) > 5
    for one, other in zip(plain, told, strict=True):
        decided = (one.v_m_per_s, one.omega_rad_per_s, one.wanted, one.reason)
        assert decided == (other.v_m_per_s, other.omega_rad_per_s, other.wanted, other.reason)
        assert one.value != other.value


# ------------------------------------------------------------------------------------------------ what is carried
def test_weights_carry_their_offsets_and_those_of_before_have_none(tmp_path: Path) -> None:
    weights = telling(agent(), fitted())
    for name, content in packed(weights).items():
        (tmp_path / name).write_bytes(content)
    assert read_weights(tmp_path).config == weights.config
    card = (tmp_path / "README.md").read_text()
    told = "recalibrated on 12 validation maps x 4 episodes (seed 3, beta = -2, 0)"
    assert f"| reports | quantiles of the return, {told} |\n" in card
    assert "\n\n\n" not in card
    config = json.loads((tmp_path / "config.json").read_bytes())
    assert config["recalibration"] == json.loads(json.dumps(asdict(fitted())))
    damaged = config | {"recalibration": config["recalibration"] | {"offsets": [[0.0]]}}
    (tmp_path / "config.json").write_text(json.dumps(damaged))
    with pytest.raises(UserInputError, match="recalibration: its offsets are no table of 2 x 16 numbers"):
        read_weights(tmp_path)
    del config["recalibration"]
    (tmp_path / "config.json").write_text(json.dumps(config | {"format_version": 5}))
    assert not Policy(read_weights(tmp_path)).recalibrated
