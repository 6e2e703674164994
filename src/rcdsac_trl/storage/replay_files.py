"""The replay on disk: every episode is written once, into a file that never changes."""

from collections.abc import Collection, Iterator, Sequence
from hashlib import sha256
from pathlib import Path

import safetensors.torch
from tensordict import TensorDict

from rcdsac_trl.storage import atomic
from rcdsac_trl.storage.replay_segments import Segment
from rcdsac_trl.storage.sequence_replay import SequenceReplay

# What a file holds at most: writing one takes twice its size of memory. At the paper's schedule it is 100,000 steps.
_EPISODES_A_FILE = 100


class ReplayFiles:
    """Keeps the episodes of a replay in files, as compact as in memory (safetensors, nothing to unpickle).

    Args:
        folder: where the files go; made at the first :meth:`save`.
        replay: whose episodes they are.
    """

    def __init__(self, folder: Path, replay: SequenceReplay) -> None:
        self.folder = folder
        self.replay = replay
        self._segments: list[Segment] = []

    def save(self) -> list[Segment]:
        """Write the episodes that are in no file yet; what it costs depends on their number alone.

        Returns:
            The segments that together hold the replay, the oldest first. The oldest may begin with episodes that
            have left the replay.
        """
        oldest = self.replay.oldest_episode
        self._segments = [segment for segment in self._segments if segment.end > oldest]
        begin = max(oldest, self._segments[-1].end if self._segments else 0)
        added = self.replay.episodes_added
        for first in range(begin, added, _EPISODES_A_FILE):
            self._segments.append(self._write(first, min(_EPISODES_A_FILE, added - first)))
        return list(self._segments)

    def _write(self, first: int, episodes: int) -> Segment:
        stored = self.replay.stored_episodes(first, episodes)
        content = safetensors.torch.save({key: value.contiguous() for key, value in stored.items()})
        self.folder.mkdir(exist_ok=True)
        file = f"episodes-{first:08d}.safetensors"
        atomic.write(self.folder / file, content)
        return Segment(file, sha256(content).hexdigest(), first, episodes)

    def load(self, segments: Sequence[Segment]) -> None:
        """Fill the empty replay with segments that :func:`~rcdsac_trl.storage.replay_segments.damage` found whole."""
        if not segments:
            return
        oldest = _oldest(segments, self.replay)
        self.replay.restore(oldest, _read(self.folder, segments, self.replay))
        self._segments = list(segments)


def inherit(folder: Path, segments: Sequence[Segment], replay: SequenceReplay) -> None:
    """Fill an empty replay with the newest episodes of another run, as many as it holds; they are its first ones.

    Args:
        folder: of the other run's replay.
        segments: that :func:`~rcdsac_trl.storage.replay_segments.damage` found whole.
        replay: of the same sensor, observations and episodes.
    """
    replay.restore(0, _read(folder, segments, replay))


def _oldest(segments: Sequence[Segment], replay: SequenceReplay) -> int:
    return max(segments[0].first_episode, segments[-1].end - replay.capacity_episodes)


def _read(folder: Path, segments: Sequence[Segment], replay: SequenceReplay) -> Iterator[TensorDict]:
    oldest = _oldest(segments, replay)
    for segment in segments:
        if segment.end > oldest:
            tensors = safetensors.torch.load_file(folder / segment.file)
            stored = TensorDict(tensors, batch_size=[segment.episodes, replay.episode_steps + 1])
            yield stored[max(0, oldest - segment.first_episode) :]


def remove_others(folder: Path, kept: Collection[str]) -> None:
    """Remove the files of a replay's folder that have none of these names."""
    for path in folder.glob("*.safetensors"):
        if path.name not in kept:
            path.unlink()
