"""What a map shows: its edges, and what detours, stop zone and a driver make of them."""

import copy
import math
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from test_navigator import ALL, AT_ONCE, in_robot, seen
from test_robot_driver import header, laser, odometry, path

from rcdsac_trl.deploy import Policy
from rcdsac_trl.deploy.navigation.local_map import LocalMap, LocalMapSettings
from rcdsac_trl.deploy.navigation.navigator import Navigator
from rcdsac_trl.deploy.navigation.static_layer import StaticLayer
from rcdsac_trl.deploy.policy.driver import Driver
from rcdsac_trl.deploy.ros.messages import static_layer_of
from rcdsac_trl.errors import UserInputError
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
        (lambda: StaticLayer.of_cells(np.ones((2, 2)), 0.0, AT_ORIGIN), "side of 0 m"),
        (lambda: StaticLayer.of_cells(np.indices((1500, 1500)).sum(axis=0) % 2, 0.05, AT_ORIGIN), "a coarser one"),
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
    assert advice.distances_m[0] == pytest.approx(math.inf)  # 1.5 m and farther: no stop zone reaches there
    assert navigator.advise(OPEN, ALL, goal, (0.0, 0.0), 0.14).waypoints == goal  # nobody says where it is


def test_the_stop_zone_minds_a_pane_in_a_sector_that_sees_through_it() -> None:
    navigator = Navigator(AT_ONCE, static_layer=StaticLayer.of_shapes(PANE))
    advice = navigator.advise(OPEN, ALL, ((3.5, 0.0),) * 2, (0.0, 0.0), 0.0, (0.7, 0.0, 0.0))
    exact = seen((0.7, 0.0, 0.0), PANE)
    near = exact < 1.4
    assert near.sum() > 40
    assert advice.distances_m[near] == pytest.approx(exact[near], abs=0.02)


def test_on_a_map_a_way_is_found_that_is_longer_than_what_a_robot_remembers() -> None:
    """A wall from 6 m left of the way to 7 m right: its ends lie outside of the remembered square."""
    wall = np.array([[1.5, -7.0, 1.5, 6.0]])
    given = ((2.5, 0.0), (2.5, 0.0))
    known = Navigator(AT_ONCE, static_layer=StaticLayer.of_shapes(wall))
    x, y, first = 0.0, 0.0, known.advise(seen(AT_ORIGIN, wall), ALL, given, (0.0, 0.0), 0.0, AT_ORIGIN)
    assert first.waypoints[0][1] > 6.0
    way_m = 0.0
    for _ in range(200):
        pose = (x, y, 0.0)
        goal = in_robot((2.5, 0.0), pose)
        told = Navigator(AT_ONCE, static_layer=StaticLayer.of_shapes(wall))
        advice = told.advise(seen(pose, wall), ALL, (goal, goal), (0.0, 0.0), 0.0, pose)
        dx, dy = advice.waypoints[0]
        apart = math.hypot(dx, dy)
        if apart < 0.15:
            break
        x, y, way_m = x + 0.15 * dx / apart, y + 0.15 * dy / apart, way_m + 0.15
    assert math.dist((x, y), (2.5, 0.0)) < 0.2
    assert 2.0 * 6.0 < way_m < 16.0  # around the nearer end
    # Without the map what is not seen is taken for free.
    blind = Navigator(AT_ONCE).advise(seen(AT_ORIGIN, wall), ALL, given, (0.0, 0.0), 0.0)
    assert abs(blind.waypoints[0][1]) < 4.0


# ------------------------------------------------------------------------------------------------ policy and driver
def policy() -> Policy:
    return Policy(agent(), navigator=Navigator(AT_ONCE, static_layer=StaticLayer.of_shapes(PANE)))


def test_a_policy_with_a_map_is_told_where_it_is() -> None:
    driver = policy()
    assert "give pose=" in str(driver.act(OPEN, AHEAD, STANDING).reason)
    assert "pose (nan" in str(driver.act(OPEN, AHEAD, STANDING, pose=(math.nan, 0.0, 0.0)).reason)
    assert "pose has shape [2]" in str(driver.act(OPEN, AHEAD, STANDING, pose=(0.0, 0.0)).reason)
    assert not driver.act(OPEN, AHEAD, STANDING, pose=AT_ORIGIN).stopped
    assert not Policy(agent()).act(OPEN, AHEAD, STANDING).stopped
    copied = copy.copy(driver)
    assert copied.navigator is not driver.navigator
    assert copied.navigator.static_layer is driver.navigator.static_layer  # type: ignore[union-attr]


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


def commanded(driver: Driver, now_s: float) -> str:
    driver.on_odometry(odometry(now_s, 0.0, 0.0))
    driver.on_scan(laser(now_s))
    return str(driver.command(now_s).reason)


def test_a_driver_with_detours_keeps_clear_of_the_map_that_comes() -> None:
    driver = Driver(Policy(agent()), detours=True)
    driver.on_path(path([(5.0, 0.0)]))
    commanded(driver, 100.0)
    advice = driver.policy._advice
    assert advice is not None
    assert advice.distances_m[0] == pytest.approx(2.0)
    driver.on_map(grid())
    commanded(driver, 100.14)
    assert driver.policy._advice.distances_m[0] == pytest.approx(1.0, abs=0.01)  # type: ignore[union-attr]
    driver.on_map(grid("map"))
    assert "the map is in frame 'map', the path in 'odom'" in commanded(driver, 100.28)
    driver.on_map(grid(width=7))
    assert "the map cannot be read (the map says 40 x 7 cells" in commanded(driver, 100.42)
    driver.on_map(grid())
    assert "map" not in commanded(driver, 100.56)


def test_a_driver_without_detours_needs_no_map() -> None:
    driver = Driver(Policy(agent()))
    driver.on_path(path([(5.0, 0.0)]))
    driver.on_map(grid("elsewhere"))
    assert "map" not in commanded(driver, 100.0)
