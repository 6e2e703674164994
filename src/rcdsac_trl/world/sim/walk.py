"""How a mover walks its tour, compiled: places on a tour, and the steps of all movers of a simulation.

All that the compiled code uses stands in this file: Numba's cache notices no change of another one.
"""

import math

import numpy as np

from rcdsac_trl.system.jit import njit

MAX_ACCELERATION = 0.7
"""Bound on speeding up and braking, and again on turning, m/s^2; so both together stay within 1 m/s^2."""
STOP_GAP_M = 0.15
"""Gap in which a mover comes to stand before what is in front of it."""
PATIENCE_S = 3.0
"""How long a mover stands before it turns back."""
PROFILE_ACCELERATION = 0.85 * MAX_ACCELERATION
"""At which the speed profile brakes, m/s^2: a little below the bound, which leaves room for the 0.02 s steps."""

_SIDE_GAP_M = 0.05

# Columns of a tour: one row is one piece, a straight line or an arc.
START, END, X, Y, HEADING, CURVATURE, SPEED2, ENTRY_SPEED2, EXIT_SPEED2 = range(9)
# Columns of the walks: one row is one mover. FIRST and LAST are the rows of its tour, as floats.
ALONG, SPEED, DIRECTION, WAITED, TOP_SPEED, FIRST, LAST, YIELDS = range(8)


def notice_gap(top_speed: float, period_s: float) -> float:
    """Return the gap that is too wide to slow a mover down, see :func:`_step`, and a centimetre for rounding, m."""
    lost = PROFILE_ACCELERATION * period_s
    return STOP_GAP_M + ((top_speed + lost) ** 2 - lost**2) / (2.0 * PROFILE_ACCELERATION) + 0.01


@njit
def _piece_at(tours: np.ndarray, first: int, last: int, along: float) -> int:
    """Return the row in [first, last) of the piece on which the distance ``along`` lies."""
    while last - first > 1:
        middle = (first + last) // 2
        if tours[middle, START] <= along:
            first = middle
        else:
            last = middle
    return first


@njit
def point_on(tours: np.ndarray, first: int, last: int, along: float) -> tuple[float, float, float]:
    """Return x, y and heading at a distance along the tour in rows [first, last)."""
    piece = tours[_piece_at(tours, first, last, along)]
    walked, heading, curvature = along - piece[START], piece[HEADING], piece[CURVATURE]
    if curvature == 0.0:
        return piece[X] + walked * math.cos(heading), piece[Y] + walked * math.sin(heading), heading
    turned = heading + curvature * walked
    x = piece[X] + (math.sin(turned) - math.sin(heading)) / curvature
    y = piece[Y] - (math.cos(turned) - math.cos(heading)) / curvature
    return x, y, turned


@njit
def _gap_ahead(x: float, y: float, cos: float, sin: float, other_x: float, other_y: float, reach: float) -> float:
    """Return how far one can walk straight on until within the side gap of a disc at distance ``reach``."""
    dx, dy = other_x - x, other_y - y
    forward, aside = dx * cos + dy * sin, dy * cos - dx * sin
    reach += _SIDE_GAP_M
    if forward <= 0.0 or abs(aside) >= reach:
        return math.inf
    return forward - math.sqrt(reach * reach - aside * aside)


@njit
def _step(
    k: int,
    walks: np.ndarray,
    discs: np.ndarray,
    tours: np.ndarray,
    robot_x: float,
    robot_y: float,
    robot_radius: float,
    period_s: float,
) -> None:
    """Move mover ``k`` by one period, in place."""
    first, last = int(walks[k, FIRST]), int(walks[k, LAST])
    along, speed, direction = walks[k, ALONG], walks[k, SPEED], walks[k, DIRECTION]
    radius = discs[k, 2]
    x, y, heading = point_on(tours, first, last, along)
    cos, sin = direction * math.cos(heading), direction * math.sin(heading)

    gap = math.inf
    if walks[k, YIELDS] != 0.0:
        gap = _gap_ahead(x, y, cos, sin, robot_x, robot_y, radius + robot_radius)
    for other in range(len(discs)):
        if other != k:
            gap = min(gap, _gap_ahead(x, y, cos, sin, discs[other, 0], discs[other, 1], radius + discs[other, 2]))

    piece = tours[_piece_at(tours, first, last, along)]
    if direction > 0.0:
        limit2 = piece[EXIT_SPEED2] + 2.0 * PROFILE_ACCELERATION * (piece[END] - along)
    else:
        limit2 = piece[ENTRY_SPEED2] + 2.0 * PROFILE_ACCELERATION * (along - piece[START])
    free = max(gap - (STOP_GAP_M - _SIDE_GAP_M), 0.0)
    limit2 = min(limit2, 2.0 * PROFILE_ACCELERATION * free)
    # The speed at which the limit still holds after this step, v^2 = limit^2 - 2 a v dt.
    lost = PROFILE_ACCELERATION * period_s
    wanted = min(math.sqrt(lost * lost + limit2) - lost, math.sqrt(piece[SPEED2]), walks[k, TOP_SPEED])
    change = MAX_ACCELERATION * period_s
    speed = min(max(wanted, speed - change), speed + change)
    rx, ry = robot_x - x, robot_y - y
    if rx * cos + ry * sin > 0.0 and math.hypot(rx, ry) <= radius + robot_radius:
        speed = 0.0  # bumped into: without this it could crush the robot against a wall

    if speed > 0.0:
        walks[k, WAITED] = 0.0
    else:
        walks[k, WAITED] += period_s
        if walks[k, WAITED] >= PATIENCE_S:
            walks[k, WAITED] = 0.0
            walks[k, DIRECTION] = -direction
    along = (along + direction * speed * period_s) % tours[last - 1, END]
    walks[k, ALONG], walks[k, SPEED] = along, speed
    discs[k, 0], discs[k, 1], _ = point_on(tours, first, last, along)


@njit
def walk(
    walks: np.ndarray,
    discs: np.ndarray,
    tours: np.ndarray,
    robot_x: float,
    robot_y: float,
    robot_radius: float,
    period_s: float,
    periods: int,
) -> float:
    """Move all movers by some periods.

    Args:
        walks: float64 [k, 8], one row a mover, columns as above; changed in place.
        discs: float64 [k, 3], x, y and radius of each, m; changed in place.
        tours: float64 [pieces, 9], the pieces of all tours.
        robot_x: where the robot stands, m.
        robot_y: where the robot stands, m.
        robot_radius: the robot's, m.
        period_s: duration of a period.
        periods: how many.

    Returns:
        The gap between the robot and the nearest mover, m; ``inf`` without movers.
    """
    for _ in range(periods):
        for k in range(len(discs)):
            _step(k, walks, discs, tours, robot_x, robot_y, robot_radius, period_s)
    gap = math.inf
    for k in range(len(discs)):
        distance = math.hypot(discs[k, 0] - robot_x, discs[k, 1] - robot_y)
        gap = min(gap, distance - discs[k, 2] - robot_radius)
    return gap
