"""What PyBullet is given: the bodies of one map, of the robot and of the movers.

Each takes the number of a visual shape, -1 for the one that PyBullet makes of the collision shapes.
"""

import math

import numpy as np
from numpy.typing import NDArray

from rcdsac_trl.robot.robot_settings import RobotSettings
from rcdsac_trl.world.maps.generator import Box, Cylinder, Map
from rcdsac_trl.world.maps.shapes import solid_arrays
from rcdsac_trl.world.sim.bullet import pybullet

SHAPES_PER_BODY = 16
"""Static shapes are joined to compound bodies of up to so many: a body each makes a step 8 times as slow."""
MAX_WHOLE_SHAPES = 512
"""A map of up to so many static shapes exists as a whole."""

# Of a larger map exists what is within so much of the square that the robot is in; it leaves it by 0.2 m at most before
# anybody looks again.
_SQUARE_M = 4.0
_AROUND_M = 1.0
# Velocities are set, and nothing else that moves can be pushed: only the ratio of inertia to mass counts.
_ROBOT_MASS_KG = 10.0
_ROBOT_HALF_HEIGHT_M = 0.1
_OBSTACLE_HALF_HEIGHT_M = 0.5
# About the two axes that lie flat nothing can turn the robot.
_UNTURNABLE = 1e9


def invisible_shape(client: int) -> int:
    """Return the number of a visual shape for bodies that nobody looks at.

    For a body without one PyBullet makes a mesh of each of its collision shapes, which takes longer than making the
    body.
    """
    shape: int = pybullet.createVisualShape(pybullet.GEOM_BOX, halfExtents=(0.1, 0.1, 0.1), physicsClientId=client)
    return shape


class StaticBodies:
    """Walls and clutter as few compound bodies of shapes that lie near each other.

    They are plain rigid bodies ("maximal coordinates"): what stands has no joints, and a step does not visit each of
    them as it would a multibody. Of a large map only those near the robot exist, since a step visits every body.
    Contact is bit for bit the same either way.

    Args:
        client: PyBullet's.
        map: what stands.
        visual: number of a visual shape, -1 for the one that PyBullet makes.
        whole: let all exist, wherever the robot is; None: if they are few.
    """

    def __init__(self, client: int, map: Map, visual: int, whole: bool | None = None) -> None:
        self._client, self._visual = client, visual
        shapes: list[Box | Cylinder] = [*map.boxes, *map.cylinders]
        whole = len(shapes) <= MAX_WHOLE_SHAPES if whole is None else whole
        firsts = range(0, len(shapes), SHAPES_PER_BODY)
        self._groups = [shapes[first : first + SHAPES_PER_BODY] for first in firsts]
        self._bodies: dict[int, int] = {}  # of the groups that exist
        # Of the groups that ever did: PyBullet keeps a shape when its body goes, and a new one would be kept as well.
        self._shapes: dict[int, int] = {}
        self._square: tuple[int, int] | None = None
        self._bounds = None if whole else np.array([_bounds(group) for group in self._groups])
        if whole:
            for number in range(len(self._groups)):
                self._add(number)

    def follow(self, x: float, y: float) -> None:
        """Let what is near a robot exist, and nothing else.

        Args:
            x: where the robot is, m.
            y: likewise.
        """
        square = math.floor(x / _SQUARE_M), math.floor(y / _SQUARE_M)
        if self._bounds is None or square == self._square:
            return
        self._square = square
        low = _SQUARE_M * np.array(square) - _AROUND_M
        high = low + _SQUARE_M + 2 * _AROUND_M
        near = (self._bounds[:, :2] <= high).all(axis=1) & (self._bounds[:, 2:] >= low).all(axis=1)
        wanted = set(np.flatnonzero(near).tolist())
        for number in sorted(self._bodies.keys() - wanted):
            pybullet.removeBody(self._bodies.pop(number), physicsClientId=self._client)
        for number in sorted(wanted - self._bodies.keys()):
            self._add(number)

    def _add(self, number: int) -> None:
        if number not in self._shapes:
            self._shapes[number] = self._shape(self._groups[number])
        self._bodies[number] = pybullet.createMultiBody(
            0.0, self._shapes[number], self._visual, useMaximalCoordinates=1, physicsClientId=self._client
        )

    def _shape(self, group: list[Box | Cylinder]) -> int:
        """Make the collision shape of a group; return its number."""
        boxes = [isinstance(shape, Box) for shape in group]
        shape: int = pybullet.createCollisionShapeArray(
            shapeTypes=[pybullet.GEOM_BOX if box else pybullet.GEOM_CYLINDER for box in boxes],
            halfExtents=[
                (s.half_x, s.half_y, _OBSTACLE_HALF_HEIGHT_M) if isinstance(s, Box) else (0.0, 0.0, 0.0) for s in group
            ],
            radii=[s.radius if isinstance(s, Cylinder) else 0.0 for s in group],
            lengths=[2.0 * _OBSTACLE_HALF_HEIGHT_M] * len(group),
            collisionFramePositions=[(s.x, s.y, 0.0) for s in group],
            collisionFrameOrientations=[
                pybullet.getQuaternionFromEuler((0.0, 0.0, s.yaw if isinstance(s, Box) else 0.0)) for s in group
            ],
            physicsClientId=self._client,
        )
        return shape


def _bounds(shapes: list[Box | Cylinder]) -> list[float]:
    """Return smallest x and y and largest x and y of shapes, m."""
    boxes, circles = solid_arrays(shapes)
    turns = np.abs(boxes[:, 4:])  # |cos|, |sin|
    halves = np.stack([(turns * boxes[:, 2:4]).sum(axis=1), (turns * boxes[:, 3:1:-1]).sum(axis=1)], axis=1)
    low = np.concatenate([boxes[:, :2] - halves, circles[:, :2] - circles[:, 2:]])
    high = np.concatenate([boxes[:, :2] + halves, circles[:, :2] + circles[:, 2:]])
    return [*low.min(axis=0).tolist(), *high.max(axis=0).tolist()]


def add_robot(client: int, start_pose: tuple[float, float, float], visual: int, robot: RobotSettings) -> int:
    """Add a robot as an upright prism or cylinder, and return its body's number."""
    x, y, yaw = start_pose
    body: int = pybullet.createMultiBody(
        _ROBOT_MASS_KG,
        _robot_shape(client, robot),
        visual,
        basePosition=(x, y, 0.0),
        baseOrientation=pybullet.getQuaternionFromEuler((0.0, 0.0, yaw)),
        physicsClientId=client,
    )
    # Friction and restitution of a contact are products of both bodies': 0 here is 0 everywhere.
    pybullet.changeDynamics(
        body,
        -1,
        linearDamping=0.0,
        angularDamping=0.0,
        lateralFriction=0.0,
        restitution=0.0,
        localInertiaDiagonal=(_UNTURNABLE, _UNTURNABLE, _inertia(robot)),
        physicsClientId=client,
    )
    return body


def _robot_shape(client: int, robot: RobotSettings) -> int:
    """Make the collision shape of a robot, around the point that it turns about; return its number."""
    if robot.shape == "disc":
        shape: int = pybullet.createCollisionShape(
            pybullet.GEOM_CYLINDER,
            radius=robot.radius_m,
            height=2.0 * _ROBOT_HALF_HEIGHT_M,
            collisionFramePosition=(robot.middle_x_m, 0.0, 0.0),
            physicsClientId=client,
        )
        return shape
    corners = [(x, y, z) for x, y in robot.outline.tolist() for z in (-_ROBOT_HALF_HEIGHT_M, _ROBOT_HALF_HEIGHT_M)]
    shape = pybullet.createCollisionShape(pybullet.GEOM_MESH, vertices=corners, physicsClientId=client)
    return shape


def _inertia(robot: RobotSettings) -> float:
    """Return a robot's moment of inertia about the axis that it turns about, kg m^2.

    Of a round one it is that of a uniform cylinder about its axis, of another one that of a uniform plate.
    """
    if robot.is_round:
        return 0.5 * _ROBOT_MASS_KG * robot.circumradius_m**2
    start, end = robot.outline, np.roll(robot.outline, -1, axis=0)
    # The plate as triangles between the axis and each side; twice their areas.
    areas = start[:, 0] * end[:, 1] - start[:, 1] * end[:, 0]
    squares = (start * start + start * end + end * end).sum(axis=1)
    return _ROBOT_MASS_KG * float((areas * squares).sum() / (6.0 * areas.sum()))


def add_movers(client: int, discs: NDArray, visual: int) -> list[int]:
    """Add movers, float64 [k, 3], as bodies of mass 0, which push and are never pushed; return their numbers."""
    return [
        pybullet.createMultiBody(
            0.0,
            pybullet.createCollisionShape(
                pybullet.GEOM_CYLINDER, radius=radius, height=2.0 * _OBSTACLE_HALF_HEIGHT_M, physicsClientId=client
            ),
            visual,
            basePosition=(x, y, 0.0),
            physicsClientId=client,
        )
        for x, y, radius in discs
    ]


def look_from_above(client: int, map: Map) -> None:
    """Point the window's camera down on the whole map."""
    middle = map.size_m / 2.0
    pybullet.resetDebugVisualizerCamera(
        cameraDistance=map.size_m,
        cameraYaw=0.0,
        cameraPitch=-89.9,
        cameraTargetPosition=(middle, middle, 0.0),
        physicsClientId=client,
    )
