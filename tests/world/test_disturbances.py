"""What disturbs an episode: how much of it is drawn, how long a wrong pose lasts, and what the robot is told of it."""

import math

import numpy as np
import pytest

from rcdsac_trl.robot.observation import waypoint_observation
from rcdsac_trl.robot.range_sensor import sensor_mask
from rcdsac_trl.seeding import stream
from rcdsac_trl.world.maps.generator import MapSettings
from rcdsac_trl.world.task.agent_group import AgentGroup
from rcdsac_trl.world.task.disturbances import POSE_ERROR_S, PoseError, draw_disturbances
from rcdsac_trl.world.task.episode import NavigationAgent
from rcdsac_trl.world.task.rules import TaskSettings

ALL = TaskSettings(
    range_noise_std_m=0.02,
    range_dropout=0.05,
    odometry_noise_std=(0.05, 0.1),
    action_delay_steps=2,
    pose_noise_std=(0.15, 0.05),
    motor_slowness=0.2,
)
DRAWN = {**vars(ALL), "disturbances": "drawn"}


def test_fixed_ones_are_as_the_task_has_them_and_drawn_ones_spread_below() -> None:
    fixed = draw_disturbances(ALL, stream(0, "x"))
    assert (fixed.range_noise_std_m, fixed.action_delay_steps, fixed.pose_noise_std) == (0.02, 2, (0.15, 0.05))
    drawn = [draw_disturbances(TaskSettings(**DRAWN), stream(0, "x", episode)) for episode in range(2000)]
    for name in ("range_noise_std_m", "range_dropout", "motor_slowness"):
        shares = np.array([getattr(each, name) for each in drawn]) / getattr(ALL, name)
        assert 0.0 <= shares.min() <= shares.max() <= 1.0
        assert shares.mean() == pytest.approx(0.5, abs=0.02)
    counts = np.bincount([each.action_delay_steps for each in drawn], minlength=3)
    np.testing.assert_allclose(counts / 2000, 1 / 3, atol=0.04)
    ratios = [each.pose_noise_std[1] / each.pose_noise_std[0] for each in drawn]
    np.testing.assert_allclose(ratios, 1 / 3)


def test_a_pose_error_has_its_spread_and_lasts() -> None:
    off = np.array([_errors(seed) for seed in range(4000)])
    np.testing.assert_allclose(off.std(axis=0), [[0.15, 0.15, 0.05]] * 2, rtol=0.05)
    for axis in range(3):
        kept = np.corrcoef(off[:, 0, axis], off[:, 1, axis])[0, 1]
        assert kept == pytest.approx(math.exp(-0.7 / POSE_ERROR_S), abs=0.03)


def _errors(seed: int) -> tuple[tuple[float, ...], tuple[float, ...]]:
    """Return how far a pose is off, and how far 0.7 s later."""
    error = PoseError((0.15, 0.05), stream(seed, "pose_error"))
    first = error.added_to((0.0, 0.0, 0.0))
    for _ in range(5):
        error.step(0.14)
    return first, error.added_to((0.0, 0.0, 0.0))


def test_no_pose_error_is_none_and_draws_nothing() -> None:
    rng = stream(0, "x")
    before = rng.bit_generator.state
    error = PoseError((0.0, 0.0), rng)
    error.step(1.0)
    assert error.added_to((1.0, 2.0, 3.0)) == (1.0, 2.0, 3.0)
    assert rng.bit_generator.state == before


def group(task: TaskSettings) -> AgentGroup:
    made = AgentGroup(
        MapSettings(num_movers=0),
        task,
        sensor="full",
        split="validation",
        seed=0,
        agent_ids=[0],
        first_episode=0,
        gui=False,
    )
    made.reset([0])
    return made


def test_waypoints_are_told_from_where_the_robot_believes_to_be() -> None:
    off, true = group(TaskSettings(pose_noise_std=(0.15, 0.05))), group(TaskSettings())
    agent = off._agents[0]
    assert np.array_equal(off.buffers.pose, true.buffers.pose)  # what is measured is the truth
    expected = waypoint_observation(agent.believed_pose, *agent.next_waypoints)
    np.testing.assert_allclose(off.buffers.waypoint[0], expected, rtol=1e-6)
    assert not np.allclose(off.buffers.waypoint, true.buffers.waypoint, atol=1e-3)
    assert np.array_equal(off.buffers.range, true.buffers.range)
    off.close()
    true.close()


def test_slow_motors_reach_their_share_of_what_they_are_told() -> None:
    made = group(TaskSettings(motor_slowness=0.25))
    for _ in range(8):
        made.step(np.array([[-0.5, 1.0]], np.float32))  # turn on the spot
    _, measured, told_v, told_omega = made.buffers.velocity[0].tolist()
    assert (told_v, told_omega) == pytest.approx((0.0, math.pi / 2), abs=1e-6)
    assert measured == pytest.approx(0.75 * math.pi / 2, rel=0.02)
    made.close()


def test_a_stop_zone_keeps_the_robot_from_what_its_sensor_sees() -> None:
    """Told to drive straight on for good, the robot hits the next wall, or is turned along it and told so."""
    ended = {}
    for share in (0.0, 1.0):
        made = group(TaskSettings(stop_zone_share=share))
        touched = False
        for _ in range(200):
            made.step(np.array([[1.0, 0.0]], np.float32))
            touched |= bool(made.buffers.contact[0, 0])
        ended[share] = touched, made.buffers.velocity[0].tolist()
        made.close()
    assert ended[0.0][0]
    assert ended[0.0][1][2] == pytest.approx(0.6)
    assert not ended[1.0][0]
    assert ended[1.0][1][2] < 0.6


def test_as_many_episodes_have_a_stop_zone_as_the_task_says() -> None:
    task = TaskSettings(stop_zone_share=0.3)
    drawn = [draw_disturbances(task, stream(0, "x", episode)).stop_zone for episode in range(2000)]
    assert np.mean(drawn) == pytest.approx(0.3, abs=0.03)


def test_an_episode_draws_its_own_whoever_drove_before() -> None:
    def drawn(episodes: list[int]) -> object:
        task = TaskSettings(**DRAWN)
        agent = NavigationAgent(MapSettings(num_movers=0), task, sensor_mask("narrow"), "train", 3)
        for episode in episodes:
            agent.reset(0, episode)
        agent.close()
        return agent._disturbances

    assert drawn([0, 1]) == drawn([1]) != drawn([0])
