"""The TorchRL environment: specs, determinism over any number of workers, resets, seeds."""

import itertools
import math
import os

import numpy as np
import pytest
import torch
from tensordict import TensorDict, TensorDictBase
from torchrl.envs import EnvBase, ParallelEnv, SerialEnv, StepCounter, TransformedEnv
from torchrl.envs.utils import check_env_specs

from rcdsac_trl.errors import UserInputError
from rcdsac_trl.robot.limits import MOTOR_PERIOD_S
from rcdsac_trl.robot.observation import range_distances
from rcdsac_trl.robot.range_sensor import sensor_mask
from rcdsac_trl.robot.remembered_ranges import RememberedRanges
from rcdsac_trl.rollout.planners.pursuit import pursuit_action
from rcdsac_trl.seeding import torch_stream
from rcdsac_trl.system import cgroups
from rcdsac_trl.system.processes import resolve_num_workers
from rcdsac_trl.world.maps.generator import LAYOUTS, MapSettings
from rcdsac_trl.world.task.env import NavigationEnv, make_env
from rcdsac_trl.world.task.episode import draw_motor_steps
from rcdsac_trl.world.task.rules import TaskSettings

SMALL = MapSettings(size_m=12.0, layouts=("clutter",), clutter_per_m2=0.08, num_movers=1)
EMPTY = MapSettings(size_m=10.0, layouts=("clutter",), clutter_per_m2=0.0, num_movers=0)


def drive(env: EnvBase, steps: int, weight: float | None = None) -> TensorDictBase:
    """Drive all agents by the same actions however they are grouped; returns [agents, steps + 1]."""
    actions = torch.rand(steps, env.numel(), 2, generator=torch_stream(7, "test actions")) * 2 - 1
    tensordict = env.reset()
    kept = [tensordict.flatten()]
    for action in actions:
        tensordict["action"] = action.view(*env.batch_size, 2)
        if weight is not None:
            tensordict["collision_weight"] = torch.full((*env.batch_size, 1), weight)
        after = env.step(tensordict)["next"]
        kept.append(after.flatten())
        tensordict = after.exclude("reward")
    kept[0]["reward"] = torch.zeros(env.numel(), 1)
    return torch.stack(kept, 1)


def assert_equal(one: TensorDictBase, other: TensorDictBase) -> None:
    assert set(one.keys()) == set(other.keys())
    for key in one.keys():  # noqa: SIM118 (a TensorDict iterates over its rows)
        assert torch.equal(one[key], other[key]), key


@pytest.mark.parametrize("sensor", ["narrow", "sparse", "full"])
@pytest.mark.parametrize("num_movers", [0, 2])
@pytest.mark.parametrize("layout", LAYOUTS)
def test_specs_hold_for_every_sensor_and_map(sensor: str, layout: str, num_movers: int) -> None:
    settings = MapSettings(size_m=12.0, layouts=(layout,), num_movers=num_movers)
    env = NavigationEnv(map_settings=settings, sensor=sensor, agent_ids=(0, 1))
    check_env_specs(env, seed=0)
    env.close()


@pytest.mark.parametrize("sensor", ["narrow", "sparse", "full"])
def test_what_is_remembered_is_told_and_changes_nothing_else(sensor: str) -> None:
    """It is what the class makes of the sensed ranges and measured velocities, and of them alone."""
    env = NavigationEnv(map_settings=SMALL, sensor=sensor, agent_ids=(0, 1), memory_s=9.0)
    check_env_specs(env, seed=0)
    env.set_seed(0)
    told = drive(env, 60)
    without = NavigationEnv(map_settings=SMALL, sensor=sensor, agent_ids=(0, 1))
    assert_equal(told.exclude("remembered"), drive(without, 60))
    for agent_id in (0, 1):
        memory = RememberedRanges(sensor_mask(sensor), 9.0)
        period_s = MOTOR_PERIOD_S * draw_motor_steps(TaskSettings(), "train", 0, 0, agent_id)
        for step, now in enumerate(told[agent_id]):
            seen_m = range_distances(now["range"].numpy())
            v, omega, *_ = now["velocity"].tolist()
            expected = memory.observe(seen_m, v, omega, period_s if step else 0.0)
            # Observations are rounded: now and then a point lies in the next cell, or an edge in the next sector.
            assert (np.abs(now["remembered"].numpy() - expected) > 1e-3).sum() <= 4
    assert told["remembered"][:, -1].count_nonzero() > 0
    env.close()
    without.close()


@pytest.mark.parametrize("num_workers", [0, 2])
def test_specs_hold_with_weighted_collisions(num_workers: int) -> None:
    env = make_env(map_settings=SMALL, agent_ids=(0, 1), num_workers=num_workers, weighted_collisions=True, serial=True)
    check_env_specs(env)
    assert env.observation_spec["collision_weight"].shape == (*env.batch_size, 1)
    env.close()


def test_keys_have_the_shapes_and_types_of_the_design_table() -> None:
    env = NavigationEnv(map_settings=SMALL, agent_ids=(3, 4))
    step = env.rollout(1)[:, 0]
    shapes = {"range": 180, "waypoint": 6, "velocity": 4, "pose": 3, "contact": 1, "goal_reached": 1}
    for key, width in shapes.items():
        assert step[key].shape == step["next", key].shape == (2, width)
    assert step["next", "reward_components"].shape == (2, 5)
    assert step["next", "reward"].shape == step["next", "done"].shape == (2, 1)
    assert step["next", "contact"].dtype == step["next", "goal_reached"].dtype == torch.bool
    assert step["range"].dtype == step["pose"].dtype == step["next", "reward"].dtype == torch.float32
    env.close()


@pytest.fixture(scope="module")
def alone() -> TensorDictBase:
    env = NavigationEnv(map_settings=SMALL, seed=3)
    driven = drive(env, 150)
    env.close()
    return driven


def test_the_same_seed_gives_the_same_rollout_bit_for_bit(alone: TensorDictBase) -> None:
    env = NavigationEnv(map_settings=SMALL, seed=3)
    env.rollout(5)  # leaves traces in the physics engine
    env.set_seed(3)
    assert_equal(drive(env, 150), alone)
    env.close()
    env = NavigationEnv(map_settings=SMALL, seed=4)
    assert not torch.equal(drive(env, 1)["pose"], alone["pose"][:, :2])
    env.close()


def test_an_agent_does_not_notice_who_shares_its_process(alone: TensorDictBase) -> None:
    env = NavigationEnv(map_settings=SMALL, seed=3, agent_ids=(7, 2))
    actions = torch.rand(150, 10, 2, generator=torch_stream(7, "test actions")) * 2 - 1
    tensordict = env.reset()
    for step, action in enumerate(actions[:50]):
        assert torch.equal(tensordict["pose"], alone["pose"][[7, 2], step])
        tensordict["action"] = action[[7, 2]]
        tensordict = env.step(tensordict)["next"].exclude("reward")
    env.close()


@pytest.mark.parametrize(("num_workers", "serial"), [(5, True), (1, False), (2, False), (5, False)])
def test_workers_change_nothing(alone: TensorDictBase, num_workers: int, serial: bool) -> None:
    env = make_env(map_settings=SMALL, seed=3, num_workers=num_workers, serial=serial)
    assert isinstance(env, SerialEnv if serial else ParallelEnv)
    assert env.batch_size == (num_workers, 10 // num_workers)
    assert_equal(drive(env, 150), alone)
    # A seed set later reaches every worker unchanged, and begins at the first episode again.
    env.set_seed(3)
    assert_equal(drive(env, 3), alone[:, :4])
    env.close()


@pytest.mark.slow
@pytest.mark.parametrize("num_workers", [1, 2, 5, 10])
def test_workers_change_nothing_over_whole_episodes(num_workers: int) -> None:
    bare, batched = NavigationEnv(seed=11), make_env(seed=11, num_workers=num_workers)
    assert_equal(drive(batched, 1000), drive(bare, 1000))
    bare.close()
    batched.close()


def test_agents_and_episodes_differ(alone: TensorDictBase) -> None:
    starts = alone["pose"][:, 0]
    assert len(starts.unique(dim=0)) == 10
    env = NavigationEnv(map_settings=SMALL, seed=3)
    env.reset()
    assert not (env.reset()["pose"] == starts).all(-1).any()
    env.close()


def test_agents_of_equal_number_meet_the_same_episode() -> None:
    env = make_env(map_settings=SMALL, agent_ids=(0, 1, 0, 1), num_workers=0)
    tensordict = env.reset()
    for key in ("range", "waypoint", "pose"):
        assert torch.equal(tensordict[key][:2], tensordict[key][2:])
    env.close()


def test_splits_have_maps_of_their_own() -> None:
    scans = []
    for split in ("train", "validation", "evaluation"):
        env = NavigationEnv(map_settings=SMALL, split=split, agent_ids=(0,))
        scans.append(env.reset()["pose"])
        env.close()
    assert len(torch.cat(scans).unique(dim=0)) == 3


def goals_met(env: NavigationEnv, steps: int, throttle: float) -> list[list[tuple[float, float]]]:
    tensordict = env.reset()
    met = [[tuple(env.agents.scene(row).waypoints[-1].tolist())] for row in range(env.numel())]
    for _ in range(steps):
        action = pursuit_action(tensordict["waypoint"])
        action[:, 0] = action[:, 0].clamp(max=throttle)
        after = env.step(tensordict.set("action", action))["next"]
        for row in after["goal_reached"].view(-1).nonzero().view(-1).tolist():
            met[row].append(tuple(env.agents.scene(row).waypoints[-1].tolist()))
        tensordict = after.exclude("reward")
    env.close()
    return met


def test_starts_and_goals_do_not_depend_on_what_the_agent_does() -> None:
    fast = goals_met(NavigationEnv(map_settings=EMPTY, seed=2, agent_ids=(0, 1, 2)), 400, throttle=1.0)
    slow = goals_met(NavigationEnv(map_settings=EMPTY, seed=2, agent_ids=(0, 1, 2)), 400, throttle=0.4)
    for quick, lazy in zip(fast, slow, strict=True):
        assert len(quick) > len(lazy) >= 2
        assert quick[: len(lazy)] == lazy
        for one, other in itertools.pairwise(quick):
            assert math.dist(one, other) >= 4.0  # the map is empty, so the path is the straight line


def test_episodes_are_truncated_by_the_step_counter_and_never_terminate() -> None:
    task = TaskSettings(episode_steps=5)
    env = TransformedEnv(
        NavigationEnv(map_settings=SMALL, task=task, agent_ids=(0, 1)), StepCounter(max_steps=task.episode_steps)
    )
    rollout = env.rollout(12, break_when_any_done=False)
    ends = torch.tensor([step % 5 == 4 for step in range(12)])
    assert torch.equal(rollout["next", "truncated"][..., 0], ends.expand(2, 12))
    assert torch.equal(rollout["next", "done"], rollout["next", "truncated"])
    assert not rollout["next", "terminated"].any()
    # After each end the next episode begins, on the next map and from another start.
    first = rollout["pose"][:, ::5]
    assert len(first.flatten(0, 1).unique(dim=0)) == 6
    fresh = NavigationEnv(map_settings=SMALL, task=task, agent_ids=(0, 1), first_episode=2)
    assert torch.equal(fresh.reset()["pose"], first[:, 2])
    env.close()
    fresh.close()


@pytest.mark.parametrize("num_workers", [0, 3])
def test_a_reset_of_one_agent_leaves_the_others_alone(alone: TensorDictBase, num_workers: int) -> None:
    env = make_env(map_settings=SMALL, seed=3, agent_ids=(0, 1, 2), num_workers=num_workers, serial=True)
    actions = torch.rand(60, 10, 2, generator=torch_stream(7, "test actions")) * 2 - 1
    tensordict = env.reset()
    for step in range(60):
        if step == 30:
            marked = torch.tensor([False, True, False]).view(*env.batch_size, 1)
            tensordict = env.reset(tensordict.set("_reset", marked)).exclude("_reset")
        tensordict["action"] = actions[step, :3].view(*env.batch_size, 2)
        tensordict = env.step(tensordict)["next"].exclude("reward")
        if step == 30:
            moved_on = tensordict.flatten()
    kept = tensordict.flatten()
    for key in ("range", "waypoint", "velocity", "pose"):
        assert torch.equal(kept[key][[0, 2]], alone[key][[0, 2], 60])
    second = NavigationEnv(map_settings=SMALL, seed=3, agent_ids=(1,), first_episode=1)
    begun = second.reset().set("action", actions[30, [1]])
    assert torch.equal(second.step(begun)["next", "pose"][0], moved_on["pose"][1])
    second.close()
    env.close()


@pytest.mark.parametrize("serial", [None, True])
def test_a_reset_can_name_its_episode(serial: bool | None) -> None:
    env = make_env(map_settings=SMALL, agent_ids=(0, 1), num_workers=2 if serial else 0, serial=bool(serial))
    episodes = [env.reset()["pose"] for _ in range(4)]
    assert torch.equal(env.reset(episode=1)["pose"], episodes[1])
    assert torch.equal(env.reset()["pose"], episodes[2])
    env.close()


@pytest.mark.parametrize("num_workers", [0, 2])
def test_a_collision_weight_scales_the_collision_reward_alone(num_workers: int) -> None:
    def run(weight: float, num_workers: int) -> TensorDictBase:
        env = make_env(map_settings=SMALL, seed=5, num_workers=num_workers, weighted_collisions=True)
        driven = drive(env, 120, weight)
        env.close()
        return driven

    plain, heavy = run(1.0, 0), run(2.0, num_workers)
    assert (plain["reward_components"][..., 4] < 0).any()
    assert_equal(plain.exclude("reward", "collision_weight"), heavy.exclude("reward", "collision_weight"))
    difference = heavy["reward"] - plain["reward"]
    torch.testing.assert_close(difference, plain["reward_components"][..., 4:])
    assert (heavy["collision_weight"][:, 1:] == 2.0).all()


@pytest.mark.parametrize("num_workers", [0, 2])
def test_a_weight_of_all_collisions_scales_the_collision_reward_and_is_told_to_nobody(num_workers: int) -> None:
    def run(**weight: float) -> TensorDictBase:
        env = make_env(map_settings=SMALL, seed=5, num_workers=num_workers, serial=True, **weight)
        driven = drive(env, 120)
        env.close()
        return driven

    plain, heavy = run(), run(collision_weight=3.0)
    assert_equal(plain.exclude("reward"), heavy.exclude("reward"))
    assert (plain["reward_components"][..., 4] < 0).any()
    torch.testing.assert_close(heavy["reward"] - plain["reward"], 2.0 * plain["reward_components"][..., 4:])


@pytest.mark.parametrize(
    ("given", "told"),
    [
        ({"collision_weight": -1.0}, r"collision_weight=-1.0 must be a number of at least 0"),
        ({"collision_weight": math.nan}, "must be a number of at least 0"),
        ({"collision_weight": 3.0, "weighted_collisions": True}, "collision_weight=3 is not for weighted_collisions"),
    ],
)
def test_a_weight_that_means_nothing_is_refused(given: dict, told: str) -> None:
    with pytest.raises(UserInputError, match=told):
        NavigationEnv(map_settings=SMALL, agent_ids=(0,), **given)


@pytest.mark.parametrize("num_workers", [0, 2])
def test_a_reset_brings_a_collision_weight_or_one(num_workers: int) -> None:
    env = make_env(map_settings=SMALL, agent_ids=(0, 1), num_workers=num_workers, serial=True, weighted_collisions=True)
    assert (env.reset()["collision_weight"] == 1.0).all()
    brought = TensorDict({"collision_weight": torch.full((*env.batch_size, 1), 0.5)}, batch_size=env.batch_size)
    assert (env.reset(brought, set_state=False)["collision_weight"] == 0.5).all()
    env.close()


def test_an_action_outside_the_limits_is_refused() -> None:
    env = NavigationEnv(map_settings=SMALL, agent_ids=(0,))
    tensordict = env.reset()
    for value in (math.nan, 1.5):
        with pytest.raises(UserInputError, match=r"in \[-1, 1\]"):
            env.step(tensordict.set("action", torch.full((1, 2), value)))
    env.close()


def test_a_step_before_the_first_reset_is_refused() -> None:
    env = NavigationEnv(map_settings=SMALL, agent_ids=(0,))
    with pytest.raises(UserInputError, match="reset"):
        env.step(TensorDict({"action": torch.zeros(1, 2)}, batch_size=[1]))
    env.close()


def test_auto_takes_the_most_workers_that_the_cores_bear(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(cgroups, "processor_quota", lambda: None)
    for cores, workers in ((1, 1), (2, 2), (3, 2), (4, 2), (8, 5), (64, 10)):
        monkeypatch.setattr(os, "sched_getaffinity", lambda _, n=cores: set(range(n)), raising=False)
        assert resolve_num_workers("auto", 10) == workers


@pytest.mark.parametrize("num_workers", [3, -1, 20, "all", 2.0])
def test_workers_that_cannot_share_the_agents_are_refused(num_workers: object) -> None:
    with pytest.raises(UserInputError, match="num_workers"):
        make_env(num_workers=num_workers)


def test_settings_reach_the_workers_only_if_they_are_right() -> None:
    with pytest.raises(UserInputError, match="sensor"):
        make_env(map_settings=SMALL, sensor="wide", num_workers=0)
    with pytest.raises(UserInputError, match="agent_ids"):
        make_env(map_settings=SMALL, agent_ids=())


def test_workers_leave_the_number_of_threads_alone() -> None:
    before, threads = torch.get_num_threads(), 3
    torch.set_num_threads(threads)
    try:
        env = make_env(map_settings=SMALL, agent_ids=(0, 1), num_workers=2)
        env.reset()
        assert torch.get_num_threads() == threads
        env.close()
    finally:
        torch.set_num_threads(before)
