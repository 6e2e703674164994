"""Movers: bounded motion on their tours, clearance, and manners towards the robot and each other."""

import math

import numpy as np
import pytest

from rcdsac_trl.robot.limits import MOTOR_PERIOD_S
from rcdsac_trl.seeding import stream
from rcdsac_trl.world.maps.generator import Map, MapSettings, Mover, generate_map
from rcdsac_trl.world.maps.planner import Planner
from rcdsac_trl.world.sim.lidar import sector_distances
from rcdsac_trl.world.sim.movers import CORNER_CUT_M, START_GAP_M, Movers, make_tour
from rcdsac_trl.world.sim.walk import PATIENCE_S, STOP_GAP_M


def walk(movers, seconds, robot=(1e3, 1e3)):
    positions = [movers.positions.copy()]
    for _ in range(round(seconds / MOTOR_PERIOD_S)):
        movers.step(*robot)
        positions.append(movers.positions.copy())
    return np.array(positions)


def test_tour_round_a_square_by_hand():
    tour = make_tour(np.array([[0.0, 0.0], [4.0, 0.0], [4.0, 4.0], [0.0, 4.0]]), MOTOR_PERIOD_S)
    radius = CORNER_CUT_M / (math.sqrt(2.0) - 1.0)
    assert len(tour) == 8
    assert tour[-1, 1] == pytest.approx(16.0 - 4.0 * radius * (2.0 - math.pi / 2.0))
    np.testing.assert_allclose(tour[::2, 5], 1.0 / radius)  # all corners turn left
    np.testing.assert_allclose(tour[1:, 0], tour[:-1, 1])


def mover_on(corners, top_speed=0.6, radius=0.3, seed=0):
    class OneTour:
        def sample_mover_point(self, rng):
            return corners[0]

        def mover_path(self, start_xy, goal_xy):
            return corners

    map = Map("clutter", 8.0, (), (), (Mover(radius, top_speed),))
    return Movers(map, OneTour(), (1e3, 1e3), stream(seed, "movers"), MOTOR_PERIOD_S)


@pytest.mark.parametrize(
    "corners",
    [
        [[0.0, 0.0], [4.0, 0.0], [4.0, 4.0], [0.0, 4.0]],
        [[0.0, 0.0], [5.0, 0.0]],  # there and back: two half turns
        [[0.0, 0.0], [3.0, 0.1], [0.2, 0.3], [0.25, 2.0], [0.3, 0.5]],
    ],
)
def test_speed_and_acceleration_stay_bounded(corners):
    positions = walk(mover_on(np.array(corners)), 60.0)[:, 0]
    velocities = np.diff(positions, axis=0) / MOTOR_PERIOD_S
    speeds = np.hypot(*velocities.T)
    assert speeds.max() <= 0.6 + 1e-9
    assert speeds.max() > 0.55
    assert speeds.mean() > 0.3
    assert np.hypot(*np.diff(velocities, axis=0).T).max() / MOTOR_PERIOD_S <= 1.0


@pytest.fixture(scope="module")
def walked():
    """Five minutes of the movers of some generated maps, nobody else about."""
    worlds = []
    for index in range(3):
        map = generate_map(MapSettings(), "train", seed=5, index=index)
        planner = Planner(map)
        robot = tuple(planner.sample_free(stream(5, "start", index)).tolist())
        movers = Movers(map, planner, robot, stream(5, "movers", index), MOTOR_PERIOD_S)
        worlds.append((map, robot, movers.radii, walk(movers, 300.0)))
    return worlds


def test_movers_start_away_from_the_robot(walked):
    for _, robot, radii, positions in walked:
        assert (np.hypot(*(positions[0] - robot).T) >= radii + 0.25 + START_GAP_M).all()


def test_movers_walk_and_never_enter_an_obstacle(walked):
    for map, _, radii, positions in walked:
        segments, circles = map.segments(), map.circles()
        for mover, radius in enumerate(radii):
            track = positions[::10, mover]
            assert np.hypot(*np.diff(track, axis=0).T).sum() > 0.3 * 300.0 * map.movers[mover].speed_m_per_s
            near = [sector_distances(x, y, 0.0, segments, circles).min() for x, y in track]
            assert min(near) >= radius


def test_movers_keep_their_bounds_on_generated_maps(walked):
    for map, _, _, positions in walked:
        velocities = np.diff(positions, axis=0) / MOTOR_PERIOD_S
        top = np.array([mover.speed_m_per_s for mover in map.movers])
        assert (np.hypot(velocities[..., 0], velocities[..., 1]) <= top + 1e-9).all()
        accelerations = np.diff(velocities, axis=0) / MOTOR_PERIOD_S
        assert np.hypot(accelerations[..., 0], accelerations[..., 1]).max() <= 1.0


def test_movers_pass_each_other_without_overlap(walked):
    for _, _, radii, positions in walked:
        for a in range(len(radii)):
            for b in range(a):
                gap = np.hypot(*(positions[:, a] - positions[:, b]).T) - radii[a] - radii[b]
                assert gap.min() > -0.05


def test_mover_waits_for_the_robot_and_then_turns_back():
    corners = np.array([[0.0, 0.0], [8.0, 0.0], [8.0, 8.0], [0.0, 8.0]])
    robot = (4.0, 0.0)
    positions = walk(mover_on(corners), 120.0, robot)[:, 0]
    gap = np.hypot(*(positions - robot).T) - 0.3 - 0.25
    assert gap.min() == pytest.approx(STOP_GAP_M, abs=0.02)
    standing = np.hypot(*np.diff(positions, axis=0).T) == 0.0
    first = int(standing.argmax())
    steps = round(PATIENCE_S / MOTOR_PERIOD_S)
    assert standing[first : first + steps].all()
    assert not standing[first + steps + 2]
    # It comes from both sides, since the tour is closed.
    beside = positions[np.abs(positions[:, 1]) < 0.01, 0]
    assert beside.min() < 3.5
    assert beside.max() > 4.5


def test_mover_stops_at_once_when_the_robot_runs_into_its_front():
    movers = mover_on(np.array([[0.0, 0.0], [50.0, 0.0], [50.0, 50.0]]))
    walk(movers, 3.0)
    before = movers.positions[0].copy()
    movers.step(*before)  # whichever way it walks ...
    ahead = movers.positions[0] + 0.5 * (movers.positions[0] - before) / np.hypot(*(movers.positions[0] - before))
    stopped = movers.positions[0].copy()
    movers.step(*ahead)
    assert (movers.positions[0] == stopped).all()


def test_many_periods_at_once_are_the_same_walk():
    corners = np.array([[0.0, 0.0], [4.0, 0.0], [4.0, 4.0], [0.0, 4.0]])
    one, many = mover_on(corners), mover_on(corners)
    walk(one, 7 * MOTOR_PERIOD_S)
    gap = many.step(1e3, 1e3, periods=7)
    assert (one.positions == many.positions).all()
    assert gap == pytest.approx(math.hypot(*(np.array([1e3, 1e3]) - many.positions[0])) - 0.3 - 0.25)


@pytest.mark.parametrize("top_speed", [0.2, 0.6, 2.0])
def test_nobody_is_noticed_beyond_the_notice_gap(top_speed):
    """The robot flees at the notice gap, right in front of the mover: the walk is that of a mover alone."""
    corners = np.array([[0.0, 0.0], [9.0, 0.0], [9.0, 9.0], [0.0, 9.0]])
    alone, watched = mover_on(corners, top_speed), mover_on(corners, top_speed)
    distance = 0.3 + 0.25 + watched.notice_gap_m
    for _ in range(600):
        before = watched.positions[0].copy()
        alone.step(1e3, 1e3)
        ahead = alone.positions[0] - before
        watched.step(*(before + distance * ahead / max(np.hypot(*ahead), 1e-12)))
        assert (watched.positions == alone.positions).all()
