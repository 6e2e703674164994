"""Who is at the other end of a node's topics, in sentences: why a robot stands although every program runs.

Types are named as ROS 2 names them, such as ``"geometry_msgs/msg/Twist"``.
"""

import re
from collections.abc import Sequence

DRIVING = "driving"
"""What ``drive_status`` says where there is nothing else to say."""

_NUMBER = re.compile(r"\d+(\.\d+)?")


def writers_of(topic: str, kind: str, writers: Sequence[str], *, matched: bool = True) -> str | None:
    """Return why nothing comes on a topic that a node reads; None if something may.

    Args:
        topic: its name.
        kind: the type that is read.
        writers: the type of each of its writers.
        matched: whether the middleware connects a writer of that type with the node's reader.

    Example:
        >>> writers_of("/scan", "sensor_msgs/msg/LaserScan", ["sensor_msgs/msg/PointCloud2"])
        '/scan is written as sensor_msgs/msg/PointCloud2, and read as sensor_msgs/msg/LaserScan'
    """
    if not writers:
        return f"nobody writes {topic} ({kind})"
    if kind not in writers:
        return f"{topic} is written as {_listed(writers)}, and read as {kind}"
    if not matched:
        return f"{topic} is written with less quality of service than is asked for: make its writer reliable"
    return None


def no_map_on(topic: str, writers: Sequence[str]) -> str:
    """Return why a node that would use a map has none.

    Args:
        topic: its name.
        writers: the type of each of its writers.

    Example:
        >>> no_map_on("/map", [])
        'nobody writes /map: detours know what was seen alone'
    """
    if not writers:
        return f"nobody writes {topic}: detours know what was seen alone"
    return f"{topic} is written, and none has come: its writer must be reliable and transient local"


def readers_of(topic: str, kinds: Sequence[str], readers: Sequence[str]) -> str:
    """Return who reads a topic that a node writes.

    Args:
        topic: its name.
        kinds: the types that the node writes.
        readers: the type of each of its readers.

    Example:
        >>> readers_of("/cmd_vel", ["geometry_msgs/msg/TwistStamped"], ["geometry_msgs/msg/Twist"])
        '/cmd_vel is read as geometry_msgs/msg/Twist, and written as geometry_msgs/msg/TwistStamped'
    """
    if not readers:
        return f"nobody reads {topic} (written as {_listed(kinds)})"
    said = f"{topic} is read as {_listed(readers)}"
    return said if set(readers) <= set(kinds) else f"{said}, and written as {_listed(kinds)}"


def without_numbers(reason: str | None) -> str | None:
    """Return what kind of reason it is: one that only counts on is not told again.

    Example:
        >>> without_numbers("stamp scan_s is 0.40 s old") == without_numbers("stamp scan_s is 0.54 s old")
        True
    """
    return None if reason is None else _NUMBER.sub("", reason)


def _listed(kinds: Sequence[str]) -> str:
    return " and ".join(sorted(set(kinds)))
