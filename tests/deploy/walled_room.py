"""A rectangular room of four walls, seen by a laser scanner."""

import math

import numpy as np

ROOM_M = (10.0, 6.0)
INCREMENT_RAD = 2.0 * math.pi / 360
ANGLE_MIN_RAD = -math.pi


def ranges_m(x: float, y: float, yaw: float, rays: int = 360) -> np.ndarray:
    """See the walls from a place in the room: a ray a degree, the first straight behind.

    Args:
        x: of the scanner, from a corner of the room, m.
        y: likewise.
        yaw: where it looks, rad.
        rays: how many.
    """
    angles = yaw + ANGLE_MIN_RAD + INCREMENT_RAD * np.arange(rays)
    cos, sin = np.cos(angles), np.sin(angles)
    with np.errstate(divide="ignore"):
        across = np.where(cos > 0.0, (ROOM_M[0] - x) / cos, -x / cos)
        along = np.where(sin > 0.0, (ROOM_M[1] - y) / sin, -y / sin)
    found: np.ndarray = np.minimum(np.abs(across), np.abs(along))
    return found
