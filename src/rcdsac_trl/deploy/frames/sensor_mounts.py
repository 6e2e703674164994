"""Where a sensor sits, as scans and clouds want it, and as a transform."""

import math

import numpy as np

from rcdsac_trl.deploy.frames.rigid_transform import RigidTransform
from rcdsac_trl.deploy.sensors.cloud import CameraPose
from rcdsac_trl.errors import UserInputError
from rcdsac_trl.robot.sectors import Mount

# A scanner that is tilted more sees the floor, or over things, within the 3 m that agents look.
_LARGEST_TILT_RAD = math.radians(10.0)
# By which ROS's drivers name a frame with z ahead, x to the right (REP 103).
_OPTICAL = "optical"
# The pose of a body frame (x ahead, y left, z up) in its optical one: of both, a CameraPose tells the former.
_BODY_OF_OPTICAL = RigidTransform(rotation=(0.5, -0.5, 0.5, 0.5))


def transform_of_mount(mount: Mount) -> RigidTransform:
    """Return the pose of a scanner's frame in the robot's.

    Example:
        >>> mount_of(transform_of_mount(Mount(0.1, 0.0, 0.0, upside_down=True))).upside_down
        True
    """
    turned = RigidTransform.planar(mount.x_m, mount.y_m, mount.yaw_rad)
    return turned @ RigidTransform(rotation=(1.0, 0.0, 0.0, 0.0)) if mount.upside_down else turned


def mount_of(transform: RigidTransform) -> Mount:
    """Return how a scanner sits whose frame has a pose in the robot's.

    Raises:
        UserInputError: if it is neither level nor upside down.
    """
    upright = transform.matrix[2, 2]
    tilt_rad = math.acos(min(abs(upright), 1.0))
    if tilt_rad > _LARGEST_TILT_RAD:
        raise UserInputError(
            f"the scanner is tilted by {math.degrees(tilt_rad):.0f} degrees, more than "
            f"{math.degrees(_LARGEST_TILT_RAD):.0f}: scan a level plane, or send clouds"
        )
    x_m, y_m, yaw_rad = transform.pose
    return Mount(x_m, y_m, yaw_rad, bool(upright < 0.0))


def transform_of_camera(camera: CameraPose) -> RigidTransform:
    """Return the pose of a camera's frame in the robot's."""
    x, y, z, w = (np.asarray(camera.quaternion) / math.hypot(*camera.quaternion)).tolist()
    return RigidTransform(camera.position_m, (x, y, z, w))


def camera_of(transform: RigidTransform, camera: CameraPose | float, frame: str) -> CameraPose:
    """Return a camera that sits elsewhere.

    Args:
        transform: pose of its frame in the robot's.
        camera: how it looks; or its horizontal field of view, rad.
        frame: its name.
    """
    if isinstance(camera, CameraPose):
        return CameraPose(transform.translation_m, transform.rotation, camera.view_rad, camera.optical)
    optical = _OPTICAL in frame
    body = transform @ _BODY_OF_OPTICAL if optical else transform
    return CameraPose(body.translation_m, body.rotation, camera, optical)
