"""Calibration of agents as they drive: what is predicted is what a robot is told, what is earned is what was driven."""

import json
import pickle
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pytest
import torch
from torchrl.envs.utils import ExplorationType, set_exploration_type

import tiny
from rcdsac_trl.config.compose import compose
from rcdsac_trl.config.conditions import Condition
from rcdsac_trl.deploy import Policy
from rcdsac_trl.errors import UserInputError
from rcdsac_trl.evaluation.calibration import make_calibration
from rcdsac_trl.release.named_agent import named_agent
from rcdsac_trl.report.calibration_report import write_calibration
from rcdsac_trl.rollout.environments import environment, evaluation_worker
from rcdsac_trl.rollout.make_agent import make_policy
from rcdsac_trl.rollout.policies import AgentNoise
from rcdsac_trl.rollout.quantile_predictor import QuantilePredictor

GAMMA = 0.6  # of which 10 steps leave out 0.6 %
HORIZON = tiny.STEPS // 2
BETAS = [-2.0, -1.0]


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("driven") / "run"
    ahead = ["sensor.memory_s=9", "network.look_ahead=true", "network.restart_steps=4"]
    return tiny.untrained_run(folder, "rcdsac_pow", f"learner.gamma={GAMMA}", *ahead)[0]


def calibrate(run: Path, *overrides: str) -> Path:
    small = ["as_driven=true", "num_maps=2", "num_episodes=2", "every_steps=3", "num_workers=0", "threads=1"]
    calibration = make_calibration(compose("calibrate", [f"run={run}", "checkpoint=last", *small, *overrides]))
    calibration.run(write_calibration)
    return calibration.results.path


def read(folder: Path) -> tuple[pd.DataFrame, pd.DataFrame]:
    return pd.read_csv(folder / "predictions.csv"), pd.read_csv(folder / "returns.csv")


def test_what_is_predicted_is_what_a_robot_is_told(run: Path) -> None:
    named = named_agent(run, "last")
    loss, average = named.load()
    settings, policy = named.settings, Policy(named.weights(), guard=None)
    env = environment(
        settings.training_world,
        settings.algo,
        split="evaluation",
        seed=0,
        agent_ids=[0, 1],
        state_size=settings.network.state_size,
        conditions=[Condition(beta=-1.5)] * 2,
    )
    predictor = QuantilePredictor(loss.critics, [0, 1])
    acting = make_policy(average.module, AgentNoise([0, 1]), "cpu")
    tensordict = env.reset()
    with torch.no_grad(), set_exploration_type(ExplorationType.DETERMINISTIC):
        for _ in range(2 * settings.network.restart_steps + 1):
            tensordict = acting(tensordict)
            predicted = predictor.step(tensordict).numpy()
            policy.act_on(tensordict, -1.5)
            for agent, expected in enumerate(predicted):
                told = policy._agents(2)[agent].foresee(-1.5, action=tensordict["action"][agent].numpy())
                assert told.raw_quantiles == pytest.approx(expected, abs=2e-5)
            tensordict = env.step_mdp(env.step(tensordict))
    env.close()


def test_what_is_earned_is_the_discounted_reward_of_the_drive(run: Path, tmp_path: Path) -> None:
    folder = calibrate(run, f"beta=[{BETAS[0]},{BETAS[1]}]", f"out={tmp_path}")
    predictions, returns = read(folder)
    steps = list(range(0, tiny.STEPS - HORIZON, 3))
    assert len(predictions) == len(returns) == 2 * 2 * 2 * len(steps)
    assert predictions["step"].unique().tolist() == steps
    assert [name for name in predictions if name.startswith("q")] == [f"q{number}" for number in range(16)]
    assert "told0" not in predictions

    named = named_agent(run, "last")
    settings = named.settings
    conditions = [Condition(beta=beta) for beta in BETAS]
    worker = evaluation_worker(
        settings.training_world, settings.algo, conditions, "evaluation", 0, 2, settings.network.state_size
    )
    acting = make_policy(named.load()[1].module, AgentNoise([0, 1, 0, 1]), "cpu")
    with torch.no_grad(), set_exploration_type(ExplorationType.DETERMINISTIC):
        driven = worker.rollout(acting, 1, observed=(), happened=("reward",))
    worker.close()
    rewards = driven.done["reward"][..., 0].astype(np.float64)
    for beta, agents in zip(BETAS, ([0, 1], [2, 3]), strict=True):
        found = returns[(returns["beta"] == beta) & (returns["map"] == 1)].set_index(["episode", "step"])
        for episode, agent in enumerate(agents):
            for step in steps:
                expected = sum(GAMMA**t * rewards[agent, step + t] for t in range(HORIZON))
                assert found.loc[(episode, step), "discounted_reward"] == pytest.approx(expected, rel=1e-4, abs=1e-5)

    table = pd.read_csv(folder / "calibration.csv")
    assert table["beta"].tolist() == BETAS
    assert table["states"].tolist() == [2 * 2 * len(steps)] * 2
    mean = returns[returns["beta"] == -2.0]["discounted_reward"].mean()
    assert table["discounted_reward"].iloc[0] == pytest.approx(mean, rel=1e-5)
    assert table["crossing_rate"].tolist() == [0.0, 0.0]
    assert not (folder / "calibration-told.csv").exists()
    described = json.loads((folder / "calibration.json").read_text())
    assert (described["as_driven"], described["horizon_steps"], described["recalibration"]) == (True, HORIZON, None)


def test_it_drives_as_the_agent_acts_and_the_same_in_other_processes(
    run: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    by_mean = calibrate(run, "beta=[-1]", f"out={tmp_path / 'mean'}")
    choosing = ["beta=[-1]", "acting.num_candidates=6", "acting.spread=2.0", "half_precision=true"]
    alone = calibrate(run, *choosing, f"out={tmp_path / 'alone'}")

    def elsewhere(make: Any, num_maps: int, processes: int, watch: Any) -> Iterator[Any]:
        """Do what a process does, without the seconds that it takes to begin: with what travels to it, map 1 first."""
        with pickle.loads(pickle.dumps(make))() as drive:
            yield from (drive(map_index, lambda: None) for map_index in reversed(range(num_maps)))

    monkeypatch.setattr("rcdsac_trl.evaluation.calibration.evaluate_maps", elsewhere)
    other = calibrate(run, *choosing, f"out={tmp_path / 'other'}")
    for name in ("predictions.csv", "returns.csv", "calibration.json"):
        assert (alone / name).read_bytes() == (other / name).read_bytes()
    assert (read(by_mean)[1]["discounted_reward"] != read(alone)[1]["discounted_reward"]).any()
    described = json.loads((alone / "calibration.json").read_text())
    assert described["acting"] == {"num_candidates": 6, "spread": 2.0, "over_critics": "minimum", "margin_m": 0.0}
    digest = named_agent(run, "last", half_precision=True).described["weights_sha256"]
    assert described["weights_sha256"] == digest
    small = compose("calibrate", [f"run={run}", "as_driven=true", "checkpoint=last", *choosing])
    out = make_calibration(small).results.path
    assert out.parent == run / "calibration"
    assert out.name == "last-half-evaluation-seed0-20x3-driven-num_candidates_6-spread_2.0-beta_-1"


def test_what_says_nothing_of_a_drive_is_refused(run: Path, tiny_run: Path) -> None:
    with pytest.raises(UserInputError, match=r"horizon_steps=10 leaves out 90% .* allows 2%: that takes 390 steps"):
        calibrate(tiny_run)
    with pytest.raises(UserInputError, match=r"horizon_steps=7 leaves out 3% .* that takes 8 steps"):
        calibrate(run, "horizon_steps=7")
    with pytest.raises(UserInputError, match=r"cross_evaluate=true branches off from states: leave one out"):
        calibrate(run, "cross_evaluate=true")
    with pytest.raises(UserInputError, match=r"acting.spread says how an agent acts, and here its actions are drawn"):
        calibrate(run, "as_driven=false", "acting.spread=2")
    with pytest.raises(UserInputError, match="every_steps=0 must be at least 1"):
        calibrate(run, "every_steps=0")
    with pytest.raises(UserInputError, match=r"3000000 simulations: 84000\.0 GB .* lower num_episodes"):
        calibrate(run, "beta=[-1]", "num_episodes=3_000_000")
