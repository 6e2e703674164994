"""Checkpoints of a run: ``last`` (the newest) and ``best`` (the highest validation score)."""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import torch
from torch.optim.swa_utils import AveragedModel
from torchrl.checkpoint import Checkpoint
from torchrl.objectives import LossModule

from rcdsac_trl.errors import UserInputError


class Checkpoints:
    """Saves a loss (all weights, targets and temperature), the averaged actor and the optimiser.

    Built on :mod:`torchrl.checkpoint`.

    Args:
        folder: where ``last`` and ``best`` go.
        loss: the loss module; holds every weight that is learnt.
        average: the running average of its actor.
        optimizer: its optimiser.
    """

    def __init__(
        self, folder: Path, loss: LossModule, average: AveragedModel, optimizer: torch.optim.Optimizer
    ) -> None:
        self.folder = folder
        self._checkpoint = Checkpoint(loss=loss, average=average, optimizer=optimizer)

    def save(self, name: str, progress: Mapping[str, Any]) -> Path:
        """Write a checkpoint; `progress` is kept in its manifest."""
        return self._checkpoint.save(self.folder / name, metadata=dict(progress))


def load_manifest(folder: Path, name: str) -> dict[str, Any]:
    """Read what was saved with a checkpoint, without its weights.

    Raises:
        UserInputError: if there is no such checkpoint.
    """
    path = folder / name
    if not Checkpoint.is_checkpoint(path):
        raise UserInputError(f"there is no checkpoint {path}: has this run saved one yet?")
    return dict(Checkpoint.manifest(path)["metadata"])


def load_weights(
    folder: Path, name: str, *, loss: LossModule | None = None, average: AveragedModel | None = None
) -> dict[str, Any]:
    """Load the weights of a checkpoint into a loss, an averaged actor, or both, of the same shape.

    Returns:
        The progress that was saved with them.

    Raises:
        UserInputError: if there is no such checkpoint.
    """
    progress = load_manifest(folder, name)
    wanted = {"loss": loss, "average": average}
    components = {key: module for key, module in wanted.items() if module is not None}
    Checkpoint(**components).load(folder / name, components=list(components))
    return progress
