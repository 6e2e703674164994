"""The office, and the course of 53.7 m through it, as in the paper's section "Real-World Experiments".

The paper shows no plan of its office. This one has what the section and its figure speak of: two corridors of 1.7 m
with rooms between them, doors of 1 m, desks that the planner knows, and chairs, stools, poles, cartons, open doors and
people that it does not. Some walls are glass (:func:`rcdsac_trl.world.office.furniture.glass`).
"""

import itertools
from dataclasses import dataclass
from functools import cache

import numpy as np
from numpy.typing import NDArray

from rcdsac_trl.world.maps.planner import Planner
from rcdsac_trl.world.maps.shapes import Box, Cylinder, Map, Mover
from rcdsac_trl.world.office.furniture import (
    WALL_M,
    Piece,
    Solid,
    block,
    chair,
    desk,
    glass,
    open_door,
    pole,
    round_block,
    round_table,
    stool,
    wall,
    wall_with_openings,
)

COURSE_M = 53.7
"""Length of the course, as in the paper."""
PEOPLE = ((0.25, 0.5), (0.22, 0.6), (0.28, 0.4), (0.24, 0.6), (0.26, 0.5), (0.22, 0.45))
"""Radius in m and top speed in m/s of whoever walks about: what movers have in training."""
PERSON_HEIGHT_M = 1.7

_SIZE_M = 20.0
# Where the course leads: open-plan office, corridor, through a room, the other corridor, lounge. The last point only
# says the direction: the course ends where it is 53.7 m long.
_STATIONS = (
    (1.3, 2.35),
    (6.9, 3.9),
    (11.9, 2.4),
    (17.0, 5.7),
    (17.0, 7.4),
    (12.7, 7.4),
    (14.1, 13.9),
    (2.9, 13.9),
    (2.9, 16.9),
    (19.0, 16.9),
)


@dataclass(frozen=True)
class Office:
    """An office, as each part of the simulation sees it.

    Attributes:
        map: footprints and who walks there; for the physics, the planner and the exact range sensor.
        planner: of the map; knows what is mapped.
        pieces: all that stands.
        course: corner points of the course, the start first, float64 [k, 2], m.
    """

    map: Map
    planner: Planner
    pieces: tuple[Piece, ...]
    course: NDArray[np.float64]

    @property
    def solids(self) -> tuple[Solid, ...]:
        """What depth cameras see, people aside."""
        return tuple(solid for piece in self.pieces for solid in piece.solids)


@cache
def make_office(people: bool = True, hollow: bool = True) -> Office:
    """Build the office and plan the course; the same at every call.

    Args:
        people: whether anybody walks about.
        hollow: whether desks, chairs, tables and stools are; else cameras see all of them.

    Example:
        >>> office = make_office()
        >>> round(polyline_m(office.course), 9)
        53.7
    """
    pieces = (*_building(), *_open_plan(), *_rooms(), *_lounge())
    if not hollow:
        pieces = tuple(piece.filled() for piece in pieces)
    footprints = [piece.footprint for piece in pieces]
    map_ = Map(
        layout="office",
        size_m=_SIZE_M,
        boxes=tuple(shape for shape in footprints if isinstance(shape, Box)),
        cylinders=tuple(shape for shape in footprints if isinstance(shape, Cylinder)),
        movers=tuple(Mover(radius, speed) for radius, speed in PEOPLE) if people else (),
    )
    planner = Planner(map_)
    course = _cut(_planned(planner, _STATIONS), COURSE_M)
    course.flags.writeable = False
    return Office(map_, planner, pieces, course)


def polyline_m(points: NDArray[np.float64]) -> float:
    """Return the length of a polyline [n, 2], m."""
    return float(np.hypot(*np.diff(points, axis=0).T).sum())


def _planned(planner: Planner, stations: tuple[tuple[float, float], ...]) -> NDArray[np.float64]:
    """Return the corner points from station to station, the first included."""
    points = [np.array([stations[0]])]
    for start, goal in itertools.pairwise(stations):
        points.append(planner.waypoints(start, goal))
    return np.concatenate(points)


def _cut(points: NDArray[np.float64], length_m: float) -> NDArray[np.float64]:
    """Return a polyline's beginning of that length; it must be longer."""
    along = np.concatenate([[0.0], np.cumsum(np.hypot(*np.diff(points, axis=0).T))])
    last = int(np.searchsorted(along, length_m))
    share = (length_m - along[last - 1]) / (along[last] - along[last - 1])
    end = points[last - 1] + share * (points[last] - points[last - 1])
    return np.concatenate([points[:last], [end]])


def _building() -> list[Piece]:
    """Outer walls, the walls of both corridors, and those between the rooms."""
    half, far = WALL_M / 2.0, _SIZE_M - WALL_M / 2.0
    inner_0, inner_1 = WALL_M, _SIZE_M - WALL_M
    return [
        wall(0.0, half, _SIZE_M, half),
        wall(0.0, far, _SIZE_M, far),
        wall(half, inner_0, half, inner_1),
        wall(far, inner_0, far, inner_1),
        # between open plan and the southern corridor
        *wall_with_openings(inner_0, 6.5, inner_1, 6.5, [(4.0, 5.0), (16.5, 17.5)]),
        # between the southern corridor and the rooms; the meeting room's wall is glass
        glass(inner_0, 8.3, 4.2, 8.3),
        glass(5.2, 8.3, 5.94, 8.3),
        *wall_with_openings(5.94, 8.3, inner_1, 8.3, [(7.4, 9.0), (12.2, 13.2), (17.0, 18.0)]),
        # between the rooms
        *(wall(x, 8.36, x, 12.94) for x in (6.0, 10.5, 15.2)),
        # between the rooms and the northern corridor
        *wall_with_openings(inner_0, 13.0, inner_1, 13.0, [(7.6, 8.6), (13.6, 14.6)]),
        # between the northern corridor and the lounge: an opening, glass with and without a frame, and a door
        *wall_with_openings(inner_0, 14.8, 5.5, 14.8, [(2.1, 3.7)]),
        glass(5.5, 14.8, 10.3, 14.8),
        glass(10.3, 14.8, 11.5, 14.8, framed=False),
        *wall_with_openings(11.5, 14.8, inner_1, 14.8, [(17.0, 18.0)]),
    ]


def _open_plan() -> list[Piece]:
    """Desks along the wall and in three islands, with chairs as people leave them."""
    along_wall = [desk(x, 0.55) for x in (2.2, 4.6, 7.0, 9.4, 11.8, 14.2)]
    islands = [desk(x, y) for x in (4.3, 9.4, 14.4) for y in (3.65, 4.45)]
    chairs = [
        chair(2.1, 1.25, 270.0),
        chair(4.9, 1.3, 240.0),
        chair(7.2, 1.3, 280.0),
        chair(9.2, 1.25, 225.0),
        chair(12.0, 1.35, 265.0),
        chair(14.1, 1.25, 270.0),
        chair(4.1, 2.85, 75.0),
        chair(9.7, 2.95, 110.0),
        chair(14.2, 2.95, 90.0),
        chair(4.5, 5.3, 285.0),
        chair(9.2, 5.2, 260.0),
        chair(14.6, 5.15, 250.0),
        chair(15.9, 4.3, 10.0),
    ]
    things = [
        round_block(6.6, 3.1, 0.16, 0.35),  # a bin
        block(11.6, 4.7, 0.5, 0.4, 0.35, 20.0),  # a carton
        block(0.45, 4.6, 1.8, 0.5, 1.3, 90.0, mapped=True),  # a cabinet
        block(19.5, 3.0, 3.0, 0.5, 1.3, 90.0, mapped=True),
        round_block(17.9, 5.2, 0.2, 0.9),  # a plant
        open_door(16.5, 6.4, 250.0),
    ]
    return [*along_wall, *islands, *chairs, *things]


def _rooms() -> list[Piece]:
    """Both corridors and the rooms between them."""
    meeting = [desk(2.9, 10.7, 0.0, 2.8, 1.2), *(chair(x, 9.6, 90.0) for x in (2.0, 2.9)), chair(3.8, 9.45, 80.0)]
    meeting += [*(chair(x, 11.8, 270.0) for x in (2.0, 2.9, 3.8)), open_door(5.2, 8.4, 80.0)]
    kitchen = [
        block(8.25, 12.6, 3.4, 0.6, 0.9, mapped=True),
        round_table(9.6, 10.4),
        stool(9.2, 9.8),
        stool(10.1, 10.1),
    ]
    passed = [
        desk(11.35, 11.9, 90.0),
        chair(12.1, 11.8, 185.0),
        desk(14.6, 9.4, 90.0),
        chair(13.85, 9.6, 350.0),
        pole(13.3, 11.6),
        round_block(14.8, 12.5, 0.15, 0.35),
        open_door(12.2, 8.4, 100.0),
        open_door(14.6, 12.9, 280.0),
    ]
    office = [desk(19.2, 11.0, 90.0), chair(18.4, 11.1, 0.0), block(15.6, 11.0, 1.8, 0.5, 1.3, 90.0, mapped=True)]
    corridors = [
        block(15.2, 6.85, 0.6, 0.4, 0.4, 5.0),
        chair(13.9, 7.97, 270.0),
        pole(10.9, 7.0),
        round_block(11.2, 14.4, 0.2, 0.9),
        block(9.3, 13.35, 1.2, 0.4, 1.1, mapped=True),
        stool(7.2, 14.2),
        block(5.0, 13.4, 0.5, 0.4, 0.35, 340.0),
    ]
    return [*meeting, *kitchen, *passed, *office, *corridors]


def _lounge() -> list[Piece]:
    """Sofas, round tables and stools."""
    sofas = [block(6.0, 19.4, 2.2, 0.8, 0.75, mapped=True), block(9.4, 19.4, 2.2, 0.8, 0.75, mapped=True)]
    tables = [round_table(5.3, 17.0), round_table(8.3, 16.3), round_table(7.6, 18.2), round_table(13.2, 17.6)]
    stools = [
        stool(4.6, 16.5),
        stool(6.0, 17.7),
        stool(8.9, 17.1),
        stool(10.2, 16.6),
        stool(12.4, 17.1),
        stool(13.9, 16.9),
    ]
    things = [round_block(4.4, 15.05, 0.2, 0.9), pole(3.6, 17.6), round_block(11.3, 16.0, 0.15, 0.35)]
    return [*sofas, *tables, *stools, *things]
