"""The core of a ROS 2 node without ROS: it takes messages as they come, and gives a command when asked."""

from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rcdsac_trl.deploy.policy.command import Command
from rcdsac_trl.deploy.policy.input_checks import Stamps
from rcdsac_trl.deploy.policy.path import PathFollower
from rcdsac_trl.deploy.policy.policy import Policy
from rcdsac_trl.deploy.policy.poses import PoseWatch
from rcdsac_trl.deploy.ros import messages
from rcdsac_trl.deploy.sensors.arrays import described
from rcdsac_trl.deploy.sensors.cloud import CameraPose, CloudFilter, cloud_sectors
from rcdsac_trl.deploy.sensors.scan import ZeroMeans, check_zero_means
from rcdsac_trl.deploy.sensors.sectors import Mount, mount_of
from rcdsac_trl.errors import UserInputError

# Of the frames whose clouds are not expected, so many are named.
_MOST_FRAMES = 5


class Driver:
    """Keeps the newest message of each kind, and asks a policy on them.

    A message that cannot be read is as good as none: the robot stands until a good one follows. Path and odometry must
    be in the same frame, and so must be their messages' headers. A path in the frame of the one before is followed from
    where the robot has got to on that one; see :meth:`PathFollower.replan`.

    Args:
        policy: that drives.
        mount: where the laser scanner sits; None: where the robot's settings have it.
        cameras: pose of each depth camera, by the ``frame_id`` of its clouds.
        filter_: which points of clouds are obstacles; None: the defaults, without what is the robot itself.
        zero_means: what the scanner's driver means by a reading of 0; see :class:`Scan`.

    Attributes:
        beta: how much risk to take; None: the policy's default. May be set at any time.
    """

    def __init__(
        self,
        policy: Policy,
        *,
        mount: Mount | None = None,
        cameras: Mapping[str, CameraPose] | None = None,
        filter_: CloudFilter | None = None,
        zero_means: ZeroMeans = "unknown",
    ) -> None:
        check_zero_means(zero_means)
        self.policy = policy
        self.beta: float | None = None
        self._robot = policy.config.robot
        self._mount = mount or mount_of(self._robot.lidar)
        self._cameras = dict(cameras or {})
        self._filter = filter_ or CloudFilter(body_radius_m=self._robot.body_radius_m)
        self._zero_means = zero_means
        self._faults: dict[str, str] = {}
        self._scan: Any = None
        self._clouds: dict[str, Any] = {}
        self._other_frames: list[str] = []
        self._odometry: Any = None
        self._poses = PoseWatch()
        self._follower: PathFollower | None = None
        self._path_frame = ""
        self._no_path = "there is no path yet"

    @property
    def arrived(self) -> bool:
        """Whether the goal of the newest path was reached."""
        return not self._no_path and self._follower is not None and self._follower.reached

    def on_scan(self, message: Any) -> None:
        """Take a ``sensor_msgs/LaserScan``."""
        self._scan = message

    def on_cloud(self, message: Any) -> None:
        """Take a ``sensor_msgs/PointCloud2`` of one of the cameras."""
        try:
            frame = str(message.header.frame_id)
        except Exception as error:  # what a message does when it is read is not ours to know
            self._faults["cloud"] = f"a cloud cannot be read ({described(error)})"
            return
        self._faults.pop("cloud", None)
        if frame in self._cameras:
            self._clouds[frame] = message
        elif frame not in self._other_frames:
            self._other_frames = [*self._other_frames, frame][-_MOST_FRAMES:]

    def on_odometry(self, message: Any) -> None:
        """Take a ``nav_msgs/Odometry``."""
        self._odometry = message

    def on_path(self, message: Any) -> None:
        """Take a ``nav_msgs/Path``; the goal is its last pose. One without poses means: stand."""
        self._faults.pop("path", None)
        self._no_path = "there is no path"
        try:
            self._follow(messages.path_of(message), str(message.header.frame_id))
        except UserInputError as error:
            self._faults["path"] = f"the path cannot be read ({error})"
        except Exception as error:  # as in on_cloud()
            self._faults["path"] = f"the path cannot be read ({described(error)})"

    def _follow(self, path: NDArray[np.float64], frame: str) -> None:
        if not len(path):
            self._no_path = "there is no path yet that has poses: the last one is empty"
            if self._follower is not None and self._follower.reached:
                self._follower = None  # the same path again is another lap
            return
        if self._follower is None or frame != self._path_frame:
            self._follower = PathFollower(path, self.policy.config)
        else:
            self._follower.replan(path)
        self._path_frame = frame
        self._no_path = ""

    def command(self, now_s: float) -> Command:
        """Return what the robot should do now; call it once in every control period.

        Args:
            now_s: time of the clock that stamps the messages, s.
        """
        try:
            return self._ask(now_s)
        except UserInputError as error:
            return self.policy.refuse(f"a message cannot be read ({error})")
        except Exception as error:  # as in on_cloud()
            return self.policy.refuse(f"a message cannot be read ({described(error)})")

    def _ask(self, now_s: float) -> Command:
        if self._faults:
            return self.policy.refuse(next(iter(self._faults.values())))
        if self._odometry is None:
            return self.policy.refuse("there is no odometry yet")
        if self._no_path or self._follower is None:
            return self.policy.refuse(self._no_path)
        frame = str(self._odometry.header.frame_id)
        if frame != self._path_frame:
            return self.policy.refuse(
                f"the path is in frame {self._path_frame!r}, odometry in {frame!r}: send both in one"
            )
        pose, moved_s = messages.pose_of_odometry(self._odometry), messages.stamp_s(self._odometry)
        self._poses.check(pose[:2], moved_s)
        waypoints = self._follower.update(pose)
        if waypoints is None:
            return self.policy.refuse("the goal is reached")
        if (missing := self._missing()) is not None:
            return self.policy.refuse(missing)
        ranges, scanned_s = self._ranges()
        stamps = Stamps(now_s, scanned_s, moved_s, moved_s)
        velocity = messages.velocity_of_odometry(self._odometry)
        return self.policy.act(ranges, waypoints, velocity, self.beta, stamps=stamps)

    def _missing(self) -> str | None:
        """Return what there is no message of yet, and what came instead."""
        others = "" if not self._other_frames else f"; clouds came in frame {', '.join(map(repr, self._other_frames))}"
        if not self._cameras:
            if self._scan is not None:
                return None
            return "there is no scan yet" + (f"{others}, which no camera of this driver has" if others else "")
        missing = [frame for frame in self._cameras if frame not in self._clouds]
        if not missing:
            return None
        if self._scan is not None:
            others += "; a scan came, which is not read where there are cameras"
        frames = ", ".join(map(repr, missing))
        return f"there is no scan yet, or not of every camera: no cloud came in frame {frames}{others}"

    def _ranges(self) -> tuple[Any, float]:
        """Return what the sensors say and when: of several cameras, the oldest counts."""
        if not self._cameras:
            return messages.scan_of(self._scan, self._mount, self._zero_means), messages.stamp_s(self._scan)
        clouds = [(messages.points_of(self._clouds[frame]), pose) for frame, pose in self._cameras.items()]
        oldest = min(messages.stamp_s(self._clouds[frame]) for frame in self._cameras)
        return cloud_sectors(clouds, self._filter, self._robot.lidar.max_range_m), oldest
