"""Agents that allow for a latency: the same in a simulation and on a robot, and what an evaluation makes of it."""

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from tensordict import TensorDict, TensorDictBase
from tensordict.nn import TensorDictModuleBase

from rcdsac_trl.deploy import Guard, Policy, Stamps
from rcdsac_trl.deploy.policy.robot_observer import RobotObserver
from rcdsac_trl.errors import UserInputError
from rcdsac_trl.robot.observation import range_observation, waypoint_observation
from rcdsac_trl.robot.range_sensor import sensor_mask
from rcdsac_trl.robot.sectors import Sectors
from rcdsac_trl.rollout.foresight import ForesightedPolicy
from rcdsac_trl.world.sim.lidar import sector_distances
from robots import AHEAD, OPEN, STANDING, agent
from tiny import evaluate, untrained_run

PERIOD_S, LATENCY_S, MEMORY_S = 0.14, 0.28, 12.0
NARROW = sensor_mask("narrow")
WALL = np.array([[1.5, -0.8, 1.5, 2.2]])
KEYS = "waypoint", "velocity", "remembered"


class Told(TensorDictModuleBase):
    """Keeps what it is told."""

    in_keys = ["range", *KEYS]  # noqa: RUF012
    out_keys = ["action"]  # noqa: RUF012

    def __init__(self) -> None:
        super().__init__()
        self.told: list[dict[str, torch.Tensor]] = []

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        self.told.append({key: tensordict[key][0].clone() for key in self.in_keys})
        return tensordict.set("action", torch.zeros(1, 2))


def test_an_agent_is_told_in_a_simulation_what_it_is_told_on_a_robot() -> None:
    inner = Told()
    policy = ForesightedPolicy(inner, LATENCY_S, NARROW, MEMORY_S, 1)
    policy.set_periods([PERIOD_S])
    observer = RobotObserver(agent(memory_s=MEMORY_S, range_code="nearness").config, LATENCY_S)
    rng = np.random.default_rng(0)
    for step in range(12):
        seen = sector_distances(0.02 * step, 0.0, 0.01 * step, WALL, np.empty((0, 3)))
        v, omega = 0.1 * min(step, 5), 0.05 * step
        velocity = np.float32([v, omega, *observer.commanded])
        given = {
            "range": range_observation(seen, NARROW),
            "waypoint": np.float32(waypoint_observation((0.0, 0.0, 0.0), *AHEAD)),
            "velocity": velocity,
            "remembered": np.zeros(90, np.float32),
            "is_init": np.array([step == 0]),
        }
        tensordict = TensorDict({key: torch.from_numpy(np.atleast_2d(value)) for key, value in given.items()}, [1])
        after = policy(tensordict.clone())
        assert all(torch.equal(after[key], tensordict[key]) for key in given)  # observations stay as they were
        sectors = Sectors(np.where(NARROW, seen, np.inf), NARROW)
        v, omega = velocity[:2].tolist()
        elapsed_s = PERIOD_S if step else 0.0
        ahead = observer.ahead((v, omega), PERIOD_S * step)
        bins, vectors = observer.observe(sectors, tuple(AHEAD), (v, omega), elapsed_s, ahead)
        told = inner.told[-1]
        np.testing.assert_array_equal(told["range"], bins)
        np.testing.assert_allclose(np.concatenate([told[key] for key in KEYS]), vectors, atol=2e-4)
        assert bool(torch.equal(told["waypoint"], tensordict["waypoint"][0])) == (step == 0)
        observer.note((float(rng.uniform(-0.2, 0.6)), float(rng.uniform(-1.5, 1.5))), PERIOD_S * step)


def test_a_policy_allows_for_it_and_so_does_its_guard() -> None:
    weights = agent(memory_s=MEMORY_S, range_code="nearness")
    late, prompt = Policy(weights, latency_s=LATENCY_S), Policy(weights)
    assert late.latency_s == LATENCY_S
    wanted = [[policy.act(OPEN, AHEAD, [0.3, 0.2], -1.0).wanted for _ in range(3)] for policy in (late, prompt)]
    assert wanted[0] != wanted[1]
    late.reset()
    assert [late.act(OPEN, AHEAD, [0.3, 0.2], -1.0).wanted for _ in range(3)] == wanted[0]
    with pytest.raises(AttributeError):
        late.latency_s = 0.1  # type: ignore[misc]


def test_whichever_guard_it_is_it_limits_from_where_the_robot_will_be(monkeypatch: pytest.MonkeyPatch) -> None:
    begun = []

    def limit(self: Guard, v: float, omega: float, *rest: Any) -> tuple[float, float, None]:
        begun.append(rest[-1])
        return v, omega, None

    monkeypatch.setattr(Guard, "limit", limit)
    weights = agent(memory_s=MEMORY_S, range_code="nearness")
    for guard in (Guard(), Guard(margin_m=0.1)):
        late, prompt = (Policy(weights, guard=guard, latency_s=latency_s) for latency_s in (LATENCY_S, 0.0))
        for policy in (late, prompt):
            policy.act(OPEN, AHEAD, [0.5, 0.0], -1.0)
        there, here = begun[-2:]
        assert there.pose[0] == pytest.approx(0.5 * LATENCY_S)  # no command is under way: it goes on as it moves
        assert here == ((0.0, 0.0, 0.0), (0.5, 0.0), 0.0)


def test_who_remembers_nothing_or_is_given_observations_is_refused() -> None:
    with pytest.raises(UserInputError, match="remembers nothing"):
        Policy(agent(), latency_s=0.2)
    late = Policy(agent(memory_s=MEMORY_S, range_code="nearness"), latency_s=0.2)
    with pytest.raises(UserInputError, match=r"latency_s=0.2 is allowed for by act\(\)"):
        late.act_on({})
    assert not late.act(OPEN, AHEAD, STANDING).stopped


def test_an_evaluation_says_what_was_allowed_for(tmp_path: Path) -> None:
    run, _, _ = untrained_run(tmp_path / "run", "rcdsac_pow", "sensor.memory_s=12")
    asked = [f"run={run}", "checkpoint=last", "beta=-1", "task.action_delay_steps=2"]
    folder = evaluate(*asked, "latency_s=0.28")
    assert "-latency_0.28" in folder.name
    assert json.loads((folder / "evaluation.json").read_bytes())["latency_s"] == 0.28


def test_an_evaluation_refuses_what_cannot_be() -> None:
    with pytest.raises(UserInputError, match="baseline=dwa does not allow for a latency"):
        evaluate("baseline=dwa", "latency_s=0.1")
    with pytest.raises(UserInputError, match=r"tail_variance.* leave one out"):
        evaluate("run=anybody", "latency_s=0.1", "beta_controller=[tail_variance]")
    with pytest.raises(UserInputError, match=r"record=true .* leave one out"):
        evaluate("run=anybody", "latency_s=0.1", "record=true")


def test_commands_are_dated_by_the_odometry_that_they_follow() -> None:
    """Repeated and refused calls, too: what is under way is what was told, when it was told."""
    policy = Policy(agent(memory_s=MEMORY_S, range_code="nearness"), latency_s=LATENCY_S)
    told = []
    for at_s, waypoints in ((1.0, AHEAD), (1.06, AHEAD), (1.2, None), (1.34, AHEAD)):
        command = policy.act(OPEN, waypoints, STANDING, -1.0, stamps=Stamps(at_s, at_s, at_s, at_s))
        told.append((command.v_m_per_s, command.omega_rad_per_s))
    assert told[2] == (0.0, 0.0)
    latency = policy._observer._latency
    assert latency is not None
    due_s = [due for due, _, _ in latency._commands]
    # The refused one has no time of its own: a period later than the one before.
    assert due_s == pytest.approx([1.06 + LATENCY_S, 1.06 + 0.14 + LATENCY_S, 1.34 + LATENCY_S])
    assert [(v, omega) for _, v, omega in latency._commands] == told[1:]
