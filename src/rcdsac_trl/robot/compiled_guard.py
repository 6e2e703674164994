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
    close = np.zeros(len(nearest), np.bool_)
    for row in range(len(nearest)):
        close[row] = _gap(pose[0], pose[1], _less_place(pose[0], pose[1], borders, nearest, row)) - radius_m < least_m
    far_m, close_m = _gaps(pose[0], pose[1], borders, nearest, close)
    far_m = _needed(far_m - radius_m, margin_m, blur_m, least_m)
    close_m = _needed(close_m - radius_m, margin_m, blur_m, least_m)
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
            gap_m, close_gap_m = _gaps(x, y, borders, nearest, close)
            free = gap_m - radius_m >= far_m and close_gap_m - radius_m >= close_m
            step += 1
        if free:
            return share
    return 0.0


@njit
def _needed(now_m: float, margin_m: float, blur_m: float, least_m: float) -> float:
    """Return the clearance that must stay, m, of who has `now_m` of it."""
    return min(margin_m, max(now_m - blur_m, least_m), now_m)


@njit
def _gaps(x: float, y: float, borders: np.ndarray, nearest: np.ndarray, close: np.ndarray) -> tuple[float, float]:
    """Return how far a place is from what is sensed, m: from what is not close, and from what is."""
    far = least = math.inf
    for row in range(len(nearest)):
        squared = _less_place(x, y, borders, nearest, row)
        if close[row]:
            least = min(least, squared)
        else:
            far = min(far, squared)
    return _gap(x, y, far), _gap(x, y, least)


@njit
def _less_place(x: float, y: float, borders: np.ndarray, nearest: np.ndarray, row: int) -> float:
    """Return the squared distance from everything from ``nearest`` on in a direction, less that of the place, m^2."""
    along = x * borders[0, row] + y * borders[1, row]
    point = max(along, nearest[row])
    return point * (point - 2.0 * along)


@njit
def _gap(x: float, y: float, less_place: float) -> float:
    return math.sqrt(max(less_place + x * x + y * y, 0.0))
