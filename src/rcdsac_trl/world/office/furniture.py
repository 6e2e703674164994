"""What an office is made of, in three dimensions: solids between two heights, joined to pieces of furniture.

The physics, the planner and the exact range sensor see the world from above, so each piece has a footprint: what the
robot, which is a metre high, cannot enter. Depth cameras see the solids: of a chair its seat, its back and four thin
legs, of a desk the edge of its top. A footprint is always what the piece's solids cover together, seen from above, but
for glass, which stops the robot and shows to no camera.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

from rcdsac_trl.world.maps.shapes import Box, Cylinder

WALL_HEIGHT_M = 2.5
WALL_M = 0.12
"""Thickness of a wall."""
GLASS_M = 0.06
"""Thickness of a pane's frame."""
RAIL_M = 0.1
"""Height of the rail that a framed pane stands in: all that depth cameras see of it, but for its posts."""
POST_EVERY_M = 1.2
DOOR_M = 2.05
"""Height of a door."""


@dataclass(frozen=True)
class Solid:
    """An upright solid: its shape seen from above, and the heights between which it is, m above the floor."""

    shape: Box | Cylinder
    low_m: float
    high_m: float


@dataclass(frozen=True)
class Piece:
    """A piece of furniture or building.

    Attributes:
        footprint: what the robot cannot enter; says, too, whether the planner knows the piece.
        solids: what depth cameras see; none for a pane without a frame.
        name: what it is.
        glass: whether it covers more than its solids do.
    """

    footprint: Box | Cylinder
    solids: tuple[Solid, ...]
    name: str
    glass: bool = False

    def filled(self) -> "Piece":
        """Return the piece as it were if it were not hollow: its footprint from the floor to its top; glass stays."""
        if self.glass or not self.solids:
            return self
        return replace(self, solids=(Solid(self.footprint, 0.0, max(solid.high_m for solid in self.solids)),))


def wall(x0: float, y0: float, x1: float, y1: float) -> Piece:
    """Return a wall along a line that is parallel to an axis."""
    box = _along(x0, y0, x1, y1, WALL_M)
    return Piece(box, (Solid(box, 0.0, WALL_HEIGHT_M),), "wall")


def wall_with_openings(
    x0: float, y0: float, x1: float, y1: float, openings: Sequence[tuple[float, float]]
) -> list[Piece]:
    """Return the pieces of a wall with openings.

    Args:
        x0: where it begins, m.
        y0: where it begins, m.
        x1: where it ends, m; either x or y is as at the beginning.
        y1: where it ends, m.
        openings: from where to where along the wall, coordinates in rising order, m.
    """
    if y0 == y1:
        cuts = [x0, *(cut for opening in openings for cut in opening), x1]
        return [wall(cuts[k], y0, cuts[k + 1], y0) for k in range(0, len(cuts), 2)]
    cuts = [y0, *(cut for opening in openings for cut in opening), y1]
    return [wall(x0, cuts[k], x0, cuts[k + 1]) for k in range(0, len(cuts), 2)]


def glass(x0: float, y0: float, x1: float, y1: float, framed: bool = True) -> Piece:
    """Return a glass wall: the planner knows it, cameras see its frame alone, and nothing of one without."""
    box = _along(x0, y0, x1, y1, GLASS_M)
    if not framed:
        return Piece(box, (), "glass without a frame", glass=True)
    half = GLASS_M / 2.0
    spans = max(1, round(math.hypot(x1 - x0, y1 - y0) / POST_EVERY_M))
    # The outermost posts stand within the pane's ends.
    length = max(abs(x1 - x0), abs(y1 - y0))
    share = [half / length + (1.0 - GLASS_M / length) * k / spans for k in range(spans + 1)]
    posts = [
        Box(x0 + (x1 - x0) * part, y0 + (y1 - y0) * part, half, half, 0.0, mapped=True, wall=True) for part in share
    ]
    solids = (Solid(box, 0.0, RAIL_M), *(Solid(post, 0.0, WALL_HEIGHT_M) for post in posts))
    return Piece(box, solids, "glass", glass=True)


def desk(x: float, y: float, yaw_deg: float = 0.0, length_m: float = 1.6, depth_m: float = 0.8) -> Piece:
    """Return a desk, which the planner knows: a top at 0.7 m that stands on a panel at either end."""
    top = _box(x, y, length_m / 2.0, depth_m / 2.0, yaw_deg, mapped=True)
    end = length_m / 2.0 - 0.02
    panels = [_beside(top, side * end, 0.0, 0.02, depth_m / 2.0) for side in (-1.0, 1.0)]
    return Piece(top, (Solid(top, 0.70, 0.74), *(Solid(panel, 0.0, 0.70) for panel in panels)), "desk")


def chair(x: float, y: float, yaw_deg: float = 0.0) -> Piece:
    """Return a chair on four legs of 3 cm, which the planner does not know; its back is at its own -x side."""
    seat = _box(x, y, 0.22, 0.22, yaw_deg, mapped=False)
    # Square ones: a box is drawn sooner than a cylinder.
    legs = [_beside(seat, ahead, left, 0.015, 0.015) for ahead in (-0.2, 0.2) for left in (-0.2, 0.2)]
    back = _beside(seat, -0.2, 0.0, 0.02, 0.22)
    solids = (Solid(seat, 0.42, 0.46), Solid(back, 0.46, 0.88), *(Solid(leg, 0.0, 0.42) for leg in legs))
    return Piece(seat, solids, "chair")


def stool(x: float, y: float) -> Piece:
    """Return a stool, which the planner does not know: a round seat on one leg of 5 cm."""
    seat, leg = Cylinder(x, y, 0.18, mapped=False), Cylinder(x, y, 0.025, mapped=False)
    return Piece(seat, (Solid(seat, 0.44, 0.48), Solid(leg, 0.0, 0.44)), "stool")


def round_table(x: float, y: float) -> Piece:
    """Return a round table on one leg, which the planner does not know."""
    top, leg = Cylinder(x, y, 0.35, mapped=False), Cylinder(x, y, 0.04, mapped=False)
    return Piece(top, (Solid(top, 0.71, 0.74), Solid(leg, 0.0, 0.71)), "round table")


def pole(x: float, y: float) -> Piece:
    """Return a coat stand, which the planner does not know: a pole of 5 cm."""
    return round_block(x, y, 0.025, 1.7, "pole")


def round_block(x: float, y: float, radius_m: float, height_m: float, name: str = "round block") -> Piece:
    """Return a bin, a plant or a column, which the planner does not know."""
    shape = Cylinder(x, y, radius_m, mapped=False)
    return Piece(shape, (Solid(shape, 0.0, height_m),), name)


def block(
    x: float, y: float, length_m: float, depth_m: float, height_m: float, yaw_deg: float = 0.0, mapped: bool = False
) -> Piece:
    """Return a carton, a cabinet or a sofa."""
    box = _box(x, y, length_m / 2.0, depth_m / 2.0, yaw_deg, mapped)
    return Piece(box, (Solid(box, 0.0, height_m),), "block")


def open_door(x: float, y: float, yaw_deg: float, width_m: float = 0.9) -> Piece:
    """Return the leaf of an open door, which the planner does not know; it reaches from its hinge along its yaw."""
    yaw = math.radians(yaw_deg)
    middle = x + math.cos(yaw) * width_m / 2.0, y + math.sin(yaw) * width_m / 2.0
    leaf = _box(*middle, width_m / 2.0, 0.02, yaw_deg, mapped=False)
    return Piece(leaf, (Solid(leaf, 0.01, DOOR_M),), "open door")


def _box(x: float, y: float, half_x: float, half_y: float, yaw_deg: float, mapped: bool) -> Box:
    return Box(x, y, half_x, half_y, math.radians(yaw_deg), mapped)


def _along(x0: float, y0: float, x1: float, y1: float, thickness_m: float) -> Box:
    """Return a thin box along a line that is parallel to an axis."""
    half_x, half_y = abs(x1 - x0) / 2.0, abs(y1 - y0) / 2.0
    half = thickness_m / 2.0
    return Box((x0 + x1) / 2.0, (y0 + y1) / 2.0, half_x or half, half_y or half, 0.0, mapped=True, wall=True)


def _beside(box: Box, ahead_m: float, left_m: float, half_x: float, half_y: float) -> Box:
    """Return a box in another's frame, turned as it is."""
    cos, sin = math.cos(box.yaw), math.sin(box.yaw)
    x, y = box.x + cos * ahead_m - sin * left_m, box.y + sin * ahead_m + cos * left_m
    return Box(x, y, half_x, half_y, box.yaw, box.mapped, box.wall)
