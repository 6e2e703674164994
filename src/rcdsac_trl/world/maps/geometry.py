"""Compiled plane geometry, shared by the map generator and the planner.

Shapes come as ``boxes`` float64 [n, 6] (x, y, half_x, half_y, cos yaw, sin yaw) and ``circles`` float64
[m, 3] (x, y, radius). Cell ``[row, column]`` of a grid has its centre at ``((column + 0.5) * cell_m,
(row + 0.5) * cell_m)``. Distances are exact and never rounded to the grid.

Why a path over free cells is safe: if the two ends of a leg of length L are at least d from a point, every
point between them is at least sqrt(d^2 - L^2 / 4) from it (Stewart's theorem); :func:`leg_clearance_m` is
that bound for the longest leg of a grid, the diagonal. So a leg between neighbouring free cells, diagonal
or not, never comes nearer than that to anything, whatever lies between the cells' centres.

What is compiled calls nothing compiled in another file: Numba's cache notices a change of the file that
holds a function, not of the files it calls into.
"""

import math

import numpy as np
from numpy.typing import NDArray

from rcdsac_trl.robot.robot_settings import PAPER
from rcdsac_trl.system.jit import njit

CELL_M = 0.1
"""Side of a grid cell, m."""

ROBOT_RADIUS_M = PAPER.circumradius_m
"""Circumradius of the paper's octagonal robot, m: whoever names no other radius means this one."""

_ROUNDING_M = 1e-9
_SLACK = 1.03  # a little cost is given for fewer corners, else many lie a step or two apart


def leg_clearance_m(clearance_m: float, cell_m: float = CELL_M) -> float:
    """Return the clearance of every leg between neighbouring cells of at least ``clearance_m``, m."""
    return math.sqrt(max(clearance_m**2 - 0.5 * cell_m**2, 0.0))


def least_margin_m(robot_radius_m: float, cell_m: float = CELL_M) -> float:
    """Return the least margin beyond a robot's radius with which no leg between free cells comes nearer than that, m.

    Example:
        >>> round(least_margin_m(0.25), 3), round(least_margin_m(0.05), 3)
        (0.01, 0.037)
    """
    return math.hypot(robot_radius_m, cell_m * math.sqrt(0.5)) - robot_radius_m


@njit
def _point_box(x: float, y: float, half_x: float, half_y: float) -> float:
    """Return the distance from a point in the box's frame to the solid box, 0 inside."""
    dx = max(abs(x) - half_x, 0.0)
    dy = max(abs(y) - half_y, 0.0)
    return math.sqrt(dx * dx + dy * dy)


@njit
def _point_segment(px: float, py: float, ax: float, ay: float, bx: float, by: float) -> float:
    dx, dy = bx - ax, by - ay
    length2 = dx * dx + dy * dy
    t = 0.0
    if length2 > 0.0:
        t = min(max(((px - ax) * dx + (py - ay) * dy) / length2, 0.0), 1.0)
    return math.hypot(ax + t * dx - px, ay + t * dy - py)


@njit
def _segment_enters_box(ax: float, ay: float, bx: float, by: float, hx: float, hy: float) -> bool:
    """Clip the segment a-b to the slab of each axis; something is left when it meets the solid box."""
    t0, t1 = 0.0, 1.0
    for start, delta, half in ((ax, bx - ax, hx), (ay, by - ay, hy)):
        if delta == 0.0:
            if abs(start) > half:
                return False
        else:
            u, v = (-half - start) / delta, (half - start) / delta
            t0, t1 = max(t0, min(u, v)), min(t1, max(u, v))
    return t0 <= t1


@njit
def _segment_box(ax: float, ay: float, bx: float, by: float, hx: float, hy: float) -> float:
    """Return the distance from a segment in the box's frame to the solid box."""
    if _segment_enters_box(ax, ay, bx, by, hx, hy):
        return 0.0
    # Two convex shapes that do not meet are nearest at a corner of one of them.
    best = min(_point_box(ax, ay, hx, hy), _point_box(bx, by, hx, hy))
    for sx in (-hx, hx):
        for sy in (-hy, hy):
            best = min(best, _point_segment(sx, sy, ax, ay, bx, by))
    return best


@njit
def segment_clearance(
    ax: float,
    ay: float,
    bx: float,
    by: float,
    boxes: NDArray[np.float64],
    circles: NDArray[np.float64],
    limit_m: float,
) -> float:
    """Return the exact distance from the segment a-b to the nearest solid shape, cut off at ``limit_m``.

    With ``a == b`` it is the clearance of a point.
    """
    best = limit_m
    for i in range(boxes.shape[0]):
        x, y, hx, hy, cos, sin = boxes[i]
        if _point_segment(x, y, ax, ay, bx, by) - math.sqrt(hx * hx + hy * hy) >= best:
            continue
        ux, uy = ax - x, ay - y
        vx, vy = bx - x, by - y
        distance = _segment_box(
            cos * ux + sin * uy, cos * uy - sin * ux, cos * vx + sin * vy, cos * vy - sin * vx, hx, hy
        )
        best = min(best, distance)
    for i in range(circles.shape[0]):
        distance = _point_segment(circles[i, 0], circles[i, 1], ax, ay, bx, by) - circles[i, 2]
        best = min(best, max(distance, 0.0))
    return best


@njit
def outline_clearance(
    corners: NDArray[np.float64],
    pose: tuple[float, float, float],
    boxes: NDArray[np.float64],
    circles: NDArray[np.float64],
    limit_m: float,
) -> float:
    """Return the exact distance from a body's outline to the nearest solid shape, cut off at ``limit_m``.

    Args:
        corners: of the body, in its own frame, [n, 2], m.
        pose: its x, y in m and yaw in rad.
        boxes: see the module.
        circles: see the module.
        limit_m: what is farther counts as this far.
    """
    x, y, yaw = pose
    cos, sin = math.cos(yaw), math.sin(yaw)
    best, n = limit_m, corners.shape[0]
    for i in range(n):
        a, b = corners[i], corners[(i + 1) % n]
        ax, ay = x + cos * a[0] - sin * a[1], y + sin * a[0] + cos * a[1]
        bx, by = x + cos * b[0] - sin * b[1], y + sin * b[0] + cos * b[1]
        best = min(best, segment_clearance(ax, ay, bx, by, boxes, circles, best))
    return best


@njit
def _is_clear(
    ax: float,
    ay: float,
    bx: float,
    by: float,
    boxes: NDArray[np.float64],
    extents: NDArray[np.float64],
    circles: NDArray[np.float64],
    need_m: float,
) -> bool:
    """Return whether :func:`segment_clearance` is ``need_m``, and stop at the first shape that is nearer.

    ``extents`` are the half sides of the boxes' bounding boxes, see :func:`_bounding_boxes`: most shapes are out of
    reach, which four comparisons show.
    """
    reach = need_m + _ROUNDING_M
    low_x, high_x = min(ax, bx) - reach, max(ax, bx) + reach
    low_y, high_y = min(ay, by) - reach, max(ay, by) + reach
    for i in range(boxes.shape[0]):
        x, y = boxes[i, 0], boxes[i, 1]
        ex, ey = extents[i, 0], extents[i, 1]
        if x + ex < low_x or x - ex > high_x or y + ey < low_y or y - ey > high_y:
            continue
        hx, hy, cos, sin = boxes[i, 2], boxes[i, 3], boxes[i, 4], boxes[i, 5]
        if _point_segment(x, y, ax, ay, bx, by) - math.sqrt(hx * hx + hy * hy) >= need_m:
            continue
        ux, uy = ax - x, ay - y
        vx, vy = bx - x, by - y
        if (
            _segment_box(cos * ux + sin * uy, cos * uy - sin * ux, cos * vx + sin * vy, cos * vy - sin * vx, hx, hy)
            < need_m
        ):
            return False
    for i in range(circles.shape[0]):
        x, y, radius = circles[i]
        if x + radius < low_x or x - radius > high_x or y + radius < low_y or y - radius > high_y:
            continue
        if max(_point_segment(x, y, ax, ay, bx, by) - radius, 0.0) < need_m:
            return False
    return True


@njit
def _bounding_boxes(boxes: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return half the sides [n, 2] of the axis-parallel boxes around boxes [n, 6]."""
    extents = np.empty((boxes.shape[0], 2))
    for i in range(boxes.shape[0]):
        hx, hy, cos, sin = boxes[i, 2], boxes[i, 3], abs(boxes[i, 4]), abs(boxes[i, 5])
        extents[i, 0] = cos * hx + sin * hy
        extents[i, 1] = sin * hx + cos * hy
    return extents


@njit
def lower_clearance(
    clearance: NDArray[np.float64],
    boxes: NDArray[np.float64],
    circles: NDArray[np.float64],
    reach_m: float,
    cell_m: float,
) -> None:
    """Lower each cell's clearance to its centre's exact distance to the given solid shapes, in place.

    Only the cells within ``reach_m`` of a shape are visited, so ``clearance`` is exact up to ``reach_m``.
    """
    rows, columns = clearance.shape
    for i in range(boxes.shape[0]):
        x, y, hx, hy, cos, sin = boxes[i]
        extent_x = abs(cos) * hx + abs(sin) * hy + reach_m
        extent_y = abs(sin) * hx + abs(cos) * hy + reach_m
        for row in range(max(int((y - extent_y) / cell_m), 0), min(int((y + extent_y) / cell_m) + 1, rows)):
            uy = (row + 0.5) * cell_m - y
            first = max(int((x - extent_x) / cell_m), 0)
            for column in range(first, min(int((x + extent_x) / cell_m) + 1, columns)):
                ux = (column + 0.5) * cell_m - x
                distance = _point_box(cos * ux + sin * uy, cos * uy - sin * ux, hx, hy)
                clearance[row, column] = min(clearance[row, column], distance)
    for i in range(circles.shape[0]):
        x, y, radius = circles[i]
        extent = radius + reach_m
        for row in range(max(int((y - extent) / cell_m), 0), min(int((y + extent) / cell_m) + 1, rows)):
            uy = (row + 0.5) * cell_m - y
            first = max(int((x - extent) / cell_m), 0)
            for column in range(first, min(int((x + extent) / cell_m) + 1, columns)):
                distance = max(math.hypot((column + 0.5) * cell_m - x, uy) - radius, 0.0)
                clearance[row, column] = min(clearance[row, column], distance)


@njit
def _leg_cost(ax: float, ay: float, bx: float, by: float, weight: NDArray[np.float64], cell_m: float) -> float:
    """Return the length of a straight leg times the mean weight under it, sampled twice a cell."""
    rows, columns = weight.shape
    length = math.hypot(bx - ax, by - ay)
    count = int(2.0 * length / cell_m) + 1
    total = 0.0
    for i in range(count):
        t = (i + 0.5) / count
        row = min(max(int((ay + t * (by - ay)) / cell_m), 0), rows - 1)
        column = min(max(int((ax + t * (bx - ax)) / cell_m), 0), columns - 1)
        total += weight[row, column]
    return length * total / count


@njit
def _surely_blocked(
    ax: float, ay: float, bx: float, by: float, field: NDArray[np.float64], need_m: float, cell_m: float
) -> bool:
    """Tell whether some cell under a straight leg shows that a shape is nearer to it than ``need_m``.

    No point is farther from the shapes than the centre of its cell is, and the way there. So true is certain, and false
    says nothing; and it takes as long however many shapes there are.
    """
    rows, columns = field.shape
    count = int(math.hypot(bx - ax, by - ay) / cell_m) + 1
    for i in range(1, count):
        x, y = ax + i / count * (bx - ax), ay + i / count * (by - ay)
        row = min(max(int(y / cell_m), 0), rows - 1)
        column = min(max(int(x / cell_m), 0), columns - 1)
        aside = math.hypot(x - (column + 0.5) * cell_m, y - (row + 0.5) * cell_m)
        if field[row, column] + aside < need_m - _ROUNDING_M:
            return True
    return False


@njit
def pull_tight(
    points: NDArray[np.float64],
    boxes: NDArray[np.float64],
    circles: NDArray[np.float64],
    field: NDArray[np.float64],
    weight: NDArray[np.float64],
    first_clearance_m: float,
    clearance_m: float,
    cell_m: float,
) -> NDArray[np.int64]:
    """Return the indices of the corners left when a path is pulled tight, the last point included.

    From each corner on, the next one is the farthest later point to which the straight leg keeps
    ``clearance_m`` (``first_clearance_m`` on the first leg) and costs hardly more than the stretch of path
    that it replaces. A corner's direct successor is always taken as seen. The first corner to see from is
    ``points[0]``, which is not among the returned ones.

    ``field`` holds the clearance of each cell's centre, exact or cut off above both clearances; it spares most legs the
    look at every shape, and changes no result.
    """
    count = points.shape[0]
    extents = _bounding_boxes(boxes)
    cost = np.zeros(count)
    for i in range(1, count):
        ax, ay = points[i - 1]
        bx, by = points[i]
        cost[i] = cost[i - 1] + _leg_cost(ax, ay, bx, by, weight, cell_m)
    corners = np.empty(count, np.int64)
    size = 0
    at = 0
    while at < count - 1:
        need = first_clearance_m if at == 0 else clearance_m
        ax, ay = points[at]
        nxt = count - 1
        while nxt > at + 1:
            bx, by = points[nxt]
            allowed = _SLACK * (cost[nxt] - cost[at])
            if (
                not _surely_blocked(ax, ay, bx, by, field, need, cell_m)
                and _is_clear(ax, ay, bx, by, boxes, extents, circles, need)
                and _leg_cost(ax, ay, bx, by, weight, cell_m) <= allowed
            ):
                break
            nxt -= 1
        corners[size] = nxt
        size += 1
        at = nxt
    return corners[:size]
