"""Logs of CARMEN, the Carnegie Mellon robot navigation toolkit: lines of text, as many public data sets are.

Read are ``FLASER`` (or ``ROBOTLASER1``), ``ODOM`` and the ``PARAM`` lines that say how the scanner sits and how far it
reaches. A ``FLASER`` does not say its angles: it is half a turn, from the right to the left. A ``ROBOTLASER1`` says how
its scanner sits, too, by the poses of scanner and robot; the first one counts.
"""

import itertools
import math
from collections.abc import Collection, Iterator, Mapping
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np

from rcdsac_trl.deploy.recordings.sensor_recording import ODOMETRY, SCAN, RecordedMessage
from rcdsac_trl.errors import UserInputError
from rcdsac_trl.robot.planar import seen_from
from rcdsac_trl.robot.sectors import Mount

SCAN_TOPIC, ODOM_TOPIC = "/scan", "/odom"
KEYWORDS = frozenset({"FLASER", "RLASER", "ROBOTLASER1", "ODOM", "PARAM", "SYNC", "TRUEPOS", "RAWLASER1"})
"""What lines of such a log begin with; others, and those with #, are passed over."""

# What the laser scanners of these robots write where nothing is, and more.
_USUAL_RANGE_MAX_M = 80.0
# Velocities are differences where no ODOM line tells them: of poses that are at least so long apart.
_SHORTEST_S = 0.02


class CarmenLog:
    """A log as two topics: ``/scan`` and ``/odom``.

    Without ``ODOM`` lines the odometry is that which is written behind each scan, and velocities are its differences.

    Args:
        path: of the file.

    Raises:
        UserInputError: if no line is a scan, or one cannot be read.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        self._range_max_m = _USUAL_RANGE_MAX_M
        self.mount: Mount | None = Mount()
        first: dict[str, list[str]] = {}  # line of each kind
        for number, words in self._lines():
            first.setdefault(words[0], words)
            if words[0] == "PARAM" and len(words) > 2:
                self._take_parameter(number, words[1], words[2])
        self._scans = "ROBOTLASER1" if "FLASER" not in first else "FLASER"
        if self._scans in first and self._scans == "ROBOTLASER1":
            self.mount = _mount_of(first[self._scans]) or self.mount
        self._has_odometry = "ODOM" in first
        self.topics: Mapping[str, str] = {SCAN_TOPIC: SCAN, ODOM_TOPIC: ODOMETRY} if self._scans in first else {}
        if self._has_odometry:
            self.topics = {**self.topics, ODOM_TOPIC: ODOMETRY}

    def messages(self, topics: Collection[str]) -> Iterator[RecordedMessage]:
        """Yield scans and odometry in the order of the log.

        Raises:
            UserInputError: naming a line that cannot be read.
        """
        last: tuple[float, tuple[float, float, float]] | None = None
        moving = 0.0, 0.0
        for number, words in self._lines():
            try:
                if words[0] == "ODOM" and ODOM_TOPIC in topics:
                    x, y, yaw, v, omega, _, stamp_s = map(float, words[1:8])
                    yield RecordedMessage(stamp_s, ODOM_TOPIC, _odometry(stamp_s, (x, y, yaw), (v, omega)))
                elif words[0] == self._scans:
                    is_flaser = self._scans == "FLASER"
                    scan, pose, velocity, stamp_s = (
                        _flaser(words, self._range_max_m) if is_flaser else _robotlaser(words)
                    )
                    if not self._has_odometry and ODOM_TOPIC in topics:
                        if last is None or not 0.0 <= stamp_s - last[0] < _SHORTEST_S:
                            moving = (0.0, 0.0) if last is None else _difference(last, stamp_s, pose)
                            last = stamp_s, pose
                        yield RecordedMessage(stamp_s, ODOM_TOPIC, _odometry(stamp_s, pose, velocity or moving))
                    if SCAN_TOPIC in topics:
                        yield RecordedMessage(stamp_s, SCAN_TOPIC, scan)
            except (ValueError, IndexError, OverflowError) as error:
                raise UserInputError(
                    f"line {number} of {self.path} is no {words[0]} of CARMEN ({error}): give a whole log"
                ) from error

    def _take_parameter(self, number: int, name: str, value: str) -> None:
        try:
            if name in ("robot_front_laser_max", "robot_frontlaser_max"):
                self._range_max_m = float(value)
                if not self._range_max_m > 0.0:
                    raise ValueError("a reach is above 0 m")
            elif name in ("robot_frontlaser_offset", "robot_front_laser_offset"):
                self.mount = Mount(x_m=float(value))
        except ValueError as error:  # of a Mount, too
            raise UserInputError(f"line {number} of {self.path}: {name} {value} cannot be ({error})") from error

    def _lines(self) -> Iterator[tuple[int, list[str]]]:
        try:
            with self.path.open(encoding="utf-8", errors="replace") as lines:
                for number, line in enumerate(lines, 1):
                    words = line.split()
                    if words and words[0] in KEYWORDS:
                        yield number, words
        except OSError as error:
            raise UserInputError(f"{self.path} cannot be read ({error.strerror}): give another recording") from error


def is_carmen_log(path: Path, lines: int = 1000) -> bool:
    """Return whether one of the first lines of a file is of a CARMEN log.

    Raises:
        UserInputError: if it cannot be read.
    """
    try:
        with path.open(encoding="utf-8", errors="replace") as file:
            first = (line.split(maxsplit=1) for line in itertools.islice(file, lines))
            return any(words and words[0] in KEYWORDS for words in first)
    except OSError as error:
        raise UserInputError(f"{path} cannot be read ({error.strerror}): give another recording") from error


Read = tuple[Any, tuple[float, float, float], tuple[float, float] | None, float]


def _flaser(words: list[str], range_max_m: float) -> Read:
    """Read ``FLASER n r_1 .. r_n x y theta odom_x odom_y odom_theta ipc_timestamp host logger_timestamp``."""
    rays = int(words[1])
    if rays < 2:
        raise ValueError(f"{rays} readings make no half turn")
    ranges = [float(word) for word in words[2 : 2 + rays]]
    rest = words[2 + rays :]
    if len(ranges) < rays or len(rest) < 7:
        raise ValueError(f"it says {rays} readings and has {len(words) - 2} words behind")
    pose = (float(rest[3]), float(rest[4]), float(rest[5]))
    # 180 or 360 readings leave the last of half a turn out, 181 or 361 have it.
    increment = math.pi / (rays if rays % 2 == 0 else rays - 1)
    stamp_s = float(rest[6])
    return _scan(stamp_s, ranges, -math.pi / 2, increment, range_max_m), pose, None, stamp_s


def _robotlaser(words: list[str]) -> Read:
    """Read ``ROBOTLASER1``: angles, reach, n and readings, m and remissions, two poses, velocities, .., a stamp."""
    start, resolution, range_max_m = float(words[2]), float(words[4]), float(words[5])
    rays = int(words[8])
    ranges, rest = [float(word) for word in words[9 : 9 + rays]], _behind_readings(words)
    pose = (float(rest[3]), float(rest[4]), float(rest[5]))
    velocity = (float(rest[6]), float(rest[7]))
    stamp_s = float(rest[11])
    return _scan(stamp_s, ranges, start, resolution, range_max_m), pose, velocity, stamp_s


def _behind_readings(words: list[str]) -> list[str]:
    """Return what stands behind the readings and remissions of a ``ROBOTLASER1``."""
    rays = int(words[8])
    rest = words[10 + rays + int(words[9 + rays]) :]
    if len(rest) < 12:
        raise ValueError(f"it says {rays} readings and has {len(words) - 9} words behind")
    return rest


def _mount_of(words: list[str]) -> Mount | None:
    """Return where the scanner of a ``ROBOTLASER1`` sits; None if its poses say nothing of that."""
    try:
        x, y, yaw, *robot = map(float, _behind_readings(words)[:6])
        ahead_m, left_m = seen_from(np.array([[x, y]]), (robot[0], robot[1], robot[2]))[0].tolist()
        mount = Mount(ahead_m, left_m, math.remainder(yaw - robot[2], 2.0 * math.pi))
    except (ValueError, IndexError, OverflowError):  # not to be read, or poses in two frames: no mount is so far away
        return None
    return None if mount == Mount() else mount  # logs of robots that do not know write one pose twice


def _scan(stamp_s: float, ranges: list[float], angle_min: float, increment: float, range_max_m: float) -> Any:
    return SimpleNamespace(
        header=_header(stamp_s, "laser"),
        angle_min=angle_min,
        angle_max=angle_min + (len(ranges) - 1) * increment,
        angle_increment=increment,
        range_min=0.0,
        range_max=range_max_m,
        ranges=ranges,
    )


def _odometry(stamp_s: float, pose: tuple[float, float, float], velocity: tuple[float, float]) -> Any:
    x, y, yaw = pose
    turn = SimpleNamespace(x=0.0, y=0.0, z=math.sin(yaw / 2.0), w=math.cos(yaw / 2.0))
    here = SimpleNamespace(position=SimpleNamespace(x=x, y=y, z=0.0), orientation=turn)
    twist = SimpleNamespace(linear=SimpleNamespace(x=velocity[0]), angular=SimpleNamespace(z=velocity[1]))
    return SimpleNamespace(
        header=_header(stamp_s, "odom"),
        child_frame_id="base_link",
        pose=SimpleNamespace(pose=here),
        twist=SimpleNamespace(twist=twist),
    )


def _header(stamp_s: float, frame: str) -> Any:
    seconds, nanoseconds = divmod(round(stamp_s * 1e9), 1_000_000_000)
    return SimpleNamespace(stamp=SimpleNamespace(sec=seconds, nanosec=nanoseconds), frame_id=frame)


def _difference(
    last: tuple[float, tuple[float, float, float]], stamp_s: float, pose: tuple[float, float, float]
) -> tuple[float, float]:
    """Return the velocities between two poses: along the heading of the first, and of the turn; 0 back in time."""
    if stamp_s <= last[0]:
        return 0.0, 0.0
    (x, y, yaw), took_s = last[1], stamp_s - last[0]
    ahead_m = (pose[0] - x) * math.cos(yaw) + (pose[1] - y) * math.sin(yaw)
    return ahead_m / took_s, math.remainder(pose[2] - yaw, 2.0 * math.pi) / took_s
