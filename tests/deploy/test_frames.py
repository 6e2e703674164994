"""Frames: transforms worked out by hand, the buffer of them, and a driver whose plan, sensors and odometry differ."""

import math
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from test_robot_driver import Recorder, cloud, header, laser, odometry, path

from rcdsac_trl.deploy import CameraPose, Mount, Policy, scan_sectors
from rcdsac_trl.deploy.frames.rigid_transform import RigidTransform
from rcdsac_trl.deploy.frames.robot_frames import FrameSettings, RobotFrames
from rcdsac_trl.deploy.frames.sensor_mounts import mount_of, transform_of_mount
from rcdsac_trl.deploy.frames.transform_buffer import ALWAYS_S, TransformBuffer, TransformError
from rcdsac_trl.deploy.policy.driver import Driver
from rcdsac_trl.errors import UserInputError
from robots import agent

QUARTER = math.sqrt(0.5)
planar = RigidTransform.planar


def near(transform: RigidTransform, x: float, y: float, yaw: float) -> bool:
    found = transform.pose
    return math.dist(found[:2], (x, y)) < 1e-9 and abs(math.remainder(found[2] - yaw, 2.0 * math.pi)) < 1e-9


# ------------------------------------------------------------------------------------------------ transforms
def test_transforms_do_what_they_do_on_paper() -> None:
    assert near(planar(1.0, 2.0, math.pi / 2) @ planar(3.0, 0.0, 0.1), 1.0, 5.0, math.pi / 2 + 0.1)
    assert near(planar(1.0, 2.0, math.pi / 2).inverse(), -2.0, 1.0, -math.pi / 2)
    # A quarter turn about y takes x to -z, and about x takes y to z.
    pitched, rolled = (
        RigidTransform(rotation=(0, QUARTER, 0, QUARTER)),
        RigidTransform(rotation=(QUARTER, 0, 0, QUARTER)),
    )
    assert pitched.matrix @ (1, 0, 0) == pytest.approx([0, 0, -1])
    assert rolled.matrix @ (0, 1, 0) == pytest.approx([0, 0, 1])
    assert (pitched @ rolled).matrix == pytest.approx(pitched.matrix @ rolled.matrix)


def test_between_two_is_a_straight_line_and_the_shorter_turn() -> None:
    assert near(planar(0, 0, 3.0).toward(planar(4, 0, -3.0), 0.25), 1.0, 0.0, 3.0 + (math.pi - 3.0) / 2)
    assert near(planar(0, 0, 0.0).toward(planar(0, 2, 0.9), 1 / 3), 0.0, 2 / 3, 0.3)
    assert near(planar(0, 0, 1.0).toward(planar(1, 0, 1.0), 0.5), 0.5, 0.0, 1.0)


@given(*[st.floats(-3.0, 3.0) for _ in range(6)])
def test_there_and_back_is_nowhere(x: float, y: float, yaw: float, a: float, b: float, turn: float) -> None:
    first, second = planar(x, y, yaw), planar(a, b, turn)
    assert near(first.inverse() @ first, 0.0, 0.0, 0.0)
    assert near((first @ second) @ second.inverse(), x, y, yaw)


@pytest.mark.parametrize("turn", [(0.0, 0.0, 0.0, 0.0), (0.0, 0.0, 1.0, 1.0), (math.nan, 0.0, 0.0, 1.0)])
def test_what_is_no_rotation_is_refused(turn: tuple[float, float, float, float]) -> None:
    with pytest.raises(UserInputError, match="its length must be 1"):
        RigidTransform(rotation=turn)


def test_mounts_there_and_back() -> None:
    for mount in (Mount(0.1, -0.2, 2.0), Mount(0.0, 0.3, -1.0, upside_down=True)):
        found = mount_of(transform_of_mount(mount))
        assert (found.x_m, found.y_m, found.yaw_rad) == pytest.approx((mount.x_m, mount.y_m, mount.yaw_rad))
        assert found.upside_down == mount.upside_down
    with pytest.raises(UserInputError, match="the scanner is tilted by 90 degrees"):
        mount_of(RigidTransform(rotation=(0.0, QUARTER, 0.0, QUARTER)))


# ------------------------------------------------------------------------------------------------ the buffer
def tree() -> TransformBuffer:
    """Make map -> odom -> base_link, which move, and base_link -> laser, which does not."""
    buffer = TransformBuffer(history_s=5.0)
    buffer.set("/map", "odom", 10.0, planar(1.0, 0.0, 0.0))
    buffer.set("map", "odom", 12.0, planar(3.0, 0.0, 0.0))
    for step in range(3):
        buffer.set("odom", "base_link", 10.0 + step, planar(0.0, float(step), 0.0))
    buffer.set("base_link", "laser", 0.0, planar(0.5, 0.0, math.pi), static=True)
    return buffer


def test_it_interpolates_each_link_at_the_stamp_and_goes_up_and_down_the_tree() -> None:
    buffer = tree()
    assert near(buffer.lookup("map", "laser", 11.5), 2.5 + 0.5, 1.5, math.pi)
    assert near(buffer.lookup("laser", "map", 11.5), 3.0, 1.5, math.pi)  # seen backwards: -(-3), -(-1.5)
    assert near(buffer.lookup("base_link", "laser", -1e9), 0.5, 0.0, math.pi)  # static: for ever, and before
    assert near(buffer.lookup("odom", "odom", 0.0), 0.0, 0.0, 0.0)
    buffer.set("base_link", "camera", 0.0, planar(0.0, 0.25, 0.0), static=True)
    assert near(buffer.lookup("laser", "camera", 0.0), 0.5, -0.25, math.pi)  # by what both hang below
    assert buffer.frames == ["base_link", "camera", "laser", "map", "odom"]


def test_the_newest_counts_whatever_the_stamps_and_the_oldest_of_the_way_is_named() -> None:
    buffer = tree()
    buffer.set("odom", "base_link", 14.5, planar(0.0, 7.0, 0.0))
    transform, stamp_s = buffer.latest("map", "laser")
    assert near(transform, 3.5, 7.0, math.pi)
    assert stamp_s == 12.0
    assert buffer.oldest_link("map", "laser") == "map -> odom"
    assert buffer.latest("base_link", "laser")[1] == ALWAYS_S


def test_a_bounded_history_and_stamps_that_come_late_or_twice() -> None:
    buffer = tree()
    buffer.set("odom", "base_link", 11.5, planar(0.0, 9.0, 0.0))  # late
    assert near(buffer.lookup("odom", "base_link", 11.25), 0.0, 5.0, 0.0)
    buffer.set("odom", "base_link", 11.5, planar(0.0, 1.0, 0.0))  # again
    assert near(buffer.lookup("odom", "base_link", 11.25), 0.0, 1.0, 0.0)
    buffer.set("odom", "base_link", 16.5, planar(0.0, 0.0, 0.0))
    assert near(buffer.lookup("odom", "base_link", 11.5), 0.0, 1.0, 0.0)
    with pytest.raises(TransformError, match=r"odom -> base_link is known from 0.30 s later on"):
        buffer.lookup("odom", "base_link", 11.2)
    buffer.set("odom", "base_link", 3.0, planar(5.0, 0.0, 0.0))  # the simulation was started again
    assert near(buffer.latest("odom", "base_link")[0], 5.0, 0.0, 0.0)


def test_what_is_missing_or_old_is_named() -> None:
    buffer = tree()
    with pytest.raises(TransformError, match="no transform names frame 'utm': there are base_link, laser, map, odom"):
        buffer.lookup("utm", "laser", 11.0)
    buffer.set("world", "arm", 10.0, planar(0.0, 0.0, 0.0))
    with pytest.raises(TransformError, match=r"'arm' and 'laser': the one hangs below 'world', the other .*'map'"):
        buffer.lookup("arm", "laser", 11.0)
    with pytest.raises(TransformError, match=r"the newest transform odom -> base_link is 0.50 s older"):
        buffer.lookup("odom", "laser", 12.5)
    assert near(buffer.lookup("odom", "base_link", 12.5, hold_s=0.5), 0.0, 2.0, 0.0)
    assert near(buffer.lookup("odom", "base_link", 9.5, hold_s=0.5), 0.0, 0.0, 0.0)
    buffer.set("laser", "map", 11.0, planar(0.0, 0.0, 0.0))
    with pytest.raises(TransformError, match="form a loop"):
        buffer.lookup("map", "world", 11.0)
    for parent, child, stamp_s in (("", "a", 0.0), ("a", "/a", 0.0), ("a", "b", math.nan)):
        with pytest.raises(UserInputError, match=r"name two frames|is not finite"):
            buffer.set(parent, child, stamp_s, planar(0.0, 0.0, 0.0))


def test_a_frame_that_is_told_another_parent_hangs_there_from_then_on() -> None:
    buffer = tree()
    buffer.set("map", "base_link", 12.0, planar(8.0, 0.0, 0.0))
    assert near(buffer.latest("map", "laser")[0], 8.5, 0.0, math.pi)
    assert not buffer.connects("utm", "laser")
    assert buffer.hangs_below("laser", "base_link")
    assert not buffer.hangs_below("odom", "base_link")


# ------------------------------------------------------------------------------------------------ the driver
def tf(now_s: float, parent: str, child: str, transform: RigidTransform) -> SimpleNamespace:
    place, turn = ("x", "y", "z"), ("x", "y", "z", "w")
    values = SimpleNamespace(
        translation=SimpleNamespace(**dict(zip(place, transform.translation_m, strict=True))),
        rotation=SimpleNamespace(**dict(zip(turn, transform.rotation, strict=True))),
    )
    return SimpleNamespace(
        transforms=[SimpleNamespace(header=header(now_s, parent), child_frame_id=child, transform=values)]
    )


def pose_message(now_s: float, frame: str, x: float, y: float, yaw: float) -> SimpleNamespace:
    message = odometry(now_s, x, y, yaw, frame)
    return SimpleNamespace(header=message.header, pose=message.pose)


class Listener(Recorder):
    """Keeps all that it is given."""

    given: dict[str, Any]

    def act(self, ranges: Any, waypoints: Any, velocity: Any, beta: float | None, *, stamps: Any, pose: Any) -> Any:
        self.given = {"ranges": ranges, "velocity": velocity, "stamps": stamps, "pose": pose}
        return super().act(ranges, waypoints, velocity, beta, stamps=stamps, pose=pose)


def driver(**options: Any) -> tuple[Driver, Listener]:
    policy = Listener()
    return Driver(policy, **options), policy  # type: ignore[arg-type]


def test_a_plan_in_map_is_brought_to_the_robot_by_the_newest_correction() -> None:
    found, policy = driver(mount=Mount())
    found.on_path(path([(0.0, 0.0), (9.0, 0.0)], "map"))
    found.on_odometry(odometry(10.0, 1.0, 0.0))
    found.on_scan(laser(10.0))
    assert found.command(10.0).reason == (
        "the path is in frame 'map', odometry in 'odom': no transform names frame 'map': there are none; start the "
        "localisation, or send both in one frame"
    )
    # odom lies at (1, 0) in map, turned left: the robot is at (1, 1), and looks along y.
    found.on_transforms(tf(9.8, "map", "odom", planar(1.0, 0.0, math.pi / 2)))
    assert found.command(10.0).reason is None
    assert policy.waypoints == pytest.approx(np.array([(-1.0, -8.0), (-1.0, -8.0)]))
    assert policy.given["velocity"] == (0.1, 0.0)
    assert policy.given["pose"] == pytest.approx((1.0, 1.0, math.pi / 2))
    assert found.situation is not None
    assert found.situation.pose == pytest.approx((1.0, 1.0, math.pi / 2))


def test_a_jump_of_the_localisation_moves_the_robot_on_its_plan_and_is_no_velocity() -> None:
    found, policy = driver(mount=Mount())
    found.on_path(path([(0.0, 0.0), (9.0, 0.0)], "map"))
    for step, x_m in enumerate((0.0, 0.0, 2.5, -0.5)):
        now = 10.0 + 0.14 * step
        found.on_transforms(tf(now, "map", "odom", planar(x_m, 0.3 * step, 0.0)))
        found.on_odometry(odometry(now, 0.014 * step, 0.0))
        found.on_scan(laser(now - 0.07))
        assert found.command(now).reason is None
        assert policy.waypoints[0] == pytest.approx([9.0 - x_m - 0.014 * step, -0.3 * step])
        assert policy.given["velocity"] == (0.1, 0.0)
        # Half a period ago the scanner was 7 mm behind: the jump is not in it.
        assert policy.given["ranges"].mount.x_m == pytest.approx(-0.007 if step else 0.0, abs=1e-9)
        assert policy.given["ranges"].mount.y_m == 0.0


def test_it_stands_while_the_localisation_is_lost_and_says_since_when() -> None:
    found, _ = driver(mount=Mount(), frames=FrameSettings(localisation_timeout_s=0.5))
    found.on_path(path([(0.0, 0.0), (9.0, 0.0)], "map"))

    def reason(now: float) -> str | None:
        found.on_odometry(odometry(now, 0.0, 0.0))
        found.on_scan(laser(now))
        return found.command(now).reason

    found.on_transforms(tf(10.0, "map", "odom", planar(0.0, 0.0, 0.0)))
    assert reason(10.5) is None
    assert reason(10.7) == (
        "the localisation is lost: the transform map -> odom is 0.70 s old, more than localisation_timeout_s=0.5"
    )
    found.on_transforms(tf(12.0, "map", "odom", planar(0.0, 0.0, 0.0)))  # stamped ahead, as AMCL does
    assert reason(11.0) is None
    assert "lost" in str(reason(12.6))
    found.on_transforms(tf(13.0, "map", "odom", planar(0.0, 0.0, 0.0)))
    assert reason(12.7) is None
    found.on_transforms(tf(1e6, "map", "odom", planar(0.0, 0.0, 0.0)))
    assert "in the future: are both in seconds, of one clock" in str(reason(12.8))
    found.on_transforms(tf(0.0, "map", "odom", planar(0.0, 0.0, 0.0)), static=True)
    assert reason(99.0) is None


def test_where_tf_knows_the_odometry_it_counts_and_says_where_the_scanner_sits() -> None:
    found, policy = driver()
    found.on_path(path([(0.0, 0.0), (9.0, 0.0)], "odom"))
    found.on_odometry(odometry(10.0, 0.0, 0.0))
    found.on_scan(laser(10.0))
    assert found.command(10.0).reason is None  # nobody publishes transforms: the scanner sits at the centre
    assert policy.given["ranges"].mount == Mount()
    found.on_transforms(tf(9.9, "odom", "base_link", planar(2.0, 0.0, 0.0)))
    assert found.command(10.0).reason == (
        "nobody says where the sensor in frame 'laser' sits: no transform names frame 'laser': there are base_link, "
        "odom"
    )
    hanging = planar(0.2, 0.0, 1.0) @ RigidTransform(rotation=(1.0, 0.0, 0.0, 0.0))
    found.on_transforms(tf(0.0, "base_link", "laser", hanging), static=True)
    assert found.command(10.0).reason is None
    mount = policy.given["ranges"].mount
    assert (mount.x_m, mount.y_m, mount.yaw_rad, mount.upside_down) == pytest.approx((0.2, 0.0, 1.0, True))
    assert policy.waypoints[0] == pytest.approx([7.0, 0.0])
    assert policy.given["stamps"].waypoints_s == 9.9
    found.on_transforms(tf(10.2, "odom", "base_link", planar(2.3, 0.0, 0.0)))  # a filter that looks ahead
    assert found.command(10.05).reason is None
    assert policy.given["stamps"].waypoints_s == 10.05
    assert policy.waypoints[0] == pytest.approx([6.85, 0.0])
    assert found.command(10.6).reason == "the transform odom -> base_link is 0.40 s old, more than 0.35 s"


def test_a_scan_is_taken_from_where_the_robot_was_when_it_was_made() -> None:
    """A turn of 9 degrees between scan and odometry: what was straight ahead is to the right by as much."""
    ranges = [5.0] * 360
    ranges[180] = 1.0  # straight ahead
    found, policy = driver(mount=Mount())
    found.on_path(path([(9.0, 0.0)]))
    for now, yaw in ((10.0, 0.0), (10.1, math.radians(9.0))):
        found.on_odometry(odometry(now, 0.0, 0.0, yaw))
        found.on_scan(laser(10.0, ranges))
        assert found.command(now).reason is None
    sectors = scan_sectors(policy.given["ranges"])
    assert int(sectors.distances_m.argmin()) == 175  # [-10, -8) degrees
    found.on_odometry(odometry(10.2, 3.0, 0.0))
    assert "the odometry moved by 3.0 m between a scan and now (0.20 s): it has jumped" in str(
        found.command(10.2).reason
    )


def swept(now_s: float, ranges: list[float], time_increment: float) -> SimpleNamespace:
    """Scan from -180 degrees to the left, a ray a degree."""
    message = laser(now_s, ranges)
    message.time_increment = time_increment
    return message


def nearest_of(scan: Any) -> tuple[int, float]:
    """Return the one sector of a scan in which something is, and how far."""
    found = scan_sectors(scan)
    (sector,) = np.flatnonzero(np.isfinite(found.distances_m))
    return int(sector), float(found.distances_m[sector])


def test_while_turning_every_ray_is_taken_from_the_heading_at_its_time() -> None:
    """5 Hz, 90 degrees/s to the left: ray 260 looks 80 degrees to the left, 0.144 s after the stamp, at 13 degrees.

    So what it sees is at 93 degrees, and 75 from the heading of 18 degrees that the robot has at the end.
    """
    ranges = [math.inf] * 360
    ranges[260] = 1.0
    for time_increment, sector in ((0.2 / 360, 37), (0.0, 31)):  # else at 80 degrees, and 62 at the end
        found, policy = driver(mount=Mount())
        found.on_path(path([(9.0, 0.0)]))
        for step in range(11):
            now = 10.0 + 0.02 * step
            found.on_odometry(odometry(now, 0.0, 0.0, math.radians(90.0 * 0.02 * step)))
            found.on_scan(swept(10.0, ranges, time_increment))
            assert found.command(now).reason is None
        assert nearest_of(policy.given["ranges"]) == (sector, pytest.approx(1.0))


def test_while_driving_every_ray_is_taken_from_the_place_at_its_time() -> None:
    """0.5 m/s: ray 180 looks ahead 0.1 s after the stamp, when the robot has done 5 cm of the 10 that it does."""
    ranges = [math.inf] * 360
    ranges[180] = 1.0
    for time_increment, distance_m in ((0.2 / 360, 0.95), (0.0, 0.9)):
        found, policy = driver(mount=Mount())
        found.on_path(path([(9.0, 0.0)]))
        for now, x_m in ((10.0, 0.0), (10.2, 0.1)):
            found.on_odometry(odometry(now, x_m, 0.0))
            found.on_scan(swept(10.0, ranges, time_increment))
            assert found.command(now).reason is None
        assert nearest_of(policy.given["ranges"]) == (0, pytest.approx(distance_m))


def test_rays_that_are_newer_than_odometry_are_taken_from_where_the_robot_was_last_seen() -> None:
    """Odometry ends in the middle of the sweep: at its end the robot still counts as there, 5 cm on."""
    ranges = [math.inf] * 360
    found, policy = driver(mount=Mount())
    found.on_path(path([(9.0, 0.0)]))
    for now, x_m in ((10.0, 0.0), (10.1, 0.05)):
        found.on_odometry(odometry(now, x_m, 0.0))
        found.on_scan(swept(10.0, ranges, 0.2 / 360))
        assert found.command(now).reason is None
    scan = policy.given["ranges"]
    assert (scan.mount.x_m, scan.end_mount.x_m) == pytest.approx((-0.05, 0.0))


@pytest.mark.parametrize("time_increment", [0.0, -0.001, math.nan, math.inf, 1.01 / 359])
def test_a_time_increment_that_says_nothing_is_as_good_as_none(time_increment: float) -> None:
    found, policy = driver(mount=Mount(0.1, 0.0, 0.3))
    found.on_path(path([(9.0, 0.0)]))
    for now, x_m in ((10.0, 0.0), (10.2, 0.1)):
        found.on_odometry(odometry(now, x_m, 0.0, 0.5))
        found.on_scan(laser(10.0))  # without that field
        found.command(now)
    plain = policy.given["ranges"]
    found.on_scan(swept(10.0, [2.0] * 360, time_increment))
    assert found.command(10.2).reason is None
    np.testing.assert_equal(vars(policy.given["ranges"]), vars(plain))
    assert plain.end_mount is None


def test_a_pose_topic_stands_in_for_tf_and_holds_on_while_odometry_goes_on() -> None:
    found, policy = driver(mount=Mount(), frames=FrameSettings(localisation="pose"))
    found.on_path(path([(0.0, 0.0), (9.0, 0.0)], "map"))
    for now, x_m in ((10.0, 1.0), (10.2, 2.0)):
        found.on_odometry(odometry(now, x_m, 0.0))
        found.on_scan(laser(now))
        reason = found.command(now).reason
        assert reason == "the path is in frame 'map', and no pose of the robot has come yet"
    found.on_pose(pose_message(10.1, "map", 4.5, 0.0, 0.0))  # odometry was at 1.5: odom begins at 3
    assert found.command(10.2).reason is None
    assert policy.waypoints[0] == pytest.approx([4.0, 0.0])
    found.on_odometry(odometry(10.4, 2.2, 0.0))
    found.on_scan(laser(10.4))
    assert found.command(10.4).reason is None
    assert policy.waypoints[0] == pytest.approx([3.8, 0.0])
    found.on_odometry(odometry(11.2, 2.2, 0.0))
    found.on_scan(laser(11.2))
    assert "the localisation is lost: the transform map -> odom is 1.10 s old" in str(found.command(11.2).reason)
    found.on_pose(SimpleNamespace(header=header(11.2, "map")))
    assert "the robot's pose cannot be read (AttributeError" in str(found.command(11.2).reason)


def test_clouds_are_taken_from_where_tf_says_their_cameras_are() -> None:
    by_hand, by_tf = (
        driver(cameras={"cam_optical": camera})[0]
        for camera in (CameraPose((0.2, 0.1, 0.3), view_rad=1.6, optical=True), 1.6)
    )
    frame = RigidTransform((0.2, 0.1, 0.3), (-0.5, 0.5, -0.5, 0.5))  # z ahead, x right, y down
    by_tf.on_transforms(tf(0.0, "base_link", "cam_optical", frame), static=True)
    for found in (by_hand, by_tf):
        found.on_path(path([(9.0, 0.0)]))
        found.on_odometry(odometry(10.0, 0.0, 0.0))
        message = cloud(10.0, "cam_optical")
        points = np.frombuffer(message.data, "<f4").reshape(-1, 3)
        message.data = np.ascontiguousarray(points[:, [1, 2, 0]]).tobytes()  # what was ahead is z
        found.on_cloud(message)
        assert found.command(10.0).reason is None
    assert by_hand.situation is not None
    assert by_tf.situation is not None
    distances_m = by_tf.situation.ranges.distances_m  # type: ignore[union-attr]
    np.testing.assert_allclose(distances_m, by_hand.situation.ranges.distances_m)  # type: ignore[union-attr]
    assert distances_m[0] == pytest.approx(1.7, abs=0.01)
    np.testing.assert_array_equal(by_tf.situation.ranges.covered, by_hand.situation.ranges.covered)  # type: ignore[union-attr]
    assert by_tf.situation.ranges.covered[0]  # type: ignore[union-attr]


@pytest.mark.parametrize("frame", ["base_link", "laser"])
def test_a_plan_that_moves_with_the_robot_is_refused(frame: str) -> None:
    found, _ = driver()
    found.on_transforms(tf(0.0, "base_link", "laser", planar(0.0, 0.0, 0.0)), static=True)
    found.on_path(path([(9.0, 0.0)], frame))
    found.on_odometry(odometry(10.0, 0.0, 0.0))
    found.on_scan(laser(10.0))
    assert "which moves with the robot: plan in one that stands still" in str(found.command(10.0).reason)


def test_odometry_whose_clock_is_set_back_is_the_newest_all_the_same() -> None:
    found, policy = driver(mount=Mount())
    found.on_path(path([(9.0, 0.0)]))
    for now, x_m in ((10.0, 1.0), (5.0, 2.0)):
        found.on_odometry(odometry(now, x_m, 0.0))
        found.on_scan(laser(now))
        found.command(now)
    assert policy.waypoints[0] == pytest.approx([7.0, 0.0])


@pytest.mark.parametrize("back_s", [2.0, 500.0])
def test_a_pose_of_before_the_clock_was_set_back_counts_no_more(back_s: float) -> None:
    frames = RobotFrames(FrameSettings(localisation="pose"))
    frames.moved("odom", "base_link", 1000.0, (1.0, 0.0, 0.0))
    frames.localised("map", 1000.0, (5.0, 0.0, 0.0))
    assert frames.robot_in("map", 1000.0)[0] == (5.0, 0.0, 0.0)
    now_s = 1000.0 - back_s
    frames.moved("odom", "base_link", now_s, (1.0, 0.0, 0.0))
    with pytest.raises(TransformError, match="no pose of the robot has come yet"):
        frames.robot_in("map", now_s)
    frames.localised("map", now_s, (50.0, 0.0, 0.0))
    assert frames.robot_in("map", now_s)[0] == (50.0, 0.0, 0.0)


@pytest.mark.parametrize("back_s", [0.001, 0.9])
def test_an_odometry_that_is_late_costs_no_pose(back_s: float) -> None:
    """A localisation that speaks only while the robot moves would not say it again."""
    frames = RobotFrames(FrameSettings(localisation="pose", localisation_timeout_s=math.inf))
    frames.moved("odom", "base_link", 10.0, (1.0, 0.0, 0.0))
    frames.localised("map", 10.0, (5.0, 0.0, 0.0))
    assert frames.robot_in("map", 10.0) == ((5.0, 0.0, 0.0), 10.0)
    frames.moved("odom", "base_link", 10.0 - back_s, (0.9, 0.0, 0.0))
    assert frames.robot_in("map", 10.0) == ((5.0, 0.0, 0.0), 10.0)  # the newest stamp counts, not what came last
    frames.moved("odom", "base_link", 10.02, (1.1, 0.0, 0.0))
    assert frames.robot_in("map", 10.02)[0] == pytest.approx((5.1, 0.0, 0.0))


def test_broken_transforms_are_left_out_and_told_where_they_are_missed() -> None:
    found = Driver(Policy(agent()), mount=Mount())
    found.on_path(path([(9.0, 0.0)]))
    found.on_odometry(odometry(10.0, 0.0, 0.0))
    found.on_scan(laser(10.0))
    broken = tf(10.0, "map", "odom", planar(0.0, 0.0, 0.0))
    broken.transforms[0].transform.rotation.w = 0.0
    broken.transforms += tf(10.0, "world", "map", planar(0.0, 0.0, 0.0)).transforms
    found.on_transforms(broken)
    assert found.command(10.0).reason is None
    found.on_path(path([(9.0, 0.0)], "world"))
    reason = str(found.command(10.0).reason)
    assert "no transform names frame 'odom': there are map, world" in reason
    assert "left out what cannot be read (rotation (0.0, 0.0, 0.0, 0.0)" in reason
    found.on_transforms(None)
    assert "left out what cannot be read (AttributeError" in str(found.command(10.0).reason)
    found.on_transforms(tf(10.0, "map", "odom", planar(0.0, 0.0, 0.0)))
    assert "lost" not in str(found.command(10.0).reason)
    assert found.situation is not None


@pytest.mark.parametrize(
    ("settings", "told"),
    [
        ({"localisation": "gps"}, "localisation='gps' is neither 'tf' nor 'pose'"),
        ({"localisation_timeout_s": 0.0}, "localisation_timeout_s=0.0 must be a positive number"),
        ({"localisation_timeout_s": math.nan}, "localisation_timeout_s=nan must be a positive number"),
    ],
)
def test_settings_that_cannot_be_are_refused(settings: dict[str, Any], told: str) -> None:
    with pytest.raises(UserInputError, match=told):
        FrameSettings(**settings)
