"""The core of a ROS 2 node without ROS: it takes messages as they come, and gives a command when asked."""

import contextlib
import math
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rcdsac_trl.deploy.frames.robot_frames import FrameSettings, RobotFrames
from rcdsac_trl.deploy.frames.sensor_mounts import camera_of, mount_of, transform_of_camera, transform_of_mount
from rcdsac_trl.deploy.frames.transform_buffer import TransformError
from rcdsac_trl.deploy.policy.command import Command
from rcdsac_trl.deploy.policy.input_checks import Stamps
from rcdsac_trl.deploy.policy.path import PathFollower
from rcdsac_trl.deploy.policy.policy import Policy
from rcdsac_trl.deploy.policy.poses import PoseWatch
from rcdsac_trl.deploy.ros import messages
from rcdsac_trl.deploy.sensors.arrays import described
from rcdsac_trl.deploy.sensors.cloud import CameraPose, CloudFilter, cloud_sectors
from rcdsac_trl.deploy.sensors.scan import Meaning, Scan, check_meaning
from rcdsac_trl.errors import UserInputError
from rcdsac_trl.robot.sectors import Mount, Sectors, mount_of_lidar

# Of the frames whose clouds are not expected, so many are named.
_MOST_FRAMES = 5


@dataclass(frozen=True)
class Situation:
    """What a policy was asked on.

    Attributes:
        pose: x and y in m and yaw in rad of the robot, in the path's frame.
        waypoints: the next two, m, in the robot's frame, [2, 2].
        ranges: what the sensors say, around that pose.
        velocity: measured, m/s and rad/s.
    """

    pose: tuple[float, float, float]
    waypoints: NDArray[np.float64]
    ranges: Scan | Sectors
    velocity: tuple[float, float]


class Driver:
    """Keeps the newest message of each kind, and asks a policy on them.

    A message that cannot be read is as good as none: the robot stands until a good one follows. A path in another frame
    than odometry, such as ``map``, needs transforms or poses that connect the two; see
    :class:`~rcdsac_trl.deploy.frames.robot_frames.RobotFrames`. What a sensor saw at its stamp is brought to where the
    robot is by then; of a scan with a ``time_increment``, every ray from where the robot was when it was measured. What
    is newer than odometry counts as measured where the robot was by the newest. A path in the frame of the one before
    is followed from where the robot has got to on that one; see :meth:`PathFollower.replan`.

    Args:
        policy: that drives.
        mount: where the laser scanner sits; None: as transforms say, or the robot's settings where there are none.
        cameras: pose of each depth camera, by the ``frame_id`` of its clouds; its horizontal field of view alone, rad,
            where transforms say the pose. A frame with "optical" in its name has z ahead, any other x.
        filter_: which points of clouds are obstacles; None: the defaults, without what is the robot itself.
        zero_means: what the scanner's driver means by a reading of 0; see :class:`Scan`.
        nan_means: what it means by NaN.
        frames: how the robot's place in the path's frame is known; None for the defaults.
        detours: give the policy a navigator that leads around what blocks the way; it needs numba. If a map comes, it
            keeps clear of that, too, and so does the stop zone: of glass, which no sensor sees.
        watchdog: give the policy a navigator that turns beta to its boldest where the robot stands, and at last backs
            off; it needs numba, and reads the map as detours do.
        plan_timeout_s: the robot stands when the newest path came longer ago, s, by the clock of :meth:`command`; None:
            paths do not age. Planners that plan again and again fall silent when a goal is cancelled.

    Attributes:
        beta: how much risk to take; None: the policy's default. May be set at any time.
        situation: what the policy was asked on last; None where the last command did not ask it.

    Raises:
        UserInputError: if readings are to mean what they cannot, or the timeout is no positive number.
    """

    def __init__(
        self,
        policy: Policy,
        *,
        mount: Mount | None = None,
        cameras: Mapping[str, CameraPose | float] | None = None,
        filter_: CloudFilter | None = None,
        zero_means: Meaning = "invalid",
        nan_means: Meaning = "invalid",
        frames: FrameSettings | None = None,
        detours: bool = False,
        watchdog: bool = False,
        plan_timeout_s: float | None = None,
    ) -> None:
        check_meaning("zero_means", zero_means)
        check_meaning("nan_means", nan_means)
        if plan_timeout_s is not None and not 0.0 < plan_timeout_s < math.inf:
            raise UserInputError(
                f"plan_timeout_s={plan_timeout_s} must be a positive number of seconds: leave it out for plans that do "
                "not age"
            )
        self.policy = policy
        if detours or watchdog:
            # Here, since a driver without them does without numba.
            from rcdsac_trl.deploy.navigation.navigator import Navigator, NavigatorSettings

            switched = NavigatorSettings.switched(replan=detours, watchdog=watchdog)
            policy.navigator = Navigator(switched, policy.robot)
        self.beta: float | None = None
        self.situation: Situation | None = None
        self._robot = policy.config.robot
        self._mount = None if mount is None else transform_of_mount(mount)
        self._own_mount = transform_of_mount(mount_of_lidar(self._robot.lidar))
        self._cameras = dict(cameras or {})
        self._filter = filter_ or CloudFilter(body_radius_m=self._robot.body_radius_m)
        self._meanings = (zero_means, nan_means)
        self._frames = RobotFrames(frames or FrameSettings(), policy.limits.max_age_s)
        self._faults: dict[str, str] = {}
        self._left_out: str | None = None
        self._scan: Any = None
        self._clouds: dict[str, Any] = {}
        self._other_frames: list[str] = []
        self._odometry: Any = None
        self._poses = PoseWatch()
        self._follower: PathFollower | None = None
        self._path_frame = self._map_frame = ""
        self._no_path = "there is no path yet"
        self._plan_timeout_s = plan_timeout_s
        # Messages come between commands, and their stamps may say anything: inf is a path that no command has met.
        self._planned_s = math.inf

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

    def on_transforms(self, message: Any, *, static: bool = False) -> None:
        """Take a ``tf2_msgs/TFMessage``; what cannot be read of it is left out, and told where it is missed.

        Args:
            message: of ``/tf``, or of ``/tf_static``.
            static: whether it is of the latter.
        """
        self._left_out = None
        for stamped in getattr(message, "transforms", [message]):
            try:
                self._frames.transforms.set(*messages.transform_of(stamped), static=static)
            except UserInputError as error:
                self._left_out = str(error)
            except Exception as error:  # as in on_cloud()
                self._left_out = described(error)

    def on_pose(self, message: Any) -> None:
        """Take a ``geometry_msgs/PoseWithCovarianceStamped`` of the robot."""
        with self._reading("robot's pose"):
            pose, at_s = messages.pose_of(message), messages.stamp_s(message)
            self._frames.localised(str(message.header.frame_id), at_s, pose)

    def on_map(self, message: Any) -> None:
        """Take a ``nav_msgs/OccupancyGrid``; it means nothing without a navigator."""
        if self.policy.navigator is None:
            return
        with self._reading("map", "; publish another one, or drive without detours and watchdog"):
            self.policy.navigator.static_layer = messages.static_layer_of(message)
            self._map_frame = str(message.header.frame_id)

    @property
    def lacks_map(self) -> bool:
        """Whether detours could be planned on a map, and none has come."""
        navigator = self.policy.navigator
        return navigator is not None and navigator.settings.replan and navigator.static_layer is None

    def on_path(self, message: Any) -> None:
        """Take a ``nav_msgs/Path``; the goal is its last pose. One without poses means: stand."""
        self._no_path = "there is no path"
        with self._reading("path"):
            self._follow(messages.path_of(message), str(message.header.frame_id))

    @contextlib.contextmanager
    def _reading(self, what: str, remedy: str = "") -> Iterator[None]:
        """Let the robot stand for what cannot be read, until the next message of its kind can be."""
        self._faults.pop(what, None)
        try:
            yield
        except UserInputError as error:
            self._faults[what] = f"the {what} cannot be read ({error}){remedy}"
        except Exception as error:  # as in on_cloud()
            self._faults[what] = f"the {what} cannot be read ({described(error)}){remedy}"

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
        self._planned_s = math.inf

    def command(self, now_s: float) -> Command:
        """Return what the robot should do now; call it once in every control period.

        Args:
            now_s: time of the clock that stamps the messages, s.
        """
        self.situation = None
        try:
            return self._ask(now_s)
        except TransformError as error:
            left_out = "" if self._left_out is None else f"; of /tf was left out what cannot be read ({self._left_out})"
            return self.policy.refuse(f"{error}{left_out}")
        except UserInputError as error:
            return self.policy.refuse(f"a message cannot be read ({error})")
        except Exception as error:  # as in on_cloud()
            return self.policy.refuse(f"a message cannot be read ({described(error)})")

    def _ask(self, now_s: float) -> Command:
        self._planned_s = min(self._planned_s, now_s)  # also where the clock was set back
        if self._faults:
            return self.policy.refuse(next(iter(self._faults.values())))
        if self._odometry is None:
            return self.policy.refuse("there is no odometry yet")
        if self._no_path or self._follower is None:
            return self.policy.refuse(self._no_path)
        velocity = messages.velocity_of_odometry(self._odometry)
        here, pose_s, moved_s = self._located(now_s, velocity)
        waypoints = self._follower.update(here)
        if waypoints is None:
            return self.policy.refuse("the goal is reached")
        if (lacks := self._old_plan(now_s) or self._missing()) is not None:
            return self.policy.refuse(lacks)
        ranges, scanned_s = self._ranges(pose_s)
        stamps = Stamps(now_s, scanned_s, pose_s, moved_s)
        self.situation = Situation(here, waypoints, ranges, velocity)
        on_map = here
        if self._map_frame not in ("", self._path_frame):
            on_map, _ = self._frames.robot_in(self._map_frame, now_s, "map")
        return self.policy.act(ranges, waypoints, velocity, self.beta, stamps=stamps, pose=on_map)

    def _old_plan(self, now_s: float) -> str | None:
        """Return how old the newest path is, where that is too old."""
        age_s = now_s - self._planned_s
        if self._plan_timeout_s is None or age_s <= self._plan_timeout_s:
            return None
        return (
            f"the plan is {age_s:.2f} s old, more than plan_timeout_s={self._plan_timeout_s:g}: it was cancelled, or "
            "its planner is late; plan again, or give a larger plan_timeout_s"
        )

    def _located(self, now_s: float, velocity: tuple[float, float]) -> tuple[tuple[float, float, float], float, float]:
        """Return the robot's pose in the path's frame, the stamp of that pose, and the stamp of the odometry."""
        pose, moved_s = messages.pose_of_odometry(self._odometry), messages.stamp_s(self._odometry)
        # Only odometry: what a localisation corrects is no motion.
        self._poses.check(pose[:2], moved_s, velocity)
        base_frame = str(getattr(self._odometry, "child_frame_id", ""))
        self._frames.moved(str(self._odometry.header.frame_id), base_frame, moved_s, pose)
        here, pose_s = self._frames.robot_in(self._path_frame, now_s)
        return here, pose_s, moved_s

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

    def _ranges(self, pose_s: float) -> tuple[Scan | Sectors, float]:
        """Return what the sensors say around where the robot was at a time, and when they saw it.

        Of several cameras, the oldest counts.
        """
        if not self._cameras:
            scanned_s = messages.stamp_s(self._scan)
            scan = messages.scan_of(self._scan, self._scanner(scanned_s, pose_s), *self._meanings)
            if swept_s := messages.sweep_s(self._scan):
                scan = replace(scan, end_mount=self._scanner(scanned_s + swept_s, pose_s))
            return scan, scanned_s
        clouds, stamps = [], []
        for frame, camera in self._cameras.items():
            message = self._clouds[frame]
            stamps.append(messages.stamp_s(message))
            given = transform_of_camera(camera) if isinstance(camera, CameraPose) else None
            there = self._frames.sensor(frame, stamps[-1], pose_s, given)
            clouds.append((messages.points_of(message), camera_of(there, camera, frame)))
        return cloud_sectors(clouds, self._filter, self._robot.lidar.max_range_m), min(stamps)

    def _scanner(self, at_s: float, pose_s: float) -> Mount:
        """Return where the scanner was at a time, around where the robot was at another."""
        frame = str(self._scan.header.frame_id)
        return mount_of(self._frames.sensor(frame, at_s, pose_s, self._mount, self._own_mount))
