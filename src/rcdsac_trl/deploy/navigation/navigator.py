"""What stands between a path and an agent: other waypoints where the way is blocked, and ways out of a standstill.

It knows what an agent knows: ranges, the next two waypoints, velocities. All that it remembers is in the frame of the
odometry, so a localisation that corrects itself changes nothing of it. It may be given a map besides, and where the
robot is on it: what that shows moves with every correction.
"""

import math
from collections import deque
from dataclasses import dataclass, field, replace
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from rcdsac_trl.deploy.navigation.detour import Place, is_clear, plan_detour
from rcdsac_trl.deploy.navigation.local_map import Clearances, LocalMap, LocalMapSettings, clearances_around
from rcdsac_trl.deploy.navigation.static_layer import Pose, StaticLayer
from rcdsac_trl.deploy.navigation.watchdog import Watchdog, WatchdogSettings
from rcdsac_trl.errors import UserInputError
from rcdsac_trl.robot.mover_tracks import MoverTracks, TrackSettings
from rcdsac_trl.robot.observation import AT_ORIGIN
from rcdsac_trl.robot.planar import placed, seen_from
from rcdsac_trl.robot.range_sensor import BIN_RAD, NUM_BINS
from rcdsac_trl.robot.robot_settings import PAPER, RobotSettings
from rcdsac_trl.robot.sectors import Sectors, check_switches

# Places that the robot was at are kept so far apart, and so many of them: for a metre and a half.
_TRAIL_STEP_M, _TRAIL_PLACES = 0.02, 75
# A detour is planned anew after so long, s; its corner gives way to the next within this, m.
_REPLAN_S, _CORNER_M = 0.4, 0.3
_NOT_MOVED = np.zeros(3)
_NOT_MOVED.flags.writeable = False
# Two waypoints nearer to each other are one, the goal.
_SAME_M = 1e-3
# What walks is told by so many points around its middle, 4 cm apart.
_TURNS_RAD = np.linspace(0.0, 2.0 * math.pi, 40, endpoint=False)
_AROUND = np.stack([np.cos(_TURNS_RAD), np.sin(_TURNS_RAD)], axis=1)
# Where a map is known, detours are planned on so large a square of it, m: the way around a wall may be long.
_WIDE_M = 20.0


@dataclass(frozen=True)
class NavigatorSettings:
    """What a navigator does.

    Attributes:
        replan: hand out the corners of a detour where the way to the next waypoint is blocked.
        blocked_s: for how long it must have been, s: agents drive around small things by themselves, and what walks
            is often gone by then.
        memory_s: what was seen is forgotten after so long, s.
        watchdog: when it helps an agent that stands still, and how; None: never.

    Raises:
        UserInputError: if a value is outside its limits.
    """

    replan: bool = True
    blocked_s: float = 3.0
    memory_s: float = 30.0
    watchdog: WatchdogSettings | None = field(default_factory=WatchdogSettings)

    def __post_init__(self) -> None:
        """Refuse what remembers nothing."""
        check_switches(self, "replan")
        if not isinstance(self.watchdog, WatchdogSettings | None):
            raise UserInputError(
                f"watchdog={self.watchdog!r} of a navigator is no WatchdogSettings(..): give that, None for none, or "
                "NavigatorSettings.switched(replan=True, watchdog=True)"
            )
        for name, low in (("blocked_s", 0.0), ("memory_s", 0.1)):
            if not low <= getattr(self, name) < math.inf:
                raise UserInputError(f"{name}={getattr(self, name)} of a navigator must be at least {low:g} seconds")

    @classmethod
    def switched(cls, *, replan: bool, watchdog: bool) -> "NavigatorSettings":
        """Return the defaults of what is switched on, and nothing else.

        Example:
            >>> NavigatorSettings.switched(replan=True, watchdog=False) == NavigatorSettings(watchdog=None)
            True
        """
        return cls(replan=replan, watchdog=WatchdogSettings() if watchdog else None)


class Advice(NamedTuple):
    """What a navigator makes of an observation.

    Attributes:
        waypoints: the next two, m, in the robot's frame.
        boldness: how far beta is to be turned from what was asked for to its boldest, in [0, 1].
        instead: velocities to drive with whatever the agent wants, m/s and rad/s; None: the agent drives.
        been: where the robot has been while it drove ahead, in its frame now, float64 [k, 2], m.
    """

    waypoints: tuple[Place, Place]
    boldness: float
    instead: tuple[float, float] | None
    been: NDArray[np.float64]


class Navigator:
    """Advises one agent; :class:`rcdsac_trl.deploy.Policy` asks it if it is given one.

    Args:
        settings: what it does.
        robot: that the agent drives.
        static_layer: what a map shows; None: it knows what was seen alone.

    Attributes:
        settings: as given.
        robot: likewise.
        static_layer: likewise; it may be changed.

    Example:
        >>> navigator = Navigator(NavigatorSettings(blocked_s=0.0))
        >>> ranges_m = np.full(180, np.inf)
        >>> ranges_m[:12] = ranges_m[-2:] = 1.0  # something ahead, more of it to the left
        >>> ahead = ((2.5, 0.0), (4.0, 0.0))
        >>> advice = navigator.advise(ranges_m, np.ones(180, bool), ahead, (0.0, 0.0), 0.0)
        >>> advice.waypoints[0][1] < -0.2  # past it on the right
        True
    """

    def __init__(
        self,
        settings: NavigatorSettings = NavigatorSettings(),
        robot: RobotSettings = PAPER,
        static_layer: StaticLayer | None = None,
    ) -> None:
        self.settings = settings
        self.static_layer = static_layer
        self.robot = robot
        self.reset()
        # Now, not before the first thing in the way: where nothing is kept of it yet, compiling takes seconds, and a
        # base may drive on meanwhile.
        if settings.replan:
            plan_detour(self._map.clearances, (0.0, 0.0), (1.0, 0.0), robot.circumradius_m)

    def reset(self) -> None:
        """Forget everything: the robot was put somewhere else, or has a new task."""
        nothing = np.zeros(NUM_BINS, np.bool_)
        max_range_m = self.robot.lidar.max_range_m
        self._map = LocalMap(LocalMapSettings(memory_s=self.settings.memory_s), nothing, max_range_m)
        self._tracks = MoverTracks(TrackSettings(), nothing, max_range_m)
        # Where the robot was, and when, s.
        self._trail: deque[tuple[float, float, float]] = deque(maxlen=_TRAIL_PLACES)
        self._time_s = 0.0
        self._far: Clearances | None = None
        self._far_s = 0.0
        self._blocked_s = self._planned_s = 0.0
        self._detour: list[Place] = []
        settings = self.settings.watchdog
        self._watchdog = None if settings is None else Watchdog(settings, self.robot)

    def advise(
        self,
        distances_m: NDArray[np.float64],
        covered: NDArray[np.bool_],
        waypoints: tuple[Place, Place],
        velocity: tuple[float, float],
        elapsed_s: float,
        pose: Pose | None = None,
    ) -> Advice:
        """Take in what is known now, and say how to go on.

        Args:
            distances_m: of the range sensor, by sector, float64 [180], ``inf`` where nothing is.
            covered: which sectors say something now, bool [180].
            waypoints: the next two, x and y in m, robot's frame.
            velocity: measured, m/s and rad/s.
            elapsed_s: since the last call, 0 at the first, s.
            pose: of the robot in the frame of the static layer, x and y in m and yaw in rad; None: nothing is known of
                the map around it.
        """
        self._observe(distances_m, covered, velocity, elapsed_s, pose)
        self._look_far(elapsed_s, pose)
        next_two = self._waypoints(waypoints, elapsed_s) if self.settings.replan else waypoints
        boldness, instead = 0.0, None
        been = seen_from(np.array(self._trail).reshape(-1, 3)[:, :2], self._map.pose)
        if self._watchdog is not None:
            self._watchdog.observe(self._map.place, elapsed_s)
            boldness = self._watchdog.boldness
            instead = self._watchdog.way_out(self._map.place, been, elapsed_s)
            # While it braked it got a little farther than it was ever driven to.
            been = np.vstack([been, AT_ORIGIN[:2]])
        return Advice(next_two, boldness, instead, been)

    def _observe(
        self,
        distances_m: NDArray[np.float64],
        covered: NDArray[np.bool_],
        velocity: tuple[float, float],
        elapsed_s: float,
        pose: Pose | None,
    ) -> None:
        seen_m = np.where(covered, distances_m, np.inf)
        self._map.sensed = covered
        self._map.move(*velocity, elapsed_s)
        self._tracks.observe(seen_m, self._map.pose, elapsed_s, covered)
        standing = self._on_map_within(0.5 * self._map.settings.size_m, pose)
        self._map.observe(seen_m, self._tracks.moving, placed(standing, self._map.pose))
        self._leave_trail(velocity[0], elapsed_s)

    def _leave_trail(self, v: float, elapsed_s: float) -> None:
        """Remember where the robot has driven ahead, and that for no longer than what was seen."""
        self._time_s += elapsed_s
        while self._trail and self._trail[0][2] < self._time_s - self.settings.memory_s:
            self._trail.popleft()
        # Only ahead: who backs a little beyond what it knows must not take that as known.
        here = self._map.place
        if not self._trail or (v > 0.0 and math.dist(self._trail[-1][:2], here) > _TRAIL_STEP_M):
            self._trail.append((*here, self._time_s))

    def _waypoints(self, waypoints: tuple[Place, Place], elapsed_s: float) -> tuple[Place, Place]:
        """Return the next two waypoints, of a detour where the way to the first is blocked."""
        radius_m = self.robot.circumradius_m
        target, after = self._placed(waypoints[0]), self._placed(waypoints[1])
        known = [self._map.clearances, *([] if self._far is None else [self._far])]
        if all(is_clear(clearances, self._map.place, target, radius_m) for clearances in known):
            self._blocked_s = 0.0
            self._detour = []
            return waypoints
        self._blocked_s += elapsed_s
        if self._blocked_s < self.settings.blocked_s:
            return waypoints
        self._planned_s += elapsed_s
        if not self._detour or self._planned_s >= _REPLAN_S:
            self._detour, self._planned_s = self._planned(target, after), 0.0
        while len(self._detour) > 1 and math.dist(self._detour[0], self._map.place) < _CORNER_M:
            self._detour = self._detour[1:]
        if not self._detour:
            return waypoints
        places = seen_from(np.array([*self._detour, after]), self._map.pose).tolist()
        return (places[0][0], places[0][1]), (places[1][0], places[1][1])

    def _planned(self, target: Place, after: Place) -> list[Place]:
        """Return the corners of a way to the next waypoint, beside it where something stands on it; [] without one.

        Where there is none, or the robot is beside it and it still is the next one, they lead to the one after it.
        """
        clearances = self._map.clearances if self._far is None else self._far
        here, radius_m = self._map.place, self.robot.circumradius_m
        corners = plan_detour(clearances, here, target, radius_m)
        arrived = bool(corners) and corners[-1] != target and math.dist(corners[-1], here) < _CORNER_M
        if (arrived or not corners) and math.dist(target, after) > _SAME_M:
            return plan_detour(clearances, here, after, radius_m) or corners
        return corners

    def _look_far(self, elapsed_s: float, pose: Pose | None) -> None:
        """Keep what detours are planned on: what is remembered, and far around it what the map shows."""
        self._far_s += elapsed_s
        if self.static_layer is None or pose is None or not self.settings.replan:
            self._far = None
        elif self._far is None or self._far_s >= _REPLAN_S:
            standing = placed(self._on_map_within(0.5 * _WIDE_M, pose), self._map.pose)
            points = np.concatenate([self._map.remembered, standing])
            around = clearances_around(self._map.place, points, _WIDE_M, self._map.settings) if len(standing) else None
            self._far, self._far_s = around, 0.0

    def _on_map_within(self, reach_m: float, pose: Pose | None) -> NDArray[np.float64]:
        """Return the edges that the map shows in a square around a pose on it, in the robot's frame, m, [k, 2]."""
        if self.static_layer is None or pose is None:
            return np.empty((0, 2))
        return self.static_layer.around(pose, reach_m)

    def known(
        self, sectors: Sectors, pose: Pose | None, reach_m: float, moved: NDArray[np.float64] = _NOT_MOVED
    ) -> Sectors:
        """Return what a stop zone minds: what is seen, remembered where nothing is, or on the map.

        What walks is expected where its velocity has led it since it left the view.

        Args:
            sectors: what the range sensor says.
            pose: as in :meth:`advise`.
            reach_m: how far the stop zone looks; what the map shows farther away is left out.
            moved: since :meth:`advise`, x and y in m and yaw in rad, float64 [3].
        """
        remembered = np.concatenate([self._map.remembered, self._edges_of_movers()])
        unseen_m = self._nearest_m(seen_from(seen_from(remembered, self._map.pose), moved))
        known_m = np.where(sectors.covered, sectors.distances_m, unseen_m)
        # On the map is what no sensor sees, too.
        known_m = np.minimum(known_m, self._nearest_m(self._on_map_within(reach_m, pose)))
        return replace(sectors, distances_m=known_m)

    def _edges_of_movers(self) -> NDArray[np.float64]:
        """Return points around what walks, where it is expected now, in the frame of the odometry, m, [k, 2]."""
        moving = self._tracks.moving
        edges: NDArray[np.float64] = moving[:, None, :2] + moving[:, None, 4:5] * _AROUND
        return edges.reshape(-1, 2)

    def _nearest_m(self, points: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return how far the nearest of points in the robot's frame is, by sector, float64 [180]; ``inf``: none."""
        apart = np.hypot(points[:, 0], points[:, 1])
        counts = apart > self.robot.body_radius_m
        bins = np.floor(np.arctan2(points[counts, 1], points[counts, 0]) / BIN_RAD).astype(np.intp) % NUM_BINS
        nearest_m = np.full(NUM_BINS, np.inf)
        np.minimum.at(nearest_m, bins, apart[counts])
        return nearest_m

    def _placed(self, point: Place) -> Place:
        """Return a point of the robot's frame in that of the odometry."""
        ((x, y),) = placed(np.array([point]), self._map.pose).tolist()
        return x, y
