"""The worlds that the page shows: a map with goals as in training, and the office with its course."""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from rcdsac_trl.config.course_settings import OdometrySettings
from rcdsac_trl.deploy import Sectors
from rcdsac_trl.deploy.policy.path import PathFollower
from rcdsac_trl.errors import UserInputError
from rcdsac_trl.evaluation.course.course_drive import Conditions, CourseWorld
from rcdsac_trl.playground.drivers import Situation
from rcdsac_trl.robot.observation import distance_and_bearing
from rcdsac_trl.robot.planar import placed
from rcdsac_trl.robot.range_sensor import sensor_mask
from rcdsac_trl.robot.robot_settings import PAPER, RobotSettings
from rcdsac_trl.world.maps.map_source import MapSource
from rcdsac_trl.world.maps.shapes import Box, Map
from rcdsac_trl.world.office.building import Office
from rcdsac_trl.world.office.depth_cameras import Lens
from rcdsac_trl.world.render import Scene
from rcdsac_trl.world.sim.simulation import Simulation
from rcdsac_trl.world.task.episode import NavigationAgent
from rcdsac_trl.world.task.rules import TaskSettings, total_reward

OBSTACLE_RADIUS_M = 0.3
MOST_OBSTACLES = 4
"""So many obstacles can be put into a world."""
PUSH_M = 0.5
"""A push moves the robot so far aside, or as far as there is room."""

_OBSTACLE_HEIGHT_M = 1.0
# A push ends in front of what is nearer than this to the robot's circle.
_PUSH_GAP_M = 0.02
_PUSH_STEP_M = 0.05
_TRAIL_STEPS = 1000


@dataclass(frozen=True)
class Outcome:
    """What a step did.

    Attributes:
        reward: of it, as in training; None where nothing is paid.
        in_contact: whether the robot touched something.
        goal_reached: whether it reached its goal.
        speed_m_per_s: linear velocity as measured, backwards below 0.
    """

    reward: float | None
    in_contact: bool
    goal_reached: bool
    speed_m_per_s: float


class Arena(Protocol):
    """A world with one robot in it, from its start."""

    map: Map
    glass: Sequence[Box]
    """Of the map, what its sensor does not see."""
    robot: RobotSettings
    period_s: float

    @property
    def simulation(self) -> Simulation:
        """The physics."""
        ...

    def situation(self) -> Situation:
        """Return what the robot is asked on."""
        ...

    def step(self, v: float, omega: float) -> Outcome:
        """Let the robot do what it is told, m/s and rad/s, for a control period."""
        ...

    def scene(self) -> Scene:
        """Return what a picture of this moment shows."""
        ...

    def set_goal(self, x: float, y: float) -> None:
        """Send the robot to the place nearest to a point, m, that it can get to."""
        ...

    def check_room(self, x: float, y: float) -> None:
        """Refuse an obstacle outside of the map, or in the robot.

        Raises:
            UserInputError: saying where it may be.
        """
        ...

    def put_obstacle(self, x: float, y: float) -> None:
        """Put an obstacle somewhere, m."""
        ...

    def move_obstacle(self, number: int, x: float, y: float) -> None:
        """Move one that was put, counted from 0."""
        ...

    def push(self, side: float) -> None:
        """Push the robot aside: to its left for 1.0, to its right for -1.0."""
        ...

    def close(self) -> None:
        """Free the physics."""
        ...


def _check_room(arena: Arena, x: float, y: float) -> None:
    if not (0.0 <= x <= arena.map.size_m and 0.0 <= y <= arena.map.size_m):
        raise UserInputError("an obstacle cannot stand outside of the map: put it on the floor")
    if math.dist((x, y), arena.simulation.pose[:2]) < arena.robot.circumradius_m + OBSTACLE_RADIUS_M + _PUSH_GAP_M:
        raise UserInputError("an obstacle cannot stand in the robot: put it beside it")


def pushed(arena: Arena, side: float) -> tuple[float, float, float]:
    """Return the pose of a robot that is pushed aside as far as there is room, at most :data:`PUSH_M`."""
    x, y, yaw = arena.simulation.pose
    radius_m = arena.robot.circumradius_m + _PUSH_GAP_M
    best = x, y
    for step in range(1, round(PUSH_M / _PUSH_STEP_M) + 1):
        shift_m = side * step * _PUSH_STEP_M
        there = x - shift_m * math.sin(yaw), y + shift_m * math.cos(yaw)
        if arena.simulation.room_at(*there, 2.0 * radius_m) < radius_m:
            break
        best = there
    return *best, yaw


class MapArena:
    """A map of the evaluation split, on which goal follows goal, as in training.

    Args:
        source: what maps are made from.
        seed: root seed of map, start, goals and movers.
        robot: that drives.
        sensor: what is drawn of what it sees.
        memory_s: for how long what it remembers is drawn.

    Attributes:
        map: what stands.
        period_s: control period.
    """

    glass: Sequence[Box] = ()

    def __init__(self, source: MapSource, seed: int, robot: RobotSettings, sensor: str, memory_s: float) -> None:
        self.robot = robot
        self._covered = robot.lidar.mask
        self._agent = NavigationAgent(
            source, TaskSettings(), robot.sensor_mask(sensor), "evaluation", 0, memory_s=memory_s, robot=robot
        )
        self._agent.reset(seed, 0)
        self.map, self.period_s = self._agent.scene().map, self._agent.period_s

    @property
    def simulation(self) -> Simulation:
        """The physics."""
        return self._agent.simulation

    def situation(self) -> Situation:
        """Return what the robot is asked on."""
        agent = self._agent
        v, omega, *desired = agent.velocities
        seen = np.where(self._covered, agent.distances_m, np.inf)
        polar = [distance_and_bearing(agent.pose, point) for point in agent.next_waypoints]
        waypoints = np.array([(distance * math.cos(turn), distance * math.sin(turn)) for distance, turn in polar])
        sectors = Sectors(seen, self._covered, self.robot.lidar.max_range_m)
        return Situation(sectors, waypoints, (v, omega), (desired[0], desired[1]))

    def step(self, v: float, omega: float) -> Outcome:
        """Let the robot do what it is told."""
        agent = self._agent
        agent.drive(v, omega)
        return Outcome(
            float(total_reward(agent.reward_components)), agent.in_contact, agent.goal_reached, agent.velocities[0]
        )

    def scene(self) -> Scene:
        """Return what a picture of this moment shows."""
        return self._agent.scene()

    def set_goal(self, x: float, y: float) -> None:
        """Send the robot to the place nearest to a point that it can get to; then goals are drawn again."""
        self._agent.set_goal(x, y)

    def check_room(self, x: float, y: float) -> None:
        """Refuse an obstacle outside of the map, or in the robot."""
        _check_room(self, x, y)

    def put_obstacle(self, x: float, y: float) -> None:
        """Put an obstacle that the planner does not know."""
        self._agent.put_disc(x, y, OBSTACLE_RADIUS_M)

    def move_obstacle(self, number: int, x: float, y: float) -> None:
        """Move one that was put."""
        self._agent.move_disc(number, x, y)

    def push(self, side: float) -> None:
        """Push the robot aside."""
        self._agent.place(pushed(self, side))

    def close(self) -> None:
        """Free the physics."""
        self._agent.close()


class CourseArena:
    """The office; the robot drives the course forward, then back, and so on, by four cameras and odometry.

    Args:
        office: where.
        config: of who drives: its waypoint and goal radii.
        seed: root seed of people, cameras' noise and odometry's errors.

    Attributes:
        map: what stands.
        glass: walls of it that cameras do not see.
        period_s: control period, on average.
    """

    robot = PAPER
    period_s = 0.15

    def __init__(self, office: Office, config: Any, seed: int) -> None:
        self.map = office.map
        panes = (piece.footprint for piece in office.pieces if piece.glass)
        self.glass: Sequence[Box] = [pane for pane in panes if isinstance(pane, Box)]
        self._office, self._config = office, config
        conditions = Conditions(Lens(), OdometrySettings(), math.inf, seed)
        self._world = CourseWorld(
            office, config, "forward", 0, conditions, [(OBSTACLE_RADIUS_M, _OBSTACLE_HEIGHT_M)] * MOST_OBSTACLES
        )
        self._mask = sensor_mask("narrow")
        self._ways = [office.course[::-1], office.course]
        self._desired = (0.0, 0.0)
        self._in_contact = False
        self._trail: list[tuple[float, float]] = [self.simulation.pose[:2]]
        self._look()

    @property
    def simulation(self) -> Simulation:
        """The physics."""
        return self._world.simulation

    def _look(self) -> bool:
        """Take in what the cameras say and where to go; return whether the goal was reached."""
        self._seen = self._world.seen()
        waypoints = self._world.waypoints()
        reached = waypoints is None
        if waypoints is None:
            way = self._ways.pop(0)
            self._ways.append(way)
            here = self._world.odometry.pose[:2]
            self._follow([here, *self._office.planner.waypoints(here, way[0]), *way[1:]])
            waypoints = self._world.waypoints()
        assert waypoints is not None
        self._waypoints = waypoints
        return reached

    def _follow(self, path: list[NDArray[np.float64] | tuple[float, float]]) -> None:
        self._world.follower = PathFollower(np.array(path), self._config)

    def situation(self) -> Situation:
        """Return what the robot is asked on."""
        return Situation(self._seen, self._waypoints, self._world.velocity, self._desired)

    def step(self, v: float, omega: float) -> Outcome:
        """Let the robot do what it is told."""
        moved = self._world.step(v, omega)
        self._desired = v, omega
        self._in_contact = moved.in_contact
        self._trail = [*self._trail[1 - _TRAIL_STEPS :], moved.pose[:2]]
        return Outcome(None, moved.in_contact, self._look(), moved.v_c)

    def scene(self) -> Scene:
        """Return what a picture of this moment shows; the next two waypoints are where the robot takes them to be."""
        simulation = self.simulation
        next_two = placed(self._waypoints, simulation.pose)
        waypoints = np.concatenate([next_two, self._world.follower.ahead[2:]])
        return Scene(
            map=self.map,
            pose=simulation.pose,
            distances_m=self._seen.distances_m,
            sensor_mask=self._mask,
            waypoints=waypoints,
            movers=np.column_stack([simulation.mover_positions, simulation.mover_radii]),
            trail=tuple(self._trail),
            in_contact=self._in_contact,
        )

    def set_goal(self, x: float, y: float) -> None:
        """Send the robot to the place nearest to a point that it can get to, then back to the course's end."""
        here = self._world.odometry.pose[:2]
        goal = self._office.planner.nearest_free((x, y))
        self._follow([here, *self._office.planner.waypoints(here, goal)])
        self._look()

    def check_room(self, x: float, y: float) -> None:
        """Refuse an obstacle outside of the map, or in the robot."""
        _check_room(self, x, y)

    def put_obstacle(self, x: float, y: float) -> None:
        """Put an obstacle that nothing knows but the cameras."""
        self._world.put_disc(x, y)
        self._look()

    def move_obstacle(self, number: int, x: float, y: float) -> None:
        """Move one that was put."""
        self.simulation.move_disc(number, x, y)
        self._look()

    def push(self, side: float) -> None:
        """Push the robot aside; the localisation will notice."""
        pose = pushed(self, side)
        self.simulation.place(pose)
        self._look()

    def close(self) -> None:
        """Free the physics."""
        self._world.close()
