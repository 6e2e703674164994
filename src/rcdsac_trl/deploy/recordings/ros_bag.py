"""Bags of ROS 1 and ROS 2, without ROS: by ``rosbags``, the extra ``replay``."""

import contextlib
from collections.abc import Collection, Iterator, Mapping
from pathlib import Path
from typing import Any

from rcdsac_trl.deploy.recordings.sensor_recording import RecordedMessage
from rcdsac_trl.deploy.sensors.arrays import described
from rcdsac_trl.errors import UserInputError
from rcdsac_trl.robot.sectors import Mount
from rcdsac_trl.system.extras import needs


class RosBag:
    """A ``.bag`` of ROS 1; a folder, an ``.mcap`` or a ``.db3`` of ROS 2.

    Args:
        path: of the file or folder.

    Raises:
        UserInputError: if it cannot be read, or ``rosbags`` is not installed.
    """

    def __init__(self, path: Path) -> None:
        needs("rosbags", f"recording={path}", extra="replay", instead="a CARMEN log")
        self.path = path
        self.mount: Mount | None = None
        with self._opened() as reader:
            self.topics: Mapping[str, str] = {found.topic: str(found.msgtype) for found in reader.connections}

    def messages(self, topics: Collection[str]) -> Iterator[RecordedMessage]:
        """Yield what came on some topics, in the order it was recorded.

        Raises:
            UserInputError: if it cannot be read.
        """
        if not topics:
            return
        with self._opened() as reader:
            wanted = [connection for connection in reader.connections if connection.topic in topics]
            for connection, nanoseconds, raw in reader.messages(wanted):
                message = reader.deserialize(raw, connection.msgtype)
                yield RecordedMessage(1e-9 * nanoseconds, connection.topic, message)

    @contextlib.contextmanager
    def _opened(self) -> Iterator[Any]:
        from rosbags.highlevel import AnyReader
        from rosbags.typesys import Stores, get_typestore

        # Bags of before ROS 2 Iron do not say what is in their messages.
        store = get_typestore(Stores.ROS2_HUMBLE)
        try:
            with AnyReader([self.path], default_typestore=store) as reader:
                yield reader
        except (UserInputError, GeneratorExit):
            raise
        except Exception as error:  # whatever a broken file makes a library do
            raise UserInputError(
                f"{self.path} cannot be read ({described(error)}): give a whole bag; `ros2 bag reindex` repairs some"
            ) from error
