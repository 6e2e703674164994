"""What a map shows: its edges, and what detours, stop zone and a driver make of them."""

import copy
import math
from array import array
from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from motors import LateMotors
from test_frames import tf
from test_navigator import ALL, AT_ONCE, in_robot, seen
from test_robot_driver import header, laser, odometry, path

from rcdsac_trl.deploy import Guard, Policy
from rcdsac_trl.deploy.frames.rigid_transform import RigidTransform
from rcdsac_trl.deploy.navigation.detour import plan_detour
from rcdsac_trl.deploy.navigation.local_map import LocalMap, LocalMapSettings, clearances_around
from rcdsac_trl.deploy.navigation.navigator import Navigator
from rcdsac_trl.deploy.navigation.static_layer import StaticLayer
from rcdsac_trl.deploy.policy.driver import Driver
from rcdsac_trl.deploy.policy.input_checks import Stamps
from rcdsac_trl.deploy.ros.messages import static_layer_of
from rcdsac_trl.errors import UserInputError
from rcdsac_trl.robot.latency import Latency
from rcdsac_trl.robot.robot_settings import PAPER
from rcdsac_trl.robot.sectors import Mount, Sectors
from robots import AHEAD, OPEN, STANDING, agent

AT_ORIGIN = (0.0, 0.0, 0.0)
# A pane across the way that no sensor sees, open to the right.
PANE = np.array([[1.5, -0.8, 1.5, 2.2]])


def corners_of(points: np.ndarray) -> set[tuple[float, float]]:
    """Return the points that lie on corners of cells of 0.5 m."""
    return {(x, y) for x, y in points.round(9).tolist() if x % 0.5 == 0.0 and y % 0.5 == 0.0}


# ------------------------------------------------------------------------------------------------ edges
def test_a_grid_has_edges_where_an_occupied_cell_meets_one_that_is_not() -> None:
    occupied = np.array([[False, True, True], [False, False, True]])
    points = StaticLayer.of_cells(occupied, 0.5, AT_ORIGIN).around(AT_ORIGIN, 10.0)
    outline = {(0.5, 0.0), (1.0, 0.0), (1.5, 0.0), (1.5, 0.5), (1.5, 1.0), (1.0, 1.0), (1.0, 0.5), (0.5, 0.5)}
    assert corners_of(points) == outline
    # Nothing between the two cells of the first row, or of the last column.
    assert not ((points[:, 0] == 1.0) & (points[:, 1] > 0.01) & (points[:, 1] < 0.49)).any()
    assert not ((points[:, 1] == 0.5) & (points[:, 0] > 1.01) & (points[:, 0] < 1.49)).any()
    apart = np.hypot(*(points[:, None] - points[None]).T) + 9.0 * np.eye(len(points))
    assert apart.min(axis=0).max() <= 0.025 + 1e-9


def test_a_grid_lies_where_its_origin_says_and_is_told_around_the_robot() -> None:
    turned = StaticLayer.of_cells(np.array([[True]]), 0.5, (2.0, 1.0, math.pi / 2.0))
    assert corners_of(turned.around(AT_ORIGIN, 10.0)) == {(2.0, 1.0), (2.0, 1.5), (1.5, 1.0), (1.5, 1.5)}
    # A robot at (2, 0) that looks along y has the cell ahead and to its left.
    told = corners_of(turned.around((2.0, 0.0, math.pi / 2.0), 10.0))
    assert told == {(1.0, 0.0), (1.5, 0.0), (1.0, 0.5), (1.5, 0.5)}


def test_only_what_is_near_is_told() -> None:
    layer = StaticLayer.of_shapes(np.array([[-50.0, 1.0, 50.0, 1.0]]), np.array([[3.0, -1.0, 0.2], [30.0, 0.0, 1.0]]))
    points = layer.around((2.0, 0.0, 0.0), 3.0)
    assert np.abs(points).max() <= 3.0
    round_ = points[points[:, 1] < 0.9]
    assert np.hypot(round_[:, 0] - 1.0, round_[:, 1] + 1.0) == pytest.approx(0.2)
    assert len(round_) > 50
    assert StaticLayer.of_shapes(np.empty((0, 4))).around(AT_ORIGIN, 3.0).shape == (0, 2)


@pytest.mark.parametrize(
    ("make", "told"),
    [
        (lambda: StaticLayer(np.zeros((3, 3))), "not finite numbers"),
        (lambda: StaticLayer(np.array([[math.nan, 0.0]])), "not finite numbers"),
        (lambda: StaticLayer.of_cells(np.ones((2, 2), bool), 0.0, AT_ORIGIN), "side of 0.0: give metres"),
        (lambda: StaticLayer.of_cells(np.ones((2, 2), bool), 50.0, AT_ORIGIN), "side of 50.0: give metres"),
        (lambda: StaticLayer.of_cells(np.ones((2, 2), bool), 0.1, (0.0, math.nan, 0.0)), "the origin of a map"),
        (lambda: StaticLayer.of_cells(np.ones((2, 2), bool), 0.1, (0.0, 0.0)), "the origin of a map"),
        (lambda: StaticLayer.of_cells(np.ones((2, 2), bool), 0.1, (0.0, 0.0, 90.0)), "yaw in rad, two turns at most"),
        (lambda: StaticLayer.of_cells(np.ones((2, 2), bool), "0.1", AT_ORIGIN), "side of 0.1: give metres"),
        (lambda: StaticLayer.of_cells(np.ones((2, 2), np.int8), 0.1, AT_ORIGIN), "whether it is occupied"),
        (lambda: StaticLayer.of_cells(np.ones(2, bool), 0.1, AT_ORIGIN), "whether it is occupied"),
        (lambda: StaticLayer.of_cells(np.indices((1500, 1500)).sum(axis=0) % 2 == 0, 0.05, AT_ORIGIN), "above 5000000"),
        (lambda: StaticLayer.of_shapes(np.array([[0.0, 0.0, 1e9, 0.0]])), "and metres"),
        (lambda: StaticLayer.of_shapes(np.zeros(4)), "segments of a map"),
        (lambda: StaticLayer.of_shapes(np.empty((0, 4)), np.array([[0.0, 0.0, -1.0]])), "radius of -1 m"),
    ],
)
def test_what_is_no_map_is_refused(make: Any, told: str) -> None:
    with pytest.raises(UserInputError, match=told):
        make()


# ------------------------------------------------------------------------------------------------ navigation
def test_what_stands_on_the_map_counts_until_the_next_look_though_it_is_seen_through() -> None:
    local_map = LocalMap(LocalMapSettings(), ALL)
    local_map.observe(OPEN, standing=np.array([[1.02, 0.52]]))
    assert local_map.distance_m(1.0, 0.2) == pytest.approx(math.hypot(0.05, 0.3), abs=1e-6)  # one cell and six
    assert not len(local_map.remembered)
    local_map.observe(OPEN)
    assert local_map.distance_m(1.0, 0.2) == pytest.approx(LocalMapSettings().reach_m)


def test_a_detour_keeps_clear_of_a_pane_that_only_the_map_shows() -> None:
    """The robot is anywhere on the map, and looks anywhere: only where it says it is counts."""
    pose = (7.0, -3.0, 2.0)
    goal = (3.5, 0.0), (3.5, 0.0)
    cos, sin = math.cos(pose[2]), math.sin(pose[2])
    ends = PANE.reshape(2, 2) @ np.array([[cos, sin], [-sin, cos]]) + pose[:2]
    navigator = Navigator(AT_ONCE, static_layer=StaticLayer.of_shapes(ends.reshape(1, 4)))
    advice = navigator.advise(OPEN, ALL, goal, (0.0, 0.0), 0.0, pose)
    corner = advice.waypoints[0]
    assert corner[1] < -0.8 - 0.2
    # What is farther away than a stop zone reaches is left out.
    assert navigator.known(Sectors(OPEN, ALL), pose, 1.0).distances_m[0] == math.inf
    assert navigator.known(Sectors(OPEN, ALL), pose, 2.8).distances_m[0] < 2.0
    assert navigator.advise(OPEN, ALL, goal, (0.0, 0.0), 0.14).waypoints == goal  # nobody says where it is


def test_the_stop_zone_minds_a_pane_in_a_sector_that_sees_through_it() -> None:
    navigator = Navigator(AT_ONCE, static_layer=StaticLayer.of_shapes(PANE))
    known_m = navigator.known(Sectors(OPEN, ALL), (0.7, 0.0, 0.0), 1.5).distances_m
    exact = seen((0.7, 0.0, 0.0), PANE)
    near = exact < 1.4
    assert near.sum() > 40
    assert known_m[near] == pytest.approx(exact[near], abs=0.02)


@pytest.mark.parametrize("latency_s", [0.0, 0.28])
def test_a_fast_robot_stands_before_a_pane_that_only_the_map_shows(latency_s: float) -> None:
    """At 2 m/s its stop zone looks 2 m and farther."""
    robot = replace(PAPER, max_speed_m_per_s=2.0)
    navigator = Navigator(AT_ONCE, robot, StaticLayer.of_shapes(np.array([[6.0, -5.0, 6.0, 5.0]])))
    guard, latency, motors = Guard.of(robot), Latency(latency_s, robot), LateMotors(latency_s, robot)
    x = v = 0.0
    for step in range(50):
        ahead = latency.ahead((v, 0.0), 0.14 * step)
        known = navigator.known(Sectors(OPEN, ALL), (x, 0.0, 0.0), guard.reach_m(2.0, ahead))
        command = guard.limit(2.0, 0.0, known, (v, 0.0), None, ahead)[0], 0.0
        latency.note(command, 0.14 * step)
        poses, (v, _) = motors.driven(command, (x, 0.0, 0.0), (v, 0.0))
        x = poses[-1][0]
    assert v == 0.0
    assert 0.04 < 6.0 - x - guard.radius_m < 0.12


def follow(walls: np.ndarray, start: tuple[float, float], goal: tuple[float, float]) -> list[tuple[float, float]]:
    """Go to each waypoint that one navigator hands out on the way to a goal, with an exact pose."""
    navigator = Navigator(AT_ONCE, static_layer=StaticLayer.of_shapes(walls))
    places, v, omega = [start], 0.0, 0.0
    for step in range(400):
        pose = (*places[-1], 0.0)
        two = (in_robot(goal, pose),) * 2
        # Its odometry is told how the robot goes, as if that could go sideways.
        navigator._map.pose[:2] = np.array(places[-1]) - start
        dx, dy = navigator.advise(seen(pose, walls), ALL, two, (v, omega), 0.14 if step else 0.0, pose).waypoints[0]
        apart = math.hypot(dx, dy)
        if math.dist(places[-1], goal) < 0.1:
            break
        share = min(1.0, 0.08 / apart)
        places.append((places[-1][0] + share * dx, places[-1][1] + share * dy))
    return places


def length_m(places: list[tuple[float, float]]) -> float:
    return float(np.hypot(*np.diff(np.array(places), axis=0).T).sum())


def test_on_a_map_a_way_is_found_that_is_longer_than_what_a_robot_remembers() -> None:
    """A wall from 6 m left of the way to 7 m right: its ends lie outside of the remembered square."""
    wall = np.array([[1.5, -7.0, 1.5, 6.0]])
    places = follow(wall, (0.0, 0.0), (2.5, 0.0))
    assert math.dist(places[-1], (2.5, 0.0)) < 0.1
    assert 12.0 < length_m(places) < 15.0  # around the nearer end
    assert max(y for _, y in places) < 7.0
    # Without the map what is not seen is taken for free.
    blind = Navigator(AT_ONCE).advise(seen(AT_ORIGIN, wall), ALL, ((2.5, 0.0),) * 2, (0.0, 0.0), 0.0)
    assert abs(blind.waypoints[0][1]) < 4.0


def test_a_way_out_of_a_long_dead_end_is_kept_to_until_the_straight_way_is_free() -> None:
    """Once it is more than 3.6 m from the end wall, only the map knows that it is there."""
    walls = np.array([[0.0, -0.8, 6.0, -0.8], [0.0, 0.8, 6.0, 0.8], [6.0, -0.8, 6.0, 0.8]])
    places = follow(walls, (5.4, 0.0), (7.5, 0.0))
    assert math.dist(places[-1], (7.5, 0.0)) < 0.1
    assert length_m(places) < 17.0


def test_no_way_around_is_so_long_that_one_through_a_wall_seems_shorter() -> None:
    """Two places 1 m apart on both sides of a wall that is open at its far end alone."""
    walls = [[-9.0, -9.0, 9.0, -9.0], [9.0, -9.0, 9.0, 9.0], [9.0, 9.0, -9.0, 9.0], [-9.0, 9.0, -9.0, -9.0]]
    points = StaticLayer.of_shapes(np.array([*walls, [0.0, -9.0, 0.0, 8.0]])).around(AT_ORIGIN, 10.0)
    clearances = clearances_around((0.0, 0.0), points, 20.0, LocalMapSettings())
    corners = plan_detour(clearances, (-0.5, -8.0), (0.5, -8.0), 0.27)
    assert corners[-1] == (0.5, -8.0)
    assert 32.0 < length_m([(-0.5, -8.0), *corners]) < 36.0


# ------------------------------------------------------------------------------------------------ policy and driver
def policy() -> Policy:
    return Policy(agent(), navigator=Navigator(AT_ONCE, static_layer=StaticLayer.of_shapes(PANE)))


def test_a_policy_with_a_map_is_told_where_it_is() -> None:
    driver = policy()
    assert "give pose=" in str(driver.act(OPEN, AHEAD, STANDING).reason)
    for wrong in ((math.nan, 0.0, 0.0), (0.0, 0.0)):
        assert "three finite numbers" in str(driver.act(OPEN, AHEAD, STANDING, pose=wrong).reason)
    assert "more than two turns" in str(driver.act(OPEN, AHEAD, STANDING, pose=(0.0, 0.0, 90.0)).reason)
    assert not driver.act(OPEN, AHEAD, STANDING, pose=AT_ORIGIN).stopped
    assert not Policy(agent()).act(OPEN, AHEAD, STANDING).stopped
    copied = copy.copy(driver)
    assert copied.navigator is not driver.navigator
    assert copied.navigator.static_layer is driver.navigator.static_layer  # type: ignore[union-attr]


def test_the_stop_zone_minds_the_map_when_a_command_is_repeated_and_says_so() -> None:
    """A scanner at half the pace of the loop: every second call has the scan of the one before."""
    driver = policy()
    told = []
    for call in range(8):
        now = 100.0 + 0.14 * call
        scanned = 100.0 + 0.28 * (call // 2)
        # 4 cm before the pane, as far as the map says: every way ahead ends at it.
        pose = (1.5 - 0.29, 0.0, 0.0)
        told.append(driver.act(OPEN, AHEAD, [0.3, 0.0], stamps=Stamps(now, scanned, now, now), pose=pose))
    assert [each.fresh for each in told] == [True, False] * 4
    for each in told:
        assert each.v_m_per_s <= 0.0 or each.reason is not None
    limited = [each.reason for each in told if each.reason is not None]
    assert len(limited) == len([each for each in told if each.wanted[0] > 0.0])
    assert all("around what the map shows" in reason for reason in limited)
    seen_too = driver.act(np.full(180, 0.29), AHEAD, [0.3, 0.0], pose=(-9.0, 0.0, 0.0))
    assert "map" not in str(seen_too.reason)


def grid(frame: str = "odom", **changes: Any) -> SimpleNamespace:
    """A map of 20 x 40 cells of 0.1 m with a wall of one cell across its middle, unknown behind it."""
    cells = np.zeros((40, 20), np.int8)
    cells[:, 10] = 100
    cells[:, 11:] = -1
    rotation = SimpleNamespace(x=0.0, y=0.0, z=0.0, w=1.0)
    origin = SimpleNamespace(position=SimpleNamespace(x=0.0, y=-2.0, z=0.0), orientation=rotation)
    info = {"resolution": 0.1, "width": 20, "height": 40, "origin": origin} | changes
    return SimpleNamespace(header=header(0.0, frame), info=SimpleNamespace(**info), data=cells.ravel().tolist())


def test_an_occupancy_grid_is_read_and_a_broken_one_refused() -> None:
    x, y = static_layer_of(grid()).around(AT_ORIGIN, 10.0).T
    assert (x.min(), x.max()) == pytest.approx((1.0, 1.1))
    assert (y.min(), y.max()) == pytest.approx((-2.0, 2.0))
    with pytest.raises(UserInputError, match="30 x 20 cells and has 800"):
        static_layer_of(grid(height=30))


@pytest.mark.parametrize("kind", [np.int8, np.uint8, bytes, bytearray, array])
def test_cells_are_percentages_in_whatever_bytes_they_come(kind: Any) -> None:
    message = grid()
    cells = np.array(message.data, np.int8)
    if kind in (np.int8, np.uint8):
        message.data = cells.view(kind)
    else:
        message.data = kind("b", cells.tobytes()) if kind is array else kind(cells.tobytes())
    there, same = (static_layer_of(each).around(AT_ORIGIN, 10.0) for each in (grid(), message))
    assert np.array_equal(there, same)


def commanded(driver: Driver, now_s: float) -> str:
    driver.on_odometry(odometry(now_s, 0.0, 0.0))
    driver.on_scan(laser(now_s))
    return str(driver.command(now_s).reason)


def test_a_driver_with_detours_keeps_clear_of_the_map_that_comes() -> None:
    driver = Driver(Policy(agent()), detours=True, mount=Mount())
    driver.on_path(path([(5.0, 0.0)]))
    commanded(driver, 100.0)
    navigator = driver.policy.navigator
    assert navigator is not None
    assert driver.lacks_map
    assert navigator._far is None
    driver.on_map(grid())
    commanded(driver, 100.14)
    assert not driver.lacks_map
    assert navigator._map.distance_m(0.9, 0.0) == pytest.approx(0.1, abs=0.05)
    driver.on_map(grid("map"))
    assert "the map is in frame 'map', odometry in 'odom': no transform" in commanded(driver, 100.28)
    # The map lies 4 m behind the robot, turned around: its wall is 5 m behind.
    driver.on_transforms(tf(100.4, "map", "odom", RigidTransform.planar(4.0, 0.0, math.pi)))
    commanded(driver, 100.42)
    assert navigator._map.distance_m(0.9, 0.0) > 0.5
    assert navigator.static_layer is not None
    x, _ = navigator.static_layer.around((4.0, 0.0, math.pi), 5.0).T
    assert (x.min(), x.max()) == pytest.approx((2.9, 3.0))
    driver.on_map(grid(width=7))
    assert "the map cannot be read (the map says 40 x 7 cells" in commanded(driver, 100.56)
    driver.on_map(grid())
    assert "map" not in commanded(driver, 100.7)


def test_a_driver_without_detours_needs_no_map() -> None:
    driver = Driver(Policy(agent()))
    driver.on_path(path([(5.0, 0.0)]))
    driver.on_map(grid("elsewhere"))
    assert "map" not in commanded(driver, 100.0)
