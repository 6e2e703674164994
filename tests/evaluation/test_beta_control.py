"""Controllers of beta: their closed forms, and evaluations and robots that are driven by them."""

import json
import math
import shutil
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pytest

from rcdsac_trl.deploy import ClearanceBeta, FixedBeta, Policy, TailVarianceBeta
from rcdsac_trl.deploy.policy.beta_controllers import lower_tail_variance
from rcdsac_trl.errors import UserInputError
from rcdsac_trl.evaluation.film import filming
from rcdsac_trl.evaluation.film.recording import Moment
from rcdsac_trl.robot.observation import range_distances, range_observation
from rcdsac_trl.robot.range_sensor import sensor_mask
from robots import AHEAD, ROWS, STANDING, full_size
from tiny import STEPS, evaluate

NOTHING = np.full(180, np.inf)


def seen(distance_m: float, sector: int = 0) -> np.ndarray:
    return np.where(np.arange(180) == sector, distance_m, 2.5)


# ------------------------------------------------------------------------------------------------ closed forms
@pytest.mark.parametrize(
    ("nearest_m", "beta"), [(0.1, -2.0), (0.4, -2.0), (0.6, -1.5), (0.8, -1.0), (1.2, 0.0), (2.9, 0.0), (math.inf, 0.0)]
)
def test_clearance_is_linear_between_its_distances(nearest_m: float, beta: float) -> None:
    controller = ClearanceBeta(-2.0, 0.0, near_m=0.4, far_m=1.2)
    assert controller(seen(nearest_m, 90), None) == pytest.approx(beta)


def test_clearance_looks_where_the_agent_does() -> None:
    controller = ClearanceBeta(-2.0, 0.0, near_m=0.4, far_m=1.2, sensor="narrow")
    assert controller(seen(0.4, 90), None) == 0.0
    assert controller(seen(0.4, 10), None) == -2.0


def test_the_lower_tail_is_measured_from_the_median() -> None:
    assert lower_tail_variance(np.array([1.0, 2.0, 3.0, 4.0, 5.0])) == pytest.approx((2**2 + 1**2) / 2)
    assert lower_tail_variance(np.array([3.0, 1.0, 2.0, 5.0, 4.0])) == pytest.approx(2.5)  # crossed
    # What is above the median does not matter.
    assert lower_tail_variance(np.array([0.0, 4.0, 6.0, 1e6])) == lower_tail_variance(np.array([0.0, 4.0, 6.0, 6.0]))


def tails(*variances: float) -> list[np.ndarray]:
    return [np.array([-math.sqrt(v), 0.0, math.sqrt(v)]) for v in variances]


def test_tail_variance_ranks_among_the_last_steps() -> None:
    controller = TailVarianceBeta(-2.0, 0.0, window_steps=3)
    assert controller(NOTHING, None) == -1.0
    told = [controller(NOTHING, tail) for tail in tails(4.0, 9.0, 1.0, 4.0, 0.0)]
    # Shares of shorter tails, ties half: 1/2; 3/4; 1/6; of (4, 9, 1), the first 4 gone: 1/2; of (4, 0, 1): 1/6.
    assert told == pytest.approx([-1.0, -1.5, -1 / 3, -1.0, -1 / 3])
    controller.reset()
    assert controller(NOTHING, tails(0.0)[0]) == -1.0


def test_controllers_refuse_what_makes_no_sense() -> None:
    for make in (ClearanceBeta, TailVarianceBeta):
        with pytest.raises(UserInputError, match="low=0 is above high=-2"):
            make(0.0, -2.0)
        with pytest.raises(UserInputError, match="low=-inf and high=0 are not both finite"):
            make(-math.inf, 0.0)
    with pytest.raises(UserInputError, match="near_m below far_m"):
        ClearanceBeta(-2.0, 0.0, near_m=2.0, far_m=1.0)
    with pytest.raises(UserInputError, match="window_steps=1 is below 2"):
        TailVarianceBeta(-2.0, 0.0, window_steps=1)


@pytest.mark.parametrize("quantiles", [[1.0], [], [1.0, math.nan], [-math.inf, 1.0], 3.0, [[1.0, 2.0]]])
def test_what_has_no_lower_tail_makes_nobody_bold(quantiles: Any) -> None:
    with pytest.raises(UserInputError, match="have no lower half that is finite"):
        TailVarianceBeta(-2.0, 0.0)(NOTHING, np.array(quantiles))


def test_distances_come_back_from_observations() -> None:
    distances = np.random.default_rng(0).uniform(0.02, 4.0, 180)
    mask = sensor_mask("narrow")
    back = range_distances(range_observation(distances, mask))
    known = mask & (distances < 3.0)
    np.testing.assert_allclose(back[known], distances[known], rtol=1e-5)
    assert np.isinf(back[~known]).all()


# ------------------------------------------------------------------------------------------------ on a robot
def test_a_robot_is_driven_by_the_beta_of_its_controllers() -> None:
    policy, told = (
        Policy(full_size(**ROWS["rcdsac_pow"]), guard=None),
        Policy(full_size(**ROWS["rcdsac_pow"]), guard=None),
    )
    clearance, tail = ClearanceBeta(-2.0, 0.0, sensor="narrow"), TailVarianceBeta(-2.0, 0.0)
    quantiles, betas = None, []
    for step in range(20):
        distances = seen(0.3 + 0.05 * step)
        beta = min(clearance(distances, quantiles), tail(distances, quantiles))
        command = policy.act(distances, AHEAD, STANDING, beta=beta)
        assert not command.stopped
        assert command.wanted == told.act(distances, AHEAD, STANDING, beta).wanted
        quantiles = command.raw_quantiles
        betas.append(beta)
    assert betas[0] == -2.0  # something is near
    assert len(set(betas)) > 5


# ------------------------------------------------------------------------------------------------ in an evaluation
@pytest.fixture(scope="module")
def run(tiny_run: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("adaptive") / "run"
    shutil.copytree(tiny_run, folder)
    return folder


ALL = ["beta=[-2,-1,-0.5]", "num_maps=3", "beta_controller=[clearance,tail_variance]"]


@pytest.fixture(scope="module")
def out(run: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    return evaluate(f"run={run}", *ALL, f"out={tmp_path_factory.mktemp('controlled')}")


def test_fixed_betas_are_what_they_are_without_controllers(run: Path, out: Path, tmp_path: Path) -> None:
    plain = pd.read_csv(evaluate(f"run={run}", *ALL[:2], f"out={tmp_path}") / "episodes.csv")
    controlled = pd.read_csv(out / "episodes.csv")
    fixed = controlled[controlled["beta_controller"].isna()]
    assert (fixed["mean_beta"] == fixed["beta"]).all()
    pd.testing.assert_frame_equal(fixed[list(plain)], plain)


def test_every_controller_meets_every_episode(out: Path) -> None:
    episodes = pd.read_csv(out / "episodes.csv")
    assert episodes["beta_controller"].dropna().unique().tolist() == ["clearance", "tail_variance"]
    for _, rows in episodes[episodes["beta"].isna()].groupby("beta_controller"):
        assert list(zip(rows["map"], rows["episode"], strict=True)) == [(m, e) for m in range(3) for e in range(2)]
        assert rows["mean_beta"].between(-2.0, -0.5).all()
    turned = episodes.groupby("beta_controller")["mean_beta"]
    assert (turned.nunique() > 3).all()
    summary = pd.read_csv(out / "summary.csv")
    assert summary["episodes"].tolist() == [6] * 5
    assert "mean_beta_mean" in summary
    described = json.loads((out / "evaluation.json").read_text())
    assert described["conditions"] == ["beta=-2", "beta=-1", "beta=-0.5", "clearance", "tail_variance"]
    assert described["controller"]["near_m"] == 0.4


def test_processes_do_not_change_what_controllers_do(run: Path, out: Path, tmp_path: Path) -> None:
    again = evaluate(f"run={run}", *ALL, f"out={tmp_path}", "num_workers=2")
    for name in ("episodes.csv", "summary.csv", "collisions.csv", "evaluation.json"):
        assert (again / name).read_bytes() == (out / name).read_bytes()


def test_a_film_shows_how_beta_turns(run: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    filmed: list[list[list[Moment]]] = []
    original = filming.recorded
    monkeypatch.setattr(filming, "recorded", lambda *given: filmed.append(original(*given)) or filmed[0])
    monkeypatch.setattr(filming, "write_video", lambda *_: [])
    out = evaluate(f"run={run}", *ALL, f"out={tmp_path}", "record=true", "video.map=2")
    episodes = pd.read_csv(out / "episodes.csv").query("map == 2 and episode == 0")
    assert len(filmed[0]) == 5
    for track, mean_beta in zip(filmed[0], episodes["mean_beta"], strict=True):
        assert np.mean([moment.beta for moment in track]) == pytest.approx(mean_beta, rel=1e-6)
        assert len(track) == STEPS
    assert isinstance(FixedBeta(-1.0)(NOTHING, None), float)
