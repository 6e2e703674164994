"""Clutter: pieces put into a building one by one, each only where the robot still gets about.

Mapped pieces come first and may close a passage as long as every place stays reachable some other way: the
planner knows them and plans around. A piece that the planner does not know may close nothing: the free
places around it that were connected near it must stay connected near it, so that whoever follows the
planned path finds a way past it without planning anew.
"""

import math
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from rcdsac_trl.robot.planar import seen_from
from rcdsac_trl.world.maps.geometry import CELL_M, lower_clearance, segment_clearance
from rcdsac_trl.world.maps.grid_search import keeps_connected
from rcdsac_trl.world.maps.shapes import Box, Cylinder, solid_arrays

_GAP_M = 0.02  # between pieces, so that no two solids overlap
_TRIES = 20  # pieces drawn before a place is left empty
_GROUPED = 0.35  # probability that a piece stands with others
_GROUP_M = 0.9  # standard deviation of how far from them
# Shelf, crate, post, barrel: what is mapped is rather furniture, what is not rather stands about.
_WEIGHTS = {True: (0.3, 0.35, 0.15, 0.2), False: (0.1, 0.4, 0.25, 0.25)}
# Furniture: how many of it are tables, their sides and those of chairs from smallest to largest, and legs.
_TABLES = 0.4
_TABLE_M = ((0.8, 0.6), (1.6, 0.8))
_CHAIR_M = ((0.38, 0.38), (0.5, 0.5))
_LEG_RADIUS_M = (0.015, 0.03)

Piece = Box | Cylinder


class ClutterSite:
    """A building and the pieces that have been put into it so far."""

    def __init__(
        self,
        walls: list[Box],
        size_m: float,
        clearance_m: float,
        detour_m: float,
        *,
        standing: Sequence[Cylinder] = (),
        floor: NDArray[np.bool_] | None = None,
        kept_free: Sequence[tuple[float, float]] = (),
    ) -> None:
        """Begin with the empty building.

        Args:
            walls: the building.
            size_m: side of the square map, m.
            clearance_m: robot radius plus margin, m.
            detour_m: how far around the places that an unmapped piece takes a way past it may lead, m.
            standing: what else stands in it from the beginning.
            floor: cells [rows, columns] that pieces may have their centre in; None: all.
            kept_free: places that keep the clearance from every piece, m.
        """
        self.pieces: list[Piece] = []
        self._walls = walls
        self._floor = None if floor is None else np.argwhere(floor)
        self._kept_free = kept_free
        self._size_m = size_m
        self._clearance_m = clearance_m
        self._detour_m = detour_m
        self._boxes, self._circles = solid_arrays([*walls, *standing])
        side = round(size_m / CELL_M)
        self._field = np.full((side, side), np.inf)
        lower_clearance(self._field, self._boxes, self._circles, clearance_m, CELL_M)

    @property
    def free(self) -> NDArray[np.bool_]:
        """Cells [rows, columns] where the robot fits with its margin."""
        return self._field >= self._clearance_m

    def fill(self, count: int, mapped: bool, rng: np.random.Generator) -> None:
        """Put up to ``count`` pieces in; those that fit nowhere in a few tries are left out."""
        for _ in range(count):
            for _ in range(_TRIES):
                if self._put(self._draw(mapped, rng)):
                    break

    def furnish(self, count: int, rng: np.random.Generator) -> None:
        """Put up to ``count`` tables and chairs in, each on four legs that the planner does not know."""
        for _ in range(count):
            for _ in range(_TRIES):
                if self._put_all(self._drawn_legs(rng)):
                    break

    def _drawn_legs(self, rng: np.random.Generator) -> list[Piece]:
        x, y = self._anywhere(rng)
        is_table = rng.random() < _TABLES
        size = rng.uniform(*(_TABLE_M if is_table else _CHAIR_M))
        yaw, radius = float(rng.uniform(0.0, math.pi)), float(rng.uniform(*_LEG_RADIUS_M))
        half_x, half_y = (size / 2.0 - radius).tolist()
        corners = Box(x, y, half_x, half_y, yaw, mapped=False).corners()
        return [Cylinder(leg_x, leg_y, radius, False) for leg_x, leg_y in corners.tolist()]

    def _put_all(self, pieces: Sequence[Piece]) -> bool:
        """Put all of some pieces in, or none."""
        before = self._field, self._boxes, self._circles, len(self.pieces)
        if all(self._put(piece) for piece in pieces):
            return True
        self._field, self._boxes, self._circles, number = before
        del self.pieces[number:]
        return False

    def _put(self, piece: Piece) -> bool:
        """Put a piece in unless it overlaps something or cuts the free space."""
        inside = all(0.0 < centre < self._size_m for centre in (piece.x, piece.y))
        if not inside or self._overlaps(piece):
            return False
        boxes, circles = solid_arrays([piece])
        need_m = self._clearance_m
        if any(segment_clearance(x, y, x, y, boxes, circles, need_m) < need_m for x, y in self._kept_free):
            return False
        near_m = _bounding_radius(piece) + self._clearance_m + (0.0 if piece.mapped else self._detour_m)
        window = self._window(piece, near_m + 2 * CELL_M)
        field = self._field.copy()
        lower_clearance(field, boxes, circles, self._clearance_m, CELL_M)
        before, after = self.free, field >= self._clearance_m
        # A way past the piece nearby is enough; only a mapped piece may also rely on one far away.
        passable = keeps_connected(before[window], after[window])
        if not passable and not (piece.mapped and keeps_connected(before, after)):
            return False
        self._field = field
        self._boxes = np.concatenate([self._boxes, boxes])
        self._circles = np.concatenate([self._circles, circles])
        self.pieces.append(piece)
        return True

    def _window(self, piece: Piece, radius_m: float) -> tuple[slice, slice]:
        row, column = (int(value / CELL_M) for value in (piece.y, piece.x))
        reach = int(radius_m / CELL_M) + 1
        return slice(max(row - reach, 0), row + reach + 1), slice(max(column - reach, 0), column + reach + 1)

    def _overlaps(self, piece: Piece) -> bool:
        if isinstance(piece, Cylinder):
            need = piece.radius + _GAP_M
            return self._clearance(piece.x, piece.y, piece.x, piece.y, need) < need
        corners = piece.corners().tolist()
        for (ax, ay), (bx, by) in zip(corners, corners[1:] + corners[:1], strict=True):
            if self._clearance(ax, ay, bx, by, _GAP_M) < _GAP_M:
                return True
        # No side is near anything, so what still overlaps lies wholly inside the new box.
        centres = np.concatenate([self._boxes[:, :2], self._circles[:, :2]])
        local = np.abs(seen_from(centres, (piece.x, piece.y, piece.yaw)))
        return bool((local < (piece.half_x, piece.half_y)).all(axis=1).any())

    def _clearance(self, ax: float, ay: float, bx: float, by: float, limit_m: float) -> float:
        return float(segment_clearance(ax, ay, bx, by, self._boxes, self._circles, limit_m))

    def _draw(self, mapped: bool, rng: np.random.Generator) -> Piece:
        """Draw a piece and a place for it, which may turn out to be impossible."""
        kind = rng.choice(len(_WEIGHTS[mapped]), p=_WEIGHTS[mapped])
        if kind == 0 and self._walls:
            return _shelf(self._walls, mapped, rng)
        if self.pieces and rng.random() < _GROUPED:
            beside = self.pieces[rng.integers(len(self.pieces))]
            x, y = rng.normal((beside.x, beside.y), _GROUP_M).tolist()
        else:
            x, y = self._anywhere(rng)
        if kind == 1:
            half_x, half_y = rng.uniform(0.15, 0.45, 2).tolist()
            # People put about half of their crates down square to the walls.
            yaw = float(rng.uniform(0.0, math.pi)) if rng.random() < 0.5 else 0.0
            return Box(x, y, half_x, half_y, yaw, mapped)
        return Cylinder(x, y, float(rng.uniform(*((0.06, 0.15) if kind == 2 else (0.2, 0.4)))), mapped)

    def _anywhere(self, rng: np.random.Generator) -> tuple[float, float]:
        if self._floor is None:
            x, y = rng.uniform(0.0, self._size_m, 2).tolist()
        else:
            row, column = self._floor[rng.integers(len(self._floor))]
            x, y = (CELL_M * (np.array([column, row]) + rng.random(2))).tolist()
        return x, y


def _shelf(walls: list[Box], mapped: bool, rng: np.random.Generator) -> Box:
    """Draw a long box with its back to a wall."""
    lengths = np.array([max(wall.half_x, wall.half_y) for wall in walls])
    wall = walls[rng.choice(len(walls), p=lengths / lengths.sum())]
    along, deep = float(rng.uniform(0.4, 0.9)), float(rng.uniform(0.15, 0.3))
    offset = min(wall.half_x, wall.half_y) + deep + 1.5 * _GAP_M
    offset *= 1.0 if rng.random() < 0.5 else -1.0
    shift = float(rng.uniform(-1.0, 1.0)) * max(wall.half_x, wall.half_y)
    if wall.half_x > wall.half_y:
        return Box(wall.x + shift, wall.y + offset, along, deep, 0.0, mapped)
    return Box(wall.x + offset, wall.y + shift, deep, along, 0.0, mapped)


def _bounding_radius(piece: Piece) -> float:
    return piece.radius if isinstance(piece, Cylinder) else float(np.hypot(piece.half_x, piece.half_y))
