"""An agent is asked, period by period, what it would have done where somebody else's robot was."""

import math
from collections.abc import Iterator
from dataclasses import dataclass
from types import SimpleNamespace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rcdsac_trl.config.replay_settings import ReplaySettings
from rcdsac_trl.deploy.frames.transform_buffer import named
from rcdsac_trl.deploy.policy.command import Command
from rcdsac_trl.deploy.policy.driver import Driver, Situation
from rcdsac_trl.deploy.policy.policy import Policy
from rcdsac_trl.deploy.recordings.sensor_recording import SensorRecording
from rcdsac_trl.deploy.ros import messages
from rcdsac_trl.deploy.ros.topics import without_numbers
from rcdsac_trl.deploy.sensors.scan import Scan, scan_sectors
from rcdsac_trl.evaluation.recording_survey import Survey
from rcdsac_trl.robot.range_sensor import BIN_RAD
from rcdsac_trl.robot.sectors import Sectors

_STATIC = "/tf_static"


@dataclass(frozen=True)
class RecordedPeriod:
    """What an agent said in a period, and what happened then.

    Attributes:
        time_s: since the recording began.
        command: what it would have done.
        situation: on which it was asked; None where it was not.
        sectors: what the sensor said there; None where the robot was to stand.
        measured: velocities by odometry, m/s and rad/s.
        recorded: what the robot was told then, m/s and rad/s; NaN where nobody told it anything.
    """

    time_s: float
    command: Command
    situation: Situation | None
    sectors: Sectors | None
    measured: tuple[float, float]
    recorded: tuple[float, float]


class RecordedDrive:
    """Feeds a recording to an agent, as its robot's messages would have come.

    Nothing moves by what the agent says: each command is for the place where the recorded robot was, whatever was said
    before. Its memory is of what the sensors saw, and the commands that it is told of are its own.

    Args:
        recording: of the robot.
        found: what the recording holds.
        policy: that is asked.
        settings: of the replay.
    """

    def __init__(self, recording: SensorRecording, found: Survey, policy: Policy, settings: ReplaySettings) -> None:
        self._recording = recording
        self._found = found
        self.period_s = sum(policy.config.period_s) / 2.0
        self._driver = Driver(
            policy,
            mount=settings.mount or recording.mount,
            zero_means=settings.zero_means or "invalid",
            nan_means=settings.nan_means or "invalid",
        )
        self._driver.beta = settings.beta
        self._measured, self._recorded = (math.nan, math.nan), (math.nan, math.nan)

    @property
    def num_periods(self) -> int:
        """How many periods the recording has."""
        return max(1, math.ceil((self._found.ended_s - self._found.began_s) / self.period_s))

    def periods(self) -> Iterator[RecordedPeriod]:
        """Yield every period of the recording.

        Raises:
            UserInputError: if it cannot be read to the end.
        """
        found, topics = self._found, self._found.topics
        if found.waypoints == "trajectory":
            self._driver.on_path(path_message(found.trajectory, found.odom_frame))
        read = {topics.scan, topics.odom, *topics.transforms}
        read |= {topic for topic in (topics.command, getattr(topics, found.waypoints, None)) if topic is not None}
        number = 0
        for recorded in self._recording.messages(read):
            time_s = recorded.time_s - found.offset_s
            while time_s > (due_s := found.began_s + number * self.period_s):
                yield self._period(due_s)
                number += 1
            self._take(recorded.topic, recorded.message)
        yield self._period(found.began_s + number * self.period_s)

    def _take(self, topic: str, message: Any) -> None:
        driver, topics = self._driver, self._found.topics
        if topic == topics.scan:
            driver.on_scan(message)
        elif topic == topics.odom:
            driver.on_odometry(message)
            self._measured = messages.velocity_of_odometry(message)
        elif topic == topics.command:
            told = getattr(message, "twist", message)
            self._recorded = float(told.linear.x), float(told.angular.z)
        elif topic in topics.transforms:
            driver.on_transforms(self._without_odometry(message), static=topic == _STATIC)
        elif topic == topics.plan:
            driver.on_path(message)
        else:
            driver.on_path(SimpleNamespace(header=message.header, poses=[message]))

    def _without_odometry(self, message: Any) -> Any:
        """Leave out where ``/tf`` says the robot is, if the way is that of the odometry's own messages."""
        if self._found.waypoints != "trajectory":
            return message
        kept = [part for part in message.transforms if named(str(part.header.frame_id)) != self._found.odom_frame]
        return SimpleNamespace(transforms=kept)

    def _period(self, now_s: float) -> RecordedPeriod:
        command = self._driver.command(now_s)
        situation = self._driver.situation
        return RecordedPeriod(
            now_s - self._found.began_s,
            command,
            situation,
            None if command.stopped or situation is None else self._sectors(situation.ranges),
            self._measured,
            self._recorded,
        )

    def _sectors(self, ranges: Scan | Sectors) -> Sectors:
        """Return what the sensor said as the agent's robot reads it."""
        if not isinstance(ranges, Scan):
            return ranges
        robot = self._driver.policy.robot
        return scan_sectors(ranges, body_radius_m=robot.body_radius_m, max_range_m=robot.lidar.max_range_m)


def row_of(period: RecordedPeriod) -> dict[str, Any]:
    """Return a period as a row of ``commands.csv``."""
    command, situation, nothing = period.command, period.situation, (math.nan, math.nan)
    pose = (math.nan, math.nan, math.nan) if situation is None else situation.pose
    waypoint = nothing if situation is None else tuple(situation.waypoints[0].tolist())
    wanted = nothing if command.wanted is None else command.wanted
    row: dict[str, Any] = {"time_s": period.time_s}
    for name, (v, omega) in (
        ("", (command.v_m_per_s, command.omega_rad_per_s)),
        ("wanted_", wanted),
        ("measured_", period.measured),
        ("recorded_", period.recorded),
    ):
        row |= {f"{name}v_m_per_s": v, f"{name}omega_rad_per_s": omega}
    row |= {
        "stopped": int(command.stopped),
        "fresh": int(command.fresh),
        "cause": without_numbers(command.reason) or "",
        "reason": command.reason or "",
        "value": math.nan if command.value is None else command.value,
        "nearest_m": math.nan if period.sectors is None else float(period.sectors.distances_m.min()),
    }
    row |= dict(zip(("x_m", "y_m", "yaw_rad"), pose, strict=True))
    row |= dict(zip(("waypoint_ahead_m", "waypoint_left_m"), waypoint, strict=True))
    quantiles = [] if command.quantiles is None else command.quantiles.tolist()
    return row | {f"q{number}": value for number, value in enumerate(quantiles)}


def seen_from(period: RecordedPeriod) -> NDArray[np.float64]:
    """Return where the sensors saw something, m, in the path's frame, [n, 2]."""
    if period.situation is None or period.sectors is None:
        return np.empty((0, 2))
    x, y, yaw = period.situation.pose
    distances_m = period.sectors.distances_m
    hits = np.flatnonzero(np.isfinite(distances_m))
    angles = yaw + (hits + 0.5) * BIN_RAD
    return np.stack([x + distances_m[hits] * np.cos(angles), y + distances_m[hits] * np.sin(angles)], axis=1)


def path_message(points: NDArray[np.float64], frame: str) -> Any:
    """Return what has the fields of a ``nav_msgs/Path``, of points in m, [n, 2]."""
    places = [SimpleNamespace(position=SimpleNamespace(x=x, y=y)) for x, y in points.tolist()]
    return SimpleNamespace(
        header=SimpleNamespace(frame_id=frame, stamp=SimpleNamespace(sec=0, nanosec=0)),
        poses=[SimpleNamespace(pose=place) for place in places],
    )
