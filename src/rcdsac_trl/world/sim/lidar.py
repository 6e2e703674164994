"""The range sensor: the exact smallest distance in each 2-degree sector, to segments and circles.

The paper's range observation (section "States and Observations") is made of "the distance in meters to the
nearest obstacle in the angular range [2i-2, 2i) degrees". That is a minimum over a sector, not the length of
one ray: a ray through the sector's middle misses a thin leg beside it. Here the minimum is computed in closed
form, which is both exact and an order of magnitude faster than casting rays.
"""

import math

import numpy as np

from rcdsac_trl.robot.range_sensor import BIN_RAD, MAX_RANGE_M, NUM_BINS
from rcdsac_trl.system.jit import njit

TILE_M = 2.0
"""Side of the squares of :class:`NearSegments`, m."""

# Directions of the borders between the bins; border b is where bin b (from 0) begins.
_BORDER_COS = np.cos(np.arange(NUM_BINS) * BIN_RAD)
_BORDER_SIN = np.sin(np.arange(NUM_BINS) * BIN_RAD)


@njit
def _bin_of(angle: float) -> int:
    """Return the bin (from 0) of an angle in [-2 pi, 2 pi], rad."""
    if angle < 0.0:
        angle += 2.0 * math.pi
    # Rounding can carry an angle just below the full turn onto it.
    return int(angle / BIN_RAD) % NUM_BINS


@njit
def _add_segment(out: np.ndarray, px: float, py: float, qx: float, qy: float, max_range: float) -> None:
    """Lower ``out`` to the distances of the segment p-q, given in the sensor's frame."""
    ex, ey = qx - px, qy - py
    length2 = ex * ex + ey * ey
    # Nearest point of the segment to the sensor, as a fraction of the way from p to q.
    along = 0.0
    if length2 > 0.0:
        along = min(max(-(px * ex + py * ey) / length2, 0.0), 1.0)
    nx, ny = px + along * ex, py + along * ey
    near2 = nx * nx + ny * ny
    if near2 >= max_range * max_range:
        return
    cross = px * qy - py * qx
    if cross < 0.0:  # from here on q lies counter-clockwise of p
        px, py, qx, qy = qx, qy, px, py
        ex, ey, cross = -ex, -ey, -cross
    near = math.sqrt(near2)
    near_bin = _bin_of(math.atan2(ny, nx))
    # The nearest point rules its own bin. In every other bin the segment recedes from it, so the smallest
    # distance is at one of the two ends of the piece inside that bin: a border, or an end of the segment.
    out[near_bin] = min(out[near_bin], near)
    if cross <= 1e-12 * length2:  # seen end on (or a point): only the bin of its nearest point sees it
        return
    first, last = _bin_of(math.atan2(py, px)), _bin_of(math.atan2(qy, qx))
    out[first] = min(out[first], math.hypot(px, py))
    out[last] = min(out[last], math.hypot(qx, qy))
    span = (last - first) % NUM_BINS
    if span > NUM_BINS // 2:  # a sweep is below half a turn: rounding put `last` before `first`
        return
    bin_ = first
    for _ in range(span):
        border = bin_ + 1 if bin_ + 1 < NUM_BINS else 0
        # Where the border's ray meets the segment: distance * (direction x e) = p x e = cross.
        slope = _BORDER_COS[border] * ey - _BORDER_SIN[border] * ex
        if slope > 0.0:
            # Nearly end on, rounding can put the crossing before the nearest point.
            distance = max(cross / slope, near)
            out[bin_] = min(out[bin_], distance)
            out[border] = min(out[border], distance)
        bin_ = border


@njit
def _add_circle(out: np.ndarray, cx: float, cy: float, radius: float, max_range: float) -> None:
    """Lower ``out`` to the distances of a disc, given in the sensor's frame."""
    centre2 = cx * cx + cy * cy
    centre = math.sqrt(centre2)
    if centre - radius >= max_range:
        return
    if centre <= radius:  # inside the disc: it is at distance 0 in every direction
        out[:] = 0.0
        return
    angle = math.atan2(cy, cx)
    half_width = math.asin(radius / centre)  # angle between the centre and a tangent
    middle = _bin_of(angle)
    out[middle] = min(out[middle], centre - radius)
    # Away from the centre's direction the disc recedes, so a bin's smallest distance is at the border that
    # is nearer to the centre: the lower one on the left side, the upper one on the right side.
    last, first = _bin_of(angle + half_width), _bin_of(angle - half_width)
    free2 = centre2 - radius * radius  # squared length of the tangent
    bin_ = middle
    while bin_ != last:
        bin_ = bin_ + 1 if bin_ + 1 < NUM_BINS else 0
        _lower_to_ray(out, bin_, bin_, cx, cy, free2)
    bin_ = middle
    while bin_ != first:
        border = bin_
        bin_ = bin_ - 1 if bin_ > 0 else NUM_BINS - 1
        _lower_to_ray(out, bin_, border, cx, cy, free2)


@njit
def _lower_to_ray(out: np.ndarray, bin_: int, border: int, cx: float, cy: float, free2: float) -> None:
    """Lower one bin to where the ray along ``border`` first meets the disc."""
    projection = cx * _BORDER_COS[border] + cy * _BORDER_SIN[border]
    # At a tangent rounding can make the root's argument negative.
    distance = projection - math.sqrt(max(projection * projection - free2, 0.0))
    out[bin_] = min(out[bin_], distance)


@njit
def scan(
    out: np.ndarray,
    x: float,
    y: float,
    yaw: float,
    segments: np.ndarray,
    circles: np.ndarray,
    max_range_m: float = MAX_RANGE_M,
) -> float:
    """Write what :func:`sector_distances` returns to ``out``, and return the smallest of those distances.

    Compiled without fast-math, so that equal input gives equal bits on every call.
    """
    out[:] = np.inf
    cos, sin = math.cos(yaw), math.sin(yaw)
    for k in range(segments.shape[0]):
        x0, y0, x1, y1 = segments[k, 0] - x, segments[k, 1] - y, segments[k, 2] - x, segments[k, 3] - y
        # Most segments of a map are far away: these four comparisons spare them everything else.
        if (
            min(x0, x1) >= max_range_m
            or max(x0, x1) <= -max_range_m
            or min(y0, y1) >= max_range_m
            or max(y0, y1) <= -max_range_m
        ):
            continue
        _add_segment(
            out,
            cos * x0 + sin * y0,
            cos * y0 - sin * x0,
            cos * x1 + sin * y1,
            cos * y1 - sin * x1,
            max_range_m,
        )
    for k in range(circles.shape[0]):
        dx, dy = circles[k, 0] - x, circles[k, 1] - y
        _add_circle(out, cos * dx + sin * dy, cos * dy - sin * dx, circles[k, 2], max_range_m)
    nearest = np.inf
    for k in range(NUM_BINS):
        if out[k] >= max_range_m:
            out[k] = np.inf
        nearest = min(nearest, out[k])
    return nearest


def sector_distances(
    x: float,
    y: float,
    yaw: float,
    segments: np.ndarray,
    circles: np.ndarray,
    max_range_m: float = MAX_RANGE_M,
) -> np.ndarray:
    """Return the exact smallest distance to any obstacle in each 2-degree sector.

    Args:
        x: position of the sensor, map frame, m.
        y: position of the sensor, map frame, m.
        yaw: direction of the sensor's x axis, rad counter-clockwise from the map's x axis.
        segments: float64 [n, 4], each row the ends (x0, y0, x1, y1), m.
        circles: float64 [m, 3], each row a disc (x, y, radius), m.
        max_range_m: obstacles at this distance or beyond are left out.

    Returns:
        float64 [180]: the distance in m; ``inf`` where nothing is within range. Index 0 is the paper's bin 1,
        [0, 2) degrees counter-clockwise from the sensor's x axis.

    Example:
        >>> wall = np.array([[2.0, -1.0, 2.0, 1.0]])
        >>> float(sector_distances(0.0, 0.0, 0.0, wall, np.empty((0, 3)))[0])
        2.0
    """
    distances = np.empty(NUM_BINS)
    scan(distances, x, y, yaw, segments, circles, max_range_m)
    return distances


class NearSegments:
    """The segments of a map, by place: what can be within range from a square of the floor is picked out once.

    A scan of what :meth:`near` returns is bit for bit the scan of all segments, since a sector's distance is a minimum
    in which what is out of range has no part.

    Args:
        segments: float64 [n, 4], each row the ends (x0, y0, x1, y1), m.
        max_range_m: of the scans.

    Example:
        >>> walls = NearSegments(np.array([[2.0, -1.0, 2.0, 1.0], [40.0, -1.0, 40.0, 1.0]]))
        >>> walls.near(0.0, 0.0).tolist()
        [[2.0, -1.0, 2.0, 1.0]]
    """

    def __init__(self, segments: np.ndarray, max_range_m: float = MAX_RANGE_M) -> None:
        self._segments = np.ascontiguousarray(segments, dtype=np.float64)
        ends = self._segments.reshape(-1, 2, 2)
        self._low, self._high = ends.min(axis=1) - max_range_m, ends.max(axis=1) + max_range_m
        self._tiles: dict[tuple[int, int], np.ndarray] = {}

    def near(self, x: float, y: float) -> np.ndarray:
        """Return all segments that can be within range of a point, in their order, float64 [k, 4].

        Args:
            x: of the point, m.
            y: likewise.
        """
        tile = math.floor(x / TILE_M), math.floor(y / TILE_M)
        if tile not in self._tiles:
            corner = TILE_M * np.array(tile)
            within = (self._low <= corner + TILE_M).all(axis=1) & (self._high >= corner).all(axis=1)
            self._tiles[tile] = self._segments[within]
        return self._tiles[tile]
