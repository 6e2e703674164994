"""The guard of a robot with corners: what swings out counts, by hand and in any scene."""

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from motors import driven

from rcdsac_trl.deploy import Guard, Sectors
from rcdsac_trl.robot.robot_settings import PAPER, RobotSettings
from rcdsac_trl.world.maps.geometry import outline_clearance
from rcdsac_trl.world.maps.shapes import Box, Cylinder, Map
from rcdsac_trl.world.sim.lidar import sector_distances

ALL = np.ones(180, dtype=np.bool_)
NO_CIRCLES = np.empty((0, 3))
# Its sides are 0.2 m from its centre, its corners 0.32 m.
CAR = RobotSettings("car", "rectangle", None, None, length_m=0.5, width_m=0.4)
LONG = RobotSettings("long", "rectangle", None, None, length_m=0.8, width_m=0.4, middle_x_m=-0.15)


def beside(y: float, yaw: float = 0.0) -> Sectors:
    """A long wall along the way, to the left."""
    return Sectors(sector_distances(0.0, 0.0, yaw, np.array([[-9.0, y, 9.0, y]]), NO_CIRCLES), ALL)


def turned_on_the_spot(y: float) -> float:
    """Ask for a turn to the left beside a wall for 17 seconds; return how far the robot turns."""
    yaw = omega = 0.0
    for _ in range(120):
        _, turn, _ = Guard.of(CAR).limit(0.0, 0.6, beside(y, yaw), (0.0, omega))
        poses, (_, omega) = driven((0.0, turn), (0.0, 0.0, yaw), (0.0, omega), CAR)
        yaw = poses[-1][2]
    return yaw


def test_a_corner_turns_no_farther_than_a_wall_lets_it() -> None:
    # The left front corner is 0.25 sin(yaw) + 0.2 cos(yaw) to the left: with 0.29 m, 1 cm before the wall, at 26.3
    # degrees; with 0.25 m, where the margin begins, at 12.7.
    assert math.radians(12.0) < turned_on_the_spot(0.30) < math.radians(26.3)
    assert turned_on_the_spot(0.32 + 0.05 + 0.02) > 2.0 * math.pi  # 2 cm: a sector's blur


def test_why_it_does_not_turn_is_told() -> None:
    assert Guard.of(CAR).limit(0.0, 0.5, beside(0.5)) == (0.0, 0.5, None)
    assert Guard.of(CAR).limit(0.0, 1.5, beside(0.26), (0.0, 1.0)) == (0.0, 0.0, "the stop zone")
    assert Guard.of(PAPER).limit(0.0, 1.5, beside(0.26), (0.0, 1.0)) == (0.0, 1.5, None)
    # Whatever circle is given, its corners are 0.32 m away.
    limited = Guard.of(CAR).limit(0.0, 1.5, beside(0.31), (0.0, 1.0))
    assert limited[2] == "the stop zone"
    assert Guard.of(CAR, radius_m=0.2).limit(0.0, 1.5, beside(0.31), (0.0, 1.0)) == limited


def test_it_turns_to_a_way_on_the_side_on_which_its_corners_get_past() -> None:
    """Before a wall it would turn to the left; then a post stands where its rear right corner, 0.29 m away, swings."""
    wall = np.array([[0.31, -9.0, 0.31, 9.0]])
    ahead = Sectors(sector_distances(0.0, 0.0, 0.0, wall, NO_CIRCLES), ALL)
    post = np.array([[-0.185, -0.285, 0.04]])
    with_post = Sectors(sector_distances(0.0, 0.0, 0.0, wall, post), ALL)
    robot = RobotSettings("slim", "rectangle", None, None, length_m=0.5, width_m=0.3)
    turns = [Guard.of(robot).limit(0.3, 0.1, seen)[1] for seen in (ahead, with_post)]
    assert turns[0] > 0.0
    assert turns[1] < 0.0


def scene(rng: np.random.Generator) -> Map:
    """Draw boxes and round things around the origin."""
    angles, halves = rng.uniform(0.0, math.pi, 4), rng.uniform(0.05, 0.8, (4, 2))
    boxes = [Box(*rng.uniform(-2.5, 2.5, 2), *half, yaw, mapped=True) for half, yaw in zip(halves, angles, strict=True)]
    discs = [Cylinder(*rng.uniform(-2.5, 2.5, 2), rng.uniform(0.02, 0.3), mapped=True) for _ in range(8)]
    return Map("clutter", 10.0, tuple(boxes), tuple(discs), ())


@pytest.mark.parametrize("robot", [CAR, LONG])
@settings(max_examples=12, deadline=None)
@given(st.integers(0, 2**32 - 1))
def test_no_command_drives_or_turns_into_what_is_sensed(robot: RobotSettings, seed: int) -> None:
    rng = np.random.default_rng(seed)
    around_it = scene(rng)
    segments, (solid, circles) = around_it.segments(), around_it.solids()
    guard = Guard.of(robot)
    middles = np.concatenate([solid[:, :2], circles[:, :2]])
    inside = (middles > robot.outline.min(0)).all(1) & (middles < robot.outline.max(0)).all(1)
    # Nothing may begin within the margin, nor wholly inside the robot.
    if outline_clearance(robot.outline, (0.0, 0.0, 0.0), solid, circles, 2.0) < guard.margin_m or inside.any():
        return
    x = y = yaw = v = omega = 0.0
    wanted = (0.0, 0.0)
    for step in range(120):
        if step % 6 == 0:  # a driver who holds on to what hurts for a while
            wanted = float(rng.choice([0.6, 0.0, -0.2, rng.uniform(-0.2, 0.6)])), float(rng.uniform(-1.57, 1.57))
        seen = Sectors(sector_distances(x, y, yaw, segments, circles), ALL)
        command = guard.limit(*wanted, seen, (v, omega))[:2]
        poses, (v, omega) = driven(command, (x, y, yaw), (v, omega), robot)
        x, y, yaw = poses[-1]
        assert min(outline_clearance(robot.outline, pose, solid, circles, 2.0) for pose in poses) > 0.0
