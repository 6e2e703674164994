"""Small recordings of one drive, in every format: a robot goes straight on through a room, and stops.

It starts at (1, 1.5) of the room, which is (0, 0) of its odometry, looks along x, and goes 0.4 m/s for 10 s. Its
scanner looks backwards, and sits 0.1 m behind the centre.
"""

import math
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
from rosbags.interfaces import Nodetype
from rosbags.rosbag1 import Writer as Writer1
from rosbags.rosbag2 import StoragePlugin
from rosbags.rosbag2 import Writer as Writer2
from rosbags.typesys import Stores, get_types_from_msg, get_typestore
from walled_room import ANGLE_MIN_RAD, INCREMENT_RAD, ranges_m

START_M = (1.0, 1.5)
SPEED_M_PER_S, DRIVE_S, PERIOD_S = 0.4, 10.0, 0.1
BEGAN_S = 1_700_000_000.0
TOLD = (0.45, 0.02)
GOAL_M = (8.0, 1.5)
FORMATS = ("bag1", "sqlite", "mcap", "mcap_folder")
Message = tuple[float, str, str, dict[str, Any]]


def here(time_s: float) -> tuple[float, float]:
    """Return how far the robot is on its way, m, and how fast, m/s."""
    driven_s = min(time_s, DRIVE_S)
    return SPEED_M_PER_S * driven_s, SPEED_M_PER_S if time_s < DRIVE_S else 0.0


def header(time_s: float, frame: str) -> dict[str, Any]:
    seconds, nanoseconds = divmod(round((BEGAN_S + time_s) * 1e9), 1_000_000_000)
    return {"stamp": {"sec": seconds, "nanosec": nanoseconds}, "frame_id": frame}


def transform(time_s: float, parent: str, child: str, x: float, y: float, yaw: float) -> dict[str, Any]:
    turn = {"z": math.sin(yaw / 2), "w": math.cos(yaw / 2)}
    return {
        "header": header(time_s, parent),
        "child_frame_id": child,
        "transform": {"translation": {"x": x, "y": y}, "rotation": turn},
    }


def scan(time_s: float, zeros: int = 0, nans: int = 0) -> dict[str, Any]:
    ranges = ranges_m(START_M[0] + here(time_s)[0] - 0.1, START_M[1], math.pi).astype(np.float32)
    ranges[:zeros] = 0.0
    ranges[zeros : zeros + nans] = np.nan
    return {
        "header": header(time_s, "laser"),
        "angle_min": ANGLE_MIN_RAD,
        "angle_max": ANGLE_MIN_RAD + 359 * INCREMENT_RAD,
        "angle_increment": INCREMENT_RAD,
        "range_min": 0.1,
        "range_max": 12.0,
        "ranges": ranges,
    }


def odometry(time_s: float) -> dict[str, Any]:
    x, v = here(time_s)
    return {
        "header": header(time_s, "odom"),
        "child_frame_id": "base_link",
        "pose": {"pose": {"position": {"x": x}, "orientation": {"w": 1.0}}},
        "twist": {"twist": {"linear": {"x": v}}},
    }


def plan(time_s: float, *points: tuple[float, float]) -> dict[str, Any]:
    return {"header": header(time_s, "map"), "poses": [pose(time_s, *point) for point in points]}


def pose(time_s: float, x: float, y: float) -> dict[str, Any]:
    return {"header": header(time_s, "map"), "pose": {"position": {"x": x, "y": y}, "orientation": {"w": 1.0}}}


def drive(**odd: int) -> Iterator[Message]:
    """Yield time, topic, type and content of every message; times differ, since bags order by them alone."""
    yield (
        0.0,
        "/tf_static",
        "tf2_msgs/msg/TFMessage",
        {"transforms": [transform(0.0, "base_link", "laser", -0.1, 0.0, math.pi)]},
    )
    yield 0.001, "/plan", "nav_msgs/msg/Path", plan(0.0, START_M, GOAL_M)
    for step in range(round((DRIVE_S + 1.0) / PERIOD_S)):
        now = 0.01 + PERIOD_S * step
        links = [("map", "odom", *START_M, 0.0), ("odom", "base_link", here(now)[0], 0.0, 0.0)]
        yield now, "/tf", "tf2_msgs/msg/TFMessage", {"transforms": [transform(now, *link) for link in links]}
        yield now + 0.001, "/odom", "nav_msgs/msg/Odometry", odometry(now)
        yield now + 0.002, "/scan", "sensor_msgs/msg/LaserScan", scan(now, **odd)
        told = {"linear": {"x": TOLD[0]}, "angular": {"z": TOLD[1]}}
        yield now + 0.003, "/cmd_vel", "geometry_msgs/msg/Twist", told


def built(store: Any, name: str, values: dict[str, Any]) -> Any:
    """Make a message of a type store: what is not given is 0 or empty."""
    return store.types[name](
        **{field: _value(store, kind, values.get(field)) for field, kind in store.fielddefs[name][1]}
    )


def _value(store: Any, description: Any, value: Any) -> Any:
    kind, detail = description
    if kind is Nodetype.NAME:
        return built(store, detail, value or {})
    if kind is Nodetype.BASE:
        return value if value is not None else {"string": "", "bool": False}.get(detail[0], 0)
    inner, length = detail
    if inner[0] is Nodetype.BASE and inner[1][0] != "string":
        return np.zeros(length or 0, inner[1][0]) if value is None else np.asarray(value, inner[1][0])
    return [_value(store, inner, item) for item in value or []]


def write_bag(path: Path, form: str, messages: Iterator[Message], *, ahead_s: float = 0.0) -> Path:
    """Write messages as a bag of one of the formats, and return its path.

    Args:
        path: without suffix.
        form: one of :data:`FORMATS`.
        messages: of :func:`drive`.
        ahead_s: what the recorder's clock is ahead of the stamps'.
    """
    if form == "bag1":
        store, path = get_typestore(Stores.ROS1_NOETIC), path.with_suffix(".bag")
        store.register(get_types_from_msg("geometry_msgs/TransformStamped[] transforms", "tf2_msgs/msg/TFMessage"))
        writer, serialize = Writer1(path), store.serialize_ros1
    else:
        store = get_typestore(Stores.ROS2_JAZZY)
        plugin = StoragePlugin.SQLITE3 if form == "sqlite" else StoragePlugin.MCAP
        writer, serialize = Writer2(path, version=9, storage_plugin=plugin), store.serialize_cdr
    connections: dict[str, Any] = {}
    with writer:
        for time_s, topic, kind, values in messages:
            if topic not in connections:
                connections[topic] = writer.add_connection(topic, kind, typestore=store)
            raw = serialize(built(store, kind, values), kind)
            writer.write(connections[topic], round((BEGAN_S + ahead_s + time_s) * 1e9), raw)
    return next(path.glob("*.mcap")) if form == "mcap" else path


def write_carmen(path: Path, *, odometry_lines: bool = True) -> Path:
    """Write the same drive as a CARMEN log, with a scanner that looks ahead and sees half a turn."""
    lines = ["# message_name [message contents] ipc_timestamp ipc_hostname logger_timestamp"]
    lines += ["PARAM robot_front_laser_max 8.0", "PARAM robot_frontlaser_offset 0.1", "PARAM base_type pioneer"]
    for step in range(round((DRIVE_S + 1.0) / PERIOD_S)):
        now = PERIOD_S * step
        x, v = here(now)
        tail = f"{BEGAN_S + now:.6f} nohost {now:.6f}"
        if odometry_lines:
            lines.append(f"ODOM {x:.6f} 0 0 {v} 0 0 {tail}")
        ranges = ranges_m(START_M[0] + x + 0.1, START_M[1], 0.0)[90:271]  # from -90 to 90 degrees
        readings = " ".join(f"{value:.3f}" for value in ranges)
        lines.append(f"FLASER 181 {readings} {x + 0.1:.6f} 0 0 {x:.6f} 0 0 {tail}")
    path.write_text("\n".join(lines) + "\n")
    return path
