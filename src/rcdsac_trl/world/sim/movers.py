"""Moving obstacles: cylinders that walk closed tours between random places.

A mover is kinematic: nothing pushes it, it decides where it is. Its tour goes through a few random reachable
places and back to the first, along the planner's paths with rounded corners, so it never leaves the clearance
that was planned for it by more than :data:`CORNER_CUT_M`. Along the tour it accelerates and brakes within
bounds, slows down for bends, stops for the robot or another mover right in front of it, and turns back when
that does not go away. Only when the robot runs into its front does it stop at once; a mover that does not yield stops
for the robot then alone.
"""

import math
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from rcdsac_trl.world.maps.generator import Map
from rcdsac_trl.world.maps.geometry import ROBOT_RADIUS_M
from rcdsac_trl.world.sim.walk import (
    ALONG,
    DIRECTION,
    END,
    FIRST,
    LAST,
    MAX_ACCELERATION,
    PROFILE_ACCELERATION,
    SPEED2,
    START,
    TOP_SPEED,
    YIELDS,
    notice_gap,
    point_on,
    walk,
)

TOUR_PLACES = 3
"""Random places on a mover's tour."""
CORNER_CUT_M = 0.04
"""How far a rounded corner may lie from the planner's corner."""
START_GAP_M = 1.0
"""Gap that a mover leaves to the robot (and 0.2 m to other movers) when it is placed."""

_PLACING_DRAWS = 50
_SMALLEST_BEND_M = 1e-3


class WalkPlanner(Protocol):
    """What movers need of :class:`rcdsac_trl.world.maps.planner.Planner`."""

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
        robot_radius_m: circumradius of the robot.

    Attributes:
        discs: float64 [k, 3], x, y and radius of each, m; :meth:`step` moves them in place.
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
        robot_radius_m: float = ROBOT_RADIUS_M,
    ) -> None:
        self._robot_radius_m = robot_radius_m
        count = len(map.movers)
        self.discs = np.zeros((count, 3))
        self.discs[:, 2] = [mover.radius for mover in map.movers]
        self._walks = np.zeros((count, 8))
        self._walks[:, DIRECTION] = 1.0
        self._walks[:, TOP_SPEED] = [mover.speed_m_per_s for mover in map.movers]
        self._walks[:, YIELDS] = [mover.yields for mover in map.movers]
        self._period_s = period_s
        self.fastest_m_per_s = float(self._walks[:, TOP_SPEED].max(initial=0.0))
        self.notice_gap_m = notice_gap(self.fastest_m_per_s, period_s)
        tours = [make_tour(_tour_corners(planner, rng), period_s) for _ in range(count)]
        self._tours = np.concatenate(tours) if tours else np.empty((0, 9))
        ends = np.cumsum([0, *(len(tour) for tour in tours)])
        self._walks[:, FIRST], self._walks[:, LAST] = ends[:-1], ends[1:]
        for number in range(count):
            self._place(number, robot_xy, rng)

    @property
    def positions(self) -> NDArray[np.float64]:
        """Where they are, float64 [k, 2], m; a view of :attr:`discs`."""
        return self.discs[:, :2]

    @property
    def radii(self) -> NDArray[np.float64]:
        """Their radii, float64 [k], m; a view of :attr:`discs`."""
        return self.discs[:, 2]

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
        gap_m: float = walk(
            self._walks, self.discs, self._tours, robot_x, robot_y, self._robot_radius_m, self._period_s, periods
        )
        return gap_m

    def _place(self, number: int, robot_xy: tuple[float, float], rng: np.random.Generator) -> None:
        """Put a mover somewhere on its tour, away from the robot and from the movers placed before it."""
        tour = self._tours[int(self._walks[number, FIRST]) : int(self._walks[number, LAST])]
        others = np.vstack([np.asarray(robot_xy), self.positions[:number]])
        gaps = np.concatenate([[self._robot_radius_m + START_GAP_M], self.radii[:number] + 0.2])
        reach = self.radii[number] + gaps
        best, best_room = 0.0, -math.inf
        for _ in range(_PLACING_DRAWS):
            along = rng.uniform(0.0, tour[-1, END])
            x, y, _ = point_on(tour, 0, len(tour), along)
            room = float(np.min(np.hypot(*(others - (x, y)).T) - reach))
            if room > best_room:
                best, best_room = along, room
            if room >= 0.0:
                break
        self._walks[number, ALONG] = best
        self.positions[number] = point_on(tour, 0, len(tour), best)[:2]


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
    cut_after = np.roll(tangents, -1).tolist()
    # As plain numbers: single ones out of arrays are slow.
    columns = (array.tolist() for array in (*corners.T, lengths, headings, turns, bends, tangents))
    for (x, y, side, heading, turn, bend, cut), cut_end in zip(zip(*columns, strict=True), cut_after, strict=True):
        joint = crawl2 if bend == 0.0 and abs(turn) > 1e-6 else math.inf
        if bend > 0.0:
            back = heading - turn
            start = x - cut * math.cos(back), y - cut * math.sin(back)
            end = along + bend * abs(turn)
            pieces.append([along, end, *start, back, math.copysign(1.0 / bend, turn), MAX_ACCELERATION * bend])
            joint_speed2.append(joint)
            along = end
        length = side - cut - cut_end
        if length > 1e-9:
            start = x + cut * math.cos(heading), y + cut * math.sin(heading)
            pieces.append([along, along + length, *start, heading, 0.0, math.inf])
            joint_speed2.append(joint)
            along += length
    return _with_speeds(np.array(pieces), np.array(joint_speed2))


def _with_speeds(pieces: NDArray[np.float64], joint_speed2: NDArray[np.float64]) -> NDArray[np.float64]:
    """Add to each piece the squared speeds at its ends that leave room to brake for what follows."""
    count = len(pieces)
    # As plain numbers: single ones out of arrays are slow.
    gain = (2.0 * PROFILE_ACCELERATION * (pieces[:, END] - pieces[:, START])).tolist()
    joint = np.minimum(joint_speed2, np.minimum(pieces[:, SPEED2], np.roll(pieces[:, SPEED2], 1))).tolist()
    entry, exit_ = joint.copy(), joint.copy()  # at the start of piece k: walking backwards, and forwards
    for k in [*range(count)] * 2:  # twice round: the tour is closed
        after = k + 1 if k + 1 < count else 0
        entry[after] = min(entry[after], entry[k] + gain[k])
        back = count - 1 - k
        exit_[back] = min(exit_[back], exit_[(back + 1) % count] + gain[back])
    return np.column_stack([pieces, entry, [*exit_[1:], exit_[0]]])
