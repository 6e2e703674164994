"""The guard, compiled: what a simulated world can afford in every step. A robot needs no compiler."""

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from rcdsac_trl.robot.guard import BLUR_M, LEAST_M, SHARES, Guard
from rcdsac_trl.robot.latency import Ahead
from rcdsac_trl.robot.sectors import Sectors
from rcdsac_trl.robot.stopping_path import STANDS_M_PER_S, STEP_S
from rcdsac_trl.system.jit import njit

# What the compiled code is given of the definition: numba's cache notices no change of another file.
_DEFINED = SHARES, STEP_S, BLUR_M, LEAST_M, STANDS_M_PER_S


@dataclass(frozen=True)
class CompiledGuard(Guard):
    """A guard that decides as :class:`~rcdsac_trl.robot.guard.Guard` does, in a fraction of the time for a disc."""

    def _fastest(
        self,
        v: float,
        omega: float,
        sectors: Sectors,
        begin: Ahead,
        been: NDArray[np.float64] | None = None,
    ) -> float:
        if been is not None or not self._is_a_disc:
            return super()._fastest(v, omega, sectors, begin, been)
        borders, nearest = self._within_reach(sectors, abs(v), begin)
        if not len(nearest):
            return 1.0
        state = begin.pose, begin.velocities
        if self._is_close(np.array(begin.pose[:2]), np.empty(0), borders, nearest).any():
            return super()._fastest(v, omega, sectors, begin, been)
        changes = self.robot.max_acceleration_m_per_s2 * STEP_S, self.robot.max_angular_acceleration * STEP_S
        kept = self.radius_m, self.margin_m
        share = _fastest_of_disc((v, omega), state, self._reacting, changes, kept, borders, nearest, _DEFINED)
        return float(share)


@njit
def _fastest_of_disc(
    wanted: tuple[float, float],
    state: tuple[tuple[float, float, float], tuple[float, float]],
    reacting: int,
    changes: tuple[float, float],
    kept: tuple[float, float],
    borders: np.ndarray,
    nearest: np.ndarray,
    defined: tuple[tuple[float, ...], float, float, float, float],
) -> float:
    """Return the largest share of the wanted speed whose way keeps its distance, 0 if none does."""
    (radius_m, margin_m), (shares, step_s, blur_m, least_m, stands) = kept, defined
    pose, moving = state
    now_m = _gap(pose[0], pose[1], borders, nearest) - radius_m
    needed_m = min(margin_m, max(now_m - blur_m, least_m), now_m)
    for share in shares:
        x, y, yaw = pose
        v, omega = moving
        free, step = True, 0
        while free and (step < reacting or abs(v) > stands):
            asked = (share * wanted[0], wanted[1]) if step < reacting else (0.0, 0.0)
            v = min(max(asked[0], v - changes[0]), v + changes[0])
            omega = min(max(asked[1], omega - changes[1]), omega + changes[1])
            half_turn = omega * step_s / 2.0
            x += v * step_s * math.cos(yaw + half_turn)
            y += v * step_s * math.sin(yaw + half_turn)
            yaw += 2.0 * half_turn
            free = _gap(x, y, borders, nearest) - radius_m >= needed_m
            step += 1
        if free:
            return share
    return 0.0


@njit
def _gap(x: float, y: float, borders: np.ndarray, nearest: np.ndarray) -> float:
    """Return how far a place is from what is sensed: from everything on the rays from ``nearest`` on, m."""
    least = math.inf
    for row in range(len(nearest)):
        along = x * borders[0, row] + y * borders[1, row]
        point = max(along, nearest[row])
        least = min(least, point * (point - 2.0 * along))
    return math.sqrt(max(least + x * x + y * y, 0.0))
