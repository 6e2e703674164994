"""Point clouds of posed depth cameras to sectors: floor and ceiling off, own body off, the minimum of the rest."""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from rcdsac_trl.deploy.sensors.arrays import numbers_of
from rcdsac_trl.errors import UserInputError
from rcdsac_trl.robot.range_sensor import BIN_RAD, MAX_RANGE_M, NUM_BINS
from rcdsac_trl.robot.sectors import (
    BODY_RADIUS_M,
    Sectors,
    bins_of,
    check_switches,
    is_whole_number,
    nearest_by_sector,
)

# Farther from the robot's centre, no camera is mounted: mm, then.
_FARTHEST_CAMERA_M = 3.0
# Of what a camera on a robot sees, its floor if nothing else, this share at least is so near.
_NEAR_M, _NEAR_SHARE = 20.0, 0.01


@dataclass(frozen=True)
class CameraPose:
    """Where a camera sits: its frame in the robot's, x ahead, y left, z up from the floor below the centre.

    Attributes:
        position_m: of the camera, (x, y, z).
        quaternion: rotation of the camera's frame, (x, y, z, w) as in ROS; need not be normalised.
        view_rad: horizontal field of view, full angle.
        optical: whether points are in an optical frame (z ahead, x right, y down) or in a body frame (x ahead, y
            left, z up), before the rotation.
    """

    position_m: tuple[float, float, float]
    quaternion: tuple[float, float, float, float] = (0.0, 0.0, 0.0, 1.0)
    view_rad: float = math.radians(70.0)
    optical: bool = False

    def __post_init__(self) -> None:
        """Refuse what is no pose."""
        check_switches(self, "optical")
        numbers = (*self.position_m, *self.quaternion, self.view_rad)
        if (len(self.position_m), len(self.quaternion)) != (3, 4) or not all(math.isfinite(value) for value in numbers):
            raise UserInputError(f"camera pose {numbers} is not three metres, a quaternion and an angle, all finite")
        if math.hypot(*self.quaternion) < 1e-6:
            raise UserInputError(
                f"quaternion {self.quaternion} of a camera has no length: the identity is (0, 0, 0, 1)"
            )
        if not 0.0 < self.view_rad <= 2.0 * math.pi:
            raise UserInputError(f"view_rad={self.view_rad:g} of a camera is outside (0, 2 pi]: give radians")
        if math.hypot(*self.position_m) > _FARTHEST_CAMERA_M:
            raise UserInputError(
                f"a camera at {self.position_m} is more than {_FARTHEST_CAMERA_M:g} m from the floor below the robot's "
                "centre: give metres"
            )

    @property
    def rotation(self) -> NDArray[np.float64]:
        """The matrix that turns points of the camera's frame into the robot's axes, [3, 3]."""
        x, y, z, w = np.asarray(self.quaternion) / math.hypot(*self.quaternion)
        turn = np.array(
            [
                [1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)],
                [2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)],
                [2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)],
            ]
        )
        if self.optical:
            turn = turn @ np.array([[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]])
        return turn

    @property
    def heading_rad(self) -> float:
        """Direction in which the camera looks, seen from above, counter-clockwise from straight ahead."""
        ahead = self.rotation @ (np.array([0.0, 0.0, 1.0]) if self.optical else np.array([1.0, 0.0, 0.0]))
        return math.atan2(ahead[1], ahead[0])


@dataclass(frozen=True)
class CloudFilter:
    """Which points are obstacles.

    Attributes:
        floor_m: what is lower is floor.
        ceiling_m: what is higher is no obstacle: the robot fits below.
        body_radius_m: what is nearer to the robot's centre, seen from above, is the robot.
        support: this many points must be as near as a sector's distance: 1 is the exact minimum, more ignores the
            single flying points of depth cameras at edges.
        min_points: a camera that delivers fewer points (floor and ceiling included) is blind.
    """

    floor_m: float = 0.05
    ceiling_m: float = 1.0
    body_radius_m: float = BODY_RADIUS_M
    support: int = 1
    min_points: int = 50

    def __post_init__(self) -> None:
        """Refuse an empty slice, counts below their least, and heights in another unit."""
        if not self.floor_m < self.ceiling_m:
            raise UserInputError(f"floor_m={self.floor_m:g} is not below ceiling_m={self.ceiling_m:g}")
        if not (abs(self.floor_m) <= MAX_RANGE_M and self.body_radius_m <= MAX_RANGE_M):
            raise UserInputError(
                f"floor_m={self.floor_m:g} or body_radius_m={self.body_radius_m:g} is beyond the {MAX_RANGE_M:g} m "
                "that agents see: give metres"
            )
        for name in ("support", "min_points"):
            if not is_whole_number(getattr(self, name)):
                raise UserInputError(f"{name}={getattr(self, name)} counts points: give a whole number")
        if self.support < 1 or self.min_points < 0 or self.body_radius_m < 0.0:
            raise UserInputError(
                f"support={self.support} must be at least 1, min_points={self.min_points} and "
                f"body_radius_m={self.body_radius_m:g} at least 0"
            )


def cloud_sectors(
    clouds: Sequence[tuple[ArrayLike, CameraPose]],
    filter_: CloudFilter | None = None,
    max_range_m: float = MAX_RANGE_M,
) -> Sectors:
    """Return what the clouds of several cameras say about each sector.

    A cloud cannot say where it saw nothing, so its camera's field of view tells what it covers: the sectors whose
    farthest points, 3 m from the robot's centre or as far as the agent sees, it has in view. A blind camera
    covers nothing.

    Args:
        clouds: points [n, 3] or [h, w, 3] in the camera's frame, m, and the camera's pose, for each camera; points
            that are not finite or masked are left out, and so is the camera's own place (0, 0, 0), which drivers
            write for pixels without depth.
        filter_: which points are obstacles; None for the defaults.
        max_range_m: as far as the agent sees.

    Raises:
        UserInputError: if points are no [.., 3] array of numbers, or not in metres.

    Example:
        >>> wall = np.stack(np.meshgrid([1.0], np.linspace(-1, 1, 99), np.linspace(0, 1, 9)), -1)
        >>> sectors = cloud_sectors([(wall, CameraPose((0.2, 0.0, 0.0)))])
        >>> round(float(sectors.distances_m[0]), 3), bool(sectors.covered[90])
        (1.2, False)
    """
    filter_ = filter_ or CloudFilter()
    covered = np.zeros(NUM_BINS, dtype=np.bool_)
    bins: list[NDArray[np.intp]] = []
    distances: list[NDArray[np.float64]] = []
    for points, pose in clouds:
        if not isinstance(pose, CameraPose):
            raise UserInputError(f"a cloud's pose is a {type(pose).__name__}: give a CameraPose")
        finite = _measured_points(points)
        if len(finite) < max(filter_.min_points, 1):
            continue
        _check_unit(finite)
        x, y, z = (finite @ pose.rotation.T + np.asarray(pose.position_m)).T
        distance = np.hypot(x, y)
        obstacle = (z >= filter_.floor_m) & (z <= filter_.ceiling_m) & (distance >= filter_.body_radius_m)
        obstacle &= distance < max_range_m
        bins.append(bins_of(np.arctan2(y[obstacle], x[obstacle])))
        distances.append(distance[obstacle])
        covered |= _in_view(pose, max_range_m)
    if not bins:
        return Sectors(np.full(NUM_BINS, np.inf), covered, max_range_m)
    nearest = nearest_by_sector(np.concatenate(bins), np.concatenate(distances), filter_.support, max_range_m)
    return Sectors(nearest, covered | np.isfinite(nearest), max_range_m)


def _measured_points(points: ArrayLike) -> NDArray[np.float64]:
    """Return the points of a cloud at which something was measured, [n, 3]."""
    array = numbers_of(points, "a cloud's points")
    if array.ndim < 2 or array.shape[-1] != 3:
        raise UserInputError(f"a cloud of shape {list(array.shape)} is none: give [n, 3] or [height, width, 3]")
    array = array.reshape(-1, 3)
    return array[np.isfinite(array).all(axis=1) & array.any(axis=1)]


def _check_unit(points: NDArray[np.float64]) -> None:
    """Refuse points, [n, 3] from the camera, that are nearly all too far away for a camera on a robot."""
    near = np.count_nonzero((np.abs(points) < _NEAR_M).all(axis=1))
    if near < _NEAR_SHARE * len(points):
        raise UserInputError(
            f"a cloud's points are {float(np.median(np.abs(points).max(axis=1))):g} m away in the median, {near} of "
            f"{len(points)} are within {_NEAR_M:g} m: give metres"
        )


def _in_view(pose: CameraPose, far_m: float) -> NDArray[np.bool_]:
    """Return the sectors whose both borders a camera has in view so far from the robot's centre."""
    borders = np.arange(NUM_BINS) * BIN_RAD
    x = far_m * np.cos(borders) - pose.position_m[0]
    y = far_m * np.sin(borders) - pose.position_m[1]
    off = np.arctan2(y, x) - pose.heading_rad
    seen = np.abs((off + math.pi) % (2.0 * math.pi) - math.pi) <= pose.view_rad / 2.0
    return seen & np.roll(seen, -1)
