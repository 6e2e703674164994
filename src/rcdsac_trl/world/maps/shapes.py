"""A map as a plain value: what stands where, and what moves.

The map frame has its origin in the lower left corner, x to the right, y up, so everything lies in
``[0, size_m] x [0, size_m]``. A map says little of a robot: starts, goals and the movers' walks are drawn
per episode by whoever needs them, but for a start and a goal that somebody chose.
"""

import json
import math
from collections.abc import Sequence
from dataclasses import asdict, dataclass, fields
from functools import cached_property
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from rcdsac_trl.errors import UserInputError
from rcdsac_trl.robot.planar import placed

CLEARANCE_MARGIN_M = 0.05
"""Default of what the generator and the planner keep free beyond the robot's radius."""

WAYPOINT_CLEARANCE_M = 0.6
"""Default of the clearance that waypoints keep where that costs little."""

FORMAT_VERSION = 1
"""Version of the JSON that :meth:`Map.to_json` writes."""

MAX_SIZE_M = 200.0
"""Largest side of a map: a larger one the planner's grid could not hold, m."""


@dataclass(frozen=True)
class Box:
    """An upright box, seen from above.

    Attributes:
        x: centre, m.
        y: centre, m.
        half_x: half of the side along the box's own x axis, m.
        half_y: half of the side along the box's own y axis, m.
        yaw: angle of the box's x axis, rad, counter-clockwise from the map's x axis.
        mapped: whether the planner knows it.
        wall: whether it is a part of the building (always mapped) and not a piece of clutter.
    """

    x: float
    y: float
    half_x: float
    half_y: float
    yaw: float
    mapped: bool
    wall: bool = False

    def corners(self) -> NDArray[np.float64]:
        """Return the corners, counter-clockwise, float64 [4, 2], m."""
        signs = np.array([[-1.0, -1.0], [1.0, -1.0], [1.0, 1.0], [-1.0, 1.0]])
        return placed(signs * (self.half_x, self.half_y), (self.x, self.y, self.yaw))


@dataclass(frozen=True)
class Cylinder:
    """An upright cylinder: centre and radius in m, and whether the planner knows it."""

    x: float
    y: float
    radius: float
    mapped: bool


def solid_arrays(pieces: Sequence[Box | Cylinder]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return boxes [n, 6] and circles [m, 3] as :mod:`rcdsac_trl.world.maps.geometry` takes them."""
    boxes = [
        (box.x, box.y, box.half_x, box.half_y, math.cos(box.yaw), math.sin(box.yaw))
        for box in pieces
        if isinstance(box, Box)
    ]
    circles = [(piece.x, piece.y, piece.radius) for piece in pieces if isinstance(piece, Cylinder)]
    return np.array(boxes, np.float64).reshape(-1, 6), np.array(circles, np.float64).reshape(-1, 3)


@dataclass(frozen=True)
class Mover:
    """A walking cylinder. Where it walks is drawn per simulation.

    Attributes:
        radius: m.
        speed_m_per_s: top speed.
        yields: whether it stops for a robot in its way; one that does not stops when they touch.
    """

    radius: float
    speed_m_per_s: float
    yields: bool = True


def _sides(boxes: Sequence[Box]) -> NDArray[np.float64]:
    """Return the sides of boxes, float64 [n, 4]: x0, y0, x1, y1 in m."""
    if not boxes:
        return np.empty((0, 4))
    corners = np.stack([box.corners() for box in boxes])
    return np.concatenate([corners, np.roll(corners, -1, axis=1)], axis=-1).reshape(-1, 4)


Kind = Literal["outer_wall", "inner_wall", "mapped_clutter", "unmapped_clutter"]
"""What something that stands is; see :meth:`Map.kind`."""

# What a mover has at least, its radius in m and its speed in m/s, and at most, as far as its place does not say it.
_LEAST_OF_A_MOVER = 0.05
_MOST_OF_A_MOVER = {"speed_m_per_s": 2.0}

# How near to the map's border a wall must reach to be an outer one.
_BORDER_M = 1e-6


@dataclass(frozen=True)
class Map:
    """One map, as a plain value.

    Attributes:
        layout: the kind of place, one of :data:`LAYOUTS` for generated maps.
        size_m: side of the square, m.
        boxes: walls and box-shaped clutter.
        cylinders: round clutter.
        movers: what walks about.
        clearance_margin_m: beyond the robot's radius, the clearance at which the free space is connected.
        waypoint_clearance_m: the clearance that waypoints keep where that costs little.
        start: where a robot starts, x, y in m and yaw in rad; None: drawn an episode.
        goal: its first goal, m; None: drawn likewise, as all that follow.

    Example:
        >>> crate = Box(x=1.0, y=2.0, half_x=0.5, half_y=0.25, yaw=0.0, mapped=True)
        >>> map = Map(layout="clutter", size_m=20.0, boxes=(crate,), cylinders=(), movers=())
        >>> map.segments().shape, Map.from_json(map.to_json()) == map
        ((4, 4), True)
    """

    layout: str
    size_m: float
    boxes: tuple[Box, ...]
    cylinders: tuple[Cylinder, ...]
    movers: tuple[Mover, ...]
    clearance_margin_m: float = CLEARANCE_MARGIN_M
    waypoint_clearance_m: float = WAYPOINT_CLEARANCE_M
    start: tuple[float, float, float] | None = None
    goal: tuple[float, float] | None = None

    def segments(self, mapped_only: bool = False) -> NDArray[np.float64]:
        """Return the sides of the boxes as float64 [n, 4]: x0, y0, x1, y1 in m.

        Args:
            mapped_only: leave out what the planner does not know.
        """
        return _sides([box for box in self.boxes if box.mapped]) if mapped_only else self._all_sides

    @cached_property
    def _all_sides(self) -> NDArray[np.float64]:
        """The sides of all boxes: every simulation of the map asks for them."""
        return _sides(self.boxes)

    def circles(self, mapped_only: bool = False) -> NDArray[np.float64]:
        """Return the cylinders as float64 [m, 3]: x, y, radius in m.

        Args:
            mapped_only: leave out what the planner does not know.
        """
        return self.solids(mapped_only)[1]

    def solids(self, mapped_only: bool = False) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Return the boxes [n, 6] and circles [m, 3] that :mod:`rcdsac_trl.world.maps.geometry` works on.

        Args:
            mapped_only: leave out what the planner does not know.
        """
        pieces: list[Box | Cylinder] = [*self.boxes, *self.cylinders]
        return solid_arrays([piece for piece in pieces if piece.mapped or not mapped_only])

    def kind(self, piece: Box | Cylinder) -> Kind:
        """Say what something that stands is. An outer wall is one that reaches the map's border.

        Args:
            piece: of this map.

        Example:
            >>> wall = Box(x=10.0, y=0.1, half_x=10.0, half_y=0.1, yaw=0.0, mapped=True, wall=True)
            >>> Map(layout="clutter", size_m=20.0, boxes=(wall,), cylinders=(), movers=()).kind(wall)
            'outer_wall'
        """
        if isinstance(piece, Box) and piece.wall:
            corners = piece.corners()
            inside = corners.min() > _BORDER_M and corners.max() < self.size_m - _BORDER_M
            return "inner_wall" if inside else "outer_wall"
        return "mapped_clutter" if piece.mapped else "unmapped_clutter"

    def to_json(self) -> str:
        """Return the map as JSON; :meth:`from_json` gives an equal map back, bit for bit."""
        values = asdict(self)
        for name in ("start", "goal"):  # as maps without them always were
            if values[name] is None:
                del values[name]
        for mover in values["movers"]:
            if mover["yields"]:
                del mover["yields"]
        return json.dumps({"format": FORMAT_VERSION, **values})

    @classmethod
    def from_json(cls, text: str) -> "Map":
        """Read a map that :meth:`to_json` wrote.

        Raises:
            UserInputError: the text is not such a map.
        """
        try:
            return map_of_values(json.loads(text))
        except _NO_MAP as error:
            raise UserInputError(f"the text is not a map ({error}); give what Map.to_json wrote") from error


_NO_MAP = (ValueError, TypeError, KeyError, AttributeError, RecursionError)


def map_of_values(values: dict[str, Any]) -> Map:
    """Return the map of values as JSON has them.

    Raises:
        ValueError: for whatever no map has; so do TypeError, KeyError and AttributeError.
    """
    data = dict(values)
    version = data.pop("format")
    if version != FORMAT_VERSION:
        raise ValueError(f"its format is {version!r}, only {FORMAT_VERSION} can be read")
    for key, part in (("boxes", Box), ("cylinders", Cylinder), ("movers", Mover)):
        data[key] = tuple(_part(part, key, item) for item in data[key])
    for key in ("start", "goal"):
        if data.get(key) is not None:
            data[key] = tuple(data[key])
    _check_keys(Map, "a map", data)
    map_ = Map(**data)
    _check_read(map_)
    return map_


def _part(kind: type, where: str, values: Any) -> Any:
    if not isinstance(values, dict):
        raise ValueError(f"{values!r} in {where} is no section with keys")
    _check_keys(kind, f"what is in {where}", values)
    return kind(**values)


def _check_keys(kind: type, what: str, values: dict[str, Any]) -> None:
    """Refuse keys that something does not have, with a ValueError."""
    known = [field.name for field in fields(kind)]
    if strange := [key for key in values if key not in known]:
        raise ValueError(f"there is no key {strange[0]}, {what} has {', '.join(known)}")


def _check_read(map_: Map) -> None:
    """Refuse values that no map has, with a ValueError."""
    if not isinstance(map_.layout, str):
        raise ValueError(f"layout is {map_.layout!r}, not text")
    _check_number("size_m", map_.size_m, 1.0, MAX_SIZE_M)
    for name in ("clearance_margin_m", "waypoint_clearance_m"):
        _check_number(name, getattr(map_, name), 0.0, map_.size_m)
    for name, place, numbers in (("start", map_.start, 3), ("goal", map_.goal, 2)):
        if place is not None and len(place) != numbers:
            raise ValueError(f"{name} is {list(place)}, not {numbers} numbers")
        for value in place or ():
            _check_number(name, value, -MAX_SIZE_M, MAX_SIZE_M)
    parts: list[tuple[str, Box | Cylinder | Mover]] = [
        *(("boxes", box) for box in map_.boxes),
        *(("cylinders", cylinder) for cylinder in map_.cylinders),
        *(("movers", mover) for mover in map_.movers),
    ]
    for where, part in parts:
        for name, value in vars(part).items():
            if name in ("mapped", "wall", "yields"):
                if not isinstance(value, bool):
                    raise ValueError(f"{name} in {where} is {value!r}, neither true nor false")
            elif isinstance(part, Mover):
                _check_number(f"{name} in {where}", value, _LEAST_OF_A_MOVER, _MOST_OF_A_MOVER.get(name, map_.size_m))
            elif name == "yaw":
                _check_number(f"yaw in {where}", value, -2 * math.pi, 2 * math.pi)
            else:
                _check_number(f"{name} in {where}", value, 0.0, map_.size_m)


def _check_number(name: str, value: object, low: float, high: float) -> None:
    # The comparison is false for NaN too.
    if isinstance(value, bool) or not isinstance(value, int | float) or not low <= value <= high:
        raise ValueError(f"{name} is {value!r}, not a number from {low:g} to {high:g}")
