"""Drive a robot over DDS, without ROS: ``python -m rcdsac_trl.deploy.dds_node <name or folder>``.

For robots whose ROS 2 runs on CycloneDDS. It reads ``scan`` (or clouds), ``odom``, ``plan``, ``tf``, ``tf_static`` and,
for detours, ``map``. It writes ``cmd_vel`` (as ``geometry_msgs/TwistStamped`` and as ``geometry_msgs/Twist``), the
return's quantiles on ``return_quantiles``, and on ``drive_status`` why the robot does not go as the agent would.
``beta`` (``std_msgs/Float64``) and ``stop`` (``std_msgs/Bool``) are topics, and may be sent while it runs. It needs
``cyclonedds``, an extra: ``pip install 'rcdsac-trl[dds]'``.
"""

import argparse
import contextlib
import importlib.util
import os
import signal
import sys
import time
from collections.abc import Iterator
from types import FrameType
from typing import TYPE_CHECKING, get_args

import rcdsac_trl
from rcdsac_trl.deploy.frames.robot_frames import FrameSettings, Localisation
from rcdsac_trl.deploy.policy.driver import Driver
from rcdsac_trl.deploy.ros.endings import ending_signals
from rcdsac_trl.deploy.ros.topics import without_numbers
from rcdsac_trl.deploy.sensors.scan import Meaning
from rcdsac_trl.errors import UserInputError
from rcdsac_trl.robot.sectors import Mount

if TYPE_CHECKING:
    from rcdsac_trl.deploy.ros.dds_bridge import DdsBridge

# Every so many commands, about 2 s, it looks who is at the other end of the topics.
_REPORT_EVERY = 15
# So often it looks for the simulated clock, s.
_LOOK_S = 0.002
_LARGEST_DOMAIN = 232  # the ports of larger ones are beyond the last


def main(arguments: list[str] | None = None) -> None:
    """Drive until Ctrl-C, SIGTERM or SIGHUP, and leave the robot standing.

    Args:
        arguments: of the command line; None: those of this process.
    """
    args = _parser().parse_args(arguments)
    try:
        bridge = bridge_of(args)
    except UserInputError as error:
        print(f"rcdsac_trl: {error}", file=sys.stderr)
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
    driver = Driver(
        rcdsac_trl.load(args.agent, latency_s=args.latency),
        mount=_mount(args),
        cameras={frame: _view_rad(frame, view) for frame, _, view in args.camera},
        zero_means=args.zero_means,
        nan_means=args.nan_means,
        frames=FrameSettings(args.localisation, args.localisation_timeout, args.base_frame),
        detours=args.detours,
        watchdog=args.watchdog,
        plan_timeout_s=args.plan_timeout,
    )
    driver.policy.check_beta(args.beta)
    driver.beta = args.beta
    if args.stopped:
        driver.policy.stop()
    clouds = [topic for _, topic, _ in args.camera]
    return DdsBridge(driver, domain_id, remapped=remapped, clouds=clouds, simulated=args.use_sim_time)


def drive(bridge: "DdsBridge") -> None:
    """Step once in every control period, and tell on the standard error stream why the robot does not go as it would.

    Who reads the commands, and which topics nobody writes, is told as well, whenever it changes. Whatever ends it, an
    error too, the last command is to stand.

    Args:
        bridge: that drives; its clock is that of this computer, or the simulated one.
    """
    leaving = False

    def leave(signal_number: int, frame: FrameType | None) -> None:
        nonlocal leaving
        leaving = True

    for number in ending_signals():
        signal.signal(number, leave)
    _tell(f"topics: {', '.join(f'/{topic}' for topic in bridge.topics.values())}; Ctrl-C ends it")
    period_s = sum(bridge.driver.policy.config.period_s) / 2.0
    said: str | None = None
    reported, steps = "", 0
    now_s = 0.0
    try:
        for at_s in _simulated_ticks(bridge, period_s) if bridge.simulated else _ticks(period_s):
            if leaving:
                break
            steps += 1
            if steps % _REPORT_EVERY == 0 and (report := bridge.report()) != reported:
                _tell(report)
                reported = report
            if at_s is None:
                continue
            now_s = at_s
            command = bridge.step(now_s)
            kind = without_numbers(command.reason)
            if kind not in (said, None):
                _tell(str(command.reason))
            said = kind
    finally:
        bridge.leave(now_s if bridge.simulated else time.time())


def _ticks(period_s: float) -> Iterator[float]:
    """Yield the time once in every period; what was missed is not made up for."""
    due_s = time.monotonic()
    while True:
        yield time.time()
        due_s = max(due_s + period_s, time.monotonic())
        time.sleep(max(due_s - time.monotonic(), 0.0))


def _simulated_ticks(bridge: "DdsBridge", period_s: float) -> Iterator[float | None]:
    """Yield the simulated time once in every simulated period, and None where that takes as long by the wall."""
    last_s: float | None = None
    shortest_s = period_s - 1e-6  # differences of float seconds are a little less than what they should be
    while True:
        give_up_s = time.monotonic() + period_s
        while (now_s := bridge.simulated_s()) is None or (last_s is not None and 0.0 <= now_s - last_s < shortest_s):
            if time.monotonic() > give_up_s:
                now_s = None
                break
            time.sleep(_LOOK_S)
        last_s = last_s if now_s is None else now_s
        yield now_s


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        prog="python -m rcdsac_trl.deploy.dds_node",
        description="Drive a robot by its ROS 2 topics over CycloneDDS, without ROS. ROS_DOMAIN_ID and CYCLONEDDS_URI "
        "mean what they mean to ROS.",
    )
    parser.add_argument("agent", help="an exported folder, a run folder, or an agent that comes with the package")
    parser.add_argument("--beta", type=float, help="how much risk to take until the topic says otherwise")
    parser.add_argument("--stopped", action="store_true", help="stand until the topic stop says false")
    parser.add_argument(
        "--laser",
        type=float,
        nargs=3,
        metavar=("X_M", "Y_M", "YAW_RAD"),
        help="where the scanner sits, from the robot's centre; else as /tf says, or where the agent's robot has it",
    )
    parser.add_argument("--laser-upside-down", action="store_true", help="the scanner hangs")
    for reading in ("0", "NaN"):
        parser.add_argument(
            f"--{'zero' if reading == '0' else 'nan'}-means",
            choices=get_args(Meaning),
            default="invalid",
            help=f"what the scanner's driver means by a reading of {reading}",
        )
    parser.add_argument(
        "--camera",
        action="append",
        nargs=3,
        default=[],
        metavar=("FRAME", "TOPIC", "VIEW_RAD"),
        help="read clouds in this frame, whose place /tf knows, instead of scans; may be given several times",
    )
    parser.add_argument(
        "--localisation",
        choices=get_args(Localisation),
        default=FrameSettings.localisation,
        help="who says where the robot is in the plan's frame: /tf, or the topic pose",
    )
    parser.add_argument(
        "--localisation-timeout",
        type=float,
        default=FrameSettings.localisation_timeout_s,
        metavar="SECONDS",
        help="stand when the localisation's newest word is older (default: %(default)s; inf: never for that)",
    )
    parser.add_argument(
        "--plan-timeout",
        type=float,
        metavar="SECONDS",
        help="stand when the newest plan came longer ago, as after a goal was cancelled (default: plans do not age)",
    )
    parser.add_argument(
        "--detours",
        action="store_true",
        help="lead around what blocks the way for some seconds, and keep clear of what map shows",
    )
    parser.add_argument(
        "--watchdog",
        action="store_true",
        help="where the robot stands for some seconds, turn beta to its boldest, and at last back off",
    )
    parser.add_argument(
        "--latency",
        type=float,
        default=0.0,
        metavar="SECONDS",
        help="how late a command acts, which the agent then allows for (default: %(default)s)",
    )
    parser.add_argument("--base-frame", help="the robot's frame; else the odometry's child_frame_id")
    parser.add_argument("--use-sim-time", action="store_true", help="the clock is that of the topic clock")
    parser.add_argument(
        "--remap",
        action="append",
        default=[],
        metavar="NAME:=TOPIC",
        help="a topic that is called otherwise, such as plan:=/nav/path; may be given several times",
    )
    return parser


def _mount(args: argparse.Namespace) -> Mount | None:
    """Return where the scanner is said to sit; None where /tf is to say it."""
    if args.laser is None and not args.laser_upside_down:
        return None
    x_m, y_m, yaw_rad = args.laser or (0.0, 0.0, 0.0)
    return Mount(x_m, y_m, yaw_rad, args.laser_upside_down)


def _view_rad(frame: str, text: str) -> float:
    try:
        return float(text)
    except ValueError:
        raise UserInputError(f"--camera {frame}: a view of {text} is no number: give radians") from None


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
    """Say a sentence to whoever reads it: nobody where a pipe or a terminal is gone, which is no reason to stop."""
    with contextlib.suppress(OSError):
        print(sentence, file=sys.stderr, flush=True)


if __name__ == "__main__":
    main()
