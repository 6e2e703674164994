"""A way past what is known to stand: from a robot to a waypoint."""

import math

import numpy as np
from numpy.typing import NDArray

from rcdsac_trl.deploy.navigation.cost_to_go import cost_to_go, steepest_way
from rcdsac_trl.deploy.navigation.local_map import Clearances

Place = tuple[float, float]

# Side of a cell of the search, in cells of what is searched.
_COARSER = 2
# What a metre costs more where nothing is left beside the robot; it falls as a square to 0 at this gap, m.
_NEAR_PRICE, _NEAR_M = 3.0, 0.3
# What a metre costs through something: finite, since the robot itself may stand there, and more than any way around.
_BLOCKED_PRICE = 1000.0
# A way is blocked where it comes nearer than the robot's radius by more than this: half a cell and its diagonal.
_SLACK_M = 0.03
# Something stands on a target: so near to it will do, m. Followers of a path pass its corners within 0.5 m.
BESIDE_M = 0.45
# What a metre costs by which a way ends short of its target: as much as driving right beside something, so that it ends
# near to the target, and on this side of what stands there.
_SHORT_PRICE = 1.0 + _NEAR_PRICE


def is_clear(clearances: Clearances, start: Place, end: Place, radius_m: float) -> bool:
    """Return whether a disc can drive straight from a place to another, as far as the square reaches.

    A disc that is nearer to something where it begins must come no nearer.

    Args:
        clearances: what is known of a square.
        start: x and y in m, in the frame of the square.
        end: likewise.
        radius_m: of the disc.
    """
    steps = max(2, math.ceil(math.dist(start, end) / clearances.cell_m) + 1)
    gaps_m = _gaps_m(clearances, np.linspace(start, end, steps))
    known_m = gaps_m[np.isfinite(gaps_m)]
    return not len(known_m) or bool(known_m.min() >= min(radius_m - _SLACK_M, float(known_m[0])))


def _gaps_m(clearances: Clearances, places: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return how far places are from what is nearest, m, float64 [k]; ``inf`` outside of the square."""
    field_m = clearances.field_m
    cells = np.floor((places - clearances.corner) / clearances.cell_m).astype(np.intp)
    inside = ((cells >= 0) & (cells < len(field_m))).all(axis=1)
    gaps_m = np.full(len(places), np.inf)
    gaps_m[inside] = field_m[cells[inside, 1], cells[inside, 0]]
    return gaps_m


def plan_detour(clearances: Clearances, start: Place, target: Place, radius_m: float) -> list[Place]:
    """Return the corners of a way to a target past all that is known; [] if there is none.

    What is not known counts as free. Where something stands on the target, the way ends as near to it as it gets.

    Args:
        clearances: what is known of a square around the start.
        start: x and y in m, in the frame of the square.
        target: likewise.
        radius_m: of the circle that holds the robot.

    Returns:
        Without the start, x and y in m. The last is the target, or a place within :data:`BESIDE_M` of it.
    """
    gaps_m, grid = _coarser_gaps_m(clearances), (clearances.corner, _COARSER * clearances.cell_m)
    spare_m = gaps_m - radius_m
    prices = np.where(
        spare_m < 0.0, _BLOCKED_PRICE, 1.0 + _NEAR_PRICE * np.clip(1.0 - spare_m / _NEAR_M, 0.0, 1.0) ** 2
    )
    end = target
    if _gaps_m(clearances, np.array([target]))[0] < radius_m - _SLACK_M:
        from_start = cost_to_go(prices, *grid, start)
        end = _place_beside(target, np.where(spare_m < 0.0, np.inf, from_start), *grid)
    way = np.vstack([steepest_way(cost_to_go(prices, *grid, end), *grid, start), end])
    return _pulled(clearances, way, radius_m)


def _coarser_gaps_m(clearances: Clearances) -> NDArray[np.float64]:
    """Return how far the cells of the search are from what is nearest, m, float64 [n, n]."""
    n = len(clearances.field_m) // _COARSER
    field_m = clearances.field_m[: n * _COARSER, : n * _COARSER].astype(np.float64)
    return field_m.reshape(n, _COARSER, n, _COARSER).mean(axis=(1, 3))


def _place_beside(target: Place, costs: NDArray[np.float64], corner: Place, cell_m: float) -> Place:
    """Return the cell near a target at which a way to it ends at best; the target where none is free.

    Args:
        target: x and y in m.
        costs: of the way to each cell, ``inf`` where something stands, float64 [n, n], rows along y.
        corner: lower corner of the square, x and y in m.
        cell_m: side of a cell, m.
    """
    middles_m = (np.arange(len(costs)) + 0.5) * cell_m
    short_m = np.hypot(corner[0] + middles_m - target[0], (corner[1] + middles_m - target[1])[:, None])
    totals = np.where(short_m < BESIDE_M, costs + _SHORT_PRICE * short_m, np.inf)
    row, column = np.unravel_index(totals.argmin(), totals.shape)
    if not np.isfinite(totals[row, column]):
        return target
    return corner[0] + float(middles_m[column]), corner[1] + float(middles_m[row])


def _pulled(clearances: Clearances, way: NDArray[np.float64], radius_m: float) -> list[Place]:
    """Return the corners that a way needs to stay clear; [] where it leads through something."""
    places: list[Place] = [(x, y) for x, y in way.tolist()]
    at, corners = 0, []
    while at < len(places) - 1:
        seen = next(
            (k for k in range(len(places) - 1, at, -1) if is_clear(clearances, places[at], places[k], radius_m)), at
        )
        if seen == at:
            return []
        corners.append(places[seen])
        at = seen
    return corners
