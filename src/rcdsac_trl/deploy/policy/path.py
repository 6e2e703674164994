"""Where to go next on a planned path: what the simulated robot's episodes do, for one that knows its pose."""

import math
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rcdsac_trl.deploy.policy.weights import AgentConfig
from rcdsac_trl.errors import UserInputError

Point = tuple[float, float]


class PathFollower:
    """Hands out the next two waypoints of a path, in the robot's frame.

    A waypoint gives way to the next within ``waypoint_radius_m``; the goal, the last one, is reached within
    ``goal_radius_m``. Agents were trained on corner points of shortest paths: a path of close points is first
    thinned to its corners.

    Args:
        path: points in the map frame, m, [n, 2], the goal last.
        config: of the agent, for both radii.
        tolerance_m: points that are this near to the line between their neighbours are no corners.

    Raises:
        UserInputError: if the path holds no point, or no numbers.

    Example:
        >>> from types import SimpleNamespace
        >>> radii = SimpleNamespace(waypoint_radius_m=0.5, goal_radius_m=0.15)
        >>> PathFollower([(0.0, 0.0), (2.0, 0.0)], radii).update((0.0, 0.0, math.pi / 2)).round(6).tolist()
        [[0.0, -2.0], [0.0, -2.0]]
    """

    def __init__(self, path: Any, config: AgentConfig, *, tolerance_m: float = 0.05) -> None:
        try:
            points = np.asarray(path, dtype=np.float64)
        except (TypeError, ValueError) as error:
            raise UserInputError("a path's points are not numbers: give x and y in metres") from error
        if points.ndim != 2 or points.shape[1] != 2 or not len(points) or not np.isfinite(points).all():
            raise UserInputError(f"a path of shape {list(points.shape)} is none: give finite points, [n, 2] in metres")
        self._points = points[_corners(points, tolerance_m)]
        self._config = config
        self._next = 0
        self.reached = False

    def update(self, pose: tuple[float, float, float]) -> NDArray[np.float64] | None:
        """Return the next two waypoints in the robot's frame, m, [2, 2]; None once the goal is reached.

        Args:
            pose: the robot's x and y in m and yaw in rad, map frame.
        """
        x, y, yaw = pose
        apart = self._points - (x, y)
        distances = np.hypot(apart[:, 0], apart[:, 1])
        last = len(self._points) - 1
        while self._next < last and distances[self._next] < self._config.waypoint_radius_m:
            self._next += 1
        self.reached = self.reached or distances[last] < self._config.goal_radius_m
        if self.reached:
            return None
        cos, sin = math.cos(yaw), math.sin(yaw)
        two = apart[[self._next, min(self._next + 1, last)]]
        return two @ np.array([[cos, -sin], [sin, cos]])


def _corners(points: NDArray[np.float64], tolerance_m: float) -> list[int]:
    """Return the points that a polyline needs to stay within the tolerance (Douglas and Peucker, 1973)."""
    kept = {0, len(points) - 1}
    pending = [(0, len(points) - 1)]
    while pending:
        first, last = pending.pop()
        if last - first < 2:
            continue
        start, along = points[first], points[last] - points[first]
        off = points[first + 1 : last] - start
        length2 = float(along @ along)
        share = np.clip(off @ along / length2, 0.0, 1.0) if length2 > 0.0 else np.zeros(len(off))
        apart = np.linalg.norm(off - share[:, None] * along, axis=1)
        farthest = int(apart.argmax())
        if apart[farthest] > tolerance_m:
            middle = first + 1 + farthest
            kept.add(middle)
            pending += [(first, middle), (middle, last)]
    return sorted(kept)
