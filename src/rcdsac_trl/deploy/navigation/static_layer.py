"""What a map shows around a robot, as the static layer of a navigation stack's costmap does.

Sensors miss what a map knows: glass, table tops, and what lies beyond their reach.
"""

import math
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rcdsac_trl.deploy.sensors.arrays import numbers_of
from rcdsac_trl.errors import UserInputError
from rcdsac_trl.robot.planar import MOST_YAW_RAD, placed, seen_from
from rcdsac_trl.robot.sectors import is_finite_number

Pose = tuple[float, float, float]

# Points along an edge are at most so far apart, m: half a cell of the local map.
_SPACING_M = 0.025
_NO_CIRCLES = np.empty((0, 3))
# A building of 500 x 500 m has fewer; of more it would not be fast.
_MOST_POINTS = 5_000_000
# Larger cells are in another unit.
_LARGEST_CELL_M = 5.0


class StaticLayer:
    """Edges of what stands on a map.

    Args:
        points: along the edges, at most 2.5 cm apart, x and y in m, map frame, [k, 2].

    Raises:
        UserInputError: if they are not finite numbers of that shape, or more than five million.

    Example:
        >>> layer = StaticLayer.of_shapes(np.array([[1.0, -1.0, 1.0, 1.0]]))
        >>> x, _ = layer.around((0.0, 0.0, math.pi), 3.6).T
        >>> bool(np.allclose(x, -1.0))
        True
    """

    def __init__(self, points: NDArray[np.float64]) -> None:
        points = _rows(points, 2, "points")
        _check_number_of_points(len(points))
        # In the order of x: what is near is then found without looking at all of a large building.
        self._points = points[np.argsort(points[:, 0], kind="stable")]

    def __deepcopy__(self, memo: dict[int, Any]) -> "StaticLayer":
        """Share it: it never changes, and may be large."""
        return self

    @classmethod
    def of_shapes(cls, segments: NDArray[np.float64], circles: NDArray[np.float64] = _NO_CIRCLES) -> "StaticLayer":
        """Return the layer of straight edges and circles.

        Args:
            segments: x0, y0, x1, y1 in m, map frame, [n, 4].
            circles: x, y and radius in m, [m, 3].

        Raises:
            UserInputError: if they are not such numbers, or have more than five million points.
        """
        segments, circles = _rows(segments, 4, "segments"), _rows(circles, 3, "circles")
        if (circles[:, 2] <= 0.0).any():
            raise UserInputError(f"circles have a radius of {circles[:, 2].min():g} m: give one above 0")
        ends_m = segments[:, 2:] - segments[:, :2]
        _check_number_of_points((np.hypot(*ends_m.T).sum() + 2.0 * math.pi * circles[:, 2].sum()) / _SPACING_M)
        parts = [np.empty((0, 2))]
        for x0, y0, x1, y1 in segments.tolist():
            parts.append(np.linspace((x0, y0), (x1, y1), _number_of_points(math.hypot(x1 - x0, y1 - y0))))
        for x, y, radius in circles.tolist():
            angles = np.linspace(0.0, 2.0 * math.pi, _number_of_points(2.0 * math.pi * radius))
            parts.append(np.stack([x + radius * np.cos(angles), y + radius * np.sin(angles)], axis=1))
        return cls(np.concatenate(parts))

    @classmethod
    def of_cells(cls, occupied: NDArray[np.bool_], cell_m: float, origin: Pose) -> "StaticLayer":
        """Return the layer of a grid: the sides of occupied cells beside others that are not.

        Args:
            occupied: rows along y, [h, w].
            cell_m: side of a cell, m.
            origin: pose of the grid's lower left corner, x and y in m and yaw in rad, map frame.

        Raises:
            UserInputError: if these are not such values, or the layer would have more than five million points.
        """
        occupied = np.asarray(occupied)
        if occupied.dtype != np.bool_ or occupied.ndim != 2:
            raise UserInputError(
                f"cells of a map are {occupied.dtype} {list(occupied.shape)}: say of each whether it is occupied, bool "
                "[h, w], such as grid >= 65"
            )
        if not (is_finite_number(cell_m) and 0.0 < cell_m <= _LARGEST_CELL_M):
            raise UserInputError(
                f"cells of a map have a side of {cell_m}: give metres, above 0, {_LARGEST_CELL_M:g} at most"
            )
        numbers = numbers_of(origin, "the origin of a map")
        if numbers.shape != (3,) or not np.isfinite(numbers).all() or abs(numbers[2]) > MOST_YAW_RAD:
            raise UserInputError(
                f"the origin of a map, {origin}, is not three finite numbers: give x and y in m and yaw in rad, two "
                "turns at most"
            )
        padded = np.pad(occupied, 1)
        # A side between two cells is an edge where one alone is occupied; corners are counted in cells.
        below = np.argwhere(padded[1:] != padded[:-1]) - (0, 1)
        beside = np.argwhere(padded[:, 1:] != padded[:, :-1]) - (1, 0)
        along = np.linspace(0.0, 1.0, _number_of_points(cell_m))
        _check_number_of_points((len(below) + len(beside)) * len(along))
        x = np.concatenate([(below[:, 1:] + along).ravel(), np.repeat(beside[:, 1], len(along))]) * cell_m
        y = np.concatenate([np.repeat(below[:, 0], len(along)), (beside[:, :1] + along).ravel()]) * cell_m
        return cls(placed(np.stack([x, y], axis=1), origin))

    def around(self, pose: Pose, reach_m: float) -> NDArray[np.float64]:
        """Return what is within a square around a robot, in its frame.

        Args:
            pose: of the robot, x and y in m and yaw in rad, map frame.
            reach_m: half the side of the square, which lies along the map's axes, m.

        Returns:
            x and y in m, float64 [m, 2].
        """
        x, y, _ = pose
        first, last = np.searchsorted(self._points[:, 0], (x - reach_m, x + reach_m))
        band = self._points[first:last]
        return seen_from(band[np.abs(band[:, 1] - y) < reach_m], pose)


def _number_of_points(length_m: float) -> int:
    """Return how many points along an edge are near enough to each other, both ends among them."""
    return max(2, math.ceil(length_m / _SPACING_M) + 1)


def _check_number_of_points(number: float) -> None:
    if not number <= _MOST_POINTS:
        raise UserInputError(
            f"a map has {number:.0f} points on its edges, above {_MOST_POINTS}: give a part of it, and metres"
        )


def _rows(values: NDArray[np.float64], columns: int, name: str) -> NDArray[np.float64]:
    """Return a table of finite numbers.

    Raises:
        UserInputError: if it is none.
    """
    table = numbers_of(values, name)
    if table.ndim != 2 or table.shape[1] != columns or not np.isfinite(table).all():
        raise UserInputError(
            f"{name} of a map, {list(table.shape)}, are not finite numbers [n, {columns}]: give metres"
        )
    return table
