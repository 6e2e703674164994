"""Physics: hand-computed motion, contact, bounds that hold whatever happens, determinism, no leak."""

import math
import os
from dataclasses import replace

import numpy as np
import pybullet
import pytest

from rcdsac_trl.config.compose import compose
from rcdsac_trl.errors import UserInputError
from rcdsac_trl.evaluation.evaluation import make_evaluation
from rcdsac_trl.robot.limits import MOTOR_PERIOD_S
from rcdsac_trl.seeding import stream
from rcdsac_trl.world.maps.generator import Box, Cylinder, Map, MapSettings, Mover, generate_map
from rcdsac_trl.world.maps.planner import Planner
from rcdsac_trl.world.sim import bodies
from rcdsac_trl.world.sim import simulation as world_simulation
from rcdsac_trl.world.sim.lidar import sector_distances
from rcdsac_trl.world.sim.simulation import Simulation
from rcdsac_trl.world.sim.walk import STOP_GAP_M

APOTHEM_M = 0.25 * math.cos(math.pi / 8.0)


def room(size_m=8.0, cylinders=(), movers=()):
    """A square room with walls 0.2 m thick around [0, size]^2."""
    middle, half = size_m / 2.0, size_m / 2.0 + 0.2
    walls = (
        Box(middle, -0.1, half, 0.1, 0.0, mapped=True),
        Box(middle, size_m + 0.1, half, 0.1, 0.0, mapped=True),
        Box(-0.1, middle, half, 0.1, math.pi / 2.0, mapped=True),
        Box(size_m + 0.1, middle, half, 0.1, math.pi / 2.0, mapped=True),
    )
    return Map("clutter", size_m, walls, tuple(cylinders), tuple(movers))


@pytest.mark.parametrize(("display", "told"), [(None, "DISPLAY is not set"), (":12345", "DISPLAY=:12345 cannot be")])
def test_a_window_without_a_display_is_refused_and_ends_no_process(
    monkeypatch: pytest.MonkeyPatch, display: str | None, told: str
) -> None:
    monkeypatch.delenv("DISPLAY", raising=False)
    if display is not None:
        monkeypatch.setenv("DISPLAY", display)
    # PyBullet, asked for a window, would end the process that runs this test.
    monkeypatch.setattr(world_simulation, "Client", None)
    with pytest.raises(UserInputError, match=rf"gui=true needs a display, and {told}"):
        Simulation(gui=True)
    with pytest.raises(UserInputError, match=rf"gui=true needs a display, and {told}"):
        make_evaluation(compose("evaluate", ["baseline=pursuit", "gui=true"]))


@pytest.fixture
def simulation():
    simulation = Simulation()
    yield simulation
    simulation.close()


def load(simulation, map, pose, seed=0):
    simulation.load(map, Planner(map), pose, stream(seed, "movers"))


# Motion in the open


def test_acceleration_from_rest_by_hand(simulation):
    load(simulation, room(), (4.0, 4.0, 0.0))
    result = simulation.step(0.6, 0.0, motor_steps=7)
    # 0.03 m/s more in each motor step of 0.02 s: 0.21 m/s, and 0.02 * 0.03 * (1 + ... + 7) m.
    assert result.v_c == pytest.approx(0.21, abs=1e-12)
    assert result.pose == pytest.approx((4.0 + 0.0168, 4.0, 0.0), abs=1e-12)
    assert result.omega_c == 0.0
    assert result.in_contact is False


def test_angular_acceleration_from_rest_by_hand(simulation):
    load(simulation, room(), (4.0, 4.0, 3.0))
    result = simulation.step(0.0, math.radians(90), motor_steps=6)
    assert result.omega_c == pytest.approx(math.radians(6 * 2.4), abs=1e-12)
    assert result.pose[2] == pytest.approx(3.0 + math.radians(0.02 * 2.4 * 21), abs=1e-6)
    for _ in range(10):
        result = simulation.step(0.0, math.radians(90), motor_steps=8)
    assert result.omega_c == pytest.approx(math.radians(90), abs=1e-12)
    assert -math.pi <= result.pose[2] <= math.pi
    assert simulation.step(0.0, math.radians(-90), 1).omega_c == pytest.approx(math.radians(90 - 2.4))


@pytest.mark.parametrize("motor_steps", [1, 6, 7, 8])
def test_number_of_motor_steps(simulation, motor_steps):
    load(simulation, room(), (4.0, 4.0, 0.0))
    assert simulation.step(-0.2, 0.0, 20).v_c == pytest.approx(-0.2, abs=1e-12)
    x = simulation.pose[0]
    simulation.step(-0.2, 0.0, motor_steps)
    assert simulation.pose[0] - x == pytest.approx(-0.2 * 0.02 * motor_steps, abs=1e-9)


def test_top_speed_in_a_straight_line(simulation):
    yaw = 0.7
    load(simulation, replace(room(60.0)), (5.0, 5.0, yaw))
    simulation.step(0.6, 0.0, 20)
    start = simulation.pose
    for _ in range(500):
        result = simulation.step(0.6, 0.0, 7)
    assert result.v_c == pytest.approx(0.6, abs=1e-12)
    driven = 500 * 7 * 0.02 * 0.6
    expected = (start[0] + driven * math.cos(yaw), start[1] + driven * math.sin(yaw), yaw)
    assert result.pose == pytest.approx(expected, abs=1e-6)


def test_velocities_run_through_a_step_boundary(simulation):
    load(simulation, room(), (4.0, 4.0, 0.0))
    simulation.step(0.6, 0.3, 7)
    simulation.step(0.6, 0.3, 7)
    in_two = simulation.pose
    load(simulation, room(), (4.0, 4.0, 0.0))
    simulation.step(0.6, 0.3, 14)
    assert simulation.pose == pytest.approx(in_two, abs=1e-12)


# Contact


def test_wall_stops_the_robot(simulation):
    load(simulation, room(), (6.0, 4.0, 0.0))
    contacts = []
    for _ in range(60):
        result = simulation.step(0.6, 0.0, 7)
        contacts.append(result.in_contact)
    onset = contacts.index(True)
    # From 6 m, a flat side ahead, the wall at 8 m is 1.769 m away: 0.12 m while accelerating for 20 motor
    # steps, then 0.012 m a motor step: 158 of them, so contact in agent step 22.
    assert onset == 22
    assert all(contacts[onset:])  # leaning on a wall is one contact
    assert result.pose[0] == pytest.approx(8.0 - APOTHEM_M, abs=3e-3)
    assert abs(result.v_c) < 1e-3


def test_a_touch_by_hand(simulation):
    load(simulation, room(), (6.0, 4.0, 0.0))
    for _ in range(22):
        simulation.step(0.6, 0.0, 7)
        assert simulation.touch is None
    simulation.step(0.6, 0.0, 7)
    touch = simulation.touch
    # The 20 motor steps of speeding up end at 0.126 m, so 1.643 m are left, which 136 steps of 0.012 m and a last one
    # of 0.011 m take; it drove at full speed in that one, too. The step after it, 157 from 0, finds the contact.
    assert touch.motor_step == 157 - 22 * 7
    assert touch.pose == pytest.approx((8.0 - APOTHEM_M, 4.0, 0.0), abs=1e-3)
    assert (touch.v, touch.omega, touch.mover) == (pytest.approx(0.6, abs=1e-12), 0.0, None)
    assert touch.x == pytest.approx(8.0, abs=1e-9)
    assert abs(touch.y - 4.0) <= 0.25 * math.sin(math.pi / 8.0) + 1e-9  # on the flat side
    load(simulation, room(), (6.0, 4.0, 0.0))
    assert simulation.touch is None


def onsets(simulation, commands, motor_steps=7):
    """Drive; return in how many steps a contact began, and whether the last step was in contact."""
    touching, begun = False, 0
    for v, omega in commands:
        before, touching = touching, simulation.step(v, omega, motor_steps).in_contact
        begun += touching and not before
    return begun, touching


def test_contact_ends_some_time_after_the_robot_has_backed_off(simulation):
    load(simulation, room(), (7.5, 4.0, 0.0))
    for _ in range(30):
        simulation.step(0.6, 0.0, 7)
    # While it speeds up it backs off 0.02 * (0.03 + 0.06 + .. + 0.18 + 0.2) = 0.0166 m, less than the 0.019 m by which
    # its corners stick out beyond its flat side. From the second step on they are more than 0.005 m from the wall,
    # and three such steps are 0.42 s.
    results = [simulation.step(-0.2, 0.0, 7) for _ in range(6)]
    assert [result.in_contact for result in results] == [True, True, True, False, False, False]
    assert results[-1].v_c == pytest.approx(-0.2, abs=1e-9)


@pytest.mark.parametrize("motor_steps", [6, 8])
@pytest.mark.parametrize("omega", [1.5, -0.8, 0.27])
@pytest.mark.parametrize("gap_m", [0.0, 0.0015])
def test_turning_on_the_spot_beside_a_wall_is_one_contact(simulation, gap_m, omega, motor_steps):
    load(simulation, room(), (8.0 - APOTHEM_M - gap_m, 4.0, 0.0))
    assert onsets(simulation, [(0.0, omega)] * 300, motor_steps) == (1, True)


def test_turning_on_the_spot_beside_a_cylinder_is_one_contact(simulation):
    load(simulation, room(cylinders=[Cylinder(4.0, 4.0, 0.3, True)]), (4.0 + 0.3 + APOTHEM_M + 1e-3, 4.0, 0.0))
    assert onsets(simulation, [(0.0, 1.2)] * 200) == (1, True)


def test_sliding_along_a_wall_is_one_contact(simulation):
    load(simulation, room(), (7.5, 1.0, math.radians(60.0)))
    # It turns a little to and fro, and so away from the wall and back.
    swaying = [(0.6, 0.4 * math.sin(step)) for step in range(60)]
    assert onsets(simulation, swaying) == (1, True)


def test_leaving_a_wall_and_coming_back_is_two_contacts(simulation):
    load(simulation, room(), (7.5, 4.0, 0.0))
    push, leave = [(0.6, 0.0)] * 15, [(-0.2, 0.0)] * 8
    assert onsets(simulation, push + leave) == (1, False)
    assert onsets(simulation, push) == (1, True)


def test_twitching_at_a_wall_is_one_contact(simulation):
    load(simulation, room(), (7.5, 4.0, 0.0))
    twitching = [(0.6, 0.0)] * 15 + [(-0.2, 0.0), (0.6, 0.5), (0.6, -0.5)] * 20
    assert onsets(simulation, twitching) == (1, True)


def test_a_load_begins_without_contact(simulation):
    load(simulation, room(), (8.0 - APOTHEM_M, 4.0, 0.0))
    assert simulation.step(0.6, 0.0, 7).in_contact
    load(simulation, room(), (7.7, 4.0, 0.0))
    assert not simulation.step(0.0, 0.0, 7).in_contact


def test_no_contact_while_there_is_a_gap(simulation):
    load(simulation, room(), (8.0 - APOTHEM_M - 0.01, 4.0, 0.0))
    assert not simulation.step(0.0, 0.0, 8).in_contact
    assert simulation.scan().min() == pytest.approx(APOTHEM_M + 0.01, abs=1e-6)


@pytest.mark.parametrize("yaw", [0.0, math.pi / 8.0])  # a flat side or a corner ahead
def test_cylinder_stops_the_robot(simulation, yaw):
    cylinder = Cylinder(2.5 + 1.5 * math.cos(yaw), 4.0 + 1.5 * math.sin(yaw), 0.5, True)
    load(simulation, room(cylinders=[cylinder]), (2.5, 4.0, yaw))
    for _ in range(60):
        result = simulation.step(0.6, 0.0, 7)
        x, y, _ = result.pose
        gap = math.hypot(x - cylinder.x, y - cylinder.y) - cylinder.radius
        assert gap > APOTHEM_M - 5e-3
        if result.in_contact:
            break
    assert result.in_contact
    assert gap < 0.25 + 2e-3


def test_pushing_into_a_corner_keeps_the_robot_planar_and_inside(simulation):
    load(simulation, room(), (7.5, 7.5, 0.5))
    rng = stream(0, "test_simulation")
    touched = 0
    for k in range(1000):
        if k % 10 == 0:
            omega = rng.uniform(-1.5, 1.5)
        result = simulation.step(0.6, omega, 7)
        touched += result.in_contact
        (_, _, z), (qx, qy, _, _) = pybullet.getBasePositionAndOrientation(
            simulation._robot, physicsClientId=simulation._client
        )
        assert max(abs(z), abs(qx), abs(qy)) < 1e-6
        assert min(8.0 - result.pose[0], 8.0 - result.pose[1], *result.pose[:2]) > APOTHEM_M - 5e-3
        assert abs(result.v_c) < 0.65
        assert abs(result.omega_c) < 3.0
    assert touched > 300


def test_thin_walls_are_not_passed(simulation):
    posts = tuple(Box(4.0, y, 0.02, 0.5, 0.0, mapped=True) for y in range(9))
    map = replace(room(), boxes=room().boxes + posts)
    for yaw in (0.0, 0.2, math.pi / 8):
        load(simulation, map, (3.0, 4.0, yaw))
        for _ in range(100):
            assert simulation.step(0.6, 0.0, 8).pose[0] < 4.0 - APOTHEM_M + 5e-3


# Scans


def test_scan_sees_what_pybullet_holds(simulation):
    movers = [Mover(0.3, 0.5)]
    load(simulation, room(cylinders=[Cylinder(4.0, 5.0, 0.4, True)], movers=movers), (4.0, 4.0, math.pi / 2 - 0.01))
    for _ in range(20):
        simulation.step(0.0, 0.0, 7)
    assert simulation.scan()[0] == pytest.approx(0.6, abs=1e-9)
    circles = np.array([[4.0, 5.0, 0.4], [*simulation.mover_positions[0], simulation.mover_radii[0]]])
    x, y, yaw = simulation.pose
    np.testing.assert_array_equal(simulation.scan(), sector_distances(x, y, yaw, room().segments(), circles))


# Determinism


def rollout(simulation, index, steps=300):
    map = generate_map(MapSettings(), "train", seed=3, index=index)
    planner = Planner(map)
    rng = stream(3, "test_simulation", index)
    x, y = planner.sample_free(rng)
    simulation.load(map, planner, (float(x), float(y), 0.3), stream(3, "movers", index))
    rows = []
    for k in range(steps):
        if k % 10 == 0:
            v, omega = rng.uniform((-0.2, -1.5), (0.6, 1.5))
        pose, *rest = simulation.step(v, omega, 7)
        rows.append([*pose, *rest, *simulation.mover_positions.ravel(), *simulation.scan()])
    return np.array(rows)


def test_equal_loads_and_steps_give_equal_bits_whatever_came_before():
    fresh = Simulation()
    expected = rollout(fresh, 0)
    assert expected[:, 5].any()  # the rollout meets obstacles
    used = Simulation()  # beside the first one, which stays open
    rollout(used, 1, steps=100)
    rollout(used, 2, steps=50)
    assert rollout(used, 0).tobytes() == expected.tobytes()
    assert rollout(fresh, 0).tobytes() == expected.tobytes()
    fresh.close()
    used.close()


def test_clients_do_not_disturb_each_other(simulation):
    load(simulation, room(), (6.0, 4.0, 0.0))
    other = Simulation()
    load(other, room(), (1.0, 1.0, 0.0))  # its reset must not empty the first client's world
    other.close()
    for _ in range(60):
        result = simulation.step(0.6, 0.0, 7)
    assert result.in_contact
    assert result.pose[0] == pytest.approx(8.0 - APOTHEM_M, abs=3e-3)


def test_close_twice_is_harmless():
    simulation = Simulation()
    simulation.close()
    simulation.close()


@pytest.mark.slow
def test_two_thousand_loads_keep_the_memory_flat(simulation):
    def resident_mib():
        with open("/proc/self/statm") as file:
            return int(file.read().split()[1]) * os.sysconf("SC_PAGE_SIZE") / 2**20

    maps = [generate_map(MapSettings(), "train", seed=0, index=index) for index in range(10)]
    worlds = [(map, Planner(map)) for map in maps]

    def load_all(first, last):
        for k in range(first, last):
            map, planner = worlds[k % len(worlds)]
            x, y = planner.sample_free(stream(0, "start", k))
            simulation.load(map, planner, (float(x), float(y), 0.0), stream(0, "movers", k))
            simulation.step(0.6, 0.0, 7)
            simulation.scan()

    load_all(0, 200)
    before = resident_mib()
    load_all(200, 2200)
    assert resident_mib() - before < 5.0


# The robot among movers


def test_robot_and_movers_in_a_small_room_neither_tunnel_nor_explode(simulation):
    map = room(4.0, cylinders=[Cylinder(2.0, 2.0, 0.3, True)], movers=[Mover(0.3, 0.6)] * 3)
    planner = Planner(map)
    touched = 0
    for episode in range(3):
        simulation.load(map, planner, (0.6, 0.6, 0.5), stream(1, "movers", episode))
        rng = stream(1, "test_simulation_push", episode)
        for k in range(1500):
            if k % 20 == 0:
                v, omega = rng.uniform((-0.2, -1.5), (0.6, 1.5))
            x0, y0, _ = simulation.pose
            result = simulation.step(v, omega, 1)
            x, y, _ = result.pose
            touched += result.in_contact
            assert abs(result.v_c) < 0.7
            assert abs(result.omega_c) < 4.0
            assert math.hypot(x - x0, y - y0) < 0.7 * MOTOR_PERIOD_S
            assert min(x, y, 4.0 - x, 4.0 - y) > APOTHEM_M - 0.01
            gaps = np.hypot(*(simulation.mover_positions - (x, y)).T) - simulation.mover_radii
            assert gaps.min() > APOTHEM_M - 0.01
    assert touched > 300


def test_driving_into_a_waiting_mover_is_a_contact(simulation):
    map = room(movers=[Mover(0.3, 0.6)])
    corners = np.array([[1.0, 1.0], [7.0, 1.0]])

    class OneTour:
        def sample_mover_point(self, rng):
            return corners[0]

        def mover_path(self, start_xy, goal_xy):
            return corners

    simulation.load(map, OneTour(), (4.0, 1.0, 0.0), stream(0, "movers"))
    gap = np.inf
    for _ in range(400):  # until it stands before the robot
        assert not simulation.step(0.0, 0.0, 1).in_contact
        gap = float(np.hypot(*(simulation.mover_positions[0] - simulation.pose[:2]))) - 0.55
        if gap < STOP_GAP_M + 0.02:
            break
    assert gap < STOP_GAP_M + 0.02
    side = math.copysign(1.0, simulation.mover_positions[0][0] - 4.0)
    for _ in range(12):
        if simulation.step(0.6 if side > 0 else -0.2, 0.0, 7).in_contact:
            break
    touch = simulation.touch
    assert touch.mover == 0
    assert math.hypot(*(simulation.mover_positions[0] - (touch.x, touch.y))) == pytest.approx(0.3, abs=1e-5)
    assert touch.v == pytest.approx(0.6 if side > 0 else -0.2, abs=0.3)
    assert math.copysign(1.0, touch.v) == side


def test_map_without_movers(simulation):
    load(simulation, room(), (4.0, 4.0, 0.0))
    assert simulation.mover_positions.shape == (0, 2)
    assert simulation.mover_radii.shape == (0,)


@pytest.mark.parametrize("num_movers", [1, 12])
def test_what_is_not_asked_and_not_repeated_changes_nothing(simulation, monkeypatch, num_movers):
    """Movers that walk ahead, contacts and velocities that are taken as known: the bits are those of the long way."""

    def drive(slack_m):
        monkeypatch.setattr(world_simulation, "_SLACK_M", slack_m)
        settings = MapSettings(size_m=12.0, clutter_per_m2=0.15, num_movers=num_movers, mover_speed_m_per_s=(0.2, 1.5))
        map = generate_map(settings, "train", seed=2, index=num_movers)
        planner, rng = Planner(map), stream(2, "drive")
        load(simulation, map, (*planner.sample_free(rng).tolist(), 0.0))
        seen = []
        for _ in range(400):
            result = simulation.step(rng.uniform(-0.2, 0.6), rng.uniform(-1.5, 1.5), int(rng.integers(1, 9)))
            seen.append((result, simulation.mover_positions.tolist(), simulation.scan().tolist()))
        return seen

    short, long = drive(world_simulation._SLACK_M), drive(math.inf)
    assert short == long
    contacts = sum(result.in_contact for result, _, _ in short)
    assert 0 < contacts < 400, "both ways were taken"


def test_of_a_large_map_only_what_is_near_exists_and_nothing_else_changes(monkeypatch: pytest.MonkeyPatch) -> None:
    map_ = generate_map(MapSettings(size_m=40.0, clutter_per_m2=0.5, num_movers=3), "train", seed=0, index=4)
    # As in maps of files: neighbours follow each other, and become one body.
    map_ = replace(map_, boxes=tuple(sorted(map_.boxes, key=lambda box: (box.y // 4.0, box.x // 4.0))))
    planner = Planner(map_)
    assert len(map_.boxes) + len(map_.cylinders) > 300
    rng = stream(0, "bumping")
    starts = [planner.sample_free(rng).tolist() for _ in range(6)]
    commands = rng.uniform((0.2, -0.6), (0.6, 0.6), (150, 2))

    def driven(most_whole: int) -> tuple[list[tuple], int, list[int]]:
        monkeypatch.setattr(bodies, "MAX_WHOLE_SHAPES", most_whole)
        simulation, contacts = Simulation(), 0
        found: list[tuple] = []
        existing: list[int] = []
        for x, y in starts:
            simulation.load(map_, planner, (x, y, 1.0), stream(0, "movers"))
            for v, omega in commands:
                result = simulation.step(float(v), float(omega), 7)
                found.append((*result, *simulation.scan().tolist()))
                contacts += result.in_contact
                existing.append(pybullet.getNumBodies(simulation._client))
        simulation.close()
        return found, contacts, existing

    whole, contacts, all_bodies = driven(10_000)
    near, _, few_bodies = driven(10)
    assert contacts > 50
    assert near == whole
    assert max(few_bodies) < 0.7 * min(all_bodies)
    assert len(set(few_bodies)) > 3  # they came and went


def test_who_comes_back_to_a_part_of_a_large_map_meets_the_shapes_that_stood_there(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """PyBullet keeps the shapes of bodies that are gone: made anew at every return they would fill the memory."""
    places = np.arange(2.0, 23.0, 2.0).tolist()
    map_ = room(24.0, cylinders=[Cylinder(x, y, 0.4, mapped=True) for x in places for y in places])
    planner = Planner(map_)
    make = pybullet.createCollisionShapeArray
    made: list[tuple] = []

    def noted(**given):
        made.append(tuple(given["collisionFramePositions"]))
        return make(**given)

    monkeypatch.setattr(pybullet, "createCollisionShapeArray", noted)

    def driven(most_whole: int) -> tuple[list[tuple], int]:
        monkeypatch.setattr(bodies, "MAX_WHOLE_SHAPES", most_whole)
        made.clear()
        simulation, contacts = Simulation(), 0
        found: list[tuple] = []
        simulation.load(map_, planner, (3.0, 3.0, 0.7), stream(0, "movers"))
        for x in [21.0, 3.0] * 4:
            simulation.place((x, 3.0, 0.7))
            for _ in range(20):
                result = simulation.step(0.6, 0.1, 7)
                found.append((*result, *simulation.scan().tolist()))
                contacts += result.in_contact
        simulation.close()
        return found, contacts

    whole, contacts = driven(10_000)
    groups = sorted(made)
    near, _ = driven(10)
    assert contacts > 50
    assert near == whole
    assert sorted(made) == sorted(set(made))
    assert set(made) < set(groups)


# What somebody does to the world while it runs


def test_a_disc_that_is_put_is_sensed_and_touched_and_moved_and_forgotten_with_the_next_load(simulation):
    load(simulation, room(movers=[Mover(0.25, 0.3)]), (3.0, 4.0, 0.0))
    movers = simulation.mover_positions
    assert simulation.put_disc(5.0, 4.0, 0.3) == 0
    assert simulation.put_disc(3.0, 6.0, 0.2) == 1
    assert simulation.scan()[0] == pytest.approx(5.0 - 3.0 - 0.3)
    assert simulation.room_at(3.0, 5.0, 2.0) == pytest.approx(0.8)
    assert simulation.put_discs.tolist() == [[5.0, 4.0, 0.3], [3.0, 6.0, 0.2]]
    assert np.array_equal(simulation.mover_positions, movers)  # they are other rows
    results = [simulation.step(0.6, 0.0, 7) for _ in range(40)]
    assert results[-1].in_contact
    # Its flat side meets the disc.
    assert simulation.pose[0] == pytest.approx(5.0 - 0.3 - APOTHEM_M, abs=2e-3)
    simulation.move_disc(0, 5.5, 4.0)
    assert simulation.scan()[0] == pytest.approx(5.5 - simulation.pose[0] - 0.3)
    for _ in range(40):
        simulation.step(0.6, 0.0, 7)
    assert simulation.pose[0] == pytest.approx(5.5 - 0.3 - APOTHEM_M, abs=2e-3)
    load(simulation, room(), (3.0, 4.0, 0.0))
    assert not len(simulation.put_discs)
    assert simulation.scan()[0] == math.inf


def test_movers_walk_where_they_would_whatever_is_put(simulation):
    walks = []
    for put in (False, True):
        load(simulation, room(movers=[Mover(0.25, 0.5), Mover(0.2, 0.6)]), (1.0, 1.0, 0.0))
        if put:
            simulation.put_disc(4.0, 4.0, 0.3)
        for _ in range(50):
            simulation.step(0.0, 0.0, 7)
        walks.append(simulation.mover_positions)
    assert np.array_equal(*walks)


def test_a_robot_that_is_placed_stands_there_at_rest_and_without_contact(simulation):
    load(simulation, room(), (7.0, 4.0, 0.0))
    for _ in range(20):
        simulation.step(0.6, 0.0, 7)
    assert simulation.step(0.6, 0.0, 7).in_contact
    simulation.place((2.0, 3.0, 4.0))
    assert simulation.pose == pytest.approx((2.0, 3.0, 4.0 - 2.0 * math.pi))
    result = simulation.step(0.6, 0.0, 7)
    assert not result.in_contact
    assert result.v_c == pytest.approx(0.21, abs=1e-12)
    driven = 0.0168
    assert result.pose[:2] == pytest.approx((2.0 + driven * math.cos(4.0), 3.0 + driven * math.sin(4.0)), abs=1e-9)
