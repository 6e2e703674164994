"""Which folder ``run=`` names, and what its agent was trained with; without torch."""

import os
from dataclasses import dataclass
from pathlib import Path

from rcdsac_trl.config.checkpoint_name import CheckpointName
from rcdsac_trl.config.compose import compose
from rcdsac_trl.config.run_config import (
    CHECKPOINTS,
    CONFIG_NAME,
    settings_of_export,
    settings_of_run,
    training_settings,
)
from rcdsac_trl.config.training_settings import TrainingSettings
from rcdsac_trl.deploy.policy.registry import find_weights
from rcdsac_trl.deploy.policy.weights import read_agent_config
from rcdsac_trl.errors import UserInputError


@dataclass(frozen=True)
class NamedFolder:
    """The folder of a trained agent.

    Attributes:
        path: where it is.
        is_run: whether training wrote it; else it holds an exported agent.
    """

    path: Path
    is_run: bool

    def settings(self) -> TrainingSettings:
        """Read what the agent was trained with.

        Raises:
            UserInputError: if nothing says so, or this version cannot read it.
        """
        return settings_of_run(self.path) if self.is_run else settings_of_export(self.path)


def find_agent(
    named: str | Path, checkpoint: CheckpointName | None = None, *, half_precision: bool = False
) -> NamedFolder:
    """Return the folder of a name: of a run, one that ``export`` wrote, or that of an agent that is shipped.

    A run folder comes first, then a weights folder, then a shipped agent.

    Args:
        named: what the user says.
        checkpoint: that was chosen; None: none was.
        half_precision: whether its weights are to be rounded.

    Raises:
        UserInputError: if there is none, or what is there is one agent as it was written, which leaves no such choice.
    """
    found = _find(named)
    if found.is_run:
        return found
    if half_precision:
        raise UserInputError(
            f"half_precision=true rounds the agent of a run, and run={named} is one that has been written: leave it out"
        )
    if checkpoint is not None:
        own = read_agent_config(found.path)[0].provenance.get("checkpoint")
        if checkpoint != own:
            raise UserInputError(
                f"checkpoint={checkpoint} chooses among those of a run, and run={named} is one agent, of checkpoint "
                f"{own}: leave it out"
            )
    return found


def _find(named: str | Path) -> NamedFolder:
    folder = Path(named)
    if os.path.isdir(folder / CHECKPOINTS):  # false for a name that is too long, too
        return NamedFolder(folder, is_run=True)
    try:
        return NamedFolder(find_weights(named), is_run=False)
    except UserInputError:
        if not os.path.isfile(folder / CONFIG_NAME):
            raise
    return NamedFolder(folder, is_run=True)


def default_training() -> TrainingSettings:
    """Return training's defaults: baselines drive in their world, whichever agent would be trained there."""
    return training_settings(compose("train", ["+algo=sac"]))
