"""Navigators around the agents of a worker: what the policy is told, what is done, and an evaluation with them."""

import json
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pytest
import torch
from tensordict import TensorDict, TensorDictBase
from tensordict.nn import TensorDictModuleBase

from rcdsac_trl.config.navigation_settings import NavigationSettings
from rcdsac_trl.deploy.navigation.navigator import Navigator, NavigatorSettings
from rcdsac_trl.deploy.navigation.watchdog import WatchdogSettings
from rcdsac_trl.errors import UserInputError
from rcdsac_trl.robot.action import action_of
from rcdsac_trl.robot.compiled_guard import CompiledGuard
from rcdsac_trl.robot.guard import Guard
from rcdsac_trl.robot.observation import range_observation, waypoint_observation, waypoint_positions
from rcdsac_trl.robot.range_sensor import sensor_mask
from rcdsac_trl.robot.robot_settings import PAPER
from rcdsac_trl.robot.sectors import Sectors
from rcdsac_trl.rollout.navigation import NavigatedPolicy, navigator_of
from rcdsac_trl.world.sim.lidar import sector_distances
from tiny import evaluate, untrained_run

FULL = sensor_mask("full")
WALL = np.array([[1.5, -0.8, 1.5, 2.2]])
AHEAD = (3.5, 0.0), (6.0, 0.0)
OPEN = np.full(180, np.inf)
ZONE = "navigation.stop_zone=true"


class Told(TensorDictModuleBase):
    """Keeps what it is told, and stands."""

    in_keys = ["range", "waypoint", "velocity", "risk"]  # noqa: RUF012
    out_keys = ["loc", "scale", "action"]  # noqa: RUF012

    def __init__(self) -> None:
        super().__init__()
        self.waypoints: list[np.ndarray] = []
        self.risks: list[list[float]] = []

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        self.waypoints.append(waypoint_positions(tensordict["waypoint"].numpy()))
        self.risks.append(tensordict["risk"][:, 0].tolist())
        stand = torch.tensor([[-0.5, 0.0]]).expand(tensordict.batch_size[0], -1)
        return tensordict.update({"loc": torch.atanh(stand), "scale": torch.full_like(stand, 0.1), "action": stand})


def observation(begins: bool, v: float = 0.0) -> TensorDict:
    """Two agents with the same waypoints and speed: before the first is a wall, before the second nothing."""
    ranges = [sector_distances(0.0, 0.0, 0.0, WALL, np.empty((0, 3))), np.full(180, np.inf)]
    seen = np.stack([range_observation(each, FULL) for each in ranges])
    waypoint = torch.tensor([waypoint_observation((0.0, 0.0, 0.0), *AHEAD)] * 2, dtype=torch.float32)
    told = {"range": torch.from_numpy(seen), "waypoint": waypoint, "velocity": torch.tensor([[v, 0.0, 0.0, 0.0]] * 2)}
    init = torch.full((2, 1), begins, dtype=torch.bool)
    return TensorDict({**told, "risk": torch.tensor([[0.2], [0.2]]), "is_init": init}, [2])


def navigated(settings: NavigatorSettings) -> tuple[Told, NavigatedPolicy]:
    inner = Told()
    policy = NavigatedPolicy(inner, partial(Navigator, settings), FULL, 2, 1.0, PAPER)
    policy.set_periods([0.14, 0.14])
    return inner, policy


def test_an_agent_is_told_a_detour_where_its_way_is_blocked_and_the_observation_stays() -> None:
    inner, policy = navigated(NavigatorSettings(blocked_s=0.2, watchdog=None))
    for step in range(4):
        given = observation(step == 0)
        after = policy(given.clone())
        assert torch.equal(after["waypoint"], given["waypoint"])
        assert torch.equal(after["risk"], given["risk"])
        assert after["action"].tolist() == [[-0.5, 0.0]] * 2
    blocked = [told[0, 0, 1] < -0.5 for told in inner.waypoints]  # past the end of the wall on the right
    assert blocked == [False, False, True, True]
    for told in inner.waypoints:
        np.testing.assert_allclose(told[1], AHEAD, atol=1e-4)


def test_an_agent_that_stands_is_made_bold_and_then_backs_off() -> None:
    dog = WatchdogSettings(still_s=1.0, bold_s=1.0, back_off_s=1.5)
    inner, policy = navigated(NavigatorSettings(replan=False, watchdog=dog))
    speeds = [0.5] * 10 + [0.0] * 30
    actions = [policy(observation(step == 0, v))["action"].tolist() for step, v in enumerate(speeds)]
    risks = [told[1] for told in inner.risks]
    assert risks[:10] == pytest.approx([0.2] * 10)
    assert risks[26] == pytest.approx(1.0)
    assert risks[:27] == sorted(risks[:27])
    assert [action[1] for action in actions[:26]] == [[-0.5, 0.0]] * 26  # the agent's own
    assert pytest.approx([-0.875, 0.0]) in [action[1] for action in actions[26:]]  # -0.15 m/s
    policy(observation(True))
    assert inner.risks[-1] == pytest.approx([0.2] * 2)  # a new episode begins afresh


class Ahead(Told):
    """Drives straight ahead at full speed."""

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        ahead = torch.tensor([[1.0, 0.05]]).expand(tensordict.batch_size[0], -1)
        return super().forward(tensordict).set("action", ahead)


def test_a_stop_zone_limits_who_has_something_ahead_and_leaves_the_other_alone() -> None:
    quiet = NavigatorSettings(replan=False, watchdog=None)
    policy = NavigatedPolicy(Ahead(), partial(Navigator, quiet), FULL, 2, None, PAPER, Guard(evade=False))
    policy.set_periods([0.14, 0.14])
    given = observation(True, v=0.6)
    near = sector_distances(1.0, 0.0, 0.0, WALL, np.empty((0, 3)))  # 0.5 m ahead
    given["range"][0] = torch.from_numpy(range_observation(near, FULL))
    limited, free = policy(given)["action"].tolist()
    seen = Sectors(near, FULL)
    v, omega, reason = Guard(evade=False).limit(0.6, 0.0, seen, (0.6, 0.0))  # 0.05 is within the dead band
    assert reason == "the stop zone"
    assert limited == pytest.approx(action_of(v, omega))
    assert v < 0.5
    assert free == torch.tensor([1.0, 0.05]).tolist()  # to the last bit


def test_the_stop_zone_minds_what_has_left_the_view() -> None:
    narrow, pole = sensor_mask("narrow"), np.array([[0.38, 0.0, 0.1]])
    quiet = NavigatorSettings(replan=False, watchdog=None)
    policy = NavigatedPolicy(Ahead(), partial(Navigator, quiet), narrow, 2, None, PAPER, Guard(evade=False))
    policy.set_periods([0.14, 0.14])
    for step in range(9):  # the first agent turns left until the pole is at 64 degrees on its right
        ranges = sector_distances(0.0, 0.0, 0.14 * step, np.empty((0, 4)), pole)
        given = observation(step == 0)
        given["range"] = torch.from_numpy(np.stack([range_observation(each, narrow) for each in (ranges, OPEN)]))
        given["velocity"][:, 1] = 1.0
        action = policy(given)["action"]
    assert not given["range"].any()
    assert action[0, 0] < 0.9
    assert action[1, 0] == 1.0


def test_an_evaluation_with_navigation_repeats_and_says_so(tmp_path: Path) -> None:
    run, _, _ = untrained_run(tmp_path / "run", "rcdsac_cvar")
    asked = [f"run={run}", "checkpoint=last", "beta=[0.25]", "navigation.replan=true", "navigation.watchdog=true"]
    first, again = (evaluate(*asked, f"out={tmp_path / name}") for name in ("a", "b"))
    pd.testing.assert_frame_equal(*(pd.read_csv(out / "episodes.csv") for out in (first, again)))
    assert '"watchdog": true' in (first / "evaluation.json").read_text()
    with pytest.raises(UserInputError, match="baseline=dwa navigates by itself"):
        evaluate("baseline=dwa", "navigation.watchdog=true")


def test_a_stop_zone_stands_behind_agents_and_planners(tmp_path: Path) -> None:
    run, _, _ = untrained_run(tmp_path / "run", "sac")
    asked = f"run={run}", "checkpoint=last"
    alone, kept = (evaluate(*asked, *more, f"out={tmp_path / name}") for name, more in (("a", ()), ("b", (ZONE,))))
    speeds = [pd.read_csv(out / "episodes.csv")["mean_speed_m_per_s"].mean() for out in (alone, kept)]
    assert speeds[0] != speeds[1]
    assert '"stop_zone": true' in (kept / "evaluation.json").read_text()
    # As versions before the stop zone wrote it, so that they can be repeated in their folders.
    assert json.loads((alone / "evaluation.json").read_bytes())["navigation"] == {"replan": False, "watchdog": False}


def test_a_stop_zone_stands_behind_a_baseline_and_has_a_folder_of_its_own(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    asked = "baseline=pursuit", "task.episode_steps=150", "map.num_movers=0", "sensor=full"
    alone, kept = evaluate(*asked), evaluate(*asked, ZONE)
    assert kept.name == alone.name + "-stop_zone"
    collisions = [pd.read_csv(out / "episodes.csv")["collisions"].sum() for out in (alone, kept)]
    assert collisions[0] > 0
    assert collisions[1] == 0


def test_the_stop_zone_of_agents_that_allow_for_a_latency_begins_where_they_will_be(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    run, _, _ = untrained_run(tmp_path / "run", "sac", "sensor.memory_s=5", "network.range_code=nearness")
    begun = []

    def limit(self: Guard, v: float, omega: float, *rest: Any) -> tuple[float, float, None]:
        begun.append(rest[-1])
        return v, omega, None

    monkeypatch.setattr(CompiledGuard, "limit", limit)
    evaluate(f"run={run}", "checkpoint=last", "latency_s=0.28", ZONE)
    assert {ahead.latency_s for ahead in begun} == {0.28}
    assert len({ahead.pose for ahead in begun}) > len(begun) / 2


def test_who_is_not_told_how_long_a_step_takes_refuses() -> None:
    policy = NavigatedPolicy(Told(), Navigator, FULL, 2, 1.0, PAPER)
    policy(observation(True))  # of the first step nothing has passed
    with pytest.raises(RuntimeError, match=r"NavigatedPolicy does not know how long a step takes: call set_periods"):
        policy(observation(False))


def test_nothing_navigates_unless_it_is_asked_for() -> None:
    assert navigator_of(NavigationSettings(), PAPER) is None
    made = navigator_of(NavigationSettings(replan=True), PAPER)
    assert made is not None
    assert (made.settings.replan, made.settings.watchdog) == (True, None)
