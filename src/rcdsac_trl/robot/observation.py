"""What an agent is told: range bins and waypoints (paper, section "States and Observations").

Pure functions; the simulated world and the policy on a robot call the same ones, so that what an agent sees there is
what it was trained on.
"""

import math
from typing import Literal

import numpy as np
from numpy.typing import ArrayLike, NDArray

from rcdsac_trl.robot.range_sensor import MAX_RANGE_M

# Observations (paper, section "States and Observations").
MIN_RANGE_M = 0.01
"""Ranges are seen strictly between this and :data:`MAX_RANGE_M`, on the paper's robot.

The observation of a sensor that reaches farther, or less far, holds the same numbers for the same shares of its reach.
"""


RANGE_OFFSET = 2.5
"""What is added to log10 of the distance, so that 0 can mean "nothing there"."""


MAX_RANGE_OBSERVATION = RANGE_OFFSET + math.log10(MAX_RANGE_M)
"""Upper limit of a range observation."""


RangeCode = Literal["paper", "nearness"]
"""How networks read range observations: ``paper`` as they are, with 0, nothing there, beside what nearly touches;
``nearness`` as log10(3 m / distance), which is 0 at 3 m and where nothing is, and rises evenly from there."""


WAYPOINT_DISTANCE_LIMITS_M = (0.01, 100.0)


VECTOR_OBSERVATIONS: dict[str, int] = {"waypoint": 6, "velocity": 4}
"""Name and size of every observation of the paper's agents besides ``range``."""


NUM_REMEMBERED_SECTORS = 36
"""Sectors of what is remembered, of 10 degrees: as wide as the robot in 3 m."""


NUM_REMEMBERED_MOVERS = 2
"""More things that move are seldom near at once."""


REMEMBERED_MOVER_SIZE = 5
"""Numbers for each of them."""


NUM_FORESEEN_COMMANDS = 22
"""Commands whose clearance is foreseen, for two horizons; see :mod:`rcdsac_trl.robot.foreseen_clearance`."""


REMEMBERED_SIZE = NUM_REMEMBERED_SECTORS + NUM_REMEMBERED_MOVERS * REMEMBERED_MOVER_SIZE + 2 * NUM_FORESEEN_COMMANDS
"""Numbers that tell what is remembered; see :class:`rcdsac_trl.robot.remembered_ranges.RememberedRanges`."""

Point = tuple[float, float]
"""x and y in the map frame, m."""


AT_ORIGIN = (0.0, 0.0, 0.0)
"""The robot's pose in its own frame: from there waypoints are observed that are told in it."""


def vector_observations(memory_s: float) -> dict[str, int]:
    """Return name and size of every observation of an agent besides ``range``, in the order that networks read them in.

    Args:
        memory_s: for how long points are remembered, s; 0: nothing is remembered, as in the paper.

    Example:
        >>> vector_observations(0.0), vector_observations(12.0)["remembered"]
        ({'waypoint': 6, 'velocity': 4}, 90)
    """
    return VECTOR_OBSERVATIONS | ({"remembered": REMEMBERED_SIZE} if memory_s > 0.0 else {})


def range_observation(distances: ArrayLike, mask: ArrayLike, max_range_m: float = MAX_RANGE_M) -> NDArray[np.float32]:
    """Return o_rng: 2.5 + log10 of the distance, 0 where nothing is within (0.01, 3) m or the mask is false.

    Distances of a sensor with another reach are scaled to 3 m, so that it tells what is near in the same numbers: a
    network, and whatever else reads an observation, is the same for all of them.

    Args:
        distances: [..., 180], m; ``inf`` where nothing is.
        mask: bool [180], the bins the sensor has; see :func:`sensor_mask`.
        max_range_m: reach of the sensor.

    Returns:
        float32 [..., 180].

    Example:
        >>> range_observation([1.0, 0.1, 3.0], [True, True, True]).tolist()
        [2.5, 1.5, 0.0]
    """
    d = np.asarray(distances, dtype=np.float64)
    if max_range_m != MAX_RANGE_M:
        d = d * (MAX_RANGE_M / max_range_m)
    observed = np.zeros(d.shape, dtype=np.float32)
    seen = (d > MIN_RANGE_M) & (d < MAX_RANGE_M) & np.asarray(mask, dtype=np.bool_)
    # Of the logarithms, the expensive part, only those that are seen.
    observed[seen] = RANGE_OFFSET + np.log10(d[seen])
    return observed


def range_distances(observed: ArrayLike, max_range_m: float = MAX_RANGE_M) -> NDArray[np.float64]:
    """Return the distances of range observations, m; ``inf`` where nothing was seen. Undoes :func:`range_observation`.

    Args:
        observed: o_rng, [..., 180].
        max_range_m: reach of the sensor.

    Example:
        >>> range_distances([2.5, 1.5, 0.0]).tolist()
        [1.0, 0.1, inf]
    """
    o = np.asarray(observed, dtype=np.float64)
    distances: NDArray[np.float64] = np.where(o > 0.0, 10.0 ** (o - RANGE_OFFSET), np.inf)
    return distances if max_range_m == MAX_RANGE_M else distances * (max_range_m / MAX_RANGE_M)


def waypoint_observation(pose: tuple[float, float, float], waypoint_1: Point, waypoint_2: Point) -> tuple[float, ...]:
    """Return o_waypoint: log10 of the distance, cosine and sine of the bearing, of the next two waypoints.

    Args:
        pose: the robot's x, y in m and yaw in rad, map frame.
        waypoint_1: the next waypoint, map frame, m.
        waypoint_2: the one after it; on the last leg both are the goal.

    Returns:
        Six numbers; distances are clipped to [0.01, 100] m before the logarithm.

    Example:
        >>> observed = waypoint_observation((0.0, 0.0, 0.0), (10.0, 0.0), (0.0, 100.0))
        >>> [round(value, 6) for value in observed]
        [1.0, 1.0, 0.0, 2.0, 0.0, 1.0]
    """
    low, high = WAYPOINT_DISTANCE_LIMITS_M
    distance_1, bearing_1 = distance_and_bearing(pose, waypoint_1)
    distance_2, bearing_2 = distance_and_bearing(pose, waypoint_2)
    return (
        math.log10(min(max(distance_1, low), high)),
        math.cos(bearing_1),
        math.sin(bearing_1),
        math.log10(min(max(distance_2, low), high)),
        math.cos(bearing_2),
        math.sin(bearing_2),
    )


def waypoint_positions(observed: ArrayLike) -> NDArray[np.float64]:
    """Return where waypoints are, float64 [N, 2, 2], in the robot's frame, m. Undoes :func:`waypoint_observation`.

    Args:
        observed: o_waypoint, [N, 6].

    Example:
        >>> waypoint_positions([[1.0, 1.0, 0.0, 2.0, 0.0, 1.0]]).tolist()
        [[[10.0, 0.0], [0.0, 100.0]]]
    """
    each = np.asarray(observed, np.float64).reshape(-1, 2, 3)
    return 10.0 ** each[..., :1] * each[..., 1:]


def distance_and_bearing(pose: tuple[float, float, float], point: Point) -> tuple[float, float]:
    """Return the distance to a point in m and its angle from the robot's x axis in rad, any full turns apart.

    Args:
        pose: the robot's x, y in m and yaw in rad, map frame.
        point: map frame, m.
    """
    x, y, yaw = pose
    dx, dy = point[0] - x, point[1] - y
    return math.hypot(dx, dy), math.atan2(dy, dx) - yaw
