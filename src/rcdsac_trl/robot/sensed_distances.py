"""How far a place, or a robot's outline, is from what its range sensor saw.

What lies behind an obstacle counts as obstacle: in a direction in which something is seen, everything is from there on.
"""

import numpy as np
from numpy.typing import NDArray

from rcdsac_trl.robot.range_sensor import BIN_RAD, NUM_BINS
from rcdsac_trl.robot.sectors import Sectors

_ANGLES = np.arange(NUM_BINS) * BIN_RAD
# Border i is the one between sectors i - 1 and i.
_BORDERS = np.stack((np.cos(_ANGLES), np.sin(_ANGLES)))
_SECTORS_BEFORE = np.arange(NUM_BINS) - 1


def sensed_within(sectors: Sectors, reach_m: float) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return the directions in which something is seen within a reach, unit vectors [2, m], and how far, m, [m]."""
    # Along a border, both sectors beside it are seen: whatever is inside a sector lies between its borders, at its
    # distance or farther.
    nearest = np.minimum(sectors.distances_m, sectors.distances_m[_SECTORS_BEFORE])
    seen = nearest < reach_m
    return _BORDERS[:, seen], nearest[seen]


def place_distances(
    places: NDArray[np.float64], borders: NDArray[np.float64], nearest: NDArray[np.float64]
) -> NDArray[np.float64]:
    """Return how far each place is from what is sensed in each direction, m, [..., m].

    Args:
        places: [..., 2].
        borders: directions of unit length, [2, m].
        nearest: in each direction, how far from here on there may be something, m, [m].

    Example:
        >>> ahead = np.array([[1.0], [0.0]])
        >>> place_distances(np.array([[0.0, 0.0], [3.0, 0.5]]), ahead, np.array([2.0]))  # the second one lies behind it
        array([[2. ],
               [0.5]])
    """
    along = places @ borders
    point = np.maximum(along, nearest)
    # |place - point u|^2 = |place|^2 + point (point - 2 place u) for a direction u, in few passes over large arrays.
    along *= 2.0
    np.subtract(point, along, out=along)
    along *= point
    along += np.square(places).sum(axis=-1)[..., None]
    return np.sqrt(np.maximum(along, 0.0))


def outline_distances(
    outline: NDArray[np.float64],
    places: NDArray[np.float64],
    headings: NDArray[np.float64],
    borders: NDArray[np.float64],
    nearest: NDArray[np.float64],
) -> NDArray[np.float64]:
    """Return how far a convex body is from what is sensed in each direction at each place, m, [k, n, m]; 0: they meet.

    What is sensed in a direction is everything on the ray from `nearest` on. A ray and a convex body that do not meet
    are nearest at the ray's beginning, or at one of the body's corners.

    Args:
        outline: corners of the body in its own frame, counter-clockwise, m, [corners, 2].
        places: of its centre, [k, n, 2].
        headings: cosine and sine of its heading there, [n, 2].
        borders: directions of unit length, [2, m].
        nearest: in each direction, how far from here on there may be something, m, [m].

    Example:
        >>> square = np.array([[0.5, -0.5], [0.5, 0.5], [-0.5, 0.5], [-0.5, -0.5]])
        >>> places, headings = np.zeros((1, 2, 2)), np.array([[1.0, 0.0], [0.5**0.5, 0.5**0.5]])
        >>> outline_distances(square, places, headings, np.array([[1.0], [0.0]]), np.array([2.0]))[..., 0].round(3)
        array([[1.5  , 1.293]])
    """
    cos, sin = headings[:, 0], headings[:, 1]
    turns = np.stack((np.stack((cos, sin), axis=-1), np.stack((-sin, cos), axis=-1)), axis=1)  # [n, frame, map]
    corners = places[:, :, None] + outline @ turns
    at_corners = place_distances(corners, borders, nearest).min(axis=2)
    # The rays in the body's frame, [k, n, m, 2].
    begin = np.einsum("nij,snmj->snmi", turns, (borders * nearest).T - places[:, :, None])
    along = np.broadcast_to(np.einsum("nij,jm->nmi", turns, borders), begin.shape)
    at_begin, met = _point_and_ray(outline, begin, along)
    return np.where(met, 0.0, np.minimum(at_corners, at_begin))


def _point_and_ray(
    outline: NDArray[np.float64], begin: NDArray[np.float64], along: NDArray[np.float64]
) -> tuple[NDArray[np.float64], NDArray[np.bool_]]:
    """Return how far the beginnings of rays [..., 2] are from a convex body, and whether the rays meet it, [...]."""
    enters, leaves = np.zeros(begin.shape[:-1]), np.full(begin.shape[:-1], np.inf)
    apart2 = np.full(begin.shape[:-1], np.inf)
    for corner, following in zip(outline, np.roll(outline, -1, axis=0), strict=True):
        side = following - corner
        off = begin - corner
        share = np.clip(off @ side / (side @ side), 0.0, 1.0)
        apart2 = np.minimum(apart2, np.square(off - share[..., None] * side).sum(axis=-1))
        # To the left of every side is inside: how far it is there, and how fast the ray gets farther in.
        inside = side[0] * off[..., 1] - side[1] * off[..., 0]
        rate = side[0] * along[..., 1] - side[1] * along[..., 0]
        with np.errstate(divide="ignore", invalid="ignore"):
            crossing = -inside / rate
        enters = np.where(rate > 0.0, np.maximum(enters, crossing), enters)
        leaves = np.where(rate < 0.0, np.minimum(leaves, crossing), leaves)
        leaves = np.where((rate == 0.0) & (inside < 0.0), -np.inf, leaves)
    return np.sqrt(apart2), enters <= leaves
