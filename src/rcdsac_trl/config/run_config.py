"""The config as checked settings: the only module that knows how a config is laid out."""

import os
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any, TypeVar

import yaml
from omegaconf import DictConfig, OmegaConf
from omegaconf.errors import OmegaConfBaseException

from rcdsac_trl.agent.network_settings import NetworkSettings
from rcdsac_trl.config.algo_settings import AlgoSettings
from rcdsac_trl.config.compose import choices
from rcdsac_trl.config.training_settings import SensorSettings, TrainingSettings
from rcdsac_trl.config.typed import read
from rcdsac_trl.deploy.policy.acting import BY_MEAN, ActingSettings
from rcdsac_trl.errors import UserInputError
from rcdsac_trl.robot.robot_settings import PAPER, RobotSettings
from rcdsac_trl.world.maps.files.file_map import FileMapSettings
from rcdsac_trl.world.maps.map_source import check_maps, with_digests
from rcdsac_trl.world.task.rules import TaskSettings

CONFIG_NAME = "config.yaml"
"""What makes a folder a run folder."""
CHECKPOINTS = "checkpoints"
"""The folder of a run's checkpoints, in the run folder."""
REPLAY = "replay"
"""The folder of the episodes that a run learns from, in the run folder."""
TRAINING_NAME = "training.yaml"
"""The config of an exported agent's training, in its folder."""

Settings = TypeVar("Settings")


def read_config(cfg: DictConfig, settings: type[Settings]) -> Settings:
    """Read a composed config as the settings class of its root, such as ``EvaluationSettings`` for ``evaluate.yaml``.

    Raises:
        UserInputError: for whatever it holds that cannot work.
    """
    return read(settings, plain(cfg))


def training_settings(cfg: DictConfig) -> TrainingSettings:
    """Read the config of a training.

    Raises:
        UserInputError: for whatever it holds that cannot work; without an algorithm, a sentence lists the choices.
    """
    return _training_settings(plain(cfg))


def settings_of_new_run(cfg: DictConfig) -> TrainingSettings:
    """Read the config of a training that is about to begin: what it asks for must be installed, too.

    Raises:
        UserInputError: as :func:`training_settings`, and for a logger or collector that cannot be had.
    """
    settings = training_settings(cfg)
    settings.logger.check_backends()
    settings.collector.check_package()
    check_maps(settings.map, settings.task.min_path_m, settings.robot.circumradius_m)
    return settings


def with_map_digests(cfg: DictConfig) -> DictConfig:
    """Return the config of a training with a note of what its map files are, so that nobody goes on with others.

    Raises:
        UserInputError: as :func:`training_settings`, or a file cannot be read.
    """
    noted = with_digests(training_settings(cfg).map)
    if not isinstance(noted, FileMapSettings):
        return cfg
    cfg = cfg.copy()
    OmegaConf.update(cfg, "map.sha256", list(noted.sha256 or ()))
    return cfg


def _training_settings(values: dict[str, Any]) -> TrainingSettings:
    algo = values.get("algo")
    if algo is None or (isinstance(algo, dict) and "name" not in algo):  # +algo.beta=-1 alone makes a section
        raise UserInputError(f"no algorithm chosen: add +algo=<name>, one of {', '.join(choices('algo'))}")
    if "protocol" in (values.get("map") or {}):
        raise UserInputError(
            "map=barn is a test, which `evaluate` drives: train on other worlds, map=file map.path=<their folder>"
        )
    return read(TrainingSettings, values)


@dataclass(frozen=True)
class AgentOfRun:
    """The sections of a run's config that say what its agent is, and nothing of how it was trained."""

    algo: AlgoSettings
    sensor: SensorSettings
    network: NetworkSettings
    task: TaskSettings
    # Runs of earlier versions name none.
    robot: RobotSettings = PAPER
    acting: ActingSettings = BY_MEAN


def agent_of_run(folder: Path) -> AgentOfRun:
    """Read what a run's agent is; runs whose training other versions would not continue can be read, too.

    Raises:
        UserInputError: as :func:`settings_of_run`.
    """
    names = ("algo", "sensor", "network", "task", "robot", "acting")
    return _of_run(folder, "run", lambda values: read(AgentOfRun, {n: values[n] for n in names if n in values}))


def settings_of_run(folder: Path, *, key: str = "run") -> TrainingSettings:
    """Read what a run was trained with.

    Args:
        folder: of the run.
        key: the key that named it, for messages.

    Raises:
        UserInputError: if the folder holds no run, or one that this version cannot read.
    """
    return _of_run(folder, key, _training_settings)


def settings_of_export(folder: Path) -> TrainingSettings:
    """Read what an exported agent was trained with.

    Raises:
        UserInputError: if its folder does not say so, or this version cannot read it.
    """
    path = folder / TRAINING_NAME
    if not path.is_file():
        raise UserInputError(
            f"{folder} holds no {TRAINING_NAME}, so nobody knows the world its agent was trained in: export it anew "
            "with this version, or name its run folder"
        )
    return _of_file(path, _training_settings)


def _of_run(folder: Path, key: str, reader: Callable[[dict[str, Any]], Settings]) -> Settings:
    path = folder / CONFIG_NAME
    if not os.path.isfile(path):  # false for a name that is too long, too
        raise UserInputError(f"{key}={folder} holds no {CONFIG_NAME}: name a folder that training wrote")
    return _of_file(path, reader)


def _of_file(path: Path, reader: Callable[[dict[str, Any]], Settings]) -> Settings:
    try:
        cfg = OmegaConf.load(path)
        if not isinstance(cfg, DictConfig):
            raise UserInputError("it holds no keys")
        return reader(_completed(plain(cfg)))
    except (OSError, ValueError, TypeError, RecursionError, yaml.YAMLError, OmegaConfBaseException) as error:
        reason = " ".join(str(error).split())
        raise UserInputError(
            f"{path} cannot be read ({reason}): mend that, or name a folder that this version wrote"
        ) from error


def _completed(values: dict[str, Any]) -> dict[str, Any]:
    """Add what runs of earlier versions do not say: their networks padded no ring."""
    if isinstance(network := values.get("network"), dict):
        values["network"] = {"padding": "none"} | network
    return values


def plain(cfg: DictConfig) -> dict[str, Any]:
    """Return a config as dictionaries, lists and plain values, its interpolations resolved."""
    return OmegaConf.to_container(cfg, resolve=True)  # type: ignore[return-value]
