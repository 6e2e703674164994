"""What a trajectory costs a classical planner: the robot's own motion model through what it knows of its surroundings.

DWA and MPPI differ in which trajectories they look at; what one costs is the same for both.
"""

import math
from collections import namedtuple
from dataclasses import astuple, dataclass, field, fields
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rcdsac_trl.deploy.navigation.cost_to_go import cost_to_go
from rcdsac_trl.deploy.navigation.local_map import LocalMap, LocalMapSettings
from rcdsac_trl.errors import UserInputError
from rcdsac_trl.robot.limits import MEAN_PERIOD_S
from rcdsac_trl.robot.mover_tracks import MoverTracks, TrackSettings
from rcdsac_trl.robot.robot_settings import PAPER, RobotSettings
from rcdsac_trl.system.jit import njit
from rcdsac_trl.world.task.rules import MIN_TURN_FACTOR, STRAIGHT_FACTOR, TURN_SCALE, TaskSettings

# Waypoints nearer to each other are one: the goal.
_SAME_M = 1e-3
# A velocity that is missed by more was taken away by contact.
_STALLED_M_PER_S = 0.08
# Side of a cell of the cost-to-go, in cells of the local map.
_COARSER = 2


@dataclass(frozen=True)
class CostSettings:
    """What a trajectory costs, in metres of way.

    It gains what the way to the next waypoint becomes shorter; a metre gained counts 1.2 driving straight on and down
    to 0.5 while turning, as the task pays it.

    Attributes:
        collision_m: a step that pushes into something, m; one costs more than a horizon can gain, 2 m.
        margin_m: gap below which nearness costs, m: in the narrowest door, 0.9 m, 0.2 are left on either side.
        near_m_per_s: a second at gap 0, m; it falls as a square to 0 at the margin. Full speed gains 0.72 m in it, so
            it pays to go around, and to pass where there is no way around.
        near_price: what a metre of way costs more at gap 0, m; it falls likewise, and leads ways through the middle of
            gaps.
        blocked_price: what a metre of way through something costs, m; finite, since it may have walked off when the
            robot is there.
        ahead_m: a trajectory is continued straight by this, m, so that it is worth something to face the way.
        reverse: what a metre backwards costs more, m: the sensor does not look there.
        goal_m: what reaching the goal gains, m; the task pays 10, or 1.4 m.
        waypoint_radius_m: within it the next waypoint gives way to the one after, m; the task's.
        goal_radius_m: within it the goal is reached, m; the task's.

    Raises:
        UserInputError: if a value is negative, or the margin is 0.
    """

    collision_m: float = 3.0
    margin_m: float = 0.25
    near_m_per_s: float = 1.2
    near_price: float = 2.0
    blocked_price: float = 10.0
    ahead_m: float = 0.3
    reverse: float = 1.0
    goal_m: float = 1.0
    waypoint_radius_m: float = TaskSettings.waypoint_radius_m
    goal_radius_m: float = TaskSettings.goal_radius_m

    def __post_init__(self) -> None:
        """Refuse rewards for what should cost."""
        for each in fields(self):
            value = getattr(self, each.name)
            if not 0.0 <= value < math.inf or (each.name == "margin_m" and value == 0.0):
                raise UserInputError(f"{each.name}={value} must be a positive number")


# The settings, and what counts of a robot, as compiled code reads them.
_Weights: Any = namedtuple("_Weights", [each.name for each in fields(CostSettings)])  # type: ignore[misc]
_Robot: Any = namedtuple("_Robot", ["radius_m", "speed", "acceleration", "turn_acceleration", "dead_band", "per_turn"])


@dataclass(frozen=True)
class PlannerSettings:
    """What DWA and MPPI have in common.

    Attributes:
        local_map: what they remember.
        tracks: what they take as moving.
        cost: what counts.
    """

    local_map: LocalMapSettings = field(default_factory=LocalMapSettings)
    tracks: TrackSettings = field(default_factory=TrackSettings)
    cost: CostSettings = field(default_factory=CostSettings)


class TrajectoryCosts:
    """What one robot knows now, and what trajectories from here cost.

    Args:
        settings: what it remembers and what counts.
        sensed: which of the 180 sectors the sensor has, bool [180].
        steps: of the trajectories, :data:`~rcdsac_trl.robot.limits.MEAN_PERIOD_S` each.
        robot: that drives; its circumcircle stands for it.
        period_s: from one observation to the next, s.

    Attributes:
        local_map: what stands.
        tracks: what moves.
    """

    def __init__(
        self,
        settings: PlannerSettings,
        sensed: NDArray[np.bool_],
        steps: int,
        robot: RobotSettings = PAPER,
        period_s: float = MEAN_PERIOD_S,
    ) -> None:
        self.local_map = LocalMap(settings.local_map, sensed, robot.lidar.max_range_m)
        self.tracks = MoverTracks(settings.tracks, sensed, robot.lidar.max_range_m)
        self._robot = _Robot(
            robot.circumradius_m,
            robot.max_speed_m_per_s,
            robot.max_acceleration_m_per_s2,
            robot.max_angular_acceleration,
            robot.dead_band,
            robot.reward_per_turn,
        )
        self._weights = _Weights(*map(float, astuple(settings.cost)))
        self._cell_m = _COARSER * settings.local_map.cell_m
        n = settings.local_map.num_cells // _COARSER
        self._prices = np.zeros((n, n))
        self._ways = np.zeros((2, n, n))
        self._waypoints = np.zeros((2, 2))
        self._reach_m = robot.max_speed_m_per_s * MEAN_PERIOD_S * steps + settings.cost.waypoint_radius_m
        self._state = 0.0, 0.0, 0.0, 0.0, 0.0
        self._moving = self.tracks.moving
        self._period_s = period_s
        self._elapsed_s = 0.0

    def observe(
        self, ranges_m: NDArray[np.float64], waypoints_m: NDArray[np.float64], velocity: NDArray[np.float64]
    ) -> None:
        """Take in an observation; arguments as of :meth:`.controller.Controller.act`."""
        v, omega = float(velocity[0]), float(velocity[1])
        local_map = self.local_map
        local_map.move(v, omega, self._elapsed_s)
        if stalled := self._stalled(*velocity.tolist()):
            local_map.touch(math.copysign(self._robot.radius_m, stalled))
        self.tracks.observe(ranges_m, local_map.pose, self._elapsed_s)
        self._moving = self.tracks.moving
        local_map.observe(ranges_m, self._moving)
        self._elapsed_s = self._period_s
        x, y, yaw = local_map.pose.tolist()
        self._state = x, y, yaw, v, omega
        cos, sin = math.cos(yaw), math.sin(yaw)
        self._waypoints[:, 0] = x + cos * waypoints_m[:, 0] - sin * waypoints_m[:, 1]
        self._waypoints[:, 1] = y + sin * waypoints_m[:, 0] + cos * waypoints_m[:, 1]
        _write_prices(self._prices, local_map.field_m, self._weights, self._robot.radius_m)
        # The way to the second waypoint only where a trajectory can get to the first.
        for leg in range(2 if math.hypot(*waypoints_m[0]) < self._reach_m else 1):
            target = self._waypoints[leg, 0], self._waypoints[leg, 1]
            self._ways[leg] = cost_to_go(self._prices, local_map.corner, self._cell_m, target)

    def _stalled(self, v: float, omega: float, v_u: float, omega_u: float) -> float:
        """Return the velocity that the motors should have reached and did not, m/s; 0 where they did.

        Only contact takes velocity away. It is how a robot that has backed into what it cannot see learns of it.
        """
        _, _, _, v_before, omega_before = self._state
        limits = self._robot.acceleration, self._robot.turn_acceleration
        expected, _ = next_velocities(v_u, omega_u, v_before, omega_before, self._period_s, *limits)
        return expected if self._elapsed_s > 0.0 and abs(expected) > abs(v) + _STALLED_M_PER_S else 0.0

    def of(self, controls: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return the costs of trajectories, float64 [k], m.

        Args:
            controls: desired velocities in each step, float64 [k, steps, 2], m/s and rad/s, within the robot's.
        """
        costs = np.empty(len(controls))
        layers = self.local_map.field_m, self._ways
        grid = (*self.local_map.corner, self.local_map.settings.cell_m)
        known = self._moving, self._weights, self._robot
        _costs(costs, controls, self._state, self._waypoints, layers, grid, *known)
        return costs


# ------------------------------------------------------------------------------------------------ compiled
# All that the compiled code uses stands in this file: Numba's cache notices no change of another one.
@njit
def next_velocities(
    v_u: float,
    omega_u: float,
    v: float,
    omega: float,
    period_s: float,
    acceleration: float = PAPER.max_acceleration_m_per_s2,
    turn_acceleration: float = PAPER.max_angular_acceleration,
) -> tuple[float, float]:
    """Return the velocities after a period, as :func:`rcdsac_trl.robot.action.clip_command` has them."""
    dv, domega = acceleration * period_s, turn_acceleration * period_s
    return min(max(v_u, v - dv), v + dv), min(max(omega_u, omega - domega), omega + domega)


@njit
def _value_at(values: np.ndarray, x0: float, y0: float, cell_m: float, x: float, y: float) -> float:
    """Return a field at a place, bilinear between the middles of its cells; outside as at the border."""
    last = values.shape[0] - 1
    across = min(max((x - x0) / cell_m - 0.5, 0.0), last - 1e-6)
    along = min(max((y - y0) / cell_m - 0.5, 0.0), last - 1e-6)
    i, j = int(along), int(across)
    fy, fx = along - i, across - j
    low = values[i, j] * (1.0 - fx) + values[i, j + 1] * fx
    high = values[i + 1, j] * (1.0 - fx) + values[i + 1, j + 1] * fx
    return low * (1.0 - fy) + high * fy


@njit
def _write_prices(prices: np.ndarray, field_m: np.ndarray, weights: Any, radius_m: float) -> None:
    """Write what a metre of way costs, [n, n], from the distances to the nearest point in twice as many cells."""
    for i in range(prices.shape[0]):
        for j in range(prices.shape[1]):
            cells = field_m[_COARSER * i : _COARSER * (i + 1), _COARSER * j : _COARSER * (j + 1)]
            gap = cells.mean() - radius_m
            near = max(0.0, 1.0 - gap / weights.margin_m)
            if gap < 0.0:
                prices[i, j] = weights.blocked_price * (1.0 - gap / radius_m)
            else:
                prices[i, j] = 1.0 + weights.near_price * near * near


@njit
def _costs(
    costs: np.ndarray,
    controls: np.ndarray,
    state: tuple,
    waypoints: np.ndarray,
    layers: tuple,
    grid: tuple,
    moving: np.ndarray,
    weights: Any,
    robot: Any,
) -> None:
    """Write the cost of each trajectory; every one is computed by itself."""
    for k in range(len(costs)):
        costs[k] = _cost(controls[k], state, waypoints, layers, grid, moving, weights, robot)


@njit
def _cost(
    controls: np.ndarray,
    state: tuple,
    waypoints: np.ndarray,
    layers: tuple,
    grid: tuple,
    moving: np.ndarray,
    weights: Any,
    robot: Any,
) -> float:
    """Return the cost of one trajectory.

    Args:
        controls: desired velocities in each step, [steps, 2].
        state: x, y, yaw, v and omega.
        waypoints: the next two, [2, 2].
        layers: distance to the nearest point, of the local map, and the ways to each of the waypoints, [2, n, n].
        grid: lower corner of the fields, x and y, and the side of a cell of the local map, m.
        moving: of :class:`MoverTracks`.
        weights: of :class:`CostSettings`.
        robot: what counts of the robot.
    """
    x, y, yaw, v, omega = state
    field_m, ways = layers
    x0, y0, cell_m = grid
    way_cell_m = _COARSER * cell_m
    goal_x, goal_y = waypoints[1, 0], waypoints[1, 1]
    target_x, target_y = waypoints[0, 0], waypoints[0, 1]
    last_leg = math.hypot(goal_x - target_x, goal_y - target_y) < _SAME_M
    way = ways[0]
    left_m = _value_at(way, x0, y0, way_cell_m, x, y)
    gap = _value_at(field_m, x0, y0, cell_m, x, y) - robot.radius_m
    cost = 0.0
    steps = len(controls)
    for t in range(steps):
        v_u, omega_u = controls[t, 0], controls[t, 1]
        if abs(omega_u) < robot.dead_band:
            omega_u = 0.0
        v_before, omega_before = v, omega
        v, omega = next_velocities(v_u, omega_u, v, omega, MEAN_PERIOD_S, robot.acceleration, robot.turn_acceleration)
        turn = 0.5 * (omega_before + omega) * MEAN_PERIOD_S
        driven_m = 0.5 * (v_before + v) * MEAN_PERIOD_S
        x_before, y_before, gap_before = x, y, gap
        x += driven_m * math.cos(yaw + 0.5 * turn)
        y += driven_m * math.sin(yaw + 0.5 * turn)
        yaw += turn
        gap = _value_at(field_m, x0, y0, cell_m, x, y) - robot.radius_m
        for disc_x, disc_y, disc_vx, disc_vy, radius, _ in moving:
            away_x, away_y = (
                x - disc_x - disc_vx * (t + 1) * MEAN_PERIOD_S,
                y - disc_y - disc_vy * (t + 1) * MEAN_PERIOD_S,
            )
            gap = min(gap, math.hypot(away_x, away_y) - radius - robot.radius_m)
        if gap < 0.0 and gap < gap_before:
            # Contact stops the robot, as it does in the world.
            x, y, v, driven_m, gap = x_before, y_before, 0.0, 0.0, gap_before
            cost += weights.collision_m
        if gap < weights.margin_m:
            near = min(1.0, 1.0 - gap / weights.margin_m)
            cost += weights.near_m_per_s * near * near * MEAN_PERIOD_S
        if driven_m < 0.0:
            cost -= weights.reverse * driven_m
        before_m, left_m = left_m, _value_at(way, x0, y0, way_cell_m, x, y)
        gained_m = before_m - left_m
        if gained_m > 0.0:
            turning = max(MIN_TURN_FACTOR, 1.0 - robot.per_turn * abs(omega_u) / TURN_SCALE)
            gained_m *= STRAIGHT_FACTOR if omega_u == 0.0 else turning
        cost -= gained_m
        straight_m = math.hypot(target_x - x, target_y - y)
        if last_leg and straight_m < weights.goal_radius_m:
            # Whatever the next goal is, the time that is left gains as much as full speed does.
            saved_s = MEAN_PERIOD_S * (steps - 1 - t)
            braking_m = 0.5 * v * abs(v) / robot.acceleration
            stop_x, stop_y = x + braking_m * math.cos(yaw), y + braking_m * math.sin(yaw)
            if _value_at(field_m, x0, y0, cell_m, stop_x, stop_y) < robot.radius_m:
                cost += weights.collision_m
            return cost - weights.goal_m - weights.ahead_m - STRAIGHT_FACTOR * robot.speed * saved_s
        if not last_leg and straight_m < weights.waypoint_radius_m:
            target_x, target_y, last_leg = goal_x, goal_y, True
            way = ways[1]
            left_m = _value_at(way, x0, y0, way_cell_m, x, y)
    ahead_x, ahead_y = x + weights.ahead_m * math.cos(yaw), y + weights.ahead_m * math.sin(yaw)
    return cost + _value_at(way, x0, y0, way_cell_m, ahead_x, ahead_y) - left_m
