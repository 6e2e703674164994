"""What stands between an agent and the wheels: a speed limit and a stop zone that know nothing of the agent.

The stop zone is the way the robot would still go if it did what it is told for one more reaction time and then braked:
the whole way must keep its distance from everything that the range sensor sees. What lies behind an obstacle counts as
obstacle. Where the wish leads into it at any speed, the robot creeps along beside it, or turns until it can.
"""

import math
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rcdsac_trl.errors import UserInputError
from rcdsac_trl.robot.range_sensor import BIN_RAD, NUM_BINS
from rcdsac_trl.robot.robot_settings import PAPER, RobotSettings
from rcdsac_trl.robot.sectors import Sectors, check_switches

# Shares of the wanted speed that are tried, the fastest first.
SHARES = (1.0, 0.75, 0.5, 0.25)
# Time from one place on the way to the next, s: 3 cm at full speed.
STEP_S = 0.05
# What is in a sector may be anywhere in it, so a wall beside the robot looks up to this much nearer farther on: who is
# within the margin may seem to come so much nearer, but never below the least that must stay.
BLUR_M = 0.01
LEAST_M = 0.01
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
# Below, the robot stands.
STANDS_M_PER_S = 1e-9

_ANGLES = np.arange(NUM_BINS) * BIN_RAD
# Border i is the one between sectors i - 1 and i.
_BORDERS = np.stack((np.cos(_ANGLES), np.sin(_ANGLES)))
_SECTORS_BEFORE = np.arange(NUM_BINS) - 1
_MIDDLES = (_ANGLES + math.pi) % (2.0 * math.pi) - math.pi + BIN_RAD / 2.0
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
        reaction_s: how long a command may last until the next one arrives and acts.
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

    def limit(
        self,
        v: float,
        omega: float,
        sectors: Sectors,
        moving: tuple[float, float] = (0.0, 0.0),
        been: NDArray[np.float64] | None = None,
    ) -> tuple[float, float, str | None]:
        """Return the velocities that may be driven, and why they are not those that were wanted.

        The linear velocity is lowered, to 0 if need be; turning on the spot is always allowed. Where it would be 0, and
        the robot may evade, it creeps with another turn, the nearest to the wish that keeps the stop zone free; where
        there is none, it turns towards the nearest heading in which there is.

        Args:
            v: wanted linear velocity, m/s.
            omega: wanted angular velocity, rad/s.
            sectors: what the range sensor sees, all of it, not just what the agent sees.
            moving: measured velocities, m/s and rad/s.
            been: where the robot's centre has been while it drove ahead, [k, 2], m, in its frame now: nothing stands
                there, so it may drive back that way without sensing it. None: nobody knows.
        """
        fast, turning = v, omega
        v = min(max(v, -self.max_reverse_m_per_s), self.max_speed_m_per_s)
        omega = min(max(omega, -self.max_turn_rad_per_s), self.max_turn_rad_per_s)
        reason = None if (v, omega) == (fast, turning) else "the speed limit"
        if v == 0.0:
            return v, omega, reason
        if self.blind_reverse or np.count_nonzero(sectors.covered[_AHEAD if v > 0.0 else _BEHIND]):
            been = None  # it sees where it goes
        elif v > 0.0 or been is None:
            return 0.0, omega, f"nothing senses what lies {'ahead' if v > 0 else 'behind'}"
        share = self._fastest(v, omega, sectors, moving, been)
        if share == 0.0 and self.evade and v > 0.0:
            return *self._evading(v, omega, sectors, moving), "the stop zone"
        if share == 0.0:
            return 0.0, omega, "the stop zone"
        return share * v, omega, reason if share == 1.0 else "the stop zone"

    def _evading(self, v: float, omega: float, sectors: Sectors, moving: tuple[float, float]) -> tuple[float, float]:
        """Return velocities that lead past what is in the way: creeping, or else turning on the spot."""
        creep = min(v, _CREEP_M_PER_S)
        turns = self.max_turn_rad_per_s * _TURNS
        turns = turns[np.argsort(np.abs(turns - omega), kind="stable")].tolist()
        shares: list[float] = []
        for turn in turns:
            shares.append(self._fastest(creep, turn, sectors, moving))
            if shares[-1] >= _WORTH_IT:
                return shares[-1] * creep, turn
        if (towards := self._turn_to_a_way(creep, omega, sectors)) is not None:
            return 0.0, towards
        share = max(shares)
        return share * creep, omega if share == 0.0 else turns[shares.index(share)]

    def _turn_to_a_way(self, creep: float, omega: float, sectors: Sectors) -> float | None:
        """Return the turn that leads to the nearest heading in which the robot could creep on; None without one."""
        side = 1.0 if omega >= 0.0 else -1.0
        for bins in range(_HEADING_BINS, NUM_BINS // 2 + 1, _HEADING_BINS):
            for way in (side, -side):
                turned = np.roll(sectors.distances_m, -round(way * bins))
                if self._fastest(creep, 0.0, replace(sectors, distances_m=turned), (0.0, 0.0)) >= _WORTH_IT:
                    return way * _TURN_SHARE * self.max_turn_rad_per_s
        return None

    def _fastest(
        self,
        v: float,
        omega: float,
        sectors: Sectors,
        moving: tuple[float, float],
        been: NDArray[np.float64] | None = None,
    ) -> float:
        """Return the largest of the shares of `v` whose way keeps its distance, 0 if none does.

        With `been`, the way must lead where the robot has been, too.
        """
        borders, nearest = self._within_reach(sectors, max(abs(v), abs(moving[0])))
        if been is None and not len(nearest):
            return 1.0
        places, headings = self._ways(v, omega, moving)
        allowed = np.ones(len(SHARES), np.bool_)
        if len(nearest):
            clearance = self._clearances(places, headings, borders, nearest)
            now = float(clearance[0, 0])
            allowed = clearance.min(axis=1) >= min(self.margin_m, max(now - BLUR_M, LEAST_M), now)
        if been is not None:
            allowed &= self._has_been(places, been)
        return next((share for share, free in zip(SHARES, allowed.tolist(), strict=True) if free), 0.0)

    def _within_reach(self, sectors: Sectors, speed: float) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Return the directions of what is in reach of who is never faster, [2, m], and how far it is, m, [m]."""
        # Along a border, both sectors beside it are seen: whatever is inside a sector lies between its borders, at its
        # distance or farther.
        nearest = np.minimum(sectors.distances_m, sectors.distances_m[_SECTORS_BEFORE])
        # What is out of reach of the whole way cannot be near to any of it.
        seen = nearest < self._reach(speed)
        return _BORDERS[:, seen], nearest[seen]

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
        """Return how far the robot is from what is sensed at each place, m, [shares, n].

        Args:
            places: of its centre, [shares, n, 2].
            directions: cosine and sine of its heading there, [n, 2].
            borders: directions in which something is, of unit length, [2, m].
            nearest: how far from here on there may be something, m, [m].
        """
        if self._is_a_disc:
            return _distances(places, borders, nearest) - self.radius_m
        return _outline_distances(self.robot.outline, places, directions, borders, nearest)

    @property
    def _is_a_disc(self) -> bool:
        """Whether the circle around the robot is guarded, and not its outline."""
        return self.robot.is_round or self.radius_m > self.robot.circumradius_m

    @property
    def _reacting(self) -> int:
        """How many steps a command may last."""
        return math.ceil(self.reaction_s / STEP_S - 1e-9)

    def _reach(self, speed: float) -> float:
        """Return how near to here, m, something must be to matter to who is never faster than `speed`."""
        return (
            self.radius_m + self.margin_m + speed * (self.reaction_s + STEP_S) + self.robot.stopping_distance_m(speed)
        )

    def _ways(
        self, v: float, omega: float, moving: tuple[float, float]
    ) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Return the places the robot's centre comes by until it stands, itself first, for each share of `v`.

        Returns:
            Places [shares, n, 2], m; who stands before the others do stays where it is. And cosine and sine of the
            heading there, [n, 2], which does not depend on the speed.
        """
        reacting = self._reacting
        braking, turning = self.robot.max_acceleration_m_per_s2, self.robot.max_angular_acceleration
        speeds = [_until_it_stands(share * v, moving[0], reacting, braking) for share in SHARES]
        steps = max(len(of_share) for of_share in speeds)
        covered_m = np.array([of_share + [0.0] * (steps - len(of_share)) for of_share in speeds]) * STEP_S
        places = np.zeros((len(SHARES), steps + 1, 2))
        on_the_way, headings = _directions(omega, moving[1], reacting, steps, turning)
        np.cumsum(covered_m[:, :, None] * on_the_way, axis=1, out=places[:, 1:])
        return places, headings


def _check_robot(robot: object) -> None:
    if not isinstance(robot, RobotSettings):
        raise UserInputError(f"robot={robot!r} of the guard is none: give policy.robot, or a RobotSettings")


def _until_it_stands(v: float, now: float, reacting: int, acceleration: float) -> list[float]:
    """Return the linear velocity in each step: `v` is wanted in the first ones, and to stand from then on."""
    speeds: list[float] = []
    while len(speeds) < reacting or abs(now) > STANDS_M_PER_S:
        now = _nearer(v if len(speeds) < reacting else 0.0, now, acceleration * STEP_S)
        speeds.append(now)
    return speeds


def _directions(
    omega: float, now: float, reacting: int, steps: int, acceleration: float
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return directions as cosine and sine: the mean one in each step, [steps, 2], and at its ends, [steps + 1, 2].

    See :func:`_until_it_stands`.
    """
    yaw, directions, headings = 0.0, [], [(1.0, 0.0)]
    for step in range(steps):
        now = _nearer(omega if step < reacting else 0.0, now, acceleration * STEP_S)
        half = now * STEP_S / 2.0
        directions.append((math.cos(yaw + half), math.sin(yaw + half)))
        yaw += 2.0 * half
        headings.append((math.cos(yaw), math.sin(yaw)))
    return np.array(directions), np.array(headings)


def _nearer(wanted: float, now: float, change: float) -> float:
    """Return the velocity after a step, as ``robot.action.clip_command`` has it, of one of the two alone."""
    return now + change if wanted > now + change else now - change if wanted < now - change else wanted


def _distances(
    places: NDArray[np.float64], borders: NDArray[np.float64], nearest: NDArray[np.float64]
) -> NDArray[np.float64]:
    """Return how far each place is from what is sensed, m, [...].

    Args:
        places: [..., 2].
        borders: directions of unit length, [2, m].
        nearest: in each direction, how far from here on there may be something, m, [m].
    """
    along = places @ borders
    point = np.maximum(along, nearest)
    # |place - point u|^2 = |place|^2 + point (point - 2 place u) for a direction u, in few passes over large arrays.
    along *= 2.0
    np.subtract(point, along, out=along)
    along *= point
    squared = along.min(axis=-1) + np.square(places).sum(axis=-1)
    return np.sqrt(np.maximum(squared, 0.0))


def _outline_distances(
    outline: NDArray[np.float64],
    places: NDArray[np.float64],
    headings: NDArray[np.float64],
    borders: NDArray[np.float64],
    nearest: NDArray[np.float64],
) -> NDArray[np.float64]:
    """Return how far a convex body is from what is sensed at each place, m, [shares, n]; 0 where they meet.

    What is sensed in a direction is everything on the ray from `nearest` on. A ray and a convex body that do not meet
    are nearest at the ray's beginning, or at one of the body's corners.

    Args:
        outline: corners of the body in its own frame, counter-clockwise, m, [k, 2].
        places: of its centre, [shares, n, 2].
        headings: cosine and sine of its heading there, [n, 2].
        borders: directions of unit length, [2, m].
        nearest: in each direction, how far from here on there may be something, m, [m].
    """
    cos, sin = headings[:, 0], headings[:, 1]
    turns = np.stack((np.stack((cos, sin), axis=-1), np.stack((-sin, cos), axis=-1)), axis=1)  # [n, frame, map]
    corners = places[:, :, None] + outline @ turns
    at_corners = _distances(corners, borders, nearest).min(axis=-1)
    # The rays in the body's frame, [shares, n, m, 2].
    begin = np.einsum("nij,snmj->snmi", turns, (borders * nearest).T - places[:, :, None])
    along = np.broadcast_to(np.einsum("nij,jm->nmi", turns, borders), begin.shape)
    at_begin, met = _point_and_ray(outline, begin, along)
    return np.where(met.any(axis=-1), 0.0, np.minimum(at_corners, at_begin.min(axis=-1)))


def _point_and_ray(
    outline: NDArray[np.float64], begin: NDArray[np.float64], along: NDArray[np.float64]
) -> tuple[NDArray[np.float64], NDArray[np.bool_]]:
    """Return how far the beginnings of rays [..., 2] are from a convex body, and whether the rays meet it, [...]."""
    enters, leaves = np.zeros(begin.shape[:-1]), np.full(begin.shape[:-1], np.inf)
    apart2 = np.full(begin.shape[:-1], np.inf)
    for corner, following in zip(outline, np.roll(outline, -1, axis=0), strict=True):
        side = following - corner
        off = begin - corner
        share = np.clip(off @ side / (side @ side), 0.0, 1.0)
        apart2 = np.minimum(apart2, np.square(off - share[..., None] * side).sum(axis=-1))
        # To the left of every side is inside: how far it is there, and how fast the ray gets farther in.
        inside = side[0] * off[..., 1] - side[1] * off[..., 0]
        rate = side[0] * along[..., 1] - side[1] * along[..., 0]
        with np.errstate(divide="ignore", invalid="ignore"):
            crossing = -inside / rate
        enters = np.where(rate > 0.0, np.maximum(enters, crossing), enters)
        leaves = np.where(rate < 0.0, np.minimum(leaves, crossing), leaves)
        leaves = np.where((rate == 0.0) & (inside < 0.0), -np.inf, leaves)
    return np.sqrt(apart2), enters <= leaves
