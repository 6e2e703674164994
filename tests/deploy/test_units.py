"""Other units than metres, radians, seconds: refused in a sentence wherever they come in, and never driven on."""

import math
from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from rcdsac_trl.deploy import (
    CameraPose,
    ClearanceBeta,
    CloudFilter,
    Guard,
    InputLimits,
    Mount,
    PathFollower,
    Policy,
    Scan,
    Sectors,
    Stamps,
    cloud_sectors,
    scan_sectors,
)
from rcdsac_trl.deploy.policy.command import Command
from rcdsac_trl.deploy.policy.input_checks import BadInputError
from rcdsac_trl.deploy.policy.poses import PoseWatch
from rcdsac_trl.deploy.ros.messages import scan_of, stamp_s, twist_stamped
from rcdsac_trl.errors import UserInputError
from robots import AHEAD, OPEN, STANDING, agent

TURN = 2.0 * math.pi
ALL = np.ones(180, dtype=bool)
NOW_S = 1.76e9  # as clocks of the year 2025 count


def scan(ranges: Any, **changes: Any) -> Scan:
    ranges = np.broadcast_to(ranges, 360) if np.isscalar(ranges) else ranges
    fields = {"angle_min": -math.pi, "angle_increment": TURN / 360, "range_min": 0.1, "range_max": 12.0}
    return Scan(ranges, **(fields | changes))


def half(value: float, other: float) -> np.ndarray:
    return np.where(np.arange(360) % 2, value, other)


# ------------------------------------------------------------------------------------------------ scans
@pytest.mark.parametrize(
    ("wrong", "told"),
    [
        (scan(500.0), "reads up to 500, beyond its range_max of 12 m: give metres"),  # mm, a wall at 0.5 m
        (scan(50.0), "reads up to 50, beyond its range_max of 12 m: give metres"),  # cm
        (scan(half(500.0, math.inf)), "reads up to 500"),
        (scan(half(500.0, 0.0)), "reads up to 500"),
        (scan(half(500.0, math.nan)), "reads up to 500"),
        (scan(half(500.0, 65535.0)), "reads up to 500"),
        (scan(np.linspace(300.0, 9000.0, 360)), "reads up to 9000"),
        (scan(500.0, range_max=math.inf), "beyond any scanner's 300 m: give metres"),
        (scan(500.0, range_min=0.0, range_max=12000.0), "beyond any scanner's 300 m: give metres"),
        (scan(500.0, range_min=100.0, range_max=12000.0), "range_min=100 m on, agents see only up to 3 m"),
        (scan(0.5, range_min=100.0, range_max=12000.0), "range_min=100 m on, agents see only up to 3 m"),
        (scan(2.0, angle_min=-180.0), "angle_min=-180 is more than two turns (12.57 rad): give radians"),
        (scan(2.0, angle_increment=1.0), "is no scan: give radians"),
        (scan(np.full(9, 2.0), angle_min=-4.0, angle_increment=1.0), "angle_increment=1 is more than 0.5 rad"),
    ],
)
def test_a_scan_that_cannot_be_in_metres_and_radians_stops_the_robot(wrong: Scan, told: str) -> None:
    command = Policy(agent()).act(wrong, AHEAD, STANDING)
    assert (command.v_m_per_s, command.omega_rad_per_s, command.stopped) == (0.0, 0.0, True)
    assert told in str(command.reason)


@pytest.mark.parametrize(
    "right",
    [
        scan(12.5),  # a little beyond range_max: nothing there
        scan(20.0),
        scan(math.inf),
        scan(65.535),  # the last number of 16 bits, in mm
        scan(np.float32(65.533)),
        scan(65535.0),  # the same without its unit: no reading in mm either
        scan(3.4e38),
        scan(half(2.0, 999.0)),  # a driver's own sign, beside readings in metres
        scan(np.where(np.arange(360) % 8, 999.0, 2.0)),
        scan(np.where(np.arange(360) < 3, [37.0, 500.0, 81.0] * 120, 2.0)),  # outliers
        scan(2.0, range_max=math.inf),
        scan(150.0, range_max=200.0),
        scan(2.0, range_max=3.4e38),
        scan(2.0, angle_min=3.0 * math.pi),
        scan(np.full(180, 2.0), angle_increment=-TURN / 180),
    ],
)
def test_what_drivers_write_where_nothing_is_drives(right: Scan) -> None:
    assert Policy(agent()).act(right, AHEAD, STANDING).reason is None


metres = st.one_of(st.floats(0.3, 12.0), st.sampled_from([math.inf, math.nan, 0.0, 12.5, -math.inf]))


@settings(max_examples=100, deadline=None)
@given(st.lists(metres, min_size=360, max_size=360), st.sampled_from([100.0, 1000.0]))
def test_any_scan_in_metres_is_read_and_in_cm_or_mm_refused(values: list[float], unit: float) -> None:
    scan_sectors(scan(values))
    if not any(0.3 <= value <= 12.0 for value in values):
        return
    with pytest.raises(UserInputError, match="give metres"):
        scan_sectors(scan(np.array(values) * unit))


def test_zeros_are_open_space_only_where_that_is_said() -> None:
    zeros = scan(half(0.0, 2.0))
    assert scan_sectors(zeros).covered.all()  # half of the rays of a sector are enough
    none = Policy(agent()).act(scan(0.0), AHEAD, STANDING)
    assert none.stopped
    assert "360 of 360 rays read 0; if the driver writes 0 where nothing is, set zero_means=far" in str(none.reason)
    found = scan_sectors(scan(0.0, zero_means="far"))
    assert found.covered.all()
    assert np.isinf(found.distances_m).all()
    assert Policy(agent()).act(scan(0.0, zero_means="far"), AHEAD, STANDING).reason is None
    blind = Policy(agent()).act(scan(math.nan, zero_means="far"), AHEAD, STANDING)
    assert "zero_means" not in str(blind.reason)
    with pytest.raises(UserInputError, match="zero_means='open' is none of invalid, far, near"):
        scan_sectors(scan(2.0, zero_means="open"))


# ------------------------------------------------------------------------------------------------ the rest of the input
@pytest.mark.parametrize(
    ("change", "told"),
    [
        ({"ranges": np.full(180, 150.0)}, "no range is below 20 m, the smallest is 150: give metres"),
        ({"ranges": np.where(ALL, 50.0, np.inf)}, "no range is below 20 m, the smallest is 50"),
        ({"ranges": Sectors(np.full(180, 500.0), ALL)}, "a range of 500 is above 200, so not in metres"),
        ({"waypoints": [2000.0, 0.0]}, "a waypoint 2000 m away is out of sight: give metres"),
        (
            {"velocity": [300.0, 0.0]},
            "(300, 0) is not in m/s and rad/s: no robot of this kind exceeds 2 m/s or 6.28 rad/s",
        ),
        ({"velocity": [0.0, 45.0]}, "(0, 45) is not in m/s and rad/s"),
        ({"stamps": Stamps(*[NOW_S * 1e9] * 4)}, "now_s=1.76e+18 is above 1e+11, so not in seconds"),
        ({"stamps": Stamps(*[NOW_S * 1e3] * 4)}, "now_s=1.76e+12 is above 1e+11, so not in seconds"),
        ({"stamps": Stamps(*[np.float32(NOW_S)] * 4)}, "now_s is float32, which counts in steps of 128 s"),
        ({"stamps": Stamps(NOW_S, 0.0, NOW_S, NOW_S)}, "0 is what messages hold that nobody stamped"),
        ({"stamps": Stamps(NOW_S, 12.0, NOW_S, NOW_S)}, "of one clock (simulated time, wall time)?"),
        ({"stamps": Stamps(12.0, 11.9, 11.9, NOW_S)}, "of one clock (simulated time, wall time)?"),
    ],
)
def test_other_units_stop_the_robot(change: dict[str, Any], told: str) -> None:
    good: dict[str, Any] = {"ranges": OPEN, "waypoints": AHEAD, "velocity": STANDING}
    policy = Policy(agent())
    command = policy.act(**(good | change))
    assert command.stopped
    assert told in str(command.reason)
    assert not policy.act(**good).stopped


def cloud(unit: float, noise: float = 0.0) -> np.ndarray:
    """Return a wall 1 m ahead, and the floor up to it, some pixels without depth (0, 0, 0), some flying."""
    rng = np.random.default_rng(0)
    wall = np.stack(np.meshgrid([1.0], np.linspace(-1, 1, 40), np.linspace(-0.3, 0.7, 20)), -1).reshape(-1, 3)
    flying = rng.uniform(-noise, noise, (8, 3))
    return np.concatenate([unit * wall, np.zeros((50, 3)), flying])


def test_clouds_are_in_metres_and_their_zeros_are_nothing() -> None:
    pose = CameraPose((0.2, 0.0, 0.3))
    sectors = cloud_sectors([(cloud(1.0), pose)])
    assert sectors.distances_m[0] == pytest.approx(1.2, abs=1e-2)
    assert np.isinf(sectors.distances_m[90])
    for unit in (100.0, 1000.0):
        with pytest.raises(UserInputError, match="8 of 808 are within 20 m: give metres"):
            cloud_sectors([(cloud(unit, noise=10.0), pose)])
    with pytest.raises(UserInputError, match="0 of 800 are within 20 m: give metres"):
        cloud_sectors([(cloud(1000.0)[:850].astype(np.int16), pose)])
    assert not cloud_sectors([(np.zeros((500, 3)), pose)]).covered.any()


@pytest.mark.parametrize(
    ("make", "told"),
    [
        (lambda: Mount(x_m=150.0), "x_m=150, y_m=0 is more than 1 m from the robot's centre: give metres"),
        (lambda: Mount(yaw_rad=90.0), "yaw_rad=90 of a sensor is more than a full turn: give radians"),
        (lambda: CameraPose((200.0, 0.0, 300.0)), "is more than 3 m from the floor below the robot's centre"),
        (lambda: CameraPose((0.2, 0.0, 0.3), view_rad=70.0), r"outside \(0, 2 pi\]: give radians"),
        (lambda: CloudFilter(floor_m=50.0, ceiling_m=1000.0), "floor_m=50 or body_radius_m=0.2 is beyond the 3 m"),
        (lambda: CloudFilter(body_radius_m=200.0), "body_radius_m=200 is beyond the 3 m"),
        (lambda: InputLimits(max_age_s=350.0), "max_age_s=350 is above 10: give seconds"),
        (lambda: Guard(max_speed_m_per_s=300.0), "max_speed_m_per_s=300 of the guard is above 2"),
        (lambda: Guard(max_reverse_m_per_s=200.0), "max_reverse_m_per_s=200 of the guard is above 2"),
        (lambda: Guard(max_turn_rad_per_s=45.0), r"max_turn_rad_per_s=45 of the guard is above 6\.28"),
        (lambda: Guard(radius_m=250.0), "radius_m=250 of the guard is above 2"),
        (lambda: Guard(margin_m=50.0), "margin_m=50 of the guard is above 2"),
        (lambda: Guard(reaction_s=250.0), "reaction_s=250 of the guard is above 5"),
        (lambda: ClearanceBeta(-2.0, 0.0, near_m=400.0, far_m=1200.0), "near_m=400 is beyond the 3 m that agents see"),
        (lambda: PathFollower([(0.0, 0.0)], agent().config, tolerance_m=50.0), r"tolerance_m=50.0 is outside \[0, 1\]"),
        (lambda: PathFollower([(0.0, 0.0)], agent().config, tolerance_m=math.nan), "tolerance_m=nan is outside"),
    ],
)
def test_limits_and_mounts_in_other_units_are_refused(make: Any, told: str) -> None:
    with pytest.raises(UserInputError, match=told):
        make()


# ------------------------------------------------------------------------------------------------ messages
def laser(**changes: Any) -> SimpleNamespace:
    stamp = SimpleNamespace(sec=10, nanosec=500_000_000)
    fields = {"angle_min": -math.pi, "angle_max": math.pi, "angle_increment": TURN / 360, "range_min": 0.1}
    more = {"range_max": 12.0, "ranges": [2.0] * 360, "header": SimpleNamespace(stamp=stamp, frame_id="laser")}
    return SimpleNamespace(**(fields | more | changes))


@pytest.mark.parametrize(
    ("change", "told"),
    [
        ({"angle_increment": 1.0}, "lead to 355.858, its angle_max=3.14159 is elsewhere: give all three in radians"),
        ({"angle_min": -180.0, "angle_max": 180.0}, "lead to -173.734, its angle_max=180 is elsewhere"),
        ({"ranges": [2.0] * 180}, "180 rays from angle_min=-3.14159"),
        ({"ranges": ["2.0"] * 360}, "the scan's ranges are not numbers"),
    ],
)
def test_a_laser_scan_whose_fields_do_not_fit_is_refused(change: dict[str, Any], told: str) -> None:
    with pytest.raises(UserInputError, match=told):
        scan_of(laser(**change))


def test_a_laser_scan_may_count_its_last_angle_either_way_and_run_clockwise() -> None:
    exact = math.pi - TURN / 360
    for first, last, sign in ((-math.pi, math.pi, 1), (-math.pi, exact, 1), (math.pi, -math.pi, -1)):
        scan_of(laser(angle_min=first, angle_max=last, angle_increment=sign * TURN / 360))
    assert np.isnan(scan_of(laser(ranges=np.ma.array([2.0] * 360, mask=True))).ranges).all()


def test_stamps_hold_less_than_a_second_of_nanoseconds() -> None:
    assert stamp_s(laser()) == 10.5
    for nanosec in (10_500_000_000, -1):
        wrong = laser(header=SimpleNamespace(stamp=SimpleNamespace(sec=10, nanosec=nanosec)))
        with pytest.raises(UserInputError, match=f"nanosec={nanosec} is not from 0 to 999999999"):
            stamp_s(wrong)


def test_a_command_is_stamped_in_seconds() -> None:
    def make(name: str) -> Any:
        vectors = {"linear": SimpleNamespace(x=0.0), "angular": SimpleNamespace(z=0.0)}
        return SimpleNamespace(header=SimpleNamespace(stamp=SimpleNamespace()), **vectors)

    command = Command(0.25, -0.5, False, None)
    message = twist_stamped(command, 12.5, make)
    assert (message.header.stamp.sec, message.header.stamp.nanosec) == (12, 500_000_000)
    assert (message.twist.linear.x, message.twist.angular.z) == (0.25, -0.5)
    for now_s in (NOW_S * 1e9, -1.0, math.nan, None):
        with pytest.raises(UserInputError, match="give seconds"):
            twist_stamped(command, now_s, make)  # type: ignore[arg-type]


def test_a_pose_in_millimetres_moves_too_fast_and_a_corrected_one_does_not() -> None:
    watch = PoseWatch()
    for position, stamp in (((0.0, 0.0), 1.0), ((0.1, 0.0), 1.14), ((5.0, 3.0), 1.28), ((5.1, 3.0), 1.42)):
        watch.check(position, stamp, (0.6, 0.0))
    with pytest.raises(BadInputError, match=r"moved by 84 m in 0\.14 s, more than 10\.3 m: give metres"):
        watch.check((89.1, 3.0), 1.56, (0.6, 0.0))
    watch.check((89.2, 3.0), 1.70, (0.6, 0.0))


def test_stamps_of_any_clock_in_seconds_drive() -> None:
    for now in (0.0, 12.0, NOW_S):
        policy = Policy(agent())
        stamps = Stamps(now + 0.1, now + 0.05, now + 0.05, now + 0.05)
        assert policy.act(OPEN, AHEAD, STANDING, stamps=stamps).reason is None
        later = replace(stamps, now_s=np.float64(now + 0.24), scan_s=now + 0.2)
        assert policy.act(OPEN, AHEAD, STANDING, stamps=later).fresh
