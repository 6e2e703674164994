"""The navigation around an agent: detours on what was seen, what a watchdog notices, and what a policy makes of it."""

import copy
import math
from dataclasses import replace
from typing import Any
from unittest.mock import Mock, patch

import numpy as np
import pytest

from rcdsac_trl.deploy import Guard, Policy, Stamps
from rcdsac_trl.deploy.navigation.cost_to_go import _descend, _sweep
from rcdsac_trl.deploy.navigation.detour import BESIDE_M, is_clear, plan_detour
from rcdsac_trl.deploy.navigation.local_map import LocalMap, LocalMapSettings
from rcdsac_trl.deploy.navigation.navigator import Navigator, NavigatorSettings
from rcdsac_trl.deploy.navigation.watchdog import Watchdog, WatchdogSettings
from rcdsac_trl.errors import UserInputError
from rcdsac_trl.robot.action import clip_command
from rcdsac_trl.robot.robot_settings import PAPER, RobotSettings
from rcdsac_trl.robot.sectors import Sectors
from rcdsac_trl.world.sim.lidar import sector_distances
from robots import AHEAD, OPEN, STANDING, agent

ALL = np.ones(180, np.bool_)
NARROW = (np.arange(180) < 21) | (np.arange(180) >= 158)
NO_CIRCLES = np.empty((0, 3))
# A wall across the way, 3 m wide, with its end to the right: the shorter way past it.
WALL = np.array([[1.5, -0.8, 1.5, 2.2]])
GOAL = ((3.5, 0.0), (3.5, 0.0))
AT_ONCE = NavigatorSettings(blocked_s=0.0, watchdog=None)


def seen(pose: tuple[float, float, float], segments: np.ndarray = WALL) -> np.ndarray:
    return sector_distances(*pose, segments, NO_CIRCLES)


def in_robot(point: tuple[float, float], pose: tuple[float, float, float]) -> tuple[float, float]:
    x, y, yaw = pose
    cos, sin = math.cos(yaw), math.sin(yaw)
    dx, dy = point[0] - x, point[1] - y
    return cos * dx + sin * dy, cos * dy - sin * dx


# ------------------------------------------------------------------------------------------------ detours
def test_a_detour_leads_past_the_nearer_end_of_a_wall_and_keeps_clear() -> None:
    local_map = LocalMap(LocalMapSettings(), ALL)
    local_map.observe(seen((0.0, 0.0, 0.0)))
    assert not is_clear(local_map.clearances, (0.0, 0.0), (3.5, 0.0), 0.25)
    assert is_clear(local_map.clearances, (0.0, 0.0), (1.0, 0.0), 0.25)
    corners = plan_detour(local_map.clearances, (0.0, 0.0), (3.5, 0.0), 0.25)
    assert corners[-1] == (3.5, 0.0)
    assert all(y < 0.0 for _, y in corners[:-1])
    # Cells of 10 cm: the discs that sensed points stand for are passed at the robot's radius, within half a cell.
    points = local_map.remembered
    for start, end in zip([(0.0, 0.0), *corners], corners, strict=False):
        assert np.hypot(*(points[:, None] - np.linspace(start, end, 50)).T).min() > 0.19


def test_no_detour_waits_for_the_compiler() -> None:
    planned = Mock(wraps=plan_detour)
    with patch("rcdsac_trl.deploy.navigation.navigator.plan_detour", planned):
        navigator = Navigator(AT_ONCE)
        assert planned.call_count == 1
        advice = navigator.advise(seen((0.0, 0.0, 0.0)), ALL, GOAL, STANDING, 0.0)
    assert planned.call_count == 2
    assert advice.waypoints != GOAL
    # What was compiled when it was made is what plans: of other types it would be compiled again.
    assert len(_sweep.signatures) == len(_descend.signatures) == 1


def test_where_nothing_leads_on_there_is_no_detour() -> None:
    walls = np.array([[1.0, -1.0, 1.0, 1.0], [-1.0, -1.0, -1.0, 1.0], [-1.0, 1.0, 1.0, 1.0], [-1.0, -1.0, 1.0, -1.0]])
    local_map = LocalMap(LocalMapSettings(), ALL)
    local_map.observe(seen((0.0, 0.0, 0.0), walls))
    assert plan_detour(local_map.clearances, (0.0, 0.0), (3.5, 0.0), 0.25) == []


@pytest.mark.parametrize(
    "things",
    [
        np.array([[1.9, -0.1, 1.9, 0.1], [1.9, -0.1, 2.1, -0.1], [1.9, 0.1, 2.1, 0.1], [2.1, -0.1, 2.1, 0.1]]),
        np.array([[1.95, -3.0, 1.95, 3.0]]),  # the waypoint is 5 cm behind a wall's face, as a pose that is off has it
    ],
)
def test_where_something_stands_on_a_target_the_way_ends_beside_it_on_this_side(things: np.ndarray) -> None:
    local_map = LocalMap(LocalMapSettings(), ALL)
    local_map.observe(seen((0.0, 0.0, 0.0), things))
    ((*_, (x, y)),) = [plan_detour(local_map.clearances, (0.0, 0.0), (2.0, 0.0), 0.25)]
    assert 0.2 < math.dist((x, y), (2.0, 0.0)) < BESIDE_M
    assert x < 1.8
    assert float(sector_distances(x, y, 0.0, things, NO_CIRCLES).min()) > 0.2


def test_a_waypoint_on_which_something_stands_is_driven_beside_and_then_past() -> None:
    pole = np.array([[2.0, 0.0, 0.1]])

    def told(x: float, after: tuple[float, float]) -> tuple[tuple[float, float], tuple[float, float]]:
        """Return what a robot that comes straight is told at x, in the world's frame."""
        navigator = Navigator(AT_ONCE)
        ranges = sector_distances(x, 0.0, 0.0, np.empty((0, 4)), pole)
        ahead = (2.0 - x, 0.0), (after[0] - x, after[1])
        (x1, y1), (x2, y2) = navigator.advise(ranges, ALL, ahead, (0.0, 0.0), 0.0).waypoints
        return (x1 + x, y1), (x2 + x, y2)

    first, second = told(0.0, (4.0, 0.0))
    assert 0.3 < math.dist(first, (2.0, 0.0)) < BESIDE_M
    assert second == pytest.approx((4.0, 0.0))
    first, _ = told(1.5, (4.0, 0.0))
    assert first[0] > 1.7  # it is beside it and the waypoint still the next one: on to the one after it,
    assert abs(first[1]) > 0.25  # around what stands there
    goal, _ = told(1.5, (2.0, 0.0))
    assert 0.3 < math.dist(goal, (2.0, 0.0)) < BESIDE_M  # nothing comes after a goal


def test_waypoints_stay_where_the_way_is_free_or_was_blocked_for_a_moment() -> None:
    navigator = Navigator(replace(AT_ONCE, blocked_s=0.3))
    given = ((3.5, 0.0), (6.0, 1.0))
    assert navigator.advise(OPEN, ALL, given, (0.0, 0.0), 0.0).waypoints == given
    told = [navigator.advise(seen((0.0, 0.0, 0.0)), ALL, given, (0.0, 0.0), 0.14).waypoints for _ in range(4)]
    assert [each == given for each in told] == [True, True, False, False]
    assert navigator.advise(np.full(180, 3.9), ALL, given, (0.0, 0.0), 0.14).waypoints == given  # it was seen through


def test_a_follower_of_the_waypoints_gets_past_a_wall_that_it_would_drive_into() -> None:
    def ends(navigator: Navigator) -> tuple[float, float]:
        """Drive to the first waypoint, all that the driver knows; return gap to the goal and least to a wall."""
        x = y = yaw = v = omega = 0.0
        nearest = math.inf
        for step in range(250):
            pose = (x, y, yaw)
            goal = in_robot(GOAL[0], pose)
            ranges = np.where(NARROW, seen(pose), np.inf)
            advice = navigator.advise(ranges, NARROW, (goal, goal), (v, omega), 0.14 if step else 0.0)
            bearing = math.atan2(*advice.waypoints[0][::-1])
            wish = 0.4 * max(0.0, math.cos(bearing)), max(-1.5, min(1.5, 3.0 * bearing))
            for _ in range(7):
                v, omega = clip_command(*wish, v, omega)
                yaw += omega * 0.02
                x, y = x + v * 0.02 * math.cos(yaw), y + v * 0.02 * math.sin(yaw)
            nearest = min(nearest, float(sector_distances(x, y, 0.0, WALL, NO_CIRCLES).min()))
            if math.dist((x, y), GOAL[0]) < 0.3:
                break
        return math.dist((x, y), GOAL[0]), nearest

    gap_m, nearest_m = ends(Navigator(AT_ONCE))
    assert gap_m < 0.3
    assert nearest_m > 0.2
    assert ends(Navigator(replace(AT_ONCE, replan=False)))[1] < 0.05


def test_what_is_out_of_view_is_told_to_the_stop_zone() -> None:
    navigator = Navigator(replace(AT_ONCE, replan=False))
    beside = np.array([[0.2, 0.5, 1.2, 0.5]])  # left of the way
    for step in range(9):
        x = 0.07 * step
        ranges = np.where(NARROW, seen((x, 0.0, 0.0), beside), np.inf)
        # From rest, reckoned along the mean of two velocities: it is given the same one from the first call on.
        advice = navigator.advise(ranges, NARROW, GOAL, (0.5, 0.0), 0.14 if step else 0.0)
    known_m = navigator.known(Sectors(ranges, NARROW), None, 1.5).distances_m
    there = known_m[44:46]  # 88 to 92 degrees, where no sector sees
    assert np.isfinite(there).any()
    assert there.min() == pytest.approx(0.5, abs=0.06)
    assert np.isinf(known_m[120])
    assert advice.been[0] == pytest.approx((-x, 0.0), abs=0.1)


def test_between_two_scans_what_is_remembered_stays_where_it_is() -> None:
    navigator = Navigator(replace(AT_ONCE, replan=False))
    ahead = np.array([[1.0, -0.3, 1.0, 0.3]])
    for step in range(3):
        navigator.advise(seen((0.0, 0.0, 0.0), ahead), ALL, GOAL, STANDING, 0.14 if step else 0.0)
    blind = Sectors(OPEN, np.zeros(180, np.bool_))
    assert navigator.known(blind, None, 1.5).distances_m[0] == pytest.approx(1.0, abs=0.01)
    on, turned = (navigator.known(blind, None, 1.5, np.array(moved)) for moved in ((0.2, 0.0, 0.0), (0.0, 0.0, 1.0)))
    assert on.distances_m[0] == pytest.approx(0.8, abs=0.01)
    assert np.isinf(turned.distances_m[0])
    assert turned.distances_m[180 - 29] == pytest.approx(1.0, abs=0.02)  # at -1 rad


def test_a_call_with_the_same_scan_is_guarded_from_where_the_robot_has_got_to(monkeypatch: pytest.MonkeyPatch) -> None:
    told: list[tuple[float, float]] = []

    def limit(
        _: Guard, v: float, omega: float, sectors: Sectors, measured: Any, been: np.ndarray, *__: Any
    ) -> tuple[float, float, None]:
        told.append((float(sectors.distances_m[0]), float(been[0, 0])))
        return v, omega, None

    monkeypatch.setattr(Guard, "limit", limit)
    driver = policy()
    wall = np.where(NARROW, seen((0.0, 0.0, 0.0), np.array([[1.0, -0.3, 1.0, 0.3]])), np.inf)
    blind = Sectors(wall, NARROW & (np.arange(180) > 0))  # what the first sector saw, is remembered
    driver.act(Sectors(wall, NARROW), AHEAD, (0.5, 0.0), -1.0, stamps=Stamps(10.0, 10.0, 10.0, 10.0))
    driver.act(blind, AHEAD, (0.5, 0.0), -1.0, stamps=Stamps(10.1, 10.0, 10.1, 10.1))
    assert told[0] == pytest.approx((1.0, 0.0), abs=0.01)
    assert told[1] == pytest.approx((0.95, -0.05), abs=0.01)


def test_who_has_just_walked_out_of_view_is_told_to_the_stop_zone_where_it_is_by_now() -> None:
    navigator = Navigator(replace(AT_ONCE, replan=False))
    for step in range(25):  # it crosses at 0.5 m/s, and is seen whole for 13 steps
        y = -0.5 + 0.07 * step
        person = np.array([[0.8, y, 0.25]])
        ranges = np.where(NARROW, sector_distances(0.0, 0.0, 0.0, np.empty((0, 4)), person), np.inf)
        navigator.advise(ranges, NARROW, GOAL, (0.0, 0.0), 0.14 if step else 0.0)
    assert np.isinf(ranges).all()
    known_m = navigator.known(Sectors(ranges, NARROW), None, 1.5).distances_m
    distance_m, bearing = math.hypot(0.8, y), math.degrees(math.atan2(y, 0.8))
    assert known_m.min() == pytest.approx(distance_m - 0.25, abs=0.08)
    told = np.flatnonzero(np.isfinite(known_m))
    assert 2.0 * told.mean() == pytest.approx(bearing, abs=4.0)
    for _ in range(20):  # by then it has turned, for all that is known
        navigator.advise(ranges, NARROW, GOAL, (0.0, 0.0), 0.14)
    assert np.isinf(navigator.known(Sectors(ranges, NARROW), None, 1.5).distances_m).all()


# ------------------------------------------------------------------------------------------------ standstill
SETTINGS = WatchdogSettings(still_s=2.0, bold_s=2.0, back_off_s=3.0, back_off_m=0.4)


def test_a_standstill_makes_bold_then_backs_off_and_begins_anew() -> None:
    dog = Watchdog(SETTINGS)
    been = np.column_stack([np.linspace(-1.0, 0.0, 51), np.zeros(51)])
    told = []
    for _ in range(60):
        dog.observe((0.0, 0.0), 0.1)
        told.append((round(dog.boldness, 2), dog.way_out((0.0, 0.0), been, 0.1)))
    assert told[19] == (0.0, None)
    assert told[30] == (0.5, None)
    assert told[45] == (1.0, None)
    assert told[52][1] == pytest.approx((-0.15, 0.0))
    for step in range(8):  # it moves
        way = dog.way_out((-0.06 * step, 0.0), been, 0.1)
    assert way is None
    assert dog.boldness == 0.0


def stood(robot: RobotSettings = PAPER) -> Watchdog:
    """Return a watchdog of a robot that has stood for 6 s, twice as long as it takes until it backs off."""
    dog = Watchdog(SETTINGS, robot)
    for _ in range(60):
        dog.observe((0.0, 0.0), 0.1)
    return dog


STRAIGHT = np.column_stack([np.linspace(-1.0, 0.0, 51), np.zeros(51)])


def test_who_has_been_nowhere_else_or_cannot_reverse_is_left_to_its_agent() -> None:
    assert stood().way_out((0.0, 0.0), np.zeros((1, 2)), 0.1) is None
    for reverse, back in ((0.0, None), (0.05, (-0.05, 0.0)), (1.0, (-0.15, 0.0))):
        robot = replace(PAPER, name="mine", max_reverse_m_per_s=reverse)
        assert stood(robot).way_out((0.0, 0.0), STRAIGHT, 0.1) == (None if back is None else pytest.approx(back))


def test_what_does_not_move_back_is_let_go_after_a_second() -> None:
    dog = stood()
    ways = [dog.way_out((0.0, 0.0), STRAIGHT, 0.125) for _ in range(12)]
    assert [way is None for way in ways] == [False] * 8 + [True] * 4
    assert dog.idle_s == 0.0


def test_where_it_has_been_is_forgotten_like_what_it_has_seen() -> None:
    navigator = Navigator(NavigatorSettings(replan=False, memory_s=30.0, watchdog=None))
    for step in range(21):
        navigator.advise(OPEN, NARROW, GOAL, (0.5, 0.0), 0.1 if step else 0.0)
    navigator.advise(OPEN, NARROW, GOAL, STANDING, 0.0)
    assert navigator.advise(OPEN, NARROW, GOAL, STANDING, 27.5).been[:, 0].min() == pytest.approx(-1.0, abs=0.06)
    assert navigator.advise(OPEN, NARROW, GOAL, STANDING, 1.6).been[:, 0].min() > -0.6  # half of its 2 s ago
    left = navigator.advise(OPEN, NARROW, GOAL, STANDING, 30.0).been
    np.testing.assert_allclose(left, [[0.0, 0.0]])  # whoever stepped there since is not seen


def test_beta_is_what_was_asked_for_as_soon_as_the_robot_gets_on() -> None:
    dog = Watchdog(SETTINGS)
    for step in range(45):  # turning, or half a dozen centimetres to and fro, is standing still
        dog.observe((0.06 * (step % 2), 0.0), 0.1)
    assert dog.boldness == 1.0
    dog.observe((0.31, 0.0), 0.1)
    assert dog.boldness == 0.0
    for step in range(45):  # who drives slowly does not stand
        dog.observe((0.31 + 0.02 * step, 0.0), 0.1)
    assert dog.boldness == 0.0


def test_it_backs_along_the_arc_that_it_came_by() -> None:
    angles = np.linspace(-1.0, 0.0, 60)
    been = np.column_stack([np.sin(angles), 1.0 - np.cos(angles)])  # on a circle around (0, 1), counter-clockwise
    v, omega = stood().way_out((0.0, 0.0), been, 0.1) or (0.0, 0.0)
    assert v < 0.0
    assert omega / v == pytest.approx(1.0, rel=0.02)  # the curvature of that circle


# ------------------------------------------------------------------------------------------------ the policy
BOLDEST = 0.0


def policy(**options: Any) -> Policy:
    return Policy(agent(), navigator=Navigator(NavigatorSettings(watchdog=SETTINGS)), **options)


def drive(driver: Policy, steps: int, beta: float = -1.5) -> list[Any]:
    return [driver.act(OPEN, AHEAD, STANDING, beta) for _ in range(steps)]


def test_a_policy_turns_bold_where_it_stands_and_says_so() -> None:
    still, plain, bold = policy(guard=None), Policy(agent(), guard=None), Policy(agent(), guard=None)
    told, untouched = drive(still, 45), drive(plain, 45)
    # 2 s are 14 periods of 0.14 s: until then nothing is changed.
    assert [each.wanted for each in told[:14]] == [each.wanted for each in untouched[:14]]
    assert {each.reason for each in told[:14]} == {None}
    # After 2 s more it acts at the boldest beta, and memory does not depend on beta.
    for turned, asked in zip(told[30:33], drive(bold, 33, BOLDEST)[30:33], strict=True):
        assert turned.wanted == pytest.approx(asked.wanted, abs=1e-6)
    assert told[30].wanted != pytest.approx(untouched[30].wanted, abs=1e-6)
    assert "beta turns to its boldest" in str(told[30].reason)


def test_a_robot_that_braked_backs_off_through_its_stop_zone() -> None:
    """It is a little farther than it was ever driven to, and nothing is seen behind it."""
    for speed in (0.2, 0.37, 0.6):
        driver = policy()
        for v in (*[speed] * 50, 0.6 * speed, 0.2 * speed):
            driver.act(OPEN, AHEAD, (v, 0.0), -1.5)
        told, v = [], 0.0
        for _ in range(60):
            told.append(driver.act(OPEN, AHEAD, (v, 0.0), -1.5))
            v = min(told[-1].v_m_per_s, 0.0)  # something holds it wherever it drives ahead
        backwards = [each for each in told if each.v_m_per_s < 0.0]
        assert 18 <= len(backwards) <= 22, speed  # 0.4 m
        assert {each.reason for each in backwards} == {"it stood still and backs off; the agent drives on then"}


def test_what_happens_while_it_is_stopped_is_no_standstill_and_its_places_are_forgotten() -> None:
    for stopped in (3, 300):  # in calls; nobody knows whether it was pushed
        driver = policy(guard=None)
        for v in [0.5] * 20 + [0.0] * 30:
            bold = driver.act(OPEN, AHEAD, (v, 0.0), -1.5)
        assert "boldest" in str(bold.reason)
        driver.stop()
        for _ in range(stopped):
            driver.act(OPEN, AHEAD, STANDING, -1.5)
        driver.resume()
        again = [driver.act(OPEN, AHEAD, STANDING, -1.5) for _ in range(14)]
        assert {each.reason for each in again} == {None}
        assert driver._advice is not None
        np.testing.assert_allclose(driver._advice.been, 0.0)


def test_without_its_navigator_a_policy_is_advised_no_more() -> None:
    driver = policy(guard=None)
    drive(driver, 30)
    driver.navigator = None
    assert drive(driver, 1)[0].reason is None
    assert driver._advice is None


def test_who_is_at_its_boldest_already_is_not_said_to_turn() -> None:
    driver = policy(guard=None)
    assert {each.reason for each in drive(driver, 30, beta=BOLDEST)} == {None}


def test_both_are_said_where_it_is_bold_and_limited() -> None:
    driver = policy(guard=Guard(max_speed_m_per_s=1e-3))
    reason = str(drive(driver, 30)[-1].reason)
    assert "limited by the speed limit" in reason
    assert reason.endswith("it stands still, so beta turns to its boldest until it gets on")


def test_an_advised_policy_repeats_and_copies() -> None:
    first = policy(guard=None)
    drive(first, 25)
    copied = copy.copy(first)
    assert [each.wanted for each in drive(copied, 5)] == [each.wanted for each in drive(first, 5)]
    first.reset()
    again = policy(guard=None)
    assert [each.wanted for each in drive(first, 20)] == [each.wanted for each in drive(again, 20)]


def test_the_stop_zone_minds_what_the_navigator_remembers(monkeypatch: pytest.MonkeyPatch) -> None:
    """Something that was seen ahead and is beside the robot once it has turned, where no sector sees."""
    told: list[np.ndarray] = []

    def limit(_: Guard, v: float, omega: float, sectors: Sectors, *__: Any) -> tuple[float, float, None]:
        told.append(sectors.distances_m)
        return v, omega, None

    monkeypatch.setattr(Guard, "limit", limit)
    for driver in (policy(), Policy(agent())):
        told.clear()
        thing = np.array([[0.6, -0.1, 0.6, 0.1]])
        for step in range(12):
            yaw = min(step * 0.14, 1.4)
            ranges = Sectors(np.where(NARROW, seen((0.0, 0.0, yaw), thing), np.inf), NARROW)
            driver.act(ranges, AHEAD, (0.0, 1.0 if yaw < 1.4 else 0.0), -1.0)
        behind = told[-1][130:145]
        assert np.isfinite(behind).any() == (driver.navigator is not None)
    assert np.isinf(told[-1][~NARROW]).all()


@pytest.mark.parametrize(
    ("make", "bad"),
    [
        (NavigatorSettings, {"blocked_s": -1.0}),
        (NavigatorSettings, {"memory_s": math.nan}),
        (NavigatorSettings, {"replan": "no"}),
        (WatchdogSettings, {"still_s": 0.0}),
        (WatchdogSettings, {"back_off_m": math.inf}),
    ],
    ids=str,
)
def test_what_navigates_nowhere_is_refused(make: Any, bad: dict[str, Any]) -> None:
    with pytest.raises(UserInputError, match=f"{next(iter(bad))}="):
        make(**bad)


def test_what_is_no_navigator_of_this_robot_is_refused() -> None:
    for watchdog in (True, False):
        with pytest.raises(UserInputError, match=rf"^watchdog={watchdog} of a navigator is no WatchdogSettings"):
            NavigatorSettings(watchdog=watchdog)  # type: ignore[arg-type]
    policy = Policy(agent())
    other = Navigator(robot=replace(PAPER, name="cart", radius_m=0.4))
    with pytest.raises(UserInputError, match=r"^the navigator is of robot=cart, and this agent drives robot=paper"):
        policy.navigator = other
    assert policy.navigator is None
    policy.navigator = Navigator()
    assert copy.copy(policy).navigator is not policy.navigator
