"""The office is what each part of the simulation says it is, its course is drivable, and the cameras see it."""

import contextlib
import itertools
import math
from collections.abc import Iterator
from dataclasses import replace

import numpy as np
import pytest

from rcdsac_trl.errors import UserInputError
from rcdsac_trl.evaluation.course.camera_rig import FILTER, camera_poses, covered, mounted, sectors_of_clouds
from rcdsac_trl.robot.range_sensor import sensor_mask
from rcdsac_trl.world.maps.geometry import ROBOT_RADIUS_M
from rcdsac_trl.world.maps.grid_search import label_components
from rcdsac_trl.world.maps.planner import Planner
from rcdsac_trl.world.maps.shapes import Box, Cylinder
from rcdsac_trl.world.office.building import COURSE_M, make_office, polyline_m
from rcdsac_trl.world.office.depth_cameras import DepthCameras, Lens, Mounted
from rcdsac_trl.world.office.furniture import RAIL_M, Piece, Solid, chair, glass, wall_with_openings
from rcdsac_trl.world.sim.lidar import sector_distances

OFFICE = make_office()
EXACT = Lens(noise_per_m=0.0, dropout=0.0)
NOBODY = np.empty((0, 2))
NARROW = sensor_mask("narrow")
LEVEL = np.array([[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]])
"""Turns the optical frame into that of a robot whose camera looks straight ahead."""


# ------------------------------------------------------------------------------------------------ the course
def test_the_course_is_as_long_as_the_paper_s() -> None:
    assert COURSE_M == 53.7
    assert abs(polyline_m(OFFICE.course) - 53.7) < 1e-6


def test_every_part_of_the_course_is_drivable_by_what_the_planner_knows() -> None:
    known = Planner(OFFICE.map)._known
    for start, end in itertools.pairwise(OFFICE.course):
        assert known.clearance(start, end) >= ROBOT_RADIUS_M


def test_a_robot_that_keeps_15_cm_from_everything_can_come_from_each_waypoint_to_the_next() -> None:
    # Wider than the robot by as much as it may be off its course and still need no luck.
    free = Planner(replace(OFFICE.map, clearance_margin_m=0.05), ROBOT_RADIUS_M + 0.1)._true
    labels, _ = label_components(free.free)
    for point in OFFICE.course:
        cell = free.nearest(point)
        assert np.hypot(*(free.centre(np.array(cell)) - point)) < 0.1
        assert labels.ravel()[cell] == labels.ravel()[free.nearest(OFFICE.course[0])]


def test_the_course_leads_into_what_the_planner_does_not_know() -> None:
    boxes, circles = OFFICE.planner._true.boxes, OFFICE.planner._true.circles
    assert len(boxes) > len(OFFICE.planner._known.boxes)
    assert len(circles) > len(OFFICE.planner._known.circles) == 0
    legs = itertools.pairwise(OFFICE.course)
    blocked = [OFFICE.planner._true.clearance(*leg) < ROBOT_RADIUS_M for leg in legs]
    assert 4 <= sum(blocked) < len(blocked)


# ------------------------------------------------------------------------------------------------ footprints
def corners(shape: Box | Cylinder) -> np.ndarray:
    if isinstance(shape, Box):
        return shape.corners()
    angles = np.arange(16) * math.pi / 8
    return np.stack([shape.x + shape.radius * np.cos(angles), shape.y + shape.radius * np.sin(angles)], axis=1)


def inside(points: np.ndarray, shape: Box | Cylinder) -> bool:
    x, y = points[:, 0] - shape.x, points[:, 1] - shape.y
    if isinstance(shape, Cylinder):
        return bool((np.hypot(x, y) <= shape.radius + 1e-9).all())
    cos, sin = math.cos(shape.yaw), math.sin(shape.yaw)
    along, across = np.abs(cos * x + sin * y), np.abs(cos * y - sin * x)
    return bool((along <= shape.half_x + 1e-9).all() and (across <= shape.half_y + 1e-9).all())


def test_a_footprint_is_what_a_piece_s_solids_cover_between_floor_and_ceiling() -> None:
    for piece in OFFICE.pieces:
        assert all(inside(corners(solid.shape), piece.footprint) for solid in piece.solids)
        if not piece.glass:
            covering = [solid for solid in piece.solids if solid.shape == piece.footprint]
            assert len(covering) == 1  # the top of a table, say, which is within the robot's height
            assert covering[0].low_m < FILTER.ceiling_m
            assert covering[0].high_m > FILTER.floor_m


def test_glass_shows_its_frame_alone() -> None:
    pane = glass(0.0, 0.0, 3.0, 0.0)
    rail, *posts = pane.solids
    assert (rail.low_m, rail.high_m, rail.shape) == (0.0, RAIL_M, pane.footprint)
    assert [post.shape.x for post in posts] == pytest.approx([0.03, 1.5, 2.97])
    assert glass(0.0, 0.0, 3.0, 0.0, framed=False).solids == ()
    assert sum(piece.glass for piece in OFFICE.pieces) == 4


def test_a_wall_s_openings_are_open() -> None:
    spans = [
        (piece.footprint.x - piece.footprint.half_x, piece.footprint.x + piece.footprint.half_x)
        for piece in wall_with_openings(0.0, 1.0, 9.0, 1.0, [(2.0, 3.0), (5.0, 6.0)])
        if isinstance(piece.footprint, Box)
    ]
    assert spans == [(0.0, 2.0), (3.0, 5.0), (6.0, 9.0)]


# ------------------------------------------------------------------------------------------------ cameras
@contextlib.contextmanager
def cameras(lens: Lens, solids: tuple[Solid, ...], people: int = 0, seed: int = 0) -> Iterator[DepthCameras]:
    rig = [mounted(pose) for pose in camera_poses(lens.view_deg)]
    made = DepthCameras(lens, rig, solids, [(0.25, 1.7)] * people, np.random.default_rng(seed))
    with contextlib.closing(made):
        yield made


def one_camera(solids: list[Solid]) -> DepthCameras:
    return DepthCameras(EXACT, [Mounted((0.0, 0.0, 0.5), LEVEL)], solids, [], np.random.default_rng(0))


def test_a_pixel_measures_what_is_in_its_direction() -> None:
    # A box whose near face is the line y = x / 2 - 1 of the robot's frame; it lies to the right.
    yaw, half = math.atan(0.5), 0.2
    middle = 1.0 + half * math.sin(yaw), -0.5 - half * math.cos(yaw)
    slanted = Solid(Box(*middle, 3.0, half, yaw, mapped=True), 0.0, 2.0)
    with contextlib.closing(one_camera([slanted])) as camera:
        cloud = camera.clouds((0.0, 0.0, 0.0), NOBODY)[0]
    x, y, z = cloud[..., 2], -cloud[..., 0], 0.5 - cloud[..., 1]
    on_face, on_floor = np.abs(y - (x / 2.0 - 1.0)) < 1e-3, np.abs(z) < 1e-3
    measured = np.isfinite(x)
    assert (on_face | on_floor)[measured].all()
    assert on_face.sum() > 300
    assert on_floor.sum() > 300


def test_what_is_too_near_hides_what_is_behind_it_and_is_not_measured() -> None:
    near = Solid(Box(0.1, 0.0, 0.05, 0.5, 0.0, True), 0.0, 2.0)  # from 5 cm on
    behind = Solid(Box(1.5, 0.0, 0.1, 3.0, 0.0, True), 0.0, 2.0)
    with contextlib.closing(one_camera([near, behind])) as camera:
        assert np.isnan(camera.depths((0.0, 0.0, 0.0), NOBODY)).all()


def test_the_cameras_cover_the_narrow_sensor() -> None:
    seen = covered(camera_poses(EXACT.view_deg))
    assert seen[NARROW].all()
    assert not seen[90]
    assert not covered(camera_poses(40.0))[NARROW].all()


def test_the_cameras_agree_with_the_exact_sensor_where_there_is_no_glass() -> None:
    """Never nearer by more than 5 mm; farther at edges that pixels miss, and some edges far off are not seen at all."""
    segments, circles = OFFICE.map.segments(), OFFICE.map.circles()
    rng = np.random.default_rng(3)
    poses = camera_poses(EXACT.view_deg)
    off, unseen, sensed = [], 0, 0
    with cameras(EXACT, OFFICE.solids) as made:
        for _ in range(60):
            x, y = OFFICE.planner.sample_free(rng)
            if y > 5.8:  # below is the open plan: desks, chairs, a door, and no glass
                continue
            yaw = rng.uniform(-3.0, 3.0)
            exact = sector_distances(x, y, yaw, segments, circles)[NARROW]
            seen = sectors_of_clouds(made.clouds((x, y, yaw), NOBODY), poses).distances_m[NARROW]
            both = np.isfinite(seen) & (exact < 2.9)
            off += (seen[both] - exact[both]).tolist()
            unseen += int((np.isinf(seen) & (exact < 2.9)).sum())
            sensed += int((exact < 2.9).sum())
    errors = np.array(off)
    assert sensed > 400
    assert errors.min() > -0.005
    assert np.median(errors) < 0.005
    assert np.quantile(errors, 0.9) < 0.1
    assert unseen / sensed < 0.04


def test_a_chair_is_seen_by_its_seat_where_its_legs_are_between_the_rays() -> None:
    seat = chair(1.5, 0.0)
    with cameras(EXACT, seat.solids) as made:
        seen = sectors_of_clouds(made.clouds((0.0, 0.0, 0.0), NOBODY), camera_poses(EXACT.view_deg))
    assert seen.distances_m[0] == pytest.approx(1.28, abs=0.01)
    assert np.isinf(seen.distances_m[15])


def test_people_are_seen_where_they_are() -> None:
    with cameras(EXACT, (), people=2) as made:
        cloud = made.clouds((5.0, 5.0, math.pi / 2), np.array([[5.0, 6.5], [9.0, 9.0]]))
    seen = sectors_of_clouds(cloud, camera_poses(EXACT.view_deg))
    assert seen.distances_m[[0, 179]] == pytest.approx(1.25, abs=0.01)
    assert np.isinf(seen.distances_m[[12, 168]]).all()


def test_what_can_be_seen_does_not_depend_on_where_the_cameras_were_before() -> None:
    with cameras(EXACT, OFFICE.solids) as straight, cameras(EXACT, OFFICE.solids) as roundabout:
        for x in np.arange(2.0, 8.0, 0.4):
            roundabout.depths((x, 2.35, 0.0), NOBODY)
        there = (8.0, 2.35, 0.3)
        assert np.array_equal(straight.depths(there, NOBODY), roundabout.depths(there, NOBODY), equal_nan=True)


def test_noise_derives_from_its_stream() -> None:
    pose = (3.0, 2.35, 0.2)
    noisy = Lens(noise_per_m=0.01, dropout=0.2)
    with (
        cameras(noisy, OFFICE.solids) as first,
        cameras(noisy, OFFICE.solids) as second,
        cameras(EXACT, OFFICE.solids) as exact,
    ):
        depths, true = first.depths(pose, NOBODY), exact.depths(pose, NOBODY)
        assert np.array_equal(depths, second.depths(pose, NOBODY), equal_nan=True)
        assert not np.array_equal(depths, first.depths(pose, NOBODY), equal_nan=True)
    both = np.isfinite(depths) & np.isfinite(true)
    assert np.isfinite(depths).sum() / np.isfinite(true).sum() == pytest.approx(0.8, abs=0.02)
    assert np.std(((depths - true) / true**2)[both]) == pytest.approx(0.01, rel=0.05)


@pytest.mark.parametrize(
    "changes",
    [{"width_px": 4}, {"view_deg": 170.0}, {"nearest_m": 4.0}, {"noise_per_m": -0.1}, {"dropout": 1.0}],
    ids=str,
)
def test_lenses_that_cannot_be_are_refused(changes: dict[str, float]) -> None:
    with pytest.raises(UserInputError, match=f"camera.{next(iter(changes))}"):
        Lens(**changes)  # type: ignore[arg-type]


def test_a_piece_says_whether_the_planner_knows_it() -> None:
    known: list[Piece] = [piece for piece in OFFICE.pieces if piece.footprint.mapped]
    assert {type(piece.footprint) for piece in known} == {Box}  # walls, glass, desks, cabinets, sofas
    assert not chair(0.0, 0.0).footprint.mapped
