"""ROS 2 messages in and out, through recorded bags of both storage formats, by ROS's own definitions."""

import ast
import math
import struct
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import rcdsac_trl
from rcdsac_trl.deploy import CameraPose, Mount, Policy, scan_sectors
from rcdsac_trl.deploy.policy.driver import Driver
from rcdsac_trl.deploy.ros.messages import (
    path_of,
    points_of,
    pose_of_odometry,
    rosbags_maker,
    scan_of,
    stamp_s,
    sweep_s,
    twist_stamped,
    velocity_of_odometry,
)
from rcdsac_trl.errors import UserInputError
from robots import agent

pytest.importorskip("rosbags")
from rosbags.rosbag2 import Reader, StoragePlugin, Writer
from rosbags.typesys import Stores, get_typestore

STORE = get_typestore(Stores.ROS2_HUMBLE)
MAKE = rosbags_maker(STORE)
TYPES = STORE.types
PERIOD_S = 0.14


def header(now_s: float, frame: str) -> Any:
    seconds, nanoseconds = divmod(round(now_s * 1e9), 1_000_000_000)
    stamp = TYPES["builtin_interfaces/msg/Time"](sec=seconds, nanosec=nanoseconds)
    return TYPES["std_msgs/msg/Header"](stamp=stamp, frame_id=frame)


def single(value: float) -> float:
    return float(np.float32(value))


def laser(now_s: float, ranges: Any = None) -> Any:
    """Return a scan as it arrives: its numbers are in single precision, as those of a recorded one."""
    ranges = np.full(360, 2.0, np.float32) if ranges is None else np.asarray(ranges, np.float32)
    return TYPES["sensor_msgs/msg/LaserScan"](
        header=header(now_s, "laser"),
        angle_min=single(-math.pi),
        angle_max=single(math.pi),
        angle_increment=single(2 * math.pi / len(ranges)),
        time_increment=0.0,
        scan_time=single(0.1),
        range_min=single(0.1),
        range_max=10.0,
        ranges=ranges,
        intensities=np.empty(0, np.float32),
    )


def cloud(now_s: float, points: np.ndarray, frame: str = "camera", big: bool = False, padding: int = 3) -> Any:
    """Pack points as cameras do: y, x and z out of order, a colour between them, and bytes to spare in every row."""
    order = ">" if big else "<"
    packed = b"".join(struct.pack(f"{order}fIfd", y, 7, x, z) for x, y, z in points) + b"\1" * padding
    kinds = {"y": (0, 7), "rgb": (4, 6), "x": (8, 7), "z": (12, 8)}
    fields = [
        TYPES["sensor_msgs/msg/PointField"](name=name, offset=offset, datatype=kind, count=1)
        for name, (offset, kind) in kinds.items()
    ]
    return TYPES["sensor_msgs/msg/PointCloud2"](
        header=header(now_s, frame),
        height=1,
        width=len(points),
        fields=fields,
        is_bigendian=big,
        point_step=20,
        row_step=20 * len(points) + padding,
        data=np.frombuffer(packed, np.uint8),
        is_dense=False,
    )


def odometry(now_s: float, pose: tuple[float, float, float] = (0.0, 0.0, 0.0), frame: str = "odom") -> Any:
    message = STORE.types["nav_msgs/msg/Odometry"]
    covariance = np.zeros(36)
    turn = TYPES["geometry_msgs/msg/Quaternion"](x=0.0, y=0.0, z=math.sin(pose[2] / 2), w=math.cos(pose[2] / 2))
    place = TYPES["geometry_msgs/msg/Pose"](TYPES["geometry_msgs/msg/Point"](x=pose[0], y=pose[1], z=0.0), turn)
    twist = MAKE("geometry_msgs/msg/Twist")
    twist.linear.x, twist.angular.z = 0.3, -0.2
    return message(
        header=header(now_s, frame),
        child_frame_id="base_link",
        pose=TYPES["geometry_msgs/msg/PoseWithCovariance"](pose=place, covariance=covariance),
        twist=TYPES["geometry_msgs/msg/TwistWithCovariance"](twist=twist, covariance=covariance),
    )


def path(now_s: float, points: list[tuple[float, float]], frame: str = "odom") -> Any:
    poses = []
    for x, y in points:
        stamped = MAKE("geometry_msgs/msg/PoseStamped")
        stamped.pose.position.x, stamped.pose.position.y = x, y
        poses.append(stamped)
    return TYPES["nav_msgs/msg/Path"](header=header(now_s, frame), poses=poses)


# ------------------------------------------------------------------------------------------------ one message
def test_laser_odometry_and_path() -> None:
    assert stamp_s(laser(12.25)) == 12.25
    mount = Mount(x_m=0.1)
    scan = scan_of(laser(0.0), mount)
    assert (scan.range_min, scan.range_max, scan.mount) == (single(0.1), 10.0, mount)
    assert scan_sectors(scan_of(laser(0.0))).distances_m.tolist() == [2.0] * 180
    message = laser(0.0)
    assert sweep_s(message) == 0.0
    message.time_increment = single(0.0005)
    assert sweep_s(message) == pytest.approx(0.1795)  # from the first of 360 rays to the last
    message = odometry(0.0, (1.0, 2.0, -2.5))
    assert pose_of_odometry(message) == pytest.approx((1.0, 2.0, -2.5))
    assert velocity_of_odometry(message) == (0.3, -0.2)
    assert path_of(path(0.0, [(1.0, 2.0), (3.0, 4.0)])).tolist() == [[1.0, 2.0], [3.0, 4.0]]
    assert path_of(path(0.0, [])).shape == (0, 2)
    message.pose.pose.orientation.w = 0.0
    message.pose.pose.orientation.z = 0.0
    with pytest.raises(UserInputError, match="is no rotation"):
        pose_of_odometry(message)


@pytest.mark.parametrize("big", [False, True])
def test_points_lie_where_their_fields_say(big: bool) -> None:
    points = np.array([[1.0, 2.0, 3.0], [math.nan, 0.5, -1.0], [4.0, 5.0, 6.0]])
    np.testing.assert_array_equal(points_of(cloud(0.0, points, big=big)), points)
    assert points_of(cloud(0.0, np.empty((0, 3)))).shape == (0, 3)


def test_broken_clouds_are_refused() -> None:
    points = np.ones((4, 3))
    short = cloud(0.0, points)
    short.data = short.data[:30]
    with pytest.raises(UserInputError, match="has 30 bytes"):
        points_of(short)
    flat = cloud(0.0, points)
    flat.fields = [field for field in flat.fields if field.name != "z"]
    with pytest.raises(UserInputError, match="have no z, only y, rgb, x"):
        points_of(flat)
    wide = cloud(0.0, points)
    wide.point_step = 16
    with pytest.raises(UserInputError, match="its sender is broken"):
        points_of(wide)


# ------------------------------------------------------------------------------------------------ the driver
def driver_at(now_s: float, **options: Any) -> Driver:
    driver = Driver(Policy(agent()), **options)
    driver.on_odometry(odometry(now_s))
    driver.on_path(path(now_s, [(0.0, 0.0), (5.0, 0.0)]))
    return driver


def test_it_stands_until_it_has_everything_and_says_what_is_missing() -> None:
    driver = Driver(Policy(agent()))
    told = []
    for give in (
        lambda: driver.on_odometry(odometry(10.0)),
        lambda: driver.on_path(path(10.0, [(5.0, 0.0)])),
        lambda: driver.on_scan(laser(10.0)),
    ):
        told.append(driver.command(10.0).reason.split(";")[0])
        give()
    assert told == ["there is no odometry yet", "there is no path yet", "there is no scan yet"]
    assert driver.command(10.1).fresh
    driver.on_path(path(10.1, []))
    assert "there is no path yet" in driver.command(10.1).reason
    driver.on_path(path(10.1, [(5.0, 0.0)], frame="map"))
    assert "the path is in frame 'map', odometry in 'odom'" in driver.command(10.1).reason
    driver.on_path(path(10.1, [(math.nan, 0.0)]))
    assert "the path cannot be read" in driver.command(10.1).reason
    driver.on_path(path(10.1, [(0.1, 0.0)]))
    assert "the goal is reached" in driver.command(10.1).reason
    assert driver.arrived


def test_messages_grow_old_and_broken_ones_stop_it() -> None:
    driver = driver_at(10.0)
    driver.on_scan(laser(10.0))
    assert driver.command(10.1).fresh
    assert "scan_s is 0.40 s old" in driver.command(10.4).reason
    driver.on_odometry(odometry(10.5))
    driver.on_scan(laser(10.5))
    assert driver.command(10.5).fresh
    driver.on_scan(None)
    assert driver.command(10.6).stopped
    driver.on_scan("garbage")
    assert "a message cannot be read" in driver.command(10.6).reason
    driver.on_scan(laser(10.6))
    assert driver.command(10.65).fresh


def test_beta_and_stop_are_live() -> None:
    driver = driver_at(10.0)
    driver.on_scan(laser(10.0))
    driver.beta = 3.0
    assert "beta=3 is outside" in driver.command(10.0).reason
    driver.beta = -2.0
    assert driver.command(10.0).fresh
    driver.policy.stop()
    assert "resume() ends it" in driver.command(10.0).reason


def test_clouds_of_all_cameras_are_needed_and_the_oldest_counts() -> None:
    turned = (0.0, 0.0, 1.0, 0.0)
    cameras = {"front": CameraPose((0.2, 0.0, 0.3)), "back": CameraPose((-0.2, 0.0, 0.3), turned)}
    driver = driver_at(10.0, cameras=cameras)
    wall = np.column_stack([np.full(400, 1.5), np.linspace(-0.5, 0.5, 400), np.zeros(400)])
    driver.on_cloud(cloud(10.0, wall, "front"))
    assert "not of every camera" in driver.command(10.0).reason
    driver.on_cloud(cloud(9.5, wall, "back"))
    assert "scan_s is 0.50 s old" in driver.command(10.0).reason
    driver.on_cloud(cloud(10.0, wall, "back"))
    # Both see 70 degrees; a narrow agent looks 42 to 44 to each side.
    assert "of the range bins this agent sees are not measured" in driver.command(10.0).reason
    wider = {frame: CameraPose(pose.position_m, pose.quaternion, 1.6) for frame, pose in cameras.items()}
    driver = driver_at(10.0, cameras=wider)
    driver.on_cloud(cloud(10.0, wall, "front"))
    driver.on_cloud(cloud(10.0, wall, "back"))
    assert driver.command(10.0).fresh


# ------------------------------------------------------------------------------------------------ recorded bags
def drive() -> Iterator[tuple[int, str, str, Any]]:
    """Yield time (ns), topic, type and message of a short drive along a corridor, with some scans dropped.

    No two times are equal: bags give messages by their time alone.
    """
    yield 99_900_000_000, "/plan", "nav_msgs/msg/Path", path(99.9, [(0.0, 0.0), (3.0, 0.0), (3.0, 4.0)])
    for step in range(20):
        now = 100.0 + PERIOD_S * step
        yield round(1e9 * now), "/odom", "nav_msgs/msg/Odometry", odometry(now, (0.05 * step, 0.0, 0.01 * step))
        if not 8 <= step < 12:
            now += 0.01
            angles = -math.pi + 2 * math.pi * np.arange(360) / 360
            with np.errstate(divide="ignore"):
                ranges = np.minimum(1.2 / np.abs(np.sin(angles)), 20.0)
            yield round(1e9 * now), "/scan", "sensor_msgs/msg/LaserScan", laser(now, ranges)


@pytest.mark.parametrize("storage", [StoragePlugin.MCAP, StoragePlugin.SQLITE3])
def test_a_recorded_bag_drives_as_the_live_messages_do(storage: StoragePlugin, tmp_path: Path) -> None:
    with Writer(tmp_path / "drive", version=9, storage_plugin=storage) as writer:
        connections: dict[str, Any] = {}
        for nanoseconds, topic, kind, message in drive():
            if topic not in connections:
                connections[topic] = writer.add_connection(topic, kind, typestore=STORE)
            writer.write(connections[topic], nanoseconds, STORE.serialize_cdr(message, kind))

    live, played = Driver(Policy(agent())), Driver(Policy(agent()))
    expected = [give(live, topic, message, nanoseconds) for nanoseconds, topic, _, message in drive()]
    found = []
    with (
        Reader(tmp_path / "drive") as reader,
        Writer(tmp_path / "commands", version=9, storage_plugin=storage) as writer,
    ):
        kind = "geometry_msgs/msg/TwistStamped"
        commands = writer.add_connection("/cmd_vel", kind, typestore=STORE)
        for connection, nanoseconds, raw in reader.messages():
            message = STORE.deserialize_cdr(raw, connection.msgtype)
            found.append(give(played, connection.topic, message, nanoseconds))
            sent = twist_stamped(found[-1], nanoseconds * 1e-9, MAKE)
            writer.write(commands, nanoseconds, STORE.serialize_cdr(sent, kind))
    assert [c.wanted for c in found] == [c.wanted for c in expected]
    assert {c.stopped for c in found} == {False, True}
    with Reader(tmp_path / "commands") as reader:
        twists = [(ns, STORE.deserialize_cdr(raw, c.msgtype)) for c, ns, raw in reader.messages()]
    assert [(t.twist.linear.x, t.twist.angular.z) for _, t in twists] == [
        (c.v_m_per_s, c.omega_rad_per_s) for c in expected
    ]
    assert all(
        stamp_s(t) == pytest.approx(ns * 1e-9, abs=1e-6) and t.header.frame_id == "base_link" for ns, t in twists
    )


def give(driver: Driver, topic: str, message: Any, nanoseconds: int) -> Any:
    {"/plan": driver.on_path, "/odom": driver.on_odometry, "/scan": driver.on_scan}[topic](message)
    return driver.command(nanoseconds * 1e-9)


def is_subscription(call: ast.Call) -> bool:
    return isinstance(call.func, ast.Attribute) and call.func.attr == "create_subscription"


def test_the_node_only_uses_what_the_core_has() -> None:
    """ROS cannot be installed here: hold the node's imports and calls of ours against what exists."""
    source = Path(rcdsac_trl.__file__).parent / "deploy" / "ros_node.py"
    tree = ast.parse(source.read_text())
    for node in ast.walk(tree):
        if isinstance(node, ast.ImportFrom) and str(node.module).startswith("rcdsac_trl"):
            module = __import__(str(node.module), fromlist=["_"])
            assert all(hasattr(module, alias.name) for alias in node.names)
    subscribed = [node.args[1] for node in ast.walk(tree) if isinstance(node, ast.Call) and is_subscription(node)]
    named = [ast.literal_eval(topic) for topic in subscribed if isinstance(topic, ast.Constant)]
    assert named == ["scan", "odom", "plan", "/tf", "/tf_static", "pose", "map"]  # dds_node's, and Nav2's
    driver = Driver(Policy(agent()))
    used = {ast.unparse(node) for node in ast.walk(tree) if isinstance(node, ast.Attribute)}
    for name in (text.removeprefix("self.driver.") for text in used if text.startswith("self.driver.")):
        owner: Any = driver
        for part in name.split("."):
            assert hasattr(owner, part), name
            owner = getattr(owner, part)
    assert callable(twist_stamped)
