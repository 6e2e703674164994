"""ROS 2 topics over CycloneDDS, without ROS, around :class:`~rcdsac_trl.deploy.policy.driver.Driver`.

Needs ``cyclonedds``; ``python -m rcdsac_trl.deploy.dds_node`` is the program.
"""

import math
import re
import struct
from collections.abc import Mapping
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
from rcdsac_trl.deploy.ros.messages import twist, twist_stamped
from rcdsac_trl.deploy.ros.topics import readers_of, writers_of
from rcdsac_trl.errors import UserInputError

READS: dict[str, Any] = {
    "scan": dds_types.LaserScan,
    "odom": dds_types.Odometry,
    "plan": dds_types.Path,
    "beta": dds_types.Float64,
    "stop": dds_types.Bool,
}
"""Topics that are read, and their types."""
WRITES: dict[str, Any] = {"cmd_vel": dds_types.TwistStamped, "return_quantiles": dds_types.Float32MultiArray}
"""Topics that are written, and their types; ``cmd_vel`` as :data:`UNSTAMPED` as well, for bases that read that."""
UNSTAMPED: Any = dds_types.Twist

# ROS's sensor data: readers that ask for less than writers offer meet all of them.
_SENSORS = {"scan", "odom"}
_TOPIC = re.compile(r"/?([A-Za-z_][A-Za-z0-9_]*(?:/[A-Za-z_][A-Za-z0-9_]*)*)")
# Without a message on these the robot stands.
_NEEDED = ("scan", "odom", "plan")
_MOST_ENDPOINTS = 1000
_TYPE = re.compile(r"(\w+)::(\w+)::dds_::(\w+)_")
# The samples that one reader may hold: the newest message, and word that its writer has left.
_MOST_SAMPLES = 8
_ACKNOWLEDGED_WITHIN = duration(seconds=1)


class DdsBridge:
    """Gives a driver the newest message of each topic, and publishes what it commands.

    ``scan``, ``odom`` and ``plan`` are for :class:`Driver`. ``beta`` sets its attribute (NaN: the agent's default), and
    ``stop`` calls ``stop`` or ``resume`` of its policy: both hold until the next one. Not for use from several threads
    at once.

    Args:
        driver: that is asked.
        domain_id: of DDS, ROS's ``ROS_DOMAIN_ID``.
        remapped: ROS names of topics that are called otherwise on this robot, such as ``{"plan": "/nav/path"}``.

    Attributes:
        topics: ROS name of every topic, by its name here.

    Raises:
        UserInputError: if there is no such topic, a name is none, or DDS cannot be started.
    """

    def __init__(self, driver: Driver, domain_id: int = 0, *, remapped: Mapping[str, str] | None = None) -> None:
        self.driver = driver
        self.topics = _topics(remapped or {})
        try:
            participant = DomainParticipant(domain_id)
        except DDSException as error:
            raise UserInputError(
                f"DDS cannot join domain {domain_id} ({error.msg or error}): see that ROS_DOMAIN_ID is 0 to 232, and "
                "what CYCLONEDDS_URI says, such as the network interface it names"
            ) from error
        self._readers = {
            name: DataReader(participant, self._topic(participant, name, kind), _qos(reliable=name not in _SENSORS))
            for name, kind in READS.items()
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
            writer.wait_for_acks(_ACKNOWLEDGED_WITHIN)

    def report(self) -> str:
        """Return who reads the commands, as which type, and which of the needed topics nobody writes as it is read."""
        commands = [_type_name(kind) for kind in (WRITES["cmd_vel"], UNSTAMPED)]
        said = [readers_of(f"/{self.topics['cmd_vel']}", commands, self._types("cmd_vel", "readers"))]
        for name in _NEEDED:
            kind, writers = _type_name(READS[name]), self._types(name, "writers")
            matched = bool(self._readers[name].get_matched_publications())
            said.append(writers_of(f"/{self.topics[name]}", kind, writers, matched=matched) or "")
        return "; ".join(filter(None, said))

    def _types(self, name: str, who: str) -> list[str]:
        """Return the type of each writer, or reader, of a topic that DDS has found and that has not left."""
        endpoints = self._found[who].read(_MOST_ENDPOINTS, condition=self._present[who])
        return [_ros_name(found.type_name) for found in endpoints if found.topic_name == f"rt/{self.topics[name]}"]

    def _listen(self) -> None:
        driver = self.driver
        takers = {
            "scan": driver.on_scan,
            "odom": driver.on_odometry,
            "plan": driver.on_path,
            "beta": self._on_beta,
            "stop": self._on_stop,
        }
        for name, reader in self._readers.items():
            for message in _newest(reader):
                takers[name](message)

    def _on_beta(self, message: Any) -> None:
        if message is not None:
            self.driver.beta = None if math.isnan(message.data) else message.data

    def _on_stop(self, message: Any) -> None:
        (self.driver.policy.stop if message is None or message.data else self.driver.policy.resume)()

    def _say(self, command: Command, now_s: float) -> None:
        self._writers["cmd_vel"].write(twist_stamped(command, now_s, _made))
        self._unstamped.write(twist(command, _made))
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


def _qos(*, reliable: bool) -> Qos:
    return Qos(
        Policy.Reliability.Reliable(duration(milliseconds=100)) if reliable else Policy.Reliability.BestEffort,
        Policy.Durability.Volatile,
        Policy.History.KeepLast(1),
        Policy.DataRepresentation(use_cdrv0_representation=True),  # ROS 2 knows no other
    )


def _topics(remapped: Mapping[str, str]) -> dict[str, str]:
    names = [*READS, *WRITES]
    topics = {name: name for name in names}
    for name, topic in remapped.items():
        if name not in topics:
            raise UserInputError(f"{name}:={topic} renames what there is not: choose one of {', '.join(names)}")
        match = _TOPIC.fullmatch(topic)
        if match is None:
            raise UserInputError(
                f"{name}:={topic} is no topic of ROS: give letters, digits, _ and slashes, such as /front/scan"
            )
        topics[name] = match[1]
    for name, topic in topics.items():
        if others := [other for other in names if other != name and topics[other] == topic]:
            raise UserInputError(f"{name} and {others[0]} are both called /{topic}: give each a topic of its own")
    return topics


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
