"""Following a path by progress: loops, crossings, long legs, republished and replanned paths, robots pushed about."""

import math
from collections.abc import Callable
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from rcdsac_trl.deploy import PathFollower
from rcdsac_trl.deploy.policy.polyline import Polyline, corners
from rcdsac_trl.errors import UserInputError

RADIUS_M, GOAL_M, STEP_M = 0.5, 0.15, 0.1
CONFIG: Any = SimpleNamespace(waypoint_radius_m=RADIUS_M, goal_radius_m=GOAL_M)
LOOP = [(0.0, 0.0), (4.0, 0.0), (4.0, 4.0), (0.0, 4.0), (0.0, 0.0)]
Place = tuple[float, float]
Path = list[Place]


def waypoints(follower: PathFollower, x: float, y: float) -> list[list[float]] | None:
    """Return the next two in the map frame: the robot looks along its x axis."""
    two = follower.update((x, y, 0.0))
    return None if two is None else (two + np.array([x, y])).round(9).tolist()


def drive(
    follower: PathFollower, start: Place, *, length_m: float, before_step: Callable[[int, Place], Place] | None = None
) -> list[Place]:
    """Drive straight to each first waypoint until the goal is reached, and return the places on the way.

    Args:
        follower: that leads.
        start: where.
        length_m: of the path; three times of it, and 20 m, must be enough.
        before_step: may do something, and move the robot, before each step.
    """
    here, trail = start, [start]
    for step in range(200 + int(3.0 * length_m / STEP_M)):
        if before_step is not None:
            here = before_step(step, here)
            trail.append(here)
        two = follower.update((*here, 0.0))
        if two is None:
            return trail
        apart = math.hypot(*two[0])
        share = min(STEP_M / apart, 1.0) if apart > 0.0 else 0.0
        here = here[0] + share * two[0, 0], here[1] + share * two[0, 1]
        trail.append(here)
    raise AssertionError(f"{start} did not arrive: last {trail[-3:]}")


def visited(trail: list[Place], path: NDArray[np.float64], within_m: float) -> int:
    """Return how many corners of a path a robot came by, in their order."""
    number = 0
    for place in trail:
        while number < len(path) and math.dist(place, path[number]) <= within_m:
            number += 1
    return number


# ------------------------------------------------------------------------------------------------ single paths
def test_what_is_ahead_are_the_corners_not_reached_yet() -> None:
    follower = PathFollower(LOOP, CONFIG)
    follower.update((1.0, 0.0, 0.0))
    assert follower.ahead.tolist() == [[4.0, 0.0], [4.0, 4.0], [0.0, 4.0], [0.0, 0.0]]
    follower.update((3.8, 0.0, 0.0))
    assert follower.ahead.tolist() == [[4.0, 4.0], [0.0, 4.0], [0.0, 0.0]]


def test_a_loop_is_driven_round_before_it_is_reached() -> None:
    follower = PathFollower(LOOP, CONFIG)
    assert waypoints(follower, 0.0, 0.0) == [[4.0, 0.0], [4.0, 4.0]]
    trail = drive(PathFollower(LOOP, CONFIG), (0.0, 0.0), length_m=16.0)
    assert visited(trail, np.array(LOOP), RADIUS_M) == 5
    assert len(trail) * STEP_M > 14.0


def test_two_laps_are_two() -> None:
    twice = LOOP + LOOP[1:]
    trail = drive(PathFollower(twice, CONFIG), (0.0, 0.0), length_m=32.0)
    assert len(trail) * STEP_M > 28.0


def test_there_and_back_on_one_line_turns_at_the_end() -> None:
    follower = PathFollower([(0.0, 0.0), (5.0, 0.0), (0.0, 0.0)], CONFIG)
    assert waypoints(follower, 2.0, 0.1) == [[5.0, 0.0], [0.0, 0.0]]
    assert waypoints(follower, 4.6, 0.1) == [[0.0, 0.0], [0.0, 0.0]]
    assert waypoints(follower, 2.0, 0.0) == [[0.0, 0.0], [0.0, 0.0]]
    assert follower.update((0.1, 0.0, 0.0)) is None


def test_waypoints_are_at_most_20_m_ahead_on_a_long_way() -> None:
    follower = PathFollower([(0.0, 0.0), (130.0, 0.0), (130.0, 5.0)], CONFIG)
    assert waypoints(follower, 0.0, 0.4) == [[20.0, 0.0], [40.0, 0.0]]
    for x in np.arange(0.5, 100.5, 0.5).tolist():
        follower.update((x, 0.0, 0.0))
    assert waypoints(follower, 100.0, -1.0) == [[120.0, 0.0], [130.0, 0.0]]
    for x in np.arange(100.5, 115.5, 0.5).tolist():
        follower.update((x, 0.0, 0.0))
    assert waypoints(follower, 115.0, 0.0) == [[130.0, 0.0], [130.0, 5.0]]


def test_a_corner_that_is_passed_at_a_distance_is_passed() -> None:
    follower = PathFollower([(0.0, 0.0), (4.0, 0.0), (4.0, 9.0)], CONFIG)
    for x, y in [(0.0, 0.0), (2.0, 0.0), (2.9, 0.4), (3.1, 0.9)]:  # something stands on the corner
        assert waypoints(follower, x, y) == [[4.0, 0.0], [4.0, 9.0]]
    assert waypoints(follower, 3.2, 1.6) == [[4.0, 9.0], [4.0, 9.0]]


def test_who_is_pushed_back_around_a_corner_goes_around_it_again() -> None:
    path = [(0.0, 0.0), (4.0, 0.0), (4.0, 9.0)]
    follower = PathFollower(path, CONFIG)
    for x, y in [(0.0, 0.0), (2.0, 0.0), (3.6, 0.0), (4.0, 1.0)]:
        follower.update((x, y, 0.0))
    assert waypoints(follower, 3.0, 0.0) == [[4.0, 9.0], [4.0, 9.0]]  # a little: what was passed stays passed
    assert waypoints(follower, 1.0, 0.0) == [[4.0, 0.0], [4.0, 9.0]]
    assert visited(drive(follower, (1.0, 0.0), length_m=13.0), np.array(path[1:]), RADIUS_M) == 2


def test_who_is_carried_away_begins_at_the_nearest_place() -> None:
    follower = PathFollower([(0.0, 0.0), (60.0, 0.0), (60.0, 60.0), (0.0, 60.0)], CONFIG)
    assert waypoints(follower, 0.0, 0.0) == [[20.0, 0.0], [40.0, 0.0]]
    for republished in (False, True):
        if republished:
            follower.replan([(0.0, 0.0), (60.0, 0.0), (60.0, 60.0), (0.0, 60.0)])
        assert waypoints(follower, 50.0, 60.0) == [[30.0, 60.0], [10.0, 60.0]]


def test_a_pose_that_is_refused_costs_no_progress() -> None:
    path = [(0.0, 0.0), (4.0, 0.0), (4.0, 4.0), (0.0, 4.0), (0.0, 0.5)]
    follower = PathFollower(path, CONFIG)
    for x, y, expected in [(0.0, 0.0, [4.0, 0.0]), (3.8, 0.0, [4.0, 4.0])]:
        for pose in [(-500.0, 9.0, 0.0), (0.0, 0.0, math.inf), (0.0, 0.0, 180.0)]:
            with pytest.raises(UserInputError):
                follower.update(pose)
        follower.replan([(x + 1e-3, y) for x, y in path])
        with pytest.raises(UserInputError):
            follower.update((-500.0, 9.0, 0.0))
        assert waypoints(follower, x, y)[0] == pytest.approx(expected, abs=2e-3)


def test_repeated_poses_and_a_path_of_one_place_are_paths() -> None:
    repeated = [point for point in LOOP for _ in range(3)]
    assert waypoints(PathFollower(repeated, CONFIG), 0.0, 0.0) == [[4.0, 0.0], [4.0, 4.0]]
    for path in ([(2.0, 1.0)], [(2.0, 1.0)] * 4, [(2.0, 1.0), (2.01, 1.0), (2.0, 1.0)]):
        follower = PathFollower(path, CONFIG)
        assert waypoints(follower, 0.0, 0.0) == [[2.0, 1.0], [2.0, 1.0]]
        assert follower.update((2.0, 1.1, 0.0)) is None


@pytest.mark.parametrize(
    ("path", "pose", "told"),
    [
        ([(0.0, 0.0), (4000.0, 0.0)], (0.0, 0.0, 0.0), "straight on: give metres"),
        ([(0.0, 0.0), (4e9, 0.0)], (0.0, 0.0, 0.0), "on no map: give metres"),
        (
            [(0.0, 0.0), (4.0, 0.0)],
            (2000.0, 100.0, 0.0),
            "m from its path, more than 75 m: give pose and path in metres",
        ),
        ([(0.0, 0.0), (4.0, 0.0)], (0.0, 0.0, 90.0), "yaw=90 is more than two turns: give radians"),
        ([(0.0, 0.0), (4.0, 0.0)], (0.0, math.nan, 0.0), "is not three finite numbers"),
        ([(0.0, 0.0), (4.0, 0.0)], (0.0, 0.0), "is not three finite numbers"),
        ([(0.0, 0.0), (4.0, 0.0)], "here", "are not numbers"),
        (np.ma.array([(0.0, 0.0), (4.0, 0.0)], mask=[(0, 0), (0, 1)]), (0.0, 0.0, 0.0), "give finite points"),
        ([("0", "0"), ("4", "0")], (0.0, 0.0, 0.0), "a path's points are not numbers"),
    ],
)
def test_what_cannot_be_metres_and_radians_is_refused(path: Any, pose: Any, told: str) -> None:
    with pytest.raises(UserInputError, match=told):
        PathFollower(path, CONFIG).update(pose)


@pytest.mark.parametrize("config", [None, {"waypoint_radius_m": 0.5, "goal_radius_m": 0.15}])
def test_a_follower_without_radii_is_refused_where_it_is_made(config: Any) -> None:
    with pytest.raises(UserInputError, match=r"has no waypoint_radius_m and goal_radius_m: give policy\.config"):
        PathFollower([(0.0, 0.0), (2.0, 0.0)], config)


def test_a_map_of_large_coordinates_is_one() -> None:
    x, y = 500_000.0, 5_400_000.0  # as projected coordinates of the Earth are
    follower = PathFollower([(x, y), (x + 3.0, y), (x + 3.0, y + 3.0)], CONFIG)
    assert waypoints(follower, x, y) == [[x + 3.0, y], [x + 3.0, y + 3.0]]


# ------------------------------------------------------------------------------------------------ new paths
def test_the_same_path_again_changes_nothing() -> None:
    follower = PathFollower(LOOP, CONFIG)
    for x, y in [(0.0, 0.0), (3.6, 0.0), (4.0, 2.0), (4.0, 3.6), (2.0, 4.0)]:
        before = waypoints(follower, x, y)
        follower.replan(LOOP)
        assert waypoints(follower, x, y) == before
    assert before == [[0.0, 4.0], [0.0, 0.0]]


def test_a_path_that_was_driven_stays_driven_while_the_robot_is_there() -> None:
    follower = PathFollower(LOOP, CONFIG)
    drive(follower, (0.0, 0.0), length_m=16.0)
    for path in (LOOP, [(x + 0.01, y) for x, y in LOOP]):
        follower.replan(path)
        assert follower.reached
        assert follower.update((0.0, 0.2, 0.0)) is None  # drifted a little, but there
    follower.replan(LOOP)
    assert waypoints(follower, 3.0, 0.0) == [[4.0, 0.0], [4.0, 4.0]]  # carried away: it is driven again


@pytest.mark.parametrize(
    "before", [[(-5.0, 0.0), (0.0, 0.0)], [(0.0, 4.0), (0.0, 0.0)], LOOP[::-1], [*LOOP[:2], LOOP[4]]]
)
def test_another_path_to_the_goal_that_was_reached_is_driven(before: Path) -> None:
    follower = PathFollower(before, CONFIG)
    drive(follower, before[0], length_m=16.0)
    follower.replan(LOOP)
    assert waypoints(follower, 0.1, 0.0) == [[4.0, 0.0], [4.0, 4.0]]
    assert not follower.reached


def test_a_replanned_path_is_followed_from_where_the_robot_has_got_to() -> None:
    eight = [(0.0, 0.0), (6.0, 0.0), (6.0, 3.0), (3.0, 3.0), (3.0, -3.0), (8.0, -3.0)]  # crosses itself in (3, 0)
    second = PathFollower(eight, CONFIG)
    for x, y in [(0.0, 0.0), (5.7, 0.0), (6.0, 2.7), (3.3, 3.0), (3.0, 0.1)]:
        second.update((x, y, 0.0))
    first = PathFollower(eight, CONFIG)
    first.update((0.0, 0.0, 0.0))
    moved = [(x + 0.2, y - 0.1) for x, y in eight]
    longer = [*eight, (8.0, 5.0)]
    rest = [(3.0, 0.1), (3.0, -3.0), (8.0, -3.0)]
    detour = [(0.0, 0.0), (6.0, 0.0), (6.0, 3.0), (3.0, 3.0), (3.0, -4.0), (8.0, -4.0), (8.0, -3.0)]
    for path, down in ((moved, -3.1), (longer, -3.0), (rest, -3.0), (detour, -4.0)):
        second.replan(path)
        assert waypoints(second, 3.0, 0.0)[0] == pytest.approx([path[-1][0] - 5.0, down], abs=0.3)
    for path in (moved, longer, detour):
        first.replan(path)
        assert waypoints(first, 3.0, 0.0)[0] == [path[1][0], path[1][1]]


# ------------------------------------------------------------------------------------------------ any path
grid = st.lists(st.tuples(st.integers(-5, 5).map(float), st.integers(-5, 5).map(float)), min_size=2, max_size=8)
events = st.lists(st.tuples(st.integers(0, 400), st.sampled_from(["again", "jitter", "rest"])), max_size=12)


@settings(max_examples=150, deadline=None)
@given(grid, events, st.integers(0, 2**32 - 1))
def test_any_path_is_driven_to_its_end_past_all_its_corners(
    path: Path, events: list[tuple[int, str]], seed: int
) -> None:
    """Whenever it is published again, moved a little, or planned anew from where the robot is."""
    rng = np.random.default_rng(seed)
    follower = PathFollower(path, CONFIG)
    points = corners(np.array(path), 0.05)
    length_m = Polyline(points).length_m
    due = dict(events)

    def publish(step: int, here: Place) -> Place:
        event = due.get(step)
        if event == "again":
            follower.replan(path)
        elif event == "jitter":
            follower.replan(np.array(path) + rng.uniform(-0.05, 0.05, 2))
        elif event == "rest" and step > 0:
            line = follower._line
            follower.replan([here, *line.points[follower._next :].tolist()])
        return here

    trail = drive(follower, path[0], length_m=length_m, before_step=publish)
    assert visited(trail, points, RADIUS_M + STEP_M + 0.1) == len(points)
    assert math.dist(trail[-1], path[-1]) < GOAL_M + 0.1


@settings(max_examples=100, deadline=None)
@given(grid, st.lists(st.tuples(st.integers(0, 300), st.floats(-2.5, 2.5), st.floats(-2.5, 2.5)), max_size=5))
def test_any_path_is_driven_to_its_end_by_a_robot_that_is_pushed_about(
    path: Path, pushes: list[tuple[int, float, float]]
) -> None:
    follower = PathFollower(path, CONFIG)
    length_m = Polyline(corners(np.array(path), 0.05)).length_m
    due = {step: (dx, dy) for step, dx, dy in pushes}

    def push(step: int, here: Place) -> Place:
        dx, dy = due.get(step, (0.0, 0.0))
        return here[0] + dx, here[1] + dy

    trail = drive(follower, path[0], length_m=length_m + 20.0 * len(pushes), before_step=push)
    assert math.dist(trail[-1], path[-1]) < GOAL_M + STEP_M


@settings(max_examples=100, deadline=None)
@given(grid, st.floats(-6.0, 6.0), st.floats(-6.0, 6.0), st.floats(-3.0, 3.0))
def test_waypoints_lie_on_the_path_wherever_the_robot_is(path: Path, x: float, y: float, yaw: float) -> None:
    follower = PathFollower(path, CONFIG)
    line = Polyline(corners(np.array(path), 0.05))
    two = follower.update((x, y, yaw))
    if two is None:
        assert math.dist((x, y), path[-1]) < GOAL_M
        return
    cos, sin = math.cos(yaw), math.sin(yaw)
    for point in two @ np.array([[cos, sin], [-sin, cos]]) + (x, y):
        off = line.closest((float(point[0]), float(point[1])), 0.0, line.length_m)[1] if len(line.points) > 1 else point
        assert off.min() < 1e-6 or math.dist(point, line.points[0]) < 1e-6


@settings(max_examples=100, deadline=None)
@given(st.lists(st.tuples(st.floats(-3.0, 3.0), st.floats(-3.0, 3.0)), min_size=1, max_size=30))
def test_thinned_paths_stay_near_and_keep_their_ends(path: Path) -> None:
    points = np.array(path)
    kept = corners(points, 0.05)
    assert math.dist(kept[0], points[0]) <= 1e-6
    assert math.dist(kept[-1], points[-1]) <= 1e-6
    line = Polyline(kept)
    assert all(line.nearest((x, y), 0.0, line.length_m)[1] <= 0.05 + 0.03 for x, y in path)
    assert (np.diff(line.along_m) > 0.0).all()
