"""Drive a robot over DDS, without ROS: ``python -m rcdsac_trl.deploy.dds_node <name or folder>``.

For robots whose ROS 2 runs on CycloneDDS. It reads ``scan``, ``odom`` and ``plan``, and writes ``cmd_vel``
(as ``geometry_msgs/TwistStamped`` and as ``geometry_msgs/Twist``) and the return's quantiles on ``return_quantiles``.
``beta`` (``std_msgs/Float64``) and ``stop`` (``std_msgs/Bool``) are topics, and may be sent while it runs. It needs
``cyclonedds``, an extra: ``pip install 'rcdsac-trl[dds]'``.
"""

import argparse
import importlib.util
import os
import signal
import sys
import time
from types import FrameType
from typing import TYPE_CHECKING, get_args

import rcdsac_trl
from rcdsac_trl.deploy.policy.driver import Driver
from rcdsac_trl.deploy.sensors.scan import ZeroMeans
from rcdsac_trl.deploy.sensors.sectors import Mount, mount_of
from rcdsac_trl.errors import UserInputError

if TYPE_CHECKING:
    from rcdsac_trl.deploy.ros.dds_bridge import DdsBridge

# Every so many commands, about 2 s, it looks who is at the other end of the topics.
_REPORT_EVERY = 15
_LARGEST_DOMAIN = 232  # the ports of larger ones are beyond the last


def main(arguments: list[str] | None = None) -> None:
    """Drive until Ctrl-C or SIGTERM, and leave the robot standing.

    Args:
        arguments: of the command line; None: those of this process.
    """
    args = _parser().parse_args(arguments)
    try:
        bridge = bridge_of(args)
    except UserInputError as error:
        print(error, file=sys.stderr)
        raise SystemExit(2) from None
    drive(bridge)


def bridge_of(args: argparse.Namespace) -> "DdsBridge":
    """Load the agent and join DDS.

    Raises:
        UserInputError: if anything that was asked for cannot be.
    """
    if importlib.util.find_spec("cyclonedds") is None:
        raise UserInputError("DDS needs cyclonedds, which is not installed: pip install 'rcdsac-trl[dds]'")
    from rcdsac_trl.deploy.ros.dds_bridge import DdsBridge

    domain_id = _domain_id(os.environ.get("ROS_DOMAIN_ID") or "0")
    remapped = dict(_renaming(text) for text in args.remap)
    policy = rcdsac_trl.load(args.agent)
    own = mount_of(policy.robot.lidar)
    x_m, y_m, yaw_rad = args.laser or (own.x_m, own.y_m, own.yaw_rad)
    mount = Mount(x_m, y_m, yaw_rad, args.laser_upside_down)
    driver = Driver(policy, mount=mount, zero_means=args.zero_means)
    driver.policy.check_beta(args.beta)
    driver.beta = args.beta
    return DdsBridge(driver, domain_id, remapped=remapped)


def drive(bridge: "DdsBridge") -> None:
    """Step once in every control period, and tell on the standard error stream why the robot does not go as it would.

    Who reads the commands, and which topics nobody writes, is told as well, whenever it changes.

    Args:
        bridge: that drives; its clock is that of this computer.
    """
    leaving = False

    def leave(signal_number: int, frame: FrameType | None) -> None:
        nonlocal leaving
        leaving = True

    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, leave)
    _tell(f"topics: {', '.join(f'/{topic}' for topic in bridge.topics.values())}; Ctrl-C ends it")
    period_s = sum(bridge.driver.policy.config.period_s) / 2.0
    due_s = time.monotonic()
    said: str | None = None
    reported, steps = "", 0
    while not leaving:
        steps += 1
        if steps % _REPORT_EVERY == 0 and (report := bridge.report()) != reported:
            _tell(report)
            reported = report
        command = bridge.step(time.time())
        if command.reason not in (said, None):
            _tell(str(command.reason))
        said = command.reason
        due_s = max(due_s + period_s, time.monotonic())  # what was missed is not made up for
        time.sleep(max(due_s - time.monotonic(), 0.0))
    bridge.leave(time.time())


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        prog="python -m rcdsac_trl.deploy.dds_node",
        description="Drive a robot by its ROS 2 topics over CycloneDDS, without ROS. ROS_DOMAIN_ID and CYCLONEDDS_URI "
        "mean what they mean to ROS.",
    )
    parser.add_argument("agent", help="an exported folder, a run folder, or an agent that comes with the package")
    parser.add_argument("--beta", type=float, help="how much risk to take until the topic says otherwise")
    parser.add_argument(
        "--laser",
        type=float,
        nargs=3,
        metavar=("X_M", "Y_M", "YAW_RAD"),
        help="where the scanner sits, from the robot's centre; without it: where the agent's robot has it",
    )
    parser.add_argument("--laser-upside-down", action="store_true", help="the scanner hangs")
    parser.add_argument(
        "--zero-means",
        choices=get_args(ZeroMeans),
        default="unknown",
        help="what the scanner's driver means by a reading of 0",
    )
    parser.add_argument(
        "--remap",
        action="append",
        default=[],
        metavar="NAME:=TOPIC",
        help="a topic that is called otherwise, such as plan:=/nav/path; may be given several times",
    )
    return parser


def _renaming(text: str) -> tuple[str, str]:
    name, separator, topic = text.partition(":=")
    if not separator:
        raise UserInputError(f"--remap {text} cannot be read: write <name>:=<topic>, such as plan:=/nav/path")
    return name, topic


def _domain_id(text: str) -> int:
    if not (text.isascii() and text.isdigit() and int(text) <= _LARGEST_DOMAIN):
        raise UserInputError(f"ROS_DOMAIN_ID={text} is no domain: give a whole number from 0 to {_LARGEST_DOMAIN}")
    return int(text)


def _tell(sentence: str) -> None:
    print(sentence, file=sys.stderr, flush=True)


if __name__ == "__main__":
    main()
