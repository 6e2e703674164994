"""Where commands under way lead a robot, and what is told of what it will meet by then."""

import math

import numpy as np
import pytest

from rcdsac_trl.errors import UserInputError
from rcdsac_trl.robot.latency import Ahead, Latency, check_latency
from rcdsac_trl.robot.observation import NUM_REMEMBERED_SECTORS
from rcdsac_trl.robot.planar import seen_from
from rcdsac_trl.robot.range_sensor import sensor_mask
from rcdsac_trl.robot.remembered_ranges import RememberedRanges
from rcdsac_trl.world.sim.lidar import sector_distances
from rcdsac_trl.world.task.agent_group import AgentGroup
from rcdsac_trl.world.task.rules import TaskSettings

PERIOD_S = 0.14
FULL = sensor_mask("full")


def test_at_a_held_command_it_is_an_arc() -> None:
    latency, held = Latency(0.5), (0.5, 1.0)
    latency.note(held, 0.0)
    ahead = latency.ahead(held, 0.5)
    # Of radius v / omega, to the error of a motor step's chord.
    assert ahead.pose == pytest.approx((0.5 * math.sin(0.5), 0.5 * (1.0 - math.cos(0.5)), 0.5), abs=0.005)
    assert ahead.velocities == pytest.approx(held)


def test_a_command_acts_only_after_the_latency_and_those_before_it_until_then() -> None:
    latency = Latency(0.3)
    latency.note((0.0, 0.0), 1.0)
    latency.note((0.6, 0.0), 1.2)
    # At 1.35 s it stands for 0.15 s more, and then speeds up at 1.5 m/s^2 for as long.
    ahead = latency.ahead((0.0, 0.0), 1.35)
    assert ahead.velocities[0] == pytest.approx(1.5 * 0.15, abs=0.03)
    assert ahead.pose[0] == pytest.approx(0.5 * 1.5 * 0.15**2, abs=0.004)
    # At 1.65 s it has been on for 0.15 s.
    assert latency.ahead((0.225, 0.0), 1.65).velocities[0] == pytest.approx(0.6)


def test_a_robot_whose_commands_are_not_known_goes_on_as_it_moves() -> None:
    latency = Latency(0.4)
    latency.note((0.0, 0.0), 0.0)
    latency.reset()
    assert latency.ahead((0.5, 0.0), 1.0).pose == pytest.approx((0.2, 0.0, 0.0))
    # A command that follows acts only after the latency.
    latency.note((0.0, 0.0), 1.0)
    assert latency.ahead((0.5, 0.0), 1.2).pose[0] == pytest.approx(0.1 + 0.5 * 0.2 - 0.5 * 1.5 * 0.2**2, abs=0.004)


def test_the_newest_command_of_a_time_counts_and_a_clock_may_be_set_back() -> None:
    latency = Latency(0.2)
    for at_s in (900.0, 5.0):
        latency.note((0.6, 0.0), at_s)
    latency.note((0.0, 0.0), 5.0)
    assert latency.ahead((0.0, 0.0), 5.2) == ((0.0, 0.0, 0.0), (0.0, 0.0), 0.2)


def test_without_a_latency_the_robot_is_where_it_is() -> None:
    assert Latency(0.0).ahead((0.3, 0.2), 0.0) == ((0.0, 0.0, 0.0), (0.3, 0.2), 0.0)


def test_the_simulated_robot_gets_there() -> None:
    """Random commands that act two steps late: where each step is expected is where the robot is two steps later."""
    task = TaskSettings(motor_steps=(7,), action_delay_steps=2)
    group = AgentGroup(None, task, sensor="narrow", split="train", seed=0, agent_ids=[0], first_episode=0, gui=False)
    rng, latency = np.random.default_rng(0), Latency(2.0 * PERIOD_S)
    group.reset([0])
    poses, expected, free = [], [], []
    for step in range(60):
        v, omega, *commanded = group.buffers.velocity[0].tolist()
        poses.append(group.buffers.pose[0].copy())
        if step:
            latency.note((commanded[0], commanded[1]), PERIOD_S * (step - 1))
        expected.append(latency.ahead((v, omega), PERIOD_S * step))
        free.append(not group.buffers.contact[0, 0])
        group.step(rng.uniform(-1.0, 1.0, (1, 2)))
    group.close()
    moved = []
    for ahead, now, then, is_free in zip(expected, poses, poses[2:], free[2:], strict=False):
        if is_free:
            there = seen_from(then[None, :2].astype(float), now)[0]
            assert ahead.pose[:2] == pytest.approx(there, abs=0.003)
            assert math.remainder(ahead.pose[2] - (then[2] - now[2]), 2.0 * math.pi) == pytest.approx(0.0, abs=0.01)
            moved.append(math.hypot(*there))
    assert len(moved) > 30
    assert max(moved) > 0.05


def test_what_is_remembered_is_told_as_from_there() -> None:
    disc = np.array([[1.5, 0.3, 0.2]])
    pose = (0.4, -0.1, 0.2)
    now, there = RememberedRanges(FULL, 12.0), RememberedRanges(FULL, 12.0)
    seen = sector_distances(0.0, 0.0, 0.0, np.empty((0, 4)), disc)
    told = now.observe(seen, 0.0, 0.0, 0.0, ahead=Ahead(pose, (0.3, 0.1), 0.3))
    from_there = there.observe(sector_distances(*pose, np.empty((0, 4)), disc), 0.3, 0.1, 0.0)
    # Sectors see other points of the disc from there: nearness within 2 cm of 0.9 m, clearances likewise.
    np.testing.assert_allclose(
        told[:NUM_REMEMBERED_SECTORS].max(), from_there[:NUM_REMEMBERED_SECTORS].max(), atol=0.02
    )
    np.testing.assert_allclose(told[46:], from_there[46:], atol=0.1)
    assert np.abs(told[46:] - now.observe(seen, 0.0, 0.0, 0.0)[46:]).max() > 0.3


@pytest.mark.parametrize(
    ("velocity", "moved"),
    [((-0.5, 0.0), (1.0, 0.0)), ((0.5, 0.0), (1.4, 0.0)), ((0.0, 0.5), (1.2, 0.2))],
    ids=["comes", "leaves", "crosses"],
)
def test_who_walks_is_told_where_they_will_be_and_where_they_were_seen(
    velocity: tuple[float, float], moved: tuple[float, float]
) -> None:
    """Seen for two seconds, at (1.2, 0) now; in 0.4 s 0.2 m farther on."""

    def told_of(at: tuple[float, float], ahead: Ahead | None) -> np.ndarray:
        remembered = RememberedRanges(FULL, 12.0)
        for step in range(15):
            since_s = PERIOD_S * (step - 14)
            disc = np.array([[at[0] + velocity[0] * since_s, at[1] + velocity[1] * since_s, 0.25]])
            ranges = sector_distances(0.0, 0.0, 0.0, np.empty((0, 4)), disc)
            told = remembered.observe(ranges, 0.0, 0.0, PERIOD_S if step else 0.0, ahead=ahead)
        return told

    standing = Ahead((0.0, 0.0, 0.0), (0.0, 0.0), 0.4)
    ahead, there, here = told_of((1.2, 0.0), standing), told_of(moved, None), told_of((1.2, 0.0), None)
    mover = slice(NUM_REMEMBERED_SECTORS, NUM_REMEMBERED_SECTORS + 5)
    # To a few centimetres of what a track lags behind.
    np.testing.assert_allclose(ahead[mover], there[mover], atol=0.05)
    assert np.abs(ahead[mover] - here[mover]).max() > 0.08
    sectors = slice(0, NUM_REMEMBERED_SECTORS)
    np.testing.assert_allclose(ahead[sectors], np.maximum(there, here)[sectors], atol=0.15)


@pytest.mark.parametrize(
    ("latency_s", "memory_s", "why"),
    [(strange, 12.0, r"a number from 0 to 0\.5") for strange in (-0.1, 0.6, math.nan, "0.2", None, True, [0.2])]
    + [(0.2, 0.0, "remembers nothing")],
)
def test_what_nobody_can_allow_for_is_refused(latency_s: object, memory_s: float, why: str) -> None:
    with pytest.raises(UserInputError, match=why):
        check_latency(latency_s, memory_s)


@pytest.mark.parametrize("latency_s", [0, 0.5, np.float32(0.25)])
def test_any_number_is_one(latency_s: float) -> None:
    check_latency(latency_s, 12.0)
