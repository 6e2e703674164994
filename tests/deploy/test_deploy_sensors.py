"""Scans and clouds to sectors: equal to the simulator's own sensor on the same scene, and right about what is lost."""

import math
from functools import partial
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from rcdsac_trl.deploy import CameraPose, CloudFilter, Guard, Mount, Scan, Sectors, cloud_sectors, scan_sectors
from rcdsac_trl.errors import UserInputError
from rcdsac_trl.robot.robot_settings import PAPER
from rcdsac_trl.robot.sectors import bins_of, nearest_by_sector
from rcdsac_trl.seeding import stream
from rcdsac_trl.world.sim.lidar import sector_distances

BIN = math.radians(2.0)
FULL = 2.0 * math.pi
# Rays or points from one to the next: 1/80 of a sector, and half a millimetre.
FINE_RAD, FINE_M = BIN / 80, 0.0005


def scan(ranges: Any, angle_min: float = 0.0, increment: float | None = None, **more: Any) -> Scan:
    increment = FULL / len(ranges) if increment is None else increment
    return Scan(ranges, angle_min, increment, more.pop("range_min", 0.05), more.pop("range_max", 10.0), **more)


# ------------------------------------------------------------------------------------------------ the same scene
Scene = tuple[NDArray[np.float64], NDArray[np.float64]]


def random_scene(seed: int) -> Scene:
    """Make walls, and legs of tables, none nearer than the robot's body."""
    rng = stream(seed, "test scene")
    walls = rng.uniform(-4.0, 4.0, (8, 4))
    legs = np.column_stack([rng.uniform(-3.0, 3.0, (8, 2)), rng.uniform(0.02, 0.3, 8)])
    legs = legs[np.hypot(legs[:, 0], legs[:, 1]) - legs[:, 2] > 0.3]
    return walls[[sector_distances(0.0, 0.0, 0.0, wall[None], np.empty((0, 3))).min() > 0.3 for wall in walls]], legs


def cast(scene: Scene, x: float, y: float, angles: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return where rays first meet the scene, by plain vector algebra, ``inf`` where they do not."""
    walls, legs = scene
    dx, dy = np.cos(angles)[:, None], np.sin(angles)[:, None]
    px, py, ex, ey = walls[:, 0] - x, walls[:, 1] - y, walls[:, 2] - walls[:, 0], walls[:, 3] - walls[:, 1]
    across = dx * ey - dy * ex
    with np.errstate(divide="ignore", invalid="ignore"):
        to_walls = (px * ey - py * ex) / across
        along = (px * dy - py * dx) / across
    to_walls = np.where((to_walls > 0) & (along >= 0) & (along <= 1), to_walls, np.inf)
    cx, cy = legs[:, 0] - x, legs[:, 1] - y
    middle = dx * cx + dy * cy
    under = legs[:, 2] ** 2 - (cx**2 + cy**2 - middle**2)
    to_legs = np.where((under >= 0) & (middle > 0), middle - np.sqrt(np.maximum(under, 0.0)), np.inf)
    return np.concatenate([to_walls, to_legs, np.full((len(angles), 1), np.inf)], axis=1).min(axis=1)


def outline(scene: Scene) -> NDArray[np.float64]:
    """Return points all along the scene's walls and legs, [n, 2]."""
    walls, legs = scene
    points = [np.linspace(wall[:2], wall[2:], int(np.hypot(*(wall[2:] - wall[:2])) / FINE_M) + 2) for wall in walls]
    for x, y, radius in legs:
        angles = np.linspace(0.0, FULL, int(FULL * radius / FINE_M) + 2)
        points.append(np.column_stack([x + radius * np.cos(angles), y + radius * np.sin(angles)]))
    return np.concatenate(points)


def assert_is_the_lidar(found: NDArray[np.float64], scene: Scene, bound_m: float) -> None:
    """Hold a sampled sensor against the exact one: never nearer, and farther only where samples fell between.

    What a sector has within a sample's width of its border, a sample may miss or give to the neighbour: so at most
    the distance that the exact sensor sees a little inside the sector.
    """
    turns = (-2.0 * FINE_RAD, 0.0, 2.0 * FINE_RAD)
    exact = sector_distances(0.0, 0.0, 0.0, *scene)
    turned = [sector_distances(0.0, 0.0, turn, *scene) for turn in turns]
    assert (found >= np.minimum.reduce(turned) - 1e-9).all()
    both = np.isfinite(found) & np.isfinite(exact)
    assert np.count_nonzero(both) > 60
    assert np.mean(np.isfinite(found) == np.isfinite(exact)) > 0.98
    off = found[both] - exact[both]
    assert np.mean(off < bound_m) > 0.97
    assert np.median(np.abs(off)) < bound_m / 10


@pytest.mark.parametrize("seed", range(6))
def test_a_dense_scan_is_the_simulator_s_lidar(seed: int) -> None:
    scene = random_scene(seed)
    angles = -math.pi + FINE_RAD / 2 + FINE_RAD * np.arange(180 * 80)
    sectors = scan_sectors(scan(cast(scene, 0.0, 0.0, angles), angles[0], FINE_RAD))
    assert sectors.covered.all()
    # On a wall seen at 10 degrees, the range changes by 3 m / sin^2 x the increment: 3 cm at most.
    assert_is_the_lidar(sectors.distances_m, scene, 0.03)


@pytest.mark.parametrize("seed", range(6))
def test_a_dense_cloud_is_the_simulator_s_lidar(seed: int) -> None:
    scene = random_scene(seed)
    points = outline(scene)
    heights = stream(seed, "heights").uniform(0.06, 0.99, len(points))
    # Four cameras look four ways; each is posed, and has the points in its own frame.
    clouds = []
    for yaw in np.radians([0.0, 90.0, 180.0, 270.0]):
        pose = CameraPose((0.1, -0.05, 0.4), (0.0, 0.0, math.sin(yaw / 2), math.cos(yaw / 2)), view_rad=FULL)
        world = np.column_stack([points, heights]) - pose.position_m
        clouds.append((world @ pose.rotation, pose))
    sectors = cloud_sectors(clouds)
    assert sectors.covered.all()
    assert_is_the_lidar(sectors.distances_m, scene, 0.01)


def test_a_sensor_off_the_centre_sees_the_same_scene() -> None:
    scene = (np.empty((0, 4)), np.array([[1.5, 0.4, 0.2], [-1.0, 1.0, 0.3], [0.2, -2.0, 0.1]]))
    mount = Mount(x_m=0.15, y_m=-0.05, yaw_rad=0.7, upside_down=True)
    seen_from = np.arange(180 * 80) * FINE_RAD
    ranges = cast(scene, mount.x_m, mount.y_m, mount.yaw_rad - seen_from)
    found = scan_sectors(scan(ranges, 0.0, FINE_RAD, mount=mount)).distances_m
    exact = sector_distances(0.0, 0.0, 0.0, *scene)
    both = np.isfinite(found) & np.isfinite(exact)
    assert np.count_nonzero(both) == np.count_nonzero(np.isfinite(exact)) > 20
    # Legs hide a little of themselves from the one place and show it to the other.
    assert np.abs(found[both] - exact[both]).max() < 0.05


# ------------------------------------------------------------------------------------------------ scans
@pytest.mark.parametrize("angle_min", [-math.pi, 0.0, 1.0, 3.0 * math.pi])
@pytest.mark.parametrize("clockwise", [False, True])
@pytest.mark.parametrize("kind", [np.float32, np.float64])
def test_any_start_and_direction_gives_the_same(angle_min: float, clockwise: bool, kind: type) -> None:
    rays = 720
    increment = -FULL / rays if clockwise else FULL / rays
    angles = angle_min + increment * (np.arange(rays) + 0.5)
    ranges = (1.0 + bins_of(angles) / 180.0).astype(kind)
    found = scan_sectors(scan(ranges, kind(angles[0]), kind(increment)))
    np.testing.assert_allclose(found.distances_m, 1.0 + np.arange(180) / 180.0, atol=1e-6)


def test_borders_in_float32_belong_to_the_sector_they_begin() -> None:
    # One ray a degree from -pi, as drivers send it: every second ray lies on a border.
    ranges = np.repeat(np.arange(180) / 100.0 + 1.0, 2)
    found = scan_sectors(scan(ranges, float(np.float32(-math.pi)), float(np.float32(math.radians(1.0)))))
    assert found.distances_m.round(9).tolist() == np.roll(np.arange(180) / 100.0 + 1.0, 90).round(9).tolist()


@pytest.mark.parametrize(
    ("values", "distance", "covered"),
    [
        ([2.0, 1.0, 2.0, 3.5], 1.0, True),  # the nearest counts; 3.5 m is beyond what agents see
        ([3.5, 3.5, 3.5, 3.5], math.inf, True),
        ([math.inf] * 4, math.inf, True),
        ([20.0] * 4, math.inf, True),  # beyond range_max
        ([-math.inf, 2.0, 2.0, 2.0], 0.3, True),  # nearer than range_min, so at most that
        ([math.nan] * 4, math.inf, False),
        ([0.0] * 4, math.inf, False),
        ([0.1] * 4, math.inf, False),  # below range_min
        ([-1.0] * 4, math.inf, False),
        ([math.nan, math.nan, math.inf, math.inf], math.inf, True),
        ([math.nan, math.nan, math.nan, math.inf], math.inf, False),
        ([math.nan, math.nan, math.nan, 1.5], 1.5, True),  # what is seen is seen
    ],
)
def test_what_a_ray_says(values: list[float], distance: float, covered: bool) -> None:
    ranges = np.full(720, 2.5)
    ranges[4:8] = values
    found = scan_sectors(scan(ranges, FULL / 1440, range_min=0.3))
    assert (found.distances_m[1], found.covered[1]) == (distance, covered)
    assert (np.delete(found.distances_m, 1) == 2.5).all()


def test_docs_robot_says_which_rays_the_sparse_agent_needs() -> None:
    sparse = PAPER.sensor_mask("sparse")
    for angle_min in (-math.pi, 0.0, 0.3, math.radians(1.0)):
        assert scan_sectors(scan(np.full(180, 2.0), angle_min)).covered[sparse].all()
    assert scan_sectors(scan(np.full(18, 2.0), math.radians(19.0))).covered[sparse].all()
    assert not scan_sectors(scan(np.full(90, 2.0), 0.0)).covered[sparse].any()  # evenly spaced, and between them all


def test_only_what_is_in_view_is_covered() -> None:
    found = scan_sectors(scan(np.full(181, 2.0), math.radians(-90.0), math.radians(1.0)))
    assert np.flatnonzero(found.covered).tolist() == [*range(46), *range(135, 180)]


# ------------------------------------------------------------------------------------------------ a scanner that moves
def one_ray(ray: int, distance_m: float, **more: Any) -> Sectors:
    """See one thing with 361 rays from -180 to 180 degrees, one a degree."""
    ranges = np.full(361, np.inf)
    ranges[ray] = distance_m
    return scan_sectors(scan(ranges, -math.pi, math.radians(1.0), **more))


def test_a_ray_is_placed_where_the_scanner_was_when_it_was_measured() -> None:
    """Ray 270 looks to the left, 90 degrees, after three quarters of the sweep."""
    # From (-0.2, 0) turned by -20 to (0.2, 0) turned by 16: then it was at (0.1, 0), turned by 7 degrees.
    start, end = Mount(-0.2, 0.0, math.radians(-20.0)), Mount(0.2, 0.0, math.radians(16.0))
    found = one_ray(270, 2.0, mount=start, end_mount=end)
    x, y = 0.1 - 2.0 * math.sin(math.radians(7.0)), 2.0 * math.cos(math.radians(7.0))
    (sector,) = np.flatnonzero(np.isfinite(found.distances_m))
    assert sector == 47  # atan2(y, x) is 94.1 degrees
    assert found.distances_m[sector] == pytest.approx(math.hypot(x, y))
    # Upside down the same ray looks to the right.
    start, end = (Mount(mount.x_m, 0.0, mount.yaw_rad, upside_down=True) for mount in (start, end))
    found = one_ray(270, 2.0, mount=start, end_mount=end)
    (sector,) = np.flatnonzero(np.isfinite(found.distances_m))
    assert sector == 139  # (0.1 + 2 sin 7, -2 cos 7): -80.3 degrees
    assert found.distances_m[sector] == pytest.approx(math.hypot(0.1 + 2.0 * math.sin(math.radians(7.0)), y))


def test_a_scanner_turns_by_the_shorter_way() -> None:
    """From 175 to -175 degrees are 10: the middle ray, straight ahead, was measured at 180."""
    found = one_ray(180, 2.0, mount=Mount(yaw_rad=math.radians(175.5)), end_mount=Mount(yaw_rad=math.radians(-174.5)))
    assert np.flatnonzero(np.isfinite(found.distances_m)).tolist() == [90]  # 180.5 degrees


def test_what_a_turn_against_the_sweep_leaves_out_is_not_covered() -> None:
    # 18 degrees to the right in a sweep to the left: it ends 18 degrees short of where it began, at 180.
    found = one_ray(0, math.inf, end_mount=Mount(yaw_rad=math.radians(-18.0)))
    assert np.flatnonzero(~found.covered).tolist() == [*range(82, 90)]  # [164, 180) degrees; one ray is at 162
    assert one_ray(0, math.inf, end_mount=Mount(yaw_rad=math.radians(18.0))).covered.all()


def test_a_scanner_that_did_not_move_sees_the_same_to_the_last_bit() -> None:
    ranges = stream(3, "standing").uniform(0.3, 4.0, 500)
    for mount in (Mount(), Mount(0.1, -0.2, 2.0), Mount(0.0, 0.05, -1.0, upside_down=True)):
        still, stands = (scan_sectors(scan(ranges, mount=mount, end_mount=end)) for end in (None, mount))
        np.testing.assert_array_equal(still.distances_m, stands.distances_m)
        np.testing.assert_array_equal(still.covered, stands.covered)


@pytest.mark.parametrize(
    ("end_mount", "told"),
    [
        ((0.1, 0.0, 0.0), "the scan's end_mount is a tuple: give a Mount"),
        (Mount(upside_down=True), "one upside down, one not: give both alike"),
    ],
)
def test_a_scanner_that_cannot_have_moved_so_is_refused(end_mount: Any, told: str) -> None:
    with pytest.raises(UserInputError, match=told):
        one_ray(0, 1.0, end_mount=end_mount)


def test_the_robot_itself_is_left_out() -> None:
    ranges = np.full(360, 0.12)
    ranges[90] = 1.0
    found = scan_sectors(scan(ranges, math.radians(0.5)))
    assert np.flatnonzero(found.covered).tolist() == [45]
    assert scan_sectors(scan(ranges), body_radius_m=0.0).distances_m.min() == 0.12


@pytest.mark.parametrize(
    ("bad", "told"),
    [
        ({"ranges": []}, "have shape"),
        ({"ranges": [[1.0]]}, "have shape"),
        ({"ranges": ["near"]}, "are not numbers"),
        ({"angle_min": math.nan}, "angle_min is no finite number"),
        ({"range_min": math.inf}, "range_min is no finite number"),
        ({"range_max": math.nan}, "range_max is no number"),
        ({"angle_increment": 0.0}, "is no scan"),
        ({"angle_increment": 0.5}, "is no scan"),  # degrees
        ({"range_min": 5.0, "range_max": 4.0}, "agents see up to 3 m"),
        ({"range_max": 2.5}, "agents see up to 3 m"),
    ],
)
def test_what_is_no_scan_is_refused(bad: dict[str, Any], told: str) -> None:
    good = {"ranges": [1.0] * 360, "angle_min": 0.0, "angle_increment": 0.017, "range_min": 0.1, "range_max": 5.0}
    with pytest.raises(UserInputError, match=told):
        scan_sectors(Scan(**(good | bad)))


# What lies farther beyond range_max is in another unit: see test_units.py.
reading = st.one_of(
    st.floats(max_value=20.0, allow_nan=False, width=32), st.sampled_from([math.nan, math.inf, 65.535, 3.0e38])
)
readings = st.lists(reading, min_size=1, max_size=400)


@settings(max_examples=150, deadline=None)
@given(readings, st.floats(-7.0, 7.0), st.floats(0.0005, 0.02), st.booleans())
def test_any_readings_give_sectors_that_can_be_true(
    values: list[float], angle_min: float, increment: float, clockwise: bool
) -> None:
    found = scan_sectors(scan(values, angle_min, -increment if clockwise else increment))
    seen = np.isfinite(found.distances_m)
    assert not np.isnan(found.distances_m).any()
    assert found.covered[seen].all()
    assert ((found.distances_m[seen] >= 0.2) & (found.distances_m[seen] < 3.0)).all()
    # A distance is one of the readings, and the smallest of all is among the distances.
    usable = [v for v in values if 0.2 <= v < 3.0]
    assert set(found.distances_m[seen].tolist()) <= set(usable)
    assert found.distances_m.min() == min(usable, default=math.inf)


# ------------------------------------------------------------------------------------------------ clouds
def wall_ahead(x: float = 1.0) -> NDArray[np.float64]:
    y, z = np.meshgrid(np.linspace(-0.5, 0.5, 101), np.linspace(-0.2, 1.5, 60))
    return np.stack([np.full_like(y, x), y, z], axis=-1)


def test_floor_and_ceiling_are_no_obstacles() -> None:
    rng = stream(0, "floor")
    flat = rng.uniform(0.3, 2.0, (500, 2))
    level = CameraPose((0.0, 0.0, 0.0), view_rad=FULL)
    for height in (-0.3, 0.0, 0.049, 1.01, 2.5):
        assert np.isinf(cloud_sectors([(np.column_stack([flat, np.full(500, height)]), level)]).distances_m).all()
    for height in (0.05, 0.5, 1.0):
        assert np.isfinite(cloud_sectors([(np.column_stack([flat, np.full(500, height)]), level)]).distances_m).any()


def test_a_tilted_camera_in_its_optical_frame_sees_the_same_wall() -> None:
    tilt = math.radians(20.0)  # looks down
    pose = CameraPose((0.2, 0.1, 0.5), (0.0, math.sin(tilt / 2), 0.0, math.cos(tilt / 2)), optical=True)
    points = (wall_ahead().reshape(-1, 3) - pose.position_m) @ pose.rotation
    assert points[:, 2].min() > 0.3  # the wall lies ahead of the camera, along its own z
    plain = cloud_sectors([(wall_ahead(), CameraPose((0.0, 0.0, 0.0)))])
    np.testing.assert_allclose(cloud_sectors([(points, pose)]).distances_m, plain.distances_m, atol=1e-9)
    assert pose.heading_rad == pytest.approx(0.0)


def test_several_cameras_cover_what_each_has_in_view() -> None:
    left, right = (CameraPose((0.0, 0.0, 0.3), (0.0, 0.0, s * 0.5, 0.5**0.5 * 1.2247449), 1.0) for s in (1, -1))
    heading = left.heading_rad
    found = cloud_sectors([(wall_ahead(), left), (wall_ahead(), right)])
    middle = (np.arange(180) + 0.5) * BIN
    off = np.minimum(*(np.abs((middle - h + math.pi) % FULL - math.pi) for h in (heading, right.heading_rad)))
    assert found.covered[off < 0.48].all()
    assert not found.covered[(off > 0.52) & np.isinf(found.distances_m)].any()


def test_a_blind_camera_covers_nothing() -> None:
    blind = np.full((60, 80, 3), np.nan)
    assert not cloud_sectors([(blind, CameraPose((0.0, 0.0, 0.3)))]).covered.any()
    assert not cloud_sectors([]).covered.any()
    few = cloud_sectors([(wall_ahead().reshape(-1, 3)[:49], CameraPose((0.0, 0.0, 0.3)))])
    assert not few.covered.any()


def test_support_leaves_single_flying_points_out() -> None:
    points = np.concatenate([wall_ahead().reshape(-1, 3), [[0.4, 0.0, 0.5]]])
    pose = CameraPose((0.0, 0.0, 0.0))
    assert cloud_sectors([(points, pose)]).distances_m[0] == pytest.approx(0.4)
    assert cloud_sectors([(points, pose)], CloudFilter(support=2)).distances_m[0] == pytest.approx(1.0, abs=1e-3)


def test_support_is_the_second_smallest_of_each_sector() -> None:
    bins, distances = np.array([3, 3, 3, 7]), np.array([2.0, 1.0, 1.5, 0.5])
    assert nearest_by_sector(bins, distances)[[3, 7]].tolist() == [1.0, 0.5]
    assert nearest_by_sector(bins, distances, 2)[[3, 7]].tolist() == [1.5, math.inf]


def test_the_robot_s_own_arm_is_left_out() -> None:
    arm = np.column_stack([stream(0, "arm").uniform(-0.1, 0.1, (200, 2)), np.full(200, 0.3)])
    found = cloud_sectors([(arm, CameraPose((0.0, 0.0, 0.0)))])
    assert np.isinf(found.distances_m).all()


@pytest.mark.parametrize("points", [np.zeros(3), np.zeros((5, 2)), "points", [["x", "y", "z"]]])
def test_what_is_no_cloud_is_refused(points: Any) -> None:
    with pytest.raises(UserInputError, match="cloud"):
        cloud_sectors([(points, CameraPose((0.0, 0.0, 0.0)))])


@pytest.mark.parametrize("bad", [{"position_m": (0.0, math.nan, 0.0)}, {"quaternion": (0.0,) * 4}, {"view_rad": 70.0}])
def test_what_is_no_pose_is_refused(bad: dict[str, Any]) -> None:
    with pytest.raises(UserInputError, match="camera"):
        CameraPose(**({"position_m": (0.0, 0.0, 0.3)} | bad))


@pytest.mark.parametrize("bad", [{"position_m": (0.0, 0.3), "quaternion": (0.0, 0.0, 0.0, 0.0, 1.0)}])
def test_a_pose_has_three_metres_and_four_numbers_of_a_quaternion(bad: dict[str, Any]) -> None:
    with pytest.raises(UserInputError, match="not three metres, a quaternion and an angle"):
        CameraPose(**bad)


@pytest.mark.parametrize("bad", [{"support": 1.5}, {"support": math.nan}, {"min_points": math.nan}, {"support": True}])
def test_points_are_counted_in_whole_numbers(bad: dict[str, Any]) -> None:
    with pytest.raises(UserInputError, match=f"{next(iter(bad))}=.* counts points: give a whole number"):
        CloudFilter(**bad)


@pytest.mark.parametrize(
    ("make", "name"),
    [
        (Mount, "upside_down"),
        (partial(CameraPose, (0.0, 0.0, 0.3)), "optical"),
        (Guard, "blind_reverse"),
    ],
)
def test_a_switch_that_is_a_text_is_refused(make: Any, name: str) -> None:
    assert make(**{name: np.bool_(False)})
    for odd in ("no", "false", 0, None):
        with pytest.raises(UserInputError, match=f"{name}={odd!r} of a .* is neither True nor False"):
            make(**{name: odd})


coordinates = st.one_of(st.floats(-19.0, 19.0, width=32), st.sampled_from([math.nan, math.inf, -math.inf]))


@settings(max_examples=100, deadline=None)
@given(st.lists(st.tuples(coordinates, coordinates, coordinates), max_size=60), st.floats(-3.2, 3.2))
def test_any_cloud_gives_sectors_that_can_be_true(points: list[tuple], yaw: float) -> None:
    pose = CameraPose((0.0, 0.0, 0.3), (0.0, 0.0, math.sin(yaw / 2), math.cos(yaw / 2)))
    found: Sectors = cloud_sectors([(np.array(points).reshape(-1, 3), pose)], CloudFilter(min_points=1))
    seen = np.isfinite(found.distances_m)
    assert not np.isnan(found.distances_m).any()
    assert found.covered[seen].all()
    assert ((found.distances_m[seen] >= 0.2) & (found.distances_m[seen] < 3.0)).all()
