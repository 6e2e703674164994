"""What the page shows of a drive: worked out by hand, or asked of the policy in another way."""

import contextlib
import math
from dataclasses import replace

import numpy as np
import pytest
from scenes_to_play import drive

from rcdsac_trl.agent.risk import MEASURES, CVaR, PowerLaw, make_measure
from rcdsac_trl.playground.drivers import AgentDriver
from rcdsac_trl.playground.page_words import robot_words
from rcdsac_trl.playground.view_state import (
    FINE,
    VALUES_A_SIDE,
    return_view,
    robot_view,
    sensor_view,
    value_view,
    weights_of,
)
from rcdsac_trl.robot.range_sensor import sensor_mask
from rcdsac_trl.world.maps.shapes import Map
from rcdsac_trl.world.render import Scene

EMPTY = Map("clutter", 20.0, (), (), ())


def scene(distances_m: np.ndarray, sensor: str) -> Scene:
    return Scene(
        EMPTY, (2.0, 3.0, 0.0), distances_m, sensor_mask(sensor), np.array([[5.0, 5.0]]), np.empty((0, 3)), [], False
    )


# ------------------------------------------------------------------------------------------------ the sensor
def test_sectors_that_see_nothing_are_shown_to_their_reach_and_those_that_are_missing_are_not() -> None:
    distances_m = np.full(180, np.inf)
    distances_m[[0, 1, 100]] = 1.0, 2.0, 1.0  # the last one the narrow sensor does not have
    shown = sensor_view(scene(distances_m, "narrow"))
    (near,) = shown.near
    assert near[0].tolist() == [2.0, 3.0]
    reach = np.hypot(*(near[1:] - (2.0, 3.0)).T)
    assert reach == pytest.approx([1.0, 1.0, 2.0, 2.0])
    assert math.degrees(math.atan2(near[-1, 1] - 3.0, near[-1, 0] - 2.0)) == pytest.approx(4.0)
    assert len(shown.hits) == 2
    assert shown.hits[0] == pytest.approx([3.0, 3.0, 2.0 + math.cos(math.pi / 90), 3.0 + math.sin(math.pi / 90)])
    assert sum(len(fan) - 1 for fan in shown.silent) == 2 * (43 - 2)
    assert all(np.hypot(*(fan[1:] - (2.0, 3.0)).T) == pytest.approx(3.0) for fan in shown.silent)


def test_sectors_of_a_sparse_sensor_are_shown_apart() -> None:
    shown = sensor_view(scene(np.full(180, 1.5), "sparse"))
    assert len(shown.near) == 18
    assert not shown.silent


# ------------------------------------------------------------------------------------------------ the critics
def test_weights_are_what_a_measure_puts_on_each_part() -> None:
    assert weights_of(CVaR(), 0.25, 8).tolist() == [4.0, 4.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0]
    # The power law at -1: g(u) = 1 - (1 - u)^2.
    borders = np.arange(5) / 4
    assert weights_of(PowerLaw(), -1.0, 4) == pytest.approx(4 * np.diff(1.0 - (1.0 - borders) ** 2))


@pytest.mark.parametrize("name", MEASURES)
def test_weights_of_every_measure_share_the_whole_out(name: str) -> None:
    measure = make_measure(name)
    for beta in (measure.low, measure.high):
        weights = weights_of(measure, beta, 16)
        assert weights.mean() == pytest.approx(1.0)
        assert weights.min() >= 0.0


@pytest.mark.parametrize("agent", ["rcdsac_pow-narrow", "rcdsac_cvar-narrow", "dsac_pow_-1-narrow"])
def test_the_curve_and_the_value_of_every_action_agree_with_the_policy(agent: str) -> None:
    with contextlib.closing(drive(agent=agent)) as played:
        (robot,) = played.robots
        assert return_view(robot) is None
        assert value_view(robot) is None
        for _ in range(12):
            played.step()
        driver = robot.driver
        assert isinstance(driver, AgentDriver)
        told = driver.policy.foresee(robot.dialled)
        shown = return_view(robot)
        assert shown is not None
        assert told.quantiles is not None
        assert shown.quantiles == pytest.approx(told.quantiles)
        assert shown.mean == pytest.approx(told.value, rel=1e-5)
        assert shown.value < shown.mean  # the default is averse
        values = value_view(robot)
        assert values is not None
        assert values.speeds_m_per_s == pytest.approx((-0.2, 0.6))
        assert values.turns_deg_per_s == pytest.approx((-90.0, 90.0))
        assert values.values.shape == (FINE * (VALUES_A_SIDE - 1) + 1,) * 2
        assert driver.measure is not None
        beta = driver.beta(robot.dialled)
        assert beta is not None
        for row, column in ((0, 0), (3, 7), (10, 10)):
            asked = (2.0 * column / 10 - 1.0, 2.0 * row / 10 - 1.0)
            expected = driver.policy.foresee(robot.dialled, action=asked).quantiles
            assert expected is not None
            by_hand = float((expected * weights_of(driver.measure, beta, len(expected))).mean())
            assert values.values[row * FINE, column * FINE] == pytest.approx(by_hand, abs=1e-3)


def test_it_is_said_of_a_curve_that_it_is_recalibrated() -> None:
    with contextlib.closing(drive(agent="rcdsac_cvar-narrow")) as played:
        (robot,) = played.robots
        played.step()
        assert isinstance(robot.driver, AgentDriver)
        shown = robot_view(robot, robot.arena.scene(), None)
        assert shown.returns is not None
        assert shown.returns.recalibrated == robot.driver.policy.recalibrated
        for told in (False, True):
            words = robot_words(replace(shown, returns=replace(shown.returns, recalibrated=told)))["value"]
            assert words.endswith("(dashed), recalibrated" if told else "(dashed)")


@pytest.mark.parametrize(("agent", "has_values"), [("sac-narrow", True), ("rcwr-narrow", True), ("dwa", False)])
def test_who_knows_no_distribution_shows_none(agent: str, has_values: bool) -> None:
    with contextlib.closing(drive(agent=agent)) as played:
        (robot,) = played.robots
        played.step()
        assert return_view(robot) is None
        assert (value_view(robot) is not None) == has_values


# ------------------------------------------------------------------------------------------------ the robot
def test_a_robot_is_shown_where_it_is_with_its_numbers() -> None:
    with contextlib.closing(drive(second="mppi", stop="on")) as played:
        for _ in range(20):
            played.step()
        for robot in played.robots:
            shown = robot_view(robot, robot.arena.scene(), None)
            x, y, yaw = shown.pose
            assert np.hypot(*(shown.body - (x, y)).T) == pytest.approx(0.25)
            tip = shown.arrow[0] - (x, y)
            assert math.atan2(tip[1], tip[0]) == pytest.approx(yaw)
            assert shown.way[0].tolist() == [x, y]
            assert shown.trail.shape == (21, 3)
            assert shown.trail[-1, :2].tolist() == [x, y]
            assert shown.speed_m_per_s == shown.trail[-1, 2]
            nearest_m = robot.arena.scene().distances_m.min()
            assert shown.clearance_m == pytest.approx(min(nearest_m, 3.0) - 0.25, abs=0.02)  # what is measured is noisy
            assert shown.time_s == pytest.approx(20 * played.period_s)
            assert shown.told is not None
            assert -90.0 <= shown.told[1] <= 90.0
