"""The ROS node on a stand-in for rclpy: what it reads, writes and tells. ROS itself cannot be installed here."""

import importlib.util
import math
import signal
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from types import ModuleType, SimpleNamespace
from typing import Any, ClassVar

import pytest
from test_frames import tf
from test_robot_driver import cloud, laser, odometry, path

from rcdsac_trl.deploy.frames.rigid_transform import RigidTransform
from rcdsac_trl.deploy.navigation.navigator import NavigatorSettings
from rcdsac_trl.deploy.policy.weights import packed
from rcdsac_trl.errors import UserInputError
from robots import agent


class Node:
    """What the node uses of ``rclpy.node.Node``; parameters that are set at the start, and a clock that stands."""

    given: dict[str, Any]
    nodes: ClassVar[list["Node"]]
    handlers: ClassVar[dict[int, Any]]
    endpoints: dict[str, list[str]]

    def __init__(self, name: str) -> None:
        self.parameters: dict[str, Any] = {}
        self.subscriptions: dict[str, Any] = {}
        self.qos: dict[str, Any] = {}
        self.published: list[Any] = []
        self.publishers: dict[str, Any] = {}
        self.timers: list[Any] = []
        self.waited: list[Any] = []
        self.nodes.append(self)
        self.told: list[str] = []

    def declare_parameter(self, name: str, default: Any) -> Any:
        self.parameters[name] = SimpleNamespace(name=name, value=self.given.get(name, default))
        return self.parameters[name]

    def get_parameter(self, name: str) -> Any:
        return self.parameters[name]

    def add_on_set_parameters_callback(self, callback: Any) -> None:
        self.set = callback

    def create_subscription(self, kind: Any, topic: str, callback: Any, qos: Any) -> None:
        self.subscriptions[topic] = callback
        self.qos[topic] = qos

    def create_publisher(self, kind: Any, topic: str, qos: Any) -> Any:
        self.publishers[topic] = kind
        return SimpleNamespace(publish=self.published.append, wait_for_all_acked=self.waited.append)

    def create_timer(self, period_s: float, callback: Any) -> None:
        self.timers.append(callback)

    def get_clock(self) -> Any:
        return SimpleNamespace(now=lambda: SimpleNamespace(nanoseconds=10_000_000_000))

    def get_logger(self) -> Any:
        return SimpleNamespace(warning=self.told.append, info=self.told.append)

    def get_subscriptions_info_by_topic(self, topic: str) -> list[Any]:
        return [SimpleNamespace(topic_type=kind) for kind in self.endpoints.get(topic, [])]

    get_publishers_info_by_topic = get_subscriptions_info_by_topic

    def destroy_node(self) -> None:
        """There is nothing to destroy."""


def vector() -> SimpleNamespace:
    return SimpleNamespace(x=0.0, y=0.0, z=0.0)


class Twist:
    def __init__(self) -> None:
        self.linear, self.angular = vector(), vector()


class TwistStamped:
    def __init__(self) -> None:
        self.header = SimpleNamespace(stamp=SimpleNamespace(sec=0, nanosec=0), frame_id="")
        self.twist = Twist()


@pytest.fixture
def ros_node(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> Iterator[Any]:
    """Import the node with stand-ins for ROS's packages; it drives an agent that is written for it."""
    for name, content in packed(agent()).items():
        (tmp_path / name).write_bytes(content)
    Node.given, Node.endpoints, Node.nodes = {"agent": str(tmp_path)}, {}, []
    Node.handlers = {}
    monkeypatch.setattr(signal, "signal", Node.handlers.__setitem__)  # the test's own stay
    monkeypatch.setattr(signal, "getsignal", lambda number: signal.SIG_DFL)
    contents: dict[str, dict[str, Any]] = {
        "rclpy": {
            "init": lambda signal_handler_options: None,
            "try_shutdown": lambda: None,
            "spin": lambda node: node.timers[0](),
        },
        "rclpy.duration": {"Duration": lambda seconds: seconds},
        "rclpy.node": {"Node": Node},
        "rclpy.signals": {"SignalHandlerOptions": SimpleNamespace(NO="none")},
        "rclpy.parameter": {"Parameter": SimpleNamespace},
        "rclpy.qos": {
            "qos_profile_sensor_data": 5,
            "QoSProfile": SimpleNamespace,
            "DurabilityPolicy": SimpleNamespace(TRANSIENT_LOCAL="kept"),
        },
        "rcl_interfaces.msg": {"SetParametersResult": SimpleNamespace},
        "geometry_msgs.msg": {"Twist": Twist, "TwistStamped": TwistStamped, "PoseWithCovarianceStamped": object},
        "nav_msgs.msg": {"OccupancyGrid": object, "Odometry": object, "Path": object},
        "sensor_msgs.msg": {"LaserScan": object, "PointCloud2": object},
        "std_msgs.msg": {"Float32MultiArray": SimpleNamespace, "String": SimpleNamespace},
        "tf2_msgs.msg": {"TFMessage": object},
    }
    for name, members in contents.items():
        module = ModuleType(name)
        module.__dict__.update(members)
        monkeypatch.setitem(sys.modules, name, module)
        if "." in name:
            monkeypatch.setitem(sys.modules, name.split(".")[0], sys.modules.get(name.split(".")[0], ModuleType(name)))
    yield importlib.import_module("rcdsac_trl.deploy.ros_node")
    sys.modules.pop("rcdsac_trl.deploy.ros_node")


def driven(node: Any, ranges: Any = None) -> Any:
    """Give a node what it needs, let its timer fire, and return the command it published."""
    node.subscriptions["scan"](laser(10.0, ranges))
    node.subscriptions["odom"](odometry(10.0, 0.0, 0.0))
    node.subscriptions["plan"](path([(0.0, 0.0), (5.0, 0.0)]))
    node.published.clear()
    node.timers[0]()
    return node.published[0]


def test_it_drives_and_writes_stamped_or_plain_twists(ros_node: Any) -> None:
    stamped_node = ros_node.PolicyNode()
    stamped = driven(stamped_node)
    assert stamped_node.publishers["cmd_vel"] is TwistStamped
    assert (stamped.header.stamp.sec, stamped.header.frame_id) == (10, "base_link")
    assert stamped_node.told == []
    _, quantiles, status = stamped_node.published
    assert len(quantiles.data) == 16
    assert status.data == "driving"
    Node.given["command_type"] = "Twist"
    node = ros_node.PolicyNode()
    plain = driven(node)
    assert (node.publishers["cmd_vel"], type(plain)) == (Twist, Twist)
    assert (plain.linear.x, plain.angular.z) == (stamped.twist.linear.x, stamped.twist.angular.z) != (0.0, 0.0)


def test_parameters_are_live_and_zeros_mean_what_is_said(ros_node: Any) -> None:
    node = ros_node.PolicyNode()
    assert node.driver.beta is None
    node.set([SimpleNamespace(name="beta", value=-2.0), SimpleNamespace(name="stop", value=True)])
    assert node.driver.beta == -2.0
    assert driven(node).twist.linear.x == 0.0
    assert "stop() was called" in node.told[-1]
    node.set([SimpleNamespace(name="beta", value=math.nan), SimpleNamespace(name="stop", value=False)])
    assert node.driver.beta is None
    driven(node, [0.0] * 360)
    assert "set zero_means=far" in node.told[-1]
    Node.given["zero_means"] = "far"
    node = ros_node.PolicyNode()
    driven(node, [0.0] * 360)
    assert node.told == []


def test_a_beta_that_the_agent_does_not_know_is_refused_and_changes_nothing(ros_node: Any) -> None:
    node = ros_node.PolicyNode()
    node.set([SimpleNamespace(name="beta", value=-2.0)])
    refused = node.set([SimpleNamespace(name="stop", value=True), SimpleNamespace(name="beta", value=5.0)])
    assert not refused.successful
    assert refused.reason == "beta=5 is outside [-2, 0], where this agent was trained"
    assert node.driver.beta == -2.0
    assert driven(node).twist.linear.x != 0.0
    assert node.set([SimpleNamespace(name="beta", value=-1.0)]).successful


def test_one_that_starts_stopped_stands_until_it_is_released(ros_node: Any) -> None:
    Node.given["stop"] = True
    node = ros_node.PolicyNode()
    assert driven(node).twist.linear.x == 0.0
    assert "stop() was called" in node.told[-1]
    node.set([SimpleNamespace(name="stop", value=False)])
    assert driven(node).twist.linear.x != 0.0


def test_it_reads_transforms_and_says_where_the_sensors_are_that_have_none(ros_node: Any) -> None:
    node = ros_node.PolicyNode()
    assert node.qos["/tf_static"].durability == "kept"
    node.subscriptions["/tf_static"](tf(0.0, "base_link", "laser", RigidTransform.planar(0.2, 0.0, 1.0)))
    assert driven(node).twist.linear.x != 0.0
    mount = node.driver.situation.ranges.mount
    assert (mount.x_m, mount.yaw_rad) == pytest.approx((0.2, 1.0))
    Node.given |= {"laser_yaw_rad": 0.5, "localisation_timeout_s": 0.3}
    node = ros_node.PolicyNode()
    node.subscriptions["/tf"](tf(9.5, "map", "odom", RigidTransform.planar(0.0, 0.0, 0.0)))
    driven(node)
    assert node.driver.situation.ranges.mount.yaw_rad == pytest.approx(0.5)
    node.subscriptions["plan"](path([(5.0, 0.0)], "map"))
    node.timers[0]()
    assert "the localisation is lost" in node.published[-1].data
    assert "the localisation is lost" in node.told[-1]


def test_it_leads_around_what_blocks_the_way_where_that_is_asked_for(ros_node: Any) -> None:
    assert ros_node.PolicyNode().driver.policy.navigator is None
    Node.given["detours"] = True
    node = ros_node.PolicyNode()
    assert node.driver.policy.navigator.settings == NavigatorSettings(watchdog=None)
    assert driven(node).twist.linear.x != 0.0
    assert node.driver.policy._advice is not None
    assert node.qos["map"].durability == "kept"
    node.timers[1]()
    assert "nobody writes map: detours know what was seen alone" in node.told[-1]
    Node.endpoints = {"map": ["nav_msgs/msg/OccupancyGrid"]}
    node.timers[1]()
    assert "map is written, and none has come" in node.told[-1]
    node.subscriptions["map"](None)
    node.timers[0]()
    assert "the map cannot be read" in node.published[-1].data


def test_it_turns_bold_where_it_stands_if_that_is_asked_for(ros_node: Any) -> None:
    Node.given["watchdog"] = True
    node = ros_node.PolicyNode()
    assert node.driver.policy.navigator.settings == NavigatorSettings(replan=False)
    node.timers[1]()
    assert not any("map" in told for told in node.told)  # detours alone want one


def test_plans_age_where_a_timeout_is_given(ros_node: Any) -> None:
    for given, told in (({}, None), ({"plan_timeout_s": 3.0}, "the plan is 3.10 s old, more than plan_timeout_s=3:")):
        Node.given |= given
        node = ros_node.PolicyNode()
        driven(node)
        node.subscriptions["scan"](laser(13.1))
        node.subscriptions["odom"](odometry(13.1, 0.0, 0.0))
        reason = node.driver.command(13.1).reason
        assert reason is None if told is None else told in reason


def test_it_allows_for_a_latency_where_that_is_given(ros_node: Any) -> None:
    Node.given["latency_s"] = 0.2
    with pytest.raises(UserInputError, match=r"latency_s=0\.2 is allowed for by what an agent remembers"):
        ros_node.PolicyNode()


def test_cameras_are_read_in_place_of_the_scanner(ros_node: Any) -> None:
    Node.given |= {"camera_frames": ["cam"], "camera_topics": ["front/points"], "camera_views_rad": [1.7]}
    node = ros_node.PolicyNode()
    node.timers[1]()
    assert "nobody writes front/points (sensor_msgs/msg/PointCloud2)" in node.told[-1]
    node.subscriptions["front/points"](cloud(10.0, "cam"))
    driven(node)
    assert node.told[-1].startswith("nobody says where the sensor in frame 'cam' sits: no transform names frame")
    pose = RigidTransform((0.2, 0.0, 0.4))
    node.subscriptions["/tf_static"](tf(0.0, "base_link", "cam", pose))
    driven(node)
    assert node.driver.situation.ranges.distances_m[0] == pytest.approx(1.7, abs=1e-3)


def test_it_tells_who_reads_its_commands_whenever_that_changes(ros_node: Any) -> None:
    node = ros_node.PolicyNode()
    report = node.timers[1]
    report()
    report()
    assert len(node.told) == 1
    assert node.told[0].startswith(
        "nobody reads cmd_vel (written as geometry_msgs/msg/TwistStamped); nobody writes scan"
    )
    needed = {"scan": "sensor_msgs/msg/LaserScan", "odom": "nav_msgs/msg/Odometry", "plan": "nav_msgs/msg/Path"}
    Node.endpoints = {topic: [kind] for topic, kind in needed.items()} | {"cmd_vel": ["geometry_msgs/msg/Twist"]}
    report()
    assert node.told[1] == (
        "cmd_vel is read as geometry_msgs/msg/Twist, and written as geometry_msgs/msg/TwistStamped; the parameter "
        "command_type chooses another of TwistStamped, Twist"
    )
    Node.endpoints["cmd_vel"] = ["geometry_msgs/msg/TwistStamped"]
    report()
    assert node.told[2] == "cmd_vel is read as geometry_msgs/msg/TwistStamped"


@pytest.mark.parametrize(
    ("given", "told"),
    [
        ({"command_type": "twist"}, "command_type=twist is not one of TwistStamped, Twist"),
        ({"zero_means": "open"}, "zero_means='open' is none of"),
        ({"laser_x_m": 150.0}, "x_m=150, y_m=0 is more than 1 m from the robot's centre: give metres"),
        (
            {"camera_frames": ["a", "b"], "camera_topics": ["a"]},
            "camera_frames has 2 entries, camera_topics 1, camera_views_rad 1: give one a camera in each",
        ),
        ({"plan_timeout_s": 0.0}, "plan_timeout_s=0.0 must be a positive number of seconds"),
        ({"beta": 5.0}, "beta=5 is outside [-2, 0], where this agent was trained"),
        ({"localisation": "gps"}, "localisation='gps' is neither 'tf' nor 'pose'"),
        ({"agent": "nobody"}, "there is no agent 'nobody'"),
    ],
)
def test_wrong_parameters_end_in_one_sentence(
    ros_node: Any, given: dict[str, Any], told: str, capsys: pytest.CaptureFixture[str]
) -> None:
    Node.given |= given
    with pytest.raises(SystemExit, match="2"):
        ros_node.main()
    error = capsys.readouterr().err
    assert told in error
    assert error.count("\n") == 1


def test_the_program_spins_and_leaves_ros(ros_node: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    done: list[str] = []
    monkeypatch.setattr(Node, "destroy_node", lambda node: done.append(node.told[-1]))
    monkeypatch.setattr(ros_node.rclpy, "try_shutdown", lambda: done.append("left"))
    ros_node.main()
    assert done == ["there is no odometry yet; it stands until good input comes", "left"]


@pytest.mark.parametrize("kind", ["TwistStamped", "Twist"])
def test_the_last_command_is_to_stand(ros_node: Any, monkeypatch: pytest.MonkeyPatch, kind: str) -> None:
    Node.given["command_type"] = kind

    def spin(node: Any) -> None:
        assert driven(node).twist.linear.x != 0.0 if kind == "TwistStamped" else driven(node).linear.x != 0.0
        Node.handlers[signal.SIGINT](signal.SIGINT, None)

    monkeypatch.setattr(ros_node.rclpy, "spin", spin)
    ros_node.main()
    (node,) = Node.nodes
    last = node.published[-1].twist if kind == "TwistStamped" else node.published[-1]
    assert (last.linear.x, last.angular.z) == (0.0, 0.0)
    assert node.waited == [1.0]


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM, signal.SIGHUP])
def test_what_asks_it_to_end_is_heard_once(ros_node: Any, monkeypatch: pytest.MonkeyPatch, number: int) -> None:
    monkeypatch.setattr(ros_node.rclpy, "spin", lambda node: Node.handlers[number](number, None))
    ros_node.main()
    assert Node.nodes[0].waited == [1.0]
    asking = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)
    assert Node.handlers == dict.fromkeys(asking, signal.SIG_IGN)  # a second one ends no last command


def test_an_error_surfaces_after_the_last_command(ros_node: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    done: list[str] = []

    def spin(node: Any) -> None:
        assert driven(node).twist.linear.x != 0.0
        raise RuntimeError("the wait set is gone")

    monkeypatch.setattr(ros_node.rclpy, "spin", spin)
    monkeypatch.setattr(Node, "destroy_node", lambda node: done.append("destroyed"))
    monkeypatch.setattr(ros_node.rclpy, "try_shutdown", lambda: done.append("left"))
    with pytest.raises(RuntimeError, match="the wait set is gone"):
        ros_node.main()
    (node,) = Node.nodes
    assert (node.published[-1].twist.linear.x, node.published[-1].twist.angular.z) == (0.0, 0.0)
    assert node.waited == [1.0]
    assert done == ["destroyed", "left"]


def test_without_ros_it_says_what_to_source(tmp_path: Path) -> None:
    if importlib.util.find_spec("rclpy") is not None:
        pytest.skip("there is ROS here")
    name = "rcdsac_trl.deploy.ros_node"
    done = subprocess.run([sys.executable, "-m", name], cwd=tmp_path, capture_output=True, text=True, check=False)
    assert (done.returncode, done.stdout, done.stderr.count("\n")) == (2, "", 1)
    assert done.stderr.startswith(
        f"rcdsac_trl: this Python ({sys.version_info[0]}.{sys.version_info[1]}) has no rclpy ("
    )
    assert "source /opt/ros/<distribution>/setup.bash" in done.stderr
    assert done.stderr.endswith("python -m rcdsac_trl.deploy.dds_node <agent>\n")
    with pytest.raises(UserInputError, match="has no rclpy"):
        importlib.import_module(name)
