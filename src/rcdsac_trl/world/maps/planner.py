"""Paths on a map: starts and goals for the robot, its waypoints, and walks for the movers.

Two sets of places matter. *Truly free* is where the robot fits between everything that stands; starts and
goals are drawn there. *Known free* is where it would fit if there were nothing but what the planner knows,
the walls and the mapped clutter; waypoints are planned there, which is why a follower of the waypoints meets
obstacles that only its sensor shows. What is truly free is known free as well.

A path is always given as its corners, float64 [k, 2] in m, without the start and with the goal last.
"""

import itertools
import math

import numpy as np
from numpy.typing import NDArray

from rcdsac_trl.errors import UserInputError
from rcdsac_trl.world.maps.geometry import (
    CELL_M,
    ROBOT_RADIUS_M,
    least_margin_m,
    leg_clearance_m,
    lower_clearance,
    pull_tight,
    segment_clearance,
)
from rcdsac_trl.world.maps.grid_search import cheapest_path, label_components, nearest_cell
from rcdsac_trl.world.maps.shapes import Map

Point = NDArray[np.float64] | tuple[float, float]

_TIGHT_COST = 3.0  # what a metre costs more where there is no room beyond the margin
_ROUNDING_M = 1e-9
_MAX_DRAWS = 1000


def check_margin(margin_m: float, robot_radius_m: float) -> None:
    """Refuse a margin with which a robot could touch things between two free cells.

    Raises:
        UserInputError: naming the least one.
    """
    if margin_m < (least_m := least_margin_m(robot_radius_m)):
        raise UserInputError(
            f"map.clearance_margin_m={margin_m:g} is less than a grid of {CELL_M:g} m needs for a robot that reaches "
            f"{robot_radius_m:.3g} m from its centre: raise it to {math.ceil(1000.0 * least_m) / 1000.0:g}"
        )


class _Layer:
    """The cells that a disc can take among one set of obstacles, and what it costs to pass them.

    Args:
        map: the map.
        clearance_m: distance from the disc's centre to the obstacles at which a cell is free.
        comfort_m: distance below which a cell costs more the nearer it is to an obstacle; with
            ``clearance_m`` all cells cost the same and the cheapest path is the shortest.
        mapped_only: whether only what the planner knows counts as an obstacle.
        reachable_only: whether only the largest component of the free cells counts as free.
    """

    def __init__(
        self,
        map: Map,
        clearance_m: float,
        comfort_m: float,
        mapped_only: bool = False,
        reachable_only: bool = False,
    ) -> None:
        self.clearance_m = clearance_m
        self.leg_m = leg_clearance_m(clearance_m) - _ROUNDING_M
        self.boxes, self.circles = map.solids(mapped_only)
        self.side = round(map.size_m / CELL_M)
        field = np.full((self.side, self.side), comfort_m)
        lower_clearance(field, self.boxes, self.circles, comfort_m, CELL_M)
        self.field = field
        self.free = field >= clearance_m
        self.weight = np.ones_like(field)
        if comfort_m > clearance_m:
            self.weight += _TIGHT_COST * np.minimum((comfort_m - field) / (comfort_m - clearance_m), 1.0)
        if reachable_only:
            labels, count = label_components(self.free)
            self.free = labels == 1 + np.argmax(np.bincount(labels.ravel(), minlength=count + 2)[1:])
        self.cells = np.flatnonzero(self.free)
        if not len(self.cells):
            raise UserInputError(f"the map has no place {clearance_m:g} m clear of everything; clear some of it")

    def centre(self, cells: NDArray[np.integer] | np.integer) -> NDArray[np.float64]:
        """Return the centres [..., 2] of flat cell indices [...]."""
        centres = np.empty((*cells.shape, 2))
        centres[..., 0], centres[..., 1] = cells % self.side, cells // self.side
        centres += 0.5
        centres *= CELL_M
        return centres

    def nearest(self, point: Point) -> int:
        """Return the free cell whose centre is nearest to a point."""
        return int(nearest_cell(self.free, float(point[0]), float(point[1]), CELL_M))

    def clearance(self, a: Point, b: Point) -> float:
        """Return the exact clearance of the straight leg from a to b, up to the layer's own."""
        ends = float(a[0]), float(a[1]), float(b[0]), float(b[1])
        return float(segment_clearance(*ends, self.boxes, self.circles, self.clearance_m))

    def sample(self, rng: np.random.Generator) -> NDArray[np.float64]:
        """Draw a point uniformly over the free cells, with the full clearance at the point itself."""
        for _ in range(_MAX_DRAWS):
            cell = self.cells[rng.integers(len(self.cells))]
            point = self.centre(cell) + (rng.random(2) - 0.5) * CELL_M
            if self.clearance(point, point) >= self.clearance_m:
                return point
        raise UserInputError(f"no free point was found in {_MAX_DRAWS} tries; choose a less cluttered map")

    def cells_between(self, first: int, last: int) -> NDArray[np.int32]:
        """Return the cheapest path between two cells that are connected, both included."""
        return cheapest_path(self.free, self.weight, first, last)

    def pull(self, points: NDArray[np.float64]) -> NDArray[np.float64]:
        """Pull a path [n, 2] tight and drop its first point.

        A robot that touches an obstacle starts with less than the layer's clearance; its first leg then has
        only to come no nearer than it already is.
        """
        first_m = min(self.leg_m, self.clearance(points[0], points[0]) - _ROUNDING_M)
        return points[
            pull_tight(points, self.boxes, self.circles, self.field, self.weight, first_m, self.leg_m, CELL_M)
        ]

    def path(self, start: Point, goal: Point) -> NDArray[np.float64]:
        """Return the corners of the cheapest path from start to goal."""
        cells = self.cells_between(self.nearest(start), self.nearest(goal))
        return self.pull(np.concatenate([[start], self.centre(cells), [goal]]))


class Planner:
    """Starts, goals and paths on one map.

    It depends on the map and the robot's radius alone and draws only from the generators it is given, so one planner
    serves all the agents and movers on its map.

    Attributes:
        map: the map.
        robot_radius_m: circumradius of the robot.

    Example:
        >>> from rcdsac_trl.seeding import stream
        >>> from rcdsac_trl.world.maps.generator import MapSettings, generate_map
        >>> planner = Planner(generate_map(MapSettings(), "train", seed=0, index=0))
        >>> rng = stream(0, "example")
        >>> start = planner.sample_free(rng)
        >>> goal = planner.sample_goal(rng, start)
        >>> waypoints = planner.waypoints(start, goal)
        >>> waypoints.shape[1], bool((waypoints[-1] == goal).all())
        (2, True)
    """

    def __init__(self, map: Map, robot_radius_m: float = ROBOT_RADIUS_M) -> None:
        """Lay the grids out; this takes a few milliseconds.

        Args:
            map: the map, which says what is kept free beyond a radius.
            robot_radius_m: circumradius of the robot.

        Raises:
            UserInputError: the map's margin is too small for the grid, or the map has no free place.
        """
        margin_m = map.clearance_margin_m
        clearance_m = robot_radius_m + margin_m
        check_margin(margin_m, robot_radius_m)
        self.map = map
        self.robot_radius_m = robot_radius_m
        self._true = _Layer(map, clearance_m, clearance_m, reachable_only=True)
        self._known = _Layer(map, clearance_m, max(clearance_m, map.waypoint_clearance_m), mapped_only=True)
        widest_m = max((mover.radius for mover in map.movers), default=robot_radius_m)
        self._mover = _Layer(map, widest_m + margin_m, widest_m + margin_m, reachable_only=True)

    def sample_free(self, rng: np.random.Generator) -> NDArray[np.float64]:
        """Draw a point [2], m, uniformly over the truly free space that is connected."""
        return self._true.sample(rng)

    def sample_goal(self, rng: np.random.Generator, start_xy: Point, min_path_m: float = 4.0) -> NDArray[np.float64]:
        """Draw a goal [2], m, uniformly over the truly free space at least ``min_path_m`` of path away.

        Raises:
            UserInputError: no such goal was found.
        """
        for _ in range(_MAX_DRAWS):
            goal = self.sample_free(rng)
            # The straight line is a lower bound of the path, and far cheaper.
            straight_m = float(np.hypot(*(goal - start_xy)))
            if straight_m >= min_path_m or self.path_length(start_xy, goal) >= min_path_m:
                return goal
        raise UserInputError(f"no goal lies {min_path_m:g} m of path away; lower min_path_m or choose a larger map")

    def nearest_free(self, point: Point) -> NDArray[np.float64]:
        """Return the place [2], m, nearest to a point of which :meth:`sample_free` draws: a goal for who asks for it.

        Args:
            point: anywhere, m; outside of the map, the nearest place at its edge counts.
        """
        inside = np.clip(np.asarray(point, np.float64), 0.0, self.map.size_m)
        return self._true.centre(np.array(self._true.nearest(inside)))

    def true_path(self, start_xy: Point, goal_xy: Point) -> NDArray[np.float64]:
        """Return the robot's shortest path past everything that stands, mapped or not."""
        return self._true.path(start_xy, goal_xy)

    def path_length(self, start_xy: Point, goal_xy: Point) -> float:
        """Return the length of :meth:`true_path`, m."""
        points = np.concatenate([[start_xy], self.true_path(start_xy, goal_xy)])
        return float(np.hypot(*np.diff(points, axis=0).T).sum())

    def waypoints(self, start_xy: Point, goal_xy: Point) -> NDArray[np.float64]:
        """Return the waypoints from a start to a goal, planned on what the planner knows.

        Every leg between waypoints keeps the robot's radius from everything known, and every waypoint is
        truly free: where the known path bends inside an obstacle that the planner does not know, the bend
        moves onto the shortest true way past that obstacle. (The nearest truly free cell would not do: it
        can lie behind a wall.)

        Args:
            start_xy: where the robot is, m; it may touch an obstacle.
            goal_xy: a point that :meth:`sample_goal` gave, m.

        Returns:
            float64 [k, 2], k >= 1, m; the start is not in it, the last row is the goal.
        """
        # Both ends snap to truly free cells, so what is left out between them has neighbours on both sides.
        first, last = self._true.nearest(start_xy), self._true.nearest(goal_xy)
        cells = self._lead_past_the_unknown(self._known.cells_between(first, last))
        return self._known.pull(np.concatenate([[start_xy], self._known.centre(cells), [goal_xy]]))

    def leg_is_free(self, from_xy: Point, to_xy: Point) -> bool:
        """Return whether the robot can drive straight from where it is to a point, past everything known.

        The straight leg must keep the robot's radius from everything known; a robot that is nearer to something
        already must come no nearer.
        """
        need_m = min(self.robot_radius_m, self._known.clearance(from_xy, from_xy)) - _ROUNDING_M
        return self._known.clearance(from_xy, to_xy) >= need_m

    def _lead_past_the_unknown(self, cells: NDArray[np.int32]) -> NDArray[np.int32]:
        """Leave out the cells that are not truly free, and bridge what then has no line of sight."""
        at = np.flatnonzero(self._true.free.ravel()[cells])
        parts = [cells[:1]]
        for i, j in itertools.pairwise(at):
            if j > i + 1:
                a, b = self._known.centre(cells[[i, j]])
                if self._known.clearance(a, b) < self._known.leg_m:
                    parts.append(self._true.cells_between(int(cells[i]), int(cells[j]))[1:-1])
            parts.append(cells[j : j + 1])
        return np.concatenate(parts)

    def sample_mover_point(self, rng: np.random.Generator) -> NDArray[np.float64]:
        """Draw a point [2], m, uniformly over the space that every mover of the map can reach."""
        return self._mover.sample(rng)

    def mover_path(self, start_xy: Point, goal_xy: Point) -> NDArray[np.float64]:
        """Return a mover's shortest path past everything that stands, mapped or not."""
        return self._mover.path(start_xy, goal_xy)
