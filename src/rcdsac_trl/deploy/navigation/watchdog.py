"""Notices that a robot stands still, and what then helps an agent: boldness, and at last backing off."""

import math
from dataclasses import dataclass, fields

import numpy as np
from numpy.typing import NDArray

from rcdsac_trl.errors import UserInputError
from rcdsac_trl.robot.robot_settings import PAPER, RobotSettings

Place = tuple[float, float]

# A robot that stays so near to where it was stands still.
_STILL_M = 0.3
# It backs along where it has been, aiming at what lies so far behind it.
_BACK_AIM_M = 0.25
# So fast, m/s, where the robot may reverse so fast. One that does not move by so much for so long is held by something.
_BACK_M_PER_S, _HELD_M, _HELD_S = 0.15, 0.01, 1.0


@dataclass(frozen=True)
class WatchdogSettings:
    """When an agent is helped, and how.

    Attributes:
        still_s: of a robot that stays within 0.3 m for so long beta begins to turn to its boldest, s.
        bold_s: it is there after so long, s; 0.3 m farther on, beta is at once what was asked for.
        back_off_s: so long after beta begins to turn, the robot backs off, s.
        back_off_m: by this, m, where it has driven ahead before.

    Raises:
        UserInputError: if a value is not positive.
    """

    still_s: float = 3.0
    bold_s: float = 3.0
    back_off_s: float = 12.0
    back_off_m: float = 0.4

    def __post_init__(self) -> None:
        """Refuse what would help at once, or never."""
        for each in fields(self):
            if not 0.0 < getattr(self, each.name) < math.inf:
                raise UserInputError(f"{each.name}={getattr(self, each.name)} of a watchdog must be a positive number")


class _Stay:
    """For how long a robot has stayed near to where it was.

    Args:
        radius_m: what is near.

    Attributes:
        lasted_s: for how long, s.
    """

    def __init__(self, radius_m: float) -> None:
        self.lasted_s = 0.0
        self._radius_m = radius_m
        self._place: Place | None = None

    def observe(self, here: Place, elapsed_s: float) -> None:
        """Take in where the robot is, and how long after the last call, s."""
        if self._place is None or math.dist(here, self._place) > self._radius_m:
            self._place, self.lasted_s = here, 0.0
        else:
            self.lasted_s += elapsed_s


class Watchdog:
    """Watches one robot.

    Args:
        settings: when it helps, and how.
        robot: that is watched.

    Example:
        >>> watchdog = Watchdog(WatchdogSettings())
        >>> for _ in range(46):
        ...     watchdog.observe((0.0, 0.0), 0.1)
        >>> round(watchdog.boldness, 2)
        0.5
    """

    def __init__(self, settings: WatchdogSettings, robot: RobotSettings = PAPER) -> None:
        self.settings = settings
        self._back_m_per_s = min(_BACK_M_PER_S, robot.max_reverse_m_per_s)
        self._standing, self._held = _Stay(_STILL_M), _Stay(_HELD_M)
        # Of a robot that backs off: how far, and for how long, it still may.
        self._left_m = self._left_s = 0.0
        self._last: Place | None = None

    def observe(self, here: Place, elapsed_s: float) -> None:
        """Take in where the robot is.

        Args:
            here: x and y in m, odometry frame.
            elapsed_s: since the last call, s.
        """
        self._standing.observe(here, elapsed_s)

    @property
    def idle_s(self) -> float:
        """For how long the robot has been in need of help, s; 0: it is not."""
        return max(0.0, self._standing.lasted_s - self.settings.still_s)

    @property
    def boldness(self) -> float:
        """How far beta is to be turned to its boldest, in [0, 1]."""
        return min(1.0, self.idle_s / self.settings.bold_s)

    def way_out(self, here: Place, been: NDArray[np.float64], elapsed_s: float) -> tuple[float, float] | None:
        """Return velocities that lead back, m/s and rad/s; None: the agent may try.

        Args:
            here: x and y in m, odometry frame.
            been: where the robot has been, in its frame now, the newest last, [k, 2], m.
            elapsed_s: since the last call, s.
        """
        moved_m = 0.0 if self._last is None else math.dist(here, self._last)
        self._last = here
        begins = self._left_s <= 0.0
        if begins and (self.idle_s < self.settings.back_off_s or self._back_m_per_s == 0.0):
            return None
        back = _aim(been)
        if begins:
            if back is None:
                return None
            self._left_m = self.settings.back_off_m
            self._left_s = 2.0 * self._left_m / self._back_m_per_s
            self._held = _Stay(_HELD_M)
        else:
            self._left_m -= moved_m
            self._left_s -= elapsed_s
        self._held.observe(here, elapsed_s)
        if back is None or self._left_m <= 0.0 or self._left_s <= 0.0 or self._held.lasted_s >= _HELD_S:
            self._left_s = self._standing.lasted_s = 0.0
            return None
        x, y = back
        return -self._back_m_per_s, -self._back_m_per_s * 2.0 * y / (x * x + y * y)


def _aim(been: NDArray[np.float64]) -> Place | None:
    """Return the newest place that lies far enough behind; None where there is none."""
    behind = been[(np.hypot(been[:, 0], been[:, 1]) >= _BACK_AIM_M) & (been[:, 0] < 0.0)]
    return None if not len(behind) else (float(behind[-1, 0]), float(behind[-1, 1]))
