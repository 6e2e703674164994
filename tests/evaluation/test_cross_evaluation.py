"""Cross-evaluation: one state for every beta, and matrices whose answer is known."""

from pathlib import Path

import numpy as np
import pandas as pd
import pytest
import torch

import tiny
from rcdsac_trl.agent.actor import STATE_KEY
from rcdsac_trl.agent.risk import CVaR
from rcdsac_trl.config.compose import compose
from rcdsac_trl.config.conditions import Condition
from rcdsac_trl.errors import UserInputError
from rcdsac_trl.evaluation.branches import roll_out
from rcdsac_trl.evaluation.calibration import make_calibration
from rcdsac_trl.evaluation.cross_evaluation import cross_evaluate, cross_tables
from rcdsac_trl.report import cross_evaluation_report as crossed
from rcdsac_trl.report.calibration_report import write_calibration
from rcdsac_trl.rollout.environments import environment
from rcdsac_trl.rollout.make_agent import make_loss

BETAS = [-2.0, 0.0]
STEPS = [4, 2]
ROLLOUTS = 3
HORIZON = 5
GAMMA = 0.9
MAP = 1


class Watched:
    """Agents of both betas, and what they do: beta, state, roll-out and step."""

    def __init__(self) -> None:
        settings = tiny.tiny_settings()
        self.actor = make_loss(settings, "cpu").actor_network
        self.env = environment(
            settings.training_world,
            settings.algo,
            split="evaluation",
            seed=0,
            agent_ids=[state for state in range(2) for _ in range(ROLLOUTS)] * 2,
            state_size=settings.network.state_size,
            conditions=[Condition(beta=beta) for beta in BETAS for _ in range(2 * ROLLOUTS)],
        )
        self._seen: dict[str, list[torch.Tensor]] = {"action": [], "pose": [], "memory": [], "reward": []}
        self._step, self.env.step = self.env.step, self._watch

    def _watch(self, tensordict):
        out = self._step(tensordict)
        for key, value in {
            "action": tensordict["action"],
            "pose": tensordict["pose"],
            "memory": tensordict[STATE_KEY].flatten(1),
            "reward": out["next", "reward"].double(),
        }.items():
            self._seen[key].append(value.clone())
        return out

    def __getitem__(self, key: str) -> torch.Tensor:
        return torch.stack(self._seen[key], 1).unflatten(0, (2, 2, ROLLOUTS))


def common(values: torch.Tensor) -> bool:
    """Say whether all betas' roll-outs of a state are alike, ``[betas, rollouts, steps, ..]``."""
    return torch.allclose(values, values[:1, :1].expand_as(values), rtol=0.0, atol=1e-6)


@pytest.fixture(scope="module")
def driven():
    watched = Watched()
    rows = cross_evaluate(
        watched.env,
        watched.actor,
        betas=BETAS,
        branch_steps=STEPS,
        num_rollouts=ROLLOUTS,
        horizon_steps=HORIZON,
        gamma=GAMMA,
        generator=torch.Generator().manual_seed(0),
        map_index=MAP,
    )
    watched.env.close()
    return watched, rows


def test_every_beta_takes_over_from_one_state_with_one_memory(driven) -> None:
    watched, _ = driven
    for state, step in enumerate(STEPS):
        assert common(watched["pose"][:, state, :, : step + 1])
        assert common(watched["memory"][:, state, :, : step + 1])
        assert watched["memory"][0, state, 0, step].abs().max() > 0.0
        actions = watched["action"][:, state, :, step]
        assert len({tuple(action.tolist()) for action in actions.flatten(0, 1)}) == 2 * ROLLOUTS


def test_betas_take_turns_at_leading_to_a_state(driven) -> None:
    """Up to the state all do, bit by bit, what agents of one beta do by themselves under the same noise."""
    watched, rows = driven
    alone = Watched()
    with torch.no_grad():
        roll_out(
            alone.env,
            alone.actor,
            branch_steps=STEPS * 2,
            num_rollouts=ROLLOUTS,
            num_blocks=2,
            horizon_steps=HORIZON,
            gamma=GAMMA,
            alpha=0.0,
            generator=torch.Generator().manual_seed(0),
            episode=MAP,
        )
    alone.env.close()
    turns = [1, 0]  # map 1 begins with the second beta
    assert [row["history_beta"] for row in rows] == [BETAS[turn] for turn in turns] * 2
    assert not torch.equal(alone["action"][0, 0], alone["action"][1, 0])
    for state, (step, turn) in enumerate(zip(STEPS, turns, strict=True)):
        for beta in range(2):
            assert torch.equal(watched["action"][beta, state, :, :step], alone["action"][turn, state, :, :step])


def test_what_is_judged_is_the_discounted_reward_from_the_state_on(driven) -> None:
    watched, rows = driven
    discounts = GAMMA ** torch.arange(HORIZON).double()
    for row, (beta, state) in zip(rows, [(0, 0), (0, 1), (1, 0), (1, 1)], strict=True):
        assert (row["beta"], row["state"], row["step"], row["map"]) == (BETAS[beta], state, STEPS[state], MAP)
        earned = watched["reward"][beta, state, :, STEPS[state] : STEPS[state] + HORIZON, 0] @ discounts
        torch.testing.assert_close(torch.tensor(row["discounted_rewards"], dtype=torch.float64), earned)


# ------------------------------------------------------------------------------------------------ what it says
def tables(tmp_path: Path, earned: np.ndarray) -> tuple[pd.DataFrame, pd.DataFrame]:
    """Write returns ``[maps, 2 betas, states, 4]`` as a calibration does, and read them back."""
    rows = [
        {"beta": beta, "map": m, "state": s, "step": 3, "history_beta": 1.0, "discounted_rewards": list(returns)}
        for b, beta in enumerate((0.25, 1.0))
        for m, states in enumerate(earned[:, b])
        for s, returns in enumerate(states)
    ]
    for name, text in cross_tables(rows, CVaR()).items():
        (tmp_path / name).write_text(text)
    return pd.read_csv(tmp_path / "cross_returns.csv"), pd.read_csv(tmp_path / "cross_distortion.csv")


def test_both_readings_by_hand(tmp_path: Path) -> None:
    careful = [[[1.0, 3.0, 3.0, 3.0]], [[5.0, 4.0, 5.0, 6.0]]]
    bold = [[[0.0, 8.0, 8.0, 8.0]], [[9.0, 9.0, 1.0, 9.0]]]
    earned = np.stack([careful, bold], 1)
    values = crossed.cross_values(*tables(tmp_path, earned))
    # CVaR 0.25 of a state's four is the least; of all eight the mean of the two least. CVaR 1 is the mean.
    np.testing.assert_allclose(values["state"].value, [[2.5, 0.5], [3.75, 6.5]])
    np.testing.assert_allclose(values["all"].value, [[2.0, 0.5], [3.75, 6.5]])
    np.testing.assert_allclose(values["state"].advantage, [[0.0, -2.0], [-2.75, 0.0]])
    # Two maps drawn with replacement: now and then one of them twice.
    np.testing.assert_allclose(values["state"].advantage_bounds[:, 0, 1], [-3.0, -1.0])
    np.testing.assert_allclose(values["all"].value_bounds[:, 0, 0], [1.0, 4.5], atol=0.5)


def test_a_dial_that_works_and_one_turned_round_are_told_apart(tmp_path: Path) -> None:
    rng = np.random.default_rng(0)
    difficulty = rng.normal(20.0, 10.0, (12, 1, 1, 1))
    noise = rng.normal(0.0, 1.0, (12, 1, 3, 4))
    careful, bold = difficulty + 0.2 * noise, difficulty + 1.0 + 4.0 * noise
    works = crossed.cross_values(*tables(tmp_path, np.concatenate([careful, bold], 1)))["state"]
    assert crossed.answer(works) == (
        "the diagonal is best, within its interval, in 2 of 2 rows; it has the highest value in 2 (by chance: 1), "
        "is clearly above 2 of 2 other cells and clearly below 0."
    )
    # Maps differ by more than betas do, yet the same maps met both.
    width = np.diff(works.value_bounds, axis=0)[0]
    assert (np.diff(works.advantage_bounds, axis=0)[0] < 0.5 * width).all()
    reversed_ = crossed.cross_values(*tables(tmp_path, np.concatenate([bold, careful], 1)))["state"]
    assert "in 0 of 2 rows" in crossed.answer(reversed_)
    assert "clearly above 0 of 2 other cells and clearly below 2." in crossed.answer(reversed_)


# ------------------------------------------------------------------------------------------------ the command
def calibrate(run: Path, *overrides: str):
    given = [f"run={run}", "num_states=2", "num_rollouts=2", "horizon_steps=8", "threads=1", "cross_evaluate=true"]
    return make_calibration(compose("calibrate", [*given, *overrides]))


def test_calibrate_writes_it_on_demand(tiny_run: Path, tmp_path: Path) -> None:
    plain = calibrate(tiny_run, "beta=[-2,0]", "num_maps=2", "num_workers=0", "cross_evaluate=false")
    assert "cross" not in plain.results.described  # so that folders of before are still the same work's
    assert calibrate(tiny_run, "beta=[-2,0]").results.path.name.startswith("best-evaluation-seed0-20x2-cross-beta_-2")
    calibrate(tiny_run, "beta=[-2,0]", "num_maps=2", "num_workers=0", f"out={tmp_path}").run()
    assert len(pd.read_csv(tmp_path / "predictions.csv")) == 2 * 2 * 2
    said = write_calibration(tmp_path)
    assert "In a state, the diagonal is best" in said
    assert "Over all states, the diagonal is best" in said
    table = pd.read_csv(tmp_path / "cross_evaluation.csv")
    assert len(table) == 2 * 2 * 2
    returns = pd.read_csv(tmp_path / "cross_returns.csv")
    neutral = table[(table.reading == "state") & (table.judging_beta == 0) & (table.driving_beta == -2)]
    assert neutral["value"].item() == pytest.approx(returns[returns.beta == -2].discounted_reward.mean(), rel=1e-5)
    assert (tmp_path / "cross_evaluation.png").stat().st_size > 10_000


def test_a_cross_evaluation_of_nothing_is_refused(tiny_run: Path) -> None:
    with pytest.raises(UserInputError, match=r"cross_evaluate=true holds values of beta against each other.*beta="):
        calibrate(tiny_run, "beta=[-1]")
    with pytest.raises(UserInputError, match="num_maps=1 has none: give at least 2"):
        calibrate(tiny_run, "beta=[-2,0]", "num_maps=1")
