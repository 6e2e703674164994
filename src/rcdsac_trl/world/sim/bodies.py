"""What PyBullet is given: the bodies of one map, of the robot and of the movers.

Each takes the number of a visual shape, -1 for the one that PyBullet makes of the collision shapes.
"""

import math

from numpy.typing import NDArray

from rcdsac_trl.world.maps.generator import Box, Cylinder, Map
from rcdsac_trl.world.maps.geometry import ROBOT_RADIUS_M
from rcdsac_trl.world.sim.bullet import pybullet

SHAPES_PER_BODY = 16
"""Static shapes are joined to compound bodies of up to so many: a body each makes a step 8 times as slow."""

_ROBOT_MASS_KG = 10.0
_ROBOT_HALF_HEIGHT_M = 0.1
_OBSTACLE_HALF_HEIGHT_M = 0.5
# That of a uniform cylinder about its axis; about the other two axes nothing can turn the robot.
_ROBOT_INERTIA = (1e9, 1e9, 0.5 * _ROBOT_MASS_KG * ROBOT_RADIUS_M**2)


def invisible_shape(client: int) -> int:
    """Return the number of a visual shape for bodies that nobody looks at.

    For a body without one PyBullet makes a mesh of each of its collision shapes, which takes longer than making the
    body.
    """
    shape: int = pybullet.createVisualShape(pybullet.GEOM_BOX, halfExtents=(0.1, 0.1, 0.1), physicsClientId=client)
    return shape


def add_static(client: int, map: Map, visual: int) -> None:
    """Add walls and clutter as few compound bodies of shapes that lie near each other.

    They are plain rigid bodies ("maximal coordinates"): what stands has no joints, and a step does not visit each of
    them as it would a multibody. Contact is bit for bit the same.
    """
    shapes: list[Box | Cylinder] = [*map.boxes, *map.cylinders]
    for first in range(0, len(shapes), SHAPES_PER_BODY):
        group = shapes[first : first + SHAPES_PER_BODY]
        boxes = [isinstance(shape, Box) for shape in group]
        shape = pybullet.createCollisionShapeArray(
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
            physicsClientId=client,
        )
        pybullet.createMultiBody(0.0, shape, visual, useMaximalCoordinates=1, physicsClientId=client)


def add_robot(client: int, start_pose: tuple[float, float, float], visual: int) -> int:
    """Add the octagonal prism, a flat side faces forward, and return its body's number."""
    corners = [
        (ROBOT_RADIUS_M * math.cos(angle), ROBOT_RADIUS_M * math.sin(angle), z)
        for angle in (math.radians(22.5 + 45.0 * k) for k in range(8))
        for z in (-_ROBOT_HALF_HEIGHT_M, _ROBOT_HALF_HEIGHT_M)
    ]
    shape = pybullet.createCollisionShape(pybullet.GEOM_MESH, vertices=corners, physicsClientId=client)
    x, y, yaw = start_pose
    robot: int = pybullet.createMultiBody(
        _ROBOT_MASS_KG,
        shape,
        visual,
        basePosition=(x, y, 0.0),
        baseOrientation=pybullet.getQuaternionFromEuler((0.0, 0.0, yaw)),
        physicsClientId=client,
    )
    # Friction and restitution of a contact are products of both bodies': 0 here is 0 everywhere.
    pybullet.changeDynamics(
        robot,
        -1,
        linearDamping=0.0,
        angularDamping=0.0,
        lateralFriction=0.0,
        restitution=0.0,
        localInertiaDiagonal=_ROBOT_INERTIA,
        physicsClientId=client,
    )
    return robot


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
