"""What the files of a replay are called and hold; without torch, as the records of checkpoints are read."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from rcdsac_trl.storage import atomic


@dataclass(frozen=True)
class Segment:
    """One file of consecutive episodes.

    Attributes:
        file: its name in the folder.
        sha256: of its content.
        first_episode: number of its first episode, counted from 0 as the replay does.
        episodes: how many it holds.
    """

    file: str
    sha256: str
    first_episode: int
    episodes: int

    @property
    def end(self) -> int:
        """Number of the first episode behind it."""
        return self.first_episode + self.episodes


def damage(folder: Path, segments: Sequence[Segment]) -> str | None:
    """Say what is wrong with the files of some segments; None if they are whole."""
    for segment in segments:
        if (reason := atomic.damage(folder / segment.file, segment.sha256)) is not None:
            return f"{folder / segment.file} {reason}"
    return None
