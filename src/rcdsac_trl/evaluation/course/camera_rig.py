"""The robot's eyes: four depth cameras on a post at its front, two low ones and two high ones.

The left camera of a pair looks to the right and the other way round: so what is right before the robot is seen by
both. The low pair sees what stands on the floor; the high pair looks down and sees what is close, and the tops of
tables that the low pair sees only from afar. Each pair covers the narrow sensor's sectors, 42 degrees to the left and
44 to the right, and more.
"""

import math

import numpy as np
from numpy.typing import NDArray

from rcdsac_trl.deploy.sensors.cloud import CameraPose, CloudFilter, cloud_sectors
from rcdsac_trl.robot.sectors import Sectors
from rcdsac_trl.world.office.depth_cameras import Mounted

AHEAD_M = 0.18
ASIDE_M = 0.05
LOW_M, HIGH_M = 0.3, 0.95
"""Heights of the two pairs."""
YAW_DEG = 35.0
LOW_PITCH_DEG, HIGH_PITCH_DEG = 10.0, 38.0
"""How far the two pairs look down."""
FILTER = CloudFilter(support=3)
"""Three points must agree: single ones may be noise."""


def camera_poses(view_deg: float) -> tuple[CameraPose, ...]:
    """Return the poses of the four cameras: low left, low right, high left, high right.

    Args:
        view_deg: the cameras' horizontal field of view.
    """
    return tuple(
        CameraPose(
            position_m=(AHEAD_M, side * ASIDE_M, height),
            quaternion=_looking(-side * math.radians(YAW_DEG), math.radians(pitch)),
            view_rad=math.radians(view_deg),
            optical=True,
        )
        for height, pitch in ((LOW_M, LOW_PITCH_DEG), (HIGH_M, HIGH_PITCH_DEG))
        for side in (1.0, -1.0)
    )


def mounted(pose: CameraPose) -> Mounted:
    """Return a camera's pose as the simulation takes it."""
    return Mounted(pose.position_m, pose.rotation)


def sectors_of_clouds(clouds: NDArray[np.float64], poses: tuple[CameraPose, ...]) -> Sectors:
    """Return what the cameras' clouds say, [cameras, height, width, 3], exactly as on a robot."""
    return cloud_sectors(list(zip(clouds, poses, strict=True)), FILTER)


def covered(poses: tuple[CameraPose, ...]) -> NDArray[np.bool_]:
    """Return the sectors that the cameras have in view out to 3 m, bool [180]."""
    # One far point a camera stands for a cloud in which nothing is near: what is covered follows from the poses.
    far = np.full((FILTER.min_points, 3), 10.0)
    return cloud_sectors([(far, pose) for pose in poses], FILTER).covered


def _looking(yaw: float, pitch: float) -> tuple[float, float, float, float]:
    """Return the quaternion (x, y, z, w) of a frame turned left by yaw and then down by pitch."""
    sin_y, cos_y, sin_p, cos_p = math.sin(yaw / 2), math.cos(yaw / 2), math.sin(pitch / 2), math.cos(pitch / 2)
    return (-sin_y * sin_p, cos_y * sin_p, sin_y * cos_p, cos_y * cos_p)
