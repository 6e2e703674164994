"""Points on the floor, from the frame of a robot, or another thing, to the one that its pose is in, and back."""

import math
from typing import Any

import numpy as np
from numpy.typing import NDArray

MOST_YAW_RAD = 4.0 * math.pi
"""A yaw of more than two turns is not in radians."""


def placed(points: NDArray[np.float64], pose: Any) -> NDArray[np.float64]:
    """Return points of a robot's frame in the frame of its pose.

    Args:
        points: x and y in m, [n, 2].
        pose: of the robot, x and y in m and yaw in rad, [3].

    Example:
        >>> placed(np.array([[1.0, 0.0]]), (2.0, 3.0, math.pi / 2.0)).round(9).tolist()
        [[2.0, 4.0]]
    """
    x, y, yaw = pose
    cos, sin = math.cos(yaw), math.sin(yaw)
    found: NDArray[np.float64] = points @ np.array([[cos, sin], [-sin, cos]]) + (x, y)
    return found


def seen_from(points: NDArray[np.float64], pose: Any) -> NDArray[np.float64]:
    """Return points of the frame of a robot's pose in the robot's frame, the other way round than :func:`placed`.

    Args:
        points: x and y in m, [n, 2].
        pose: of the robot, x and y in m and yaw in rad, [3].

    Example:
        >>> seen_from(np.array([[2.0, 4.0]]), (2.0, 3.0, math.pi / 2.0)).round(9).tolist()
        [[1.0, 0.0]]
    """
    x, y, yaw = pose
    cos, sin = math.cos(yaw), math.sin(yaw)
    found: NDArray[np.float64] = (points - (x, y)) @ np.array([[cos, -sin], [sin, cos]])
    return found
