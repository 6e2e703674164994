"""Planar laser scans to sectors: any field of view, direction and increment, and everything a driver may write.

What a ray's number means (REP 117, and what drivers do in spite of it):

| number | means |
|---|---|
| within [range_min, range_max] | something is there |
| +Inf, or beyond range_max | nothing is there |
| -Inf | something is there, nearer than range_min: it counts as range_min |
| NaN, 0, or otherwise below range_min | no measurement: the ray says nothing |
| 0 with ``zero_means="far"``, NaN with ``nan_means="far"`` | nothing is there: so do some cheap scanners say it |
| the same with ``"near"`` | something is there, nearer than range_min: it counts as range_min |

Since beyond range_max is nothing, a scan in millimetres would read as open space: it is refused before.
"""

import math
from dataclasses import dataclass, field
from typing import Literal, get_args

import numpy as np
from numpy.typing import ArrayLike, NDArray

from rcdsac_trl.deploy.sensors.arrays import numbers_of
from rcdsac_trl.errors import UserInputError
from rcdsac_trl.robot.range_sensor import MAX_RANGE_M, NUM_BINS
from rcdsac_trl.robot.sectors import (
    BODY_RADIUS_M,
    Mount,
    Sectors,
    bins_of,
    is_finite_number,
    nearest_by_sector,
)

# More than a turn and a half of rays, or so many of them, is no scan.
_LONGEST_SCAN_RAD = 3.0 * math.pi
_MOST_RAYS = 1_000_000
# Two turns, and 29 degrees: beyond, angles are degrees.
_LARGEST_ANGLE_RAD = 4.0 * math.pi
_LARGEST_INCREMENT_RAD = 0.5
# No scanner of a robot measures farther.
_LONGEST_RANGE_M = 300.0
# What a driver writes where nothing is may be this much beyond range_max; what is more than the larger multiple is no
# reading in millimetres either.
_BEYOND, _FAR_BEYOND = 2.0, 1000.0
# The last numbers of 16 bits, in millimetres: so many drivers write that nothing is there.
_LAST_OF_16_BITS_M = (65.5325, 65.5355)

Meaning = Literal["invalid", "far", "near"]
"""What a driver means by a reading that is no distance: no measurement, nothing there, something before range_min."""


_STANDS_FOR: dict[Meaning, float] = {"invalid": math.nan, "far": math.inf, "near": -math.inf}


@dataclass(frozen=True)
class Scan:
    """One planar scan, with the fields of ROS's ``sensor_msgs/LaserScan``.

    Attributes:
        ranges: distances from the sensor, m, [n].
        angle_min: angle of the first ray, rad, counter-clockwise from the sensor's x axis.
        angle_increment: from one ray to the next, rad; negative for a scan that runs clockwise.
        range_min: smallest distance that the sensor measures, m.
        range_max: largest one, m; may be ``inf``.
        mount: where the sensor sits; of one that moves while it turns, where it was at its first ray.
        zero_means: what the driver means by a reading of 0: ``"invalid"``, ``"far"`` if it writes 0 where nothing is,
            or ``"near"`` if it does where something is too near. With ``"far"`` a sensor that fails with zeros reads
            as open space.
        nan_means: the same of NaN.
        end_mount: where the sensor was at its last ray, in the frame of `mount`; from the one to the other it moved
            evenly, by the shorter turn. None: all rays were measured from `mount`.
    """

    ranges: ArrayLike
    angle_min: float
    angle_increment: float
    range_min: float
    range_max: float
    mount: Mount = field(default_factory=Mount)
    zero_means: Meaning = "invalid"
    nan_means: Meaning = "invalid"
    end_mount: Mount | None = None


def check_meaning(name: str, value: object) -> None:
    """Refuse what readings cannot mean.

    Raises:
        UserInputError: with what they can.
    """
    if value not in get_args(Meaning):
        raise UserInputError(f"{name}={value!r} is none of {', '.join(get_args(Meaning))}: choose one")


def scan_sectors(scan: Scan, *, body_radius_m: float = BODY_RADIUS_M, max_range_m: float = MAX_RANGE_M) -> Sectors:
    """Return what a scan says about each sector.

    A sector is covered if at least one ray points into it and at least half of those that do say something. Points
    are taken from the robot's centre; a sensor that sits elsewhere sees sectors a little askew, so mount it within
    0.3 m of the centre. Where a sensor turned against its sweep, sectors between its last and its first ray were not
    seen, and are not covered.

    Args:
        scan: of any angle range and direction.
        body_radius_m: what is nearer to the robot's centre is the robot, and such a ray says nothing.
        max_range_m: as far as the agent sees.

    Raises:
        UserInputError: if the scan cannot be one: no ray, an increment of 0, angles in degrees, limits that are no
            numbers, a sensor that does not reach as far as the agent sees or that turned over on its way, or readings
            that are not in metres.

    Example:
        >>> scan = Scan(np.full(360, 2.0), -math.pi, math.radians(1.0), 0.1, 10.0)
        >>> sectors = scan_sectors(scan)
        >>> float(sectors.distances_m.max()), bool(sectors.covered.all())
        (2.0, True)
    """
    ranges = _checked(scan, max_range_m)
    with np.errstate(invalid="ignore"):
        for readings, meaning in ((ranges == 0.0, scan.zero_means), (np.isnan(ranges), scan.nan_means)):
            ranges = np.where(readings, _STANDS_FOR[meaning], ranges)
        too_near = np.isneginf(ranges)
        silent = np.isnan(ranges) | (ranges < scan.range_min) & ~too_near
        ranges = np.where(ranges > scan.range_max, np.inf, ranges)
        ranges[too_near] = scan.range_min
    turn = -1.0 if scan.mount.upside_down else 1.0
    places = _places(scan, len(ranges))
    angles = places[2] + turn * (scan.angle_min + scan.angle_increment * np.arange(len(ranges)))
    bearings = bins_of(angles)
    hits = ~silent & np.isfinite(ranges)
    distances, bins = ranges[hits], bearings[hits]
    if places[:2].any():
        x_m, y_m = places[:2] if scan.end_mount is None else places[:2, hits]
        x, y = x_m + distances * np.cos(angles[hits]), y_m + distances * np.sin(angles[hits])
        distances, bins = np.hypot(x, y), bins_of(np.arctan2(y, x))
    own = distances < body_radius_m
    silent[np.flatnonzero(hits)[own]] = True
    rays, saying = (np.bincount(bearings[which], minlength=NUM_BINS) for which in (slice(None), ~silent))
    covered = (saying > 0) & (2 * saying >= rays)
    nearest = nearest_by_sector(bins[~own], distances[~own], max_range_m=max_range_m)
    # Something that is seen is seen, whatever the other rays of its sector say.
    return Sectors(nearest, covered | np.isfinite(nearest), max_range_m)


def _places(scan: Scan, rays: int) -> NDArray[np.float64]:
    """Return x and y in m and yaw in rad of the sensor, [3, 1]; of one that moved at each ray, [3, rays]."""
    start, end = scan.mount, scan.end_mount
    first = np.array([[start.x_m], [start.y_m], [start.yaw_rad]])
    if end is None:
        return first
    way = np.array([[end.x_m - start.x_m], [end.y_m - start.y_m], [_turned_rad(start, end)]])
    return first + way * np.linspace(0.0, 1.0, rays)


def _turned_rad(start: Mount, end: Mount) -> float:
    return math.remainder(end.yaw_rad - start.yaw_rad, 2.0 * math.pi)


def unswept_rad(scan: Scan) -> float:
    """Return how much of a full turn a sensor left out that turned against its sweep, rad; 0 of any other.

    Example:
        >>> turned = Mount(yaw_rad=-0.1)
        >>> unswept_rad(Scan(np.full(360, 2.0), 0.0, math.radians(1.0), 0.1, 10.0, end_mount=turned))
        0.1
    """
    if scan.end_mount is None:
        return 0.0
    turned_rad = _turned_rad(scan.mount, scan.end_mount)
    swept = -scan.angle_increment if scan.mount.upside_down else scan.angle_increment
    return max(0.0, -math.copysign(1.0, swept) * turned_rad)


def unsaid_readings(scan: Scan) -> dict[str, int]:
    """Return how many rays of a scan read 0, and how many NaN, where nobody said what is meant by it."""
    ranges = numbers_of(scan.ranges, "ranges")
    zeros, nans = np.count_nonzero(ranges == 0.0), np.count_nonzero(np.isnan(ranges))
    return {
        "zero_means": int(zeros) if scan.zero_means == "invalid" else 0,
        "nan_means": int(nans) if scan.nan_means == "invalid" else 0,
    }


def _checked(scan: Scan, max_range_m: float) -> NDArray[np.float64]:
    ranges = numbers_of(scan.ranges, "the scan's ranges")
    if ranges.ndim != 1 or not 0 < len(ranges) <= _MOST_RAYS:
        raise UserInputError(f"the scan's ranges have shape {list(ranges.shape)}: give one number for each ray")
    for name, mount in (("mount", scan.mount), ("end_mount", scan.mount if scan.end_mount is None else scan.end_mount)):
        if not isinstance(mount, Mount):
            raise UserInputError(f"the scan's {name} is a {type(mount).__name__}: give a Mount")
        if mount.upside_down != scan.mount.upside_down:
            raise UserInputError("the scan's mount and end_mount are one upside down, one not: give both alike")
    check_meaning("zero_means", scan.zero_means)
    check_meaning("nan_means", scan.nan_means)
    _check_angles(scan, len(ranges))
    _check_limits(scan, max_range_m)
    _check_unit(ranges, scan)
    return ranges


def _check_angles(scan: Scan, rays: int) -> None:
    for name in ("angle_min", "angle_increment"):
        if not is_finite_number(getattr(scan, name)):
            raise UserInputError(f"the scan's {name} is no finite number: check the driver")
    if scan.angle_increment == 0.0 or abs(scan.angle_increment) * (rays - 1) > _LONGEST_SCAN_RAD:
        raise UserInputError(
            f"the scan's increment of {scan.angle_increment:g} over {rays} rays is no scan: give radians"
        )
    if abs(scan.angle_increment) > _LARGEST_INCREMENT_RAD:
        raise UserInputError(
            f"the scan's angle_increment={scan.angle_increment:g} is more than {_LARGEST_INCREMENT_RAD:g} rad, no "
            "scan is so sparse: give radians"
        )
    if abs(scan.angle_min) > _LARGEST_ANGLE_RAD:
        raise UserInputError(
            f"the scan's angle_min={scan.angle_min:g} is more than two turns ({_LARGEST_ANGLE_RAD:.2f} rad): give "
            "radians"
        )


def _check_limits(scan: Scan, max_range_m: float) -> None:
    if not is_finite_number(scan.range_min):
        raise UserInputError("the scan's range_min is no finite number: check the driver")
    if not (is_finite_number(scan.range_max) or scan.range_max == math.inf):
        raise UserInputError("the scan's range_max is no number (inf is one): check the driver")
    if not 0.0 <= scan.range_min < scan.range_max or scan.range_max < max_range_m:
        raise UserInputError(
            f"the scan measures {scan.range_min:g} to {scan.range_max:g} m, agents see up to {max_range_m:g} m: use "
            "a sensor that reaches so far"
        )
    if scan.range_min >= max_range_m:
        raise UserInputError(
            f"the scan measures from range_min={scan.range_min:g} m on, agents see only up to {max_range_m:g} m: give "
            "its limits in metres"
        )


def _check_unit(ranges: NDArray[np.float64], scan: Scan) -> None:
    """Refuse a scan whose readings would be beyond its own range_max in metres, and within it in cm or mm.

    A driver may write any number beyond range_max where nothing is; but then the other rays read metres.
    """
    reach = min(scan.range_max, _LONGEST_RANGE_M)
    beyond = ranges[(ranges > min(_BEYOND * reach, _LONGEST_RANGE_M)) & (ranges <= _FAR_BEYOND * reach)]
    if not len(beyond):
        return
    within = np.count_nonzero((ranges >= scan.range_min) & (ranges <= reach) & (ranges > 0.0))
    low, high = float(beyond.min()), float(beyond.max())
    if low == high:  # a sign, which real readings in another unit are not
        if _LAST_OF_16_BITS_M[0] < low < _LAST_OF_16_BITS_M[1]:
            return
        within *= 10
    if within < len(beyond):
        limit = f"its range_max of {scan.range_max:g} m" if scan.range_max == reach else f"any scanner's {reach:g} m"
        raise UserInputError(f"the scan reads up to {high:g}, beyond {limit}: give metres, and inf where nothing is")
