"""Occupied cells as few rectangles: what walls of cells become, for the physics as for the planner and the sensor."""

import numpy as np
from numpy.typing import NDArray

from rcdsac_trl.system.jit import njit


@njit
def _growth(
    occupied: NDArray[np.bool_], covered: NDArray[np.bool_], row: int, column: int, wide: bool
) -> tuple[int, int, int]:
    """Grow a rectangle from a cell, to the right and then up if it is to be wide, else the other way round.

    Returns its end row and end column, both excluded, and how many cells it covers that were not covered.
    """
    rows, columns = occupied.shape
    end_row, end_column = row + 1, column + 1
    for axis in range(2):
        if (axis == 0) == wide:
            while end_column < columns and occupied[row:end_row, end_column].all():
                end_column += 1
        else:
            while end_row < rows and occupied[end_row, column:end_column].all():
                end_row += 1
    new = (end_row - row) * (end_column - column) - covered[row:end_row, column:end_column].sum()
    return end_row, end_column, new


@njit
def rectangles(occupied: NDArray[np.bool_]) -> NDArray[np.int64]:
    """Return rectangles that cover exactly the occupied cells; they may overlap.

    Greedy: from the first cell that is not covered, the one of two rectangles that covers more that is not.

    Args:
        occupied: bool [rows, columns].

    Returns:
        int64 [n, 4]: first row, first column, end row and end column (both excluded) of each.

    Example:
        >>> rectangles(np.array([[True, True, True], [False, True, False]])).tolist()
        [[0, 0, 1, 3], [1, 1, 2, 2]]
    """
    rows, columns = occupied.shape
    covered = np.zeros_like(occupied)
    found = np.empty((16, 4), np.int64)
    count = 0
    for row in range(rows):
        for column in range(columns):
            if not occupied[row, column] or covered[row, column]:
                continue
            end_row, end_column, new = _growth(occupied, covered, row, column, True)
            high_row, high_column, high_new = _growth(occupied, covered, row, column, False)
            if high_new > new:
                end_row, end_column = high_row, high_column
            covered[row:end_row, column:end_column] = True
            if count == len(found):
                found = np.concatenate((found, np.empty_like(found)))
            found[count] = row, column, end_row, end_column
            count += 1
    return found[:count]
