"""Checkpoints of a run: one folder each, which never changes once it has its name.

``checkpoints/iteration-000012`` is the whole state after 12 iterations: :mod:`torchrl.checkpoint` writes the
components, :mod:`rcdsac_trl.storage.checkpoint_record` the record around them, and :mod:`rcdsac_trl.storage.atomic`
sees to it that the folder is whole or absent.
"""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import torch
from torch.optim.swa_utils import AveragedModel
from torchrl.checkpoint import Checkpoint, CheckpointError, StateDictCheckpointAdapter
from torchrl.objectives import LossModule

from rcdsac_trl.config.checkpoint_name import CheckpointName
from rcdsac_trl.errors import UserInputError
from rcdsac_trl.storage import atomic as durable
from rcdsac_trl.storage import replay_files
from rcdsac_trl.storage.checkpoint_record import (
    Progress,
    Saved,
    checked,
    find,
    folder_name,
    folders,
    record_or_none,
    write_record,
)
from rcdsac_trl.storage.replay_files import ReplayFiles

# What a checkpoint holds beside its tensors.
_ROOM_BYTES = 1 << 20


class Generators:
    """Named random generators as one component with a ``state_dict``."""

    def __init__(self, **generators: torch.Generator) -> None:
        self._generators = generators

    def state_dict(self) -> dict[str, torch.Tensor]:
        """Return the state of each."""
        return {name: generator.get_state() for name, generator in self._generators.items()}

    def load_state_dict(self, state: Mapping[str, torch.Tensor]) -> None:
        """Set the state of each."""
        for name, generator in self._generators.items():
            generator.set_state(state[name])


class Checkpoints:
    """Saves and restores the components of a run.

    Args:
        folder: where checkpoints go.
        components: what is saved, by name; each has ``state_dict`` and ``load_state_dict``.
        replay: the files of the replay, which checkpoints name; None: the replay is not saved.
        keep: how many of the newest checkpoints stay; those they name, the best one and the one whose validation is
            under way, stay as well.

    Attributes:
        saved_iterations: iterations done at the last checkpoint that was saved or restored; None before.
    """

    def __init__(self, folder: Path, components: Mapping[str, Any], *, replay: ReplayFiles | None, keep: int) -> None:
        self.folder = folder
        self.replay = replay
        self.keep = keep
        self.saved_iterations: int | None = None
        self._components = dict(components)
        self._checkpoint = Checkpoint()
        for name, component in components.items():
            # One file for all tensors of a component: a checkpoint is soon on the disk, and soon hashed.
            self._checkpoint.register(name, component, adapter=StateDictCheckpointAdapter("consolidated"))

    def save(self, progress: Progress, logs: Mapping[str, int]) -> Path:
        """Save everything, remove what is then too old, and return the checkpoint's folder.

        Args:
            progress: of the run.
            logs: length of every log file, which must be on the disk up to there.
        """
        self.folder.mkdir(parents=True, exist_ok=True)
        durable.clear_leftovers(self.folder)
        segments = [] if self.replay is None else self.replay.save()
        path = self.folder / folder_name(progress.iterations)
        temporary = durable.unfinished(path)
        # TorchRL writes tensors through memory.
        durable.reserve(self.folder, self.size_bytes() + _ROOM_BYTES)
        self._checkpoint.save(temporary)
        write_record(temporary, progress, segments, logs)
        durable.publish(path)
        self.saved_iterations = progress.iterations
        rotate(self.folder, keep=self.keep, replay=None if self.replay is None else self.replay.folder)
        return path

    def size_bytes(self) -> int:
        """Return how many bytes the tensors of all components have now; optimisers get theirs at their first step."""
        return sum(_tensor_bytes(component.state_dict()) for component in self._components.values())

    def restore(self, saved: Saved) -> None:
        """Load a checkpoint that is whole, and forget everything that was saved after it.

        Raises:
            UserInputError: if it is of another shape.
        """
        _load(self._checkpoint, saved.path)
        for path in folders(self.folder):
            if path.name > saved.path.name:
                durable.remove_folder(path)
        durable.clear_leftovers(self.folder)
        if self.replay is not None:
            self.replay.load(saved.segments)
            named = {segment.file for segment in saved.segments} | _named_segments(self.folder, self.keep)
            replay_files.remove_others(self.replay.folder, named)
        self.saved_iterations = saved.progress.iterations


def rotate(folder: Path, *, keep: int, replay: Path | None) -> None:
    """Remove the checkpoints that are too old, and the files of the replay that only they need.

    Args:
        folder: holds the checkpoints.
        keep: how many of the newest stay; those they name, the best one and the one whose validation is under way,
            stay as well.
        replay: folder of the replay's files; None: the replay is not saved.
    """
    newest = folders(folder)[-keep:]
    records = [record for path in newest if (record := record_or_none(path)) is not None]
    named = {record.progress.best_iterations for record in records}
    named |= {record.progress.validating_iterations for record in records}
    kept = {path.name for path in newest} | {folder_name(number) for number in named if number is not None}
    for path in folders(folder):
        if path.name not in kept:
            durable.remove_folder(path)
    durable.clear_leftovers(folder)
    if replay is not None:
        replay_files.remove_others(replay, _named_segments(folder, keep))


def _named_segments(folder: Path, keep: int) -> set[str]:
    """Name the files of the replay that one needs to continue from a checkpoint that stays."""
    records = [record_or_none(path) for path in folders(folder)[-keep:]]
    return {segment.file for record in records if record is not None for segment in record.segments}


def load_weights(
    folder: Path, name: CheckpointName, *, loss: LossModule | None = None, average: AveragedModel | None = None
) -> list[str]:
    """Load the weights of a checkpoint into a loss, an averaged actor, or both, of the same shape.

    Returns:
        One sentence for each damaged checkpoint that was passed over.

    Raises:
        UserInputError: as :func:`find`, or if the checkpoint is of another shape.
    """
    saved, damaged = find(folder, name)
    wanted = {"loss": loss, "average": average}
    _load(Checkpoint(**{key: module for key, module in wanted.items() if module is not None}), saved.path)
    return damaged


def load_average(path: Path, average: AveragedModel) -> Saved:
    """Load the averaged actor of one checkpoint, and return the checkpoint's record.

    Raises:
        DamagedError: if the checkpoint is not whole.
        UserInputError: if it is of another shape.
    """
    saved = checked(path)
    _load(Checkpoint(average=average), path)
    return saved


def load_optimizer(path: Path, optimizer: torch.optim.Optimizer) -> None:
    """Load the optimiser's state of one checkpoint into an optimiser of the same networks.

    Raises:
        UserInputError: if the checkpoint is of another shape.
    """
    _load(Checkpoint(optimizer=optimizer), path)


class _State:
    """Takes a component's state as it was saved."""

    def __init__(self) -> None:
        self.state: Mapping[str, torch.Tensor] = {}

    def state_dict(self) -> Mapping[str, torch.Tensor]:
        return self.state

    def load_state_dict(self, state: Mapping[str, torch.Tensor]) -> None:
        self.state = state


def load_states(folder: Path, name: CheckpointName) -> tuple[Saved, dict[str, Mapping[str, torch.Tensor]], list[str]]:
    """Load the tensors of a checkpoint's loss and averaged actor by name, without making either.

    Returns:
        The checkpoint, the states of ``loss`` and ``average``, and what :func:`load_weights` returns.

    Raises:
        UserInputError: as :func:`find`.
    """
    saved, damaged = find(folder, name)
    states = {"loss": _State(), "average": _State()}
    _load(Checkpoint(**states), saved.path)
    return saved, {key: component.state for key, component in states.items()}, damaged


def _tensor_bytes(state: Any) -> int:
    if isinstance(state, torch.Tensor):
        return state.nbytes
    values: Any = state.values() if isinstance(state, Mapping) else state if isinstance(state, list | tuple) else ()
    return sum(_tensor_bytes(value) for value in values)


def _load(checkpoint: Checkpoint, path: Path) -> None:
    try:
        checkpoint.load(path, map_location="cpu")
    except CheckpointError as error:
        reason = " ".join(str(error).split())
        raise UserInputError(f"checkpoint {path} does not fit this version ({reason}): use the one it is of") from error
