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


def is_clear(clearances: Clearances, start: Place, end: Place, radius_m: float) -> bool:
    """Return whether a disc can drive straight from a place to another, as far as the square reaches.

    A disc that is nearer to something where it begins must come no nearer.

    Args:
        clearances: what is known of a square.
        start: x and y in m, in the frame of the square.
        end: likewise.
        radius_m: of the disc.
    """
    field_m, cell_m = clearances.field_m, clearances.cell_m
    steps = max(2, math.ceil(math.dist(start, end) / cell_m) + 1)
    places = np.linspace(start, end, steps)
    cells = np.floor((places - clearances.corner) / cell_m).astype(np.intp)
    inside = ((cells >= 0) & (cells < len(field_m))).all(axis=1)
    if not inside.any():
        return True
    gaps = field_m[cells[inside, 1], cells[inside, 0]]
    return bool(gaps.min() >= min(radius_m - _SLACK_M, float(gaps[0])))


def plan_detour(clearances: Clearances, start: Place, target: Place, radius_m: float) -> list[Place]:
    """Return the corners of a way to a target past all that is known; [] if there is none.

    What is not known counts as free.

    Args:
        clearances: what is known of a square around the start.
        start: x and y in m, in the frame of the square.
        target: likewise.
        radius_m: of the circle that holds the robot.

    Returns:
        Without the start and with the target last, x and y in m.
    """
    cell_m = _COARSER * clearances.cell_m
    n = len(clearances.field_m) // _COARSER
    field_m = clearances.field_m[: n * _COARSER, : n * _COARSER].astype(np.float64)
    gaps = field_m.reshape(n, _COARSER, n, _COARSER).mean(axis=(1, 3)) - radius_m
    prices = np.where(gaps < 0.0, _BLOCKED_PRICE, 1.0 + _NEAR_PRICE * np.clip(1.0 - gaps / _NEAR_M, 0.0, 1.0) ** 2)
    values = cost_to_go(prices, clearances.corner, cell_m, target)
    way = np.vstack([steepest_way(values, clearances.corner, cell_m, start), target])
    return _pulled(clearances, way, radius_m)


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
