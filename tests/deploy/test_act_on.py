"""An agent in the environments: an observation as it is, and the same numbers as on a robot."""

import copy
from typing import Any

import gymnasium
import numpy as np
import pytest
import torch
from tensordict import TensorDict
from torchrl.envs import Compose, InitTracker, StepCounter, TransformedEnv

import rcdsac_trl
from rcdsac_trl.deploy import Policy
from rcdsac_trl.deploy.policy.acting import BY_MEAN, ActingSettings
from rcdsac_trl.errors import UserInputError
from rcdsac_trl.robot.action import desired_velocities
from rcdsac_trl.robot.observation import range_observation, waypoint_observation
from rcdsac_trl.world.task.env import NavigationEnv
from robots import ROWS, agent


def seen(rng: np.random.Generator, mask: np.ndarray) -> dict[str, np.ndarray]:
    """Draw what one agent might see."""
    distances = np.where(rng.random(180) < 0.7, rng.uniform(0.1, 4.0, 180), np.inf)
    waypoints = rng.uniform(-5, 5, (2, 2))
    return {
        "range": range_observation(distances, mask),
        "waypoint": np.array(waypoint_observation((0.0, 0.0, 0.0), *map(tuple, waypoints.tolist())), np.float32),
        "velocity": rng.uniform(-0.5, 0.5, 4).astype(np.float32),
    }


@pytest.mark.parametrize("row", ROWS)
def test_it_wants_what_it_wants_on_a_robot(row: str) -> None:
    weights = agent(**ROWS[row])
    robot, simulated = Policy(weights, guard=None), Policy(weights)
    low, high = weights.config.context_range or (0.0, 0.0)
    rng = np.random.default_rng(3)
    commanded = (0.0, 0.0)
    for _ in range(12):
        distances = np.where(rng.random(180) < 0.7, rng.uniform(0.1, 4.0, 180), np.inf)
        waypoints, velocity = rng.uniform(-5, 5, (2, 2)), rng.uniform(-0.5, 0.5, 2)
        told = {} if weights.config.context is None else {weights.config.context: low + (high - low) * rng.random()}
        observation = {
            "range": range_observation(distances, weights.config.sensor_mask),
            "waypoint": np.array(waypoint_observation((0.0, 0.0, 0.0), *map(tuple, waypoints.tolist()))),
            "velocity": np.array([*velocity, *commanded]),
        }
        action = simulated.act_on(observation, **told)
        assert (action.dtype, action.shape) == (np.float32, (2,))
        commanded = robot.act(distances, waypoints, velocity, **told).wanted
        assert commanded == pytest.approx(desired_velocities(action.tolist()), abs=1e-6)
    if weights.config.context != "collision_weight":  # what it expects may be asked for as on a robot
        assert simulated.foresee().value == pytest.approx(robot.foresee().value, abs=1e-5)


def test_many_agents_have_memories_of_their_own() -> None:
    weights = agent()
    together, alone = Policy(weights), [Policy(weights) for _ in range(3)]
    rng = np.random.default_rng(5)
    for step in range(6):
        rows = [seen(rng, weights.config.sensor_mask) for _ in range(3)]
        batch = TensorDict({key: torch.from_numpy(np.stack([row[key] for row in rows])) for key in rows[0]}, [3])
        batch["is_init"] = torch.tensor([[step == 0], [step in (0, 3)], [step == 0]])
        if step == 3:
            alone[1].reset()
        if step == 4:  # a copy keeps the memories of all
            together = copy.copy(together)
        actions = together.act_on(batch, beta=-1.0)
        assert actions.shape == (3, 2)
        np.testing.assert_array_equal(
            actions, [each.act_on(row, beta=-1.0) for each, row in zip(alone, rows, strict=True)]
        )
    # Another number of agents are others.
    fresh = Policy(weights).act_on(rows[0], beta=-1.0)
    np.testing.assert_array_equal(together.act_on(rows[0], beta=-1.0), fresh)


def test_how_they_act_is_changed_for_all_of_them() -> None:
    rng = np.random.default_rng(6)
    choosing = ActingSettings(num_candidates=16, spread=3.0)
    policy = Policy(agent(), acting=choosing)
    observation = {name: np.stack([value] * 4) for name, value in seen(rng, policy.config.sensor_mask).items()}
    chosen = policy.act_on(observation)
    policy.reset()
    policy.acting = BY_MEAN
    by_mean = policy.act_on(observation)
    assert not np.allclose(chosen, by_mean), "else the test could not tell"
    policy.reset()
    policy.acting = choosing
    policy.act_on(observation)
    policy.acting = BY_MEAN
    after = policy.act_on(observation)
    assert np.array_equal(after, np.broadcast_to(after[0], after.shape))


def test_a_reset_forgets_all_of_them() -> None:
    policy, rng = Policy(agent()), np.random.default_rng(5)
    rows = [seen(rng, policy.config.sensor_mask) for _ in range(2)]
    batch = {key: np.stack([row[key] for row in rows]) for key in rows[0]}
    first = policy.act_on(batch)
    assert not np.array_equal(policy.act_on(batch), first)
    policy.reset()
    np.testing.assert_array_equal(policy.act_on(batch), first)


@pytest.mark.parametrize(
    ("change", "options", "told"),
    [
        ({"waypoint": None}, {}, r"^the observation has no 'waypoint': .* made with \*\*policy\.world$"),
        ({"range": np.zeros(90)}, {}, r"^range has shape \(90,\), and ends in 180 numbers"),
        ({"range": np.ones(180)}, {}, r"^there are ranges in sectors that sensor=narrow of robot=paper does not have"),
        ({"velocity": np.zeros((2, 4))}, {}, r"^velocity is of agents \(2,\), and range of \(\)"),
        ({"velocity": ["a"] * 4}, {}, "^velocity is not numbers"),
        ({"range": np.full(180, np.nan)}, {}, "^the observation's 'range' holds nan: give finite numbers"),
        ({"velocity": np.full(4, np.inf)}, {}, "^the observation's 'velocity' holds inf: give finite numbers"),
        ({}, {"beta": -3.0}, r"^beta=-3 is outside \[-2, 0\]"),
        ({}, {"collision_weight": 1.0}, r"^collision_weight=1 means nothing to this agent"),
    ],
)
def test_what_it_cannot_read_is_refused(change: dict[str, Any], options: dict[str, float], told: str) -> None:
    policy = Policy(agent())
    observation = seen(np.random.default_rng(1), policy.config.sensor_mask) | change
    observation = {key: value for key, value in observation.items() if value is not None}
    with pytest.raises(UserInputError, match=told):
        policy.act_on(observation, **options)
    with pytest.raises(UserInputError, match="the observation has no 'range'"):
        policy.act_on(None)


def test_memory_is_asked_for_by_name() -> None:
    policy = Policy(agent(memory_s=9.0))
    assert policy.world == {"sensor": "narrow", "memory_s": 9.0, "robot": policy.robot}
    with pytest.raises(UserInputError, match="the observation has no 'remembered'"):
        policy.act_on(seen(np.random.default_rng(1), policy.config.sensor_mask))


def test_both_environments_are_driven_alike() -> None:
    """With what is remembered and another robot; the agent of TorchRL has companions, and two episodes."""
    policy = Policy(agent(memory_s=9.0, sensor="full"))
    world = rcdsac_trl.world_settings(map="easy", num_agents=2, **policy.world)
    several = TransformedEnv(NavigationEnv(world, seed=3), Compose(InitTracker(), StepCounter(max_steps=5)))
    rollout = several.rollout(
        10, lambda td: td.set("action", torch.from_numpy(policy.act_on(td, beta=-1.0))), break_when_any_done=False
    )
    several.close()
    env = gymnasium.make("RCDSACNavigation-v0", map="easy", **policy.world)
    for episode in range(2):
        observation, _ = env.reset(seed=3, options={"episode": episode})
        policy.reset()
        for step in range(5):
            action = policy.act_on(observation, beta=-1.0)
            np.testing.assert_allclose(action, rollout["action"][0, 5 * episode + step], atol=1e-6)
            observation = env.step(action)[0]
    env.close()
