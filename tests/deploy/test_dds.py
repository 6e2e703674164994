"""Live over DDS in ROS 2's names and bytes: the types, the bridge on a clock of its own, and two processes."""

import io
import math
import os
import re
import signal
import subprocess
import sys
import time
import uuid
from collections.abc import Callable, Iterator
from dataclasses import fields
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from rcdsac_trl.deploy import Policy, Scan, dds_node
from rcdsac_trl.deploy.policy.driver import Driver
from rcdsac_trl.deploy.policy.weights import Weights, packed
from rcdsac_trl.errors import UserInputError
from robots import agent

pytest.importorskip("cyclonedds", reason="live over DDS needs cyclonedds: pip install 'rcdsac-trl[dds]'")
from cyclonedds.core import Policy as Rule
from cyclonedds.core import Qos
from cyclonedds.domain import DomainParticipant
from cyclonedds.internal import InvalidSample
from cyclonedds.pub import DataWriter
from cyclonedds.sub import DataReader
from cyclonedds.topic import Topic

from rcdsac_trl.deploy.ros import dds_types as ros
from rcdsac_trl.deploy.ros.dds_bridge import CLOUD, READS, UNSTAMPED, WRITES, DdsBridge

PERIOD_S = 0.14
# Its own domain and tag: whatever else speaks DDS on this machine or beside it is not met. No multicast, loopback only.
DOMAIN = 1 + os.getpid() % 100
URI = f"""<CycloneDDS><Domain><General><Interfaces><NetworkInterface address="127.0.0.1"/></Interfaces>
<AllowMulticast>false</AllowMulticast></General><Discovery><ParticipantIndex>auto</ParticipantIndex>
<Peers><Peer address="127.0.0.1"/></Peers><Tag>{uuid.uuid4().hex}</Tag></Discovery></Domain></CycloneDDS>"""


@pytest.fixture(autouse=True)
def loopback(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("CYCLONEDDS_URI", URI)
    monkeypatch.setenv("ROS_DOMAIN_ID", str(DOMAIN))


# ------------------------------------------------------------------------------------------------ names and bytes
def drawn(store: Any, kind: Any, detail: Any, rng: np.random.Generator) -> Any:
    """Draw a value of any type that a ROS definition may name."""
    if kind.name == "NAME":
        members = store.fielddefs[detail][1]
        return store.types[detail](**{name: drawn(store, *described, rng) for name, described in members})
    if kind.name == "BASE":
        if detail[0] == "string":
            return "grün"[: rng.integers(5)]
        return np.frombuffer(rng.bytes(8), detail[0])[0].item() if detail[0] != "bool" else bool(rng.integers(2))
    (inner, inner_detail), length = detail
    values = [drawn(store, inner, inner_detail, rng) for _ in range(length or rng.integers(4))]
    return np.array(values, inner_detail[0]) if inner.name == "BASE" else values


def same(theirs: Any, ours: Any) -> None:
    """Assert that two messages hold the same members, in the same order, with the same values."""
    if isinstance(theirs, list | np.ndarray):
        assert len(theirs) == len(ours)
        for one, other in zip(theirs, ours, strict=True):
            same(one, other)
    elif hasattr(theirs, "__msgtype__"):
        # What is in capitals is a constant of the definition.
        names = [part.name for part in fields(theirs) if part.name != "__msgtype__" and not part.name.isupper()]
        assert [part.name for part in fields(ours)] == names
        package, _, kind = theirs.__msgtype__.split("/")
        assert type(ours).__idl__.idl_transformed_typename == f"{package}::msg::dds_::{kind}_"
        for name in names:
            same(getattr(theirs, name), getattr(ours, name))
    else:
        np.testing.assert_equal(ours, theirs)


@pytest.mark.parametrize("kind", [*READS.values(), CLOUD, *WRITES.values(), UNSTAMPED], ids=lambda kind: kind.__name__)
@pytest.mark.parametrize("release", ["ROS2_FOXY", "ROS2_HUMBLE", "ROS2_JAZZY"])
def test_types_and_bytes_are_those_of_ros(kind: Any, release: str) -> None:
    typesys = pytest.importorskip("rosbags.typesys")
    from rosbags.interfaces import Nodetype

    store = typesys.get_typestore(typesys.Stores[release])
    name = re.sub(r"(\w+)::msg::dds_::(\w+)_", r"\1/msg/\2", kind.__idl__.idl_transformed_typename)
    rng = np.random.default_rng(8)
    for _ in range(20):
        theirs = drawn(store, Nodetype.NAME, name, rng)
        raw = bytes(store.serialize_cdr(theirs, name))
        ours = kind.deserialize(raw)
        same(theirs, ours)
        assert ours.serialize() == raw


# ------------------------------------------------------------------------------------------------ what a robot says
def header(now_s: float, frame: str) -> ros.Header:
    seconds, nanoseconds = divmod(round(now_s * 1e9), 1_000_000_000)
    return ros.Header(ros.Time(seconds, nanoseconds), frame)


def laser(now_s: float, half_width_m: float = 1.2) -> ros.LaserScan:
    """See a corridor, a ray a degree."""
    increment = 2 * math.pi / 360
    angles = -math.pi + increment * (np.arange(360) + 0.5)
    ranges = np.minimum(half_width_m / np.abs(np.sin(angles)), 20.0).tolist()
    return ros.LaserScan(
        header(now_s, "laser"), angles[0], math.pi, increment, range_min=0.1, range_max=10.0, ranges=ranges
    )


def odometry(now_s: float, x_m: float = 0.0) -> ros.Odometry:
    message = ros.Odometry(header(now_s, "odom"))
    message.pose.pose.position.x = x_m
    message.twist.twist.linear.x, message.twist.twist.angular.z = 0.3, -0.2
    return message


def plan(now_s: float, points: tuple[tuple[float, float], ...] = ((0.0, 0.0), (5.0, 2.0))) -> ros.Path:
    return ros.Path(header(now_s, "odom"), [ros.PoseStamped(pose=ros.Pose(ros.Point(x, y))) for x, y in points])


class Robot:
    """The other side, with the defaults of ROS's publishers and subscriptions: reliable, volatile."""

    def __init__(self, **remapped: str) -> None:
        participant = DomainParticipant(DOMAIN)
        rules = Qos(Rule.Reliability.Reliable(10**9), Rule.Durability.Volatile, Rule.History.KeepLast(1000))

        def topic(name: str, kind: Any) -> Topic:
            return Topic(participant, f"rt/{remapped.get(name, name)}", kind)

        kept = Qos(Rule.Reliability.Reliable(10**9), Rule.Durability.TransientLocal, Rule.History.KeepLast(1000))
        self._writers = {
            name: DataWriter(participant, topic(name, kind), kept if name == "tf_static" else rules)
            for name, kind in READS.items()
        }
        self._readers = {name: DataReader(participant, topic(name, kind), rules) for name, kind in WRITES.items()}

    def say(self, **messages: Any) -> None:
        for name, message in messages.items():
            self._writers[name].write(message)

    def withdraw(self, name: str, message: Any) -> None:
        self._writers[name].dispose(message)

    def hears(self, name: str) -> list[Any]:
        return [message for message in self._readers[name].take(1000) if isinstance(message, WRITES[name])]

    def commands(self) -> list[tuple[float, float]]:
        return [(twist.twist.linear.x, twist.twist.angular.z) for twist in self.hears("cmd_vel")]


# ------------------------------------------------------------------------------------------------ the bridge
def test_it_drives_as_the_driver_does_that_is_given_the_same() -> None:
    """Within a process DDS hands messages over as they are written, so the clock may be the test's."""
    robot, plain = Robot(plan="nav/path"), Driver(Policy(agent()))
    bridge = DdsBridge(Driver(Policy(agent())), DOMAIN, remapped={"plan": "/nav/path"})
    betas = {5: -2.0, 10: 0.0, 15: math.nan}
    robot.say(plan=plan(100.0))
    plain.on_path(plan(100.0))
    for step in range(30):
        now = 100.0 + PERIOD_S * step
        if not 20 <= step < 24:  # dropped scans
            robot.say(scan=laser(now - 0.1, 0.2), odom=odometry(now - 0.1))  # the older of two does not count
            robot.say(scan=laser(now), odom=odometry(now, 0.05 * step))
            plain.on_scan(laser(now))
            plain.on_odometry(odometry(now, 0.05 * step))
        if step in betas:
            robot.say(beta=ros.Float64(betas[step]))
            plain.beta = None if math.isnan(betas[step]) else betas[step]
        if step in (17, 18):
            robot.say(stop=ros.Bool(step == 17))
            (plain.policy.stop if step == 17 else plain.policy.resume)()
        expected, found = plain.command(now), bridge.step(now)
        assert (found.fresh, found.stopped, found.reason) == (expected.fresh, expected.stopped, expected.reason)
        assert found.wanted == (expected.wanted and pytest.approx(expected.wanted, abs=1e-6))  # of another array's sums
        assert found.stopped == (step in (17, 22, 23))
        (twist,), quantiles = robot.hears("cmd_vel"), robot.hears("return_quantiles")
        assert (twist.twist.linear.x, twist.twist.angular.z) == (found.v_m_per_s, found.omega_rad_per_s)
        assert twist.header == header(now, "base_link")
        told = [] if found.quantiles is None else [found.quantiles.tolist()]
        assert [message.data for message in quantiles] == told


def test_what_cannot_be_decoded_stops_the_robot_until_something_good_follows(monkeypatch: pytest.MonkeyPatch) -> None:
    robot, bridge = Robot(), DdsBridge(Driver(Policy(agent())), DOMAIN)

    def reason_with(broken: Any, **messages: Any) -> str | None:
        robot.say(**messages)
        with monkeypatch.context() as patch:

            def refuse(data: bytes, **_: Any) -> Any:
                raise UnicodeDecodeError("utf-8", data, 0, 1, "not UTF-8")

            patch.setattr(broken, "deserialize", refuse)
            return bridge.step(10.0).reason

    good = {"scan": laser(10.0), "odom": odometry(10.0), "plan": plan(10.0), "stop": ros.Bool()}
    robot.say(beta=ros.Float64(-1.0), **good)
    assert bridge.step(10.0).fresh
    for kind, name, said in (
        (ros.LaserScan, "scan", "there is no scan"),
        (ros.Odometry, "odom", "there is no odometry"),
        (ros.Path, "plan", "the path cannot be read"),
        (ros.Bool, "stop", r"stop\(\) was called"),
    ):
        assert re.match(said, str(reason_with(kind, **{name: good[name]})))
        robot.say(**{name: good[name]})
        assert not bridge.step(10.0).stopped
    assert reason_with(ros.Float64, beta=ros.Float64(-2.0)) is None
    assert bridge.driver.beta == -1.0


def test_word_that_there_is_nothing_more_is_no_message() -> None:
    robot, bridge = Robot(), DdsBridge(Driver(Policy(agent())), DOMAIN)
    robot.say(scan=laser(10.0), odom=odometry(10.0), plan=plan(10.0), stop=ros.Bool(True))
    assert bridge.step(10.0).stopped
    robot.say(stop=ros.Bool(False))
    robot.withdraw("stop", ros.Bool())  # goes along with what was said before
    robot.withdraw("scan", ros.LaserScan())
    assert isinstance(bridge._readers["scan"].read(10)[-1], InvalidSample)
    assert bridge.step(10.1).fresh
    assert "scan_s is 0.40 s old" in str(bridge.step(10.4).reason)


# ------------------------------------------------------------------------------------------------ frames and clouds
def transform(now_s: float, parent: str, child: str, x_m: float, z_m: float = 0.0) -> ros.TFMessage:
    place = ros.Transform(ros.Vector3(x_m, 0.0, z_m))
    return ros.TFMessage([ros.TransformStamped(header(now_s, parent), child, place)])


def test_every_transform_counts_and_static_ones_are_those_of_before() -> None:
    """Two publishers of /tf between two steps, and two of /tf_static that spoke before the node was there."""
    latched = [Rule.Reliability.Reliable(10**9), Rule.Durability.TransientLocal, Rule.History.KeepLast(1)]
    publishers = [endpoint(DataWriter, "tf_static", ros.TFMessage, *latched) for _ in range(2)]
    publishers[0].write(transform(0.0, "base_link", "mast", 0.1))
    publishers[1].write(transform(0.0, "mast", "laser", 0.05))
    driver, robot = Driver(Policy(agent())), Robot()
    bridge = DdsBridge(driver, DOMAIN)
    message = plan(10.0)
    message.header.frame_id = "map"
    robot.say(plan=message, odom=odometry(10.0, 1.0), scan=laser(10.0))
    robot.say(tf=transform(10.0, "map", "odom", 2.0))
    robot.say(tf=transform(10.0, "world", "map", 4.0))
    assert bridge.step(10.0).fresh
    assert driver.situation is not None
    assert driver.situation.pose == (3.0, 0.0, 0.0)
    assert driver.situation.ranges.mount.x_m == pytest.approx(0.15)  # type: ignore[union-attr]
    assert [message.data for message in robot.hears("drive_status")] == ["driving"]
    assert "the localisation is lost" in str(bridge.step(11.5).reason)
    assert "the localisation is lost" in robot.hears("drive_status")[0].data


def test_a_pose_topic_says_where_the_robot_is_where_that_is_asked_for(folder: Path) -> None:
    arguments = [str(folder), "--localisation", "pose", "--localisation-timeout", "0.5", "--remap", "pose:=/amcl_pose"]
    bridge, robot = dds_node.bridge_of(dds_node._parser().parse_args(arguments)), Robot(pose="amcl_pose")
    message = plan(10.0)
    message.header.frame_id = "map"
    robot.say(plan=message, odom=odometry(10.0, 1.0), scan=laser(10.0))
    assert "no pose of the robot has come yet" in str(bridge.step(10.0).reason)
    here = ros.PoseWithCovariance(ros.Pose(ros.Point(x=3.5)))
    robot.say(pose=ros.PoseWithCovarianceStamped(header(10.0, "map"), here))
    assert bridge.step(10.0).fresh
    assert bridge.driver.situation is not None
    assert bridge.driver.situation.pose == (3.5, 0.0, 0.0)
    assert "the localisation is lost" in str(bridge.step(10.6).reason)


def test_clouds_come_on_topics_of_their_own() -> None:
    camera = endpoint(DataWriter, "front/points", ros.PointCloud2, Rule.Reliability.Reliable(10**9))
    driver, robot = Driver(Policy(agent()), cameras={"cam": 1.7}), Robot()
    bridge = DdsBridge(driver, DOMAIN, clouds=["/front/points"])
    points = np.zeros((400, 3), "<f4")
    points[:, 0], points[:, 1] = 1.5, np.linspace(-1.5, 1.5, 400)
    parts = [ros.PointField(name, 4 * place, 7, 1) for place, name in enumerate("xyz")]
    camera.write(ros.PointCloud2(header(10.0, "cam"), 1, 400, parts, False, 12, 4800, list(points.tobytes()), True))
    robot.say(plan=plan(10.0), odom=odometry(10.0), tf=transform(10.0, "base_link", "cam", 0.2, 0.4))
    assert bridge.step(10.0).reason is None
    assert driver.situation is not None
    assert driver.situation.ranges.distances_m[0] == pytest.approx(1.7, abs=1e-3)  # type: ignore[union-attr]
    assert "nobody writes /scan" not in bridge.report()
    with pytest.raises(UserInputError, match="cloud:=a b is no topic of ROS"):
        DdsBridge(driver, DOMAIN, clouds=["a b"])


def test_simulated_time_moves_it_on_a_period_at_a_time() -> None:
    robot, bridge = Robot(), DdsBridge(Driver(Policy(agent())), DOMAIN, simulated=True)
    assert "nobody writes /clock" not in bridge.report()
    ticks = dds_node._simulated_ticks(bridge, PERIOD_S)
    found = []
    for now_s in (10.0, 10.07, 10.14, 10.2, 10.28, 3.0):  # the last: the simulation was started again
        robot.say(clock=ros.Clock(header(now_s, "").stamp))
        found.append(next(ticks))
    assert found == [10.0, None, 10.14, None, 10.28, 3.0]


# ------------------------------------------------------------------------------------------------ who is there
def endpoint(make: Any, name: str, kind: Any, *rules: Any) -> Any:
    participant = DomainParticipant(DOMAIN)
    return make(participant, Topic(participant, f"rt/{name}", kind), Qos(*rules))


def test_a_base_that_reads_twist_gets_the_same_commands() -> None:
    robot, bridge = Robot(), DdsBridge(Driver(Policy(agent())), DOMAIN)
    base = endpoint(DataReader, "cmd_vel", ros.Twist, Rule.Reliability.Reliable(10**9), Rule.History.KeepLast(10))
    robot.say(scan=laser(10.0), odom=odometry(10.0), plan=plan(10.0))
    command = bridge.step(10.0)
    assert command.fresh
    bridge.leave(10.1)
    expected = [(command.v_m_per_s, command.omega_rad_per_s), (0.0, 0.0)]
    assert [(twist.linear.x, twist.angular.z) for twist in base.take(10)] == expected
    assert robot.commands() == expected


def test_it_says_who_reads_its_commands_and_who_writes_what_it_needs() -> None:
    bridge = DdsBridge(Driver(Policy(agent())), DOMAIN, remapped={"cmd_vel": "/base/cmd_vel"})
    kinds = "geometry_msgs/msg/Twist and geometry_msgs/msg/TwistStamped"
    nobody = (
        f"nobody reads /base/cmd_vel (written as {kinds}); nobody writes /scan (sensor_msgs/msg/LaserScan); "
        "nobody writes /odom (nav_msgs/msg/Odometry); nobody writes /plan (nav_msgs/msg/Path)"
    )
    assert bridge.report() == nobody
    others = [
        endpoint(DataReader, "base/cmd_vel", ros.Twist),
        endpoint(DataWriter, "scan", ros.Odometry),
        endpoint(DataWriter, "odom", ros.Odometry, Rule.Reliability.BestEffort),
        endpoint(DataWriter, "plan", ros.Path, Rule.Reliability.BestEffort),
    ]
    assert bridge.report() == (
        "/base/cmd_vel is read as geometry_msgs/msg/Twist; /scan is written as nav_msgs/msg/Odometry, and read as "
        "sensor_msgs/msg/LaserScan; /plan is written with less quality of service than is asked for: make its writer "
        "reliable"
    )
    others[0] = endpoint(DataReader, "base/cmd_vel", ros.Float64)
    assert bridge.report().startswith(f"/base/cmd_vel is read as std_msgs/msg/Float64, and written as {kinds};")
    del others
    assert bridge.report() == nobody


# ------------------------------------------------------------------------------------------------ the program
def decided() -> Weights:
    """Make an agent that knows what it wants: beta changes its command, and it takes few steps to settle."""
    weights = agent(28)
    return Weights(weights.config, {name: 3.0 * tensor for name, tensor in weights.tensors.items()})


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    for name, content in packed(decided()).items():
        (tmp_path / name).write_bytes(content)
    return tmp_path


@pytest.mark.parametrize(
    ("arguments", "variables", "said"),
    [
        (["nobody"], {}, "nobody"),
        (["--laser", "150", "0", "0"], {}, "x_m=150, y_m=0 is more than 1 m from the robot's centre: give metres"),
        (["--laser", "0", "0", "90"], {}, "yaw_rad=90 of a sensor is more than a full turn: give radians"),
        (["--beta", "3"], {}, r"beta=3 is outside \[-2, 0\]"),
        (["--remap", "scan"], {}, r"--remap scan cannot be read: write <name>:=<topic>"),
        (["--remap", "scam:=scan"], {}, "scam:=scan renames what there is not: choose one of scan, odom, plan"),
        (["--remap", "scan:=front scan"], {}, "scan:=front scan is no topic of ROS"),
        (["--remap", "scan:=/odom"], {}, "scan and odom are both called /odom: give each a topic of its own"),
        (["--laser", "0", "nan", "0"], {}, "is not finite"),
        (["--camera", "cam", "points", "wide"], {}, "--camera cam: a view of wide is no number: give radians"),
        (["--camera", "cam", "p q", "1.5"], {}, "cloud:=p q is no topic of ROS"),
        (["--localisation-timeout", "-1"], {}, "localisation_timeout_s=-1.0 must be a positive number of seconds"),
        (["--plan-timeout", "0"], {}, "plan_timeout_s=0.0 must be a positive number of seconds: leave it out"),
        ([], {"ROS_DOMAIN_ID": "233"}, "ROS_DOMAIN_ID=233 is no domain: give a whole number from 0 to 232"),
        ([], {"ROS_DOMAIN_ID": "-1"}, "ROS_DOMAIN_ID=-1 is no domain"),
        # In a domain of its own: what a process knows of one that it is in, it does not read again.
        (
            [],
            {
                "ROS_DOMAIN_ID": "232",
                "CYCLONEDDS_URI": URI.replace("NetworkInterface address", "NetworkInterface name"),
            },
            "DDS cannot join domain .* CYCLONEDDS_URI",
        ),
    ],
)
def test_wrong_input_ends_in_one_sentence(
    arguments: list[str],
    variables: dict[str, str],
    said: str,
    folder: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    monkeypatch.setattr(dds_node, "drive", lambda bridge: None)
    for name, value in variables.items():
        monkeypatch.setenv(name, value)
    with pytest.raises(SystemExit, match="2"):
        dds_node.main(arguments if arguments == ["nobody"] else [str(folder), *arguments])
    printed = capsys.readouterr()
    assert re.search(f"^rcdsac_trl: .*{said}", printed.err)
    assert printed.err.count("\n") == 1
    assert not printed.out


def test_without_cyclonedds_it_says_how_to_get_it(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("importlib.util.find_spec", lambda name: None)
    with pytest.raises(UserInputError, match=r"pip install 'rcdsac-trl\[dds\]'"):
        dds_node.bridge_of(dds_node._parser().parse_args(["anybody"]))


def test_it_leads_around_what_blocks_the_way_where_the_command_line_says_so(folder: Path) -> None:
    """What stands across the way ends 25 degrees left of it and 60 degrees right."""
    first = {}
    for arguments in ([], ["--detours"]):
        bridge, robot = dds_node.bridge_of(dds_node._parser().parse_args([str(folder), *arguments])), Robot()
        policy = bridge.driver.policy
        for step in range(30):
            now_s = 10.0 + PERIOD_S * step
            scanned, standing = laser(now_s), odometry(now_s)
            scanned.ranges = [1.2 if -60 <= i - 180 < 25 else 4.0 for i in range(360)]
            standing.twist.twist.linear.x = standing.twist.twist.angular.z = 0.0
            robot.say(scan=scanned, odom=standing, plan=plan(now_s, ((0.0, 0.0), (5.0, 0.0))))
            bridge.step(now_s)
            first[bool(arguments), step] = None if policy._advice is None else policy._advice.waypoints[0]
    assert first[False, 29] is None
    assert first[True, 20] == pytest.approx((5.0, 0.0), abs=0.01)  # 2.8 s
    x, y = first[True, 29] or (0.0, 0.0)
    assert 0.7 < math.hypot(x, y) < 2.0
    assert y > 0.4


def test_it_turns_bold_where_it_stands_if_the_command_line_says_so(folder: Path) -> None:
    bridge, robot = dds_node.bridge_of(dds_node._parser().parse_args([str(folder), "--watchdog"])), Robot()
    told = []
    for step in range(60):
        now_s = 10.0 + PERIOD_S * step
        standing = odometry(now_s)
        standing.twist.twist.linear.x = standing.twist.twist.angular.z = 0.0
        robot.say(scan=laser(now_s), odom=standing, plan=plan(now_s, ((0.0, 0.0), (5.0, 0.0))))
        told.append(bridge.step(now_s).reason)
    assert not any("boldest" in str(reason) for reason in told[:21])  # 2.94 s
    assert "beta turns to its boldest" in str(told[30])


def test_it_allows_for_a_latency_where_the_command_line_gives_one(folder: Path) -> None:
    asked = dds_node._parser().parse_args([str(folder), "--latency", "0.2"])
    with pytest.raises(UserInputError, match=r"latency_s=0\.2 is allowed for by what an agent remembers"):
        dds_node.bridge_of(asked)


def test_a_plan_ages_where_the_command_line_says_so(folder: Path) -> None:
    for arguments, old in (([], None), (["--plan-timeout", "3"], "the plan is 3.10 s old")):
        bridge, robot = dds_node.bridge_of(dds_node._parser().parse_args([str(folder), *arguments])), Robot()
        robot.say(plan=plan(10.0))
        for now_s, told in ((10.0, None), (13.1, old)):
            robot.say(scan=laser(now_s), odom=odometry(now_s))
            reason = bridge.step(now_s).reason
            assert reason is None if told is None else told in str(reason)


def test_it_stands_until_it_is_released_where_the_command_line_says_so(folder: Path) -> None:
    bridge, robot = dds_node.bridge_of(dds_node._parser().parse_args([str(folder), "--stopped"])), Robot()
    robot.say(scan=laser(10.0), odom=odometry(10.0), plan=plan(10.0))
    assert "stop() was called" in str(bridge.step(10.0).reason)
    robot.say(stop=ros.Bool(False))
    assert bridge.step(10.0).reason is None


def test_zeros_are_open_space_where_the_command_line_says_so(folder: Path) -> None:
    for arguments, reads_zero in (([], True), (["--zero-means", "far"], False)):
        bridge = dds_node.bridge_of(dds_node._parser().parse_args([str(folder), *arguments]))
        robot = Robot()
        message = laser(10.0)
        message.ranges = [0.0] * 360
        robot.say(scan=message, odom=odometry(10.0), plan=plan(10.0))
        assert ("read 0" in str(bridge.step(10.0).reason)) == reads_zero


class Told:
    """Stands in for a bridge whose reader comes after 3 s, and ends the program after 50 steps."""

    def __init__(self, end: Callable[[], None] = lambda: signal.raise_signal(signal.SIGTERM)) -> None:
        self.topics = {"scan": "scan"}
        self.simulated = False
        self.driver = Driver(Policy(agent(period_s=(0.0, 0.0))))
        self.steps = 0
        self._end = end

    def step(self, now_s: float) -> Any:
        assert self.steps < 50, "it was to end"
        self.steps += 1
        if self.steps == 50:
            self._end()
        return self.driver.policy.refuse("there is no scan yet")

    def report(self) -> str:
        return "nobody reads /cmd_vel" if self.steps < 25 else "/cmd_vel is read as geometry_msgs/msg/Twist"

    def leave(self, now_s: float) -> None:
        self.steps = -1


@pytest.fixture
def signals() -> Iterator[None]:
    """Give the test's own handlers back; a closed terminal ends no test."""
    handlers = {number: signal.getsignal(number) for number in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)}
    signal.signal(signal.SIGHUP, lambda number, frame: None)
    yield
    for number, handler in handlers.items():
        signal.signal(number, handler)


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM, signal.SIGHUP])
def test_whatever_asks_it_to_end_the_last_command_is_sent(number: signal.Signals, signals: None) -> None:
    bridge: Any = Told(lambda: signal.raise_signal(number))
    dds_node.drive(bridge)
    assert bridge.steps == -1


def test_a_terminal_that_it_is_to_outlive_ends_nothing(signals: None) -> None:
    signal.signal(signal.SIGHUP, signal.SIG_IGN)  # as nohup does
    dds_node.drive(Told())  # type: ignore[arg-type]
    assert signal.getsignal(signal.SIGHUP) is signal.SIG_IGN


def test_an_error_surfaces_after_the_last_command(signals: None) -> None:
    def end() -> None:
        raise RuntimeError("the network is gone")

    bridge: Any = Told(end)
    with pytest.raises(RuntimeError, match="the network is gone"):
        dds_node.drive(bridge)
    assert bridge.steps == -1


def test_it_drives_on_when_nobody_reads_what_it_tells(monkeypatch: pytest.MonkeyPatch, signals: None) -> None:
    reader, writer = os.pipe()
    os.close(reader)
    ended: list[int] = []

    def end() -> None:
        ended.append(bridge.steps)
        signal.raise_signal(signal.SIGTERM)

    bridge: Any = Told(end)
    with open(writer, "wb", buffering=0) as raw, io.TextIOWrapper(raw, write_through=True) as nobody_reads:
        monkeypatch.setattr(sys, "stderr", nobody_reads)
        with pytest.raises(BrokenPipeError):
            print("as it is", file=sys.stderr, flush=True)
        dds_node.drive(bridge)
    assert (ended, bridge.steps) == ([50], -1)


def test_the_program_tells_who_reads_it_whenever_that_changes(
    capsys: pytest.CaptureFixture[str], signals: None
) -> None:
    bridge: Any = Told()
    dds_node.drive(bridge)
    assert bridge.steps == -1
    assert capsys.readouterr().err.splitlines() == [
        "topics: /scan; Ctrl-C ends it",
        "there is no scan yet; it stands until good input comes",
        "nobody reads /cmd_vel",
        "/cmd_vel is read as geometry_msgs/msg/Twist",
    ]


# ------------------------------------------------------------------------------------------------ two processes
def settled(beta: float) -> tuple[float, float]:
    """Return the command that the agent ends with where nothing changes, however long its periods are."""
    policy = Policy(decided())
    message = laser(0.0)
    scan = Scan(np.array(message.ranges), message.angle_min, message.angle_increment, 0.1, 10.0)
    commands = [policy.act(scan, [5.0, 2.0], (0.3, -0.2), beta) for _ in range(40)]
    assert {command.reason for command in commands} == {None}
    assert commands[-1].wanted == pytest.approx(commands[-2].wanted, abs=1e-6)
    return commands[-1].v_m_per_s, commands[-1].omega_rad_per_s


def until(robot: Robot, goal: tuple[float, float], node: subprocess.Popen[bytes], times: int = 1) -> None:
    """Be a robot that stands in a corridor, until such a command comes, so many times in a row."""
    in_a_row = 0
    deadline = time.monotonic() + 60.0
    while time.monotonic() < deadline:
        assert node.poll() is None
        now = time.time()
        robot.say(scan=laser(now), odom=odometry(now))
        for command in robot.commands():
            in_a_row = in_a_row + 1 if math.dist(command, goal) < 0.01 else 0
        if in_a_row >= times:
            return
        time.sleep(0.05)
    pytest.fail(f"{goal} was not commanded within a minute")


@pytest.fixture
def node(folder: Path) -> Iterator[subprocess.Popen[bytes]]:
    command = [sys.executable, "-m", "rcdsac_trl.deploy.dds_node", str(folder), "--beta", "-2"]
    with subprocess.Popen(command) as process:
        yield process
        process.kill()


def test_two_processes_drive_over_loopback(node: subprocess.Popen[bytes]) -> None:
    averse, neutral, stands = settled(-2.0), settled(0.0), (0.0, 0.0)
    assert min(math.dist(averse, neutral), math.hypot(*averse), math.hypot(*neutral)) > 0.1
    robot = Robot()
    until(robot, stands, node)  # they have met, and there is no path yet
    robot.say(plan=plan(time.time()))
    until(robot, averse, node)
    robot.say(beta=ros.Float64(0.0))
    until(robot, neutral, node)
    robot.say(stop=ros.Bool(True))
    until(robot, stands, node, times=5)
    robot.say(stop=ros.Bool(False))
    until(robot, neutral, node)
    node.send_signal(signal.SIGTERM)
    assert node.wait(60.0) == 0
    assert robot.commands()[-1] == stands
