"""ROS 2 messages to what a policy reads, and commands to messages; ROS itself is not needed.

Messages are whatever has the fields of ROS's definitions: those of ``rclpy``, of ``rosbags``, or any other. Wrong ones
raise :class:`~rcdsac_trl.errors.UserInputError`.
"""

import math
from array import array
from collections.abc import Callable
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rcdsac_trl.deploy.frames.rigid_transform import RigidTransform
from rcdsac_trl.deploy.navigation.static_layer import StaticLayer
from rcdsac_trl.deploy.policy.command import Command
from rcdsac_trl.deploy.sensors.arrays import numbers_of
from rcdsac_trl.deploy.sensors.scan import Meaning, Scan
from rcdsac_trl.errors import UserInputError
from rcdsac_trl.robot.sectors import Mount, is_finite_number

# Drivers count the last angle to the last ray or to the one after it; more is another unit, or number of rays.
_ANGLE_SLACK_RAYS, _ANGLE_SLACK_SHARE = 2.0, 0.05
# No scanner of a robot takes longer from its first ray to its last.
_LONGEST_SWEEP_S = 1.0
# builtin_interfaces/Time holds whole seconds in 32 bits.
_LAST_STAMP_S = 2.0**31
# A cell of a nav_msgs/OccupancyGrid that is occupied with so much probability is; -1 is unknown.
_OCCUPIED_PERCENT = (65, 100)
# sensor_msgs/PointField: number of a type to NumPy's.
_POINT_TYPES = {1: "i1", 2: "u1", 3: "i2", 4: "u2", 5: "i4", 6: "u4", 7: "f4", 8: "f8"}


def stamp_s(message: Any) -> float:
    """Return the time in a message's header, s.

    Raises:
        UserInputError: if it does not hold less than a second of nanoseconds.
    """
    return seconds_of(message.header.stamp)


def seconds_of(stamp: Any) -> float:
    """Return a ``builtin_interfaces/Time``, s.

    Raises:
        UserInputError: if it does not hold less than a second of nanoseconds.
    """
    if not 0 <= stamp.nanosec < 1_000_000_000:
        raise UserInputError(f"a stamp's nanosec={stamp.nanosec} is not from 0 to 999999999: put seconds into sec")
    return float(stamp.sec) + 1e-9 * float(stamp.nanosec)


def scan_of(
    message: Any, mount: Mount | None = None, zero_means: Meaning = "invalid", nan_means: Meaning = "invalid"
) -> Scan:
    """Return the scan in a ``sensor_msgs/LaserScan``.

    Args:
        message: the message.
        mount: where the sensor sits, from the static transform to its frame; None for the robot's centre.
        zero_means: what its driver means by a reading of 0.
        nan_means: what it means by NaN.

    Raises:
        UserInputError: if its ranges are no numbers, or its angles do not fit to their number.
    """
    ranges = numbers_of(message.ranges, "the scan's ranges")
    _check_angles(message, ranges.size)
    return Scan(
        ranges=ranges,
        angle_min=float(message.angle_min),
        angle_increment=float(message.angle_increment),
        range_min=float(message.range_min),
        range_max=float(message.range_max),
        mount=mount or Mount(),
        zero_means=zero_means,
        nan_means=nan_means,
    )


def sweep_s(message: Any) -> float:
    """Return how long after its stamp, which is of the first ray, the last one of a ``sensor_msgs/LaserScan`` was seen.

    Returns:
        s; 0 where the message does not say it. A ``time_increment`` that is negative, not finite, or makes more than
        1 s of a sweep is none: drivers that do not know it write anything there.
    """
    swept_s = float(getattr(message, "time_increment", 0.0)) * (len(message.ranges) - 1)
    return swept_s if 0.0 < swept_s <= _LONGEST_SWEEP_S else 0.0


def _check_angles(message: Any, rays: int) -> None:
    """Refuse a ``LaserScan`` whose last angle is not where its rays lead: one of its fields is in another unit."""
    first, last, increment = float(message.angle_min), float(message.angle_max), float(message.angle_increment)
    leads_to = first + increment * (rays - 1)
    slack = max(_ANGLE_SLACK_RAYS * abs(increment), _ANGLE_SLACK_SHARE * abs(last - first))
    if abs(leads_to - last) > slack:
        raise UserInputError(
            f"the scan's {rays} rays from angle_min={first:g} in steps of angle_increment={increment:g} lead to "
            f"{leads_to:g}, its angle_max={last:g} is elsewhere: give all three in radians, and a number for each ray"
        )


def points_of(message: Any) -> NDArray[np.float64]:
    """Return the points of a ``sensor_msgs/PointCloud2`` in its own frame, m, [n, 3].

    Raises:
        UserInputError: if it has no x, y and z as numbers, or less data than it says.
    """
    fields = {field.name: field for field in message.fields}
    height, width, step, row = (int(getattr(message, name)) for name in ("height", "width", "point_step", "row_step"))
    order = ">" if message.is_bigendian else "<"
    names, formats, offsets = ["x", "y", "z"], [], []
    for name in names:
        field = fields.get(name)
        kind = None if field is None else _POINT_TYPES.get(int(field.datatype))
        if field is None or kind is None:
            raise UserInputError(
                f"the cloud's points have no {name}, only {', '.join(fields) or 'nothing'}: send x, y, z"
            )
        formats.append(order + kind)
        offsets.append(int(field.offset))
    data = np.frombuffer(bytes(message.data), dtype=np.uint8)
    fits = all(0 <= o <= step - np.dtype(f).itemsize for o, f in zip(offsets, formats, strict=True))
    if min(height, width) < 0 or not fits or row < width * step or len(data) < height * row:
        raise UserInputError(
            f"the cloud says {height} x {width} points of {step} bytes and has {len(data)} bytes: its sender is broken"
        )
    if height * width == 0:
        return np.empty((0, 3))
    layout = np.dtype({"names": names, "formats": formats, "offsets": offsets, "itemsize": step})
    rows = np.ascontiguousarray(data[: height * row].reshape(height, row)[:, : width * step])
    points = rows.view(layout)
    return np.stack([points[name].astype(np.float64).ravel() for name in names], axis=1)


def velocity_of_odometry(message: Any) -> tuple[float, float]:
    """Return the velocities in a ``nav_msgs/Odometry``, m/s and rad/s, which are in the robot's frame."""
    twist = message.twist.twist
    return float(twist.linear.x), float(twist.angular.z)


def pose_of_odometry(message: Any) -> tuple[float, float, float]:
    """Return x and y in m and yaw in rad of a ``nav_msgs/Odometry``, in its header's frame.

    Raises:
        UserInputError: if the orientation is no rotation.
    """
    return pose_of(message)


def pose_of(message: Any) -> tuple[float, float, float]:
    """Return x and y in m and yaw in rad of a ``geometry_msgs/PoseWithCovarianceStamped``, in its header's frame.

    Raises:
        UserInputError: if the orientation is no rotation.
    """
    pose = message.pose.pose
    return float(pose.position.x), float(pose.position.y), _yaw(pose.orientation)


def transform_of(message: Any) -> tuple[str, str, float, RigidTransform]:
    """Return parent, child, stamp in s and transform of a ``geometry_msgs/TransformStamped``.

    Raises:
        UserInputError: if the transform is none.
    """
    place, turn = message.transform.translation, message.transform.rotation
    transform = RigidTransform(
        (float(place.x), float(place.y), float(place.z)),
        (float(turn.x), float(turn.y), float(turn.z), float(turn.w)),
    )
    return str(message.header.frame_id), str(message.child_frame_id), stamp_s(message), transform


def path_of(message: Any) -> NDArray[np.float64]:
    """Return the points of a ``nav_msgs/Path``, m, [n, 2], in its header's frame."""
    points = [(float(stamped.pose.position.x), float(stamped.pose.position.y)) for stamped in message.poses]
    return np.array(points, dtype=np.float64).reshape(-1, 2)


def static_layer_of(message: Any) -> StaticLayer:
    """Return what a ``nav_msgs/OccupancyGrid`` shows, in its header's frame; unknown cells count as free.

    Raises:
        UserInputError: if it has not as many cells as it says, they are no numbers, or its origin is no pose.
    """
    info = message.info
    width, height = int(info.width), int(info.height)
    cells = _cells_of(message.data)
    if cells.shape != (width * height,):
        raise UserInputError(f"the map says {height} x {width} cells and has {cells.size}: its sender is broken")
    origin = float(info.origin.position.x), float(info.origin.position.y), _yaw(info.origin.orientation)
    low, high = _OCCUPIED_PERCENT
    occupied = ((cells >= low) & (cells <= high)).reshape(height, width)
    return StaticLayer.of_cells(occupied, float(info.resolution), origin)


def _cells_of(data: Any) -> NDArray[Any]:
    """Return the cells of an occupancy grid: of bytes, which are read at once, or of a list, which takes longer."""
    if isinstance(data, bytes | bytearray | memoryview | array):
        return np.frombuffer(data, np.int8)
    if isinstance(data, np.ndarray) and data.dtype.itemsize == 1:
        return data.view(np.int8)
    return numbers_of(data, "the map's cells")


def twist_stamped(command: Command, now_s: float, make: Callable[[str], Any], *, frame_id: str = "base_link") -> Any:
    """Return a command as ``geometry_msgs/TwistStamped``.

    Args:
        command: of the policy.
        now_s: time for the header, s.
        make: returns an empty message of the type with that name; see :func:`rosbags_maker`.
        frame_id: of the header.

    Raises:
        UserInputError: if the time is not one in seconds that a header can hold.
    """
    if not (is_finite_number(now_s) and 0.0 <= now_s < _LAST_STAMP_S):
        raise UserInputError(f"now_s={now_s} is not from 0 to {_LAST_STAMP_S:g}: give seconds")
    message = make("geometry_msgs/msg/TwistStamped")
    nanoseconds = round(now_s * 1e9)
    message.header.stamp.sec, message.header.stamp.nanosec = divmod(nanoseconds, 1_000_000_000)
    message.header.frame_id = frame_id
    message.twist = twist(command, make)
    return message


def twist(command: Command, make: Callable[[str], Any]) -> Any:
    """Return a command as ``geometry_msgs/Twist``, which many bases still read.

    Args:
        command: of the policy.
        make: as for :func:`twist_stamped`.
    """
    message = make("geometry_msgs/msg/Twist")
    message.linear.x = command.v_m_per_s
    message.angular.z = command.omega_rad_per_s
    return message


def rosbags_maker(store: Any) -> Callable[[str], Any]:
    """Return what makes empty messages of a ``rosbags`` type store: numbers 0, texts empty.

    Args:
        store: from ``rosbags.typesys.get_typestore``.
    """
    zeros = {"string": "", "bool": False, "float32": 0.0, "float64": 0.0}

    def value_of(description: Any) -> Any:
        kind, detail = description
        if kind.name == "NAME":
            return make(detail)
        if kind.name == "BASE":
            return zeros.get(detail[0], 0)
        raise UserInputError(f"messages with lists, such as {detail}, are not made here: make them by hand")

    def make(name: str) -> Any:
        return store.types[name](**{field: value_of(kind) for field, kind in store.fielddefs[name][1]})

    return make


def _yaw(q: Any) -> float:
    x, y, z, w = (float(value) for value in (q.x, q.y, q.z, q.w))
    if not abs(math.hypot(x, y, z, w) - 1.0) < 0.1:  # also false for NaN
        raise UserInputError(f"orientation ({x:g}, {y:g}, {z:g}, {w:g}) is no rotation: its length must be 1")
    return math.atan2(2.0 * (w * z + x * y), 1.0 - 2.0 * (y * y + z * z))
