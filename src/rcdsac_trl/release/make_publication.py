"""A publication from its config."""

from pathlib import Path

from omegaconf import DictConfig

from rcdsac_trl.config.run_config import publish_settings
from rcdsac_trl.errors import UserInputError
from rcdsac_trl.release.publication import Publication, Published, evaluation_of
from rcdsac_trl.release.run_weights import weights_of_run
from rcdsac_trl.system.resources import check_writable


def make_publication(cfg: DictConfig) -> Publication:
    """Make a publication; refuses before anything is written.

    Raises:
        UserInputError: for a run that is missing or not evaluated, two of one name, or a name that is taken.
    """
    settings = publish_settings(cfg)
    agents: dict[str, Published] = {}
    for run in map(Path, settings.runs):
        weights = weights_of_run(run, settings.checkpoint)
        name = f"{weights.config.name}-{weights.config.sensor}"
        if name in agents:
            raise UserInputError(f"{agents[name].run} and {run} are both {name}: publish one of them")
        agents[name] = Published(run, weights, evaluation_of(run, settings.checkpoint))
    for folder in (Path(settings.weights), Path(settings.results)):
        check_writable(folder)
        for name in agents:
            if (folder / name).exists():
                raise UserInputError(f"{folder / name} exists: remove it, or publish into another folder")
    return Publication(agents, Path(settings.weights), Path(settings.results))
