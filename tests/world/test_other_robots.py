"""Robots of other shapes in the world: contact where their sides are, clearance by hand, the whole task."""

import itertools
import math
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from rcdsac_trl.config.compose import choices, compose
from rcdsac_trl.config.run_config import training_settings
from rcdsac_trl.errors import UserInputError
from rcdsac_trl.robot.range_sensor import LidarSettings
from rcdsac_trl.robot.robot_settings import PAPER, RobotSettings
from rcdsac_trl.rollout.planners.dwa import Dwa
from rcdsac_trl.rollout.planners.mppi import Mppi
from rcdsac_trl.seeding import stream
from rcdsac_trl.world.maps.generator import Box, Map, MapSettings, generate_map
from rcdsac_trl.world.maps.geometry import outline_clearance
from rcdsac_trl.world.maps.planner import Planner
from rcdsac_trl.world.render import Renderer
from rcdsac_trl.world.sim import bodies
from rcdsac_trl.world.sim.simulation import Simulation
from rcdsac_trl.world.task.env import NavigationEnv

NO_BOXES, NO_CIRCLES = np.empty((0, 6)), np.empty((0, 3))
PLATE = RobotSettings("plate", "rectangle", None, None, length_m=0.6, width_m=0.4)
OFFSET = replace(PLATE, middle_x_m=-0.1)
SMALL: dict[str, Any] = {"size_m": 10.0, "layouts": ("clutter",)}


def robot(name: str) -> RobotSettings:
    return training_settings(compose("train", ["+algo=sac", f"robot={name}"])).robot


# ------------------------------------------------------------------------------------------------ clearance
@pytest.mark.parametrize(
    ("pose", "expected"),
    [
        ((0.0, 0.0, 0.0), 0.7),  # the front is 0.3 m ahead of the centre
        ((0.0, 0.0, math.pi / 2), 0.8),  # a side is 0.2 m away
        ((0.0, 0.0, math.pi / 4), 1.0 - (0.3 + 0.2) / math.sqrt(2)),  # a corner
        ((0.0, 5.0, 0.0), 2.0),  # beside the wall's end, which is 5 - 0.2 - 1 away: cut off
    ],
)
def test_clearance_of_a_rectangle_by_hand(pose: tuple[float, float, float], expected: float) -> None:
    wall = np.array([[1.5, 0.0, 0.5, 1.0, 1.0, 0.0]])
    assert outline_clearance(PLATE.outline, pose, wall, NO_CIRCLES, 2.0) == pytest.approx(expected)
    # Of the body whose middle lies 0.1 m behind, the front is 0.2 m ahead.
    if pose[2] == 0.0 and pose[1] == 0.0:
        assert outline_clearance(OFFSET.outline, pose, wall, NO_CIRCLES, 2.0) == pytest.approx(0.8)


def test_clearance_of_a_rectangle_to_a_post() -> None:
    post = np.array([[0.6, 0.6, 0.1]])
    assert outline_clearance(PLATE.outline, (0.0, 0.0, 0.0), NO_BOXES, post, 2.0) == pytest.approx(0.5 - 0.1)


@pytest.mark.parametrize("middle_x_m", [0.0, 0.1])
def test_inertia_of_a_plate_by_hand(middle_x_m: float) -> None:
    expected = 10.0 * ((0.6**2 + 0.4**2) / 12.0 + middle_x_m**2)
    assert bodies._inertia(replace(PLATE, middle_x_m=middle_x_m)) == pytest.approx(expected)
    assert bodies._inertia(PAPER) == 0.5 * 10.0 * 0.25**2


# ------------------------------------------------------------------------------------------------ physics
def driven_into_a_wall(own: RobotSettings, yaw: float, v: float) -> tuple[Simulation, float]:
    """Drive straight into a wall whose face is at x = 6 m until it stops; return where the centre is."""
    wall = Box(6.1, 4.0, 0.1, 4.0, 0.0, mapped=True)
    map_ = Map("clutter", 8.0, (wall,), (), ())
    simulation = Simulation(robot=own)
    simulation.load(map_, Planner(map_, own.circumradius_m), (4.5, 4.0, yaw), stream(0, "movers"))
    for _ in range(int(2.0 / abs(v) / (7 * own.motor_period_s)) + 5):
        result = simulation.step(v, 0.0, 7)
    assert result.in_contact
    return simulation, result.pose[0]


@pytest.mark.parametrize(
    ("own", "front_m", "rear_m"),
    [
        (PLATE, 0.3, 0.3),
        (OFFSET, 0.2, 0.4),
        (RobotSettings("disc", "disc", 0.17, None), 0.17, 0.17),
        (RobotSettings("hexagon", "polygon", 0.3, 6), 0.3 * math.cos(math.pi / 6), 0.3 * math.cos(math.pi / 6)),
    ],
    ids=["rectangle", "offset", "disc", "hexagon"],
)
def test_a_robot_stops_where_its_side_meets_the_wall(own: RobotSettings, front_m: float, rear_m: float) -> None:
    simulation, x = driven_into_a_wall(own, 0.0, 0.6)
    simulation.close()
    assert x == pytest.approx(6.0 - front_m, abs=2e-3)
    simulation, x = driven_into_a_wall(own, math.pi, -0.2)
    simulation.close()
    assert x == pytest.approx(6.0 - rear_m, abs=2e-3)


def test_a_contact_of_a_rectangle_ends_by_its_sides() -> None:
    """Its circle reaches 0.36 m: a robot that has backed off by 0.1 m is clear of the wall, and its circle is not."""
    simulation, x = driven_into_a_wall(PLATE, 0.0, 0.6)
    result = simulation.step(-0.2, 0.0, 35)
    assert x - result.pose[0] > 0.1 > PLATE.circumradius_m - 0.3
    in_contact = [simulation.step(0.0, 0.0, 7).in_contact for _ in range(4)]
    simulation.close()
    assert in_contact[-1] is False


def test_the_motor_period_is_the_step_of_the_physics() -> None:
    slow = replace(PAPER, motor_period_s=0.05)
    empty = Map("clutter", 20.0, (), (), ())
    simulation = Simulation(robot=slow)
    simulation.load(empty, Planner(empty), (5.0, 5.0, 0.0), stream(0, "movers"))
    result = simulation.step(0.6, 0.0, 4)
    simulation.close()
    assert result.v_c == pytest.approx(4 * 1.5 * 0.05)
    # The velocities of the steps are 0.075, 0.15, 0.225 and 0.3 m/s.
    assert result.pose[0] - 5.0 == pytest.approx(0.75 * 0.05)


# ------------------------------------------------------------------------------------------------ maps
@pytest.mark.parametrize("radius_m", [0.1346, 0.3328])
def test_maps_are_made_for_the_robot(radius_m: float) -> None:
    settings = MapSettings()
    for index in range(3):
        map_ = generate_map(settings, "train", 0, index, radius_m)
        planner = Planner(map_, radius_m)
        rng = stream(0, "robots", index)
        start = planner.sample_free(rng)
        goal = planner.sample_goal(rng, start)
        assert planner._true.clearance(start, start) >= radius_m + settings.clearance_margin_m - 1e-9
        legs = np.vstack([start, planner.waypoints(start, goal)])
        for a, b in itertools.pairwise(legs):
            assert planner._known.clearance(a, b) >= radius_m - 1e-6
    assert generate_map(settings, "train", 0, 0, 0.25) == generate_map(settings, "train", 0, 0)


# ------------------------------------------------------------------------------------------------ the task
@pytest.mark.parametrize("name", choices("robot"))
def test_every_robot_drives_in_the_environment(name: str) -> None:
    own = robot(name)
    env = NavigationEnv(map_settings=MapSettings(**SMALL), agent_ids=(0, 1), sensor="full", memory_s=5.0, robot=own)
    env.set_seed(1)
    driven = env.rollout(12, lambda td: td.set("action", env.action_spec.ones()))
    seen = driven["range"]
    mask = own.sensor_mask("full")
    assert not seen[..., ~mask].any()
    assert seen[..., mask].any()
    assert env.observation_spec.is_in(env.reset())
    assert driven["next", "velocity"][..., 0].max() <= own.max_speed_m_per_s + 1e-6
    scene = env.agents.scene(0)
    assert scene.robot == own
    assert Renderer(size_px=128, view_m=4.0).draw(scene).std() > 0
    env.close()


def test_it_sees_as_far_as_its_sensor() -> None:
    def nearest(max_range_m: float) -> float:
        empty = Map("clutter", 20.0, (Box(10.0, 5.0, 0.5, 5.0, 0.0, mapped=True),), (), ())
        simulation = Simulation(robot=replace(PAPER, lidar=LidarSettings(max_range_m=max_range_m)))
        simulation.load(empty, Planner(empty), (5.0, 5.0, 0.0), stream(0, "movers"))
        seen = float(simulation.scan().min())
        simulation.close()
        return seen

    assert (nearest(3.0), nearest(4.4), nearest(4.6)) == (np.inf, np.inf, pytest.approx(4.5))


def test_a_robot_that_fits_through_no_passage_is_refused() -> None:
    with pytest.raises(
        UserInputError, match=r"robot=wide reaches 0\.5 m .* needs passages of 1\.2 m, map\.door_width_m"
    ):
        NavigationEnv(agent_ids=(0,), robot=replace(PAPER, name="wide", radius_m=0.5))


@pytest.mark.parametrize("make", [Dwa, Mppi])
def test_classical_planners_use_what_the_robot_can(make: Any) -> None:
    own = robot("turtlebot3_burger")
    planner = make(robot=own)
    planner.reset(own.sensor_mask("full"), stream(0, "planner"), 0.14)
    v, omega = planner.act(np.full(180, np.inf), np.array([[3.0, 0.0], [3.0, 0.0]]), np.array([0.22, 0.0, 0.22, 0.0]))
    assert 0.18 < v <= 0.22
    assert abs(omega) < own.max_angular_velocity
