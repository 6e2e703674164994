"""A ROS 2 node around :class:`~rcdsac_trl.deploy.policy.driver.Driver`; the one file that needs ``rclpy``.

Run it where ROS 2 is sourced: ``python -m rcdsac_trl.deploy.ros_node --ros-args -p agent:=<name or folder>``.
It reads ``scan`` (or clouds), ``odom``, ``plan``, ``/tf``, ``/tf_static`` and, for detours, ``map``. It writes
``cmd_vel`` (``geometry_msgs/TwistStamped``, or ``Twist`` with the parameter ``command_type``), the return's quantiles
on ``return_quantiles``, and on ``drive_status`` why the robot does not go as the agent would. ``beta`` and ``stop`` may
be set while it runs; every parameter is explained in docs/nav2.md.
"""

import contextlib
import importlib
import math
import signal
import sys
from functools import partial
from types import FrameType
from typing import Any

from rcdsac_trl.errors import UserInputError

try:
    import rclpy
except ModuleNotFoundError as error:
    _sentence = (
        f"this Python ({sys.version_info.major}.{sys.version_info.minor}) has no rclpy ({error}): source a ROS 2 that "
        "was built for it (source /opt/ros/<distribution>/setup.bash), or drive without ROS: "
        "python -m rcdsac_trl.deploy.dds_node <agent>"
    )
    if __name__ != "__main__":
        raise UserInputError(_sentence) from error
    print(f"rcdsac_trl: {_sentence}", file=sys.stderr)
    raise SystemExit(2) from None

from geometry_msgs.msg import PoseWithCovarianceStamped, Twist, TwistStamped
from nav_msgs.msg import OccupancyGrid, Odometry, Path
from rcl_interfaces.msg import SetParametersResult
from rclpy.duration import Duration
from rclpy.node import Node
from rclpy.parameter import Parameter
from rclpy.qos import DurabilityPolicy, QoSProfile, qos_profile_sensor_data
from rclpy.signals import SignalHandlerOptions
from sensor_msgs.msg import LaserScan, PointCloud2
from std_msgs.msg import Float32MultiArray, String
from tf2_msgs.msg import TFMessage

import rcdsac_trl
from rcdsac_trl.deploy.frames.robot_frames import FrameSettings
from rcdsac_trl.deploy.policy.command import Command
from rcdsac_trl.deploy.policy.driver import Driver
from rcdsac_trl.deploy.ros.endings import ending_signals
from rcdsac_trl.deploy.ros.messages import twist, twist_stamped
from rcdsac_trl.deploy.ros.topics import DRIVING, no_map_on, readers_of, without_numbers, writers_of
from rcdsac_trl.errors import UserInputError
from rcdsac_trl.robot.sectors import Mount

# One node writes a topic as one type: not every middleware of ROS knows two of one name.
_COMMAND_TYPES = {"TwistStamped": TwistStamped, "Twist": Twist}
_SCAN, _CLOUD = "sensor_msgs/msg/LaserScan", "sensor_msgs/msg/PointCloud2"
_NEEDED = {"odom": "nav_msgs/msg/Odometry", "plan": "nav_msgs/msg/Path"}
# What holds for whoever comes later: as map servers publish.
_KEPT_QOS = QoSProfile(depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL)
# How tf2 publishes and reads.
_TF_QOS = QoSProfile(depth=100)
_STATIC_TF_QOS = QoSProfile(depth=100, durability=DurabilityPolicy.TRANSIENT_LOCAL)
_REPORT_PERIOD_S = 2.0
_LAST_S = 1.0  # so long it waits until its last command has come


class PolicyNode(Node):
    """Drives by a policy; every parameter is read at the start but ``beta`` and ``stop``, which are live."""

    def __init__(self) -> None:
        super().__init__("rcdsac_trl")
        agent = self._given("agent", "")
        plan_timeout_s = self._given("plan_timeout_s", math.nan)  # NaN: never
        self._command_type = self._given("command_type", "TwistStamped")
        if self._command_type not in _COMMAND_TYPES:
            raise UserInputError(
                f"command_type={self._command_type} is not one of {', '.join(_COMMAND_TYPES)}: choose one"
            )
        cameras = self._cameras()
        defaults = FrameSettings()
        self.driver = Driver(
            rcdsac_trl.load(agent, latency_s=self._given("latency_s", 0.0)),
            mount=self._mount(),
            cameras={frame: view_rad for frame, _, view_rad in cameras},
            zero_means=self._given("zero_means", "invalid"),
            nan_means=self._given("nan_means", "invalid"),
            frames=FrameSettings(
                self._given("localisation", defaults.localisation),
                self._given("localisation_timeout_s", defaults.localisation_timeout_s),
                self._given("base_frame", "") or None,
            ),
            detours=self._given("detours", False),
            watchdog=self._given("watchdog", False),
            plan_timeout_s=None if math.isnan(plan_timeout_s) else plan_timeout_s,
        )
        self._needed = {topic: _CLOUD for _, topic, _ in cameras} or {"scan": _SCAN}
        self._needed |= _NEEDED
        config = self.driver.policy.config
        # NaN stands for the agent's own default: ROS parameters know no null.
        self.declare_parameter("beta", math.nan)
        self.declare_parameter("stop", False)
        self.add_on_set_parameters_callback(self._set)
        begins = self._set([self.get_parameter("beta"), self.get_parameter("stop")])
        if not begins.successful:
            raise UserInputError(begins.reason)
        self._subscribe([topic for _, topic, _ in cameras])
        self._commands = self.create_publisher(_COMMAND_TYPES[self._command_type], "cmd_vel", 1)
        self._quantiles = self.create_publisher(Float32MultiArray, "return_quantiles", 1)
        self._status = self.create_publisher(String, "drive_status", 1)
        self._said: str | None = None
        self._reported = ""
        self.create_timer(sum(config.period_s) / 2.0, self._drive)
        self.create_timer(_REPORT_PERIOD_S, self._report)

    def _given(self, name: str, default: Any) -> Any:
        """Declare a parameter, and return its value."""
        return self.declare_parameter(name, default).value

    def _mount(self) -> Mount | None:
        """Return where the scanner is said to sit; None where /tf is to say it. NaN stands for not said."""
        place = [self._given(f"laser_{name}", math.nan) for name in ("x_m", "y_m", "yaw_rad")]
        upside_down = self._given("laser_upside_down", False)
        if all(math.isnan(value) for value in place) and not upside_down:
            return None
        x_m, y_m, yaw_rad = (0.0 if math.isnan(value) else value for value in place)
        return Mount(x_m, y_m, yaw_rad, upside_down)

    def _cameras(self) -> list[tuple[str, str, float]]:
        """Return frame, topic and horizontal field of view, rad, of each camera."""
        frames, topics = self._given("camera_frames", [""]), self._given("camera_topics", [""])
        views_rad = self._given("camera_views_rad", [math.nan])
        if list(frames) == [""]:  # ROS knows no type of an empty list
            return []
        if not len(frames) == len(topics) == len(views_rad):
            raise UserInputError(
                f"camera_frames has {len(frames)} entries, camera_topics {len(topics)}, camera_views_rad "
                f"{len(views_rad)}: give one a camera in each"
            )
        return list(zip(frames, topics, views_rad, strict=True))

    def _subscribe(self, cloud_topics: list[str]) -> None:
        driver = self.driver
        self.create_subscription(LaserScan, "scan", driver.on_scan, qos_profile_sensor_data)
        for topic in cloud_topics:
            self.create_subscription(PointCloud2, topic, driver.on_cloud, qos_profile_sensor_data)
        self.create_subscription(Odometry, "odom", driver.on_odometry, qos_profile_sensor_data)
        self.create_subscription(Path, "plan", driver.on_path, 1)
        self.create_subscription(TFMessage, "/tf", driver.on_transforms, _TF_QOS)
        self.create_subscription(TFMessage, "/tf_static", partial(driver.on_transforms, static=True), _STATIC_TF_QOS)
        self.create_subscription(PoseWithCovarianceStamped, "pose", driver.on_pose, 1)
        if driver.policy.navigator is not None:
            self.create_subscription(OccupancyGrid, "map", driver.on_map, _KEPT_QOS)

    def _set(self, parameters: list[Parameter]) -> SetParametersResult:
        """Take live parameters over; none of them where the agent would not drive with this beta."""
        given = {parameter.name: parameter.value for parameter in parameters}
        if "beta" in given:
            beta = None if math.isnan(given["beta"]) else float(given["beta"])
            try:
                self.driver.policy.check_beta(beta)
            except UserInputError as error:
                return SetParametersResult(successful=False, reason=str(error))
            self.driver.beta = beta
        if "stop" in given:
            (self.driver.policy.stop if given["stop"] else self.driver.policy.resume)()
        return SetParametersResult(successful=True)

    def leave(self) -> None:
        """Send a last command, to stand, and wait until it has come."""
        self._write(self.driver.policy.refuse("the node leaves"), self._now_s())
        self._commands.wait_for_all_acked(Duration(seconds=_LAST_S))

    def _now_s(self) -> float:
        return float(self.get_clock().now().nanoseconds) * 1e-9

    def _write(self, command: Command, now_s: float) -> None:
        stamped = self._command_type == "TwistStamped"
        self._commands.publish(twist_stamped(command, now_s, _made) if stamped else twist(command, _made))

    def _drive(self) -> None:
        now_s = self._now_s()
        command = self.driver.command(now_s)
        self._write(command, now_s)
        if command.quantiles is not None:
            self._quantiles.publish(Float32MultiArray(data=command.quantiles.tolist()))
        self._status.publish(String(data=command.reason or DRIVING))
        kind = without_numbers(command.reason)
        if kind != self._said and command.reason is not None:
            self.get_logger().warning(command.reason)
        self._said = kind

    def _report(self) -> None:
        """Tell who reads the commands, as which type, and which needed topics nobody writes, whenever it changes."""
        readers = [found.topic_type for found in self.get_subscriptions_info_by_topic("cmd_vel")]
        kind = f"geometry_msgs/msg/{self._command_type}"
        said = [readers_of("cmd_vel", [kind], readers)]
        if readers and kind not in readers:
            said.append(f"the parameter command_type chooses another of {', '.join(_COMMAND_TYPES)}")
        for topic, needed in self._needed.items():
            writers = [found.topic_type for found in self.get_publishers_info_by_topic(topic)]
            said.append(writers_of(topic, needed, writers) or "")
        if self.driver.lacks_map:
            writers = [found.topic_type for found in self.get_publishers_info_by_topic("map")]
            said.append(no_map_on("map", writers))
        report = "; ".join(filter(None, said))
        if report != self._reported:
            self.get_logger().info(report)
        self._reported = report


def _made(name: str) -> Any:
    """Return an empty message of a type such as ``"geometry_msgs/msg/TwistStamped"``."""
    package, kind = name.rsplit("/", 1)
    return getattr(importlib.import_module(package.replace("/", ".")), kind)()


def _end(signal_number: int, frame: FrameType | None) -> None:
    """End the spinning, once: a second signal, which launch files send, would end the sending of the last command."""
    for number in ending_signals():
        signal.signal(number, signal.SIG_IGN)
    raise KeyboardInterrupt


def main() -> None:
    """Spin until Ctrl-C, SIGTERM, SIGHUP or an error, and leave the robot standing."""
    # Handlers of its own would shut ROS down at once, and no last command could be sent.
    rclpy.init(signal_handler_options=SignalHandlerOptions.NO)
    for number in ending_signals():
        signal.signal(number, _end)
    try:
        node = PolicyNode()
    except UserInputError as error:
        rclpy.try_shutdown()
        print(error, file=sys.stderr)
        raise SystemExit(2) from None
    with contextlib.ExitStack() as ending:
        ending.callback(rclpy.try_shutdown)
        ending.callback(node.destroy_node)
        ending.callback(node.leave)
        with contextlib.suppress(KeyboardInterrupt):
            rclpy.spin(node)


if __name__ == "__main__":
    main()
