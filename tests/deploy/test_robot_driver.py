"""The driver on a robot: paths that are published again, and what it says of messages that do not come or fit."""

import math
from collections.abc import Callable
from types import SimpleNamespace
from typing import Any
from unittest.mock import patch

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from rcdsac_trl.deploy import CameraPose, InputLimits, Policy
from rcdsac_trl.deploy.policy.command import Command
from rcdsac_trl.deploy.policy.driver import Driver
from rcdsac_trl.errors import UserInputError
from rcdsac_trl.robot.action import clip_command
from robots import agent

PERIOD_S = 0.14
LOOP = [(0.0, 0.0), (4.0, 0.0), (4.0, 4.0), (0.0, 4.0), (0.0, 0.0)]


def header(now_s: float, frame: str) -> SimpleNamespace:
    sec, nanosec = divmod(round(now_s * 1e9), 1_000_000_000)
    return SimpleNamespace(stamp=SimpleNamespace(sec=sec, nanosec=nanosec), frame_id=frame)


def path(points: Any, frame: str = "odom") -> SimpleNamespace:
    poses = [SimpleNamespace(pose=SimpleNamespace(position=SimpleNamespace(x=x, y=y))) for x, y in points]
    return SimpleNamespace(header=header(0.0, frame), poses=poses)


def odometry(
    now_s: float, x: float, y: float, yaw: float = 0.0, frame: str = "odom", v: float = 0.1
) -> SimpleNamespace:
    turn = SimpleNamespace(x=0.0, y=0.0, z=math.sin(yaw / 2), w=math.cos(yaw / 2))
    pose = SimpleNamespace(position=SimpleNamespace(x=x, y=y), orientation=turn)
    twist = SimpleNamespace(linear=SimpleNamespace(x=v), angular=SimpleNamespace(z=0.0))
    return SimpleNamespace(
        header=header(now_s, frame), pose=SimpleNamespace(pose=pose), twist=SimpleNamespace(twist=twist)
    )


def laser(now_s: float, ranges: Any = None) -> SimpleNamespace:
    increment = 2.0 * math.pi / 360
    return SimpleNamespace(
        header=header(now_s, "laser"),
        angle_min=-math.pi,
        angle_max=math.pi - increment,
        angle_increment=increment,
        range_min=0.1,
        range_max=10.0,
        ranges=[2.0] * 360 if ranges is None else ranges,
    )


def cloud(now_s: float, frame: str) -> SimpleNamespace:
    points = np.zeros((400, 3), "<f4")
    points[:, 0], points[:, 1] = 1.5, np.linspace(-0.5, 0.5, 400)
    fields = [SimpleNamespace(name=name, offset=4 * place, datatype=7) for place, name in enumerate("xyz")]
    return SimpleNamespace(
        header=header(now_s, frame),
        height=1,
        width=400,
        point_step=12,
        row_step=4800,
        is_bigendian=False,
        fields=fields,
        data=points.tobytes(),
    )


class Recorder:
    """Stands in for a policy, and keeps the waypoints it is given, in the map frame of a robot that looks along x."""

    def __init__(self) -> None:
        self.config, self.limits = agent().config, InputLimits()
        self.waypoints: Any = None

    def act(self, ranges: Any, waypoints: Any, velocity: Any, beta: float | None, *, stamps: Any, pose: Any) -> Command:
        self.waypoints = waypoints
        return Command(0.1, 0.0, False, None)

    def refuse(self, reason: str) -> Command:
        return Command(0.0, 0.0, True, reason)


class Drive:
    """A driver whose robot goes straight to each waypoint."""

    def __init__(self, start: tuple[float, float] = (0.0, 0.0)) -> None:
        self.policy = Recorder()
        self.driver = Driver(self.policy)  # type: ignore[arg-type]
        self.here = start
        self.steps = 0

    def next(self) -> list[list[float]] | str:
        """Return the next two waypoints in the map frame, or why there are none."""
        self.steps += 1
        now = 100.0 + PERIOD_S * self.steps
        self.driver.on_odometry(odometry(now, *self.here))
        self.driver.on_scan(laser(now))
        command = self.driver.command(now)
        if command.stopped:
            return str(command.reason)
        return (self.policy.waypoints + np.array(self.here)).round(6).tolist()

    def go(self, metres: float = math.inf) -> str | None:
        """Go on for so far, or until there are no waypoints; return why not."""
        while metres > 0.0:
            two = self.next()
            if isinstance(two, str):
                return two
            apart = math.dist(two[0], self.here)
            share = min(0.1 / apart, 1.0)
            self.here = tuple(at + share * (to - at) for at, to in zip(self.here, two[0], strict=True))
            metres -= 0.1
        return None


# ------------------------------------------------------------------------------------------------ paths
def test_a_loop_is_driven_round_while_its_path_is_published_again_and_again() -> None:
    drive = Drive()
    for _ in range(40):
        drive.driver.on_path(path(LOOP))
        told = drive.go(0.5)
        if told is not None:
            break
    assert told == "the goal is reached"
    assert drive.steps * 0.1 > 14.0
    assert drive.driver.arrived
    drive.driver.on_path(path(LOOP))
    assert drive.next() == "the goal is reached"
    assert drive.driver.arrived


@settings(max_examples=25, deadline=None)
@given(st.lists(st.integers(0, 129), max_size=6), st.lists(st.integers(0, 129), max_size=2))
def test_whenever_it_is_published_again_the_same_way_is_driven(again: list[int], empty: list[int]) -> None:
    """Also after an empty one, on which the robot stands for as long as it is the last."""
    drive, plain = Drive(), Drive()
    drive.driver.on_path(path(LOOP))
    plain.driver.on_path(path(LOOP))
    for step in range(130):
        if step in empty:
            drive.driver.on_path(path([]))
            assert "there is no path yet that has poses" in str(drive.next())
            assert not drive.driver.arrived
        if step in again or step in empty:
            drive.driver.on_path(path(LOOP))
        assert drive.go(0.05) == plain.go(0.05)
        assert drive.here == plain.here


def test_after_an_empty_path_a_reached_one_is_another_lap() -> None:
    drive = Drive()
    drive.driver.on_path(path(LOOP))
    assert drive.go() == "the goal is reached"
    drive.driver.on_path(path([]))
    drive.driver.on_path(path(LOOP))
    assert not drive.driver.arrived
    assert drive.next() == [[4.0, 0.0], [4.0, 4.0]]
    assert drive.go() == "the goal is reached"


def test_a_path_in_another_frame_is_a_new_one_and_a_broken_one_costs_no_progress() -> None:
    drive = Drive()
    drive.driver.on_path(path(LOOP))
    drive.go(6.0)
    assert drive.next() == [[4.0, 4.0], [0.0, 4.0]]
    drive.driver.on_path(path([(math.nan, 0.0)]))
    assert "the path cannot be read" in str(drive.next())
    drive.driver.on_path(None)
    assert "the path cannot be read (AttributeError" in str(drive.next())
    drive.driver.on_path(path(LOOP))
    assert drive.next() == [[4.0, 4.0], [0.0, 4.0]]
    drive.driver.on_path(path(LOOP, "map"))
    assert drive.next() == (
        "the path is in frame 'map', odometry in 'odom': no transform names frame 'map': there are none; start the "
        "localisation, or send both in one frame"
    )


# ------------------------------------------------------------------------------------------------ plans that end
def aging(timeout_s: float | None) -> tuple[Driver, Callable[[float, float], str | None]]:
    """Make a driver with a plan from (0, 0) to (9, 0) to (9, 9), and what asks it at a time and a place on that."""
    driver = Driver(Recorder(), plan_timeout_s=timeout_s)  # type: ignore[arg-type]
    driver.on_path(path([(0.0, 0.0), (9.0, 0.0), (9.0, 9.0)]))

    def reason(now_s: float, x_m: float) -> str | None:
        driver.on_odometry(odometry(now_s, x_m, 0.0))
        driver.on_scan(laser(now_s))
        return driver.command(now_s).reason

    return driver, reason


OLD = (
    "the plan is 3.10 s old, more than plan_timeout_s=3: it was cancelled, or its planner is late; plan again, or give "
    "a larger plan_timeout_s"
)


def test_a_plan_ages_from_the_first_command_after_it_came_whatever_its_stamp() -> None:
    driver, reason = aging(3.0)
    assert [reason(now_s, 0.0) for now_s in (100.0, 103.0, 103.1)] == [None, None, OLD]
    driver.on_path(path([(0.0, 0.0), (9.0, 0.0), (9.0, 9.0)]))  # stamped 0, as all of them
    assert [reason(now_s, 0.0) for now_s in (104.0, 107.0, 107.1)] == [None, None, OLD]
    driver, reason = aging(None)
    assert [reason(now_s, 0.0) for now_s in (100.0, 1e6)] == [None, None]


def test_what_is_refused_for_an_old_plan_costs_no_progress() -> None:
    """While plans were missing the robot got past the corner: the next plan, the same, is followed from there."""
    driver, reason = aging(3.0)
    assert reason(100.0, 0.0) is None
    assert reason(103.1, 8.8) == OLD
    assert driver.situation is None
    driver.on_path(path([(0.0, 0.0), (9.0, 0.0), (9.0, 9.0)]))
    assert reason(103.2, 8.8) is None
    assert driver.policy.waypoints == pytest.approx(np.array([(0.2, 9.0), (0.2, 9.0)]))  # type: ignore[attr-defined]


def test_a_goal_that_is_reached_stays_so_when_its_plan_is_old() -> None:
    driver, _ = aging(3.0)
    driver.on_path(path([(0.0, 0.0), (1.0, 0.0)]))
    for now_s in (100.0, 110.0):
        driver.on_odometry(odometry(now_s, 1.0, 0.0))
        assert driver.command(now_s).reason == "the goal is reached"
        assert driver.arrived


def test_a_plan_is_new_again_where_the_clock_was_set_back() -> None:
    _, reason = aging(3.0)
    assert [reason(now_s, 0.0) for now_s in (100.0, 5.0, 8.0, 8.1)] == [None, None, None, OLD]


@pytest.mark.parametrize("timeout_s", [0.0, -1.0, math.nan, math.inf])
def test_a_plan_timeout_that_is_none_is_refused(timeout_s: float) -> None:
    with pytest.raises(UserInputError, match=f"plan_timeout_s={timeout_s} must be a positive number of seconds"):
        Driver(Policy(agent()), plan_timeout_s=timeout_s)


def test_a_straight_way_of_130_m_is_driven() -> None:
    driver = Driver(Policy(agent()))
    driver.on_path(path([(0.0, 0.0), (130.0, 0.0)]))
    driver.on_odometry(odometry(10.0, 0.0, 0.0))
    driver.on_scan(laser(10.0))
    assert driver.command(10.0).reason is None


# ------------------------------------------------------------------------------------------------ why it stands
def test_a_cloud_in_another_frame_is_named_beside_the_one_that_is_expected() -> None:
    driver = Driver(Policy(agent()), cameras={"cam": CameraPose((0.2, 0.0, 0.3), view_rad=1.6)})
    driver.on_odometry(odometry(10.0, 0.0, 0.0))
    driver.on_path(path([(5.0, 0.0)]))
    assert str(driver.command(10.0).reason).startswith(
        "there is no scan yet, or not of every camera: no cloud came in frame 'cam';"
    )
    for number in range(9):
        driver.on_cloud(cloud(10.0, f"/cam{number}"))
    driver.on_cloud(cloud(10.0, "/cam"))
    driver.on_cloud(cloud(10.0, "/cam"))
    reason = str(driver.command(10.0).reason)
    assert "no cloud came in frame 'cam'; clouds came in frame '/cam5', '/cam6', '/cam7', '/cam8', '/cam';" in reason
    driver.on_scan(laser(10.0))
    assert "a scan came, which is not read where there are cameras" in str(driver.command(10.0).reason)
    driver.on_cloud(SimpleNamespace())
    assert "a cloud cannot be read (AttributeError" in str(driver.command(10.0).reason)
    driver.on_cloud(cloud(10.0, "cam"))
    assert driver.command(10.0).reason is None


def test_clouds_to_a_driver_without_cameras_are_named() -> None:
    driver = Driver(Policy(agent()))
    driver.on_odometry(odometry(10.0, 0.0, 0.0))
    driver.on_path(path([(5.0, 0.0)]))
    assert str(driver.command(10.0).reason).startswith("there is no scan yet;")
    driver.on_cloud(cloud(10.0, "cam"))
    reason = str(driver.command(10.0).reason)
    assert "there is no scan yet; clouds came in frame 'cam', which no camera of this driver has" in reason


def test_zeros_are_named_with_their_parameter_which_makes_them_open_space() -> None:
    for zero_means, told in (("invalid", "360 of 360 rays read 0; if the driver writes 0"), ("far", None)):
        driver = Driver(Policy(agent()), zero_means=zero_means)  # type: ignore[arg-type]
        driver.on_odometry(odometry(10.0, 0.0, 0.0))
        driver.on_path(path([(5.0, 0.0)]))
        driver.on_scan(laser(10.0, [0.0] * 360))
        reason = driver.command(10.0).reason
        assert reason is None if told is None else told in str(reason)
    with pytest.raises(UserInputError, match="zero_means='open'"):
        Driver(Policy(agent()), zero_means="open")  # type: ignore[arg-type]


@pytest.mark.parametrize(
    ("change", "told"),
    [
        ({"scan": laser(10.0, [500.0] * 360)}, "reads up to 500, beyond its range_max of 10 m"),
        ({"odometry": odometry(10.0, 2000.0, 0.0)}, "m from its path, more than 75 m: give pose and path in metres"),
        ({"path": path([(0.0, 0.0), (4000.0, 0.0)])}, "straight on: give metres"),
        ({"scan": SimpleNamespace(header=header(10.0, "laser"))}, "a message cannot be read (AttributeError"),
        ({"scan": laser(10.0, [[2.0], [2.0, 2.0]])}, "the scan's ranges are not numbers"),
        ({"odometry": odometry(0.0, 0.0, 0.0)}, "0 is what messages hold that nobody stamped"),
    ],
)
def test_what_cannot_be_driven_on_is_told(change: dict[str, Any], told: str) -> None:
    driver = Driver(Policy(agent()))
    driver.on_odometry(change.get("odometry", odometry(10.0, 0.0, 0.0)))
    driver.on_path(change.get("path", path([(5.0, 0.0)])))
    driver.on_scan(change.get("scan", laser(10.0)))
    assert told in str(driver.command(10.0).reason)


def test_odometry_in_millimetres_is_told_when_the_robot_moves() -> None:
    driver = Driver(Policy(agent()))
    driver.on_path(path([(0.0, 0.0), (400.0, 0.0), (400.0, 450.0)]))
    reasons = []
    for step in range(3):
        now = 10.0 + PERIOD_S * step
        driver.on_odometry(odometry(now, 42.0 * step, 0.0))
        driver.on_scan(laser(now))
        reasons.append(str(driver.command(now).reason))
    assert reasons[0] == "None"
    assert all("the pose moved by 42 m in 0.14 s, more than 10.3 m: give metres" in reason for reason in reasons[1:])


def test_odometry_without_velocities_is_told_when_the_robot_moves() -> None:
    driver = Driver(Policy(agent()))
    driver.on_path(path([(0.0, 0.0), (5.0, 0.0)]))
    reasons = []
    # It stands for a while, and drifts; then it moves.
    for step, x in enumerate([0.0, 0.01, 0.0, *np.arange(0.04, 0.25, 0.04)]):
        now = 10.0 + PERIOD_S * step
        driver.on_odometry(odometry(now, float(x), 0.0, v=0.0))
        driver.on_scan(laser(now))
        reasons.append(str(driver.command(now).reason))
    told = "the pose moved by 0.16 m in 0.84 s, and the odometry's twist is 0"
    assert [told in reason for reason in reasons] == [False] * 6 + [True, False, False]
    assert "the pose moved by 0.24 m" in reasons[-1]


@pytest.mark.parametrize("lost", ["scan", "odometry", "both"])
def test_what_ceases_near_a_wall_lets_nobody_drive_into_it(lost: str) -> None:
    """Whatever is driven on is a little old, and old before it is refused: the stop zone reckons with both."""
    wall_m, radius_m = 2.0, 0.25
    bearings = np.linspace(-np.pi, np.pi, 360, endpoint=False)
    nearest_m = math.inf
    for gap_m in np.arange(0.26, 0.6, 0.02):  # by then it is lost
        driver = Driver(Policy(agent()))
        driver.on_path(path([(0.0, 0.0), (5.0, 0.0)]))
        x = v = wish = 0.0
        for step in range(800):
            now = 100.0 + 0.01 * step
            gone = wall_m - radius_m - x < gap_m
            if not gone or lost == "scan":
                driver.on_odometry(odometry(now, x, 0.0, v=v))
            if (not gone or lost == "odometry") and step % 10 == 0:
                with np.errstate(divide="ignore"):
                    seen_m = np.where(np.cos(bearings) > 1e-6, (wall_m - x) / np.cos(bearings), math.inf)
                driver.on_scan(laser(now, np.where(seen_m > 10.0, math.inf, seen_m)))
            if step % 14 == 0:
                with patch.object(Policy, "_wish", return_value=((0.6, 0.0), [])):
                    wish = driver.command(now).v_m_per_s
            v, _ = clip_command(wish, 0.0, v, 0.0, 0.01)
            x += 0.01 * v
        nearest_m = min(nearest_m, wall_m - radius_m - x)
    assert nearest_m >= 0.05
