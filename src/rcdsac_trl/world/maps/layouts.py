"""Buildings: where the walls stand, before anything is put into them.

A building is a partition of the map into rectangles, halved again and again by a wall or by a corridor.
Along every shared edge stands a wall; a random spanning tree of the rectangles says which walls get a door,
and some more doors close loops, so that there is usually more than one way to a place.
"""

from collections import defaultdict
from dataclasses import dataclass

import numpy as np

from rcdsac_trl.world.maps.shapes import Box

OUTER_WALL_M = 0.2
INNER_WALL_M = 0.15
_JAMB_M = 0.15  # what is left of a wall beside a door, at least
_MIN_ROOM_M = 2.6
_MAX_ROOM_M = 7.0
_EXTRA_DOOR = 0.3  # probability of a door that the spanning tree does not need

Range = tuple[float, float]


@dataclass(frozen=True)
class _Region:
    """A rectangle of the partition, its edges on the centre lines of the walls."""

    low: tuple[float, float]
    high: tuple[float, float]
    corridor: bool = False

    def cut(self, axis: int, low: float, high: float) -> "_Region":
        """Return the part of the rectangle between two coordinates on one axis, as a room."""
        a, b = list(self.low), list(self.high)
        a[axis], b[axis] = low, high
        return _Region((a[0], a[1]), (b[0], b[1]))


@dataclass(frozen=True)
class _Edge:
    """What two regions share: a stretch of the line ``coordinate[axis] == at``."""

    axis: int
    at: float
    low: float
    high: float


def build_walls(
    layout: str, size_m: float, corridor_width_m: Range, door_width_m: Range, rng: np.random.Generator
) -> list[Box]:
    """Return the walls of one building.

    Args:
        layout: ``"rooms"`` (rooms along corridors), ``"clutter"`` (an open place with a few free-standing
            walls) or ``"mixed"`` (rooms beside a hall).
        size_m: side of the square map, m.
        corridor_width_m: smallest and largest width of a corridor between its walls, m.
        door_width_m: smallest and largest width of a door, m.
        rng: what to draw from.
    """
    walls = _outer_walls(size_m)
    inside = _Region((OUTER_WALL_M,) * 2, (size_m - OUTER_WALL_M,) * 2)
    if layout == "clutter":
        return walls + _free_walls(inside, rng)
    if layout == "rooms":
        regions = _divide(inside, 2, corridor_width_m, rng)
    else:
        axis = int(rng.integers(2))
        at = inside.low[axis] + rng.uniform(0.4, 0.6) * (inside.high[axis] - inside.low[axis])
        halves = [inside.cut(axis, inside.low[axis], at), inside.cut(axis, at, inside.high[axis])]
        hall = halves.pop(rng.integers(2))
        regions = [hall, *_divide(halves[0], 1, corridor_width_m, rng)]
    return walls + _inner_walls(regions, door_width_m, rng)


def _outer_walls(size_m: float) -> list[Box]:
    half, thin = size_m / 2, OUTER_WALL_M / 2
    return [
        Box(x, y, half_x, half_y, yaw=0.0, mapped=True, wall=True)
        for x, y, half_x, half_y in (
            (half, thin, half, thin),
            (half, size_m - thin, half, thin),
            (thin, half, thin, half),
            (size_m - thin, half, thin, half),
        )
    ]


def _free_walls(inside: _Region, rng: np.random.Generator) -> list[Box]:
    """Return up to five walls that stand alone, each in a column of its own so that they do not meet."""
    count = int(rng.integers(2, 6))
    width = (inside.high[0] - inside.low[0]) / count
    walls = []
    for i in range(count):
        half = float(rng.uniform(0.2, 0.36)) * width
        x = inside.low[0] + (i + 0.5) * width
        y = float(rng.uniform(inside.low[1] + half + 1.0, inside.high[1] - half - 1.0))
        sides = (half, INNER_WALL_M / 2) if rng.random() < 0.5 else (INNER_WALL_M / 2, half)
        walls.append(Box(x, y, *sides, yaw=0.0, mapped=True, wall=True))
    return walls


def _divide(region: _Region, corridors: int, corridor_width_m: Range, rng: np.random.Generator) -> list[_Region]:
    """Halve a rectangle across its longer side until the rooms are small, at first by corridors."""
    sides = [region.high[i] - region.low[i] for i in range(2)]
    axis = int(rng.integers(2)) if sides[0] == sides[1] else int(sides[1] > sides[0])
    gap = float(rng.uniform(*corridor_width_m)) + INNER_WALL_M if corridors else 0.0
    spare = sides[axis] - gap - 2 * _MIN_ROOM_M
    if spare < 0 or (not corridors and sides[axis] < _MAX_ROOM_M and rng.random() < 0.5):
        return [region]
    low, high = region.low[axis], region.high[axis]
    first = low + _MIN_ROOM_M + float(rng.uniform(0.2, 0.8)) * spare
    parts = []
    if corridors:
        passage = region.cut(axis, first, first + gap)
        parts.append(_Region(passage.low, passage.high, corridor=True))
    for part in (region.cut(axis, low, first), region.cut(axis, first + gap, high)):
        parts += _divide(part, max(corridors - 1, 0), corridor_width_m, rng)
    return parts


def _shared_edge(a: _Region, b: _Region) -> _Edge | None:
    for axis in range(2):
        other = 1 - axis
        low, high = max(a.low[other], b.low[other]), min(a.high[other], b.high[other])
        if high > low and (a.high[axis] == b.low[axis] or b.high[axis] == a.low[axis]):
            return _Edge(axis, max(a.low[axis], b.low[axis]), low, high)
    return None


def _inner_walls(regions: list[_Region], door_width_m: Range, rng: np.random.Generator) -> list[Box]:
    """Put a wall on every shared edge and openings where the regions are to be joined."""
    edges = {
        (i, j): edge
        for j in range(len(regions))
        for i in range(j)
        if (edge := _shared_edge(regions[i], regions[j])) is not None
    }
    # Corridors open into each other first, rooms are rather reached from a corridor than through a room.
    rank = {pair: (2 - regions[pair[0]].corridor - regions[pair[1]].corridor) + float(rng.random()) for pair in edges}
    joined = list(range(len(regions)))
    stretches: dict[tuple[int, float], list[Range]] = defaultdict(list)
    for i, j in sorted(edges, key=rank.__getitem__):
        edge = edges[i, j]
        half = INNER_WALL_M / 2
        if regions[i].corridor and regions[j].corridor:
            opening: Range | None = (edge.low + half, edge.high - half)
        elif joined[i] != joined[j] or rng.random() < _EXTRA_DOOR:
            opening = _door(edge, door_width_m, rng)
        else:
            opening = None
        line = stretches[edge.axis, edge.at]
        if opening is None:
            line.append((edge.low - half, edge.high + half))
            continue
        joined = [joined[i] if group == joined[j] else group for group in joined]
        line += [(edge.low - half, opening[0]), (opening[1], edge.high + half)]
    return [_wall(axis, at, low, high) for (axis, at), line in stretches.items() for low, high in _merge(line)]


def _door(edge: _Edge, door_width_m: Range, rng: np.random.Generator) -> Range | None:
    width = float(rng.uniform(*door_width_m))
    spare = edge.high - edge.low - INNER_WALL_M - 2 * _JAMB_M - width
    if spare < 0:
        return None
    low = edge.low + INNER_WALL_M / 2 + _JAMB_M + float(rng.random()) * spare
    return low, low + width


def _merge(stretches: list[Range]) -> list[Range]:
    """Join the stretches of one line that touch."""
    merged: list[Range] = []
    for low, high in sorted(stretches):
        if merged and low <= merged[-1][1]:
            merged[-1] = (merged[-1][0], max(merged[-1][1], high))
        else:
            merged.append((low, high))
    return merged


def _wall(axis: int, at: float, low: float, high: float) -> Box:
    middle, half, thin = (low + high) / 2, (high - low) / 2, INNER_WALL_M / 2
    if axis == 0:
        return Box(at, middle, thin, half, yaw=0.0, mapped=True, wall=True)
    return Box(middle, at, half, thin, yaw=0.0, mapped=True, wall=True)
