"""Speed limit and stop zone: closed forms on plain scenes, and no collision in any scene, whatever is commanded."""

import math
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st
from motors import LateMotors, driven

from rcdsac_trl.deploy import Guard, PathFollower, Sectors
from rcdsac_trl.errors import UserInputError
from rcdsac_trl.robot.action import clip_command
from rcdsac_trl.robot.compiled_guard import CompiledGuard
from rcdsac_trl.robot.guard import _BESIDE_M
from rcdsac_trl.robot.latency import Ahead, Latency
from rcdsac_trl.robot.robot_settings import PAPER
from rcdsac_trl.world.sim.lidar import sector_distances
from robots import agent

ALL = np.ones(180, dtype=np.bool_)
OPEN = Sectors(np.full(180, np.inf), ALL)
NO_SEGMENTS, NO_CIRCLES = np.empty((0, 4)), np.empty((0, 3))


def wall_at(x: float) -> Sectors:
    """A long wall across the way."""
    return Sectors(sector_distances(0.0, 0.0, 0.0, np.array([[x, -9.0, x, 9.0]]), NO_CIRCLES), ALL)


def test_the_limits_hold_and_are_told() -> None:
    guard = Guard(max_speed_m_per_s=0.3, max_reverse_m_per_s=0.1, max_turn_rad_per_s=0.5)
    assert guard.limit(0.6, -1.0, OPEN) == (0.3, -0.5, "the speed limit")
    assert guard.limit(-0.2, 1.0, OPEN) == (-0.1, 0.5, "the speed limit")
    assert guard.limit(0.3, 0.5, OPEN) == (0.3, 0.5, None)


def test_the_way_to_a_wall_is_that_of_reaction_and_braking() -> None:
    guard = Guard()
    # At 0.6 m/s: 0.25 s on, then 0.36 / (2 x 1.5) m, less half a step of 0.05 s: the speed falls in steps.
    way = 0.6 * 0.25 + 0.36 / 3.0 - 0.6 * 0.05 / 2.0
    needed = guard.radius_m + guard.margin_m + way
    assert guard.limit(0.6, 0.0, wall_at(needed + 0.01), (0.6, 0.0)) == (0.6, 0.0, None)
    v, omega, reason = guard.limit(0.6, 0.7, wall_at(needed - 0.01), (0.6, 0.0))
    assert (omega, reason) == (0.7, "the stop zone")
    assert v < 0.6
    assert guard.limit(0.6, 0.0, wall_at(0.31))[0] == 0.0
    assert guard.limit(-0.2, 0.0, wall_at(0.31)) == (-0.2, 0.0, None)  # away from it


def test_beside_a_wall_it_may_go_along_and_away_but_not_nearer() -> None:
    beside = Sectors(sector_distances(0.0, 0.0, 0.0, np.array([[-9.0, 0.27, 9.0, 0.27]]), NO_CIRCLES), ALL)
    assert Guard().limit(0.4, -0.5, beside)[0] == 0.4
    v, omega, reason = Guard().limit(0.4, 0.5, beside, (0.4, 0.5))
    assert (omega, reason) == (0.5, "the stop zone")
    assert v < 0.4


def test_it_drives_blind_neither_way_unless_told_to() -> None:
    ahead = Sectors(np.full(180, np.inf), (np.arange(180) < 21) | (np.arange(180) >= 158))
    assert Guard().limit(-0.2, 0.3, ahead) == (0.0, 0.3, "nothing senses what lies behind")
    assert Guard(blind_reverse=True).limit(-0.2, 0.3, ahead) == (-0.2, 0.3, None)
    behind = Sectors(ahead.distances_m, ~ahead.covered)
    assert Guard().limit(0.2, 0.0, behind) == (0.0, 0.0, "nothing senses what lies ahead")


def free_distance(x: float, y: float, segments: np.ndarray, circles: np.ndarray) -> float:
    return float(sector_distances(x, y, 0.0, segments, circles).min())


# ------------------------------------------------------------------------------------------------ ways out
def beside_the_way(gap_m: float, y: float) -> Sectors:
    """A thing of 10 cm radius whose middle is off the way, so far before the robot's circle."""
    x = math.sqrt((0.25 + gap_m + 0.1) ** 2 - y * y)
    return Sectors(sector_distances(0.0, 0.0, 0.0, NO_SEGMENTS, np.array([[x, y, 0.1]])), ALL)


@pytest.mark.parametrize("side", [-1.0, 1.0])
def test_where_it_would_stand_for_good_it_turns_away_from_what_is_in_the_way(side: float) -> None:
    seen = beside_the_way(0.05, side * 0.3)
    assert replace(Guard(), evade=False).limit(0.3, 0.0, seen) == (0.0, 0.0, "the stop zone")
    v, omega, reason = Guard().limit(0.3, 0.0, seen)
    assert (v <= 0.2, reason) == (True, "the stop zone")
    assert omega * side < 0.0  # to the other side


def test_before_what_it_cannot_pass_it_turns_the_shorter_way() -> None:
    """A corner: a wall ahead, and one to the left; to the right the way is free."""
    walls = np.array([[0.27, -9.0, 0.27, 9.0], [-9.0, 0.27, 9.0, 0.27]])
    seen = Sectors(sector_distances(0.0, 0.0, 0.0, walls, NO_CIRCLES), ALL)
    for wish in (-0.5, 0.0):
        v, omega, reason = Guard().limit(0.6, wish, seen)
        assert (v, reason) == (0.0, "the stop zone")
        assert omega < -0.5
    enclosed = Sectors(np.full(180, 0.27), ALL)
    assert Guard().limit(0.6, 0.3, enclosed) == (0.0, 0.3, "the stop zone")


def test_it_gets_around_a_post_that_it_would_stand_before() -> None:
    """The driver wants straight on to a goal behind the post, and knows nothing of it."""

    def nearest_m(evade: bool) -> float:
        guard, circles = replace(Guard(), evade=evade), np.array([[1.0, 0.02, 0.1]])
        x = y = yaw = v = omega = 0.0
        nearest = math.inf
        for _ in range(300):
            bearing = math.remainder(math.atan2(-y, 2.5 - x) - yaw, 2.0 * math.pi)
            wish = 0.4 * max(0.2, math.cos(bearing)), max(-1.5, min(1.5, 2.0 * bearing))
            seen = Sectors(sector_distances(x, y, yaw, NO_SEGMENTS, circles), ALL)
            command = guard.limit(*wish, seen, (v, omega))[:2]
            poses, (v, omega) = driven(command, (x, y, yaw), (v, omega))
            x, y, yaw = poses[-1]
            assert free_distance(x, y, NO_SEGMENTS, circles) > guard.radius_m
            nearest = min(nearest, math.dist((x, y), (2.5, 0.0)))
        return nearest

    assert nearest_m(evade=False) > 1.5
    assert nearest_m(evade=True) < 0.2


AHEAD_ONLY = (np.arange(180) < 21) | (np.arange(180) >= 158)


def test_it_backs_where_it_has_been_and_nowhere_else() -> None:
    seen = Sectors(np.full(180, np.inf), AHEAD_ONLY)
    been = np.column_stack([np.linspace(-0.6, 0.0, 31), np.zeros(31)])
    assert Guard().limit(-0.2, 0.0, seen, been=been) == (-0.2, 0.0, None)
    assert Guard().limit(-0.2, 1.5, seen, (-0.2, 1.5), been=been)[0] > -0.2  # off its way
    assert Guard().limit(-0.2, 0.0, seen, been=been[-3:])[0] > -0.2  # it came from 4 cm behind
    assert Guard().limit(-0.2, 0.0, seen, been=been[-1:])[0] == 0.0
    assert Guard().limit(-0.2, 0.0, seen, been=np.empty((0, 2)))[0] == 0.0


@settings(max_examples=40, deadline=None)
@given(st.integers(0, 2**32 - 1))
@example(302)  # it drives on within 4 mm of what it never saw, and backs 1 mm beside its way
def test_who_sees_ahead_alone_never_backs_into_what_stands(seed: int) -> None:
    """Whatever is commanded. What it never saw beside it, it may touch as it drives on, and graze where it has been."""
    rng = np.random.default_rng(seed)
    circles = np.column_stack([rng.uniform(-2, 2, (25, 2)), rng.uniform(0.02, 0.2, 25)])
    guard = Guard()
    if free_distance(0.0, 0.0, NO_SEGMENTS, circles) < guard.radius_m + guard.margin_m:
        return
    x = y = yaw = v = omega = 0.0
    trail = [(0.0, 0.0)]
    for step in range(150):
        if step % 8 == 0:
            wanted = float(rng.choice([0.4, -0.2, -0.04])), float(rng.uniform(-1.0, 1.0))
        seen_m = sector_distances(x, y, yaw, NO_SEGMENTS, circles)
        cos, sin = math.cos(yaw), math.sin(yaw)
        been = (np.array(trail) - (x, y)) @ np.array([[cos, -sin], [sin, cos]])
        seen = Sectors(np.where(AHEAD_ONLY, seen_m, np.inf), AHEAD_ONLY)
        command = guard.limit(*wanted, seen, (v, omega), been)[:2]
        for _ in range(7):
            v, omega = clip_command(*command, v, omega)
            yaw += omega * 0.02
            x, y = x + v * 0.02 * math.cos(yaw), y + v * 0.02 * math.sin(yaw)
            if (distance_m := free_distance(x, y, NO_SEGMENTS, circles)) < guard.radius_m:
                assert v > 0.0 or distance_m >= guard.radius_m - _BESIDE_M
                return
        if v > 0.0 and math.dist(trail[-1], (x, y)) > 0.02:
            trail.append((x, y))


@settings(max_examples=40, deadline=None)
@given(st.integers(0, 2**32 - 1))
def test_no_command_drives_into_what_is_sensed(seed: int) -> None:
    rng = np.random.default_rng(seed)
    segments = rng.uniform(-3, 3, (6, 4))
    circles = np.column_stack([rng.uniform(-3, 3, (10, 2)), rng.uniform(0.02, 0.3, 10)])
    guard = Guard()
    if free_distance(0.0, 0.0, segments, circles) < guard.radius_m + guard.margin_m:
        return
    x = y = yaw = v = omega = 0.0
    wanted = (0.0, 0.0)
    for step in range(150):
        if step % 5 == 0:  # a driver who holds on to what hurts for a while
            wanted = float(rng.choice([0.6, 0.6, -0.2, rng.uniform(-0.2, 0.6)])), float(rng.uniform(-1.57, 1.57))
        seen = Sectors(sector_distances(x, y, yaw, segments, circles), ALL)
        command = guard.limit(*wanted, seen, (v, omega))[:2]
        poses, (v, omega) = driven(command, (x, y, yaw), (v, omega))
        x, y, yaw = poses[-1]
        assert min(free_distance(*pose[:2], segments, circles) for pose in poses) > guard.radius_m


@settings(max_examples=40, deadline=None)
@given(st.integers(0, 2**32 - 1), st.sampled_from([0.14, 0.2, 0.28, 0.5]))
def test_no_command_that_acts_late_drives_into_what_is_sensed(seed: int, latency_s: float) -> None:
    rng = np.random.default_rng(seed)
    segments = rng.uniform(-3, 3, (6, 4))
    circles = np.column_stack([rng.uniform(-3, 3, (10, 2)), rng.uniform(0.02, 0.3, 10)])
    guard, latency, motors = Guard(), Latency(latency_s), LateMotors(latency_s)
    if free_distance(0.0, 0.0, segments, circles) < guard.radius_m + guard.margin_m:
        return
    x = y = yaw = v = omega = 0.0
    wanted = (0.0, 0.0)
    for step in range(120):
        if step % 5 == 0:
            wanted = float(rng.choice([0.6, 0.6, -0.2, rng.uniform(-0.2, 0.6)])), float(rng.uniform(-1.57, 1.57))
        seen = Sectors(sector_distances(x, y, yaw, segments, circles), ALL)
        ahead = latency.ahead((v, omega), 0.14 * step)
        command = guard.limit(*wanted, seen, (v, omega), None, ahead)[:2]
        latency.note(command, 0.14 * step)
        poses, (v, omega) = motors.driven(command, (x, y, yaw), (v, omega))
        x, y, yaw = poses[-1]
        assert min(free_distance(*pose[:2], segments, circles) for pose in poses) > guard.radius_m


def test_a_command_is_limited_from_where_the_robot_will_be() -> None:
    """It brakes as late as if it stood there, and turned as it will be, already: a disc, a rectangle, compiled, too."""
    cart = replace(PAPER, shape="rectangle", corners=None, radius_m=None, length_m=0.6, width_m=0.4)
    pose = (0.4, -0.1, 0.3)
    walls = np.array([[0.9, -9.0, 0.9, 9.0], [-9.0, -0.75, 9.0, -0.75]])
    there = Sectors(sector_distances(*pose, walls, NO_CIRCLES), ALL)
    here = Sectors(sector_distances(0.0, 0.0, 0.0, walls, NO_CIRCLES), ALL)
    for robot in (PAPER, cart):
        limited = set()
        for kind in (Guard, CompiledGuard):
            guard = kind.of(robot, evade=False)
            for v, omega in ((0.6, 0.0), (0.3, -1.0), (0.6, 1.0), (0.1, -1.5)):
                found = guard.limit(v, omega, here, (0.5, 0.0), None, Ahead(pose, (0.4, 0.2), 0.28))
                assert found == guard.limit(v, omega, there, (0.4, 0.2))
                limited.add(found[2])
        assert limited == {None, "the stop zone"}


@pytest.mark.parametrize("mast_m", [0.205, 0.252])
def test_a_mast_of_its_own_makes_no_wall_less_worth_keeping_clear_of(mast_m: float) -> None:
    """A sector behind sees the robot itself, or something that touches it."""
    guard, x, v = Guard(), 0.0, 0.0
    mast = np.zeros(180, np.bool_)
    mast[90] = True
    while True:
        wall = sector_distances(x, 0.0, 0.0, np.array([[1.5, -9.0, 1.5, 9.0]]), NO_CIRCLES)
        command = guard.limit(0.6, 0.0, Sectors(np.where(mast, mast_m, wall), ALL), (v, 0.0))[:2]
        before = x
        poses, (v, _) = driven(command, (x, 0.0, 0.0), (v, 0.0))
        x = poses[-1][0]
        if x == before:
            break
    assert 0.045 < 1.5 - x - guard.radius_m < 0.12


def plain_limit(guard: Guard, v: float, sectors: Sectors, omega: float, moving: tuple[float, float]) -> float:
    """Return the linear velocity that the stop zone leaves: share by share, place by place, each sector's borders."""
    angles = np.arange(181) * math.pi / 90.0
    directions = np.stack((np.cos(angles), np.sin(angles)), axis=1)
    seen = np.isfinite(sectors.distances_m)
    for share in (1.0, 0.75, 0.5, 0.25):
        clearances = []
        for place in plain_way(share * v, omega, moving, guard.reaction_s):
            gaps = []
            for borders in (directions[:-1], directions[1:]):
                along = np.maximum(borders @ place, sectors.distances_m)[seen]
                gaps.extend(np.hypot(*(place - along[:, None] * borders[seen]).T) - guard.radius_m)
            clearances.append(gaps)
        rays = np.array(clearances)  # [places, rays]
        close = rays[0] < 0.01
        kept = [
            group.min() >= min(guard.margin_m, max(group[0].min() - 0.01, 0.01), group[0].min())
            for group in (rays[:, close], rays[:, ~close])
            if group.size
        ]
        if all(kept):
            return share * v
    return 0.0


def plain_way(v: float, omega: float, moving: tuple[float, float], reaction_s: float) -> list[tuple[float, float]]:
    """Return the places of a way, by the motors' own rule in steps of 0.05 s."""
    x = y = yaw = 0.0
    places, step = [(x, y)], 0
    while step < round(reaction_s / 0.05) or abs(moving[0]) > 1e-9:
        moving = clip_command(*((v, omega) if step < round(reaction_s / 0.05) else (0.0, 0.0)), *moving, 0.05)
        middle = yaw + moving[1] * 0.025
        x, y = x + moving[0] * 0.05 * math.cos(middle), y + moving[0] * 0.05 * math.sin(middle)
        yaw += moving[1] * 0.05
        places.append((x, y))
        step += 1
    return places


@pytest.mark.parametrize("guard", [Guard(), Guard(margin_m=0.2, reaction_s=0.4), Guard(margin_m=0.0, radius_m=0.1)])
def test_it_decides_as_the_definition_says(guard: Guard) -> None:
    rng = np.random.default_rng(3)
    decided = set()
    for _ in range(300):
        nearest = guard.radius_m + rng.uniform(0.0, guard.margin_m + 0.5 * guard.reaction_s + 0.1)
        there = rng.random(180) < rng.uniform(0.0, 0.3)
        sectors = Sectors(np.where(there, rng.uniform(nearest, nearest + 0.4, 180), np.inf), ALL)
        (v, omega), moving = rng.uniform((-0.2, -1.5), (0.6, 1.5)), rng.uniform((-0.3, -1.5), (0.8, 1.5))
        expected = plain_limit(guard, v, sectors, omega, moving)
        assert replace(guard, evade=False).limit(v, omega, sectors, moving)[0] == expected
        compiled = CompiledGuard(**vars(guard))
        assert compiled.limit(v, omega, sectors, moving) == guard.limit(v, omega, sectors, moving)
        if v < 0.0 or expected > 0.0:  # else it evades
            assert guard.limit(v, omega, sectors, moving)[:2] == (expected, omega)
        decided.add(round(expected / v, 2))
    assert decided == {0.0, 0.25, 0.5, 0.75, 1.0}


@pytest.mark.parametrize("bad", [{"max_speed_m_per_s": -1.0}, {"margin_m": math.nan}, {"radius_m": 0.0}])
def test_what_is_no_limit_is_refused(bad: dict[str, Any]) -> None:
    with pytest.raises(UserInputError, match=f"{next(iter(bad))}="):
        Guard(**bad)


# ------------------------------------------------------------------------------------------------ the path
def test_a_path_is_followed_as_in_training() -> None:
    follower = PathFollower([(0.0, 0.0), (2.0, 0.0), (2.0, 3.0)], agent().config)
    # The start itself is within 0.5 m, so the corner is next.
    np.testing.assert_allclose(follower.update((0.0, 0.0, 0.0)), [[2.0, 0.0], [2.0, 3.0]])
    np.testing.assert_allclose(follower.update((1.4, 0.0, math.pi / 2)), [[0.0, -0.6], [3.0, -0.6]], atol=1e-12)
    np.testing.assert_allclose(follower.update((1.6, 0.0, 0.0)), [[0.4, 3.0], [0.4, 3.0]])
    # A waypoint that was passed stays passed.
    np.testing.assert_allclose(follower.update((1.0, 0.0, 0.0)), [[1.0, 3.0], [1.0, 3.0]])
    assert not follower.reached
    assert follower.update((2.0, 2.86, 1.0)) is None
    assert follower.reached
    assert follower.update((0.0, 0.0, 0.0)) is None


def test_a_dense_path_is_thinned_to_its_corners() -> None:
    line = np.linspace(0.0, 4.0, 81)
    path = np.concatenate([np.column_stack([line, 0 * line]), np.column_stack([0 * line + 4.0, line])])
    follower = PathFollower(path, agent().config)
    np.testing.assert_allclose(follower.update((0.0, 0.0, 0.0)), [[4.0, 0.0], [4.0, 4.0]])


@pytest.mark.parametrize("path", [[], [(0.0, math.nan)], [(0.0, 0.0, 0.0)], "path"])
def test_what_is_no_path_is_refused(path: Any) -> None:
    with pytest.raises(UserInputError, match="path"):
        PathFollower(path, agent().config)
