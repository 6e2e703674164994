"""Where to go next on a planned path: what the simulated robot's episodes do, for one that knows its pose."""

import math
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rcdsac_trl.deploy.policy.agent_config import AgentConfig
from rcdsac_trl.deploy.policy.polyline import Polyline, corners
from rcdsac_trl.deploy.sensors.arrays import numbers_of
from rcdsac_trl.errors import UserInputError
from rcdsac_trl.robot.planar import MOST_YAW_RAD, seen_from
from rcdsac_trl.robot.sectors import is_finite_number

# Waypoints are at most this far ahead along the path: the maps of training are 20 m wide.
_LOOK_AHEAD_M = 20.0
# A robot that is farther from its path is in another frame, or in another unit.
_FARTHEST_M = 75.0
# Beyond these, a path is not in metres, nor a pose; projected coordinates of maps have seven digits.
_LONGEST_LEG_M, _LONGEST_PATH_M, _LARGEST_COORDINATE_M = 500.0, 20_000.0, 1e8
# A path that is thinned more than this cuts through what stands beside it.
_LARGEST_TOLERANCE_M = 1.0
# A robot that is farther from where it was on its path was carried away, and begins anew at the nearest place.
_CARRIED_AWAY_M = 20.0
# A robot that is so many waypoint radii nearer to the part of the path before the leg it is on was pushed back there.
_PUSHED_BACK = 3.0

# How a new path is compared with the one before: 3 m ahead and behind, in steps of 0.5 m.
_COMPARED_M = np.concatenate([np.arange(-6, 0), np.arange(1, 7)]) / 2.0
# Paths that differ more, on average, are of different plans; places that differ by less fit equally well.
_OTHER_PLAN_M, _FITS_AS_WELL_M = 1.0, 0.25


class PathFollower:
    """Hands out the next two waypoints of a path, in the robot's frame.

    The robot's progress is where along the path it is: the nearest place to it, looked for around the last one, so that
    a path may cross itself, lead back or end where it begins. A waypoint gives way to the next within
    ``waypoint_radius_m``, or where progress has left it behind; one that was passed stays passed, unless the robot is
    pushed back by more than three radii. The goal, the last one, is reached within ``goal_radius_m``, on the last
    leg only. Agents were trained on corner points of shortest paths: a path of close points is first thinned to its
    corners, and of a leg that is longer than 20 m waypoints are handed out 20 m ahead.

    Args:
        path: points in the map frame, m, [n, 2], the goal last.
        config: of the agent, for both radii.
        tolerance_m: points that are this near to the line between their neighbours are no corners.

    Attributes:
        reached: whether the goal was reached.

    Raises:
        UserInputError: if the path holds no point, or no numbers, or is not in metres, or the tolerance is not, or the
            config has no radii.

    Example:
        >>> from types import SimpleNamespace
        >>> radii = SimpleNamespace(waypoint_radius_m=0.5, goal_radius_m=0.15)
        >>> PathFollower([(0.0, 0.0), (2.0, 0.0)], radii).update((0.0, 0.0, math.pi / 2)).round(6).tolist()
        [[0.0, -2.0], [0.0, -2.0]]
    """

    def __init__(self, path: Any, config: AgentConfig, *, tolerance_m: float = 0.05) -> None:
        if not (is_finite_number(tolerance_m) and 0.0 <= tolerance_m <= _LARGEST_TOLERANCE_M):
            raise UserInputError(
                f"tolerance_m={tolerance_m} is outside [0, {_LARGEST_TOLERANCE_M:g}], a path would be cut: give metres"
            )
        if not all(is_finite_number(getattr(config, name, None)) for name in ("waypoint_radius_m", "goal_radius_m")):
            raise UserInputError(f"config={config!r} has no waypoint_radius_m and goal_radius_m: give policy.config")
        self._config = config
        self._tolerance_m = tolerance_m
        self._line = self._line_of(path)
        self._planned: Polyline | None = self._line  # what is to be followed from the next pose on
        self._joined = False
        self._along_m = 0.0
        self._next = 0
        self.reached = False

    def replan(self, path: Any) -> None:
        """Follow another path to the end, from where the robot has got to on the one before.

        The same path, sent again, changes nothing. One that begins at the robot is followed from its start. Any other
        is followed from the place that fits best to where the robot was on the old one and to the way there; if none
        does, as a new one. A path that was driven to its end stays driven while the robot is there: for another lap
        of it, make a new follower.

        Args:
            path: as for the class.

        Raises:
            UserInputError: as by the class; then the path before stays.
        """
        self._planned = self._line_of(path)
        self.reached = self.reached and _apart(self._planned.points[-1], self._line.points[-1]) < self._goal_m

    def update(self, pose: tuple[float, float, float]) -> NDArray[np.float64] | None:
        """Return the next two waypoints in the robot's frame, m, [2, 2]; None once the goal is reached.

        Args:
            pose: the robot's x and y in m and yaw in rad, map frame.

        Raises:
            UserInputError: if the pose is none, or farther from the path than 75 m.
        """
        x, y, yaw = checked_pose(pose)
        _check_near(self._planned or self._line, (x, y))
        if self._planned is not None:
            self._take_over(self._planned, (x, y))
            self._planned = None
        if not self.reached:
            self._advance((x, y))
            is_last = self._next == len(self._line.points) - 1
            self.reached = is_last and _apart(self._line.points[-1], (x, y)) < self._goal_m
        if self.reached:
            return None
        return seen_from(self._two(), (x, y, yaw))

    @property
    def along_m(self) -> float:
        """How far along the path the robot has got, m."""
        return self._along_m

    @property
    def ahead(self) -> NDArray[np.float64]:
        """The corners of the path that are still to be reached, m, map frame, [k, 2]; the goal is the last one."""
        return self._line.points[self._next :]

    @property
    def _goal_m(self) -> float:
        return self._config.goal_radius_m

    @property
    def _radius_m(self) -> float:
        return self._config.waypoint_radius_m

    def _line_of(self, path: Any) -> Polyline:
        points = numbers_of(path, "a path's points")
        if points.ndim != 2 or points.shape[1] != 2 or not len(points) or not np.isfinite(points).all():
            raise UserInputError(f"a path of shape {list(points.shape)} is none: give finite points, [n, 2] in metres")
        if np.abs(points).max() > _LARGEST_COORDINATE_M:
            raise UserInputError(f"a path's point at {np.abs(points).max():g} is on no map: give metres")
        line = Polyline(corners(points, self._tolerance_m))
        longest = float(np.diff(line.along_m).max(initial=0.0))
        if longest > _LONGEST_LEG_M or line.length_m > _LONGEST_PATH_M:
            raise UserInputError(
                f"a path of {line.length_m:g} m, {longest:g} m of it straight on, is longer than {_LONGEST_PATH_M:g} m "
                f"or {_LONGEST_LEG_M:g} m straight on: give metres"
            )
        return line

    def _take_over(self, line: Polyline, here: tuple[float, float]) -> None:
        """Begin to follow a line, which may be the one that is followed, at the place that the robot has got to."""
        old, self._line = self._line, line
        was_reached, self.reached = self.reached, False
        if not self._joined or self._begins_at(here, old):
            return self._join(here)
        is_same = line.points.shape == old.points.shape and np.allclose(line.points, old.points, rtol=0.0, atol=1e-6)
        along_m = self._along_m if is_same else self._matching(old)
        if along_m is None or (was_reached and not self._is_over(along_m, here, old)):
            return self._join(here)
        if not is_same:
            self._go_to(along_m)
        self.reached = was_reached
        return None

    def _is_over(self, along_m: float, here: tuple[float, float], old: Polyline) -> bool:
        """Return whether the line is the old one, which was driven to its end, and the robot is still there."""
        line, radius_m = self._line, self._radius_m
        at_end = along_m > line.length_m - radius_m and _apart(line.points[-1], here) < radius_m
        return at_end and abs(line.length_m - old.length_m) < 2.0 * radius_m

    def _begins_at(self, here: tuple[float, float], old: Polyline) -> bool:
        """Return whether the line was planned from where the robot is, and not from where the old one began."""
        start = self._line.points[0]
        return _apart(start, here) < 2.0 * self._radius_m and _apart(start, old.points[0]) > self._radius_m

    def _join(self, here: tuple[float, float]) -> None:
        """Begin at the earliest place that is about as near as the nearest."""
        self._joined = True
        if len(self._line.points) == 1:
            return self._go_to(0.0)
        along_m, off = self._line.closest(here, 0.0, self._line.length_m)
        return self._go_to(float(along_m[np.argmax(off <= off.min() + self._radius_m)]))

    def _matching(self, old: Polyline) -> float | None:
        """Return how far along the line the place is that progress on the old line corresponds to; None if none is."""
        new, was_m = self._line, self._along_m
        if len(new.points) == 1:
            return None
        place = old.at(np.array([was_m]))[0]
        along_m, off = new.closest((float(place[0]), float(place[1])), 0.0, new.length_m)
        along_m = along_m[off <= off.min() + self._radius_m]
        behind = old.at(was_m + _COMPARED_M)
        differences = []
        for candidate in along_m.tolist():
            both = (was_m + _COMPARED_M >= 0.0) & (candidate + _COMPARED_M >= 0.0)
            apart = new.at(candidate + _COMPARED_M) - behind
            differences.append(float(np.hypot(apart[:, 0], apart[:, 1])[both].mean()))
        difference = np.array(differences)
        if difference.min() > _OTHER_PLAN_M:
            return None
        # A path that goes the same way twice fits twice: the one with as much of it behind, or ahead, is meant.
        left_m = np.abs((new.length_m - along_m) - (old.length_m - was_m))
        unlike = np.minimum(left_m, np.abs(along_m - was_m))
        unlike[difference > difference.min() + _FITS_AS_WELL_M] = np.inf
        return float(along_m[unlike.argmin()])

    def _go_to(self, along_m: float) -> None:
        """Take up progress at a place; the start itself is a waypoint to those who are before it."""
        self._along_m = along_m
        after = int(np.searchsorted(self._line.along_m, along_m, side="right"))
        self._next = min(after, len(self._line.points) - 1) if along_m > 0.0 else 0

    def _advance(self, here: tuple[float, float]) -> None:
        """Find the robot's progress, and the waypoint that is next."""
        line, radius_m = self._line, self._radius_m
        begin_m, ahead_m = self._around_m()
        along_m, off_m = line.nearest(here, begin_m, ahead_m)
        if off_m > _CARRIED_AWAY_M:
            self._join(here)
            begin_m, ahead_m = self._around_m()
            along_m, off_m = line.nearest(here, begin_m, ahead_m)
        if off_m > radius_m:
            # Who passes a corner at a distance is twice as far from there to the next leg, along the path.
            along_m, off_m = line.nearest(here, begin_m, ahead_m + 2.0 * (off_m - radius_m))
        if off_m > _PUSHED_BACK * radius_m and begin_m > 0.0:
            back_m, back_off_m = line.nearest(here, begin_m - 2.0 * off_m, begin_m)
            if back_off_m < off_m - _PUSHED_BACK * radius_m:
                return self._go_to(back_m)
        self._along_m = along_m
        last = len(line.points) - 1
        while self._next < last and (
            along_m > line.along_m[self._next] or _apart(line.points[self._next], here) < radius_m
        ):
            self._next += 1
            self._along_m = max(along_m, float(line.along_m[self._next - 1]))
        return None

    def _around_m(self) -> tuple[float, float]:
        """Return the stretch of the path on which progress is looked for: the leg, and a little ahead."""
        return float(self._line.along_m[max(self._next - 1, 0)]), self._along_m + self._radius_m

    def _two(self) -> NDArray[np.float64]:
        """Return the next two waypoints in the map frame, [2, 2]: corners, or places on the way to them."""
        along_m, last = self._line.along_m, len(self._line.points) - 1
        first_m = min(float(along_m[self._next]), self._along_m + _LOOK_AHEAD_M)
        after = self._next if first_m < along_m[self._next] else min(self._next + 1, last)
        return self._line.at(np.array([first_m, min(float(along_m[after]), first_m + _LOOK_AHEAD_M)]))


def _apart(a: NDArray[np.float64] | tuple[float, float], b: NDArray[np.float64] | tuple[float, float]) -> float:
    return math.hypot(a[0] - b[0], a[1] - b[1])


def _check_near(line: Polyline, here: tuple[float, float]) -> None:
    off_m = line.nearest(here, 0.0, line.length_m)[1]
    if off_m > _FARTHEST_M:
        raise UserInputError(
            f"the robot is {off_m:g} m from its path, more than {_FARTHEST_M:g} m: give pose and path in metres, in "
            "one frame"
        )


def checked_pose(pose: Any) -> tuple[float, float, float]:
    """Return a pose on a map, x and y in m and yaw in rad.

    Raises:
        UserInputError: if it is none, or in other units.
    """
    numbers = numbers_of(pose, "a pose's numbers")
    if numbers.shape != (3,) or not np.isfinite(numbers).all():
        raise UserInputError(f"the pose {numbers.tolist()} is not three finite numbers: give x, y in metres and yaw")
    x, y, yaw = numbers.tolist()
    if max(abs(x), abs(y)) > _LARGEST_COORDINATE_M:
        raise UserInputError(f"the pose's x={x:g}, y={y:g} are on no map: give metres")
    if abs(yaw) > MOST_YAW_RAD:
        raise UserInputError(f"the pose's yaw={yaw:g} is more than two turns: give radians, from -pi to pi")
    return x, y, yaw
