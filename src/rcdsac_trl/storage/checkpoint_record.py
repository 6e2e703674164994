"""What is saved of a run: reading the records of checkpoints, and finding the one that is asked for.

A checkpoint's record (``checkpoint.json``) holds the SHA-256 of every file in its folder, the files of the replay, the
lengths of the logs and the progress, which names the best checkpoint so far. So no pointer has to be kept in step:
``last`` is the newest checkpoint that is whole, ``best`` the one it names; any other goes by its iterations.
"""

import json
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from hashlib import sha256
from pathlib import Path
from typing import Any

from rcdsac_trl.config.checkpoint_name import CheckpointName
from rcdsac_trl.errors import UserInputError
from rcdsac_trl.storage import atomic as durable
from rcdsac_trl.storage import replay_segments
from rcdsac_trl.storage.replay_segments import Segment

FORMAT_VERSION = 1
_RECORD = "checkpoint.json"


class DamagedError(Exception):
    """A checkpoint is not whole; the message says what is wrong with it."""


@dataclass(frozen=True)
class Progress:
    """How far a run is, after whole iterations.

    Attributes:
        iterations: done.
        steps: agent steps driven.
        updates: done.
        elapsed_s: time spent training, s.
        best_score: highest validation score so far; None before the first validation.
        best_iterations: iterations done when it was reached.
        restarts: how often worker processes died or hung.
        skipped_maps: training maps that were given up for that, or that the run of ``init`` has had; iteration i is on
            map i + skipped_maps.
        validating_iterations: iterations done by the agent whose validation is under way; None: there is none.
    """

    iterations: int = 0
    steps: int = 0
    updates: int = 0
    elapsed_s: float = 0.0
    best_score: float | None = None
    best_iterations: int | None = None
    restarts: int = 0
    skipped_maps: int = 0
    validating_iterations: int | None = None


@dataclass(frozen=True)
class Saved:
    """What the record of a checkpoint says.

    Attributes:
        path: the checkpoint's folder.
        progress: of the run.
        segments: files of the replay.
        logs: length of every log file, bytes.
        files: SHA-256 of every file in the folder.
    """

    path: Path
    progress: Progress
    segments: tuple[Segment, ...]
    logs: Mapping[str, int]
    files: Mapping[str, str]


def newest(folder: Path, *, replay: Path | None = None) -> tuple[Saved, list[str]]:
    """Find the newest checkpoint that is whole.

    Args:
        folder: holds the checkpoints of a run.
        replay: folder of the replay's files; they are checked too, as one who continues needs them.

    Returns:
        The checkpoint, and one sentence for each newer one that is damaged.

    Raises:
        UserInputError: if there is none, or none that is whole, or one of another version.
    """
    damaged: list[str] = []
    for path in reversed(folders(folder)):
        try:
            saved = checked(path)
            if replay is not None and (reason := replay_segments.damage(replay, saved.segments)) is not None:
                raise DamagedError(reason)
            return saved, damaged
        except DamagedError as error:
            if not path.exists():  # the training that writes here has just removed it, and saved a newer one
                return newest(folder, replay=replay)
            damaged.append(f"checkpoint {path} is damaged: {error}")
    if damaged:
        raise UserInputError(f"no checkpoint in {folder} is whole: {'; '.join(damaged)}")
    if (folder / "last").exists():
        raise UserInputError(
            f"{folder} was written by an earlier version, this one reads format {FORMAT_VERSION} of checkpoints: "
            "use the commit that the run's manifest.json names"
        )
    raise UserInputError(f"there is no checkpoint in {folder}: has this run saved one yet?")


def find(folder: Path, name: CheckpointName) -> tuple[Saved, list[str]]:
    """Find a checkpoint of a run; see :func:`newest`.

    Raises:
        UserInputError: as :func:`newest`, and if the named one does not exist or is damaged.
    """
    last, damaged = newest(folder)
    if name == "last":
        return last, damaged
    iterations = last.progress.best_iterations if name == "best" else name
    if iterations is None:
        raise UserInputError(f"there is no best checkpoint in {folder}: has this run validated yet?")
    path = folder / folder_name(iterations)
    if name != "best" and not path.is_dir():
        kept = ", ".join(path.name for path in folders(folder))
        raise UserInputError(
            f"checkpoint={name} is not in {folder}, which holds {kept}: a training keeps more with checkpoint.keep"
        )
    try:
        return checked(path), damaged
    except DamagedError as error:
        which = "the best checkpoint" if name == "best" else "checkpoint"
        raise UserInputError(f"{which} {path} is damaged: {error}; checkpoint=last is whole") from error


def best_damage(folder: Path, progress: Progress) -> str | None:
    """Say what is wrong with the best checkpoint that some progress names; None if it is whole or there is none."""
    if progress.best_iterations is None:
        return None
    path = folder / folder_name(progress.best_iterations)
    try:
        checked(path)
    except DamagedError as error:
        return f"the best checkpoint {path} is damaged: {error}; the next validation finds a new best one"
    return None


def folder_name(iterations: int) -> str:
    """Name the folder of the checkpoint after some iterations."""
    return f"iteration-{iterations:06d}"


def folders(folder: Path) -> list[Path]:
    """List the checkpoints, the oldest first."""
    return sorted(folder.glob("iteration-*"))


def _files(folder: Path) -> list[str]:
    return sorted(path.relative_to(folder).as_posix() for path in folder.rglob("*") if path.is_file())


def _digest(version: int, content: Mapping[str, Any]) -> str:
    return sha256(json.dumps([version, content], sort_keys=True).encode()).hexdigest()


def write_record(folder: Path, progress: Progress, segments: Sequence[Segment], logs: Mapping[str, int]) -> None:
    """Write the record of a checkpoint whose other files are all in the folder."""
    content = {
        "progress": asdict(progress),
        "replay": [asdict(segment) for segment in segments],
        "logs": dict(logs),
        "files": {name: durable.sha256_of(folder / name) for name in _files(folder)},
    }
    written = {"format_version": FORMAT_VERSION, "sha256": _digest(FORMAT_VERSION, content), **content}
    (folder / _RECORD).write_text(json.dumps(written, indent=1) + "\n", encoding="utf-8")


def record(path: Path) -> Saved:
    """Read the record of a checkpoint; it vouches for itself."""
    try:
        content = json.loads((path / _RECORD).read_bytes())
        version, digest = content.pop("format_version"), content.pop("sha256")
    except FileNotFoundError as error:
        raise DamagedError(f"{_RECORD} is missing") from error
    except (OSError, ValueError, KeyError, AttributeError, TypeError) as error:
        raise DamagedError(f"{_RECORD} cannot be read") from error
    if digest != _digest(version, content):
        raise DamagedError(f"{_RECORD} does not hold what was written")
    if version != FORMAT_VERSION:
        raise UserInputError(
            f"checkpoint {path} is of format {version}, this version reads format {FORMAT_VERSION}: use the commit "
            "that the run's manifest.json names"
        )
    segments = tuple(Segment(**segment) for segment in content["replay"])
    return Saved(path, Progress(**content["progress"]), segments, content["logs"], content["files"])


def record_or_none(path: Path) -> Saved | None:
    """Read a checkpoint's record, unless it is damaged."""
    try:
        return record(path)
    except DamagedError:
        return None


def checked(path: Path) -> Saved:
    """Read a checkpoint's record and compare every file with it."""
    saved = record(path)
    for name, expected in saved.files.items():
        if (reason := durable.damage(path / name, expected)) is not None:
            raise DamagedError(f"{name} {reason}")
    return saved
