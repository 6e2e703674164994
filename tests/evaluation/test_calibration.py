"""Calibration: critics whose quantiles are known, and roll-outs that really start from one state."""

import json
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
import torch
from omegaconf import OmegaConf

import tiny
from rcdsac_trl.config.calibration_settings import CalibrationSettings
from rcdsac_trl.config.compose import compose
from rcdsac_trl.config.conditions import Condition
from rcdsac_trl.config.run_config import read_config
from rcdsac_trl.errors import UserInputError
from rcdsac_trl.evaluation.branches import fractions, predict, roll_out
from rcdsac_trl.evaluation.calibration import make_calibration
from rcdsac_trl.release.named_agent import named_agent
from rcdsac_trl.report import calibration_report as measured
from rcdsac_trl.rollout.environments import environment
from rcdsac_trl.rollout.make_agent import make_loss

GAMMA = 0.9
STEPS = [3, 0]
ROLLOUTS = 3
HORIZON = 5


@pytest.fixture(scope="module")
def branches():
    settings = tiny.tiny_settings()
    loss = make_loss(settings, "cpu")
    env = environment(
        settings.training_world,
        settings.algo,
        split="evaluation",
        seed=0,
        agent_ids=[0] * ROLLOUTS + [1] * ROLLOUTS,
        state_size=settings.network.state_size,
        conditions=[Condition(beta=-1.0)] * (2 * ROLLOUTS),
    )
    rewards, poses = [], []
    step = env.step

    def watched(tensordict):
        out = step(tensordict)
        rewards.append(out["next", "reward"].flatten().double())
        poses.append(out["next", "pose"].clone())
        return out

    env.step = watched
    with torch.no_grad():
        out = roll_out(
            env,
            loss.actor_network,
            branch_steps=STEPS,
            num_rollouts=ROLLOUTS,
            num_blocks=1,
            horizon_steps=HORIZON,
            gamma=GAMMA,
            alpha=0.1,
            generator=torch.Generator().manual_seed(0),
            episode=0,
        )
    env.close()
    return loss, out, torch.stack(rewards, 1).view(2, ROLLOUTS, -1), torch.stack(poses, 1).view(2, ROLLOUTS, -1, 3)


def test_a_group_drives_as_one_up_to_its_step_and_apart_from_there(branches) -> None:
    _, _, _, poses = branches
    for group, step in enumerate(STEPS):
        together = poses[group, :, : step + 1]
        assert torch.equal(together, together[:1].expand_as(together))
        last = poses[group, :, -1]
        assert len({tuple(pose.tolist()) for pose in last}) == ROLLOUTS


def test_returns_are_discounted_from_the_branch_over_the_horizon(branches) -> None:
    _, out, rewards, _ = branches
    discounts = GAMMA ** torch.arange(HORIZON).double()
    for group, step in enumerate(STEPS):
        expected = rewards[group, :, step : step + HORIZON] @ discounts
        torch.testing.assert_close(out.discounted_reward[group], expected)
    # The first action was chosen before: its entropy does not count.
    assert not torch.equal(out.soft_return, out.discounted_reward)


def test_every_beta_is_rolled_out_with_the_same_noise() -> None:
    settings = tiny.tiny_settings()
    env = environment(
        settings.training_world,
        settings.algo,
        split="evaluation",
        seed=0,
        agent_ids=[0] * ROLLOUTS * 2,
        state_size=settings.network.state_size,
        conditions=[Condition(beta=-1.0)] * (2 * ROLLOUTS),
    )
    with torch.no_grad():
        out = roll_out(
            env,
            make_loss(settings, "cpu").actor_network,
            branch_steps=[2, 2],
            num_rollouts=ROLLOUTS,
            num_blocks=2,
            horizon_steps=3,
            gamma=GAMMA,
            alpha=0.1,
            generator=torch.Generator().manual_seed(0),
            episode=0,
        )
    env.close()
    first, second = out.soft_return
    torch.testing.assert_close(first, second)
    assert len(set(first.tolist())) == ROLLOUTS


def test_predictions_are_those_of_the_loss_on_the_same_window(branches) -> None:
    loss, out, _, _ = branches
    predicted = predict(loss, out.history, branch_steps=STEPS, risk=torch.full((2,), -1.0), memory_steps=2)
    window = {key: value[:1, 2:4] for key, value in out.history.items()}  # steps 2 and 3 of the first group
    memory = loss.critics[1][0].module(window["range"], window["waypoint"], window["velocity"])
    head = loss.critics[1][1].module
    expected = head(memory[:, -1:], window["action"][:, -1:], fractions().view(1, 1, -1), torch.full((1, 1, 1), -1.0))
    torch.testing.assert_close(predicted[1, 0], expected.flatten())


# ------------------------------------------------------------------------------------------------ what it says
def tables(quantiles: np.ndarray, returns: np.ndarray) -> tuple[pd.DataFrame, pd.DataFrame]:
    """Lay arrays out as the two files."""
    keys = [{"beta": -1.0, "map": g, "state": 0, "step": 5} for g in range(len(quantiles))]
    rows = [
        key | {"whole_history_mean": 0.0} | {f"q{i}": q for i, q in enumerate(row)}
        for key, row in zip(keys, quantiles, strict=True)
    ]
    earned = [
        key | {"rollout": m, "soft_return": value}
        for key, row in zip(keys, returns, strict=True)
        for m, value in enumerate(row)
    ]
    return pd.DataFrame(rows), pd.DataFrame(earned)


def test_true_quantiles_are_found_true_and_a_shift_is_found_to_be_one() -> None:
    rng = np.random.default_rng(0)
    middle = rng.normal(30.0, 8.0, (400, 1))
    q = torch.special.ndtri(fractions().double()).numpy() * 3.0
    returns = middle + rng.normal(0.0, 3.0, (400, 8))
    row = measured.calibration_table(*tables(middle + q, returns), 0.99, 400).iloc[0]
    assert abs(row.bias) < 0.2
    for fraction in measured.COVERED:
        assert row[f"coverage_{fraction:g}"] == pytest.approx(fraction, abs=0.02)
    assert row.scatter == pytest.approx(row.predicted_scatter, rel=0.03)
    # The mean of a normal distribution's worst tenth lies 1.755 standard deviations below the mean.
    assert row.tail_depth == pytest.approx(3.0 * 1.755, rel=0.05)
    assert row.predicted_tail_depth == pytest.approx(3.0 * 1.755, rel=0.02)
    assert row.crossing_rate == 0.0

    shifted = measured.calibration_table(*tables(middle + q - 30.0, returns), 0.99, 400).iloc[0]
    assert shifted.bias == pytest.approx(row.bias - 30.0)
    assert shifted["coverage_0.9"] == 0.0
    for fraction in measured.COVERED:
        name = f"recentred_coverage_{fraction:g}"
        assert shifted[name] == pytest.approx(row[name])
    assert shifted.correlation > 0.98


def test_calibration_by_hand() -> None:
    quantiles = np.array([[0.0, 2.0, 1.0, 5.0], [10.0, 10.0, 10.0, 10.0]])
    returns = np.array([[1.0, 3.0], [12.0, 14.0]])
    row = measured.calibration_table(*tables(quantiles, returns), 0.5, 2).iloc[0]
    assert (row.soft_return, row.predicted, row.bias) == (7.5, 6.0, -1.5)
    assert row.missing == pytest.approx(7.5 * 0.25 / 0.75)
    assert row.scatter == pytest.approx(np.std([-1.0, 1.0, 2.0, 4.0]))
    assert row.rollout_scatter == pytest.approx(np.sqrt(2.0))
    assert row.crossing_rate == pytest.approx(1 / 6)
    assert row.crossing_depth == pytest.approx(0.5)
    assert row.tail_depth == pytest.approx(1.5 + 1.0)  # 0.4 of a value: the worst alone
    # At 0.5, between the second and the third: 1.5 and 10; the return 1 alone lies below.
    assert row["coverage_0.5"] == 0.25


# ------------------------------------------------------------------------------------------------ the command
def calibrate(run: Path, *overrides: str):
    given = [f"run={run}", "num_states=2", "num_rollouts=2", "horizon_steps=8", "threads=1", *overrides]
    return make_calibration(compose("calibrate", given))


def test_a_calibration_writes_the_same_whoever_drives(tiny_run: Path, tmp_path: Path) -> None:
    outs = []
    for workers in (0, 2):
        calibration = calibrate(
            tiny_run, "beta=[-2,0]", "num_maps=2", f"num_workers={workers}", f"out={tmp_path / str(workers)}"
        )
        calibration.run()
        outs.append(calibration.results.path)
    for name in ("predictions.csv", "returns.csv", "calibration.json"):
        assert (outs[0] / name).read_bytes() == (outs[1] / name).read_bytes()
    predictions, returns = pd.read_csv(outs[0] / "predictions.csv"), pd.read_csv(outs[0] / "returns.csv")
    assert (len(predictions), len(returns)) == (2 * 2 * 2, 2 * 2 * 2 * 2)
    assert measured.write_calibration(outs[0])
    table = pd.read_csv(outs[0] / "calibration.csv")
    assert table["beta"].tolist() == [-2.0, 0.0]
    assert table["soft_return"].iloc[0] == pytest.approx(returns[returns.beta == -2].soft_return.mean(), rel=1e-5)
    assert (outs[0] / "calibration.png").stat().st_size > 10_000


def test_an_exported_agent_brings_what_a_calibration_needs(tiny_run: Path, tmp_path: Path) -> None:
    folder = tiny.exported(tiny_run, tmp_path / "agent")
    (loss, average), critics = named_agent(tiny_run).load(), named_agent(folder).load_critics()
    assert critics.alpha.item() == pytest.approx(loss.alpha.item(), rel=1e-6)
    assert critics.alpha.item() != make_loss(tiny.tiny_settings(), "cpu").alpha.item()  # learnt, not the config's
    trained, found = loss.state_dict(), critics.state_dict()
    names = [name for name in trained if name.startswith("critic_network_params.")]
    assert names
    assert all(torch.equal(trained[name], found[name]) for name in names)
    for name, value in average.module.state_dict().items():  # it drives: the learning actor is not exported
        assert torch.equal(found[f"actor_network_params.{name}"], value)
    calibration = calibrate(folder, "beta=[-1]", "num_maps=1", "num_workers=0")
    calibration.run()
    assert calibration.results.path.parent == folder / "calibration"
    assert len(pd.read_csv(calibration.results.path / "predictions.csv")) == 2


def test_a_horizon_fits_the_task_and_betas_the_row(tiny_run: Path) -> None:
    calibration = make_calibration(compose("calibrate", [f"run={tiny_run}", "num_workers=0"]))
    described = json.loads(calibration.results.described)
    assert described["horizon_steps"] == tiny.STEPS // 2
    assert described["conditions"] == ["beta=-2", "beta=-1.5", "beta=-1", "beta=-0.5"]
    settings = read_config(compose("calibrate", []), CalibrationSettings)
    assert [settings.horizon_in(steps) for steps in (1000, 21, 2)] == [500, 10, 1]
    with pytest.raises(UserInputError, match=r"^horizon_steps=1 must be below the 1 steps of an episode"):
        settings.horizon_in(1)


def test_what_cannot_be_calibrated_is_refused(tiny_run: Path, tmp_path: Path) -> None:
    with pytest.raises(UserInputError, match=r"horizon_steps=20 must be below the 20 steps"):
        calibrate(tiny_run, "beta=[-1]", "horizon_steps=20")
    # Of 3 states and in one process; a simulation takes 28 MB.
    with pytest.raises(UserInputError, match=r"3000000 simulations: 84000\.0 GB .* lower num_rollouts"):
        calibrate(tiny_run, "beta=[-1]", "num_states=3", "num_rollouts=1_000_000", "num_workers=0")
    with pytest.raises(UserInputError, match=r"before does not say at which temperature .* export the agent"):
        calibrate(tiny.agent_of_before(tmp_path / "before"), "beta=[-1]")
    with pytest.raises(UserInputError, match="run=<folder>"):
        make_calibration(compose("calibrate", []))
    OmegaConf.save(tiny.tiny_cfg("sac"), tmp_path / "config.yaml", resolve=True)
    with pytest.raises(UserInputError, match="scalar critics"):
        calibrate(tmp_path)
