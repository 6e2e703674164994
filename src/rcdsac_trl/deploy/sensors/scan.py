"""Planar laser scans to sectors: any field of view, direction and increment, and everything a driver may write.

What a ray's number means (REP 117, and what drivers do in spite of it):

| number | means |
|---|---|
| within [range_min, range_max] | something is there |
| +Inf, or beyond range_max | nothing is there |
| -Inf | something is there, nearer than range_min: it counts as range_min |
| NaN, 0, or otherwise below range_min | no measurement: the ray says nothing |
"""

import math
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import ArrayLike, NDArray

from rcdsac_trl.deploy.sensors.sectors import (
    BODY_RADIUS_M,
    Mount,
    Sectors,
    bins_of,
    is_finite_number,
    nearest_by_sector,
)
from rcdsac_trl.errors import UserInputError
from rcdsac_trl.robot.range_sensor import MAX_RANGE_M, NUM_BINS

# More than a turn and a half of rays, or so many of them, is no scan.
_LONGEST_SCAN_RAD = 3.0 * math.pi
_MOST_RAYS = 1_000_000


@dataclass(frozen=True)
class Scan:
    """One planar scan, with the fields of ROS's ``sensor_msgs/LaserScan``.

    Attributes:
        ranges: distances from the sensor, m, [n].
        angle_min: angle of the first ray, rad, counter-clockwise from the sensor's x axis.
        angle_increment: from one ray to the next, rad; negative for a scan that runs clockwise.
        range_min: smallest distance that the sensor measures, m.
        range_max: largest one, m.
        mount: where the sensor sits.
    """

    ranges: ArrayLike
    angle_min: float
    angle_increment: float
    range_min: float
    range_max: float
    mount: Mount = field(default_factory=Mount)


def scan_sectors(scan: Scan, *, body_radius_m: float = BODY_RADIUS_M) -> Sectors:
    """Return what a scan says about each sector.

    A sector is covered if at least one ray points into it and at least half of those that do say something. Points
    are taken from the robot's centre; a sensor that sits elsewhere sees sectors a little askew, so mount it within
    0.3 m of the centre.

    Args:
        scan: of any angle range and direction.
        body_radius_m: what is nearer to the robot's centre is the robot, and such a ray says nothing.

    Raises:
        UserInputError: if the scan cannot be one: no ray, an increment of 0, limits that are no numbers, or a sensor
            that does not reach the 3 m that agents see.

    Example:
        >>> scan = Scan(np.full(360, 2.0), -math.pi, math.radians(1.0), 0.1, 10.0)
        >>> sectors = scan_sectors(scan)
        >>> float(sectors.distances_m.max()), bool(sectors.covered.all())
        (2.0, True)
    """
    ranges = _checked(scan)
    with np.errstate(invalid="ignore"):
        too_near = np.isneginf(ranges)
        silent = np.isnan(ranges) | (ranges < scan.range_min) & ~too_near
        ranges = np.where(ranges > scan.range_max, np.inf, ranges)
        ranges[too_near] = scan.range_min
    mount = scan.mount
    turn = -1.0 if mount.upside_down else 1.0
    angles = mount.yaw_rad + turn * (scan.angle_min + scan.angle_increment * np.arange(len(ranges)))
    bearings = bins_of(angles)
    hits = ~silent & np.isfinite(ranges)
    distances, bins = ranges[hits], bearings[hits]
    if (mount.x_m, mount.y_m) != (0.0, 0.0):
        x, y = mount.x_m + distances * np.cos(angles[hits]), mount.y_m + distances * np.sin(angles[hits])
        distances, bins = np.hypot(x, y), bins_of(np.arctan2(y, x))
    own = distances < body_radius_m
    silent[np.flatnonzero(hits)[own]] = True
    rays, saying = (np.bincount(bearings[which], minlength=NUM_BINS) for which in (slice(None), ~silent))
    covered = (saying > 0) & (2 * saying >= rays)
    nearest = nearest_by_sector(bins[~own], distances[~own])
    # Something that is seen is seen, whatever the other rays of its sector say.
    return Sectors(nearest, covered | np.isfinite(nearest))


def _checked(scan: Scan) -> NDArray[np.float64]:
    try:
        ranges = np.asarray(scan.ranges, dtype=np.float64)
    except (TypeError, ValueError) as error:
        raise UserInputError("the scan's ranges are not numbers: give metres, one for each ray") from error
    if ranges.ndim != 1 or not 0 < len(ranges) <= _MOST_RAYS:
        raise UserInputError(f"the scan's ranges have shape {list(ranges.shape)}: give one number for each ray")
    numbers = (scan.angle_min, scan.angle_increment, scan.range_min, scan.range_max)
    if not all(is_finite_number(n) for n in numbers):
        raise UserInputError("the scan's angles and limits are not all finite numbers: check the driver")
    if scan.angle_increment == 0.0 or abs(scan.angle_increment) * (len(ranges) - 1) > _LONGEST_SCAN_RAD:
        raise UserInputError(
            f"the scan's increment of {scan.angle_increment:g} over {len(ranges)} rays is no scan: give radians"
        )
    if not 0.0 <= scan.range_min < scan.range_max or scan.range_max < MAX_RANGE_M:
        raise UserInputError(
            f"the scan measures {scan.range_min:g} to {scan.range_max:g} m, agents see up to {MAX_RANGE_M:g} m: use "
            "a sensor that reaches so far"
        )
    return ranges
