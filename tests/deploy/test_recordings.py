"""Recordings of others: bags of ROS 1 and 2 and logs of CARMEN, and what is told of those that cannot be read."""

import math
from collections.abc import Iterable
from pathlib import Path

import numpy as np
import pytest

pytest.importorskip("rosbags", reason="bags need rosbags: pip install 'rcdsac-trl[replay]'")
from recordings import BEGAN_S, FORMATS, Message, drive, odometry, write_bag, write_carmen

from rcdsac_trl.deploy import Mount
from rcdsac_trl.deploy.recordings.carmen_log import CarmenLog
from rcdsac_trl.deploy.recordings.open_recording import open_recording
from rcdsac_trl.deploy.recordings.sensor_recording import COMMANDS, ODOMETRY, SCAN, needed_topic, topic_of
from rcdsac_trl.deploy.ros import messages
from rcdsac_trl.errors import UserInputError


@pytest.mark.parametrize("form", FORMATS)
def test_bags_of_every_format_say_what_was_written(form: str, tmp_path: Path) -> None:
    recording = open_recording(write_bag(tmp_path / "drive", form, drive()))
    assert recording.topics == {
        "/tf_static": "tf2_msgs/msg/TFMessage",
        "/plan": "nav_msgs/msg/Path",
        "/tf": "tf2_msgs/msg/TFMessage",
        "/odom": ODOMETRY,
        "/scan": SCAN,
        "/cmd_vel": "geometry_msgs/msg/Twist",
    }
    read = list(recording.messages(["/odom", "/scan"]))
    assert [message.topic for message in read] == ["/odom", "/scan"] * 110
    third = read[2 * 30 + 1]
    assert third.time_s - BEGAN_S == pytest.approx(3.012, abs=1e-6)
    assert messages.stamp_s(third.message) - BEGAN_S == pytest.approx(3.01, abs=1e-6)
    # At 3.01 s the scanner is 1 + 0.4 * 3.01 - 0.1 m from the wall behind, which it looks at.
    assert third.message.ranges[180] == pytest.approx(2.104, abs=1e-6)
    assert messages.velocity_of_odometry(read[0].message) == (0.4, 0.0)
    assert list(recording.messages([])) == []


def test_a_carmen_log_is_read_as_it_is_written(tmp_path: Path) -> None:
    path = tmp_path / "some.log"
    readings = " ".join(["1.5", "2.5", "81.91"])
    path.write_text(
        "# a comment\n"
        "PARAM robot_front_laser_max 50.0\n"
        "PARAM robot_frontlaser_offset 0.12\n"
        "ODOM 1.0 2.0 0.5 0.3 -0.1 0.0 100.25 host 0.25\n"
        f"FLASER 3 {readings} 9.0 9.0 9.0 1.1 2.2 0.6 100.5 host 0.5\n"
        "NMEA something else\n"
    )
    recording = open_recording(path)
    assert isinstance(recording, CarmenLog)
    assert recording.mount == Mount(0.12)
    odom, scan = recording.messages(["/odom", "/scan"])
    assert (odom.time_s, messages.stamp_s(odom.message)) == (100.25, 100.25)
    assert messages.pose_of_odometry(odom.message) == pytest.approx((1.0, 2.0, 0.5))
    assert messages.velocity_of_odometry(odom.message) == (0.3, -0.1)
    found = messages.scan_of(scan.message, recording.mount)
    assert (found.angle_min, found.angle_increment, found.range_max) == (-math.pi / 2, math.pi / 2, 50.0)
    assert np.asarray(found.ranges).tolist() == [1.5, 2.5, 81.91]
    assert scan.time_s == 100.5


@pytest.mark.parametrize(("rays", "last_deg"), [(180, 89.0), (181, 90.0), (360, 89.5), (361, 90.0)])
def test_half_a_turn_of_as_many_readings_as_scanners_have(rays: int, last_deg: float, tmp_path: Path) -> None:
    path = tmp_path / "some.log"
    path.write_text(f"FLASER {rays} {'1.0 ' * rays}0 0 0 0 0 0 100.5 host 0.5\n")
    (scan,) = open_recording(path).messages(["/scan"])
    assert math.degrees(scan.message.angle_max) == pytest.approx(last_deg)


def test_without_odom_lines_velocities_are_differences_of_the_poses_behind_the_scans(tmp_path: Path) -> None:
    path = tmp_path / "some.log"
    poses = [(0.0, 0.0, 3.1, 10.0), (-0.1, 0.0, 3.1, 10.25), (-0.1, 0.0, -3.1, 10.5)]
    path.write_text("".join(f"FLASER 2 1 1 0 0 0 {x} {y} {yaw} {at} host 0\n" for x, y, yaw, at in poses))
    velocities = [messages.velocity_of_odometry(found.message) for found in open_recording(path).messages(["/odom"])]
    assert velocities[0] == (0.0, 0.0)
    assert velocities[1] == pytest.approx((0.4 * math.cos(math.pi - 3.1), 0.0), abs=1e-9)
    assert velocities[2] == pytest.approx((0.0, (2 * math.pi - 6.2) / 0.25), abs=1e-9)


def test_velocities_of_fast_scans_are_differences_over_20_ms_and_more(tmp_path: Path) -> None:
    path = tmp_path / "some.log"
    lines = [f"FLASER 2 1 1 0 0 0 {0.5 * at:.9f} 0 0 {10.0 + at:.9f} host 0\n" for at in np.arange(30) / 75.0]
    path.write_text("".join(lines))
    found = [messages.velocity_of_odometry(found.message)[0] for found in open_recording(path).messages(["/odom"])]
    assert found[:2] == [0.0, 0.0]
    assert found[2:] == pytest.approx([0.5] * 28, abs=1e-6)


def test_a_robotlaser_says_its_own_angles_reach_and_velocities(tmp_path: Path) -> None:
    path = tmp_path / "some.log"
    path.write_text(
        "ROBOTLASER1 0 -1.0 2.0 0.5 30.0 0.01 0 5 1 2 3 4 5 1 9 1.0 2.0 0.5 1.0 2.0 0.5 0.25 -0.125 0 0 0 100.5 h 0\n"
    )
    odom, scan = open_recording(path).messages(["/odom", "/scan"])
    assert (scan.message.angle_min, scan.message.angle_increment, scan.message.range_max) == (-1.0, 0.5, 30.0)
    assert scan.message.ranges == [1.0, 2.0, 3.0, 4.0, 5.0]
    assert scan.time_s == 100.5
    assert messages.pose_of_odometry(odom.message) == pytest.approx((1.0, 2.0, 0.5))
    assert messages.velocity_of_odometry(odom.message) == (0.25, -0.125)


@pytest.mark.parametrize(
    ("laser", "mount"),
    [
        ("1.0 2.2 1.6", Mount(x_m=0.2, yaw_rad=1.6 - math.pi / 2)),
        (f"0.9 2.0 {math.pi / 2}", Mount(y_m=0.1)),
        (f"1.0 2.0 {math.pi / 2}", Mount(x_m=0.15)),  # no mount of its own: what the parameters say
        (f"7.0 2.0 {math.pi / 2}", Mount(x_m=0.15)),  # poses in two frames
    ],
)
def test_a_robotlaser_says_where_its_scanner_sits(laser: str, mount: Mount, tmp_path: Path) -> None:
    path = tmp_path / "some.log"
    path.write_text(
        "PARAM robot_frontlaser_offset 0.15\n"
        f"ROBOTLASER1 0 -1.0 2.0 0.5 30.0 0.01 0 2 1 2 0 {laser} 1.0 2.0 {math.pi / 2} 0 0 0 0 0 100.5 host 0.5\n"
    )
    found = open_recording(path).mount
    assert found is not None
    assert (found.x_m, found.y_m, found.yaw_rad) == pytest.approx((mount.x_m, mount.y_m, mount.yaw_rad))


@pytest.mark.parametrize(
    ("line", "told"),
    [
        ("FLASER 3 1.0 2.0", r"line 2 of .* is no FLASER of CARMEN \(it says 3 readings"),
        ("FLASER 1 1.0 0 0 0 0 0 0 5.0 host 0", r"line 2 of .* \(1 readings make no half turn"),
        ("FLASER some 1.0", r"line 2 of .* is no FLASER of CARMEN \(invalid literal"),
        ("ODOM 1.0 2.0 0.5", r"line 2 of .* is no ODOM of CARMEN"),
        ("PARAM robot_front_laser_max far", "line 2 of .*: robot_front_laser_max far cannot be"),
        ("PARAM robot_front_laser_max 0", "line 2 of .*: robot_front_laser_max 0 cannot be .*above 0 m"),
        ("PARAM robot_frontlaser_offset 150", "line 2 of .*: robot_frontlaser_offset 150 cannot be .*give metres"),
    ],
)
def test_a_line_that_cannot_be_read_is_named(line: str, told: str, tmp_path: Path) -> None:
    path = tmp_path / "some.log"
    path.write_text(f"# first\n{line}\nFLASER 1 1.0 0 0 0 0 0 0 5.0 host 0\n")
    with pytest.raises(UserInputError, match=told):
        list(open_recording(path).messages(["/scan", "/odom"]))


def test_what_is_no_recording_is_refused(tmp_path: Path) -> None:
    for name, content in (("notes.txt", b"FLASERS are nice\n"), ("empty", b""), ("picture.png", bytes(range(256)))):
        (tmp_path / name).write_bytes(content)
        with pytest.raises(UserInputError, match="is of no kind that is known: give a ROS bag"):
            open_recording(tmp_path / name)
    for name in ("broken.bag", "broken.mcap", "broken.db3"):
        (tmp_path / name).write_bytes(b"nothing of the kind")
        with pytest.raises(UserInputError, match=r"cannot be read .*: give a whole bag"):
            open_recording(tmp_path / name)
    with pytest.raises(UserInputError, match="does not exist"):
        open_recording(tmp_path / "nothing.bag")
    with pytest.raises(UserInputError, match=r"is a folder without metadata\.yaml"):
        open_recording(tmp_path)
    with pytest.raises(UserInputError, match="cannot be a file"):
        open_recording(tmp_path / ("x" * 300))


def test_a_bag_that_breaks_off_is_told(tmp_path: Path) -> None:
    path = write_bag(tmp_path / "drive", "mcap", drive())
    path.write_bytes(path.read_bytes()[:-4000])
    with pytest.raises(UserInputError, match=r"cannot be read .*: give a whole bag"):
        list(open_recording(path).messages(["/scan"]))


def renamed(messages: Iterable[Message], **names: str) -> Iterable[Message]:
    for time_s, topic, kind, values in messages:
        yield time_s, names.get(topic.removeprefix("/"), topic), kind, values


def test_topics_are_found_by_type_and_named_where_there_are_several(tmp_path: Path) -> None:
    recording = open_recording(write_bag(tmp_path / "a", "mcap", renamed(drive(), scan="/front/scan")))
    assert needed_topic(recording, "scan", SCAN, None) == "/front/scan"
    assert needed_topic(recording, "scan", SCAN, "front/scan") == "/front/scan"
    assert topic_of(recording, "command", COMMANDS, None) == "/cmd_vel"
    with pytest.raises(UserInputError, match=r"scan=/rear is no topic of .*LaserScan: there are /front/scan"):
        needed_topic(recording, "scan", SCAN, "/rear")
    assert topic_of(recording, "goal", ("geometry_msgs/msg/PoseStamped",), None) is None

    others = [(0.5, "/wheels", ODOMETRY, odometry(0.5)), (0.6, "/visual", ODOMETRY, odometry(0.6))]
    both = open_recording(write_bag(tmp_path / "b", "mcap", iter([*drive(), *others])))
    assert needed_topic(both, "odom", ODOMETRY, None) == "/odom"
    unclear = open_recording(write_bag(tmp_path / "c", "mcap", iter(others)))
    with pytest.raises(UserInputError, match="has 2 topics with nav_msgs/msg/Odometry: name one, odom=<one of /wheels"):
        needed_topic(unclear, "odom", ODOMETRY, None)
    with pytest.raises(UserInputError, match=r"no topic with sensor_msgs/msg/LaserScan: there are /wheels \(nav_msgs"):
        needed_topic(unclear, "scan", SCAN, None)


def test_a_carmen_log_without_scans_has_no_such_topic(tmp_path: Path) -> None:
    path = tmp_path / "some.log"
    path.write_text("ODOM 1.0 2.0 0.5 0.3 -0.1 0.0 100.25 host 0.25\n")
    with pytest.raises(UserInputError, match=r"has no topic with .*LaserScan: there are /odom \(nav_msgs"):
        needed_topic(open_recording(path), "scan", SCAN, None)
    assert needed_topic(open_recording(write_carmen(tmp_path / "whole.log")), "scan", SCAN, None) == "/scan"
