"""A rolling map of what a robot has seen around it, as the local costmap of a navigation stack is.

It knows what an agent knows: ranges and measured velocities. Where the robot is follows from the velocities alone
(odometry), so the map drifts with them, and forgets after a while.
"""

import math
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from rcdsac_trl.errors import UserInputError
from rcdsac_trl.robot.dead_reckoning import DeadReckoning
from rcdsac_trl.robot.range_sensor import BIN_RAD, MAX_RANGE_M, NUM_BINS
from rcdsac_trl.system.jit import njit

_NEVER = -math.inf
_NOTHING = np.empty((0, 6))
_NOWHERE = np.empty((0, 2))


@dataclass(frozen=True)
class LocalMapSettings:
    """What a local map holds.

    Attributes:
        size_m: side of the square around the robot that is remembered, m. With 4.8 m it drives as safely, but now and
            then goes to and fro between two ways that it has both forgotten; with 9.6 m a decision takes 1.5 times as
            long.
        cell_m: side of a cell, m. Half of it is how far a point is moved at most, which must be small beside what is
            left in a door; the time a decision takes grows with its inverse square.
        memory_s: age at which a point is forgotten, s. MPPI collided 0.15 times an episode with 8 s and 0.07 times with
            16 s, on validation maps; longer was not tried.
        clearing_margin_m: a remembered point goes when its sector sees this much farther than it, m. About what a
            point has moved by cell, sector and odometry since it was seen.
        mover_margin_m: points this near to a thing that moves are its own, m; about what its place is uncertain by.
        reach_m: distances to points are computed up to here, m: the robot's radius, the margin of its costs, and some.

    Raises:
        UserInputError: if a value is outside its limits.
    """

    size_m: float = 7.2
    cell_m: float = 0.05
    memory_s: float = 16.0
    clearing_margin_m: float = 0.1
    mover_margin_m: float = 0.2
    reach_m: float = 0.8

    def __post_init__(self) -> None:
        """Refuse a map that holds nothing."""
        for name in ("size_m", "cell_m", "memory_s", "clearing_margin_m", "mover_margin_m", "reach_m"):
            if not 0.0 < getattr(self, name) < math.inf:
                raise UserInputError(f"{name}={getattr(self, name)} must be a positive number")
        if not 2.0 * (self.cell_m + self.reach_m) < self.size_m:
            raise UserInputError(f"size_m={self.size_m:g} must be above twice reach_m={self.reach_m:g} and a cell")

    @property
    def num_cells(self) -> int:
        """Cells along a side."""
        return round(self.size_m / self.cell_m)


class Clearances(NamedTuple):
    """How far the places of a square are from whatever is nearest.

    Attributes:
        field_m: distance from the middle of each cell to the nearest point's cell, m, float32 [n, n], rows along y; at
            most a reach.
        corner: lower corner of the square, x and y in m.
        cell_m: side of a cell, m.
    """

    field_m: NDArray[np.float32]
    corner: tuple[float, float]
    cell_m: float


def clearances_around(
    place: tuple[float, float], points: NDArray[np.float64], size_m: float, settings: LocalMapSettings
) -> Clearances:
    """Return how far the places of a square are from the nearest of some points.

    Args:
        place: middle of the square, x and y in m.
        points: x and y in m, [k, 2].
        size_m: side of the square, m.
        settings: their cells and reach are taken.
    """
    n = round(size_m / settings.cell_m)
    corner = _corner(place, n, settings.cell_m)
    held, field_m = np.zeros((n, n), np.bool_), np.empty((n, n), np.float32)
    _mark(held, points, *corner, settings.cell_m)
    _measure(field_m, held, settings.cell_m, settings.reach_m)
    return Clearances(field_m, corner, settings.cell_m)


def _corner(place: tuple[float, float], n: int, cell_m: float) -> tuple[float, float]:
    """Return the lower corner, on the grid of cells, of a square of n x n cells around a place."""
    x, y = place
    return (math.floor(x / cell_m) - n // 2) * cell_m, (math.floor(y / cell_m) - n // 2) * cell_m


class LocalMap:
    """What one robot remembers.

    Points are kept in the odometry frame: it has its origin where the robot was when the map was made.

    Args:
        settings: what it holds.
        sensed: which of the 180 sectors the sensor has, bool [180].
        max_range_m: reach of the sensor.

    Attributes:
        pose: the robot's x and y in m and yaw in rad, float64 [3], odometry frame.
        points: a row for each cell of a ring of cells, float64 [n, n, 3]: the last point seen in it (x and y in m,
            odometry frame) and when (s).
        field_m: distance from the middle of each cell of the square around the robot to the nearest point, m, float32
            [n, n], rows along y; at most :attr:`LocalMapSettings.reach_m`.

    Example:
        >>> from rcdsac_trl.robot.range_sensor import sensor_mask
        >>> local_map = LocalMap(LocalMapSettings(), sensor_mask("narrow"))
        >>> ranges_m = np.full(180, np.inf)
        >>> ranges_m[0] = 1.0
        >>> local_map.observe(ranges_m)
        >>> round(local_map.distance_m(0.5, 0.0), 1)
        0.5
    """

    def __init__(self, settings: LocalMapSettings, sensed: NDArray[np.bool_], max_range_m: float = MAX_RANGE_M) -> None:
        self.settings = settings
        self._max_range_m = max_range_m
        self.sensed = np.asarray(sensed, np.bool_)
        n = settings.num_cells
        self._reckoning = DeadReckoning()
        self.pose = self._reckoning.pose
        self.points = np.full((n, n, 3), _NEVER)
        self.field_m = np.full((n, n), settings.reach_m, np.float32)

    def move(self, v: float, omega: float, elapsed_s: float) -> None:
        """Go with the robot.

        Args:
            v: linear velocity measured now, m/s.
            omega: angular velocity measured now, rad/s.
            elapsed_s: since the last move, s.
        """
        self._reckoning.move(v, omega, elapsed_s)

    def touch(self, ahead_m: float) -> None:
        """Remember something that was felt, not seen; the next observation clears it where it sees through it.

        Args:
            ahead_m: how far ahead of the robot's middle, m; negative is behind.
        """
        x, y, yaw = self.pose.tolist()
        place = x + ahead_m * math.cos(yaw), y + ahead_m * math.sin(yaw)
        _put(self.points, *place, self._reckoning.time_s, self.settings.cell_m)

    def observe(
        self,
        ranges_m: NDArray[np.float64],
        moving: NDArray[np.float64] = _NOTHING,
        standing: NDArray[np.float64] = _NOWHERE,
    ) -> None:
        """Forget what is old, clear what is seen through, and add what is seen but does not move.

        Args:
            ranges_m: smallest distance in each sector, float64 [180], m; ``inf`` where nothing is in reach.
            moving: what moves, float64 [k, 6]; see :attr:`rcdsac_trl.robot.mover_tracks.MoverTracks.moving`.
            standing: what is known to stand, seen or not, x and y in m, odometry frame, float64 [k, 2]. It counts until
                the next call, and is not remembered.
        """
        settings = self.settings
        _forget(self.points, self._reckoning.time_s - settings.memory_s, self.pose, 0.5 * settings.size_m)
        time_s, far_m = self._reckoning.time_s, self._max_range_m
        _clear(self.points, self.pose, ranges_m, self.sensed, settings.clearing_margin_m, far_m)
        _add(self.points, time_s, self.pose, ranges_m, self.sensed, settings.cell_m, far_m)
        _take_out(self.points, time_s, moving, settings.mover_margin_m)
        held = np.zeros(self.field_m.shape, np.bool_)
        _hold(held, self.points, self.pose, settings.cell_m)
        _mark(held, standing, *self.corner, settings.cell_m)
        _measure(self.field_m, held, settings.cell_m, settings.reach_m)

    @property
    def corner(self) -> tuple[float, float]:
        """Lower corner of the square around the robot, on the grid of cells: x and y in m, odometry frame."""
        return _corner(self.place, self.settings.num_cells, self.settings.cell_m)

    @property
    def place(self) -> tuple[float, float]:
        """Where the robot is, x and y in m, odometry frame."""
        x, y, _ = self.pose.tolist()
        return x, y

    @property
    def clearances(self) -> Clearances:
        """How far the places of the square are from whatever is nearest, odometry frame."""
        return Clearances(self.field_m, self.corner, self.settings.cell_m)

    @property
    def remembered(self) -> NDArray[np.float64]:
        """The points that are remembered, x and y in m, odometry frame, float64 [k, 2]."""
        return self.points[np.isfinite(self.points[..., 2])][:, :2]

    def distance_m(self, x: float, y: float) -> float:
        """Return how far the cell of a place in the square, odometry frame, is from the nearest point's, m."""
        x0, y0 = self.corner
        cell_m = self.settings.cell_m
        return float(self.field_m[math.floor((y - y0) / cell_m), math.floor((x - x0) / cell_m)])


# ------------------------------------------------------------------------------------------------ compiled
# All that the compiled code uses stands in this file: Numba's cache notices no change of another one.
@njit
def _forget(points: np.ndarray, before_s: float, pose: np.ndarray, half_m: float) -> None:
    """Drop what is too old, and what is outside of the square."""
    for i in range(points.shape[0]):
        for j in range(points.shape[1]):
            if points[i, j, 2] == _NEVER:
                continue
            outside = max(abs(points[i, j, 0] - pose[0]), abs(points[i, j, 1] - pose[1])) >= half_m
            if outside or points[i, j, 2] < before_s:
                points[i, j, 2] = _NEVER


@njit
def _clear(
    points: np.ndarray, pose: np.ndarray, ranges_m: np.ndarray, sensed: np.ndarray, margin_m: float, far_m: float
) -> None:
    """Drop what sectors see through: nothing is nearer than their range, and nothing in reach where there is none."""
    for i in range(points.shape[0]):
        for j in range(points.shape[1]):
            if points[i, j, 2] == _NEVER:
                continue
            dx, dy = points[i, j, 0] - pose[0], points[i, j, 1] - pose[1]
            bearing = math.atan2(dy, dx) - pose[2]
            bin_ = math.floor(bearing / BIN_RAD) % NUM_BINS
            if sensed[bin_] and math.hypot(dx, dy) < min(ranges_m[bin_], far_m) - margin_m:
                points[i, j, 2] = _NEVER


@njit
def _put(points: np.ndarray, x: float, y: float, time_s: float, cell_m: float) -> None:
    """Remember a point."""
    n = points.shape[0]
    i, j = math.floor(y / cell_m) % n, math.floor(x / cell_m) % n
    points[i, j, 0], points[i, j, 1], points[i, j, 2] = x, y, time_s


@njit
def _add(
    points: np.ndarray,
    time_s: float,
    pose: np.ndarray,
    ranges_m: np.ndarray,
    sensed: np.ndarray,
    cell_m: float,
    far_m: float,
) -> None:
    """Put a point into the middle of each sector that sees one."""
    half_m = 0.5 * points.shape[0] * cell_m
    for bin_ in range(NUM_BINS):
        if not sensed[bin_] or ranges_m[bin_] >= far_m:
            continue
        bearing = pose[2] + (bin_ + 0.5) * BIN_RAD
        dx, dy = ranges_m[bin_] * math.cos(bearing), ranges_m[bin_] * math.sin(bearing)
        if max(abs(dx), abs(dy)) >= half_m:
            continue
        _put(points, pose[0] + dx, pose[1] + dy, time_s, cell_m)


@njit
def _take_out(points: np.ndarray, time_s: float, moving: np.ndarray, margin_m: float) -> None:
    """Drop the points of what moves, but for those seen now where it is itself not seen: its place is a guess then."""
    if len(moving) == 0:
        return
    for i in range(points.shape[0]):
        for j in range(points.shape[1]):
            if points[i, j, 2] == _NEVER:
                continue
            for x, y, _, _, radius, unseen_s in moving:
                near = math.hypot(points[i, j, 0] - x, points[i, j, 1] - y) < radius + margin_m
                if near and (unseen_s == 0.0 or points[i, j, 2] < time_s):
                    points[i, j, 2] = _NEVER


@njit
def _hold(held: np.ndarray, points: np.ndarray, pose: np.ndarray, cell_m: float) -> None:
    """Say which cells of the square around a robot hold a remembered point."""
    n = held.shape[0]
    row0 = math.floor(pose[1] / cell_m) - n // 2
    column0 = math.floor(pose[0] / cell_m) - n // 2
    for i in range(n):
        for j in range(n):
            held[i, j] = points[(row0 + i) % n, (column0 + j) % n, 2] != _NEVER


@njit
def _mark(held: np.ndarray, standing: np.ndarray, x0: float, y0: float, cell_m: float) -> None:
    """Add the cells that hold one of some points."""
    n = held.shape[0]
    row0, column0 = round(y0 / cell_m), round(x0 / cell_m)
    for x, y in standing:
        i, j = math.floor(y / cell_m) - row0, math.floor(x / cell_m) - column0
        if 0 <= i < n and 0 <= j < n:
            held[i, j] = True


@njit
def _measure(field_m: np.ndarray, held: np.ndarray, cell_m: float, reach_m: float) -> None:
    """Write the distance to the nearest cell that holds a point, exactly, up to a reach.

    First along each row, then over the rows around: what is squared may be minimised one axis after the other.
    """
    n = field_m.shape[0]
    reach = math.ceil(reach_m / cell_m)
    along = np.empty((n, n), np.float32)
    far = np.float32(reach + 1)
    for i in range(n):
        gap = far
        for j in range(n):
            gap = np.float32(0.0) if held[i, j] else min(gap + np.float32(1.0), far)
            along[i, j] = gap
        for j in range(n - 2, -1, -1):
            along[i, j] = min(along[i, j], along[i, j + 1] + np.float32(1.0))
        for j in range(n):
            along[i, j] *= along[i, j]
    limit = np.float32((reach_m / cell_m) ** 2)
    for i in range(n):
        row = field_m[i]
        row[:] = limit
        for other in range(max(0, i - reach), min(n, i + reach + 1)):
            apart = np.float32((other - i) * (other - i))
            beside = along[other]
            for j in range(n):
                row[j] = min(row[j], beside[j] + apart)
        for j in range(n):
            row[j] = np.sqrt(row[j]) * np.float32(cell_m)
