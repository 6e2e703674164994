"""Compiled search on grids of free cells: components, the nearest free cell, cheapest paths.

A grid is bool [rows, columns], true where a cell is free. Cells have flat indices, row times columns plus
column, and eight neighbours: a diagonal step between free cells is safe whatever its other two cells are, see
:mod:`rcdsac_trl.world.maps.geometry`.
"""

import math

import numpy as np
from numpy.typing import NDArray

from rcdsac_trl.system.jit import njit

_SQRT2 = math.sqrt(2.0)


@njit
def nearest_cell(free: NDArray[np.bool_], x: float, y: float, cell_m: float) -> int:
    """Return the flat index of the free cell whose centre is nearest to a point, -1 when none is free."""
    rows, columns = free.shape
    at_row = min(max(int(y / cell_m), 0), rows - 1)
    at_column = min(max(int(x / cell_m), 0), columns - 1)
    reach = 2
    while True:
        best, nearest = np.inf, -1
        for row in range(max(at_row - reach, 0), min(at_row + reach + 1, rows)):
            dy = (row + 0.5) * cell_m - y
            for column in range(max(at_column - reach, 0), min(at_column + reach + 1, columns)):
                dx = (column + 0.5) * cell_m - x
                if free[row, column] and dx * dx + dy * dy < best:
                    best = dx * dx + dy * dy
                    nearest = row * columns + column
        # Whatever lies outside the window is farther away than this (from a point on the grid).
        if best < (reach * cell_m) ** 2 or reach >= max(rows, columns):
            return nearest
        reach *= 4


@njit
def label_components(free: NDArray[np.bool_]) -> tuple[NDArray[np.int32], int]:
    """Number the 8-connected components of the free cells 1, 2, ...; 0 is what is not free."""
    rows, columns = free.shape
    labels = np.zeros((rows, columns), np.int32)
    stack = np.empty(rows * columns, np.int32)
    count = 0
    for seed in range(rows * columns):
        if not free[seed // columns, seed % columns] or labels[seed // columns, seed % columns] > 0:
            continue
        count += 1
        labels[seed // columns, seed % columns] = count
        stack[0] = seed
        size = 1
        while size > 0:
            size -= 1
            row, column = stack[size] // columns, stack[size] % columns
            for r in range(max(row - 1, 0), min(row + 2, rows)):
                for c in range(max(column - 1, 0), min(column + 2, columns)):
                    if free[r, c] and labels[r, c] == 0:
                        labels[r, c] = count
                        stack[size] = r * columns + c
                        size += 1
    return labels, count


@njit
def keeps_connected(before: NDArray[np.bool_], after: NDArray[np.bool_]) -> bool:
    """Tell whether the cells free in both that are connected in ``before`` still are in ``after``."""
    old, num_old = label_components(before)
    new, _ = label_components(after)
    heir = np.zeros(num_old + 1, np.int32)
    for row in range(before.shape[0]):
        for column in range(before.shape[1]):
            if before[row, column] and after[row, column]:
                label = old[row, column]
                if heir[label] == 0:
                    heir[label] = new[row, column]
                elif heir[label] != new[row, column]:
                    return False
    return True


@njit
def _push(costs: NDArray[np.float64], nodes: NDArray[np.int32], size: int, cost: float, node: int) -> None:
    """Add an entry to a binary heap of ``size`` entries; ties go to the smaller node, so order is fixed."""
    i = size
    while i > 0:
        parent = (i - 1) >> 1
        if costs[parent] < cost or (costs[parent] == cost and nodes[parent] <= node):
            break
        costs[i], nodes[i] = costs[parent], nodes[parent]
        i = parent
    costs[i], nodes[i] = cost, node


@njit
def _pop(costs: NDArray[np.float64], nodes: NDArray[np.int32], size: int) -> int:
    """Remove the least entry of a binary heap of ``size`` entries and return its node."""
    least = nodes[0]
    cost, node = costs[size - 1], nodes[size - 1]
    i = 0
    while True:
        child = 2 * i + 1
        if child >= size - 1:
            break
        right = child + 1
        if right < size - 1 and (
            costs[right] < costs[child] or (costs[right] == costs[child] and nodes[right] < nodes[child])
        ):
            child = right
        if cost < costs[child] or (cost == costs[child] and node <= nodes[child]):
            break
        costs[i], nodes[i] = costs[child], nodes[child]
        i = child
    costs[i], nodes[i] = cost, node
    return least


@njit
def cheapest_path(free: NDArray[np.bool_], weight: NDArray[np.float64], start: int, goal: int) -> NDArray[np.int32]:
    """Return the cheapest 8-connected path over free cells by A*, both ends included.

    A step costs its length in cells times the mean weight of its two cells; no weight is below 1. Cells
    are flat indices, row times columns plus column; the path is empty when there is none.
    """
    rows, columns = free.shape
    goal_row, goal_column = goal // columns, goal % columns
    cost = np.full(rows * columns, np.inf)
    parent = np.full(rows * columns, -1, np.int32)
    # Inside a border that is closed from the beginning, no neighbour needs to be asked whether it exists.
    closed = np.ones((rows + 2, columns + 2), np.bool_)
    closed[1:-1, 1:-1] = ~free
    # A cell enters the open heap at most once for each of its 8 neighbours, in practice far less often.
    heap_costs = np.empty(rows * columns, np.float64)
    heap_nodes = np.empty(rows * columns, np.int32)
    cost[start] = 0.0
    closed[start // columns + 1, start % columns + 1] = False
    _push(heap_costs, heap_nodes, 0, 0.0, start)
    size = 1
    found = False
    while size > 0:
        node = _pop(heap_costs, heap_nodes, size)
        size -= 1
        row, column = node // columns, node % columns
        if closed[row + 1, column + 1]:
            continue
        closed[row + 1, column + 1] = True
        if node == goal:
            found = True
            break
        if size + 8 > heap_costs.size:
            heap_costs = np.concatenate((heap_costs, np.empty_like(heap_costs)))
            heap_nodes = np.concatenate((heap_nodes, np.empty_like(heap_nodes)))
        here, here_weight = cost[node], weight[row, column]
        for dr in (-1, 0, 1):
            for dc in (-1, 0, 1):
                if closed[row + 1 + dr, column + 1 + dc]:
                    continue
                r, c = row + dr, column + dc
                other = node + dr * columns + dc
                step = _SQRT2 if dr != 0 and dc != 0 else 1.0
                new_cost = here + step * 0.5 * (here_weight + weight[r, c])
                if new_cost < cost[other]:
                    cost[other] = new_cost
                    parent[other] = node
                    to_row, to_column = abs(r - goal_row), abs(c - goal_column)
                    heuristic = max(to_row, to_column) + (_SQRT2 - 1.0) * min(to_row, to_column)
                    _push(heap_costs, heap_nodes, size, new_cost + heuristic, other)
                    size += 1
    length = 0
    node = goal if found else -1
    while node >= 0:
        length += 1
        node = parent[node]
    path = np.empty(length, np.int32)
    node = goal
    for i in range(length - 1, -1, -1):
        path[i] = node
        node = parent[node]
    return path


@njit
def farthest_cell(free: NDArray[np.bool_], start: int) -> tuple[int, float]:
    """Return the cell that is farthest from another one, by steps over free cells, and how far, in cells.

    Args:
        free: bool [rows, columns].
        start: flat index of a free cell.
    """
    rows, columns = free.shape
    cost = np.full(rows * columns, np.inf)
    heap_costs = np.empty(rows * columns + 8, np.float64)
    heap_nodes = np.empty(rows * columns + 8, np.int32)
    cost[start] = 0.0
    _push(heap_costs, heap_nodes, 0, 0.0, start)
    size, farthest, most = 1, start, 0.0
    while size > 0:
        at = heap_costs[0]
        node = _pop(heap_costs, heap_nodes, size)
        size -= 1
        if at > cost[node]:
            continue
        farthest, most = node, at  # cells come in the order of their distance
        if size + 8 > heap_costs.size:
            heap_costs = np.concatenate((heap_costs, np.empty_like(heap_costs)))
            heap_nodes = np.concatenate((heap_nodes, np.empty_like(heap_nodes)))
        row, column = node // columns, node % columns
        for r in range(max(row - 1, 0), min(row + 2, rows)):
            for c in range(max(column - 1, 0), min(column + 2, columns)):
                new = at + (_SQRT2 if r != row and c != column else 1.0)
                if free[r, c] and new < cost[r * columns + c]:
                    cost[r * columns + c] = new
                    _push(heap_costs, heap_nodes, size, new, r * columns + c)
                    size += 1
    return farthest, most
