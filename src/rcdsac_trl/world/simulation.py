"""The physics: one robot among the obstacles of one map, in one PyBullet client.

The world is seen from above: there is no floor and no gravity, walls and clutter are upright and higher than
the robot, and the robot cannot roll or pitch, so all contact forces are horizontal. The robot is a dynamic
body that is given its motor controller's velocities every 0.02 s; PyBullet moves it and lets contact take
velocity away, and what is left is what the robot measures.
"""

import math
import time
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from rcdsac_trl.errors import UserInputError
from rcdsac_trl.interface import MAX_LINEAR_VELOCITY, MOTOR_PERIOD_S, clip_command
from rcdsac_trl.world.bullet import pybullet
from rcdsac_trl.world.geometry import ROBOT_RADIUS_M
from rcdsac_trl.world.lidar import scan
from rcdsac_trl.world.maps import Box, Cylinder, Map
from rcdsac_trl.world.movers import Movers, WalkPlanner

CONTACT_DISTANCE_M = 1e-3
"""The robot is in contact with what is nearer than this.

The solver lets a pushing robot rest within about 0.01 mm of a wall, on either side of it; with a limit of 0
mm, leaning on a wall would read as a series of collisions.
"""

SHAPES_PER_BODY = 16
"""Static shapes are joined to compound bodies of up to so many: a body each makes a step 8 times as slow."""

_ROBOT_MASS_KG = 10.0
_ROBOT_HALF_HEIGHT_M = 0.1
_OBSTACLE_HALF_HEIGHT_M = 0.5
# That of a uniform cylinder about its axis; about the other two axes nothing can turn the robot.
_ROBOT_INERTIA = (1e9, 1e9, 0.5 * _ROBOT_MASS_KG * ROBOT_RADIUS_M**2)
# Movers farther than this from touching the robot are moved in PyBullet only once an agent step, in which
# both together go at most 0.2 m.
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
        in_contact: whether the robot touched anything in any of the motor steps.
    """

    pose: tuple[float, float, float]
    v_c: float
    omega_c: float
    in_contact: bool


class Simulation:
    """One robot in one PyBullet client.

    Equal loads and steps give bit-identical results, whatever the client simulated before.

    Args:
        gui: show PyBullet's window and run in real time; PyBullet allows one window a process.

    Raises:
        UserInputError: the window cannot be opened.

    Example:
        >>> from rcdsac_trl.seeding import stream
        >>> from rcdsac_trl.world.maps import Map
        >>> from rcdsac_trl.world.planner import Planner
        >>> empty = Map(layout="clutter", size_m=20.0, boxes=(), cylinders=(), movers=())
        >>> simulation = Simulation()
        >>> simulation.load(empty, Planner(empty), (5.0, 5.0, 0.0), stream(0, "movers"))
        >>> round(simulation.step(0.6, 0.0, motor_steps=7).v_c, 3)
        0.21
        >>> simulation.close()
    """

    def __init__(self, gui: bool = False) -> None:
        self._gui = gui
        try:
            self._client = pybullet.connect(pybullet.GUI if gui else pybullet.DIRECT)
        except pybullet.error:
            self._client = -1
        if self._client < 0:
            raise UserInputError("PyBullet could not open its window: gui=true needs a display; use gui=false")
        self._pose = (0.0, 0.0, 0.0)
        self._v_c = self._omega_c = 0.0
        self._clearance_m = 0.0

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
            fixedTimeStep=MOTOR_PERIOD_S,
            numSubSteps=1,
            deterministicOverlappingPairs=1,
            physicsClientId=client,
        )
        pybullet.setGravity(0.0, 0.0, 0.0, physicsClientId=client)
        # Nobody looks, but for a body without a visual shape PyBullet meshes all its collision shapes, which takes
        # longer than all the rest of a reset.
        self._look = -1
        if not self._gui:
            self._look = pybullet.createVisualShape(
                pybullet.GEOM_BOX, halfExtents=(0.1, 0.1, 0.1), physicsClientId=client
            )
        self._build_static(map)
        self._build_robot(start_pose)
        self._clearance_m = 0.0
        self._movers = Movers(map, planner, start_pose[:2], movers_rng, MOTOR_PERIOD_S)
        self._mover_radii: list[float] = self._movers.radii.tolist()
        self._build_movers()
        self._segments = np.ascontiguousarray(map.segments(), dtype=np.float64)
        static = np.asarray(map.circles(), dtype=np.float64).reshape(-1, 3)
        # The last rows are the movers'; scan() writes their positions.
        movers = np.column_stack([self._movers.positions, self._movers.radii])
        self._circles = np.ascontiguousarray(np.concatenate([static, movers]))
        self._mover_circles = self._circles[len(static) :]
        if self._gui:
            self._look_from_above(map)

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

    def step(self, v_u: float, omega_u: float, motor_steps: int) -> StepResult:
        """Hold one pair of desired velocities for a number of motor steps.

        Args:
            v_u: desired linear velocity, m/s.
            omega_u: desired angular velocity, rad/s.
            motor_steps: how many steps of 0.02 s, at least 1.
        """
        client, robot = self._client, self._robot
        x, y, yaw = self._pose
        v_c, omega_c = self._v_c, self._omega_c
        cos, sin = math.cos(yaw), math.sin(yaw)
        gap_m = self._movers.step(x, y)
        self._sync_movers(x, y, everywhere=True)
        duration_s = motor_steps * MOTOR_PERIOD_S
        robot_m = max(abs(v_c), MAX_LINEAR_VELOCITY) * duration_s
        approach_m = robot_m + self._movers.fastest_m_per_s * duration_s + _SLACK_M
        # Movers that cannot notice the robot in this agent step walk through it at once.
        unnoticed = gap_m > max(self._movers.notice_gap_m, _MOVER_SYNC_GAP_M) + approach_m and not self._gui
        if unnoticed:
            self._movers.step(x, y, motor_steps - 1)
        # Contacts that cannot be are not asked for, nor the velocities that only contact would change.
        in_contact = False
        touchable = self._clearance_m <= ROBOT_RADIUS_M + CONTACT_DISTANCE_M + approach_m
        self._clearance_m = 0.0  # not known until the next scan
        for motor_step in range(motor_steps):
            if motor_step > 0 and not unnoticed:
                self._movers.step(x, y)
                self._sync_movers(x, y, everywhere=self._gui)
            v, omega = clip_command(v_u, omega_u, v_c, omega_c)
            # By position, which PyBullet reads faster than keywords.
            linear, angular = (v * cos, v * sin, 0.0), (0.0, 0.0, omega)
            pybullet.resetBaseVelocity(robot, linear, angular, client)
            pybullet.stepSimulation(client)
            (x, y, _), turn = pybullet.getBasePositionAndOrientation(robot, client)
            if touchable:
                linear, angular = pybullet.getBaseVelocity(robot, client)
            yaw = 2.0 * math.atan2(turn[2], turn[3])
            cos, sin = math.cos(yaw), math.sin(yaw)
            v_c = linear[0] * cos + linear[1] * sin
            omega_c = angular[2]
            if touchable and not in_contact:
                points = pybullet.getContactPoints(bodyA=robot, physicsClientId=client)
                in_contact = any(point[8] <= CONTACT_DISTANCE_M for point in points)
            if self._gui:
                time.sleep(MOTOR_PERIOD_S)
        self._pose = (x, y, math.remainder(yaw, 2.0 * math.pi))
        self._v_c, self._omega_c = v_c, omega_c
        return StepResult(self._pose, v_c, omega_c, in_contact)

    def scan(self) -> NDArray[np.float64]:
        """Return the exact smallest distance from the robot's centre in each 2-degree sector.

        Returns:
            float64 [180], m; ``inf`` where nothing is within 3 m. See
            :func:`rcdsac_trl.world.lidar.sector_distances`.
        """
        self._mover_circles[:, :2] = self._movers.positions
        x, y, yaw = self._pose
        distances, self._clearance_m = scan(x, y, yaw, self._segments, self._circles)
        return distances

    def close(self) -> None:
        """Disconnect from PyBullet; harmless when done before."""
        if self._client >= 0:
            pybullet.disconnect(physicsClientId=self._client)
            self._client = -1

    def _build_static(self, map: Map) -> None:
        """Add walls and clutter as few compound bodies of shapes that lie near each other."""
        shapes: list[Box | Cylinder] = [*map.boxes, *map.cylinders]
        for first in range(0, len(shapes), SHAPES_PER_BODY):
            group = shapes[first : first + SHAPES_PER_BODY]
            boxes = [isinstance(shape, Box) for shape in group]
            shape = pybullet.createCollisionShapeArray(
                shapeTypes=[pybullet.GEOM_BOX if box else pybullet.GEOM_CYLINDER for box in boxes],
                halfExtents=[
                    (s.half_x, s.half_y, _OBSTACLE_HALF_HEIGHT_M) if isinstance(s, Box) else (0.0, 0.0, 0.0)
                    for s in group
                ],
                radii=[s.radius if isinstance(s, Cylinder) else 0.0 for s in group],
                lengths=[2.0 * _OBSTACLE_HALF_HEIGHT_M] * len(group),
                collisionFramePositions=[(s.x, s.y, 0.0) for s in group],
                collisionFrameOrientations=[
                    pybullet.getQuaternionFromEuler((0.0, 0.0, s.yaw if isinstance(s, Box) else 0.0)) for s in group
                ],
                physicsClientId=self._client,
            )
            pybullet.createMultiBody(0.0, shape, self._look, physicsClientId=self._client)

    def _build_robot(self, start_pose: tuple[float, float, float]) -> None:
        """Add the octagonal prism; a flat side faces forward."""
        client = self._client
        corners = [
            (ROBOT_RADIUS_M * math.cos(angle), ROBOT_RADIUS_M * math.sin(angle), z)
            for angle in (math.radians(22.5 + 45.0 * k) for k in range(8))
            for z in (-_ROBOT_HALF_HEIGHT_M, _ROBOT_HALF_HEIGHT_M)
        ]
        shape = pybullet.createCollisionShape(pybullet.GEOM_MESH, vertices=corners, physicsClientId=client)
        x, y, yaw = start_pose
        self._robot = pybullet.createMultiBody(
            _ROBOT_MASS_KG,
            shape,
            self._look,
            basePosition=(x, y, 0.0),
            baseOrientation=pybullet.getQuaternionFromEuler((0.0, 0.0, yaw)),
            physicsClientId=client,
        )
        # Friction and restitution of a contact are products of both bodies': 0 here is 0 everywhere.
        pybullet.changeDynamics(
            self._robot,
            -1,
            linearDamping=0.0,
            angularDamping=0.0,
            lateralFriction=0.0,
            restitution=0.0,
            localInertiaDiagonal=_ROBOT_INERTIA,
            physicsClientId=client,
        )
        self._pose = (float(x), float(y), math.remainder(yaw, 2.0 * math.pi))
        self._v_c = self._omega_c = 0.0

    def _build_movers(self) -> None:
        """Add the movers as bodies of mass 0: they push and are never pushed."""
        self._mover_bodies = [
            pybullet.createMultiBody(
                0.0,
                pybullet.createCollisionShape(
                    pybullet.GEOM_CYLINDER,
                    radius=radius,
                    height=2.0 * _OBSTACLE_HALF_HEIGHT_M,
                    physicsClientId=self._client,
                ),
                self._look,
                basePosition=(x, y, 0.0),
                physicsClientId=self._client,
            )
            for (x, y), radius in zip(self._movers.positions, self._movers.radii, strict=True)
        ]

    def _sync_movers(self, robot_x: float, robot_y: float, everywhere: bool) -> None:
        """Tell PyBullet where the movers are: all of them, or only those that the robot could touch."""
        near = ROBOT_RADIUS_M + _MOVER_SYNC_GAP_M
        for body, (x, y), radius in zip(
            self._mover_bodies, self._movers.positions.tolist(), self._mover_radii, strict=True
        ):
            if everywhere or math.hypot(x - robot_x, y - robot_y) < near + radius:
                pybullet.resetBasePositionAndOrientation(body, (x, y, 0.0), _UPRIGHT, self._client)

    def _look_from_above(self, map: Map) -> None:
        """Point the window's camera down on the whole map."""
        middle = map.size_m / 2.0
        pybullet.resetDebugVisualizerCamera(
            cameraDistance=map.size_m,
            cameraYaw=0.0,
            cameraPitch=-89.9,
            cameraTargetPosition=(middle, middle, 0.0),
            physicsClientId=self._client,
        )
