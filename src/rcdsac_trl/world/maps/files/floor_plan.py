"""A floor plan: what a file says that stands, whatever format it has; and what of it a robot can use.

A plan lies in the map frame of :class:`~rcdsac_trl.world.maps.shapes.Map`, whose origin is the lower left corner, and
says where that frame lies in the file's own. It is closed: walls surround it, and fill what it lacks to a square.
"""

import math
from dataclasses import dataclass
from typing import NamedTuple, TypeVar

import numpy as np
from numpy.typing import NDArray

from rcdsac_trl.errors import UserInputError
from rcdsac_trl.world.maps.files.rectangles import rectangles
from rcdsac_trl.world.maps.geometry import CELL_M, lower_clearance
from rcdsac_trl.world.maps.grid_search import label_components
from rcdsac_trl.world.maps.shapes import MAX_SIZE_M, Box, Cylinder, Map, Mover

Pose = tuple[float, float, float]
Piece = TypeVar("Piece", Box, Cylinder)

BORDER_M = 0.2
"""Thickness of the walls around a plan."""

_MAX_BOXES = 30_000
# Pieces are sorted by squares of this side: those that follow each other become one body in the physics.
_NEIGHBOURHOOD_M = 4.0


@dataclass(frozen=True)
class FloorPlan:
    """What a file says that stands, in the map frame.

    Attributes:
        name: what it is called.
        size_m: side of the square, m.
        boxes: its walls and whatever else is a box.
        cylinders: what is round.
        movers: what walks about; only a map of ours says that.
        frame: pose of the map frame in the file's own: x, y in m and yaw in rad.
        extent_m: width and height of what the file describes, m.
        start: where a robot starts, in the map frame, if the file says so.
        goal: likewise.
    """

    name: str
    size_m: float
    boxes: tuple[Box, ...]
    cylinders: tuple[Cylinder, ...]
    movers: tuple[Mover, ...]
    frame: Pose
    extent_m: tuple[float, float]
    start: Pose | None = None
    goal: tuple[float, float] | None = None

    def to_map_frame(self, x: float, y: float) -> tuple[float, float]:
        """Return a place of the file's own frame in the map frame, m.

        Example:
            >>> plan = FloorPlan("a", 9.0, (), (), (), (2.0, 1.0, math.pi / 2), (9.0, 9.0))
            >>> plan.to_map_frame(2.0, 4.0)
            (3.0, 0.0)
        """
        from_x, from_y, yaw = self.frame
        dx, dy = x - from_x, y - from_y
        cos, sin = math.cos(yaw), math.sin(yaw)
        return round(cos * dx + sin * dy, 9), round(cos * dy - sin * dx, 9)


def plan_of_cells(name: str, occupied: NDArray[np.bool_], cell_m: float, frame: Pose, *, mapped: bool) -> FloorPlan:
    """Return the plan of a grid of cells.

    Args:
        name: of the plan, for messages too.
        occupied: bool [rows, columns], the first row at the smallest y.
        cell_m: side of a cell, m.
        frame: pose of the grid's lower left corner in the file's frame.
        mapped: whether the planner knows what stands there.

    Raises:
        UserInputError: nothing is free, or it is larger than maps can be, or of more pieces than serve.
    """
    rows, columns = np.flatnonzero(~occupied.all(axis=1)), np.flatnonzero(~occupied.all(axis=0))
    if not len(rows):
        raise UserInputError(
            f"{name}: none of its {occupied.size} cells is free: look at its thresholds, negate and map.unknown"
        )
    # What lies around all that is free is the border's business.
    inside = occupied[rows[0] : rows[-1] + 1, columns[0] : columns[-1] + 1]
    height_m, width_m = (cells * cell_m for cells in inside.shape)
    if max(width_m, height_m) + 2 * BORDER_M > MAX_SIZE_M:
        raise UserInputError(
            f"{name}: its free part is {inside.shape[1]} x {inside.shape[0]} cells of {cell_m:g} m, {width_m:.1f} x "
            f"{height_m:.1f} m, and maps have at most {MAX_SIZE_M:g} m: is the side of a cell right?"
        )
    found = rectangles(np.ascontiguousarray(inside))
    if len(found) > _MAX_BOXES:
        raise UserInputError(
            f"{name}: its occupied cells make {len(found)} boxes, and {_MAX_BOXES} are the most that serve: "
            "clear it of specks, or use a coarser map"
        )
    low, high = (BORDER_M + cell_m * found[:, corner] for corner in ((1, 0), (3, 2)))
    middles, halves = (0.5 * (low + high)).tolist(), (0.5 * (high - low)).tolist()
    boxes = [
        Box(x, y, half_x, half_y, yaw=0.0, mapped=mapped, wall=mapped)
        for (x, y), (half_x, half_y) in zip(middles, halves, strict=True)
    ]
    corner = _moved(frame, columns[0] * cell_m - BORDER_M, rows[0] * cell_m - BORDER_M)
    return enclosed(name, (width_m, height_m), boxes, [], corner)


def _moved(frame: Pose, x: float, y: float) -> Pose:
    """Return a frame moved along its own axes."""
    cos, sin = math.cos(frame[2]), math.sin(frame[2])
    return frame[0] + cos * x - sin * y, frame[1] + sin * x + cos * y, frame[2]


def enclosed(
    name: str, extent_m: tuple[float, float], boxes: list[Box], cylinders: list[Cylinder], frame: Pose
) -> FloorPlan:
    """Return the plan of a rectangle, with walls around it and what a square has beside it filled.

    Args:
        name: of the plan.
        extent_m: width and height of the rectangle, whose lower left corner is at :data:`BORDER_M`, m.
        boxes: in it.
        cylinders: in it.
        frame: pose of the map frame in the file's.
    """
    width_m, height_m = extent_m
    size_m = max(extent_m) + 2 * BORDER_M
    right, top = BORDER_M + width_m, BORDER_M + height_m
    walls = [
        _wall(0.0, 0.0, BORDER_M, size_m),
        _wall(right, 0.0, size_m, size_m),
        _wall(BORDER_M, 0.0, right, BORDER_M),
        _wall(BORDER_M, top, right, size_m),
    ]
    return FloorPlan(name, size_m, (*walls, *_by_place(boxes)), tuple(_by_place(cylinders)), (), frame, extent_m)


def _wall(low_x: float, low_y: float, high_x: float, high_y: float) -> Box:
    half_x, half_y = 0.5 * (high_x - low_x), 0.5 * (high_y - low_y)
    return Box(low_x + half_x, low_y + half_y, half_x, half_y, yaw=0.0, mapped=True, wall=True)


def _by_place(pieces: list[Piece]) -> list[Piece]:
    """Sort pieces so that neighbours follow each other."""
    return sorted(pieces, key=lambda piece: (piece.y // _NEIGHBOURHOOD_M, piece.x // _NEIGHBOURHOOD_M))


class FreeFloor(NamedTuple):
    """Where a robot fits on a plan.

    Attributes:
        connected: cells of the largest connected part, bool [side, side]; see
            :data:`~rcdsac_trl.world.maps.geometry.CELL_M`.
        share: of all cells where the robot fits, those in that part.
        parts: how many parts there are.
    """

    connected: NDArray[np.bool_]
    share: float
    parts: int

    @property
    def area_m2(self) -> float:
        """Area of the largest part, m^2."""
        return float(self.connected.sum()) * CELL_M**2


def free_cells(map_: Map, clearance_m: float) -> NDArray[np.bool_]:
    """Return which cells of a map are so far from everything that stands, bool [side, side]."""
    side = round(map_.size_m / CELL_M)
    field = np.full((side, side), clearance_m)
    lower_clearance(field, *map_.solids(), clearance_m, CELL_M)
    return field >= clearance_m


def free_floor(map_: Map, clearance_m: float) -> FreeFloor:
    """Return where a robot fits.

    Args:
        map_: as it is without clutter.
        clearance_m: the robot's radius and its margin, m.

    Raises:
        UserInputError: it fits nowhere.
    """
    labels, parts = label_components(free_cells(map_, clearance_m))
    if not parts:
        raise UserInputError(
            f"{map_.layout}: of {map_.size_m:.1f} x {map_.size_m:.1f} m no place is {clearance_m:g} m clear of "
            "everything, which this robot needs: is the side of a cell right?"
        )
    sizes = np.bincount(labels.ravel(), minlength=parts + 1)[1:]
    largest = int(sizes.argmax())
    return FreeFloor(labels == 1 + largest, float(sizes[largest] / sizes.sum()), parts)
