"""How near commands would lead, against ways computed by hand."""

import math
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from rcdsac_trl.robot.foreseen_clearance import MIRRORED_COMMANDS, ForeseenClearance
from rcdsac_trl.robot.limits import MAX_LINEAR_VELOCITY, MIN_LINEAR_VELOCITY
from rcdsac_trl.robot.observation import NUM_FORESEEN_COMMANDS
from rcdsac_trl.robot.robot_settings import PAPER, RobotSettings

NOBODY = np.empty((0, 6))
ORIGIN = np.zeros(3)
COMMANDS = ForeseenClearance().commands
SOON, LATER = slice(0, 22), slice(22, 44)


def foreseen_nearness(*given: Any) -> NDArray[np.float32]:
    """Return what is told of the far horizon."""
    return ForeseenClearance().nearness(*given)[LATER]


AHEAD, HALF_AHEAD, STILL, BACK = 4, 12, 17, 20


def nearness(distance_m: float) -> float:
    return math.log10(0.8 / (distance_m - 0.2))


def test_the_commands_are_what_their_names_say() -> None:
    assert len(COMMANDS) == NUM_FORESEEN_COMMANDS
    expected = [[0.6, 0.0], [0.3, 0.0], [0.0, 0.0], [-0.2, 0.0]]
    np.testing.assert_allclose(COMMANDS[[AHEAD, HALF_AHEAD, STILL, BACK]], expected, atol=1e-12)
    assert COMMANDS[:, 0].min() >= MIN_LINEAR_VELOCITY
    assert COMMANDS[:, 0].max() == MAX_LINEAR_VELOCITY
    assert np.abs(COMMANDS[:, 1]).max() == PAPER.max_angular_velocity
    assert sorted(MIRRORED_COMMANDS) == list(range(len(COMMANDS)))


def test_a_thing_beside_the_way_is_as_near_as_it_is_passed() -> None:
    beside = np.array([[5 * 0.6 * 0.14, 0.3]])  # where the fifth step ends
    told = foreseen_nearness(beside, NOBODY, ORIGIN, 0.6, 0.0)
    assert told[AHEAD] == pytest.approx(nearness(0.3), abs=1e-5)
    # At half speed five steps do not suffice, nor ten quite: 0.42 m.
    assert foreseen_nearness(beside, NOBODY, ORIGIN, 0.3, 0.0)[HALF_AHEAD] == pytest.approx(nearness(0.3), abs=1e-5)
    assert told[BACK] < told[AHEAD]
    left, right = told[8], told[0]  # full speed, turning
    assert right < told[AHEAD] < left


def test_it_speeds_up_as_the_robot_does() -> None:
    # 1.5 m/s2 over 0.14 s: 0.21, 0.42, 0.6 m/s; (0.105 + 0.315 + 0.51 + 7 * 0.6) * 0.14 s = 0.7182 m.
    point = np.array([[0.7182 + 0.3, 0.0]])
    assert foreseen_nearness(point, NOBODY, ORIGIN, 0.0, 0.0)[AHEAD] == pytest.approx(nearness(0.3), abs=1e-5)


def test_what_moves_is_met_where_it_will_be() -> None:
    """It comes from the left at 0.5 m/s and crosses the way: it is there when the robot is, or long gone."""
    time_s = 7 * 0.14
    crossing = np.array([[0.6 * time_s, 0.5 * time_s, 0.0, -0.5, 0.25, 0.0]])
    told = foreseen_nearness(np.empty((0, 3)), crossing, ORIGIN, 0.6, 0.0)
    assert told[AHEAD] == pytest.approx(math.log10(0.8 / 0.02))  # both are in the same place
    # One that moves away as fast as the robot drives stays 0.5 m away, 0.25 of them its radius.
    leaving = np.array([[0.6, 0.0, 0.6, 0.0, 0.25, 0.0]])
    told = foreseen_nearness(np.empty((0, 3)), leaving, ORIGIN, 0.6, 0.0)
    assert told[AHEAD] == pytest.approx(nearness(0.35), abs=1e-5)


def test_frames_and_sides_do_not_matter() -> None:
    rng = np.random.default_rng(0)
    points, movers = rng.uniform(-1.5, 1.5, (30, 2)), rng.uniform(-1.5, 1.5, (2, 5))
    movers[:, 4] = 0.2
    told = foreseen_nearness(points, movers, ORIGIN, 0.4, 0.7)
    assert (told > 0.0).sum() > 5
    cos, sin = math.cos(1.1), math.sin(1.1)
    turn = np.array([[cos, sin], [-sin, cos]])
    elsewhere = movers.copy()
    elsewhere[:, :2], elsewhere[:, 2:4] = movers[:, :2] @ turn + (3.0, -2.0), movers[:, 2:4] @ turn
    moved = foreseen_nearness(points @ turn + (3.0, -2.0), elsewhere, np.array([3.0, -2.0, 1.1]), 0.4, 0.7)
    np.testing.assert_allclose(moved, told, atol=1e-5)
    mirrored = foreseen_nearness(points * (1, -1), movers * (1, -1, 1, -1, 1), ORIGIN, 0.4, -0.7)
    np.testing.assert_allclose(mirrored, told[MIRRORED_COMMANDS], atol=1e-5)


def test_nothing_near_is_nothing() -> None:
    far = np.array([[2.5, 0.0]])
    assert not foreseen_nearness(far, NOBODY, ORIGIN, 0.6, 0.0).any()
    assert not foreseen_nearness(np.empty((0, 3)), NOBODY, ORIGIN, 0.6, 0.0).any()


def test_the_near_horizon_ends_after_three_steps() -> None:
    """At full speed it sees what the robot passes on 0.252 m."""
    told = ForeseenClearance().nearness(np.array([[0.252, 0.3]]), NOBODY, ORIGIN, 0.6, 0.0)
    assert told[SOON][AHEAD] == told[LATER][AHEAD] == pytest.approx(nearness(0.3), abs=1e-5)
    told = ForeseenClearance().nearness(np.array([[0.252 + 0.4, 0.3]]), NOBODY, ORIGIN, 0.6, 0.0)
    assert told[SOON][AHEAD] == pytest.approx(nearness(0.5), abs=1e-5)
    assert told[LATER][AHEAD] > nearness(0.31)
    assert (told[SOON] <= told[LATER]).all()


def test_another_robot_foresees_by_its_own_limits_and_size() -> None:
    """2.5 m/s2 over 0.14 s: 0.35, 0.7, .., 1.75, 2, .. m/s, so it goes (2.5 * 2.5 + 1.875 + 4 * 2) * 0.14 m."""
    cart = RobotSettings(
        "cart", "disc", 0.3, None, max_speed_m_per_s=2.0, max_reverse_m_per_s=0.0, max_acceleration_m_per_s2=2.5
    )
    clearance = ForeseenClearance(cart)
    # Without a reverse the same actions are another quarter and none of its speed.
    assert clearance.commands[[AHEAD, HALF_AHEAD, STILL, BACK]].tolist() == [[2.0, 0], [1.25, 0], [0.5, 0], [0.0, 0]]
    went_m = (0.175 + 0.525 + 0.875 + 1.225 + 1.575 + 1.875 + 4 * 2.0) * 0.14
    told = clearance.nearness(np.array([[went_m + 0.34, 0.0]]), NOBODY, ORIGIN, 0.0, 0.0)[LATER]
    assert told[AHEAD] == pytest.approx(math.log10(0.8 / (0.34 - 0.24)), abs=1e-5)  # 0.8 of its radius is inside
    assert told[BACK] == 0.0
