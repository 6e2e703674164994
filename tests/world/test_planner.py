import itertools
import math
from dataclasses import replace

import numpy as np
import pytest
from skimage.graph import MCP_Geometric

from rcdsac_trl.errors import UserInputError
from rcdsac_trl.robot.robot_settings import RobotSettings
from rcdsac_trl.seeding import stream
from rcdsac_trl.world.maps import geometry
from rcdsac_trl.world.maps.files.file_map import FileMapSettings
from rcdsac_trl.world.maps.generator import Box, Cylinder, Map, MapSettings, Mover, generate_map
from rcdsac_trl.world.maps.geometry import (
    CELL_M,
    ROBOT_RADIUS_M,
    leg_clearance_m,
    lower_clearance,
    pull_tight,
    segment_clearance,
)
from rcdsac_trl.world.maps.grid_search import cheapest_path, farthest_cell, nearest_cell
from rcdsac_trl.world.maps.planner import Planner
from rcdsac_trl.world.maps.shapes import solid_arrays
from rcdsac_trl.world.task.world_settings import WorldSettings

HARD = MapSettings(door_width_m=(0.9, 1.2), clutter_per_m2=0.22, mapped_fraction=0.4, num_movers=8)
CASES = [(MapSettings(), index) for index in range(8)] + [(HARD, index) for index in range(4)]


def wall(x: float, y: float, half_x: float, half_y: float) -> Box:
    return Box(x, y, half_x, half_y, 0.0, mapped=True, wall=True)


def room(*pieces: Box | Cylinder, size_m: float = 10.0, movers: tuple[Mover, ...] = ()) -> Map:
    """A square room with walls 0.2 m thick, and what is in it."""
    half = size_m / 2
    outer = (
        wall(half, 0.1, half, 0.1),
        wall(half, size_m - 0.1, half, 0.1),
        wall(0.1, half, 0.1, half),
        wall(size_m - 0.1, half, 0.1, half),
    )
    boxes = (*outer, *(piece for piece in pieces if isinstance(piece, Box)))
    return Map("clutter", size_m, boxes, tuple(p for p in pieces if isinstance(p, Cylinder)), movers)


def clearance_along(a: np.ndarray, b: np.ndarray, map_: Map, mapped_only: bool = False) -> float:
    """Smallest distance from 1,000 points of a leg to the solids, by plain NumPy: an oracle for the kernels."""
    points = a + np.linspace(0, 1, 1000)[:, None] * (np.asarray(b) - a)
    least = math.inf
    for box in map_.boxes:
        if mapped_only and not box.mapped:
            continue
        turn = np.array([[math.cos(box.yaw), -math.sin(box.yaw)], [math.sin(box.yaw), math.cos(box.yaw)]])
        outside = np.maximum(np.abs((points - (box.x, box.y)) @ turn) - (box.half_x, box.half_y), 0)
        least = min(least, float(np.hypot(*outside.T).min()))
    for cylinder in map_.cylinders:
        if mapped_only and not cylinder.mapped:
            continue
        distance = np.hypot(points[:, 0] - cylinder.x, points[:, 1] - cylinder.y) - cylinder.radius
        least = min(least, max(float(distance.min()), 0.0))
    return least


def length(start: np.ndarray, path: np.ndarray) -> float:
    return float(np.hypot(*np.diff(np.vstack([start, path]), axis=0).T).sum())


# ---------------------------------------------------------------- geometry


def test_clearance_by_hand() -> None:
    box = Box(5.0, 5.0, 1.0, 0.5, 0.0, mapped=True)
    solids = room(box, Cylinder(8.0, 8.0, 0.3, mapped=True)).solids()
    assert segment_clearance(5, 6, 5, 6, *solids, 9.0) == pytest.approx(0.5)  # above the box
    assert segment_clearance(6.3, 5.9, 6.3, 5.9, *solids, 9.0) == pytest.approx(0.5)  # off its corner: 3-4-5
    assert segment_clearance(3, 5, 7, 5, *solids, 9.0) == 0.0  # through it
    assert segment_clearance(5, 5, 5, 5, *solids, 9.0) == 0.0  # inside it
    assert segment_clearance(3, 5.8, 7, 5.8, *solids, 9.0) == pytest.approx(0.3)  # along it
    assert segment_clearance(8, 7, 9, 7, *solids, 9.0) == pytest.approx(0.7)  # past the cylinder
    assert segment_clearance(5, 6, 5, 6, *solids, 0.2) == 0.2  # cut off


def test_clearance_of_turned_boxes_against_dense_sampling() -> None:
    rng = stream(0, "test")
    for index in range(5):
        map_ = generate_map(MapSettings(), "train", 2, index)
        for _ in range(20):
            a, b = rng.uniform(0, 20, (2, 2))
            expected = clearance_along(a, b, map_)
            # Samples lie up to 14 mm from the nearest point of the leg.
            assert segment_clearance(*a, *b, *map_.solids(), 99.0) == pytest.approx(expected, abs=0.015)


def test_grid_clearance_is_exact_at_the_centres() -> None:
    map_ = generate_map(MapSettings(), "train", 2, 0)
    field = np.full((200, 200), 0.5)
    lower_clearance(field, *map_.solids(), 0.5, CELL_M)
    for row, column in stream(0, "test").integers(0, 200, (300, 2)):
        centre = (np.array([column, row]) + 0.5) * CELL_M
        assert field[row, column] == pytest.approx(min(clearance_along(centre, centre, map_), 0.5), abs=1e-12)


def test_leg_clearance_bounds_every_leg_of_the_grid() -> None:
    """Worst case: a point equally far from both ends of a diagonal; and no random point beats it."""
    bound = leg_clearance_m(0.3)
    assert bound == pytest.approx(math.sqrt(0.09 - 0.005))
    assert bound > ROBOT_RADIUS_M
    rng = stream(0, "test")
    a, b = np.zeros(2), np.array([CELL_M, CELL_M])
    points = rng.uniform(-0.5, 0.6, (20000, 2))
    far = points[(np.hypot(*(points - a).T) >= 0.3) & (np.hypot(*(points - b).T) >= 0.3)]
    boxes, _ = solid_arrays([])
    for x, y in far[:500]:
        assert segment_clearance(*a, *b, boxes, np.array([[x, y, 0.0]]), 9.0) >= bound


# ---------------------------------------------------------------- search


def test_cheapest_path_costs_what_an_independent_search_finds() -> None:
    rng = stream(0, "test")
    for _ in range(20):
        free = rng.random((30, 40)) < 0.7
        weight = rng.uniform(1.0, 4.0, (30, 40))
        start, goal = rng.choice(np.flatnonzero(free), 2, replace=False)
        # scikit-image charges a step its length times the mean of its two cells, as we do.
        search = MCP_Geometric(np.where(free, weight, -1.0))
        expected = search.find_costs([divmod(start, 40)], [divmod(goal, 40)])[0][divmod(goal, 40)]
        cells = cheapest_path(free, weight, start, goal)
        if not len(cells):
            assert math.isinf(expected)
            continue
        assert (cells[0], cells[-1]) == (start, goal)
        rows, columns = np.divmod(cells, 40)
        assert free[rows, columns].all()
        steps = np.hypot(np.diff(rows), np.diff(columns))
        assert steps.max() < 1.5
        mean = (weight[rows[1:], columns[1:]] + weight[rows[:-1], columns[:-1]]) / 2
        assert (steps * mean).sum() == pytest.approx(expected)


def test_cheapest_path_without_a_way_is_empty() -> None:
    free = np.ones((5, 5), bool)
    free[:, 2] = False
    assert len(cheapest_path(free, np.ones((5, 5)), 0, 4)) == 0


def test_the_heap_grows_when_it_must() -> None:
    """Weights that fall along the way reopen cells again and again."""
    rng = stream(0, "test")
    weight = np.exp(rng.uniform(0, 6, (25, 25)))
    cells = cheapest_path(np.ones((25, 25), bool), weight, 0, 624)
    search = MCP_Geometric(weight)
    expected = search.find_costs([(0, 0)], [(24, 24)])[0][24, 24]
    rows, columns = np.divmod(cells, 25)
    steps = np.hypot(np.diff(rows), np.diff(columns))
    mean = (weight[rows[1:], columns[1:]] + weight[rows[:-1], columns[:-1]]) / 2
    assert (steps * mean).sum() == pytest.approx(expected)


def test_farthest_cell_is_the_end_of_the_longest_way() -> None:
    free = np.ones((7, 5), bool)
    free[2, :4] = free[4, 1:] = False  # a way that winds: right, left, right
    assert farthest_cell(free, 0) == (6 * 5 + 4, pytest.approx(3 * (2 + 2 * math.sqrt(2))))
    rng = stream(0, "test")
    free = rng.random((30, 40)) < 0.7
    start = int(np.flatnonzero(free)[0])
    costs = MCP_Geometric(np.where(free, 1.0, -1.0)).find_costs([divmod(start, 40)])[0].ravel()
    reached = np.where(np.isfinite(costs), costs, -1.0)
    cell, length = farthest_cell(free, start)
    assert (length, reached[cell]) == pytest.approx((reached.max(), reached.max()))


def test_nearest_cell_by_hand() -> None:
    free = np.zeros((3, 3), bool)
    assert nearest_cell(free, 0.0, 0.0, 0.1) == -1
    free[0, 0] = free[2, 2] = True
    assert nearest_cell(free, 0.10, 0.12, 0.1) == 0
    assert nearest_cell(free, 0.25, 0.12, 0.1) == 8


def test_nearest_cell_is_that_of_a_search_over_all_cells() -> None:
    rng = stream(0, "nearest")
    for share in (0.001, 0.02, 0.3):
        free = rng.random((60, 45)) < share
        free[7, 40] = True
        rows, columns = np.nonzero(free)
        for x, y in rng.uniform(-0.5, 6.5, (100, 2)):
            distances = ((columns + 0.5) * 0.1 - x) ** 2 + ((rows + 0.5) * 0.1 - y) ** 2
            nearest = nearest_cell(free, x, y, 0.1)
            assert distances.min() == ((nearest % 45 + 0.5) * 0.1 - x) ** 2 + ((nearest // 45 + 0.5) * 0.1 - y) ** 2


def test_a_leg_is_clear_where_its_clearance_is_enough() -> None:
    planner = Planner(generate_map(MapSettings(), "train", seed=0, index=1))
    boxes, circles = planner._true.boxes, planner._true.circles
    extents = geometry._bounding_boxes(boxes)
    rng, found = stream(0, "legs"), set()
    for ax, ay, length, angle in rng.uniform((0, 0, 0, 0), (20, 20, 4, 7), (3000, 4)):
        bx, by = ax + length * np.cos(angle), ay + length * np.sin(angle)
        for need in (-1e-9, 0.3):
            clear = geometry._is_clear(ax, ay, bx, by, boxes, extents, circles, need)
            assert clear == (geometry.segment_clearance(ax, ay, bx, by, boxes, circles, need) >= need)
            found.add((need, clear))
    assert found == {(-1e-9, True), (0.3, True), (0.3, False)}


def test_what_the_field_shows_of_a_leg_is_true_and_changes_no_path() -> None:
    layer = Planner(generate_map(MapSettings(), "train", seed=0, index=1))._true
    extents = geometry._bounding_boxes(layer.boxes)
    rng = stream(0, "legs")
    blocked = unseen = 0
    for ax, ay, length_m, angle in rng.uniform((0, 0, 0, 0), (20, 20, 4, 7), (3000, 4)):
        leg = ax, ay, ax + length_m * np.cos(angle), ay + length_m * np.sin(angle)
        clear = geometry._is_clear(*leg, layer.boxes, extents, layer.circles, layer.leg_m)
        shown = geometry._surely_blocked(*leg, layer.field, layer.leg_m, CELL_M)
        assert not (shown and clear)
        blocked += shown
        unseen += not shown and not clear
    assert blocked > 4 * unseen > 0
    known_nothing = np.full_like(layer.field, np.inf)
    for _ in range(20):
        start, goal = layer.sample(rng), layer.sample(rng)
        cells = layer.centre(layer.cells_between(layer.nearest(start), layer.nearest(goal)))
        pulled = [
            pull_tight(cells, layer.boxes, layer.circles, field, layer.weight, layer.leg_m, layer.leg_m, CELL_M)
            for field in (layer.field, known_nothing)
        ]
        np.testing.assert_array_equal(*pulled)


def test_pull_tight_leaves_only_the_corner() -> None:
    boxes, circles = solid_arrays([Box(0.0, 0.0, 1.0, 1.0, 0.0, mapped=True)])
    legs = [(x, 1.5) for x in np.linspace(-2, 1.5, 36)] + [(1.5, y) for y in np.linspace(1.4, -2, 35)]
    path = np.array([*legs]) + 3.0
    boxes[:, :2] += 3.0
    corners = pull_tight(path, boxes, circles, np.full((60, 60), np.inf), np.ones((60, 60)), 0.3, 0.3, CELL_M)
    assert corners[-1] == len(path) - 1
    assert len(corners) <= 3
    points = np.vstack([path[:1], path[corners]])
    for a, b in itertools.pairwise(points):
        assert segment_clearance(*a, *b, boxes, circles, 9.0) >= 0.3
    # The taut string around the corner of the square inflated by 0.3, at most a tenth longer.
    assert length(points[0], points[1:]) < 1.1 * 2 * math.hypot(3.3, 0.3) + 0.3


# ---------------------------------------------------------------- waypoints


@pytest.mark.parametrize(("settings", "index"), CASES)
def test_waypoints(settings: MapSettings, index: int) -> None:
    map_ = generate_map(settings, "validation", 0, index)
    planner = Planner(map_)
    rng = stream(0, "test", index)
    for _ in range(6):
        start = planner.sample_free(rng)
        goal = planner.sample_goal(rng, start)
        points = planner.waypoints(start, goal)
        assert points.dtype == np.float64
        np.testing.assert_array_equal(points[-1], goal)
        assert np.abs(points[0] - start).max() > 0
        legs = np.vstack([start, points])
        for a, b in itertools.pairwise(legs):
            assert clearance_along(a, b, map_, mapped_only=True) >= ROBOT_RADIUS_M
            assert np.abs(a - b).max() > 0
        # Truly free, not only known free.
        for point in points:
            assert clearance_along(point, point, map_) >= ROBOT_RADIUS_M + map_.clearance_margin_m - 1e-9
        # Comfort costs a little, and what is unknown may save something.
        assert length(start, points) < 1.5 * planner.path_length(start, goal)


@pytest.mark.parametrize(("settings", "index"), CASES)
def test_a_way_past_the_unknown_is_near_on_every_leg(settings: MapSettings, index: int) -> None:
    map_ = generate_map(settings, "train", 0, index)
    planner = Planner(map_)
    rng = stream(0, "test", index)
    for _ in range(6):
        start = planner.sample_free(rng)
        legs = np.vstack([start, planner.waypoints(start, planner.sample_goal(rng, start))])
        for a, b in itertools.pairwise(legs):
            assert planner.path_length(a, b) - math.dist(a, b) < 5.0


@pytest.mark.parametrize(("settings", "index"), CASES)
def test_true_paths_and_walks_pass_everything(settings: MapSettings, index: int) -> None:
    map_ = generate_map(settings, "validation", 0, index)
    planner = Planner(map_)
    rng = stream(0, "test", index)
    widest = max(mover.radius for mover in map_.movers)
    for _ in range(3):
        start = planner.sample_free(rng)
        goal = planner.sample_goal(rng, start)
        assert planner.path_length(start, goal) >= max(4.0, math.dist(start, goal) - 1e-9)
        walk_start, walk_goal = planner.sample_mover_point(rng), planner.sample_mover_point(rng)
        for path, first, radius in (
            (planner.true_path(start, goal), start, ROBOT_RADIUS_M),
            (planner.mover_path(walk_start, walk_goal), walk_start, widest),
        ):
            legs = np.vstack([first, path])
            for a, b in itertools.pairwise(legs):
                assert clearance_along(a, b, map_) >= radius


def test_an_empty_room_needs_one_waypoint() -> None:
    planner = Planner(room())
    np.testing.assert_array_equal(planner.waypoints((2.0, 2.0), (8.0, 7.0)), [[8.0, 7.0]])
    assert planner.path_length((2.0, 2.0), (8.0, 7.0)) == pytest.approx(math.hypot(6, 5))


def test_waypoints_lead_through_the_middle_of_a_door() -> None:
    # A wall across the room with a door from x = 6.0 to 7.0.
    map_ = room(wall(3.0, 5.0, 3.0, 0.1), wall(8.5, 5.0, 1.5, 0.1))
    planner = Planner(map_)
    start, goal = np.array([2.0, 2.0]), np.array([2.0, 8.0])
    legs = np.vstack([start, planner.waypoints(start, goal)])
    crossing = next((a, b) for a, b in itertools.pairwise(legs) if a[1] <= 5.0 < b[1])
    a, b = crossing
    x = a[0] + (5.0 - a[1]) / (b[1] - a[1]) * (b[0] - a[0])
    assert 6.35 <= x <= 6.65
    # The shortest way hugs the jamb: straight to where the robot just fits, across, and the same again.
    shortest = 2 * math.hypot(4.0 + 0.3, 3.0 - 0.1) + 0.2
    assert shortest - 0.1 < planner.path_length(start, goal) < 1.05 * shortest


def test_the_planner_does_not_know_unmapped_clutter() -> None:
    blocked = room(Box(5.0, 5.0, 0.5, 0.5, 0.0, mapped=False))
    planner = Planner(blocked)
    np.testing.assert_array_equal(planner.waypoints((2.0, 5.0), (8.0, 5.0)), [[8.0, 5.0]])
    assert planner.path_length((2.0, 5.0), (8.0, 5.0)) > 6.1
    known = Planner(replace(blocked, boxes=tuple(replace(box, mapped=True) for box in blocked.boxes)))
    assert len(known.waypoints((2.0, 5.0), (8.0, 5.0))) > 1


def test_a_waypoint_inside_an_unmapped_obstacle_moves_out_on_the_same_side_of_the_wall() -> None:
    # A wall from the left to x = 6; the way around its tip is where an unknown barrel stands.
    tip = wall(3.0, 5.0, 3.0, 0.075)
    barrel = Cylinder(6.5, 5.0, 0.45, mapped=False)
    map_ = room(tip, barrel)
    planner = Planner(map_)
    start, goal = np.array([3.0, 3.0]), np.array([3.0, 7.0])
    free_way = Planner(room(tip)).waypoints(start, goal)
    assert min(math.dist(point, (6.5, 5.0)) for point in free_way) < 0.45 + ROBOT_RADIUS_M
    points = planner.waypoints(start, goal)
    for point in points:
        assert math.dist(point, (6.5, 5.0)) >= 0.45 + ROBOT_RADIUS_M
    legs = np.vstack([start, points])
    assert max(legs[:, 0]) > 7.0
    for a, b in itertools.pairwise(legs):
        assert clearance_along(a, b, map_, mapped_only=True) >= ROBOT_RADIUS_M


@pytest.mark.parametrize("x", [0.20 + 0.231, 0.20 + 0.2455, 0.20 + 0.29])
def test_a_robot_against_a_wall_finds_its_way(x: float) -> None:
    """Pressed against a wall, the octagon's centre may be as near as its inradius, off every free cell."""
    planner = Planner(room(wall(5.0, 5.0, 3.0, 0.1)))
    start, goal = np.array([x, 5.0]), np.array([9.0, 6.0])
    points = planner.waypoints(start, goal)
    np.testing.assert_array_equal(points[-1], goal)
    legs = np.vstack([start, points])
    assert clearance_along(legs[0], legs[1], planner.map) >= x - 0.2 - 1e-6
    for a, b in itertools.pairwise(legs[1:]):
        assert clearance_along(a, b, planner.map) >= ROBOT_RADIUS_M


def test_a_leg_is_free_where_it_keeps_the_robots_radius_from_what_is_known() -> None:
    post = Cylinder(5.0, 5.0, 0.5, True)
    planner = Planner(room(post, Cylinder(8.0, 5.0, 0.5, False)))
    past = [((2.0, y), (6.9, y)) for y in (5.76, 5.74, 5.0)]  # the post's edge and the robot's radius are 5.75 m
    assert [planner.leg_is_free(*leg) for leg in past] == [True, False, False]
    assert planner.leg_is_free((7.0, 5.0), (9.0, 5.0))  # the planner does not know what stands there
    # A robot 0.24 m from the post may drive away from it, and along it, but come no nearer.
    assert planner.leg_is_free((4.26, 5.0), (2.0, 5.0))
    assert planner.leg_is_free((4.26, 5.0), (4.26, 8.0))
    assert not planner.leg_is_free((4.26, 5.0), (4.4, 8.0))


def test_less_waypoint_clearance_leads_closer_around_corners() -> None:
    map_ = generate_map(replace(MapSettings(), num_movers=0), "train", 0, 1)
    rng = stream(0, "test")
    wide, close = Planner(map_), Planner(replace(map_, waypoint_clearance_m=0.0))
    longer = 0.0
    for _ in range(10):
        start = wide.sample_free(rng)
        goal = wide.sample_goal(rng, start)
        longer += length(start, wide.waypoints(start, goal)) - length(start, close.waypoints(start, goal))
    assert longer > 0.5


# ---------------------------------------------------------------- samples


def test_samples_are_uniform_over_the_free_space() -> None:
    # A block takes the lower left quarter of the room away.
    planner = Planner(room(Box(2.5, 2.5, 2.5, 2.5, 0.0, mapped=True)))
    rng = stream(0, "test")
    points = np.array([planner.sample_free(rng) for _ in range(6000)])
    # Free, at 0.3 m clearance: [0.5, 9.5]^2 without [.., 5.3]^2 (its corner rounded).
    low, high, edge = 0.5, 9.5, 5.3
    areas = np.array([(high - edge) ** 2, (high - edge) * (edge - low), (high - edge) * (edge - low)])
    right, top = points[:, 0] > edge, points[:, 1] > edge
    counts = np.array([(right & top).sum(), (right & ~top).sum(), (~right & top).sum()])
    expected = 6000 * areas / areas.sum()
    assert counts.sum() > 5990
    assert (((counts - expected) ** 2) / expected).sum() < 13.8  # chi-square, 2 degrees of freedom, p = 0.001
    assert points.min() >= low
    assert points.max() <= high
    # Uniform inside a cell too: no lattice.
    assert len(np.unique(points)) > 11990


def test_goals_are_at_least_the_path_away_even_round_a_wall() -> None:
    # Behind the wall it is near as the crow flies and far on foot.
    planner = Planner(room(wall(4.0, 5.0, 4.0, 0.1)))
    rng = stream(0, "test")
    start = np.array([1.0, 4.5])
    goals = np.array([planner.sample_goal(rng, start) for _ in range(200)])
    assert min(planner.path_length(start, goal) for goal in goals) >= 4.0
    straight = np.hypot(*(goals - start).T)
    assert (straight < 4.0).sum() > 10
    assert (goals[straight < 4.0][:, 1] > 5.0).all()


def test_samples_depend_on_the_generator_alone() -> None:
    map_ = generate_map(MapSettings(), "train", 0, 0)
    one, two = Planner(map_), Planner(map_)
    rng = stream(9, "other")
    for _ in range(5):
        two.waypoints(two.sample_free(rng), two.sample_free(rng))
    for planner in (one, two):
        rng = stream(0, "test")
        start = planner.sample_free(rng)
        goal = planner.sample_goal(rng, start)
        walk = planner.mover_path(planner.sample_mover_point(rng), planner.sample_mover_point(rng))
        result = np.concatenate([start, goal, planner.waypoints(start, goal).ravel(), walk.ravel()])
        if planner is one:
            first = result
    np.testing.assert_array_equal(first, result)


def test_goals_that_cannot_be_are_refused() -> None:
    planner = Planner(room())
    with pytest.raises(UserInputError, match="no goal lies 100 m of path away"):
        planner.sample_goal(stream(0, "test"), (5.0, 5.0), min_path_m=100.0)


def test_a_margin_below_the_grid_is_refused() -> None:
    with pytest.raises(UserInputError, match=r"clearance_margin_m=0\.005 .* reaches 0\.25 m .*: raise it to 0\.01$"):
        Planner(replace(room(), clearance_margin_m=0.005))
    with pytest.raises(UserInputError, match=r"=0\.02 .* reaches 0\.05 m from its centre: raise it to 0\.037$"):
        Planner(replace(room(), clearance_margin_m=0.02), robot_radius_m=0.05)
    Planner(replace(room(), clearance_margin_m=0.037), robot_radius_m=0.05)


def test_a_small_robot_that_needs_a_wider_margin_is_told_before_anything_is_driven() -> None:
    mouse = RobotSettings("mouse", "disc", 0.05, None)
    with pytest.raises(UserInputError, match=r"clearance_margin_m=0\.02 .* raise it to 0\.037$"):
        WorldSettings(MapSettings(clearance_margin_m=0.02), robot=mouse)
    with pytest.raises(UserInputError, match=r"clearance_margin_m=0\.02 .* raise it to 0\.037$"):
        WorldSettings(FileMapSettings(path="a", clearance_margin_m=0.02), robot=mouse)


def test_a_map_without_free_space_is_refused() -> None:
    with pytest.raises(UserInputError, match=r"no place 0\.3 m clear"):
        Planner(room(Box(5.0, 5.0, 5.0, 5.0, 0.0, mapped=True)))


def test_closed_off_places_are_never_drawn() -> None:
    # A closed cell in a corner, [0.2, 2] x [0.2, 2] inside.
    map_ = room(wall(1.1, 2.1, 1.1, 0.1), wall(2.1, 1.1, 0.1, 1.1))
    planner = Planner(map_)
    rng = stream(0, "test")
    points = np.array([planner.sample_free(rng) for _ in range(500)])
    assert (points.max(axis=1) > 2.2).all()
