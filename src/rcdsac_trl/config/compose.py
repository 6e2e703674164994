"""Configs composed as the command line does, and the one sentence for whatever Hydra refuses."""

import re
from contextlib import nullcontext
from pathlib import Path

import hydra
from hydra._internal.core_plugins.basic_sweeper import BasicSweeper
from hydra.core.global_hydra import GlobalHydra
from hydra.core.override_parser.overrides_parser import OverridesParser
from hydra.core.override_parser.types import Override
from hydra.errors import HydraException, OverrideParseException
from omegaconf import DictConfig, OmegaConf
from omegaconf.errors import OmegaConfBaseException

from rcdsac_trl.config.paths import CONF_DIR
from rcdsac_trl.config.typed import unknown_key
from rcdsac_trl.errors import UserInputError


def output_folder(config_name: str, overrides: list[str]) -> Path:
    """Return the folder that a run would write into."""
    return _folder(config_name, overrides, "run")


def sweep_folder(config_name: str, overrides: list[str]) -> Path:
    """Return the folder that holds those of a multirun."""
    return _folder(config_name, overrides, "sweep")


def _folder(config_name: str, overrides: list[str], mode: str) -> Path:
    folder = _compose(config_name, overrides, return_hydra_config=True).hydra[mode].dir
    if not folder:
        raise UserInputError(f"hydra.{mode}.dir names no folder: give it one, or leave it out")
    return Path(folder)


def combinations(overrides: list[str]) -> list[list[str]]:
    """Split the overrides of a multirun as Hydra's own sweeper does; the last of several for one key holds."""
    parsed = parse(overrides)
    return [job for batch in BasicSweeper.split_arguments(parsed, max_batch_size=None) for job in batch]


def parse(overrides: list[str]) -> list[Override]:
    """Read overrides.

    Raises:
        UserInputError: one sentence for what is no override.
    """
    try:
        return OverridesParser.create().parse_overrides(overrides)
    except HydraException as error:
        raise UserInputError(_sentence(error, "", overrides)) from error


def key_of(override: str) -> str:
    """Return the key that an override is about.

    Example:
        >>> key_of("+experiment=table"), key_of("learner.gamma=0.9")
        ('experiment', 'learner.gamma')
    """
    return override.lstrip("+~").partition("=")[0]


def compose(config_name: str, overrides: list[str]) -> DictConfig:
    """Compose a config as the command line does.

    Raises:
        UserInputError: one sentence for whatever Hydra refuses.
    """
    cfg = _compose(config_name, overrides)
    try:
        OmegaConf.to_container(cfg, resolve=True)
    except OmegaConfBaseException as error:
        raise UserInputError(" ".join(str(error).split())) from error
    return cfg


def _compose(config_name: str, overrides: list[str], *, return_hydra_config: bool = False) -> DictConfig:
    for override in overrides:
        if not key_of(override).partition("@")[0].strip():  # Hydra fails an assertion
            raise UserInputError(f"{override} names no key: write it as <key>=<value>")
    # Inside a Hydra main the search path is set up already, and setting it up twice is an error.
    inside = GlobalHydra.instance().is_initialized()
    with nullcontext() if inside else hydra.initialize_config_dir(str(CONF_DIR), version_base="1.3"):
        try:
            return hydra.compose(config_name, overrides=overrides, return_hydra_config=return_hydra_config)
        except (HydraException, OmegaConfBaseException, ValueError) as error:
            raise UserInputError(_sentence(error, config_name, overrides)) from error


def choices(group: str) -> list[str]:
    """List the options of a config group, such as ``"algo"``."""
    return sorted(path.stem for path in (CONF_DIR / group).glob("*.yaml"))


def _sentence(error: Exception, config_name: str, overrides: list[str]) -> str:
    text = str(error)
    if isinstance(error, OverrideParseException):
        return f"{error.override} cannot be read: write it as <key>=<value>, and lists in brackets"
    if match := re.search(r"(?:Could not find|load) '([\w/]+)/([^/']+)'", text):
        group, name = match.groups()
        known = choices(group)
        return f"{group}={name} does not exist: " + (f"choose one of {', '.join(known)}" if known else "leave it out")
    for override in overrides:
        group, _, name = override.lstrip("+").partition("=")
        if name == "null" and choices(group):
            return f"{group}=null chooses nothing: choose one of {', '.join(choices(group))}"
    if config_name == "train" and any(override.startswith("algo=") for override in overrides):
        return f"write +algo=<name> (with a plus): one of {', '.join(choices('algo'))}"
    if match := re.match(r"Ambiguous value for argument '([^']+)'", text):
        return f"{match[1]} holds several values: write a list in brackets, or add -m to run one job for each"
    if match := re.match(r"Multiple values for (\S+)\.", text):
        return f"{match[1]} is chosen twice: write {match[1]}=<name> once, without a plus"
    if match := re.match(r"Could not override '([^']+)'", text):
        return _no_key(match[1], _all_keys(config_name, overrides))
    return " ".join(text.split())


def _no_key(key: str, known: list[str]) -> str:
    group = key.split(".")[0]
    if group != key and group not in known and choices(group):
        plus = "+" if group == "algo" else ""
        return f"{key} needs a choice of {group}: add {plus}{group}=<name>, one of {', '.join(choices(group))}"
    return unknown_key(key, known)


def _all_keys(config_name: str, overrides: list[str]) -> list[str]:
    groups = [o for o in overrides if "." not in o.split("=")[0]]
    try:
        cfg = hydra.compose(config_name, overrides=groups)
    except (HydraException, OmegaConfBaseException):
        cfg = hydra.compose(config_name)
    return _keys_of(OmegaConf.to_container(cfg), "")


def _keys_of(node: object, prefix: str) -> list[str]:
    if not isinstance(node, dict):
        return [prefix]
    nested = [_keys_of(value, f"{prefix}.{key}" if prefix else str(key)) for key, value in node.items()]
    return [prefix] * bool(prefix) + [key for keys in nested for key in keys]
