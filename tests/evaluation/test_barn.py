"""BARN's protocol: who drives straight arrives where nothing stands in the way, and the score is what one reckons."""

import json
import math
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pytest
from world_files import write_world

from rcdsac_trl.config.compose import compose
from rcdsac_trl.config.evaluation_settings import EvaluationSettings
from rcdsac_trl.config.first_look import look_at_evaluation
from rcdsac_trl.config.named_folder import default_training
from rcdsac_trl.config.run_config import read_config, settings_of_new_run
from rcdsac_trl.errors import UserInputError
from rcdsac_trl.evaluation.barn_runs import run_metrics
from rcdsac_trl.evaluation.evaluation import make_evaluation
from rcdsac_trl.report.barn_report import describe_evaluation, write_barn
from rcdsac_trl.rollout.collisions import COLLISIONS
from rcdsac_trl.world.maps.files.barn import optimal_time_s

SIDES = [(x, y, 0.075) for x in (-4.5, 0.0) for y in np.arange(0.0, 9.6, 0.5).tolist()]
# A way of 10 m straight ahead: two cells in the middle column of a world.
STRAIGHT = np.array([[15.5, 0.0], [15.5, 30.0]])


@pytest.fixture
def worlds(tmp_path: Path) -> Path:
    """Two of the protocol's worlds: an empty one, one with a post in the way; and one of another number."""
    folder = tmp_path / "worlds"
    folder.mkdir()
    for number, more in ((6, []), (12, [(-2.25, 6.0, 0.3)]), (13, [])):
        write_world(folder / f"world_{number}.world", [*SIDES, *more])
        np.save(folder / f"path_{number}.npy", STRAIGHT)
    return folder


def evaluate_pursuit(worlds: Path, out: Path, *given: str) -> Path:
    overrides = ["baseline=pursuit", "map=barn", f"map.path={worlds}", "num_episodes=2", "num_workers=0", f"out={out}"]
    make_evaluation(compose("evaluate", [*overrides, *given])).run(describe_evaluation)
    return out


def test_pursuit_arrives_where_nothing_is_in_the_way_and_collides_with_what_nobody_knows(
    worlds: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    folder = evaluate_pursuit(worlds, tmp_path / "out")
    assert sorted(path.name for path in folder.iterdir()) == ["barn.json", "runs.csv", "summary.csv", "worlds.csv"]
    runs = pd.read_csv(folder / "runs.csv")
    assert runs[["world", "run"]].to_numpy().tolist() == [[6, 0], [6, 1], [12, 0], [12, 1]]
    free, blocked = runs[runs["world"] == 6], runs[runs["world"] == 12]
    assert (free["success"] == 1).all()
    assert (blocked["collision"] == 1).all()
    assert (runs[["success", "collision", "timeout"]].sum(axis=1) == 1).all()
    # 9 m until the goal is within 1 m, at 0.6 m/s and a little for getting there; 5 s is optimal for 10 m at 2 m/s.
    assert (free["time_s"] - 15.0).between(0.0, 1.0).all()
    assert blocked["time_s"].isna().all()
    np.testing.assert_allclose(free["score"], 5.0 / 20.0)  # faster than four times the optimal time
    np.testing.assert_allclose(free["later_score"], 5.0 / free["time_s"], rtol=1e-5)
    assert (blocked[["score", "later_score"]] == 0).all(axis=None)
    summary = pd.read_csv(folder / "summary.csv").iloc[0]
    assert (summary["runs"], summary["success"], summary["collision"]) == (4, 0.5, 0.5)
    assert (summary["success_low"], summary["success_high"]) == (0.0, 1.0)  # one world of two
    described = json.loads((folder / "barn.json").read_text())
    assert (described["num_maps"], described["task"]["goal_radius_m"]) == (2, 1.0)
    assert [line.split("  ")[1].split("/")[-1] for line in described["map"]["sha256"]] == [
        "world_6.world",
        "world_12.world",
    ]
    told = capsys.readouterr().out
    assert "pursuit" in told
    assert "2 of the protocol's 50 worlds" in told
    assert "DRL-VO" in told
    assert "knew the cylinders" not in told


def test_what_the_planner_knows_is_driven_around(worlds: Path, tmp_path: Path) -> None:
    runs = pd.read_csv(evaluate_pursuit(worlds, tmp_path / "out", "map.mapped=true") / "runs.csv")
    assert (runs["success"] == 1).all()
    blocked = runs[runs["world"] == 12]["time_s"].min()
    assert blocked > runs[runs["world"] == 6]["time_s"].max()


def test_an_evaluation_of_the_protocol_ends_with_its_trips(worlds: Path, tmp_path: Path) -> None:
    steps: list[int] = []
    overrides = ["baseline=pursuit", "map=barn", f"map.path={worlds}", "num_maps=1", "num_episodes=2", "num_workers=0"]
    evaluation = make_evaluation(compose("evaluate", [*overrides, f"out={tmp_path / 'out'}"]))
    rows = next(evaluation.measure(steps.append))
    slowest_s = max(row["time_to_goal_s"] for row in rows)
    assert slowest_s / 0.16 + 1 <= steps[-1] <= slowest_s / 0.12 + 2 < 834 / 4
    assert len({row["time_to_goal_s"] for row in rows}) == 2  # control periods differ


def row(**given: Any) -> dict[str, Any]:
    return {"success": 0.0, "collided": 0.0, "time_to_goal_s": math.nan, COLLISIONS: [], **given}


@pytest.mark.parametrize(
    ("of_episode", "expected"),
    [
        # Between four and eight times the optimal time of 5 s it is their ratio, beyond eight times an eighth.
        (row(success=1.0, time_to_goal_s=25.0), (1, 0, 0, 0.2, 0.2)),
        (row(success=1.0, time_to_goal_s=90.0), (1, 0, 0, 0.125, 0.125)),
        (row(success=1.0, time_to_goal_s=8.0), (1, 0, 0, 0.25, 0.5)),
        (row(success=1.0, time_to_goal_s=100.2), (0, 0, 1, 0.0, 0.0)),
        (row(collided=1.0, **{COLLISIONS: [{"time_s": 99.0}, {"time_s": 120.0}]}), (0, 1, 0, 0.0, 0.0)),
        (row(collided=1.0, **{COLLISIONS: [{"time_s": 101.0}]}), (0, 0, 1, 0.0, 0.0)),
        (row(collided=1.0, time_to_goal_s=30.0, **{COLLISIONS: [{"time_s": 9.0}]}), (0, 1, 0, 0.0, 0.0)),
        (row(), (0, 0, 1, 0.0, 0.0)),
    ],
)
def test_the_metrics_of_a_run(of_episode: dict[str, Any], expected: tuple[float, ...]) -> None:
    found = run_metrics(of_episode, optimal_s=5.0)
    names = ("success", "collision", "timeout", "score", "later_score")
    assert tuple(found[name] for name in names) == expected
    assert math.isnan(found["time_s"]) == (not found["success"])


def test_conditions_are_told_apart(tmp_path: Path) -> None:
    rows = [
        {"beta": beta, "world": world, "run": run, "success": 1.0, "collision": 0.0, "timeout": 0.0}
        | {"time_s": 20.0 - beta, "score": 0.25, "later_score": 0.3}
        for beta in (-2.0, -1.0)
        for world in (0, 6)
        for run in range(3)
    ]
    pd.DataFrame(rows).to_csv(tmp_path / "runs.csv", index=False)
    (tmp_path / "barn.json").write_text('{"agent": "rcdsac_pow", "map": {"mapped": true}}')
    told = write_barn(tmp_path).splitlines()
    assert [line.split()[:2] for line in told[1:3]] == [["rcdsac_pow", "beta=-2"], ["rcdsac_pow", "beta=-1"]]
    assert "here the planner knew the cylinders" in told[-1]
    assert pd.read_csv(tmp_path / "summary.csv")["time_s"].tolist() == [22.0, 21.0]
    assert len(pd.read_csv(tmp_path / "worlds.csv")) == 4


def test_the_protocol_is_no_place_to_train_in(worlds: Path) -> None:
    with pytest.raises(UserInputError, match=r"map=barn is a test, which `evaluate` drives: train on other worlds"):
        settings_of_new_run(compose("train", ["+algo=sac", "map=barn", f"map.path={worlds}"]))


def test_missing_worlds_are_told_before_anything_is_driven(tmp_path: Path) -> None:
    with pytest.raises(UserInputError, match=r"holds none of the 50 worlds .* github\.com/Daffan/the-barn-challenge"):
        look_at_evaluation(compose("evaluate", ["baseline=pursuit", "map=barn", f"map.path={tmp_path}"]))


def test_a_missing_path_is_told_before_anything_is_driven(worlds: Path, tmp_path: Path) -> None:
    (worlds / "path_12.npy").unlink()
    given = ["baseline=pursuit", "map=barn", f"map.path={worlds}", f"out={tmp_path / 'out'}"]
    with pytest.raises(UserInputError, match=r"path_12\.npy is missing, and BARN's score needs it"):
        make_evaluation(compose("evaluate", given))


@pytest.mark.parametrize("cells", [np.zeros((3, 3)), np.zeros(2), np.full((3, 2), np.nan)])
def test_a_path_of_another_shape_is_told(cells: np.ndarray, tmp_path: Path) -> None:
    np.save(tmp_path / "path_12.npy", cells)
    with pytest.raises(UserInputError, match=r"path_12\.npy beside .* cannot be read \(its shape is"):
        optimal_time_s(tmp_path / "world_12.world")


def test_a_film_of_a_world_that_is_not_there_is_refused(worlds: Path, tmp_path: Path) -> None:
    given = ["baseline=pursuit", "map=barn", f"map.path={worlds}", f"out={tmp_path}", "record=true", "video.map=2"]
    with pytest.raises(UserInputError, match=r"video\.map=2 is not among the 2 worlds that are there"):
        make_evaluation(compose("evaluate", given))


def test_the_task_of_the_protocol(worlds: Path) -> None:
    given = ["baseline=pursuit", "map=barn", f"map.path={worlds}", "task.motor_steps=[5,8]"]
    chosen = read_config(compose("evaluate", given), EvaluationSettings).world_of(default_training())
    assert chosen.barn is not None
    assert (chosen.task.episode_steps, chosen.task.goal_radius_m) == (1000, 1.0)  # 100 s of 0.1 s
