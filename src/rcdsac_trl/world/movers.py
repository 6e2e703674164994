"""Moving obstacles: cylinders that walk closed tours between random places.

A mover is kinematic: nothing pushes it, it decides where it is. Its tour goes through a few random reachable
places and back to the first, along the planner's paths with rounded corners, so it never leaves the clearance
that was planned for it by more than :data:`CORNER_CUT_M`. Along the tour it accelerates and brakes within
bounds, slows down for bends, stops for the robot or another mover right in front of it, and turns back when
that does not go away. Only when the robot runs into its front does it stop at once.
"""

import math
from typing import Protocol

import numba
import numpy as np
from numpy.typing import NDArray

from rcdsac_trl.world.geometry import ROBOT_RADIUS_M
from rcdsac_trl.world.maps import Map

TOUR_PLACES = 3
"""Random places on a mover's tour."""
CORNER_CUT_M = 0.04
"""How far a rounded corner may lie from the planner's corner."""
MAX_ACCELERATION = 0.7
"""Bound on speeding up and braking, and again on turning, m/s^2; so both together stay within 1 m/s^2."""
STOP_GAP_M = 0.15
"""Gap in which a mover comes to stand before what is in front of it."""
PATIENCE_S = 3.0
"""How long a mover stands before it turns back."""
START_GAP_M = 1.0
"""Gap that a mover leaves to the robot (and 0.2 m to other movers) when it is placed."""

_PLACING_DRAWS = 50
_SIDE_GAP_M = 0.05
# The speed profile brakes a little more gently than the bound, which leaves room for its 0.02 s steps.
_PROFILE_ACCELERATION = 0.85 * MAX_ACCELERATION
_SMALLEST_BEND_M = 1e-3

# Columns of a tour: one row is one piece, a straight line or an arc.
_START, _END, _X, _Y, _HEADING, _CURVATURE, _SPEED2, _ENTRY_SPEED2, _EXIT_SPEED2 = range(9)
# Columns of the state: one row is one mover.
_ALONG, _SPEED, _DIRECTION, _WAITED = range(4)


class WalkPlanner(Protocol):
    """What movers need of :class:`rcdsac_trl.world.planner.Planner`."""

    def sample_mover_point(self, rng: np.random.Generator) -> NDArray[np.float64]:
        """Return a place [2] that every mover can reach, m."""
        ...

    def mover_path(self, start_xy: NDArray[np.float64], goal_xy: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return a path's corners, float64 [k, 2], m, without the start, the goal last."""
        ...


class Movers:
    """All movers of one simulation.

    Args:
        map: where they walk; its ``movers`` say how large and how fast they are.
        planner: the map's planner.
        robot_xy: where the robot starts, m; no mover starts near it.
        rng: stream that tours and starts are drawn from.
        period_s: duration of a step.

    Attributes:
        positions: float64 [k, 2], m.
        radii: float64 [k], m.
        fastest_m_per_s: the fastest mover's top speed, 0 without movers.
        notice_gap_m: gap to the robot beyond which no mover's walk depends on where the robot is.
    """

    def __init__(
        self,
        map: Map,
        planner: WalkPlanner,
        robot_xy: tuple[float, float],
        rng: np.random.Generator,
        period_s: float,
    ) -> None:
        self.radii = np.array([mover.radius for mover in map.movers], dtype=np.float64)
        self._top_speeds = np.array([mover.speed_m_per_s for mover in map.movers], dtype=np.float64)
        self._period_s = period_s
        self.fastest_m_per_s = float(self._top_speeds.max(initial=0.0))
        self.notice_gap_m = _notice_gap(self.fastest_m_per_s, period_s)
        self.positions = np.zeros((len(self.radii), 2))
        self._state = np.zeros((len(self.radii), 4))
        self._state[:, _DIRECTION] = 1.0
        tours = [make_tour(_tour_corners(planner, rng), period_s) for _ in self.radii]
        self._tours = np.concatenate(tours) if tours else np.empty((0, 9))
        self._first_piece = np.cumsum([0, *(len(tour) for tour in tours)])
        for number in range(len(self.radii)):
            self._place(number, robot_xy, rng)

    def step(self, robot_x: float, robot_y: float, periods: int = 1) -> float:
        """Move all movers by some periods.

        Args:
            robot_x: where the robot is, m.
            robot_y: where the robot is, m.
            periods: how many; the robot is taken to stand still meanwhile.

        Returns:
            The gap between the robot and the nearest mover afterwards, m, negative where they overlap; ``inf`` without
            movers.
        """
        if not len(self.radii):
            return math.inf
        gap_m: float = _walk(
            self._state,
            self.positions,
            self.radii,
            self._top_speeds,
            self._tours,
            self._first_piece,
            robot_x,
            robot_y,
            ROBOT_RADIUS_M,
            self._period_s,
            periods,
        )
        return gap_m

    def _place(self, number: int, robot_xy: tuple[float, float], rng: np.random.Generator) -> None:
        """Put a mover somewhere on its tour, away from the robot and from the movers placed before it."""
        tour = self._tours[self._first_piece[number] : self._first_piece[number + 1]]
        others = np.vstack([np.asarray(robot_xy), self.positions[:number]])
        reach = self.radii[number] + np.concatenate([[ROBOT_RADIUS_M + START_GAP_M], self.radii[:number] + 0.2])
        best, best_room = 0.0, -math.inf
        for _ in range(_PLACING_DRAWS):
            along = rng.uniform(0.0, tour[-1, _END])
            x, y, _ = _point_on(tour, 0, len(tour), along)
            room = float(np.min(np.hypot(*(others - (x, y)).T) - reach))
            if room > best_room:
                best, best_room = along, room
            if room >= 0.0:
                break
        self._state[number, _ALONG] = best
        self.positions[number] = _point_on(tour, 0, len(tour), best)[:2]


def _notice_gap(top_speed: float, period_s: float) -> float:
    """Return the gap that is too wide to slow a mover down, see :func:`_step`, and a centimetre for rounding."""
    lost = _PROFILE_ACCELERATION * period_s
    return STOP_GAP_M + ((top_speed + lost) ** 2 - lost**2) / (2.0 * _PROFILE_ACCELERATION) + 0.01


def _tour_corners(planner: WalkPlanner, rng: np.random.Generator) -> NDArray[np.float64]:
    """Return the corners of a closed tour through random places, float64 [n, 2]; the end is not repeated."""
    places = [planner.sample_mover_point(rng) for _ in range(TOUR_PLACES)]
    legs = [planner.mover_path(start, goal) for start, goal in zip(places, [*places[1:], places[0]], strict=True)]
    corners = np.concatenate(legs)
    distinct = np.hypot(*(corners - np.roll(corners, 1, axis=0)).T) > 1e-6
    return corners[distinct]


def make_tour(corners: NDArray[np.float64], period_s: float) -> NDArray[np.float64]:
    """Turn a closed polygon into lines and arcs with the speeds that bounded acceleration allows on them.

    Each corner is replaced by the largest arc that stays within :data:`CORNER_CUT_M` of it and uses at most
    half of either side. A corner too sharp for an arc is walked at a crawl that one period can turn.

    Args:
        corners: float64 [n, 2], n >= 2, m, consecutive ones distinct.
        period_s: duration of a step.

    Returns:
        float64 [pieces, 9], in walking order: where the piece starts and ends along the tour, m; x, y,
        heading and curvature (1/m, 0 for a line) at its start; the squared speed its bend allows; the
        squared speeds allowed at its start for who walks backwards and at its end for who walks forwards.
    """
    sides = np.roll(corners, -1, axis=0) - corners
    lengths = np.hypot(*sides.T)
    headings = np.arctan2(sides[:, 1], sides[:, 0])
    turns = np.remainder(headings - np.roll(headings, 1) + np.pi, 2.0 * np.pi) - np.pi  # at each side's start
    shortest = np.minimum(lengths, np.roll(lengths, 1))
    with np.errstate(divide="ignore"):
        cut_radius = CORNER_CUT_M / (1.0 / np.cos(turns / 2.0) - 1.0)
        side_radius = 0.5 * shortest / np.tan(np.abs(turns) / 2.0)
    bends = np.where(np.abs(turns) > 1e-6, np.minimum(cut_radius, side_radius), 0.0)
    bends[bends < _SMALLEST_BEND_M] = 0.0
    tangents = bends * np.tan(np.abs(turns) / 2.0, where=bends > 0.0, out=np.zeros_like(turns))

    pieces: list[list[float]] = []
    joint_speed2: list[float] = []  # squared speed at the start of each piece, as far as the joint limits it
    along = 0.0
    # Twice the crawl, for a half turn, and one period's speeding up are a change of 1 m/s^2 at most.
    crawl2 = (0.2 * MAX_ACCELERATION * period_s) ** 2
    for k, corner in enumerate(corners):
        sharp = bends[k] == 0.0 and abs(turns[k]) > 1e-6
        joint = crawl2 if sharp else math.inf
        if bends[k] > 0.0:
            back = headings[k] - turns[k]
            curvature = math.copysign(1.0 / bends[k], turns[k])
            x, y = corner - tangents[k] * np.array([math.cos(back), math.sin(back)])
            end = along + bends[k] * abs(turns[k])
            pieces.append([along, end, x, y, back, curvature, MAX_ACCELERATION * bends[k]])
            joint_speed2.append(joint)
            along = end
        length = lengths[k] - tangents[k] - tangents[(k + 1) % len(corners)]
        if length > 1e-9:
            x, y = corner + tangents[k] * np.array([math.cos(headings[k]), math.sin(headings[k])])
            pieces.append([along, along + length, x, y, headings[k], 0.0, math.inf])
            joint_speed2.append(joint)
            along += length
    return _with_speeds(np.array(pieces), np.array(joint_speed2))


def _with_speeds(pieces: NDArray[np.float64], joint_speed2: NDArray[np.float64]) -> NDArray[np.float64]:
    """Add to each piece the squared speeds at its ends that leave room to brake for what follows."""
    count = len(pieces)
    gain = 2.0 * _PROFILE_ACCELERATION * (pieces[:, _END] - pieces[:, _START])
    joint = np.minimum(joint_speed2, np.minimum(pieces[:, _SPEED2], np.roll(pieces[:, _SPEED2], 1)))
    entry, exit_ = joint.copy(), joint.copy()  # at the start of piece k: walking backwards, and forwards
    for k in [*range(count)] * 2:  # twice round: the tour is closed
        entry[(k + 1) % count] = min(entry[(k + 1) % count], entry[k] + gain[k])
        exit_[count - 1 - k] = min(exit_[count - 1 - k], exit_[(count - k) % count] + gain[count - 1 - k])
    return np.column_stack([pieces, entry, np.roll(exit_, -1)])


@numba.njit(cache=True)
def _piece_at(tours: np.ndarray, first: int, last: int, along: float) -> int:
    """Return the row in [first, last) of the piece on which the distance ``along`` lies."""
    while last - first > 1:
        middle = (first + last) // 2
        if tours[middle, _START] <= along:
            first = middle
        else:
            last = middle
    return first


@numba.njit(cache=True)
def _point_on(tours: np.ndarray, first: int, last: int, along: float) -> tuple[float, float, float]:
    """Return x, y and heading at a distance along the tour in rows [first, last)."""
    piece = tours[_piece_at(tours, first, last, along)]
    walked, heading, curvature = along - piece[_START], piece[_HEADING], piece[_CURVATURE]
    if curvature == 0.0:
        return piece[_X] + walked * math.cos(heading), piece[_Y] + walked * math.sin(heading), heading
    turned = heading + curvature * walked
    x = piece[_X] + (math.sin(turned) - math.sin(heading)) / curvature
    y = piece[_Y] - (math.cos(turned) - math.cos(heading)) / curvature
    return x, y, turned


@numba.njit(cache=True)
def _gap_ahead(x: float, y: float, cos: float, sin: float, other_x: float, other_y: float, reach: float) -> float:
    """Return how far one can walk straight on until within the side gap of a disc at distance ``reach``."""
    dx, dy = other_x - x, other_y - y
    forward, aside = dx * cos + dy * sin, dy * cos - dx * sin
    reach += _SIDE_GAP_M
    if forward <= 0.0 or abs(aside) >= reach:
        return math.inf
    return forward - math.sqrt(reach * reach - aside * aside)


@numba.njit(cache=True)
def _step(
    state: np.ndarray,
    positions: np.ndarray,
    radii: np.ndarray,
    top_speeds: np.ndarray,
    tours: np.ndarray,
    first_piece: np.ndarray,
    robot_x: float,
    robot_y: float,
    robot_radius: float,
    period_s: float,
) -> None:
    """Move all movers by one period, in place."""
    for k in range(len(radii)):
        first, last = first_piece[k], first_piece[k + 1]
        along, speed, direction = state[k, _ALONG], state[k, _SPEED], state[k, _DIRECTION]
        x, y, heading = _point_on(tours, first, last, along)
        cos, sin = direction * math.cos(heading), direction * math.sin(heading)

        gap = _gap_ahead(x, y, cos, sin, robot_x, robot_y, radii[k] + robot_radius)
        for other in range(len(radii)):
            if other != k:
                ox, oy = positions[other, 0], positions[other, 1]
                gap = min(gap, _gap_ahead(x, y, cos, sin, ox, oy, radii[k] + radii[other]))

        piece = tours[_piece_at(tours, first, last, along)]
        if direction > 0.0:
            limit2 = piece[_EXIT_SPEED2] + 2.0 * _PROFILE_ACCELERATION * (piece[_END] - along)
        else:
            limit2 = piece[_ENTRY_SPEED2] + 2.0 * _PROFILE_ACCELERATION * (along - piece[_START])
        free = max(gap - (STOP_GAP_M - _SIDE_GAP_M), 0.0)
        limit2 = min(limit2, 2.0 * _PROFILE_ACCELERATION * free)
        # The speed at which the limit still holds after this step, v^2 = limit^2 - 2 a v dt.
        lost = _PROFILE_ACCELERATION * period_s
        wanted = min(math.sqrt(lost * lost + limit2) - lost, math.sqrt(piece[_SPEED2]), top_speeds[k])
        change = MAX_ACCELERATION * period_s
        speed = min(max(wanted, speed - change), speed + change)
        rx, ry = robot_x - x, robot_y - y
        if rx * cos + ry * sin > 0.0 and math.hypot(rx, ry) <= radii[k] + robot_radius:
            speed = 0.0  # bumped into: without this it could crush the robot against a wall

        if speed > 0.0:
            state[k, _WAITED] = 0.0
        else:
            state[k, _WAITED] += period_s
            if state[k, _WAITED] >= PATIENCE_S:
                state[k, _WAITED] = 0.0
                state[k, _DIRECTION] = -direction
        along = (along + direction * speed * period_s) % tours[last - 1, _END]
        state[k, _ALONG], state[k, _SPEED] = along, speed
        positions[k, 0], positions[k, 1], _ = _point_on(tours, first, last, along)


@numba.njit(cache=True)
def _walk(
    state: np.ndarray,
    positions: np.ndarray,
    radii: np.ndarray,
    top_speeds: np.ndarray,
    tours: np.ndarray,
    first_piece: np.ndarray,
    robot_x: float,
    robot_y: float,
    robot_radius: float,
    period_s: float,
    periods: int,
) -> float:
    """Move all movers by some periods, in place; return the gap between the robot and the nearest one."""
    for _ in range(periods):
        _step(state, positions, radii, top_speeds, tours, first_piece, robot_x, robot_y, robot_radius, period_s)
    gap = math.inf
    for k in range(len(radii)):
        distance = math.hypot(positions[k, 0] - robot_x, positions[k, 1] - robot_y)
        gap = min(gap, distance - radii[k] - robot_radius)
    return gap
