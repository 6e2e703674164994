"""The agent that ``run=`` names, for every command that takes one: of a run folder, exported, or shipped."""

import math
import sys
from abc import ABC, abstractmethod
from dataclasses import dataclass, replace
from functools import cached_property
from hashlib import sha256
from pathlib import Path
from typing import Any

import torch
from torch.optim.swa_utils import AveragedModel
from torchrl.objectives import LossModule

from rcdsac_trl.config.checkpoint_name import CheckpointName
from rcdsac_trl.config.named_folder import find_agent
from rcdsac_trl.config.run_config import (
    CHECKPOINTS,
    CONFIG_NAME,
    TRAINING_NAME,
    settings_of_export,
    settings_of_run,
)
from rcdsac_trl.config.training_settings import TrainingSettings
from rcdsac_trl.deploy.policy.acting import ActingSettings
from rcdsac_trl.deploy.policy.recalibration import Recalibration
from rcdsac_trl.deploy.policy.registry import is_shipped
from rcdsac_trl.deploy.policy.weights import WEIGHTS_NAME, Weights, digest_of, halved, read_weights
from rcdsac_trl.errors import UserInputError
from rcdsac_trl.release.run_weights import TEMPERATURE, agent_config, states_of_weights, weights_of_run
from rcdsac_trl.rollout.make_agent import make_average, make_loss
from rcdsac_trl.storage.checkpoint import load_weights
from rcdsac_trl.storage.checkpoint_record import find


class NamedAgent(ABC):
    """A trained agent, wherever it lies."""

    @property
    @abstractmethod
    def settings(self) -> TrainingSettings:
        """What it was trained with.

        Raises:
            UserInputError: if nothing says so.
        """

    @property
    @abstractmethod
    def described(self) -> dict[str, Any]:
        """Which agent it is, for the descriptions of results."""

    @property
    @abstractmethod
    def out(self) -> Path:
        """The folder below which results go unless a user says otherwise."""

    @property
    @abstractmethod
    def stem(self) -> str:
        """What tells its results from those of others in that folder; may be empty."""

    def folder_of(self, kind: str, name: str) -> Path:
        """Return where results go unless a user says otherwise.

        Args:
            kind: of the results, such as ``"evaluation"``.
            name: what tells them from others of this agent.
        """
        return self.out / kind / "-".join(part for part in (self.stem, name) if part)

    @property
    @abstractmethod
    def training(self) -> bytes | None:
        """The config of its training, as a file; None where there is none."""

    @abstractmethod
    def recalibration(self, acting: ActingSettings) -> Recalibration | None:
        """Return by what it tells the quantiles of the return; None: as its critics say them.

        Args:
            acting: how it acts; set to act otherwise than it was measured, it earns something else.
        """

    @abstractmethod
    def weights(self) -> Weights:
        """Read it as a robot does."""

    @abstractmethod
    def check(self) -> None:
        """Refuse, before work starts, what cannot be loaded."""

    @abstractmethod
    def load(self) -> tuple[LossModule, AveragedModel]:
        """Load the loss with its actor and critics, and the averaged actor, which is what drives."""

    @abstractmethod
    def load_critics(self) -> LossModule:
        """Load the loss with what its critics are about: the actor whose returns they predict, and the temperature.

        Raises:
            UserInputError: if the temperature is not known.
        """


@dataclass(frozen=True)
class RunAgent(NamedAgent):
    """The agent of a run at a checkpoint.

    Attributes:
        folder: of the run.
        checkpoint: which of them.
        half_precision: take the averaged actor and the critics as :mod:`~rcdsac_trl.release.publication` ships them.
    """

    folder: Path
    checkpoint: CheckpointName
    half_precision: bool = False

    @cached_property
    def settings(self) -> TrainingSettings:
        """What it was trained with."""
        return settings_of_run(self.folder)

    @property
    def described(self) -> dict[str, Any]:
        """Its checkpoint; and the digest of the weights that would ship, where these are taken."""
        shipped = {"weights_sha256": digest_of(self._shipped, half=True)} if self.half_precision else {}
        return {"checkpoint": self.checkpoint} | shipped

    @property
    def out(self) -> Path:
        """The run folder."""
        return self.folder

    @property
    def stem(self) -> str:
        """The checkpoint, and whether it is taken as it ships."""
        return f"{self.checkpoint}{'-half' if self.half_precision else ''}"

    @property
    def training(self) -> bytes:
        """The run's config."""
        return (self.folder / CONFIG_NAME).read_bytes()

    def recalibration(self, acting: ActingSettings) -> None:
        """Return nothing: what is published or exported of a run gets it."""

    def weights(self) -> Weights:
        """Read the averaged actor and the critics."""
        return self._shipped if self.half_precision else weights_of_run(self.folder, self.checkpoint)

    @cached_property
    def _shipped(self) -> Weights:
        """Read once: a training that goes on may write another checkpoint meanwhile."""
        return halved(weights_of_run(self.folder, self.checkpoint))

    def check(self) -> None:
        """Refuse a checkpoint that is not there, or damaged."""
        find(self.folder / CHECKPOINTS, self.checkpoint)

    def load(self) -> tuple[LossModule, AveragedModel]:
        """Load both from the checkpoint, or what would ship of it."""
        if self.half_precision:
            return _load(self._shipped, self.settings)
        loss = make_loss(self.settings, "cpu")
        average = make_average(loss, self.settings.learner)
        for damaged in load_weights(self.folder / CHECKPOINTS, self.checkpoint, loss=loss, average=average):
            print(f"rcdsac_trl: {damaged}", file=sys.stderr)
        return loss, average

    def load_critics(self) -> LossModule:
        """Load the loss as training left it."""
        return self.load()[0]


@dataclass(frozen=True)
class ExportedAgent(NamedAgent):
    """An agent of a weights folder: exported, or shipped with the package."""

    folder: Path
    read: Weights

    @cached_property
    def settings(self) -> TrainingSettings:
        """What it was trained with; how it acts may have been chosen when it was exported."""
        config = self.read.config
        settings = replace(settings_of_export(self.folder), acting=config.acting)
        trained = agent_config(settings, settings.learner.num_critics, config.provenance)
        if replace(trained, recalibration=config.recalibration) != config:  # which no training has
            raise UserInputError(f"{self.folder}: {TRAINING_NAME} is of another agent than the weights: export it anew")
        return settings

    @property
    def described(self) -> dict[str, Any]:
        """Of which checkpoint it is, and the weights' digest: the name stays, another version ships other weights."""
        digest = sha256((self.folder / WEIGHTS_NAME).read_bytes()).hexdigest()
        return {"checkpoint": self.read.config.provenance.get("checkpoint"), "weights_sha256": digest}

    @property
    def out(self) -> Path:
        """Its folder; for a shipped one, which lies in the package, where the user is."""
        return Path() if self._is_shipped else self.folder

    @property
    def stem(self) -> str:
        """The name of a shipped one; a folder needs none."""
        return self.folder.name if self._is_shipped else ""

    @property
    def _is_shipped(self) -> bool:
        return is_shipped(self.folder)

    @property
    def training(self) -> bytes | None:
        """What was exported with it."""
        path = self.folder / TRAINING_NAME
        return path.read_bytes() if path.is_file() else None

    def recalibration(self, acting: ActingSettings) -> Recalibration | None:
        """Return what it was written with, where it acts as it does by itself."""
        config = self.read.config
        return config.recalibration if acting == config.acting else None

    def weights(self) -> Weights:
        """Return what was read."""
        return self.read

    def check(self) -> None:
        """Do nothing: it was read as a whole."""

    def load(self) -> tuple[LossModule, AveragedModel]:
        """Load both."""
        return _load(self.read, self.settings)

    def load_critics(self) -> LossModule:
        """Load them as the export has written them down."""
        if _temperature(self.read) is None:
            raise UserInputError(
                f"{self.folder} does not say at which temperature its critics were trained, which the returns that "
                "they predict depend on: export the agent anew, or name its run folder"
            )
        return self.load()[0]


def _load(weights: Weights, trained: TrainingSettings) -> tuple[LossModule, AveragedModel]:
    """Load loss and averaged actor, which is the only one here and stands for the learning one as well.

    The loss gets the temperature, too, where that is known.
    """
    loss = make_loss(trained, "cpu")
    average = make_average(loss, trained.learner)
    of_loss, of_average = states_of_weights(weights)
    loss.load_state_dict(loss.state_dict() | of_loss)
    average.load_state_dict(average.state_dict() | of_average)
    if (temperature := _temperature(weights)) is not None:
        with torch.no_grad():
            loss.log_alpha.fill_(math.log(temperature))
    return loss, average


def _temperature(weights: Weights) -> float | None:
    """Return what an agent's critics were trained at, if its files say so."""
    temperature = weights.config.provenance.get(TEMPERATURE)
    return temperature if isinstance(temperature, int | float) and 0.0 < temperature < math.inf else None


def named_agent(
    named: str | Path, checkpoint: CheckpointName | None = None, *, half_precision: bool = False
) -> NamedAgent:
    """Return the agent of a name: a run folder, a folder that ``export`` wrote, or an agent that is shipped.

    See :func:`~rcdsac_trl.config.named_folder.find_agent`.

    Args:
        named: what the user says.
        checkpoint: of a run, ``"best"`` where it is None; an exported agent is of one checkpoint, and has no choice.
        half_precision: of a run: take it as it would ship; an exported agent is what it is, and has no choice.

    Raises:
        UserInputError: if there is no such agent, or its weights cannot be read.
    """
    found = find_agent(named, checkpoint, half_precision=half_precision)
    if found.is_run:
        return RunAgent(found.path, "best" if checkpoint is None else checkpoint, half_precision)
    return ExportedAgent(found.path, read_weights(found.path))
