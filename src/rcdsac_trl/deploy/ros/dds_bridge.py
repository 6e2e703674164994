"""ROS 2 topics over CycloneDDS, without ROS, around :class:`~rcdsac_trl.deploy.policy.driver.Driver`.

Needs ``cyclonedds``; ``python -m rcdsac_trl.deploy.dds_node`` is the program.
"""

import math
import re
import struct
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from functools import partial
from typing import Any

from cyclonedds.builtin import BuiltinDataReader, BuiltinTopicDcpsPublication, BuiltinTopicDcpsSubscription
from cyclonedds.core import DDSException, InstanceState, Policy, Qos, ReadCondition, SampleState, ViewState
from cyclonedds.domain import DomainParticipant
from cyclonedds.internal import InvalidSample
from cyclonedds.pub import DataWriter
from cyclonedds.sub import DataReader
from cyclonedds.topic import Topic
from cyclonedds.util import duration

from rcdsac_trl.deploy.policy.command import Command
from rcdsac_trl.deploy.policy.driver import Driver
from rcdsac_trl.deploy.ros import dds_types
from rcdsac_trl.deploy.ros.messages import seconds_of, twist, twist_stamped
from rcdsac_trl.deploy.ros.topics import DRIVING, no_map_on, readers_of, writers_of
from rcdsac_trl.errors import UserInputError

READS: dict[str, Any] = {
    "scan": dds_types.LaserScan,
    "odom": dds_types.Odometry,
    "plan": dds_types.Path,
    "tf": dds_types.TFMessage,
    "tf_static": dds_types.TFMessage,
    "pose": dds_types.PoseWithCovarianceStamped,
    "map": dds_types.OccupancyGrid,
    "clock": dds_types.Clock,
    "beta": dds_types.Float64,
    "stop": dds_types.Bool,
}
"""Topics that are read, and their types; ``map`` only by a driver with a navigator."""
CLOUD: Any = dds_types.PointCloud2
"""Type of the clouds, which are read from topics of any name."""
WRITES: dict[str, Any] = {
    "cmd_vel": dds_types.TwistStamped,
    "return_quantiles": dds_types.Float32MultiArray,
    "drive_status": dds_types.String,
}
"""Topics that are written, and their types; ``cmd_vel`` as :data:`UNSTAMPED` as well, for bases that read that."""
UNSTAMPED: Any = dds_types.Twist

# ROS's sensor data: readers that ask for less than writers offer meet all of them.
_SENSORS = {"scan", "odom", "tf", "clock"}
# What their writers say holds for whoever comes later.
_KEPT = {"tf_static", "map"}
# All that came since the last step counts, of however many writers, and not the newest alone.
_MANY = {"tf", "tf_static"}
_TOPIC = re.compile(r"/?([A-Za-z_][A-Za-z0-9_]*(?:/[A-Za-z_][A-Za-z0-9_]*)*)")
_MOST_ENDPOINTS = 1000
_TYPE = re.compile(r"(\w+)::(\w+)::dds_::(\w+)_")
# The samples that one reader may hold: the newest message, and word that its writer has left; or those of many writers.
_MOST_SAMPLES, _MOST_TRANSFORMS = 8, 1000
_ACKNOWLEDGED_WITHIN = duration(seconds=1)


class DdsBridge:
    """Gives a driver the newest message of each topic, and publishes what it commands.

    ``beta`` sets the driver's attribute (NaN: the agent's default), and ``stop`` calls ``stop`` or ``resume`` of its
    policy: both hold until the next one. All else is for :class:`Driver`. Not for use from several threads at once.

    Args:
        driver: that is asked.
        domain_id: of DDS, ROS's ``ROS_DOMAIN_ID``.
        remapped: ROS names of topics that are called otherwise on this robot, such as ``{"plan": "/nav/path"}``.
        clouds: ROS names of topics with clouds of the driver's cameras.
        simulated: whether the clock that stamps is that of ``clock``.

    Attributes:
        topics: ROS name of every topic, by its name here.
        simulated: as given.

    Raises:
        UserInputError: if there is no such topic, a name is none, or DDS cannot be started.
    """

    def __init__(
        self,
        driver: Driver,
        domain_id: int = 0,
        *,
        remapped: Mapping[str, str] | None = None,
        clouds: Sequence[str] = (),
        simulated: bool = False,
    ) -> None:
        self.driver = driver
        self.simulated = simulated
        self.topics = _topics(remapped or {})
        self._cloud_topics = [_topic_name("cloud", topic) for topic in clouds]
        try:
            participant = DomainParticipant(domain_id)
        except DDSException as error:
            raise UserInputError(
                f"DDS cannot join domain {domain_id} ({error.msg or error}): see that ROS_DOMAIN_ID is 0 to 232, and "
                "what CYCLONEDDS_URI says, such as the network interface it names"
            ) from error
        self._readers = {
            name: DataReader(participant, self._topic(participant, name, kind), _reader_qos(name))
            for name, kind in READS.items()
            if name != "map" or driver.policy.navigator is not None
        }
        self._clouds = {
            name: DataReader(participant, Topic(participant, f"rt/{name}", CLOUD), _qos(reliable=False))
            for name in self._cloud_topics
        }
        self._writers = {
            name: DataWriter(participant, self._topic(participant, name, kind), _qos(reliable=True))
            for name, kind in WRITES.items()
        }
        self._unstamped = DataWriter(participant, self._topic(participant, "cmd_vel", UNSTAMPED), _qos(reliable=True))
        self._found = {
            "writers": BuiltinDataReader(participant, BuiltinTopicDcpsPublication),
            "readers": BuiltinDataReader(participant, BuiltinTopicDcpsSubscription),
        }
        self._present = {
            who: ReadCondition(found, SampleState.Any | ViewState.Any | InstanceState.Alive)
            for who, found in self._found.items()
        }

    def _topic(self, participant: DomainParticipant, name: str, kind: Any) -> Any:
        return Topic(participant, f"rt/{self.topics[name]}", kind)

    def simulated_s(self) -> float | None:
        """Return the newest time of ``clock`` since the last call; None if none has come."""
        times = [seconds_of(message.clock) for message in _newest(self._readers["clock"]) if message is not None]
        return times[-1] if times else None

    def step(self, now_s: float) -> Command:
        """Take what has come, ask the driver, and publish; call it once in every control period.

        Args:
            now_s: time of the clock that stamps the messages, s.
        """
        self._listen()
        command = self.driver.command(now_s)
        self._say(command, now_s)
        return command

    def leave(self, now_s: float) -> None:
        """Publish the command to stand, and wait until readers that can tell have got it, at most 1 s."""
        self._say(self.driver.policy.refuse("the node leaves"), now_s)
        for writer in (self._writers["cmd_vel"], self._unstamped):
            # A reader whose process has ended without a word never answers, and cyclonedds 11 stumbles over its own
            # word for that.
            with suppress(DDSException, AttributeError):
                writer.wait_for_acks(_ACKNOWLEDGED_WITHIN)

    def report(self) -> str:
        """Return who reads the commands, as which type, and which of the needed topics nobody writes as it is read."""
        commands = [_type_name(kind) for kind in (WRITES["cmd_vel"], UNSTAMPED)]
        said = [readers_of(f"/{self.topics['cmd_vel']}", commands, self._types(self.topics["cmd_vel"], "readers"))]
        needed = [*([] if self._clouds else ["scan"]), "odom", "plan", *(["clock"] if self.simulated else [])]
        asked = [(self.topics[name], READS[name], self._readers[name]) for name in needed]
        asked += [(name, CLOUD, reader) for name, reader in self._clouds.items()]
        for topic, kind, reader in asked:
            matched = bool(reader.get_matched_publications())
            writers = self._types(topic, "writers")
            said.append(writers_of(f"/{topic}", _type_name(kind), writers, matched=matched) or "")
        if self.driver.lacks_map:
            said.append(no_map_on(f"/{self.topics['map']}", self._types(self.topics["map"], "writers")))
        return "; ".join(filter(None, said))

    def _types(self, topic: str, who: str) -> list[str]:
        """Return the type of each writer, or reader, of a topic that DDS has found and that has not left."""
        endpoints = self._found[who].read(_MOST_ENDPOINTS, condition=self._present[who])
        return [_ros_name(found.type_name) for found in endpoints if found.topic_name == f"rt/{topic}"]

    def _listen(self) -> None:
        driver = self.driver
        takers: dict[str, Callable[[Any], None]] = {
            "scan": driver.on_scan,
            "odom": driver.on_odometry,
            "plan": driver.on_path,
            "tf": driver.on_transforms,
            "tf_static": partial(driver.on_transforms, static=True),
            "pose": driver.on_pose,
            "map": driver.on_map,
            "beta": self._on_beta,
            "stop": self._on_stop,
        }
        for name, take in takers.items():
            if name not in self._readers:
                continue
            for message in _all(self._readers[name]) if name in _MANY else _newest(self._readers[name]):
                take(message)
        for reader in self._clouds.values():
            for message in _newest(reader):
                driver.on_cloud(message)

    def _on_beta(self, message: Any) -> None:
        if message is not None:
            self.driver.beta = None if math.isnan(message.data) else message.data

    def _on_stop(self, message: Any) -> None:
        (self.driver.policy.stop if message is None or message.data else self.driver.policy.resume)()

    def _say(self, command: Command, now_s: float) -> None:
        self._writers["cmd_vel"].write(twist_stamped(command, now_s, _made))
        self._unstamped.write(twist(command, _made))
        self._writers["drive_status"].write(dds_types.String(command.reason or DRIVING))
        if command.quantiles is not None:
            quantiles = dds_types.Float32MultiArray(data=command.quantiles.tolist())
            self._writers["return_quantiles"].write(quantiles)


def _newest(reader: Any) -> list[Any]:
    """Return the newest message since the last call, in a list that is empty if there is none.

    One whose bytes mean nothing is None: to a driver, a message that cannot be read.
    """
    try:
        samples = reader.take(_MOST_SAMPLES)
    except (ValueError, struct.error):  # what decoding raises: texts that are not UTF-8, too few bytes
        return [None]
    return [sample for sample in samples if not isinstance(sample, InvalidSample)][-1:]


def _all(reader: Any) -> list[Any]:
    """Return every message since the last call; those whose bytes mean nothing are None."""
    messages: list[Any] = []
    while len(messages) < _MOST_TRANSFORMS:
        try:
            samples = reader.take(1)  # one by one, so that a broken one costs no other
        except (ValueError, struct.error):
            messages.append(None)
            continue
        if not samples:
            break
        messages += [sample for sample in samples if not isinstance(sample, InvalidSample)]
    return messages


def _reader_qos(name: str) -> Qos:
    return _qos(reliable=name not in _SENSORS, kept=name in _KEPT, depth=_MOST_TRANSFORMS if name in _MANY else 1)


def _qos(*, reliable: bool, kept: bool = False, depth: int = 1) -> Qos:
    return Qos(
        Policy.Reliability.Reliable(duration(milliseconds=100)) if reliable else Policy.Reliability.BestEffort,
        Policy.Durability.TransientLocal if kept else Policy.Durability.Volatile,
        Policy.History.KeepLast(depth),
        Policy.DataRepresentation(use_cdrv0_representation=True),  # ROS 2 knows no other
    )


def _topics(remapped: Mapping[str, str]) -> dict[str, str]:
    names = [*READS, *WRITES]
    topics = {name: name for name in names}
    for name, topic in remapped.items():
        if name not in topics:
            raise UserInputError(f"{name}:={topic} renames what there is not: choose one of {', '.join(names)}")
        topics[name] = _topic_name(name, topic)
    for name, topic in topics.items():
        if others := [other for other in names if other != name and topics[other] == topic]:
            raise UserInputError(f"{name} and {others[0]} are both called /{topic}: give each a topic of its own")
    return topics


def _topic_name(name: str, topic: str) -> str:
    """Return a topic of ROS without its first slash."""
    match = _TOPIC.fullmatch(topic)
    if match is None:
        raise UserInputError(
            f"{name}:={topic} is no topic of ROS: give letters, digits, _ and slashes, such as /front/scan"
        )
    return match[1]


def _type_name(kind: Any) -> str:
    """Return what ROS calls a message type."""
    return _ros_name(kind.__idl__.idl_transformed_typename)


def _ros_name(type_name: str) -> str:
    """Return what ROS calls a type of DDS, such as ``"geometry_msgs/msg/Twist"``, or the name itself."""
    match = _TYPE.fullmatch(type_name)
    return "/".join(match.groups()) if match else type_name


def _made(name: str) -> Any:
    """Return an empty message of a type such as ``"geometry_msgs/msg/TwistStamped"``."""
    return getattr(dds_types, name.rsplit("/", 1)[1])()
