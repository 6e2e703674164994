"""The range sensor: closed forms, invariances, and two independent ways to measure the same scene."""

import math
from dataclasses import replace

import numpy as np
import pybullet
import pytest

from rcdsac_trl.errors import UserInputError
from rcdsac_trl.robot.range_sensor import MAX_RANGE_M, NUM_BINS, SENSORS, sensor_mask
from rcdsac_trl.seeding import stream
from rcdsac_trl.world.maps.generator import MapSettings, generate_map
from rcdsac_trl.world.maps.planner import Planner
from rcdsac_trl.world.sim.lidar import NearSegments, sector_distances
from rcdsac_trl.world.sim.simulation import Simulation

NO_SEGMENTS = np.empty((0, 4))
NO_CIRCLES = np.empty((0, 3))
DEG = math.pi / 180.0


def scan_segments(*rows, pose=(0.0, 0.0, 0.0)):
    return sector_distances(*pose, np.array(rows, dtype=np.float64), NO_CIRCLES)


def scan_circles(*rows, pose=(0.0, 0.0, 0.0)):
    return sector_distances(*pose, NO_SEGMENTS, np.array(rows, dtype=np.float64))


def seen(distances):
    return np.flatnonzero(np.isfinite(distances)).tolist()


# Sensors


@pytest.mark.parametrize(("name", "bins"), [("narrow", 43), ("sparse", 18), ("full", 180)])
def test_sensor_has_this_many_bins(name, bins):
    mask = sensor_mask(name)
    assert mask.shape == (NUM_BINS,)
    assert mask.dtype == np.bool_
    assert mask.sum() == bins


def test_sensor_bins_count_from_one():
    assert np.flatnonzero(~sensor_mask("narrow")).tolist() == list(range(21, 158))  # i = 22..158
    assert np.flatnonzero(sensor_mask("sparse")).tolist() == list(range(9, 180, 10))  # i = 10, 20, ..., 180
    assert {"narrow", "sparse", "full"} == SENSORS


def test_unknown_sensor_is_refused():
    with pytest.raises(UserInputError, match=r"wide.*full, narrow, sparse"):
        sensor_mask("wide")


# Closed forms


def test_nothing_in_sight():
    assert np.isinf(sector_distances(0.0, 0.0, 0.0, NO_SEGMENTS, NO_CIRCLES)).all()


def test_long_wall_ahead():
    distances = scan_segments([2.0, -50.0, 2.0, 50.0])
    expected = np.full(NUM_BINS, np.inf)
    for k in range(25):  # the wall is 2 / cos(48 deg) = 2.989 m away where bin 24 begins, 3.11 m at 50 deg
        expected[k] = expected[NUM_BINS - 1 - k] = 2.0 / math.cos(2.0 * k * DEG)
    np.testing.assert_allclose(distances, expected, rtol=1e-12)


def test_small_circle_in_the_middle_of_a_sector():
    distances = scan_circles([2.0 * math.cos(DEG), 2.0 * math.sin(DEG), 0.01])
    assert seen(distances) == [0]
    assert distances[0] == pytest.approx(1.99, rel=1e-12)


def test_circle_reaches_into_neighbouring_sectors():
    # Half as wide as asin(0.1 / 2) = 2.87 deg about 1 deg: sectors 179, 0 and 1. In both neighbours the
    # nearest direction is 1 deg off the centre.
    distances = scan_circles([2.0 * math.cos(DEG), 2.0 * math.sin(DEG), 0.1])
    beside = 2.0 * math.cos(DEG) - math.sqrt(0.1**2 - (2.0 * math.sin(DEG)) ** 2)
    assert seen(distances) == [0, 1, 179]
    np.testing.assert_allclose(distances[[0, 1, 179]], [1.9, beside, beside], rtol=1e-12)


@pytest.mark.parametrize(("factor", "bins"), [(1.0 - 1e-9, [5]), (1.0 + 1e-9, [4, 5, 6])])
def test_circle_tangent_to_the_borders(factor, bins):
    angle, radius = 11.0 * DEG, 2.0 * math.sin(DEG) * factor
    distances = scan_circles([2.0 * math.cos(angle), 2.0 * math.sin(angle), radius])
    assert seen(distances) == bins
    for neighbour in set(bins) - {5}:  # the tangent's length
        assert distances[neighbour] == pytest.approx(2.0 * math.cos(DEG), rel=1e-4)


def test_segment_across_the_positive_x_axis():
    distances = scan_segments([1.0, -0.01, 1.0, 0.01])
    assert seen(distances) == [0, 179]
    assert distances[0] == distances[179] == 1.0


def test_segment_across_the_negative_x_axis():
    distances = scan_segments([-1.0, -0.01, -1.0, 0.01])  # 180 deg begins bin 90
    assert seen(distances) == [89, 90]
    np.testing.assert_allclose(distances[[89, 90]], 1.0, rtol=1e-12)


def test_direction_of_a_border_belongs_to_the_upper_sector():
    assert seen(scan_segments([1.0, 0.0, 1.0, 0.01])) == [0]


def test_segment_that_recedes_on_both_sides():
    # The wall x + y = 2 is nearest at 45 deg (bin 22, [44, 46)), at distance sqrt(2).
    distances = scan_segments([2.0, 0.0, 0.0, 2.0])
    assert seen(distances) == list(range(46))
    assert distances[22] == pytest.approx(math.sqrt(2.0), rel=1e-12)
    assert distances[10] == pytest.approx(math.sqrt(2.0) / math.cos((45 - 22) * DEG), rel=1e-12)
    assert distances[30] == pytest.approx(math.sqrt(2.0) / math.cos((60 - 45) * DEG), rel=1e-12)
    assert distances[45] == pytest.approx(2.0, rel=1e-12)  # 90 deg, the end, lies in [90, 92)


def test_segment_seen_end_on():
    direction = np.array([math.cos(33 * DEG), math.sin(33 * DEG)])
    distances = scan_segments([*(2.0 * direction), *(0.7 * direction)])
    assert seen(distances) == [16]
    assert distances[16] == pytest.approx(0.7, rel=1e-12)


def test_nearest_obstacle_of_a_sector_wins():
    distances = sector_distances(
        0.0, 0.0, 0.0, np.array([[1.0, -1.0, 1.0, 1.0]]), np.array([[0.6, 0.0, 0.1], [2.0, 0.0, 0.5]])
    )
    assert distances[0] == pytest.approx(0.5, rel=1e-12)
    assert distances[10] == pytest.approx(1.0 / math.cos(20 * DEG), rel=1e-12)


def test_range_ends_before_three_metres():
    assert seen(scan_segments([3.0, -1.0, 3.0, 1.0])) == []
    assert seen(scan_segments([2.999, -0.01, 2.999, 0.01])) == [0, 179]
    assert seen(scan_circles([3.5, 0.0, 0.5])) == []


def test_inside_a_disc_everything_is_at_distance_zero():
    assert (scan_circles([0.1, 0.0, 0.5]) == 0.0).all()


def test_robot_yaw_turns_the_sectors():
    straight_left = [0.0, 2.0, 0.01]
    assert seen(scan_circles(straight_left, pose=(0.0, 0.0, 89 * DEG))) == [0]
    assert seen(scan_circles(straight_left, pose=(0.0, 0.0, -89 * DEG))) == [89]
    assert seen(scan_circles(straight_left, pose=(0.0, 0.0, 91 * DEG))) == [179]


def random_scene(index):
    rng = stream(0, "test_lidar", index)
    centres, half = rng.uniform(-3.0, 3.0, (12, 2)), rng.uniform(-1.5, 1.5, (12, 2))
    circles = np.column_stack([rng.uniform(-3.0, 3.0, (5, 2)), rng.uniform(0.1, 0.4, 5)])
    circles = circles[np.hypot(circles[:, 0], circles[:, 1]) > circles[:, 2]]
    return rng, np.column_stack([centres - half, centres + half]), circles


def test_moving_scene_and_robot_together_changes_nothing():
    for index in range(50):
        rng, segments, circles = random_scene(index)
        x, y, yaw = rng.uniform(-5.0, 5.0, 3)
        turn = np.array([[math.cos(yaw), math.sin(yaw)], [-math.sin(yaw), math.cos(yaw)]])
        moved_segments = (segments.reshape(-1, 2) @ turn + (x, y)).reshape(-1, 4)
        moved_circles = np.column_stack([circles[:, :2] @ turn + (x, y), circles[:, 2]])
        here = sector_distances(0.0, 0.0, 0.0, segments, circles)
        there = sector_distances(x, y, yaw, moved_segments, moved_circles)
        # Nearly end-on pieces are ill-conditioned: rounding moves the distance, never by much.
        np.testing.assert_allclose(there, here, atol=1e-9)


def test_agrees_with_points_sampled_on_the_obstacles():
    for index in range(30):
        _, segments, circles = random_scene(index)
        share = np.linspace(0.0, 1.0, 20_001)[:, None, None]
        on_segments = segments[:, :2] * (1.0 - share) + segments[:, 2:] * share
        angle = 2.0 * np.pi * share
        rim = np.concatenate([np.cos(angle), np.sin(angle)], axis=2)
        points = [on_segments.reshape(-1, 2), (circles[:, :2] + circles[:, 2:] * rim).reshape(-1, 2)]
        x, y = np.concatenate(points).T
        bins = (np.remainder(np.arctan2(y, x), 2.0 * np.pi) / (2.0 * DEG)).astype(int) % NUM_BINS
        sampled = np.full(NUM_BINS, np.inf)
        np.minimum.at(sampled, bins, np.hypot(x, y))
        exact = sector_distances(0.0, 0.0, 0.0, segments, circles)
        in_range = sampled < MAX_RANGE_M
        assert (exact[in_range] <= sampled[in_range] + 1e-9).all()
        assert (sampled[in_range] - exact[in_range] < 0.02).all()  # end-on pieces: steps of 0.2 mm fan out
        # What no sample shows can only be a sliver of an obstacle between two samples.
        assert np.isfinite(exact[~in_range]).sum() <= 3


# Against PyBullet's rays


def min_over_rays(client, pose, rays_per_bin, start_m=0.26):
    """Minimum over evenly spread rays of each sector; they begin outside the robot."""
    x, y, yaw = pose
    angles = yaw + (np.arange(NUM_BINS * rays_per_bin) + 0.5) * 2.0 * DEG / rays_per_bin
    directions = np.column_stack([np.cos(angles), np.sin(angles), np.zeros_like(angles)])
    origin = np.array([x, y, 0.0])
    lengths = []
    for part in np.array_split(directions, 4):  # PyBullet takes at most 16,384 rays at once
        hits = pybullet.rayTestBatch(
            (origin + start_m * part).tolist(), (origin + MAX_RANGE_M * part).tolist(), physicsClientId=client
        )
        lengths += [start_m + hit[2] * (MAX_RANGE_M - start_m) if hit[0] >= 0 else np.inf for hit in hits]
    return np.array(lengths).reshape(NUM_BINS, rays_per_bin).min(axis=1)


def grown(map, by_m):
    boxes = (replace(box, half_x=box.half_x + by_m, half_y=box.half_y + by_m) for box in map.boxes)
    cylinders = (replace(cylinder, radius=cylinder.radius + by_m) for cylinder in map.cylinders)
    return replace(map, boxes=tuple(boxes), cylinders=tuple(cylinders), movers=())


def test_dense_rays_converge_to_the_exact_minimum():
    simulation = Simulation()
    excess = {4: [], 64: []}
    for index in range(3):
        map = replace(generate_map(MapSettings(), "train", seed=0, index=index), movers=())
        planner = Planner(map)
        # PyBullet's rays stop up to about 1 mm before a surface, and hit what they pass by that closely.
        nearer = grown(map, 1.5e-3)
        rng = stream(0, "test_lidar_rays", index)
        for _ in range(4):
            x, y = planner.sample_free(rng)
            pose = (float(x), float(y), float(rng.uniform(-math.pi, math.pi)))
            simulation.load(map, planner, pose, rng)
            exact = simulation.scan()
            lower = sector_distances(*pose, nearer.segments(), nearer.circles())
            for density, found in excess.items():
                rays = min_over_rays(simulation._client, pose, density)
                assert (rays >= lower).all()
                found.append(np.minimum(rays, MAX_RANGE_M) - np.minimum(exact, MAX_RANGE_M))
    simulation.close()
    sparse, dense = (np.concatenate(excess[density]) for density in (4, 64))
    assert dense.mean() < 0.3 * sparse.mean()
    assert dense.mean() < 2e-3
    assert np.quantile(dense, 0.99) < 0.03


def test_the_near_segments_of_a_place_give_the_scan_of_all_of_them_bit_for_bit() -> None:
    map_ = generate_map(MapSettings(size_m=30.0), "train", seed=0, index=2)
    segments, circles = map_.segments(), map_.circles()
    index = NearSegments(segments)
    rng = stream(0, "places")
    for x, y, yaw in rng.uniform((-1.0, -1.0, -math.pi), (31.0, 31.0, math.pi), (300, 3)):
        near = index.near(x, y)
        np.testing.assert_array_equal(
            sector_distances(x, y, yaw, near, circles), sector_distances(x, y, yaw, segments, circles)
        )
        assert len(near) < 0.7 * len(segments)
    # A segment that begins exactly at the range is out of it; a hair nearer it is not, from the square's far corner.
    wall = np.array([[5.0, 0.0, 5.0, 1.0]])
    assert len(NearSegments(wall).near(1.99, 0.5)) == 1
    assert len(NearSegments(wall).near(-0.01, 0.5)) == 0
