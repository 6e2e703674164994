"""What a recording holds, looked through once before an agent is asked: so that what is missing is told at once."""

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from rcdsac_trl.config.replay_settings import ReplaySettings
from rcdsac_trl.deploy.frames.transform_buffer import TransformBuffer, named
from rcdsac_trl.deploy.recordings.sensor_recording import (
    COMMANDS,
    GOAL,
    ODOMETRY,
    PLAN,
    SCAN,
    TRANSFORMS,
    SensorRecording,
    needed_topic,
    topic_of,
)
from rcdsac_trl.deploy.ros import messages
from rcdsac_trl.deploy.sensors.arrays import described, numbers_of
from rcdsac_trl.errors import UserInputError
from rcdsac_trl.system.progress import Work

Waypoints = Literal["plan", "goal", "trajectory"]

# Recorders stamp with wall time what simulations, and other computers, stamp with a clock of their own.
_OTHER_CLOCK_S = 5.0
# A recording that says nothing for so long holds a wrong stamp, or two drives.
_LONGEST_SILENCE_S = 3600.0
# Odometry that has moved less is of a robot that stood.
_SHORTEST_WAY_M = 0.5
# Points of a trajectory that are nearer than this to the one before are left out.
_STEP_M = 0.05


@dataclass(frozen=True)
class Topics:
    """Which topics are read.

    Attributes:
        scan: with scans.
        odom: with odometry.
        plan: with plans, if any.
        goal: with goals, if any.
        command: with the commands that were given, if any.
        transforms: all with transforms; those called ``/tf_static`` hold for ever.
    """

    scan: str
    odom: str
    plan: str | None
    goal: str | None
    command: str | None
    transforms: tuple[str, ...]


@dataclass(frozen=True)
class Survey:
    """What was found.

    Attributes:
        topics: that are read.
        waypoints: where they come from.
        began_s: when both scans and odometry were there, in the stamps' clock.
        ended_s: when the last message came.
        offset_s: what the recorder's clock is ahead of the stamps'.
        trajectory: the way that odometry went, m, [n, 2].
        odom_frame: in which that is.
    """

    topics: Topics
    waypoints: Waypoints
    began_s: float
    ended_s: float
    offset_s: float
    trajectory: NDArray[np.float64]
    odom_frame: str


def topics_of(recording: SensorRecording, settings: ReplaySettings) -> Topics:
    """Find the topics by their types, or as the settings name them.

    Raises:
        UserInputError: if scans or odometry are missing, or it is not clear which is meant.
    """
    return Topics(
        scan=needed_topic(recording, "scan", SCAN, settings.scan),
        odom=needed_topic(recording, "odom", ODOMETRY, settings.odom),
        plan=topic_of(recording, "plan", (PLAN,), settings.plan) if settings.waypoints in ("auto", "plan") else None,
        goal=topic_of(recording, "goal", (GOAL,), settings.goal) if settings.waypoints in ("auto", "goal") else None,
        command=topic_of(recording, "command", COMMANDS, settings.command),
        transforms=tuple(topic for topic, kind in recording.topics.items() if kind in TRANSFORMS),
    )


def survey(recording: SensorRecording, settings: ReplaySettings) -> Survey:
    """Read a recording once.

    Raises:
        UserInputError: for whatever would keep an agent from being asked: no scan, readings of which nobody said what
            they mean, a scanner whose place is not known, a plan that nothing connects with odometry.
    """
    topics = topics_of(recording, settings)
    found = _Findings()
    read = {topics.scan, topics.odom, *topics.transforms, *filter(None, (topics.plan, topics.goal))}
    with Work(f"one look through {recording.path}", 1, "look"):
        for recorded in recording.messages(read):
            try:
                found.take(topics, recorded.topic, recorded.time_s, recorded.message)
            except Exception as error:  # what a message does when it is read is not ours to know
                raise UserInputError(
                    f"a message on {recorded.topic} of {recording.path} cannot be read ({described(error)}): give "
                    "another recording"
                ) from error
    found.check(topics, settings, recording)
    offset_s = float(np.median(found.offsets_s))
    offset_s = offset_s if abs(offset_s) > _OTHER_CLOCK_S else 0.0
    return Survey(
        topics=topics,
        waypoints=found.waypoints(settings, recording),
        began_s=max(found.first_s.values()) - offset_s,
        ended_s=found.last_s - offset_s,
        offset_s=offset_s,
        trajectory=np.array([*found.way, found.end]),
        odom_frame=found.odom_frame,
    )


class _Findings:
    """What the messages of a recording say, taken one by one."""

    def __init__(self) -> None:
        self.readings = {"zero_means": 0, "nan_means": 0, "all": 0}
        self.offsets_s: list[float] = []
        self.first_s: dict[str, float] = {}
        self.last_s = -math.inf
        self.silence_s, self.silent_from_s = 0.0, math.nan
        self.way: list[tuple[float, float]] = []
        self.end: tuple[float, float] = (math.nan, math.nan)
        self.odom_frame, self.base_frame, self.scan_frame = "", "", ""
        self.frames: dict[str, str] = {}
        self.transforms = TransformBuffer()

    def take(self, topics: Topics, topic: str, time_s: float, message: Any) -> None:
        if len(self.first_s) == 2 and time_s - self.last_s > self.silence_s:  # before, nobody is asked
            self.silence_s, self.silent_from_s = time_s - self.last_s, self.last_s
        self.last_s = max(self.last_s, time_s)
        if topic in (topics.scan, topics.odom):
            self.first_s.setdefault(topic, time_s)
        if topic == topics.scan:
            self._take_scan(time_s, message)
        elif topic == topics.odom:
            self._take_odometry(message)
        elif topic in topics.transforms:
            for stamped in message.transforms:
                # Only who hangs below whom: a static one per link is all that is kept.
                parent, child, _, transform = messages.transform_of(stamped)
                self.transforms.set(parent, child, 0.0, transform, static=True)
        elif topic == topics.goal or len(message.poses):
            self.frames["goal" if topic == topics.goal else "plan"] = named(str(message.header.frame_id))

    def _take_scan(self, time_s: float, message: Any) -> None:
        ranges = numbers_of(message.ranges, "the scan's ranges")
        self.readings["zero_means"] += int(np.count_nonzero(ranges == 0.0))
        self.readings["nan_means"] += int(np.count_nonzero(np.isnan(ranges)))
        self.readings["all"] += ranges.size
        self.offsets_s.append(time_s - messages.stamp_s(message))
        self.scan_frame = str(message.header.frame_id)

    def _take_odometry(self, message: Any) -> None:
        x, y, _ = messages.pose_of_odometry(message)
        if not self.way or math.dist(self.way[-1], (x, y)) >= _STEP_M:
            self.way.append((x, y))
        self.end = (x, y)
        self.odom_frame = named(str(message.header.frame_id))
        self.base_frame = str(getattr(message, "child_frame_id", "")) or "base_link"

    def check(self, topics: Topics, settings: ReplaySettings, recording: SensorRecording) -> None:
        """Refuse what nobody can be asked on."""
        for topic in (topics.scan, topics.odom):
            if topic not in self.first_s:
                raise UserInputError(f"{recording.path} has no message on {topic}: name another topic")
        if self.silence_s > _LONGEST_SILENCE_S:
            since_s = self.silent_from_s - max(self.first_s.values())
            raise UserInputError(
                f"{recording.path} says nothing for {self.silence_s:.0f} s, from {since_s:.1f} s on, more than "
                f"{_LONGEST_SILENCE_S:g} s: is a stamp wrong there? Else cut it in two"
            )
        for key, read in (("zero_means", "0"), ("nan_means", "NaN")):
            if self.readings[key] and getattr(settings, key) is None:
                share = self.readings[key] / self.readings["all"]
                raise UserInputError(
                    f"{share:.1%} of the readings on {topics.scan} are {read}, and drivers mean different things by "
                    f"it: say {key}=far (nothing is there), {key}=near (something is before range_min) or "
                    f"{key}=invalid (no measurement)"
                )
        if settings.laser is None and topics.transforms and not self._is_mounted():
            raise UserInputError(
                f"no transform of {recording.path} says where the scanner's frame {self.scan_frame!r} sits on "
                f"{self.base_frame!r}: give laser=[<x in m>,<y in m>,<yaw in rad>]"
            )

    def _is_mounted(self) -> bool:
        return self.transforms.connects(self.base_frame, self.scan_frame)

    def waypoints(self, settings: ReplaySettings, recording: SensorRecording) -> Waypoints:
        """Return where the waypoints come from."""
        choices: tuple[Waypoints, ...] = ("plan", "goal")
        for choice in choices:
            if settings.waypoints not in ("auto", choice):
                continue
            if choice in self.frames:
                frame = self.frames[choice]
                if not self.transforms.connects(frame, self.odom_frame):
                    raise UserInputError(
                        f"the {choice} of {recording.path} is in frame {frame!r}, and no transform there connects it "
                        f"with {self.odom_frame!r}: waypoints=trajectory follows the way that was driven"
                    )
                return choice
            if settings.waypoints == choice:
                raise UserInputError(f"{recording.path} has no {choice}: leave waypoints={choice} out")
        length_m = sum(math.dist(a, b) for a, b in zip(self.way[:-1], self.way[1:], strict=True))
        if length_m < _SHORTEST_WAY_M:
            raise UserInputError(
                f"the robot of {recording.path} moved by {length_m:.2f} m, less than {_SHORTEST_WAY_M:g} m, and there "
                "is no plan or goal: nobody knows where to go, give another recording"
            )
        return "trajectory"


def kinds_of(topics: Topics, recording: SensorRecording) -> Mapping[str, str]:
    """Return the type of each topic that is read, by what it is read as."""
    names = {name: getattr(topics, name) for name in ("scan", "odom", "plan", "goal", "command")}
    return {f"{name} {topic}": recording.topics[topic] for name, topic in names.items() if topic is not None}
