"""Which kind of recording a path is."""

from pathlib import Path

from rcdsac_trl.deploy.recordings.carmen_log import CarmenLog, is_carmen_log
from rcdsac_trl.deploy.recordings.ros_bag import RosBag
from rcdsac_trl.deploy.recordings.sensor_recording import SensorRecording
from rcdsac_trl.errors import UserInputError

_BAGS = (".bag", ".mcap", ".db3")
_KINDS = "a ROS bag (.bag, a folder with metadata.yaml, .mcap, .db3) or a CARMEN log"


def open_recording(path: Path) -> SensorRecording:
    """Return a recording, whatever wrote it.

    Raises:
        UserInputError: if there is none, it is of no kind that is known, or it cannot be read.
    """
    try:
        is_there = path.exists()
    except OSError as error:  # such as a name that is too long
        raise UserInputError(f"recording={path} cannot be a file ({error.strerror}): give another") from error
    if not is_there:
        raise UserInputError(f"recording={path} does not exist: give {_KINDS}")
    if path.is_dir() and not (path / "metadata.yaml").is_file():
        raise UserInputError(f"recording={path} is a folder without metadata.yaml: give {_KINDS}")
    if path.is_dir() or path.suffix in _BAGS:
        return RosBag(path)
    if is_carmen_log(path):
        return CarmenLog(path)
    raise UserInputError(f"recording={path} is of no kind that is known: give {_KINDS}")
