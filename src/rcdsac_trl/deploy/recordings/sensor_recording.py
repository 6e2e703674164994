"""What a robot's sensors said, recorded by somebody else: which topics there are, and their messages in order."""

from collections.abc import Collection, Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Protocol

from rcdsac_trl.errors import UserInputError
from rcdsac_trl.robot.sectors import Mount

SCAN = "sensor_msgs/msg/LaserScan"
ODOMETRY = "nav_msgs/msg/Odometry"
PLAN = "nav_msgs/msg/Path"
GOAL = "geometry_msgs/msg/PoseStamped"
TRANSFORMS = ("tf2_msgs/msg/TFMessage", "tf/msg/tfMessage")
COMMANDS = ("geometry_msgs/msg/TwistStamped", "geometry_msgs/msg/Twist")

# Of several topics of a type, the one of this name is meant.
_USUAL = {
    "scan": ("/scan",),
    "odom": ("/odom",),
    "plan": ("/plan",),
    "goal": ("/goal_pose", "/move_base_simple/goal"),
    "command": ("/cmd_vel",),
}
_MOST_TOPICS = 12


@dataclass(frozen=True)
class RecordedMessage:
    """A message and when it was recorded.

    Attributes:
        time_s: of the recorder's clock.
        topic: that it came on.
        message: with the fields of ROS's definition.
    """

    time_s: float
    topic: str
    message: Any


class SensorRecording(Protocol):
    """A recording that can be read more than once.

    Attributes:
        path: of the file or folder.
        topics: type of each, such as ``"sensor_msgs/msg/LaserScan"``.
        mount: where its scanner sits; None where only transforms may say so.
    """

    path: Path
    topics: Mapping[str, str]
    mount: Mount | None

    def messages(self, topics: Collection[str]) -> Iterator[RecordedMessage]:
        """Yield what came on some topics, in the order it was recorded.

        Raises:
            UserInputError: if it cannot be read.
        """
        ...


def topic_of(recording: SensorRecording, key: str, kinds: Collection[str], named: str | None) -> str | None:
    """Return the topic of a kind, by its type; None if there is none.

    Args:
        recording: that has it.
        key: of the setting that would name it.
        kinds: the types that will do.
        named: what the setting says; None: nothing.

    Raises:
        UserInputError: if there is no such topic, or there are several and none has the usual name.
    """
    found = [topic for topic, kind in recording.topics.items() if kind in kinds]
    if named is not None:
        name = f"/{named.removeprefix('/')}"
        if name in found:
            return name
        raise UserInputError(
            f"{key}={named} is no topic of {recording.path} with {' or '.join(kinds)}: {_listed(recording, found)}"
        )
    usual = [topic for topic in _USUAL[key] if topic in found]
    if len(found) > 1 and not usual:
        raise UserInputError(
            f"{recording.path} has {len(found)} topics with {' or '.join(kinds)}: name one, {key}=<one of "
            f"{', '.join(found[:_MOST_TOPICS])}>"
        )
    return next(iter(usual or found), None)


def needed_topic(recording: SensorRecording, key: str, kind: str, named: str | None) -> str:
    """Return the topic of a type that nothing goes without.

    Raises:
        UserInputError: if there is none, with the topics that there are; and as :func:`topic_of`.
    """
    topic = topic_of(recording, key, (kind,), named)
    if topic is None:
        raise UserInputError(f"{recording.path} has no topic with {kind}: {_listed(recording, [])}")
    return topic


def _listed(recording: SensorRecording, found: list[str]) -> str:
    if found:
        return f"there are {', '.join(found[:_MOST_TOPICS])}"
    there = [f"{topic} ({kind})" for topic, kind in recording.topics.items()]
    more = f" and {len(there) - _MOST_TOPICS} more" if len(there) > _MOST_TOPICS else ""
    return f"there are {', '.join(there[:_MOST_TOPICS]) or 'no topics'}{more}; give another recording"
