"""What stands between an agent and the wheels: a speed limit and a stop zone that know nothing of the agent.

The stop zone is the way the robot would still go if it did what it is told for one more reaction time and then braked:
the whole way must keep its distance from everything that the range sensor sees. What lies behind an obstacle counts as
obstacle. Where the wish leads into it at any speed, the robot creeps along beside it, or turns until it can.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rcdsac_trl.errors import UserInputError
from rcdsac_trl.robot.latency import Ahead, at_once
from rcdsac_trl.robot.planar import placed
from rcdsac_trl.robot.range_sensor import BIN_RAD, NUM_BINS
from rcdsac_trl.robot.robot_settings import PAPER, RobotSettings
from rcdsac_trl.robot.sectors import Sectors, check_switches
from rcdsac_trl.robot.sensed_distances import outline_distances, place_distances, sensed_within
from rcdsac_trl.robot.stopping_path import STEP_S, stopping_paths

# Shares of the wanted speed that are tried, the fastest first.
SHARES = (1.0, 0.75, 0.5, 0.25)
# What is in a sector may be anywhere in it, so a wall beside the robot looks up to this much nearer farther on: who is
# within the margin may seem to come so much nearer, but never below the least that must stay.
BLUR_M = 0.01
LEAST_M = 0.01
_STANDING = at_once((0.0, 0.0))
# Half the angle ahead (or behind) in which something must be sensed at all before the robot moves that way.
_WAY_RAD = math.radians(30.0)

# Limits beyond these are in another unit (mm/s, degrees/s, mm, ms), and would limit nothing or stop everything.
_LARGEST = {
    "max_speed_m_per_s": 2.0,
    "max_reverse_m_per_s": 2.0,
    "max_turn_rad_per_s": 2.0 * math.pi,
    "radius_m": 2.0,
    "margin_m": 2.0,
    "reaction_s": 5.0,
}
# Turns that are tried where the wanted one leads into the stop zone, shares of the fastest.
_TURNS = np.linspace(-1.0, 1.0, 9)
# On a way that nobody asked for the robot creeps at most so fast, m/s; a way that allows less than this share of it
# often leads only to the last centimetre.
_CREEP_M_PER_S, _WORTH_IT = 0.2, 0.5
# The robot turns away from what it cannot pass at this share of its fastest turn, by headings so many sectors apart.
_TURN_SHARE, _HEADING_BINS = 0.5, 5
# Beside where the robot has been, its edge may come by this much: what the places between two calls leave open.
_BESIDE_M = 0.004
_EDGE = np.stack(
    (np.cos(np.arange(0.0, 2.0 * math.pi, math.pi / 12)), np.sin(np.arange(0.0, 2.0 * math.pi, math.pi / 12))), axis=1
)

_MIDDLES = (np.arange(NUM_BINS) * BIN_RAD + math.pi) % (2.0 * math.pi) - math.pi + BIN_RAD / 2.0
_AHEAD = np.abs(_MIDDLES) < _WAY_RAD
_BEHIND = np.abs(_MIDDLES) > math.pi - _WAY_RAD


@dataclass(frozen=True)
class Guard:
    """Limits that no command of an agent leaves.

    The defaults are those of the paper's robot; :meth:`of` takes them from another one.

    Attributes:
        max_speed_m_per_s: forwards.
        max_reverse_m_per_s: backwards, as a positive number.
        max_turn_rad_per_s: either way.
        radius_m: of the circle around the robot's centre that holds the robot. A robot that is not nearly round, such
            as a rectangle, is guarded by its outline instead, unless this circle is larger than it needs: then it is
            taken to hold what the robot carries.
        margin_m: what is kept between that circle, or outline, and everything that is sensed. Who is nearer may drive
            along it or away from it, and nearer by 1 cm a call, the blur of a sector, until 1 cm is left.
        reaction_s: how long a command may act until the next one does.
        blind_reverse: whether the robot may drive backwards (or forwards) where it senses nothing at all.
        evade: whether it may turn otherwise than it was told where it would stand for good: it creeps along beside what
            is in the way, or turns on the spot until it can.
        robot: which one it is; how fast it speeds up and brakes, and its outline, count.

    Raises:
        UserInputError: if a limit is negative, the radius is not positive, or one is too large for its unit.

    Example:
        >>> wall = Sectors(np.full(NUM_BINS, 0.31), np.ones(NUM_BINS, dtype=bool))
        >>> Guard().limit(0.6, 0.0, wall)[:2]
        (0.0, 0.0)
    """

    max_speed_m_per_s: float = PAPER.max_speed_m_per_s
    max_reverse_m_per_s: float = PAPER.max_reverse_m_per_s
    max_turn_rad_per_s: float = PAPER.max_angular_velocity
    radius_m: float = PAPER.circumradius_m
    margin_m: float = 0.05
    reaction_s: float = 0.25
    blind_reverse: bool = False
    evade: bool = True
    robot: RobotSettings = PAPER

    def __post_init__(self) -> None:
        """Refuse what is no limit."""
        check_switches(self, "blind_reverse", "evade")
        _check_robot(self.robot)
        for name in ("max_speed_m_per_s", "max_reverse_m_per_s", "max_turn_rad_per_s", "margin_m", "reaction_s"):
            if not 0.0 <= getattr(self, name) < math.inf:
                raise UserInputError(f"{name}={getattr(self, name)} of the guard must be a number of 0 or more")
        if not 0.0 < self.radius_m < math.inf:
            raise UserInputError(f"radius_m={self.radius_m} of the guard must be a positive number of metres")
        for name, largest in _LARGEST.items():
            if getattr(self, name) > largest:
                raise UserInputError(
                    f"{name}={getattr(self, name):g} of the guard is above {largest:.3g}: give metres, seconds, radians"
                )

    @classmethod
    def of(cls, robot: RobotSettings, **changes: Any) -> "Guard":
        """Return the guard of a robot: its limits, its shape.

        Args:
            robot: which one it is.
            changes: fields that are to be otherwise.

        Example:
            >>> from rcdsac_trl.robot.robot_settings import PAPER
            >>> Guard.of(PAPER, margin_m=0.1) == Guard(margin_m=0.1)
            True
        """
        _check_robot(robot)
        limits: dict[str, Any] = {
            "max_speed_m_per_s": robot.max_speed_m_per_s,
            "max_reverse_m_per_s": robot.max_reverse_m_per_s,
            "max_turn_rad_per_s": robot.max_angular_velocity,
            "radius_m": robot.circumradius_m,
        }
        return cls(**{**limits, **changes, "robot": robot})

    def later(self, late_s: float) -> "Guard":
        """Return this guard for input that is so much older: the robot has driven on since, and still does.

        Example:
            >>> round(Guard().later(0.3).reaction_s, 2)
            0.55
        """
        return replace(self, reaction_s=min(self.reaction_s + late_s, _LARGEST["reaction_s"])) if late_s else self

    def limit(
        self,
        v: float,
        omega: float,
        sectors: Sectors,
        moving: tuple[float, float] = (0.0, 0.0),
        been: NDArray[np.float64] | None = None,
        ahead: Ahead | None = None,
    ) -> tuple[float, float, str | None]:
        """Return the velocities that may be driven, and why they are not those that were wanted.

        The linear velocity is lowered, to 0 if need be. Where it would be 0, and the robot may evade, it creeps with
        another turn, the nearest to the wish that keeps the stop zone free; where there is none, it turns towards the
        nearest heading in which there is. A disc may always turn on the spot; whose outline is guarded, as fast as no
        corner swings into the stop zone.

        Args:
            v: wanted linear velocity, m/s.
            omega: wanted angular velocity, rad/s.
            sectors: what the range sensor sees, all of it, not just what the agent sees.
            moving: measured velocities, m/s and rad/s.
            been: where the robot's centre has been while it drove ahead, [k, 2], m, in its frame now: nothing stands
                there, so it may drive back that way without sensing it. None: nobody knows.
            ahead: where the robot will be when this command begins to act, by the commands that are under way; None: it
                acts at once.
        """
        begin = at_once(moving) if ahead is None else ahead
        fast, turning = v, omega
        v = min(max(v, -self.max_reverse_m_per_s), self.max_speed_m_per_s)
        omega = min(max(omega, -self.max_turn_rad_per_s), self.max_turn_rad_per_s)
        reason = None if (v, omega) == (fast, turning) else "the speed limit"
        if v == 0.0:
            turn = self._turn_on_the_spot(omega, sectors, begin)
            return 0.0, turn, reason if turn == omega else "the stop zone"
        if self.blind_reverse or np.count_nonzero(sectors.covered[_AHEAD if v > 0.0 else _BEHIND]):
            been = None  # it sees where it goes
        elif v > 0.0 or been is None:
            blind = f"nothing senses what lies {'ahead' if v > 0 else 'behind'}"
            return 0.0, self._turn_on_the_spot(omega, sectors, begin), blind
        share = self._fastest(v, omega, sectors, begin, been)
        if share > 0.0:
            return share * v, omega, reason if share == 1.0 else "the stop zone"
        if self.evade and v > 0.0:
            v, omega = self._evading(v, omega, sectors, begin)
            if v > 0.0:
                return v, omega, "the stop zone"
        return 0.0, self._turn_on_the_spot(omega, sectors, begin), "the stop zone"

    def _evading(self, v: float, omega: float, sectors: Sectors, begin: Ahead) -> tuple[float, float]:
        """Return velocities that lead past what is in the way: creeping, or else turning on the spot."""
        creep = min(v, _CREEP_M_PER_S)
        turns = self.max_turn_rad_per_s * _TURNS
        turns = turns[np.argsort(np.abs(turns - omega), kind="stable")].tolist()
        shares: list[float] = []
        for turn in turns:
            shares.append(self._fastest(creep, turn, sectors, begin))
            if shares[-1] >= _WORTH_IT:
                return shares[-1] * creep, turn
        if (towards := self._turn_to_a_way(creep, omega, sectors)) is not None:
            return 0.0, towards
        share = max(shares)
        return share * creep, omega if share == 0.0 else turns[shares.index(share)]

    def _turn_to_a_way(self, creep: float, omega: float, sectors: Sectors) -> float | None:
        """Return the turn that leads to the nearest heading in which the robot could creep on; None without one."""
        side = 1.0 if omega >= 0.0 else -1.0
        swings = {way: self._free_swing(way, sectors) for way in (side, -side)}
        for bins in range(_HEADING_BINS, NUM_BINS // 2 + 1, _HEADING_BINS):
            for way in (side, -side):
                if bins > swings[way]:
                    continue
                turned = np.roll(sectors.distances_m, -round(way * bins))
                if self._fastest(creep, 0.0, replace(sectors, distances_m=turned), _STANDING) >= _WORTH_IT:
                    return way * _TURN_SHARE * self.max_turn_rad_per_s
        return None

    def _free_swing(self, way: float, sectors: Sectors) -> int:
        """Return how many sectors far the robot can turn on the spot to a side, half of all at most: a disc that far.

        Within the margin its corners come nearer little by little, so the least that must stay counts.
        """
        half = NUM_BINS // 2
        borders, nearest = self._within_reach(sectors, 0.0, _STANDING)
        if self._is_a_disc or not len(nearest):
            return half
        turned = way * BIN_RAD * np.arange(half + 1)
        headings = np.stack((np.cos(turned), np.sin(turned)), axis=1)
        clearance = self._clearances(np.zeros((1, half + 1, 2)), headings, borders, nearest)[0].min(axis=-1)
        touching = np.flatnonzero(clearance < min(LEAST_M, float(clearance[0])))
        return int(touching[0]) - 1 if len(touching) else half

    def _turn_on_the_spot(self, omega: float, sectors: Sectors, begin: Ahead) -> float:
        """Return the largest of the shares of a turn that keeps the stop zone free while the robot stands, or brakes.

        Where none does, it is to turn no more.
        """
        if self._is_a_disc or omega == 0.0:
            return omega
        borders, nearest = self._within_reach(sectors, 0.0, begin)
        if not len(nearest):
            return omega
        for share in SHARES:
            places, headings = self._ways([0.0], share * omega, begin)
            if self._kept(places, headings, borders, nearest)[0]:
                return share * omega
        return 0.0

    def _kept(
        self,
        places: NDArray[np.float64],
        headings: NDArray[np.float64],
        borders: NDArray[np.float64],
        nearest: NDArray[np.float64],
    ) -> NDArray[np.bool_]:
        """Return which ways keep their distance from what is sensed, bool [shares]; see :meth:`_clearances`.

        From what is nearer than the least already, such as a mast of the robot's own, it must come no nearer. That
        makes nothing else less worth keeping clear of.
        """
        clearance = self._clearances(places, headings, borders, nearest)
        close = clearance[0, 0] < LEAST_M
        kept = np.ones(len(places), np.bool_)
        for group in (clearance[..., close], clearance[..., ~close]):
            if group.size:
                kept &= group.min(axis=(1, 2)) >= self._needed_m(float(group[0, 0].min()))
        return kept

    def _needed_m(self, now_m: float) -> float:
        """Return the clearance that must stay, m, of who has `now_m` of it."""
        return min(self.margin_m, max(now_m - BLUR_M, LEAST_M), now_m)

    def _fastest(
        self,
        v: float,
        omega: float,
        sectors: Sectors,
        begin: Ahead,
        been: NDArray[np.float64] | None = None,
    ) -> float:
        """Return the largest of the shares of `v` whose way keeps its distance, 0 if none does.

        With `been`, the way must lead where the robot has been, too.
        """
        borders, nearest = self._within_reach(sectors, abs(v), begin)
        if been is None and not len(nearest):
            return 1.0
        speeds = [share * v for share in SHARES]
        places, headings = self._ways(speeds, omega, begin)
        allowed = np.ones(len(SHARES), np.bool_)
        if len(nearest):
            allowed = self._kept(places, headings, borders, nearest)
        if been is not None:
            allowed &= self._has_been(places, been)
        return next((share for share, free in zip(SHARES, allowed.tolist(), strict=True) if free), 0.0)

    def _ways(
        self, speeds: Sequence[float], omega: float, begin: Ahead
    ) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Return the ways that begin somewhere, as :func:`stopping_paths` does, in the robot's frame now."""
        places, headings = stopping_paths(speeds, omega, begin.velocities, self._reacting, self.robot)
        if begin.pose == _STANDING.pose:
            return places, headings
        return placed(places.reshape(-1, 2), begin.pose).reshape(places.shape), placed(headings, (0, 0, begin.pose[2]))

    def _within_reach(
        self, sectors: Sectors, speed: float, begin: Ahead
    ) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Return the directions of what is in reach of who is told a speed, [2, m], and how far it is, m, [m]."""
        # What is out of reach of the whole way cannot be near to any of it.
        return sensed_within(sectors, self.reach_m(speed, begin))

    def _has_been(self, places: NDArray[np.float64], been: NDArray[np.float64]) -> NDArray[np.bool_]:
        """Return of which ways all places lie within where the robot has been, bool [shares].

        Args:
            places: of its centre, [shares, n, 2].
            been: where it was, [k, 2].
        """
        edge = places[:, :, None] + (self.radius_m - _BESIDE_M) * _EDGE
        apart = edge[:, :, :, None] - been
        covered = np.square(apart).sum(axis=-1).min(axis=-1, initial=np.inf) <= self.radius_m**2
        return np.asarray(covered.all(axis=(1, 2)))

    def _clearances(
        self,
        places: NDArray[np.float64],
        directions: NDArray[np.float64],
        borders: NDArray[np.float64],
        nearest: NDArray[np.float64],
    ) -> NDArray[np.float64]:
        """Return how far the robot is from what is sensed in each direction at each place, m, [shares, n, m].

        Args:
            places: of its centre, [shares, n, 2].
            directions: cosine and sine of its heading there, [n, 2].
            borders: directions in which something is, of unit length, [2, m].
            nearest: how far from here on there may be something, m, [m].
        """
        if self._is_a_disc:
            return place_distances(places, borders, nearest) - self.radius_m
        return outline_distances(self.robot.outline, places, directions, borders, nearest)

    @property
    def _is_a_disc(self) -> bool:
        """Whether the circle around the robot is guarded, and not its outline."""
        return self.robot.is_round or self.radius_m > self.robot.circumradius_m

    @property
    def _reacting(self) -> int:
        """How many steps a command may last."""
        return math.ceil(self.reaction_s / STEP_S - 1e-9)

    def reach_m(self, speed: float, begin: Ahead) -> float:
        """Return how near to here, m, something must be to matter to a command.

        Args:
            speed: that it wants, m/s, either way.
            begin: where the robot is when it begins to act.
        """
        x, y, _ = begin.pose
        fastest = max(speed, abs(begin.velocities[0]))
        held_m = self.radius_m if self._is_a_disc else self.robot.circumradius_m  # corners reach so far
        driven_m = fastest * (self.reaction_s + STEP_S) + self.robot.stopping_distance_m(fastest)
        return math.hypot(x, y) + held_m + self.margin_m + driven_m


def _check_robot(robot: object) -> None:
    if not isinstance(robot, RobotSettings):
        raise UserInputError(f"robot={robot!r} of the guard is none: give policy.robot, or a RobotSettings")
