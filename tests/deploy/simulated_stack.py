"""A robot, its localisation and its planner, as a program of its own that speaks ROS 2's topics over CycloneDDS.

``python simulated_stack.py <Twist or TwistStamped>`` drives a robot by what comes on ``/cmd_vel``, in simulated time:
each control period it says what its sensors see, moves the clock on, and waits for the command. Odometry drifts; the
localisation (``map -> odom``) begins late, corrects in steps, is wrong for a while, and is lost for a while; the plan
is in ``map``, and is published anew every second. It ends when the robot has stood at its goal, and prints what was.
"""

import json
import math
import os
import sys
import time
from typing import Any

from cyclonedds.core import Policy, Qos
from cyclonedds.domain import DomainParticipant
from cyclonedds.pub import DataWriter
from cyclonedds.sub import DataReader
from cyclonedds.topic import Topic
from walled_room import ANGLE_MIN_RAD, INCREMENT_RAD, ranges_m

from rcdsac_trl.deploy.frames.rigid_transform import RigidTransform
from rcdsac_trl.deploy.ros import dds_types as ros

PERIOD_S, MOTOR_S = 0.14, 0.02
START, GOAL = (1.0, 1.5, 0.6), (8.5, 4.5)
ACCELERATION = (1.5, math.radians(120.0))
# Odometry: distances 4 % too long, and a turn to the left that nobody made.
SCALE, BIAS_RAD_PER_S = 1.04, 0.01
# Localisation, simulated s: from when on, when it is off to the left by how much, when it is lost.
BEGINS_S, WRONG_S, WRONG_M, LOST_S = 1.0, (5.0, 6.5), 0.4, (8.0, 12.0)
LIMIT_S = 90.0
STANDS_STEPS = 12
# The scanner looks backwards: only /tf_static says so.
LASER = RigidTransform((0.1, 0.0, 0.2), (0.0, 0.0, 1.0, 0.0))
BEGAN_S = 1000.0


def reliable(*more: Any) -> Qos:
    return Qos(Policy.Reliability.Reliable(10**9), Policy.History.KeepLast(100), *more)


def header(now_s: float, frame: str) -> ros.Header:
    seconds, nanoseconds = divmod(round((BEGAN_S + now_s) * 1e9), 1_000_000_000)
    return ros.Header(ros.Time(seconds, nanoseconds), frame)


def stamped(now_s: float, parent: str, child: str, transform: RigidTransform) -> ros.TransformStamped:
    place, turn = ros.Vector3(*transform.translation_m), ros.Quaternion(*transform.rotation)
    return ros.TransformStamped(header(now_s, parent), child, ros.Transform(place, turn))


def scan(now_s: float, robot: RigidTransform) -> ros.LaserScan:
    """See the walls of the room, a ray a degree, from where the scanner is."""
    last = ANGLE_MIN_RAD + 359 * INCREMENT_RAD
    ranges = ranges_m(*(robot @ LASER).pose).tolist()
    stamp = header(now_s, "laser")
    return ros.LaserScan(stamp, ANGLE_MIN_RAD, last, INCREMENT_RAD, range_min=0.1, range_max=12.0, ranges=ranges)


class Robot:
    """Where it is, what its odometry believes, and how its commands move it."""

    def __init__(self) -> None:
        self.truth, self.odometry = RigidTransform.planar(*START), RigidTransform.planar(0.0, 0.0, 0.0)
        self.velocity = (0.0, 0.0)

    def move(self, command: tuple[float, float]) -> None:
        limits = zip(self.velocity, command, ACCELERATION, strict=True)
        v, omega = (now + max(-a * MOTOR_S, min(a * MOTOR_S, to - now)) for now, to, a in limits)
        self.velocity = v, omega
        self.truth = self.truth @ RigidTransform.planar(v * MOTOR_S, 0.0, omega * MOTOR_S)
        believed = (SCALE * v * MOTOR_S, 0.0, (omega + BIAS_RAD_PER_S * (v != 0.0)) * MOTOR_S)
        self.odometry = self.odometry @ RigidTransform.planar(*believed)

    def says(self, now_s: float) -> ros.Odometry:
        message = ros.Odometry(header(now_s, "odom"), "base_link")
        message.pose.pose.position = ros.Point(*self.odometry.translation_m)
        message.pose.pose.orientation = ros.Quaternion(*self.odometry.rotation)
        message.twist.twist.linear.x, message.twist.twist.angular.z = self.velocity
        return message


class Localisation:
    """Says every second where odometry starts from, and repeats it in every period."""

    def __init__(self) -> None:
        self.map_to_odom: RigidTransform | None = None
        self._due_s = BEGINS_S

    def says(self, now_s: float, robot: Robot) -> RigidTransform | None:
        if now_s >= self._due_s:
            self._due_s = now_s + 1.0
            off_m = WRONG_M if WRONG_S[0] <= now_s < WRONG_S[1] else 0.0
            found = robot.truth @ RigidTransform.planar(0.0, off_m, 0.0)
            self.map_to_odom = found @ robot.odometry.inverse()
        return None if LOST_S[0] <= now_s < LOST_S[1] else self.map_to_odom


def plan(now_s: float, here: tuple[float, float, float]) -> ros.Path:
    """Plan straight on from where the robot is believed to be, a point every 10 cm."""
    steps = max(round(math.dist(here[:2], GOAL) / 0.1), 1)
    points = [tuple(a + i / steps * (b - a) for a, b in zip(here[:2], GOAL, strict=True)) for i in range(steps + 1)]
    poses = [ros.PoseStamped(header(now_s, "map"), ros.Pose(ros.Point(*point))) for point in points]
    return ros.Path(header(now_s, "map"), poses)


class Stack:
    """The topics, and the loop."""

    def __init__(self, base: str) -> None:
        participant = DomainParticipant(int(os.environ["ROS_DOMAIN_ID"]))

        def writer(name: str, kind: Any, *more: Any) -> DataWriter:
            return DataWriter(participant, Topic(participant, f"rt/{name}", kind), reliable(*more))

        self.writers = {
            "scan": writer("scan", ros.LaserScan),
            "odom": writer("odom", ros.Odometry),
            "tf": writer("tf", ros.TFMessage),
            "tf_static": writer("tf_static", ros.TFMessage, Policy.Durability.TransientLocal),
            "plan": writer("plan", ros.Path),
            "clock": writer("clock", ros.Clock),
        }
        kind = getattr(ros, base)
        self.commands = DataReader(participant, Topic(participant, "rt/cmd_vel", kind), reliable())
        self.status = DataReader(participant, Topic(participant, "rt/drive_status", ros.String), reliable())

    def wait_for_the_node(self, most_s: float = 60.0) -> None:
        deadline = time.monotonic() + most_s
        ends = [*(writer.get_matched_subscriptions for writer in self.writers.values())]
        ends += [self.commands.get_matched_publications, self.status.get_matched_publications]
        while not all(matched() for matched in ends):
            if time.monotonic() > deadline:
                raise SystemExit("the node did not come")
            time.sleep(0.02)

    def command(self, now_s: float, most_s: float = 30.0) -> tuple[tuple[float, float], str]:
        """Move the clock on, and return what the node answers."""
        self.writers["clock"].write(ros.Clock(header(now_s, "").stamp))
        deadline = time.monotonic() + most_s
        status, message = "", None
        while not (status and message is not None):
            if time.monotonic() > deadline:
                raise SystemExit(f"no command came at {now_s:.2f} s")
            for sample in self.commands.take(10):
                message = sample
            for sample in self.status.take(10):
                status = sample.data
            time.sleep(0.001)
        twist = getattr(message, "twist", message)
        return (twist.linear.x, twist.angular.z), status

    def drive(self) -> list[dict[str, Any]]:
        """Drive until the robot has stood at the end, and return every period."""
        robot, localisation = Robot(), Localisation()
        self.writers["tf_static"].write(ros.TFMessage([stamped(0.0, "base_link", "laser", LASER)]))
        now_s, command, planned_s = 0.0, (0.0, 0.0), -math.inf
        periods: list[dict[str, Any]] = []
        while now_s < LIMIT_S:
            for step in range(round(PERIOD_S / MOTOR_S)):
                robot.move(command)
                now_s += MOTOR_S
                self.writers["tf"].write(ros.TFMessage([stamped(now_s, "odom", "base_link", robot.odometry)]))
                if step == 4:  # two motor steps before the clock moves on
                    self.writers["scan"].write(scan(now_s, robot.truth))
            self.writers["odom"].write(robot.says(now_s))
            map_to_odom = localisation.says(now_s, robot)
            if map_to_odom is not None:
                self.writers["tf"].write(ros.TFMessage([stamped(now_s, "map", "odom", map_to_odom)]))
                if now_s >= planned_s + 1.0:
                    planned_s = now_s
                    self.writers["plan"].write(plan(now_s, (map_to_odom @ robot.odometry).pose))
            command, status = self.command(now_s)
            x, y, _ = robot.truth.pose
            periods.append({"time_s": now_s, "command": command, "status": status, "x_m": x, "y_m": y})
            if now_s > LOST_S[1] and all(period["command"] == (0.0, 0.0) for period in periods[-STANDS_STEPS:]):
                break
        return periods


if __name__ == "__main__":
    stack = Stack(sys.argv[1])
    stack.wait_for_the_node()
    print(json.dumps(stack.drive()))
