"""The physics: one robot among the obstacles of one map, in one PyBullet client.

The world is seen from above: there is no floor and no gravity, walls and clutter are upright and higher than
the robot, and the robot cannot roll or pitch, so all contact forces are horizontal. The robot is a dynamic
body that is given its motor controller's velocities every motor period, 0.02 s; PyBullet moves it and lets contact take
velocity away, and what is left is what the robot measures.
"""

import math
import time
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from rcdsac_trl.errors import UserInputError
from rcdsac_trl.robot.action import clip_command
from rcdsac_trl.robot.range_sensor import NUM_BINS
from rcdsac_trl.robot.robot_settings import PAPER, RobotSettings
from rcdsac_trl.world.maps.generator import Map
from rcdsac_trl.world.maps.geometry import segment_clearance
from rcdsac_trl.world.sim import bodies
from rcdsac_trl.world.sim.bullet import Client, check_display, pybullet
from rcdsac_trl.world.sim.contact import CONTACT_DISTANCE_M, Contact, Touch, first_touch
from rcdsac_trl.world.sim.lidar import NearSegments, scan
from rcdsac_trl.world.sim.movers import Movers, WalkPlanner

SIMULATION_BYTES = 28_000_000
"""Memory that PyBullet takes for a simulation, however empty; where there is none left, it ends the process."""

# Movers farther than this from touching the robot, and farther than both can come nearer in an agent step, which is
# 0.2 m for the paper's robot, are moved in PyBullet only once an agent step.
_MOVER_SYNC_GAP_M = 0.5
_UPRIGHT = (0.0, 0.0, 0.0, 1.0)
# Added to how far the robot and a mover can come nearer to each other, for what rounding and contact add.
_SLACK_M = 0.02


class StepResult(NamedTuple):
    """What one agent step did.

    Attributes:
        pose: x, y in m and yaw in [-pi, pi] rad, map frame.
        v_c: linear velocity along the robot's x axis, measured after contact, m/s.
        omega_c: angular velocity, measured after contact, rad/s.
        in_contact: whether the robot touched anything in any of the motor steps, or has not been clear of everything
            for long enough since it did: see :mod:`rcdsac_trl.world.sim.contact`.
    """

    pose: tuple[float, float, float]
    v_c: float
    omega_c: float
    in_contact: bool


class Simulation:
    """One robot in one PyBullet client, which is freed with it or when it is closed.

    Equal loads and steps give bit-identical results, whatever the client simulated before.

    Args:
        gui: show PyBullet's window and run in real time; PyBullet allows one window a process.
        robot: which one it is.

    Raises:
        UserInputError: the window cannot be opened.

    Example:
        >>> from rcdsac_trl.seeding import stream
        >>> from rcdsac_trl.world.maps.generator import Map
        >>> from rcdsac_trl.world.maps.planner import Planner
        >>> empty = Map(layout="clutter", size_m=20.0, boxes=(), cylinders=(), movers=())
        >>> simulation = Simulation()
        >>> simulation.load(empty, Planner(empty), (5.0, 5.0, 0.0), stream(0, "movers"))
        >>> round(simulation.step(0.6, 0.0, motor_steps=7).v_c, 3)
        0.21
        >>> simulation.close()
    """

    def __init__(self, gui: bool = False, robot: RobotSettings = PAPER) -> None:
        self.robot = robot
        self._gui = gui
        if gui:
            check_display()
        self._connection = Client(pybullet.GUI if gui else pybullet.DIRECT)
        self._client = self._connection.number
        if self._client < 0 and not gui:
            raise UserInputError("PyBullet opens no more simulations in one process: use fewer agents or more workers")
        if self._client < 0:
            raise UserInputError("PyBullet could not open its window: gui=true needs a display; use gui=false")
        self._pose = (0.0, 0.0, 0.0)
        self._v_c = self._omega_c = 0.0
        self._driven = (0.0, 0.0)  # velocities that the motor set last
        self._touch: Touch | None = None
        self._clearance_m = 0.0
        self._contact = Contact(robot)

    def load(
        self,
        map: Map,
        planner: WalkPlanner,
        start_pose: tuple[float, float, float],
        movers_rng: np.random.Generator,
    ) -> None:
        """Forget the old world and build a new one, the robot at rest.

        Args:
            map: what stands and what moves there.
            planner: the map's planner; the movers' walks come from it.
            start_pose: the robot's x, y in m and yaw in rad.
            movers_rng: stream that the movers' walks are drawn from.
        """
        client = self._client
        # By keyword: the first positional argument is `flags`, and the client would be client 0. Unlike
        # removeBody this also frees the collision shapes.
        pybullet.resetSimulation(physicsClientId=client)
        pybullet.setPhysicsEngineParameter(
            fixedTimeStep=self.robot.motor_period_s,
            numSubSteps=1,
            deterministicOverlappingPairs=1,
            physicsClientId=client,
        )
        pybullet.setGravity(0.0, 0.0, 0.0, physicsClientId=client)
        visual = self._visual = -1 if self._gui else bodies.invisible_shape(client)
        self._static = bodies.StaticBodies(client, map, visual, whole=True if self._gui else None)
        self._static.follow(*start_pose[:2])
        self._robot = bodies.add_robot(client, start_pose, visual, self.robot)
        self._rest_at(start_pose)
        movers = self._movers = Movers(
            map, planner, start_pose[:2], movers_rng, self.robot.motor_period_s, self.robot.circumradius_m
        )
        self._mover_bodies = list(
            zip(bodies.add_movers(client, movers.discs, visual), movers.radii.tolist(), strict=True)
        )
        self._segments = NearSegments(map.segments(), self.robot.lidar.max_range_m)
        self._boxes, static = map.solids()
        self._put_bodies: list[int] = []
        self._sense_circles(static)
        if self._gui:
            bodies.look_from_above(client, map)

    def _rest_at(self, pose: tuple[float, float, float]) -> None:
        """Take down that the robot stands somewhere, and touches nothing."""
        x, y, yaw = pose
        self._pose = (float(x), float(y), math.remainder(yaw, 2.0 * math.pi))
        self._v_c = self._omega_c = self._clearance_m = 0.0
        self._driven = (0.0, 0.0)
        self._touch = None
        self._contact.end()

    def _sense_circles(self, standing: NDArray[np.float64]) -> None:
        """Let the scan see circles that stand, float64 [n, 3], and all movers."""
        # The last rows are the movers' own, so that they are sensed where they walk.
        self._circles = np.concatenate([standing, self._movers.discs])
        self._movers.discs = self._circles[len(standing) :]

    def place(self, pose: tuple[float, float, float]) -> None:
        """Put the robot somewhere else, at rest and without contact.

        Args:
            pose: x, y in m and yaw in rad, map frame; where the robot overlaps something, physics drives them apart.
        """
        self._rest_at(pose)
        x, y, yaw = self._pose
        turn = (0.0, 0.0, math.sin(yaw / 2.0), math.cos(yaw / 2.0))
        pybullet.resetBasePositionAndOrientation(self._robot, (x, y, 0.0), turn, self._client)
        pybullet.resetBaseVelocity(self._robot, (0.0, 0.0, 0.0), (0.0, 0.0, 0.0), self._client)

    def put_disc(self, x: float, y: float, radius_m: float) -> int:
        """Put an upright cylinder among what stands; it is gone with the next load.

        It is sensed and touched like everything else. Movers do not know it: their walks were planned without it, and
        they walk through it.

        Args:
            x: centre, map frame, m.
            y: likewise.
            radius_m: radius.

        Returns:
            Its number, from 0, for :meth:`move_disc`.
        """
        disc = np.array([[x, y, radius_m]])
        self._put_bodies += bodies.add_movers(self._client, disc, self._visual)
        self._sense_circles(np.concatenate([self._circles[: self._num_standing], disc]))
        self._clearance_m = 0.0  # not known until the next scan
        return len(self._put_bodies) - 1

    def move_disc(self, number: int, x: float, y: float) -> None:
        """Move a cylinder that was put.

        Args:
            number: as :meth:`put_disc` returned it.
            x: its new centre, map frame, m.
            y: likewise.
        """
        self._circles[self._num_standing - len(self._put_bodies) + number, :2] = x, y
        pybullet.resetBasePositionAndOrientation(self._put_bodies[number], (x, y, 0.0), _UPRIGHT, self._client)
        self._clearance_m = 0.0  # not known until the next scan

    @property
    def put_discs(self) -> NDArray[np.float64]:
        """Centre and radius of each cylinder that was put, float64 [n, 3], m; a copy."""
        return self._circles[self._num_standing - len(self._put_bodies) : self._num_standing].copy()

    @property
    def _num_standing(self) -> int:
        """Rows of the circles before the movers' own."""
        return len(self._circles) - len(self._movers.discs)

    def room_at(self, x: float, y: float, limit_m: float) -> float:
        """Return how far a place is from the nearest thing, movers among them, m, at most a limit.

        Args:
            x: of the place, map frame, m.
            y: likewise.
            limit_m: what is farther is not looked for.
        """
        return float(segment_clearance(x, y, x, y, self._boxes, self._circles, limit_m))

    @property
    def pose(self) -> tuple[float, float, float]:
        """The robot's x, y in m and yaw in [-pi, pi] rad, map frame."""
        return self._pose

    @property
    def mover_positions(self) -> NDArray[np.float64]:
        """Where the movers are, float64 [k, 2], m; a copy."""
        return self._movers.positions.copy()

    @property
    def mover_radii(self) -> NDArray[np.float64]:
        """The movers' radii, float64 [k], m; a copy."""
        return self._movers.radii.copy()

    @property
    def touch(self) -> Touch | None:
        """How the robot touched something first in the last step; None if it did not."""
        return self._touch

    def step(self, v_u: float, omega_u: float, motor_steps: int) -> StepResult:
        """Hold one pair of desired velocities for a number of motor steps.

        Args:
            v_u: desired linear velocity, m/s.
            omega_u: desired angular velocity, rad/s.
            motor_steps: how many motor periods, at least 1.
        """
        client, body, movers, robot = self._client, self._robot, self._movers, self.robot
        x, y, yaw = self._pose
        self._static.follow(x, y)
        v_c, omega_c = self._v_c, self._omega_c
        cos, sin = math.cos(yaw), math.sin(yaw)
        gap_m = movers.step(x, y)
        self._sync_movers(x, y)
        duration_s = motor_steps * robot.motor_period_s
        robot_m = max(abs(v_c), robot.fastest_m_per_s) * duration_s
        approach_m = robot_m + movers.fastest_m_per_s * duration_s + _SLACK_M
        sync_gap_m = max(_MOVER_SYNC_GAP_M, approach_m)
        # Movers that cannot notice the robot in this agent step walk through it at once.
        unnoticed = gap_m > max(movers.notice_gap_m, sync_gap_m) + approach_m and not self._gui
        if unnoticed:
            movers.step(x, y, motor_steps - 1)
        # Contacts that cannot be are not asked for, nor the velocities that only contact would change.
        self._touch = None
        touchable = self._clearance_m <= robot.circumradius_m + CONTACT_DISTANCE_M + approach_m
        self._clearance_m = 0.0  # not known until the next scan
        v, omega = self._driven
        for motor_step in range(motor_steps):
            before = x, y, yaw, v, omega
            if motor_step > 0 and not unnoticed:
                gap_m = movers.step(x, y)
                if gap_m < sync_gap_m or self._gui:
                    self._sync_movers(x, y, None if self._gui else sync_gap_m)
            v, omega = clip_command(v_u, omega_u, v_c, omega_c, robot.motor_period_s, robot)
            # By position, which PyBullet reads faster than keywords.
            linear, angular = (v * cos, v * sin, 0.0), (0.0, 0.0, omega)
            pybullet.resetBaseVelocity(body, linear, angular, client)
            pybullet.stepSimulation(client)
            (x, y, _), turn = pybullet.getBasePositionAndOrientation(body, client)
            if touchable:
                linear, angular = pybullet.getBaseVelocity(body, client)
            yaw = 2.0 * math.atan2(turn[2], turn[3])
            cos, sin = math.cos(yaw), math.sin(yaw)
            v_c = linear[0] * cos + linear[1] * sin
            omega_c = angular[2]
            if touchable and self._touch is None:
                points = pybullet.getContactPoints(bodyA=body, physicsClientId=client)
                if points:
                    walking = [number for number, _ in self._mover_bodies]
                    self._touch = first_touch(points, walking, before, motor_step)
            if self._gui:
                time.sleep(robot.motor_period_s)
        self._pose = (x, y, math.remainder(yaw, 2.0 * math.pi))
        self._v_c, self._omega_c = v_c, omega_c
        self._driven = v, omega
        touched = self._touch is not None
        in_contact = self._contact.after_step(touched, motor_steps, self._pose, self._boxes, self._circles)
        return StepResult(self._pose, v_c, omega_c, in_contact)

    def scan(self) -> NDArray[np.float64]:
        """Return the exact smallest distance from the robot's centre in each 2-degree sector.

        Returns:
            float64 [180], m; ``inf`` where nothing is within the sensor's reach. See
            :func:`rcdsac_trl.world.sim.lidar.sector_distances`.
        """
        distances = np.empty(NUM_BINS)
        x, y, yaw = self._pose
        segments, max_range_m = self._segments.near(x, y), self.robot.lidar.max_range_m
        self._clearance_m = scan(distances, x, y, yaw, segments, self._circles, max_range_m)
        return distances

    def close(self) -> None:
        """Disconnect from PyBullet; harmless when done before."""
        self._connection.close()
        self._client = -1

    def _sync_movers(self, robot_x: float, robot_y: float, gap_m: float | None = None) -> None:
        """Tell PyBullet where the movers are: all of them, or only those within a gap, m, of the robot."""
        near = math.inf if gap_m is None else self.robot.circumradius_m + gap_m
        for (body, radius), (x, y, _) in zip(self._mover_bodies, self._movers.discs.tolist(), strict=True):
            if gap_m is None or math.hypot(x - robot_x, y - robot_y) < near + radius:
                pybullet.resetBasePositionAndOrientation(body, (x, y, 0.0), _UPRIGHT, self._client)
