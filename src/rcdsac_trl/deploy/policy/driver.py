"""The core of a ROS 2 node without ROS: it takes messages as they come, and gives a command when asked."""

from collections.abc import Mapping
from typing import Any

from rcdsac_trl.deploy.policy.input_checks import Stamps
from rcdsac_trl.deploy.policy.path import PathFollower
from rcdsac_trl.deploy.policy.policy import Command, Policy
from rcdsac_trl.deploy.ros import messages
from rcdsac_trl.deploy.sensors.cloud import CameraPose, CloudFilter, cloud_sectors
from rcdsac_trl.deploy.sensors.sectors import Mount
from rcdsac_trl.errors import UserInputError


class Driver:
    """Keeps the newest message of each kind, and asks a policy on them.

    A message that cannot be read is as good as none: the robot stands until a good one follows. Path and odometry must
    be in the same frame, and so must be their messages' headers.

    Args:
        policy: that drives.
        mount: where the laser scanner sits.
        cameras: pose of each depth camera, by the ``frame_id`` of its clouds.
        filter_: which points of clouds are obstacles.

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
    ) -> None:
        self.policy = policy
        self.beta: float | None = None
        self._mount = mount or Mount()
        self._cameras = dict(cameras or {})
        self._filter = filter_
        self._faults: dict[str, str] = {}
        self._scan: Any = None
        self._clouds: dict[str, Any] = {}
        self._odometry: Any = None
        self._follower: PathFollower | None = None
        self._path_frame = ""

    @property
    def arrived(self) -> bool:
        """Whether the goal of the newest path was reached."""
        return self._follower is not None and self._follower.reached

    def on_scan(self, message: Any) -> None:
        """Take a ``sensor_msgs/LaserScan``."""
        self._scan = message

    def on_cloud(self, message: Any) -> None:
        """Take a ``sensor_msgs/PointCloud2`` of one of the cameras."""
        self._clouds[str(message.header.frame_id)] = message

    def on_odometry(self, message: Any) -> None:
        """Take a ``nav_msgs/Odometry``."""
        self._odometry = message

    def on_path(self, message: Any) -> None:
        """Take a ``nav_msgs/Path``; the goal is its last pose. One without poses means: stand."""
        self._follower = None
        self._faults.pop("path", None)
        try:
            path = messages.path_of(message)
            self._path_frame = str(message.header.frame_id)
            self._follower = PathFollower(path, self.policy.config) if len(path) else None
        except (UserInputError, AttributeError, TypeError, ValueError, OverflowError) as error:
            self._faults["path"] = f"the path cannot be read ({error})"

    def command(self, now_s: float) -> Command:
        """Return what the robot should do now; call it once in every control period.

        Args:
            now_s: time of the clock that stamps the messages, s.
        """
        try:
            return self._ask(now_s)
        except (UserInputError, AttributeError, TypeError, ValueError, OverflowError) as error:
            return self.policy.refuse(f"a message cannot be read ({error})")

    def _ask(self, now_s: float) -> Command:
        if self._faults:
            return self.policy.refuse(next(iter(self._faults.values())))
        if self._odometry is None:
            return self.policy.refuse("there is no odometry yet")
        if self._follower is None:
            return self.policy.refuse("there is no path yet")
        frame = str(self._odometry.header.frame_id)
        if frame != self._path_frame:
            return self.policy.refuse(
                f"the path is in frame {self._path_frame!r}, odometry in {frame!r}: send both in one"
            )
        waypoints = self._follower.update(messages.pose_of_odometry(self._odometry))
        if waypoints is None:
            return self.policy.refuse("the goal is reached")
        ranges, scanned_s = self._ranges()
        if ranges is None:
            return self.policy.refuse("there is no scan, or not of every camera, yet")
        moved_s = messages.stamp_s(self._odometry)
        stamps = Stamps(now_s, scanned_s, moved_s, moved_s)
        velocity = messages.velocity_of_odometry(self._odometry)
        return self.policy.act(ranges, waypoints, velocity, self.beta, stamps=stamps)

    def _ranges(self) -> tuple[Any, float]:
        """Return what the sensors say and when: of several cameras, the oldest counts."""
        if not self._cameras:
            return (
                (None, 0.0)
                if self._scan is None
                else (
                    messages.scan_of(self._scan, self._mount),
                    messages.stamp_s(self._scan),
                )
            )
        if not self._cameras.keys() <= self._clouds.keys():
            return None, 0.0
        clouds = [(messages.points_of(self._clouds[frame]), pose) for frame, pose in self._cameras.items()]
        oldest = min(messages.stamp_s(self._clouds[frame]) for frame in self._cameras)
        return cloud_sectors(clouds, self._filter), oldest
