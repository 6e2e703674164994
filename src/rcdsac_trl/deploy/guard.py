"""What stands between an agent and the wheels: a speed limit and a stop zone that know nothing of the agent.

The stop zone is the way the robot would still go if it did what it is told for one more reaction time and then braked:
the whole way must keep its distance from everything that the range sensor sees. What lies behind an obstacle counts as
obstacle.
"""

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from rcdsac_trl.deploy.sectors import BIN_RAD, Sectors
from rcdsac_trl.errors import UserInputError
from rcdsac_trl.interface import (
    MAX_ANGULAR_VELOCITY,
    MAX_LINEAR_VELOCITY,
    MIN_LINEAR_VELOCITY,
    NUM_BINS,
    clip_command,
)

# Shares of the wanted speed that are tried, the fastest first.
_SHARES = (1.0, 0.75, 0.5, 0.25)
# Time from one place on the way to the next, s: 3 cm at full speed.
_STEP_S = 0.05
# What is in a sector may be anywhere in it, so a wall beside the robot looks up to this much nearer farther on: who is
# within the margin may seem to come so much nearer, but never below the least that must stay.
_BLUR_M = 0.01
_LEAST_M = 0.01
# Half the angle ahead (or behind) in which something must be sensed at all before the robot moves that way.
_WAY_RAD = math.radians(30.0)

_BORDERS = np.arange(NUM_BINS) * BIN_RAD
_COS, _SIN = np.cos(_BORDERS), np.sin(_BORDERS)
_MIDDLES = (_BORDERS + math.pi) % (2.0 * math.pi) - math.pi + BIN_RAD / 2.0
_AHEAD = np.abs(_MIDDLES) < _WAY_RAD
_BEHIND = np.abs(_MIDDLES) > math.pi - _WAY_RAD


@dataclass(frozen=True)
class Guard:
    """Limits that no command of an agent leaves.

    Attributes:
        max_speed_m_per_s: forwards.
        max_reverse_m_per_s: backwards, as a positive number.
        max_turn_rad_per_s: either way.
        radius_m: of the circle around the robot's centre that holds the robot.
        margin_m: what is kept between that circle and everything that is sensed. Who is nearer may drive along it
            or away from it, and nearer by 1 cm a call, the blur of a sector, until 1 cm is left.
        reaction_s: how long a command may last until the next one arrives and acts.
        blind_reverse: whether the robot may drive backwards (or forwards) where it senses nothing at all.

    Raises:
        UserInputError: if a limit is negative, or the radius is not positive.

    Example:
        >>> wall = Sectors(np.full(NUM_BINS, 0.31), np.ones(NUM_BINS, dtype=bool))
        >>> Guard().limit(0.6, 0.0, wall)[:2]
        (0.0, 0.0)
    """

    max_speed_m_per_s: float = MAX_LINEAR_VELOCITY
    max_reverse_m_per_s: float = -MIN_LINEAR_VELOCITY
    max_turn_rad_per_s: float = MAX_ANGULAR_VELOCITY
    radius_m: float = 0.25
    margin_m: float = 0.05
    reaction_s: float = 0.25
    blind_reverse: bool = False

    def __post_init__(self) -> None:
        """Refuse what is no limit."""
        for name in ("max_speed_m_per_s", "max_reverse_m_per_s", "max_turn_rad_per_s", "margin_m", "reaction_s"):
            if not 0.0 <= getattr(self, name) < math.inf:
                raise UserInputError(f"{name}={getattr(self, name)} of the guard must be a number of 0 or more")
        if not 0.0 < self.radius_m < math.inf:
            raise UserInputError(f"radius_m={self.radius_m} of the guard must be a positive number of metres")

    def limit(
        self, v: float, omega: float, sectors: Sectors, moving: tuple[float, float] = (0.0, 0.0)
    ) -> tuple[float, float, str | None]:
        """Return the velocities that may be driven, and why they are not those that were wanted.

        The linear velocity is lowered, to 0 if need be; turning on the spot is always allowed.

        Args:
            v: wanted linear velocity, m/s.
            omega: wanted angular velocity, rad/s.
            sectors: what the range sensor sees, all of it, not just what the agent sees.
            moving: measured velocities, m/s and rad/s.
        """
        fast, turning = v, omega
        v = min(max(v, -self.max_reverse_m_per_s), self.max_speed_m_per_s)
        omega = min(max(omega, -self.max_turn_rad_per_s), self.max_turn_rad_per_s)
        reason = None if (v, omega) == (fast, turning) else "the speed limit"
        if v == 0.0:
            return v, omega, reason
        if not self.blind_reverse and not sectors.covered[_AHEAD if v > 0.0 else _BEHIND].any():
            return 0.0, omega, f"nothing senses what lies {'ahead' if v > 0 else 'behind'}"
        for share in _SHARES:
            if self._keeps_distance(share * v, omega, sectors, moving):
                return share * v, omega, reason if share == 1.0 else "the stop zone"
        return 0.0, omega, "the stop zone"

    def _keeps_distance(self, v: float, omega: float, sectors: Sectors, moving: tuple[float, float]) -> bool:
        places = self._way(v, omega, moving)
        # What is out of reach of the whole way cannot be near to any of it.
        reach = float(np.abs(places).sum(axis=1).max()) + self.radius_m + self.margin_m
        seen = np.flatnonzero(sectors.distances_m < reach)
        if not len(seen):
            return True
        # Both borders of a sector: whatever is inside it lies between them, at its distance or farther.
        borders = np.concatenate((seen, (seen + 1) % NUM_BINS))
        near = np.concatenate((sectors.distances_m[seen],) * 2)
        x, y = _COS[borders], _SIN[borders]
        along = np.maximum(places @ np.stack((x, y)), near)
        apart = np.square(places[:, :1] - along * x) + np.square(places[:, 1:] - along * y)
        clearance = np.sqrt(apart.min(axis=1)) - self.radius_m
        needed = min(self.margin_m, max(clearance[0] - _BLUR_M, _LEAST_M), clearance[0])
        return bool((clearance >= needed).all())

    def _way(self, v: float, omega: float, moving: tuple[float, float]) -> NDArray[np.float64]:
        """Return the places the robot's centre comes by until it stands, itself first, [n, 2]."""
        x = y = yaw = 0.0
        v_now, omega_now = moving
        places = [(0.0, 0.0)]
        left = math.ceil(self.reaction_s / _STEP_S - 1e-9)
        while left > 0 or abs(v_now) > 1e-9:
            wanted = (v, omega) if left > 0 else (0.0, 0.0)
            v_now, omega_now = clip_command(*wanted, v_now, omega_now, _STEP_S)
            yaw += omega_now * _STEP_S / 2.0
            x, y = x + v_now * _STEP_S * math.cos(yaw), y + v_now * _STEP_S * math.sin(yaw)
            yaw += omega_now * _STEP_S / 2.0
            places.append((x, y))
            left -= 1
        return np.array(places)
