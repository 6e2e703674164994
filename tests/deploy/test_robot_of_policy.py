"""A policy's robot: weights carry it, the guard takes shape and limits from it, and what is another's is refused."""

import json
import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from rcdsac_trl.deploy import (
    ClearanceBeta,
    Guard,
    Policy,
    Scan,
    Sectors,
    cloud_sectors,
    read_weights,
    scan_sectors,
)
from rcdsac_trl.deploy.frames.sensor_mounts import mount_of
from rcdsac_trl.deploy.policy.driver import Driver
from rcdsac_trl.deploy.policy.registry import shipped_agents
from rcdsac_trl.deploy.policy.weights import FORMAT_VERSION, packed
from rcdsac_trl.deploy.sensors.cloud import CameraPose
from rcdsac_trl.errors import UserInputError
from rcdsac_trl.robot.range_sensor import LidarSettings
from rcdsac_trl.robot.robot_settings import PAPER, RobotSettings
from rcdsac_trl.robot.sectors import Mount, mount_of_lidar
from rcdsac_trl.robot.sensed_distances import outline_distances
from rcdsac_trl.world.sim.lidar import sector_distances
from robots import AHEAD, OPEN, STANDING, agent

ALL = np.ones(180, dtype=np.bool_)
NO_CIRCLES = np.empty((0, 3))
BURGER = RobotSettings(
    "burger",
    "rectangle",
    None,
    None,
    length_m=0.138,
    width_m=0.178,
    middle_x_m=-0.032,
    max_speed_m_per_s=0.22,
    max_reverse_m_per_s=0.07,
    max_turn_deg_per_s=162.72,
    lidar=LidarSettings(max_range_m=3.5, x_m=-0.032),
)
CAR = RobotSettings("car", "rectangle", None, None, length_m=0.5, width_m=0.4, max_speed_m_per_s=2.0)


def full(robot: RobotSettings) -> Policy:
    return Policy(agent(sensor="full", robot=robot))


def scan(distance_m: float = 2.0, range_max: float = 10.0, view_deg: float = 360.0) -> Scan:
    view = math.radians(view_deg)
    return Scan(np.full(360, distance_m), -view / 2, view / 360, 0.1, range_max)


# ------------------------------------------------------------------------------------------------ weights
def test_weights_carry_their_robot(tmp_path: Path) -> None:
    for name, content in packed(agent(robot=BURGER)).items():
        (tmp_path / name).write_bytes(content)
    weights = read_weights(tmp_path)
    assert weights.config.robot == BURGER
    assert Policy(weights).robot == BURGER
    card = (tmp_path / "README.md").read_text()
    assert "| drives | `burger`, rectangle of 0.138 x 0.178 m, -0.07 to 0.22 m/s, 162.72 degrees/s," in card
    assert "robot of 0.135 m radius" in card


def test_weights_of_before_drive_the_papers_robot(tmp_path: Path) -> None:
    for name, content in packed(agent()).items():
        (tmp_path / name).write_bytes(content)
    config = json.loads((tmp_path / "config.json").read_bytes())
    assert config.pop("format_version") == FORMAT_VERSION == 6
    del config["robot"], config["restart_steps"], config["look_ahead"], config["acting"], config["recalibration"]
    (tmp_path / "config.json").write_text(json.dumps(config | {"format_version": 3}))
    assert read_weights(tmp_path).config == agent().config
    for folder in shipped_agents().values():
        assert read_weights(folder).config.robot == PAPER


@pytest.mark.parametrize(
    ("key", "value", "told"),
    [
        ("radius_m", -1.0, "robot.radius_m=-1.0 of a polygon must be a positive number"),
        ("wheels", 4, "robot has the wrong keys (wheels)"),
        ("lidar", None, "robot.lidar is None: give a section"),
    ],
)
def test_a_damaged_robot_is_refused(tmp_path: Path, key: str, value: object, told: str) -> None:
    for name, content in packed(agent()).items():
        (tmp_path / name).write_bytes(content)
    config = json.loads((tmp_path / "config.json").read_bytes())
    config["robot"][key] = value
    (tmp_path / "config.json").write_text(json.dumps(config))
    with pytest.raises(UserInputError) as raised:
        read_weights(tmp_path)
    assert told in str(raised.value)


# ------------------------------------------------------------------------------------------------ driving
def test_commands_are_within_the_robots_own_limits() -> None:
    policy = full(CAR)
    for u, expected in (((1.0, 1.0), (2.0, math.pi / 2)), ((-1.0, 0.1), (-0.2, 0.0))):
        policy.act(OPEN, AHEAD, STANDING)
        assert policy.foresee(action=np.array(u)).wanted == pytest.approx(expected)
    assert policy.act(OPEN, AHEAD, [2.1, 0.0]).stopped is False  # above the 2 m/s of smaller robots
    assert "exceeds 3 m/s" in str(policy.act(OPEN, AHEAD, [3.1, 0.0]).reason)


def test_a_scan_of_another_reach_is_refused() -> None:
    policy = full(BURGER)
    assert not policy.act(scan(), AHEAD, STANDING).stopped
    command = policy.act(scan(range_max=3.0), AHEAD, STANDING)
    assert command.stopped
    assert "the scan measures 0.1 to 3 m, agents see up to 3.5 m" in str(command.reason)
    assert not full(PAPER).act(scan(range_max=3.0), AHEAD, STANDING).stopped


def test_a_scan_of_another_field_of_view_is_refused() -> None:
    half = replace(PAPER, name="half", lidar=LidarSettings(field_of_view_deg=((-90.0, 90.0),)))
    assert not full(half).act(scan(view_deg=180.0), AHEAD, STANDING).stopped
    command = full(PAPER).act(scan(view_deg=180.0), AHEAD, STANDING)
    assert "50 % of the range bins this agent sees are not measured" in str(command.reason)


def test_sectors_of_another_reach_are_refused() -> None:
    policy = full(BURGER)
    command = policy.act(scan_sectors(scan(3.2)), AHEAD, STANDING)  # cut off at 3 m
    assert "sectors were filled up to 3 m, and robot=burger of this agent sees up to 3.5 m" in str(command.reason)
    sectors = scan_sectors(scan(3.2), max_range_m=3.5)
    assert sectors.distances_m.max() == pytest.approx(3.2)
    assert not policy.act(sectors, AHEAD, STANDING).stopped
    cloud = np.stack(np.meshgrid([3.2], np.linspace(-1, 1, 99), [0.3]), -1)
    assert np.isfinite(cloud_sectors([(cloud, CameraPose((0.0, 0.0, 0.0)))], max_range_m=3.5).distances_m[0])
    assert not np.isfinite(cloud_sectors([(cloud, CameraPose((0.0, 0.0, 0.0)))]).distances_m[0])


def test_what_touches_a_small_robot_is_no_part_of_it() -> None:
    """0.12 m ahead is inside of the paper's robot, and not of the small one."""
    near = scan(0.12)
    assert scan_sectors(near, body_radius_m=BURGER.body_radius_m).distances_m.max() == pytest.approx(0.12)
    command = full(BURGER).act(replace(near, range_min=0.05), AHEAD, STANDING)
    assert not command.stopped
    assert full(PAPER).act(replace(near, range_min=0.05), AHEAD, STANDING).stopped


def test_the_driver_knows_where_the_scanner_sits() -> None:
    driver = Driver(full(BURGER))
    assert mount_of(driver._own_mount) == mount_of_lidar(BURGER.lidar) == Mount(-0.032, 0.0, 0.0)
    assert driver._filter.body_radius_m == BURGER.body_radius_m
    assert mount_of(Driver(full(PAPER))._own_mount) == Mount()
    given = Driver(full(BURGER), mount=Mount(0.1))._mount
    assert given is not None
    assert mount_of(given) == Mount(0.1)


def test_clearance_of_a_robot_that_sees_farther() -> None:
    far = replace(PAPER, lidar=LidarSettings(max_range_m=6.0))
    assert ClearanceBeta(-2.0, 0.0, near_m=4.0, far_m=5.0, robot=far)(np.full(180, 4.5), None) == -1.0
    with pytest.raises(UserInputError, match="near_m=4 is beyond the 3 m that agents see"):
        ClearanceBeta(-2.0, 0.0, near_m=4.0, far_m=5.0)


# ------------------------------------------------------------------------------------------------ guard
def test_the_guard_is_the_robots() -> None:
    guard = full(BURGER).guard
    assert guard == Guard.of(BURGER)
    assert (guard.max_speed_m_per_s, guard.max_reverse_m_per_s, guard.radius_m) == (0.22, 0.07, BURGER.circumradius_m)
    assert full(PAPER).guard == Guard() == Guard.of(PAPER)
    assert Policy(agent(), guard=None).guard is None
    assert Policy(agent(robot=CAR), guard=Guard.of(CAR, margin_m=0.1)).guard.margin_m == 0.1  # type: ignore[union-attr]
    for made in (lambda: Guard.of("jackal"), lambda: Guard(robot="jackal")):  # type: ignore[arg-type]
        with pytest.raises(UserInputError, match=r"robot='jackal' of the guard is none: give policy\.robot"):
            made()
    with pytest.raises(UserInputError, match="guard='off' is none: give"):
        Policy(agent(), guard="off")  # type: ignore[arg-type]
    with pytest.raises(UserInputError, match=r"limits of robot=paper, and this agent drives robot=car: give Guard\.of"):
        Policy(agent(robot=CAR), guard=Guard(radius_m=0.4))


def beside(y: float) -> Sectors:
    return Sectors(sector_distances(0.0, 0.0, 0.0, np.array([[-9.0, y, 9.0, y]]), NO_CIRCLES), ALL)


def ahead(x: float) -> Sectors:
    return Sectors(sector_distances(0.0, 0.0, 0.0, np.array([[x, -9.0, x, 9.0]]), NO_CIRCLES), ALL)


def test_a_rectangle_is_guarded_by_its_sides() -> None:
    guard = Guard.of(CAR)
    # Its side is 0.2 m from its centre, its circle reaches 0.32 m.
    assert guard.limit(0.5, 0.0, beside(0.27), (0.5, 0.0)) == (0.5, 0.0, None)
    assert Guard.of(CAR, radius_m=0.33).limit(0.5, 0.4, beside(0.35), (0.5, 0.0))[2] == "the stop zone"
    # Turning left it comes nearer with its front left corner.
    assert guard.limit(0.5, 0.8, beside(0.27), (0.5, 0.0))[2] == "the stop zone"


def test_the_way_of_a_rectangle_to_a_wall_by_hand() -> None:
    guard = Guard.of(CAR)
    # As for the disc: on for 0.25 s, then braking at 1.5 m/s^2 in steps of 0.05 s; the front is 0.25 m ahead.
    way = 1.0 * 0.25 + 1.0 / 3.0 - 1.0 * 0.05 / 2.0
    needed = 0.25 + guard.margin_m + way
    assert guard.limit(1.0, 0.0, ahead(needed + 0.015), (1.0, 0.0)) == (1.0, 0.0, None)
    assert guard.limit(1.0, 0.0, ahead(needed - 0.01), (1.0, 0.0))[0] < 1.0


def test_distances_of_an_outline_are_those_of_all_its_points() -> None:
    rng = np.random.default_rng(0)
    sides = np.linspace(0.0, 1.0, 400)[:, None]
    rays_m = np.linspace(0.0, 6.0, 1200)
    met = 0
    for _ in range(25):
        corners = BURGER.outline * rng.uniform(1.0, 5.0)
        angles = rng.uniform(0.0, 2.0 * math.pi, 3)
        borders = np.stack((np.cos(angles), np.sin(angles)))
        nearest = rng.uniform(0.05, 1.0, 3)
        place, yaw = rng.uniform(-0.4, 0.4, 2), rng.uniform(-math.pi, math.pi)
        cos, sin = math.cos(yaw), math.sin(yaw)
        found = outline_distances(corners, place[None, None], np.array([[cos, sin]]), borders, nearest)[0, 0].min()
        turned = corners @ np.array([[cos, sin], [-sin, cos]]) + place
        outline = np.concatenate(
            [a + sides * (b - a) for a, b in zip(turned, np.roll(turned, -1, axis=0), strict=True)]
        )
        points = np.concatenate(
            [(near + rays_m)[:, None] * border for near, border in zip(nearest, borders.T, strict=True)]
        )
        expected = np.hypot(*(outline[:, None] - points).transpose(2, 0, 1)).min()
        met += found == 0.0
        # Where they meet, some point of the outline or of the rays lies within their spacing.
        assert found == pytest.approx(expected, abs=0.01)
    assert 0 < met < 25
