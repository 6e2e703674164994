"""A ROS 2 node around :class:`~rcdsac_trl.deploy.policy.driver.Driver`; the one file that needs ``rclpy``.

Run it where ROS 2 is sourced: ``python -m rcdsac_trl.deploy.ros_node --ros-args -p agent:=<name or folder>``.
It reads ``scan``, ``odom`` and ``plan``, writes ``cmd_vel`` (``geometry_msgs/TwistStamped``, or ``Twist`` with the
parameter ``command_type``) and the return's quantiles on ``return_quantiles``. ``beta`` and ``stop`` may be set while
it runs; ``zero_means`` says what the scanner's driver means by a reading of 0.
"""

import importlib
import math
import sys
from typing import Any

import rclpy
from geometry_msgs.msg import Twist, TwistStamped
from nav_msgs.msg import Odometry, Path
from rcl_interfaces.msg import SetParametersResult
from rclpy.node import Node
from rclpy.parameter import Parameter
from rclpy.qos import qos_profile_sensor_data
from sensor_msgs.msg import LaserScan
from std_msgs.msg import Float32MultiArray

import rcdsac_trl
from rcdsac_trl.deploy.policy.driver import Driver
from rcdsac_trl.deploy.ros.messages import twist, twist_stamped
from rcdsac_trl.deploy.ros.topics import readers_of, writers_of
from rcdsac_trl.deploy.sensors.sectors import Mount, mount_of
from rcdsac_trl.errors import UserInputError

# One node writes a topic as one type: not every middleware of ROS knows two of one name.
_COMMAND_TYPES = {"TwistStamped": TwistStamped, "Twist": Twist}
_NEEDED = {"scan": "sensor_msgs/msg/LaserScan", "odom": "nav_msgs/msg/Odometry", "plan": "nav_msgs/msg/Path"}
_REPORT_PERIOD_S = 2.0


class PolicyNode(Node):
    """Drives by a policy; every parameter is read at the start but ``beta`` and ``stop``, which are live."""

    def __init__(self) -> None:
        super().__init__("rcdsac_trl")
        agent = str(self.declare_parameter("agent", "").value)
        upside_down = bool(self.declare_parameter("laser_upside_down", False).value)
        zero_means = self.declare_parameter("zero_means", "unknown").value
        self._command_type = str(self.declare_parameter("command_type", "TwistStamped").value)
        if self._command_type not in _COMMAND_TYPES:
            raise UserInputError(
                f"command_type={self._command_type} is not one of {', '.join(_COMMAND_TYPES)}: choose one"
            )
        policy = rcdsac_trl.load(agent)
        own = mount_of(policy.robot.lidar)
        places = {"x_m": own.x_m, "y_m": own.y_m, "yaw_rad": own.yaw_rad}
        x_m, y_m, yaw_rad = (self.declare_parameter(f"laser_{name}", value).value for name, value in places.items())
        self.driver = Driver(policy, mount=Mount(x_m, y_m, yaw_rad, upside_down), zero_means=zero_means)
        config = self.driver.policy.config
        # NaN stands for the agent's own default: ROS parameters know no null.
        self.declare_parameter("beta", math.nan)
        self.declare_parameter("stop", False)
        self.add_on_set_parameters_callback(self._set)
        self._set([self.get_parameter("beta"), self.get_parameter("stop")])
        self.create_subscription(LaserScan, "scan", self.driver.on_scan, qos_profile_sensor_data)
        self.create_subscription(Odometry, "odom", self.driver.on_odometry, qos_profile_sensor_data)
        self.create_subscription(Path, "plan", self.driver.on_path, 1)
        self._commands = self.create_publisher(_COMMAND_TYPES[self._command_type], "cmd_vel", 1)
        self._quantiles = self.create_publisher(Float32MultiArray, "return_quantiles", 1)
        self._said: str | None = None
        self._reported = ""
        self.create_timer(sum(config.period_s) / 2.0, self._drive)
        self.create_timer(_REPORT_PERIOD_S, self._report)

    def _set(self, parameters: list[Parameter]) -> SetParametersResult:
        for parameter in parameters:
            if parameter.name == "beta":
                self.driver.beta = None if math.isnan(parameter.value) else float(parameter.value)
            elif parameter.name == "stop":
                (self.driver.policy.stop if parameter.value else self.driver.policy.resume)()
        return SetParametersResult(successful=True)

    def _drive(self) -> None:
        now_s = self.get_clock().now().nanoseconds * 1e-9
        command = self.driver.command(now_s)
        stamped = self._command_type == "TwistStamped"
        self._commands.publish(twist_stamped(command, now_s, _made) if stamped else twist(command, _made))
        if command.quantiles is not None:
            self._quantiles.publish(Float32MultiArray(data=command.quantiles.tolist()))
        if command.reason != self._said and command.reason is not None:
            self.get_logger().warning(command.reason)
        self._said = command.reason

    def _report(self) -> None:
        """Tell who reads the commands, as which type, and which needed topics nobody writes, whenever it changes."""
        readers = [found.topic_type for found in self.get_subscriptions_info_by_topic("cmd_vel")]
        kind = f"geometry_msgs/msg/{self._command_type}"
        said = [readers_of("cmd_vel", [kind], readers)]
        if readers and kind not in readers:
            said.append(f"the parameter command_type chooses another of {', '.join(_COMMAND_TYPES)}")
        for topic, needed in _NEEDED.items():
            writers = [found.topic_type for found in self.get_publishers_info_by_topic(topic)]
            said.append(writers_of(topic, needed, writers) or "")
        report = "; ".join(filter(None, said))
        if report != self._reported:
            self.get_logger().info(report)
        self._reported = report


def _made(name: str) -> Any:
    """Return an empty message of a type such as ``"geometry_msgs/msg/TwistStamped"``."""
    package, kind = name.rsplit("/", 1)
    return getattr(importlib.import_module(package.replace("/", ".")), kind)()


def main() -> None:
    """Spin until Ctrl-C."""
    rclpy.init()
    try:
        node = PolicyNode()
    except UserInputError as error:
        rclpy.try_shutdown()
        print(error, file=sys.stderr)
        raise SystemExit(2) from None
    try:
        rclpy.spin(node)
    finally:
        node.destroy_node()
        rclpy.try_shutdown()


if __name__ == "__main__":
    main()
