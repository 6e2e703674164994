"""How far it is to a waypoint, around what a local map holds."""

import math

import numpy as np
from numpy.typing import NDArray

from rcdsac_trl.system.jit import njit

_FAR_M = 1e9
# Cells this near to the target begin with their straight distance.
_AT_TARGET_M = 0.15
_SETTLED_M = 1e-3
_MAX_ROUNDS = 8


def cost_to_go(
    price: NDArray[np.float64], corner: tuple[float, float], cell_m: float, target: tuple[float, float]
) -> NDArray[np.float64]:
    """Return the cheapest way from each cell to a target, in metres at the price of open space.

    It solves the eikonal equation ``|grad V| = price`` by fast sweeping (Zhao 2005), so ways run at any angle. What is
    outside of the square is not known: from its border on, the way to the target counts as straight and free.

    Args:
        price: what a metre costs in each cell, at least 1, float64 [n, n], rows along y.
        corner: lower corner of the square, x and y in m.
        cell_m: side of a cell, m.
        target: x and y in m.

    Returns:
        float64 [n, n], for the middles of the cells.

    Example:
        >>> open_space = np.ones((21, 21))
        >>> values = cost_to_go(open_space, (0.0, 0.0), 0.1, (10.0, 1.05))
        >>> round(float(values[10, 10]), 2)
        8.95
    """
    values = np.empty_like(price)
    _sweep(values, price, *corner, cell_m, *target)
    return values


@njit
def _sweep(
    values: np.ndarray, price: np.ndarray, x0: float, y0: float, cell_m: float, target_x: float, target_y: float
) -> None:
    n = values.shape[0]
    for i in range(n):
        for j in range(n):
            straight_m = math.hypot(x0 + (j + 0.5) * cell_m - target_x, y0 + (i + 0.5) * cell_m - target_y)
            if straight_m < _AT_TARGET_M:
                values[i, j] = straight_m
            elif i == 0 or j == 0 or i == n - 1 or j == n - 1:
                # What is in the way at the border goes on for a metre.
                values[i, j] = straight_m + price[i, j] - 1.0
            else:
                values[i, j] = _FAR_M
    for _ in range(_MAX_ROUNDS):
        change = 0.0
        for sweep in range(4):
            for step_i in range(1, n - 1):
                i = step_i if sweep < 2 else n - 1 - step_i
                for step_j in range(1, n - 1):
                    j = step_j if sweep % 2 == 0 else n - 1 - step_j
                    across = min(values[i, j - 1], values[i, j + 1])
                    along = min(values[i - 1, j], values[i + 1, j])
                    step_m = price[i, j] * cell_m
                    apart = abs(across - along)
                    if apart >= step_m:
                        value = min(across, along) + step_m
                    else:
                        value = 0.5 * (across + along + math.sqrt(2.0 * step_m * step_m - apart * apart))
                    if value < values[i, j]:
                        change = max(change, values[i, j] - value)
                        values[i, j] = value
        if change < _SETTLED_M:
            return


def steepest_way(
    values: NDArray[np.float64], corner: tuple[float, float], cell_m: float, start: tuple[float, float]
) -> NDArray[np.float64]:
    """Return the way from a start down :func:`cost_to_go`, to the target's cell or out of the square.

    Args:
        values: of :func:`cost_to_go`, float64 [n, n].
        corner: lower corner of the square, x and y in m.
        cell_m: side of a cell, m.
        start: x and y in m, in the square.

    Returns:
        The start and the middles of cells, float64 [k, 2], m.

    Example:
        >>> values = cost_to_go(np.ones((21, 21)), (0.0, 0.0), 0.1, (1.05, 1.05))
        >>> steepest_way(values, (0.0, 0.0), 0.1, (0.85, 1.05)).round(2).tolist()
        [[0.85, 1.05], [0.95, 1.05], [1.05, 1.05]]
    """
    places = np.empty((values.size, 2))
    return places[: _descend(places, values, *corner, cell_m, *start)].copy()


@njit
def _descend(
    places: np.ndarray, values: np.ndarray, x0: float, y0: float, cell_m: float, start_x: float, start_y: float
) -> int:
    n = values.shape[0]
    i, j = math.floor((start_y - y0) / cell_m), math.floor((start_x - x0) / cell_m)
    places[0, 0], places[0, 1] = start_x, start_y
    number = 1
    while 0 < i < n - 1 and 0 < j < n - 1:
        best_i, best_j, steepest = i, j, 0.0
        for di in range(-1, 2):
            for dj in range(-1, 2):
                if di == 0 and dj == 0:
                    continue
                slope = (values[i, j] - values[i + di, j + dj]) / math.hypot(di, dj)
                if slope > steepest:
                    best_i, best_j, steepest = i + di, j + dj, slope
        if best_i == i and best_j == j:
            break
        i, j = best_i, best_j
        places[number, 0], places[number, 1] = x0 + (j + 0.5) * cell_m, y0 + (i + 0.5) * cell_m
        number += 1
    return number
