"""One agent's episodes: its starts, goals and waypoints, its contacts and what it is paid.

Everything random in episode ``k`` of agent ``i`` comes from ``stream(seed, "<purpose>/<split>", k, i, ...)``,
and each goal is drawn relative to the goal before it. So maps, starts, goals and control periods are the same
whatever the agent does, and whichever group and process holds it.
"""

import math
from collections import deque
from collections.abc import Sequence
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from rcdsac_trl.errors import UserInputError
from rcdsac_trl.robot.action import desired_velocities
from rcdsac_trl.robot.compiled_guard import CompiledGuard
from rcdsac_trl.robot.observation import Point, distance_and_bearing
from rcdsac_trl.robot.remembered_ranges import RememberedRanges
from rcdsac_trl.robot.robot_settings import PAPER, RobotSettings
from rcdsac_trl.robot.sectors import Sectors
from rcdsac_trl.seeding import stream
from rcdsac_trl.world.maps.generator import Split
from rcdsac_trl.world.maps.map_source import MapSource, make_map
from rcdsac_trl.world.maps.planner import Planner
from rcdsac_trl.world.maps.shapes import Map
from rcdsac_trl.world.render import Scene
from rcdsac_trl.world.sim.simulation import Simulation
from rcdsac_trl.world.task import rules
from rcdsac_trl.world.task.disturbances import PoseError, draw_disturbances
from rcdsac_trl.world.task.rules import TaskSettings

Pose = tuple[float, float, float]

# The agents of a process walk through the maps together. A few more maps stay, so that an agent that was
# reset alone, or an evaluation beside the training, does not make the others' map again.
_MAPS_KEPT = 8
_TRAIL_STEPS = 1000


@lru_cache(maxsize=_MAPS_KEPT)
def load_map(
    source: MapSource, split: Split, seed: int, index: int, robot_radius_m: float = PAPER.circumradius_m
) -> tuple[Map, Planner]:
    """Return a map and its planner, shared by all agents of this process.

    Args:
        source: what maps are made from.
        split: which of the disjoint map sets.
        seed: root seed.
        index: which map; episode ``k`` of every agent takes place on map ``k``.
        robot_radius_m: circumradius of the robot that drives there.
    """
    map_ = make_map(source, split, seed, index, robot_radius_m)
    return map_, Planner(map_, robot_radius_m)


def draw_motor_steps(task: TaskSettings, split: Split, seed: int, episode: int, agent_id: int) -> int:
    """Return how many motor steps an agent step of this episode takes: its control period."""
    rng = stream(seed, f"motor_steps/{split}", episode, agent_id)
    return int(rng.choice(task.motor_steps))


class NavigationAgent:
    """One robot in its own simulation.

    The simulation is made at the first reset, so that making an agent costs nothing.

    Args:
        map_settings: what maps are made from.
        task: rules of the task.
        mask: bins that the sensor has, bool [180].
        split: which of the disjoint map sets.
        agent_id: the agent's global number, which its random streams derive from.
        memory_s: for how long it remembers points that it saw, s; 0: not at all.
        gui: show PyBullet's window.
        robot: which one it is.

    Attributes:
        pose: x, y in m and yaw in rad, map frame.
        velocities: measured linear and angular velocity, then the desired ones, m/s and rad/s: o_velocity.
        in_contact: whether the robot was in contact in the last step; see
            :class:`~rcdsac_trl.world.sim.simulation.StepResult`.
        goal_reached: whether it reached its goal in the last step.
        reward_components: of the last step, see :func:`~rcdsac_trl.world.task.rules.reward_components`; zeros after
            a reset.
        distances_m: what the range sensor measures, float64 [180], m.
        remembered: what it remembers, float32 [90], see
            :class:`~rcdsac_trl.robot.remembered_ranges.RememberedRanges`; None without a memory.
    """

    pose: Pose
    velocities: tuple[float, float, float, float]
    in_contact: bool
    goal_reached: bool
    reward_components: tuple[float, ...]
    distances_m: NDArray[np.float64]
    remembered: NDArray[np.float32] | None

    def __init__(
        self,
        map_settings: MapSource,
        task: TaskSettings,
        mask: NDArray[np.bool_],
        split: Split,
        agent_id: int,
        memory_s: float = 0.0,
        gui: bool = False,
        robot: RobotSettings = PAPER,
    ) -> None:
        self._map_settings = map_settings
        self._task = task
        self._mask = mask
        self._split = split
        self._agent_id = agent_id
        self._gui = gui
        self._robot = robot
        self._memory = None
        if memory_s > 0.0:
            self._memory = RememberedRanges(mask, memory_s, robot)
        self._simulation: Simulation | None = None
        self._trail: deque[tuple[float, float]] = deque(maxlen=_TRAIL_STEPS)

    def reset(self, seed: int, episode: int) -> None:
        """Begin an episode, on the map of the same number."""
        self._seed, self._episode = seed, episode
        self._map, self._planner = load_map(self._map_settings, self._split, seed, episode, self._robot.circumradius_m)
        self.pose = x, y, _ = self._map.start or self._drawn_start()
        self._motor_steps = draw_motor_steps(self._task, self._split, seed, episode, self._agent_id)
        if self._simulation is None:
            self._simulation = Simulation(gui=self._gui, robot=self._robot)
        self._simulation.load(self._map, self._planner, self.pose, self._stream("movers"))
        self._noise = self._stream("noise")
        self._disturbances = draw_disturbances(self._task, self._stream("disturbances"))
        self._guard = None
        if self._disturbances.stop_zone:
            self._guard = CompiledGuard.of(self._robot, margin_m=self._task.stop_zone_margin_m)
        self._pose_error = PoseError(self._disturbances.pose_noise_std, self._stream("pose_error"))
        self._delayed: deque[tuple[float, float]] = deque([(0.0, 0.0)] * self._disturbances.action_delay_steps)
        self._goals_drawn = 0
        self._goal = x, y
        self._draw_goal()
        self._trail.clear()
        self.in_contact = self.goal_reached = False
        self.velocities = (0.0, 0.0, 0.0, 0.0)
        self.reward_components = (0.0,) * len(rules.REWARD_COMPONENTS)
        if self._memory is not None:
            self._memory.reset()
        self._sense(elapsed_s=0.0)

    def step(self, action: Sequence[float]) -> None:
        """Take one agent step with the desired velocities of an action."""
        self.drive(*desired_velocities(action, self._robot))

    def drive(self, v_u: float, omega_u: float) -> None:
        """Take one agent step with desired velocities, m/s and rad/s, slow turns that no action stands for included."""
        simulation, task, disturbances = self.simulation, self._task, self._disturbances
        v_u, omega_u = self._guarded(v_u, omega_u)
        self._delayed.append((v_u, omega_u))
        v, omega = self._delayed.popleft()
        reached = 1.0 - disturbances.motor_slowness
        moved = simulation.step(reached * v, reached * omega, self._motor_steps)
        collided = rules.collision_due(moved.in_contact, self.in_contact, task.collision_penalty_mode)
        self.in_contact = moved.in_contact
        self.pose = moved.pose
        # The step is paid for progress to the waypoint that was next while it was taken.
        _, bearing = distance_and_bearing(self.pose, self._path[self._next])
        self.goal_reached = self._distance_to(self._goal) < task.goal_radius_m
        self.reward_components = rules.reward_components(
            moved.v_c, bearing, omega_u, moved.in_contact, collided, self.goal_reached, self._robot
        )
        if self.goal_reached:
            self._draw_goal()
        else:
            self._take_waypoints()
        v_c, omega_c = rules.noisy_velocities(moved.v_c, moved.omega_c, disturbances.odometry_noise_std, self._noise)
        self.velocities = (v_c, omega_c, v_u, omega_u)
        self._sense(elapsed_s=self.period_s)

    def set_goal(self, x: float, y: float) -> Point:
        """Give the robot another goal; those that follow are drawn relative to it.

        Args:
            x: where it should be, map frame, m.
            y: likewise.

        Returns:
            Where it is: the nearest place that the robot can get to.
        """
        self._head_for(self._planner.nearest_free((x, y)))
        return self._goal

    def place(self, pose: Pose) -> None:
        """Put the robot somewhere else, at rest, with a new plan to its goal. What it remembers moves with it.

        Args:
            pose: x, y in m and yaw in rad, map frame.
        """
        self.simulation.place(pose)
        self.pose = self.simulation.pose
        self.velocities = (0.0, 0.0, 0.0, 0.0)
        self.in_contact = False
        self._head_for(self._goal)
        self._scan()

    def put_disc(self, x: float, y: float, radius_m: float) -> int:
        """Put a cylinder that the planner does not know; see :meth:`.Simulation.put_disc`."""
        number = self.simulation.put_disc(x, y, radius_m)
        self._scan()
        return number

    def move_disc(self, number: int, x: float, y: float) -> None:
        """Move a cylinder that was put; see :meth:`.Simulation.move_disc`."""
        self.simulation.move_disc(number, x, y)
        self._scan()

    @property
    def period_s(self) -> float:
        """Duration of an agent step of this episode, s."""
        return self._motor_steps * self._robot.motor_period_s

    def _guarded(self, v_u: float, omega_u: float) -> tuple[float, float]:
        """Return what a stop zone leaves of desired velocities; the robot is told that it wanted these."""
        if self._guard is None:
            return v_u, omega_u
        seen = Sectors(np.where(self._mask, self.distances_m, math.inf), self._mask, self._robot.lidar.max_range_m)
        v, omega, _ = self._guard.limit(v_u, omega_u, seen, self.velocities[:2])
        return v, omega

    @property
    def next_waypoints(self) -> tuple[Point, Point]:
        """The next waypoint and the one after it, m; on the last leg both are the goal."""
        return self._path[self._next], self._path[min(self._next + 1, len(self._path) - 1)]

    @property
    def believed_pose(self) -> Pose:
        """Where its localisation says that it is; what it is told of waypoints is told from there."""
        return self._pose_error.added_to(self.pose)

    @property
    def simulation(self) -> Simulation:
        """Its physics."""
        if self._simulation is None:
            raise UserInputError("the environment was stepped or drawn before its first reset; call reset() first")
        return self._simulation

    def scene(self) -> Scene:
        """Return what a picture of this moment shows."""
        simulation = self.simulation
        return Scene(
            map=self._map,
            pose=self.pose,
            distances_m=self.distances_m,
            sensor_mask=self._mask,
            waypoints=np.array(self._path[self._next :]),
            movers=np.column_stack([simulation.mover_positions, simulation.mover_radii]),
            trail=tuple(self._trail),
            in_contact=self.in_contact,
            robot=self._robot,
            **self._remembered_places(),
        )

    def _remembered_places(self) -> dict[str, NDArray[np.float64]]:
        """Return what a picture shows of what is remembered, by its names; nothing without a memory."""
        if self._memory is None:
            return {}
        remembered, expected = self._memory.places(self.pose)
        return {"remembered": remembered, "expected": expected}

    def close(self) -> None:
        """Disconnect from the physics engine."""
        if self._simulation is not None:
            self._simulation.close()
            self._simulation = None

    def _stream(self, purpose: str, *index: int) -> np.random.Generator:
        return stream(self._seed, f"{purpose}/{self._split}", self._episode, self._agent_id, *index)

    def _drawn_start(self) -> Pose:
        rng = self._stream("start")
        x, y = self._planner.sample_free(rng).tolist()
        return x, y, rng.uniform(-math.pi, math.pi)

    def _draw_goal(self) -> None:
        """Draw the next goal relative to the last one, and plan to it from where the robot is.

        The first is the map's own, where it has one.
        """
        goal: Point | NDArray[np.float64] | None = self._map.goal if self._goals_drawn == 0 else None
        if goal is None:
            rng = self._stream("goal", self._goals_drawn)
            goal = self._planner.sample_goal(rng, self._goal, self._task.min_path_m)
        self._goals_drawn += 1
        self._head_for(goal)

    def _head_for(self, goal: Point | NDArray[np.float64]) -> None:
        """Plan to a goal from where the robot is."""
        # As plain floats: single numbers out of arrays are slow, and every step reads some.
        self._path = [(x, y) for x, y in self._planner.waypoints(self.pose[:2], goal).tolist()]
        self._goal = self._path[-1]
        self._next = 0
        self._take_waypoints()

    def _take_waypoints(self) -> None:
        """Pass every corner point that is near enough; the goal itself stays until it is reached."""
        while self._next < len(self._path) - 1 and self._is_passed(self._next):
            self._next += 1

    def _is_passed(self, number: int) -> bool:
        """Say whether a waypoint is within reach and the one after it can be driven to from here."""
        distance_m = self._distance_to(self._path[number])
        if distance_m >= self._task.waypoint_radius_m:
            return False
        return distance_m < rules.SURE_WAYPOINT_RADIUS_M or self._planner.leg_is_free(
            self.pose[:2], self._path[number + 1]
        )

    def _distance_to(self, point: Point) -> float:
        return math.hypot(point[0] - self.pose[0], point[1] - self.pose[1])

    def _sense(self, elapsed_s: float) -> None:
        self._trail.append(self.pose[:2])
        self._scan()
        self._pose_error.step(elapsed_s)
        v_c, omega_c, _, _ = self.velocities
        memory = self._memory
        self.remembered = None if memory is None else memory.observe(self.distances_m, v_c, omega_c, elapsed_s)

    def _scan(self) -> None:
        noise = self._disturbances
        distances = self.simulation.scan()
        self.distances_m = rules.noisy_ranges(distances, noise.range_noise_std_m, noise.range_dropout, self._noise)
