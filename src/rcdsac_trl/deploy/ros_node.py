"""A ROS 2 node around :class:`~rcdsac_trl.deploy.policy.driver.Driver`; the one file that needs ``rclpy``.

Run it where ROS 2 is sourced: ``python -m rcdsac_trl.deploy.ros_node --ros-args -p agent:=<name or folder>``.
It reads ``scan``, ``odom`` and ``plan``, writes ``cmd_vel`` (``geometry_msgs/TwistStamped``) and the return's quantiles
on ``return_quantiles``. ``beta`` and ``stop`` may be set while it runs.
"""

import importlib
import math
from typing import Any

import rclpy
from geometry_msgs.msg import TwistStamped
from nav_msgs.msg import Odometry, Path
from rcl_interfaces.msg import SetParametersResult
from rclpy.node import Node
from rclpy.parameter import Parameter
from rclpy.qos import qos_profile_sensor_data
from sensor_msgs.msg import LaserScan
from std_msgs.msg import Float32MultiArray

import rcdsac_trl
from rcdsac_trl.deploy.policy.driver import Driver
from rcdsac_trl.deploy.ros.messages import twist_stamped
from rcdsac_trl.deploy.sensors.sectors import Mount


class PolicyNode(Node):
    """Drives by a policy; every parameter is read at the start but ``beta`` and ``stop``, which are live."""

    def __init__(self) -> None:
        super().__init__("rcdsac_trl")
        agent = str(self.declare_parameter("agent", "").value)
        x_m, y_m, yaw_rad = (self.declare_parameter(f"laser_{name}", 0.0).value for name in ("x_m", "y_m", "yaw_rad"))
        upside_down = bool(self.declare_parameter("laser_upside_down", False).value)
        self.driver = Driver(rcdsac_trl.load(agent), mount=Mount(x_m, y_m, yaw_rad, upside_down))
        config = self.driver.policy.config
        # NaN stands for the agent's own default: ROS parameters know no null.
        self.declare_parameter("beta", math.nan)
        self.declare_parameter("stop", False)
        self.add_on_set_parameters_callback(self._set)
        self._set([self.get_parameter("beta"), self.get_parameter("stop")])
        self.create_subscription(LaserScan, "scan", self.driver.on_scan, qos_profile_sensor_data)
        self.create_subscription(Odometry, "odom", self.driver.on_odometry, qos_profile_sensor_data)
        self.create_subscription(Path, "plan", self.driver.on_path, 1)
        self._commands = self.create_publisher(TwistStamped, "cmd_vel", 1)
        self._quantiles = self.create_publisher(Float32MultiArray, "return_quantiles", 1)
        self._said: str | None = None
        self.create_timer(sum(config.period_s) / 2.0, self._drive)

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
        self._commands.publish(twist_stamped(command, now_s, _made))
        if command.quantiles is not None:
            self._quantiles.publish(Float32MultiArray(data=command.quantiles.tolist()))
        if command.reason != self._said and command.reason is not None:
            self.get_logger().warning(command.reason)
        self._said = command.reason


def _made(name: str) -> Any:
    """Return an empty message of a type such as ``"geometry_msgs/msg/TwistStamped"``."""
    package, kind = name.rsplit("/", 1)
    return getattr(importlib.import_module(package.replace("/", ".")), kind)()


def main() -> None:
    """Spin until Ctrl-C."""
    rclpy.init()
    node = PolicyNode()
    try:
        rclpy.spin(node)
    finally:
        node.destroy_node()
        rclpy.try_shutdown()


if __name__ == "__main__":
    main()
