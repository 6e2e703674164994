"""Plan, pose, scans and clouds in one frame: the robot in the frame of its plan, its sensors in that of the robot.

A localisation corrects where odometry starts from (``map -> odom``), in steps. Here such a step moves the robot in the
frame of its plan, and nothing else: velocities are those of the odometry's twist, and how the robot moved between two
stamps is told by odometry alone, which knows no steps.
"""

import math
from dataclasses import dataclass
from typing import Literal, get_args

from rcdsac_trl.deploy.frames.rigid_transform import RigidTransform
from rcdsac_trl.deploy.frames.transform_buffer import SET_BACK_S, TransformBuffer, TransformError, named
from rcdsac_trl.deploy.policy.input_checks import InputLimits
from rcdsac_trl.errors import UserInputError

Localisation = Literal["tf", "pose"]
"""Who says where the robot is in the frame of its plan: ``/tf``, or a topic with the robot's pose."""

_USUAL_BASE = "base_link"
# The odometry's own messages name frames that /tf may name otherwise: beside it, they are these.
_START, _ROBOT = "start", "robot"
# Localisations stamp their correction ahead, by how long they mean it to hold; more is another clock.
_FARTHEST_AHEAD_S = 10.0
# Between a scan and the newest odometry no robot of this kind moves so far.
_LARGEST_MOVE_M = 1.0


@dataclass(frozen=True)
class FrameSettings:
    """How the robot's place in the frame of its plan is known.

    Attributes:
        localisation: ``"tf"``: from ``/tf``; ``"pose"``: from messages with its pose.
        localisation_timeout_s: the robot stands when the newest correction is older; ``inf``: never for that.
        base_frame: the robot's frame, on the floor below its centre of rotation; None: the odometry's
            ``child_frame_id``, or ``base_link`` where that is empty.

    Raises:
        UserInputError: if the localisation is another, or the timeout is no positive number.
    """

    localisation: Localisation = "tf"
    localisation_timeout_s: float = 1.0
    base_frame: str | None = None

    def __post_init__(self) -> None:
        """Refuse what cannot be."""
        if self.localisation not in get_args(Localisation):
            raise UserInputError(f"localisation={self.localisation!r} is neither 'tf' nor 'pose': choose one")
        if not self.localisation_timeout_s > 0.0:  # also false for NaN
            raise UserInputError(
                f"localisation_timeout_s={self.localisation_timeout_s} must be a positive number of seconds, or inf"
            )


class RobotFrames:
    """Knows where the robot is in any frame, and where its sensors were.

    Without any transform it still drives where plan and odometry are in one frame, and sensors are where they are said
    to be.

    Args:
        settings: of the localisation.
        max_age_s: of what moves on the robot itself, and of its odometry.

    Attributes:
        transforms: what ``/tf`` and ``/tf_static`` said.

    Example:
        >>> frames = RobotFrames()
        >>> frames.transforms.set("map", "odom", 10.0, RigidTransform.planar(5.0, 0.0, 0.0))
        >>> frames.moved("odom", "base_link", 10.0, (1.0, 2.0, 0.0))
        >>> frames.robot_in("map", 10.0)
        ((6.0, 2.0, 0.0), 10.0)
    """

    def __init__(self, settings: FrameSettings = FrameSettings(), max_age_s: float = InputLimits.max_age_s) -> None:
        self.transforms = TransformBuffer()
        self._max_age_s = max_age_s
        self._settings = settings
        self._odometry = TransformBuffer()
        self._localised = TransformBuffer()
        self._pose: tuple[str, float, RigidTransform] | None = None
        self._odom_frame, self._base_frame = "odom", settings.base_frame or _USUAL_BASE

    def moved(self, odom_frame: str, base_frame: str, stamp_s: float, pose: tuple[float, float, float]) -> None:
        """Take note of an odometry.

        Args:
            odom_frame: its ``header.frame_id``.
            base_frame: its ``child_frame_id``; may be empty.
            stamp_s: when the robot was there.
            pose: x and y in m and yaw in rad, in its frame.

        Raises:
            UserInputError: if a number is not finite.
        """
        self._odom_frame = named(odom_frame)
        self._base_frame = named(self._settings.base_frame or base_frame or _USUAL_BASE)
        if self._odometry.frames and stamp_s < self._odometry.latest(_START, _ROBOT)[1] - SET_BACK_S:
            # Nothing that was stamped before the clock was set back says where the robot is now.
            self._odometry, self._localised, self._pose = TransformBuffer(), TransformBuffer(), None
        self._odometry.set(_START, _ROBOT, stamp_s, RigidTransform.planar(*pose))

    def localised(self, frame: str, stamp_s: float, pose: tuple[float, float, float]) -> None:
        """Take note of where a localisation found the robot; counts only where the settings say ``"pose"``.

        Args:
            frame: of the pose.
            stamp_s: when the robot was there.
            pose: x and y in m and yaw in rad.
        """
        self._pose = named(frame), stamp_s, RigidTransform.planar(*pose)

    def robot_in(self, frame: str, now_s: float, what: str = "path") -> tuple[tuple[float, float, float], float]:
        """Return the robot's pose in a frame that stands still, by the newest of every transform.

        Args:
            frame: of a plan.
            now_s: time of the clock that stamps.
            what: is in that frame, for the sentence of a refusal.

        Returns:
            x and y in m and yaw in rad, and the stamp of the odometry in it.

        Raises:
            TransformError: naming the transform that is missing or old.
        """
        frame = named(frame)
        if self.transforms.hangs_below(frame, self._base_frame):
            raise TransformError(
                f"the {what} is in frame {frame!r}, which moves with the robot: plan in one that stands still, such as "
                "map or odom"
            )
        pose_s = min(self._newest_odometry_s(), now_s)
        if self._odometry_in_tf() and now_s - pose_s > self._max_age_s:
            link = self.transforms.oldest_link(self._odom_frame, self._base_frame)
            raise TransformError(f"the transform {link} is {now_s - pose_s:.2f} s old, more than {self._max_age_s:g} s")
        robot = self._robot_at(pose_s)
        if frame != self._odom_frame:
            robot = self._correction(frame, now_s, what) @ robot
        return robot.pose, pose_s

    def sensor(
        self,
        frame: str,
        stamp_s: float,
        robot_s: float,
        given: RigidTransform | None,
        untold: RigidTransform | None = None,
    ) -> RigidTransform:
        """Return where a sensor was at its stamp, in the frame that the robot has at another time.

        Args:
            frame: of the sensor.
            stamp_s: of what it measured; where odometry has not come so far, the robot is where it was by the newest.
            robot_s: when the robot's frame is meant.
            given: where it sits on the robot; None: as ``/tf`` says.
            untold: where it sits where nobody publishes any transform; None: that is refused.

        Raises:
            TransformError: naming the transform that is missing, or that the robot has moved too far between.
        """
        if given is None:
            given = self._mounted(frame, stamp_s) if untold is None or self.transforms.frames else untold
        moved = self._robot_at(robot_s).inverse() @ self._robot_at(stamp_s)
        if (metres := math.hypot(*moved.translation_m)) > _LARGEST_MOVE_M:
            raise TransformError(
                f"the odometry moved by {metres:.1f} m between a scan and now ({abs(robot_s - stamp_s):.2f} s): it has "
                "jumped, or is not in metres"
            )
        return moved @ given

    def _mounted(self, frame: str, stamp_s: float) -> RigidTransform:
        try:
            return self.transforms.lookup(self._base_frame, frame, stamp_s, hold_s=self._max_age_s)
        except TransformError as error:
            raise TransformError(f"nobody says where the sensor in frame {frame!r} sits: {error}") from error

    def _odometry_in_tf(self) -> bool:
        """Tell whether ``/tf`` says where the robot is in the frame of odometry, which then counts.

        Where a filter fuses several, the topic is one of its sources, and ``/tf`` the result.
        """
        return self.transforms.connects(self._odom_frame, self._base_frame)

    def _newest_odometry_s(self) -> float:
        if self._odometry_in_tf():
            return self.transforms.latest(self._odom_frame, self._base_frame)[1]
        return self._odometry.latest(_START, _ROBOT)[1]

    def _robot_at(self, stamp_s: float) -> RigidTransform:
        """Return the robot's pose in the frame of odometry; before the first and after the last it stands there."""
        if self._odometry_in_tf():
            return self.transforms.lookup(self._odom_frame, self._base_frame, stamp_s, hold_s=math.inf)
        return self._odometry.lookup(_START, _ROBOT, stamp_s, hold_s=math.inf)

    def _correction(self, frame: str, now_s: float, what: str) -> RigidTransform:
        """Return what takes the frame of odometry to that of a plan, unless it is missing or old."""
        if self._settings.localisation == "pose":
            self._take_pose_over(frame, what)
        transforms = self._localised if self._settings.localisation == "pose" else self.transforms
        try:
            correction, stamp_s = transforms.latest(frame, self._odom_frame)
        except TransformError as error:
            raise TransformError(
                f"the {what} is in frame {frame!r}, odometry in {self._odom_frame!r}: {error}; start the localisation, "
                "or send both in one frame"
            ) from error
        link, timeout_s = transforms.oldest_link(frame, self._odom_frame), self._settings.localisation_timeout_s
        if now_s - stamp_s > timeout_s:
            raise TransformError(
                f"the localisation is lost: the transform {link} is {now_s - stamp_s:.2f} s old, more than "
                f"localisation_timeout_s={timeout_s:g}"
            )
        if _FARTHEST_AHEAD_S < stamp_s - now_s < math.inf:
            raise TransformError(
                f"the transform {link} is {stamp_s - now_s:.2f} s in the future: are both in seconds, of one clock "
                "(simulated time, wall time)?"
            )
        return correction

    def _take_pose_over(self, frame: str, what: str) -> None:
        """Keep what the newest pose says of the frame of odometry: a pose holds at its stamp, a correction stays."""
        if self._pose is None:
            raise TransformError(f"the {what} is in frame {frame!r}, and no pose of the robot has come yet")
        of_frame, stamp_s, pose = self._pose
        if stamp_s > self._taken_s(of_frame):
            correction = pose @ self._robot_at(stamp_s).inverse()
            self._localised.set(of_frame, self._odom_frame, stamp_s, correction)

    def _taken_s(self, frame: str) -> float:
        if not self._localised.frames or not self._localised.connects(frame, self._odom_frame):
            return -math.inf
        return self._localised.latest(frame, self._odom_frame)[1]
