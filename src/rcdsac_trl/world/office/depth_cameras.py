"""Depth cameras in PyBullet: what a robot's cameras would measure of the solids around it.

PyBullet's own rasteriser (``TinyRenderer``) draws the depth image. Casting a ray a pixel gives the same numbers, but
took 9 times as long for 64 x 48 pixels among 250 boxes.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from rcdsac_trl.errors import UserInputError
from rcdsac_trl.world.maps.shapes import Box, Cylinder
from rcdsac_trl.world.office.furniture import Solid
from rcdsac_trl.world.sim.bullet import Client, pybullet

# Half of the floor's side, around the robot.
_FLOOR_M = 10.0
# The rasteriser's nearest plane; what lies before a camera's own nearest distance hides what is behind it.
_NEAR_PLANE_M = 0.02
_SHAPES_PER_BODY = 16
# The rasteriser's time grows with all that is there, so only what can be seen within so many metres of way is there.
_GATHERED_FOR_M = 1.0


@dataclass(frozen=True)
class Lens:
    """What all depth cameras of a rig have in common; every field is a key of ``camera`` in ``conf/course.yaml``.

    A pinhole camera with square pixels, counted from 0: its focal length is ``width_px / (2 tan(view_deg / 2))``
    pixels, its principal point ``(width_px / 2, height_px / 2 - 1)``.

    Attributes:
        width_px: pixels in a row.
        height_px: rows.
        view_deg: horizontal field of view, full angle.
        nearest_m: what is nearer to the camera, along its axis, is not measured.
        farthest_m: what is farther from the camera is not measured.
        noise_per_m: standard deviation of a depth's noise, divided by the depth's square, 1/m: for triangulating
            cameras it grows so.
        dropout: share of the pixels that measure nothing, at random.

    Raises:
        UserInputError: a value is outside its limits.
    """

    width_px: int = 64
    height_px: int = 48
    view_deg: float = 87.0
    nearest_m: float = 0.1
    farthest_m: float = 3.5
    noise_per_m: float = 0.002
    dropout: float = 0.01

    def __post_init__(self) -> None:
        """Refuse what is no camera."""
        for name in ("width_px", "height_px"):
            if not 8 <= getattr(self, name) <= 1024:
                raise UserInputError(f"camera.{name}={getattr(self, name)} must be from 8 to 1024 pixels")
        if not 10.0 <= self.view_deg <= 150.0:
            raise UserInputError(f"camera.view_deg={self.view_deg:g} must be from 10 to 150 degrees")
        if not _NEAR_PLANE_M <= self.nearest_m < self.farthest_m <= 100.0:
            raise UserInputError(
                f"camera.nearest_m={self.nearest_m:g} and farthest_m={self.farthest_m:g} must rise from at least "
                f"{_NEAR_PLANE_M:g} to at most 100 m"
            )
        if not 0.0 <= self.noise_per_m <= 0.1:
            raise UserInputError(f"camera.noise_per_m={self.noise_per_m:g} must be from 0 to 0.1")
        if not 0.0 <= self.dropout < 1.0:
            raise UserInputError(f"camera.dropout={self.dropout:g} is a share: give 0 or more, and less than 1")

    @property
    def focal_px(self) -> float:
        """Focal length in pixels."""
        return self.width_px / (2.0 * math.tan(math.radians(self.view_deg) / 2.0))

    def directions(self) -> NDArray[np.float64]:
        """Return the points of all pixels at depth 1 m in the optical frame (x right, y down), [height, width, 3]."""
        # The rasteriser looks through a pixel's corner (the lower left one), not through its middle.
        x = (np.arange(self.width_px) - self.width_px / 2.0) / self.focal_px
        y = (np.arange(self.height_px) + 1.0 - self.height_px / 2.0) / self.focal_px
        return np.stack([*np.meshgrid(x, y), np.ones((self.height_px, self.width_px))], axis=-1)


@dataclass(frozen=True)
class Mounted:
    """Where a camera sits: in the robot's frame, x ahead, y left, z up from the floor below its centre.

    Attributes:
        position_m: (x, y, z).
        rotation: turns the optical frame's axes (x right, y down, z ahead) into the robot's, [3, 3].
    """

    position_m: tuple[float, float, float]
    rotation: NDArray[np.float64]


class DepthCameras:
    """The cameras of one robot in one PyBullet client of their own, which holds the solids, a floor and people.

    Equal solids, places and generators give bit-identical images.

    Args:
        lens: of all cameras.
        mounted: where each sits.
        solids: what stands.
        people_m: radius and height of whoever walks about, [(radius, height), ..].
        rng: stream of the noise.

    Raises:
        UserInputError: PyBullet opens no more simulations.
    """

    def __init__(
        self,
        lens: Lens,
        mounted: Sequence[Mounted],
        solids: Sequence[Solid],
        people_m: Sequence[tuple[float, float]],
        rng: np.random.Generator,
    ) -> None:
        self.lens = lens
        self._mounted = mounted
        self._solids = solids
        self._people_m = people_m
        self._rng = rng
        self._connection = Client(pybullet.DIRECT)
        self._client = self._connection.number
        if self._client < 0:
            raise UserInputError("PyBullet opens no more simulations in one process: lower num_workers")
        self._people: list[int] = []
        self._gathered_at: tuple[float, float] | None = None
        self._directions = lens.directions()
        self._lengths = np.linalg.norm(self._directions, axis=-1)
        self._centres = np.array([(solid.shape.x, solid.shape.y) for solid in solids]).reshape(-1, 2)
        self._radii = np.array([_radius_m(solid.shape) for solid in solids])
        self._reach_m = lens.farthest_m + max(math.hypot(*camera.position_m[:2]) for camera in mounted)
        self._projection = pybullet.computeProjectionMatrixFOV(
            fov=math.degrees(2.0 * math.atan(lens.height_px / 2.0 / lens.focal_px)),
            aspect=lens.width_px / lens.height_px,
            nearVal=_NEAR_PLANE_M,
            farVal=2.0 * lens.farthest_m,
        )

    def depths(self, pose: tuple[float, float, float], people_xy: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return what every pixel measures along its camera's axis.

        Args:
            pose: the robot's x, y in m and yaw in rad, map frame.
            people_xy: where people are, [k, 2], m.

        Returns:
            float64 [cameras, height, width], m; ``nan`` where a pixel measures nothing.
        """
        if self._gathered_at is None or math.dist(self._gathered_at, pose[:2]) > _GATHERED_FOR_M:
            self._gather(pose[:2])
        for body, (x, y) in zip(self._people, people_xy.tolist(), strict=True):
            pybullet.resetBasePositionAndOrientation(body, (x, y, 0.0), (0.0, 0.0, 0.0, 1.0), self._client)
        depths = np.stack([self._depth(camera, pose) for camera in self._mounted])
        lens = self.lens
        if lens.noise_per_m > 0.0:
            depths += lens.noise_per_m * np.square(depths) * self._rng.standard_normal(depths.shape)
        measured = (depths >= lens.nearest_m) & (depths * self._lengths <= lens.farthest_m)
        if lens.dropout > 0.0:
            measured &= self._rng.random(depths.shape) >= lens.dropout
        return np.where(measured, depths, np.nan)

    def clouds(self, pose: tuple[float, float, float], people_xy: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return the points that every pixel measures, in its camera's optical frame.

        Args:
            pose: the robot's x, y in m and yaw in rad, map frame.
            people_xy: where people are, [k, 2], m.

        Returns:
            float64 [cameras, height, width, 3], m; ``nan`` where a pixel measures nothing.
        """
        return self.depths(pose, people_xy)[..., None] * self._directions

    def close(self) -> None:
        """Disconnect from PyBullet; harmless when done before."""
        self._connection.close()
        self._client = -1

    def _gather(self, xy: tuple[float, float]) -> None:
        """Put into the client what can be seen from around a place, and people."""
        pybullet.resetSimulation(physicsClientId=self._client)
        self._gathered_at = xy
        apart = np.hypot(*(self._centres - xy).T) - self._radii
        seen = [self._solids[k] for k in np.flatnonzero(apart < self._reach_m + _GATHERED_FOR_M).tolist()]
        standing = [Solid(Box(*xy, _FLOOR_M, _FLOOR_M, 0.0, mapped=True), -0.1, 0.0), *seen]
        for first in range(0, len(standing), _SHAPES_PER_BODY):
            self._add(standing[first : first + _SHAPES_PER_BODY])
        self._people = [
            self._add([Solid(Cylinder(0.0, 0.0, radius, mapped=False), 0.0, height)])
            for radius, height in self._people_m
        ]

    def _depth(self, camera: Mounted, pose: tuple[float, float, float]) -> NDArray[np.float64]:
        x, y, yaw = pose
        cos, sin = math.cos(yaw), math.sin(yaw)
        turn = np.array([[cos, -sin, 0.0], [sin, cos, 0.0], [0.0, 0.0, 1.0]])
        eye = turn @ np.asarray(camera.position_m) + (x, y, 0.0)
        axes = turn @ camera.rotation
        view = pybullet.computeViewMatrix(eye.tolist(), (eye + axes[:, 2]).tolist(), (-axes[:, 1]).tolist())
        image = pybullet.getCameraImage(
            self.lens.width_px,
            self.lens.height_px,
            view,
            self._projection,
            shadow=0,
            renderer=pybullet.ER_TINY_RENDERER,
            flags=pybullet.ER_NO_SEGMENTATION_MASK,
            physicsClientId=self._client,
        )
        buffer = np.asarray(image[3], dtype=np.float64).reshape(self.lens.height_px, self.lens.width_px)
        near, far = _NEAR_PLANE_M, 2.0 * self.lens.farthest_m
        return far * near / (far - (far - near) * buffer)

    def _add(self, solids: Sequence[Solid]) -> int:
        """Add solids as one body that shows and touches nothing; return its number."""
        boxes = [isinstance(solid.shape, Box) for solid in solids]
        halves = [(solid.high_m - solid.low_m) / 2.0 for solid in solids]
        shape = pybullet.createVisualShapeArray(
            shapeTypes=[pybullet.GEOM_BOX if box else pybullet.GEOM_CYLINDER for box in boxes],
            halfExtents=[
                (solid.shape.half_x, solid.shape.half_y, half) if isinstance(solid.shape, Box) else (0.0, 0.0, 0.0)
                for solid, half in zip(solids, halves, strict=True)
            ],
            radii=[solid.shape.radius if isinstance(solid.shape, Cylinder) else 0.0 for solid in solids],
            lengths=[2.0 * half for half in halves],
            visualFramePositions=[
                (solid.shape.x, solid.shape.y, (solid.low_m + solid.high_m) / 2.0) for solid in solids
            ],
            visualFrameOrientations=[
                pybullet.getQuaternionFromEuler((0.0, 0.0, solid.shape.yaw if isinstance(solid.shape, Box) else 0.0))
                for solid in solids
            ],
            physicsClientId=self._client,
        )
        body: int = pybullet.createMultiBody(0.0, -1, shape, physicsClientId=self._client)
        return body


def _radius_m(shape: Box | Cylinder) -> float:
    """Return the radius of the circle around a shape's centre that holds it."""
    return shape.radius if isinstance(shape, Cylinder) else math.hypot(shape.half_x, shape.half_y)
