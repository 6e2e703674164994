"""The choice among actions on a robot: what it is worth, whom it obeys, what is refused."""

import copy
import json
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any, cast

import numpy as np
import pytest
import torch

from rcdsac_trl.agent.risk import MEASURES
from rcdsac_trl.config.acting_override import ActingOverride
from rcdsac_trl.deploy import Policy
from rcdsac_trl.deploy.policy.acting import BY_MEAN, ActingSettings
from rcdsac_trl.deploy.policy.action_choice import ActionChoice
from rcdsac_trl.deploy.policy.distortion import PSI, distorted, fractions_of
from rcdsac_trl.deploy.policy.inference import Actor, Array, Critics
from rcdsac_trl.deploy.policy.weights import packed, read_weights
from rcdsac_trl.errors import UserInputError
from robots import AHEAD, OPEN, ROWS, STANDING, agent

MANY = ActingSettings(num_candidates=32, spread=2.0)


# ------------------------------------------------------------------------------------------------ candidates
def test_candidates_are_a_standard_normal_laid_out_around_the_mean() -> None:
    noise = ActingSettings(num_candidates=2001).noise()
    assert noise[0].tolist() == [0.0, 0.0]
    np.testing.assert_allclose(noise.mean(axis=0), 0.0, atol=2e-3)
    np.testing.assert_allclose(np.cov(noise.T), np.eye(2), atol=5e-3)
    # Half of the Rayleigh distribution lies below sqrt(2 ln 2).
    radii = np.hypot(*noise[1:].T)
    assert np.mean(radii < np.sqrt(2.0 * np.log(2.0))) == pytest.approx(0.5, abs=1e-3)
    np.testing.assert_allclose(ActingSettings(9, 3.0).noise(), 3.0 * ActingSettings(9).noise(), rtol=1e-6)
    assert ActingSettings().noise().tolist() == [[0.0, 0.0]]


@pytest.mark.parametrize("name", MEASURES)
def test_numpy_distorts_as_torch_does(name: str) -> None:
    measure, tau = MEASURES[name](), fractions_of(16)  # type: ignore[call-arg]
    for beta in np.linspace(measure.low, measure.high, 5).tolist():
        expected = measure.psi(torch.from_numpy(tau), torch.tensor(beta)).numpy()
        np.testing.assert_allclose(distorted(name, tau, beta), expected, atol=2e-7)


# ------------------------------------------------------------------------------------------------ the choice
def acting(policy: Policy, beta: float | None = None) -> list[tuple[float, float]]:
    """Return what a policy wants of some situations, one after the other."""
    rng = np.random.default_rng(4)
    wanted = []
    for _ in range(20):
        ranges = np.where(rng.random(180) < 0.5, rng.uniform(0.4, 3.0, 180), np.inf)
        command = policy.act(ranges, rng.uniform(-3.0, 3.0, (2, 2)), rng.uniform(-0.2, 0.5, 2), beta)
        assert command.wanted is not None
        wanted.append(command.wanted)
    return wanted


@pytest.mark.parametrize("row", ROWS)
def test_one_candidate_is_the_mean_itself(row: str) -> None:
    weights = agent(**ROWS[row])
    assert acting(Policy(weights, acting=ActingSettings(1, 3.0))) == acting(Policy(weights))
    assert acting(Policy(weights, acting=MANY)) != acting(Policy(weights))
    assert acting(Policy(weights, acting=MANY)) == acting(Policy(weights, acting=MANY))


def test_the_choice_is_never_worth_less_than_the_mean() -> None:
    """Of one critic and at the neutral beta, what is told is what was compared."""
    weights = agent(num_critics=1)
    by_mean, policy = Policy(weights), Policy(weights, acting=MANY)
    rng = np.random.default_rng(1)
    gains = []
    for _ in range(30):
        ranges = np.where(rng.random(180) < 0.5, rng.uniform(0.4, 3.0, 180), np.inf)
        given = ranges, rng.uniform(-3.0, 3.0, (2, 2)), rng.uniform(-0.2, 0.5, 2)
        by_mean.act(*given, 0.0)
        command = policy.act(*given, 0.0)
        chosen, mean = policy.foresee(0.0), policy.foresee(0.0, action=by_mean.foresee(0.0).action)
        assert (command.wanted, command.value) == (chosen.wanted, chosen.value)
        np.testing.assert_array_equal(command.quantiles, chosen.quantiles)
        gains.append(chosen.value - mean.value)
    assert min(gains) >= -1e-6
    assert np.mean(np.array(gains) > 1e-6) > 0.5


def test_it_foresees_and_copies_as_it_acts() -> None:
    policy = Policy(agent(2), acting=MANY)
    for beta in (-2.0, 0.0, -1.0):
        command = policy.act(OPEN, AHEAD, STANDING, beta)
        for other in (policy, copy.copy(policy)):
            other.foresee(-0.3)
            assert other.foresee(beta).wanted == command.wanted
    assert "chooses among 32 actions" in repr(policy)
    by_mean = copy.copy(policy)
    by_mean.acting = BY_MEAN
    assert by_mean.foresee(-1.0).wanted != policy.foresee(-1.0).wanted == command.wanted


class Risky:
    """Stands for critics: Z at tau = u_0 (gain + 2 tau - 1) of each."""

    def __init__(self, *gains: float) -> None:
        self.gains = gains

    def of_fractions(self, fractions: Array) -> Array:
        return fractions

    def gate(self, of_fractions: Array, embedded: float | None) -> Array:
        return of_fractions

    def means(self, read: Array, actions: Array, gate: Array) -> Array:
        return np.array([actions[:, 0] * (gain + 2.0 * gate.mean() - 1.0) for gain in self.gains])


def chosen_speed(beta: float, *gains: float, over: Any = "minimum") -> float:
    stand = SimpleNamespace(action=lambda read, embedded, noise: np.tanh(0.5 * noise))
    settings = ActingSettings(32, over_critics=over)
    choice = ActionChoice(settings, agent().config, cast(Actor, stand), cast(Critics, Risky(*gains)))
    return float(choice.best(np.zeros((3, 1), np.float32), beta, -0.5 * beta)[0])


def test_a_neutral_beta_takes_the_risky_action_and_an_averse_one_does_not() -> None:
    speeds = np.tanh(0.5 * ActingSettings(32).noise()[:, 0])
    assert chosen_speed(0.0, 0.2) == pytest.approx(speeds.max())
    assert chosen_speed(-2.0, 0.2) == pytest.approx(speeds.min())  # where the mean of psi is 1/4
    assert chosen_speed(0.0, 0.5, -0.3) == 0.0
    assert chosen_speed(0.0, 0.5, -0.3, over="mean") == pytest.approx(speeds.max())


# ------------------------------------------------------------------------------------------------ what is carried
def test_weights_carry_how_they_act_and_those_of_before_act_by_the_mean(tmp_path: Path) -> None:
    for name, content in packed(agent(acting=MANY)).items():
        (tmp_path / name).write_bytes(content)
    assert Policy(read_weights(tmp_path)).acting == MANY
    assert "| acts by | the best of 32 actions" in (tmp_path / "README.md").read_text()
    config = json.loads((tmp_path / "config.json").read_bytes())
    assert config.pop("acting") == {"num_candidates": 32, "spread": 2.0, "over_critics": "minimum", "margin_m": 0.0}
    # Those of before there was a margin do not say any.
    (tmp_path / "config.json").write_text(json.dumps(config | {"acting": {"num_candidates": 32, "spread": 2.0}}))
    assert Policy(read_weights(tmp_path)).acting == MANY
    assert config.pop("recalibration") is None
    (tmp_path / "config.json").write_text(json.dumps(config | {"format_version": 4}))
    assert Policy(read_weights(tmp_path)).acting == BY_MEAN


@pytest.mark.parametrize(
    ("values", "told"),
    [
        ({"num_candidates": 0}, "acting.num_candidates=0 must be at least 1"),
        ({"num_candidates": 10**6}, "acting.num_candidates=1000000 must be at most 4096"),
        ({"num_candidates": 2.5}, "acting.num_candidates=2.5 is no whole number"),
        ({"spread": 0.0}, "acting.spread=0 must be above 0 and at most 10"),
        ({"spread": float("nan")}, "acting.spread=nan must be above 0 and at most 10"),
        ({"spread": "wide"}, "acting.spread='wide' is no number"),
        ({"margin_m": -0.01}, r"acting.margin_m=-0.01 is outside \[0, 0.2\]: give metres"),
        ({"margin_m": 5}, r"acting.margin_m=5 is outside \[0, 0.2\]: give metres"),
        ({"over_critics": "median"}, "acting.over_critics=median is unknown: choose one of minimum, mean"),
    ],
)
def test_what_nobody_can_act_by_is_refused(values: dict[str, Any], told: str) -> None:
    for make in (ActingSettings, ActingOverride):
        with pytest.raises(UserInputError, match=told):
            make(**values)
    with pytest.raises(UserInputError, match=told):
        agent(acting=values)


def test_a_margin_needs_heads_that_look_ahead() -> None:
    careful = replace(MANY, margin_m=0.03)
    with pytest.raises(UserInputError, match=r"acting.margin_m=0.03 needs an agent with network.look_ahead=true"):
        agent(acting=careful)
    with pytest.raises(UserInputError, match=r"acting.margin_m=0.03 needs an agent with network.look_ahead=true"):
        Policy(agent(), acting=careful)
    assert Policy(agent(), acting=replace(careful, num_candidates=1)).acting.margin_m == 0.03  # not read
    assert str(careful).endswith("with a safety margin of 3 cm")
    assert "nearer" not in str(MANY)


def test_a_measure_that_numpy_does_not_know_cannot_choose() -> None:
    weights = agent()
    own = replace(weights, config=replace(weights.config, measure="own"))
    with pytest.raises(UserInputError, match=r"needs the risk measure 'own' in NumPy, which knows neutral, cvar, .*=1"):
        Policy(own, acting=MANY)
    Policy(own)
    Policy(agent(**ROWS["sac"], acting=MANY))
    assert PSI.keys() == MEASURES.keys()
