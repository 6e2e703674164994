"""Configs composed as the command line does, and the one sentence for whatever Hydra refuses."""

import os
import re
from collections.abc import Sequence
from contextlib import AbstractContextManager, nullcontext
from pathlib import Path
from typing import Any

import hydra
from hydra._internal.core_plugins.basic_sweeper import BasicSweeper
from hydra.core.global_hydra import GlobalHydra
from hydra.core.override_parser.overrides_parser import OverridesParser
from hydra.core.override_parser.types import Override
from hydra.errors import HydraException, OverrideParseException
from omegaconf import DictConfig, ListConfig, OmegaConf
from omegaconf.errors import OmegaConfBaseException

from rcdsac_trl.config.command_line import SEARCHPATH, assigned, key_of, listed, several, unreadable
from rcdsac_trl.config.paths import CONF_DIR
from rcdsac_trl.config.typed import unknown_key
from rcdsac_trl.errors import UserInputError, first_line

_ABSENT = object()
# Keys of verbs that name a folder, or a file of one, or several.
_FOLDERS = ("run", "runs", "agents", "out", "films", "maps")


def output_folder(config_name: str, overrides: list[str]) -> Path:
    """Return the folder that a run would write into."""
    return _folder(config_name, overrides, "run")


def sweep_folder(config_name: str, overrides: list[str]) -> Path:
    """Return the folder that holds those of a multirun."""
    return _folder(config_name, overrides, "sweep")


def _folder(config_name: str, overrides: list[str], mode: str) -> Path:
    cfg = _compose(config_name, overrides, return_hydra_config=True)
    try:
        folder = cfg.hydra[mode].dir
    except OmegaConfBaseException as error:
        raise UserInputError(_not_resolved(error)) from error
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


def compose(config_name: str, overrides: list[str]) -> DictConfig:
    """Compose a config as the command line does.

    Raises:
        UserInputError: one sentence for whatever Hydra refuses.
    """
    cfg = _compose(config_name, overrides)
    try:
        OmegaConf.to_container(cfg, resolve=True)
    except OmegaConfBaseException as error:
        raise UserInputError(_not_resolved(error)) from error
    for key in _FOLDERS:
        _refuse_no_folder(key, cfg.get(key))
    return cfg


def _refuse_no_folder(key: str, named: Any) -> None:
    """Refuse an empty name, such as that of a variable that a script left empty: it would mean the folder one is in."""
    if any(not name.strip() for name in (named if isinstance(named, ListConfig) else [named]) if isinstance(name, str)):
        raise UserInputError(f"{key} names no folder: give it one, or leave it out")


def _not_resolved(error: OmegaConfBaseException) -> str:
    key = re.search(r"full_key: (\S+)", str(error))
    sentence = first_line(error) if key is None else f"{key[1]}: {first_line(error)}"
    missing = re.search(r"Interpolation key '(\w+)' not found", sentence)
    if missing is None or missing[1] not in os.environ:
        return sentence
    return f"{sentence}: write ${missing[1]}, without braces, for the variable of the environment"


def _compose(config_name: str, overrides: list[str], *, return_hydra_config: bool = False) -> DictConfig:
    for override in overrides:
        if not key_of(override).partition("@")[0].strip():  # Hydra fails an assertion
            raise UserInputError(f"{override} names no key: write it as <key>=<value>, without spaces around =")
        if key_of(override) == SEARCHPATH:
            _check_searchpath(override)
    overrides = with_sections(config_name, overrides)
    with _initialized():
        try:
            return hydra.compose(config_name, overrides=overrides, return_hydra_config=return_hydra_config)
        except (HydraException, OmegaConfBaseException, ValueError) as error:
            raise UserInputError(_sentence(error, config_name, overrides)) from error


def _check_searchpath(override: str) -> None:
    """Refuse what is no folder: Hydra would only warn, and then miss what it is to find there."""
    named = parse([override])[0].value()
    for place in named if isinstance(named, list) else [named]:
        path = str(place).removeprefix("file://")
        if "://" not in path and not os.path.isdir(path):
            raise UserInputError(f"{override}: {path} is no folder: name those that hold configs of yours")


def _initialized() -> AbstractContextManager[None]:
    """Let Hydra know conf/; inside a Hydra main it does already, and being told twice is an error."""
    if GlobalHydra.instance().is_initialized():
        return nullcontext()
    return hydra.initialize_config_dir(str(CONF_DIR), version_base="1.3")


def with_sections(config_name: str, overrides: list[str]) -> list[str]:
    """Complete overrides by what they imply.

    A key of a section that is null until it is chosen changes that section, where the root takes a part of one.

    `evaluate` completes ``task.episode_steps=200`` with the task that the agent was trained for; Hydra alone would want
    a plus before it. `train` takes row, sensor, robot and networks of the agent that ``init`` names.

    Example:
        >>> with_sections("evaluate", ["run=a", "task.episode_steps=200"])
        ['run=a', '+task.episode_steps=200']
    """
    if config_name == "train":
        return _with_init(overrides)
    if config_name != "evaluate":
        return overrides
    chosen = {key_of(override) for override in overrides}
    absent = {group for group, option in root_groups(config_name).items() if option is None} - chosen
    return [f"+{o}" if o.partition(".")[0] in absent else o for o in overrides]


def _with_init(overrides: list[str]) -> list[str]:
    """Let a training that begins with an agent be of that agent's kind."""
    named = [override.partition("=")[2].strip("'\"") for override in overrides if key_of(override) == "init"]
    if not named or named[-1] in ("", "null") or "," in named[-1]:
        return overrides
    from rcdsac_trl.config.init_overrides import with_the_agents_own  # late: it reads what it names through this module

    return with_the_agents_own(named[-1], overrides)


def root_groups(config_name: str) -> dict[str, str | None]:
    """Return the groups in which a root takes a choice, and the option it takes if none is named."""
    root: Any = OmegaConf.to_container(OmegaConf.load(CONF_DIR / f"{config_name}.yaml"))
    entries = [entry for entry in root["defaults"] if isinstance(entry, dict)]
    groups = {group: option for entry in entries for group, option in entry.items() if choices(group)}
    return groups | ({"algo": None} if config_name == "train" else {})


def choices(group: str) -> list[str]:
    """List the options of a config group, such as ``"algo"``."""
    return sorted(path.stem for path in (CONF_DIR / group).glob("*.yaml"))


def offered(config_name: str, group: str) -> list[str]:
    """List the options of a group that a root can work with: nothing trains on the test that ``map=barn`` is."""
    trains = config_name in ("train", "search", "sweep")
    return [option for option in choices(group) if not (trains and (group, option) == ("map", "barn"))]


def _sentence(error: Exception, config_name: str, overrides: list[str]) -> str:
    text = str(error)
    if isinstance(error, OverrideParseException):
        word = error.override or ""
        return unreadable(word, overrides, _meant(word, config_name) if config_name else None)
    if match := re.search(r"(?:Could not find|load) '([\w/]+)/([^/']*)'", text):
        group, name = match.groups()
        known = offered(config_name, group)
        return f"{group}={name} does not exist: " + (f"choose one of {', '.join(known)}" if known else "leave it out")
    for override in overrides:
        group, _, name = override.lstrip("+").partition("=")
        if name == "null" and choices(group):
            return f"{group}=null chooses nothing: choose one of {', '.join(offered(config_name, group))}"
    if config_name == "train" and any(override.startswith("algo=") for override in overrides):
        return f"write +algo=<name> (with a plus): one of {', '.join(choices('algo'))}"
    if match := re.match(r"Ambiguous value for argument '([^']+)'", text):
        return several(match[1], as_jobs=config_name == "train")
    if match := re.match(r"Multiple values for (\S+)\.|(\S+) appears more than once in the final defaults list", text):
        group = match[1] or match[2]
        return f"{group} is chosen twice: write {group}=<name> once, without a plus"
    if match := re.match(r"Could not override '([^']+)'", text):
        return _no_key(match[1], config_name, overrides)
    return " ".join(text.split())


def _meant(word: str, config_name: str) -> str | None:
    """Return the override of which a word is the value: a choice of one group alone, or an agent."""
    groups = [group for group in root_groups(config_name) if word in choices(group)]
    if len(groups) == 1:
        return f"{'+' if groups[0] == 'algo' else ''}{groups[0]}={word}"
    from rcdsac_trl.deploy.policy.registry import shipped_names  # late: whoever mistypes nothing does not wait for it

    keys = OmegaConf.load(CONF_DIR / f"{config_name}.yaml")
    if word not in shipped_names():
        return None
    if "run" in keys:
        return assigned("run", word)
    return listed("runs", word) if "runs" in keys else None


def _no_key(key: str, config_name: str, overrides: list[str]) -> str:
    """Say what to write in place of a key that a composed config does not have."""
    known = all_keys(config_name, overrides)
    group, _, below = key.partition(".")
    groups = root_groups(config_name)
    if below and group in groups:
        plus = "+" if group == "algo" else ""
        if groups[group] is None and group not in known:
            return f"{key} needs a choice of {group}: add {plus}{group}=<name>, one of {', '.join(choices(group))}"
        if having := [option for option in choices(group) if _option_has(group, option, below)]:
            owners = " or ".join(f"{plus}{group}={option}" for option in having)
            return f"{key} goes with {owners} alone: add that, or leave it out"
    return unknown_key(key, known)


def _option_has(group: str, option: str, key: str) -> bool:
    return OmegaConf.select(OmegaConf.load(CONF_DIR / group / f"{option}.yaml"), key, default=_ABSENT) is not _ABSENT


def all_keys(config_name: str, overrides: Sequence[str] = ()) -> list[str]:
    """List the keys of a composed config and its sections, with the choices among the overrides where they compose."""
    groups = [o for o in overrides if "." not in o.split("=")[0]]
    with _initialized():
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
