"""Hydra entry points whose mistakes end in one sentence and exit code 2, before anything is written."""

import difflib
import re
import sys
from collections.abc import Callable
from contextlib import nullcontext
from functools import wraps
from typing import NoReturn

import hydra
from hydra._internal.utils import get_args_parser
from hydra.core.global_hydra import GlobalHydra
from hydra.errors import HydraException
from omegaconf import DictConfig, OmegaConf
from omegaconf.errors import OmegaConfBaseException

from rcdsac_trl.errors import UserInputError
from rcdsac_trl.paths import CONF_DIR
from rcdsac_trl.pipeline.runtime import keep_pages, quiet_libraries

Task = Callable[[DictConfig], None]


def entry_point(config_name: str, *, check: Task) -> Callable[[Task], Callable[[], None]]:
    """Make a Hydra main of a task.

    Args:
        config_name: the root config in ``conf/``.
        check: called with the composed config before Hydra creates a folder; raises
            :class:`~rcdsac_trl.errors.UserInputError` for what cannot work.
    """

    def decorate(task: Task) -> Callable[[], None]:
        @wraps(task)
        def guarded(cfg: DictConfig) -> None:
            try:
                check(cfg)
                task(cfg)
            except UserInputError as error:
                fail(error)

        def main() -> None:
            keep_pages()
            quiet_libraries()
            try:
                precheck(config_name, sys.argv[1:], check)
            except UserInputError as error:
                fail(error)
            hydra.main(version_base="1.3", config_path=str(CONF_DIR), config_name=config_name)(guarded)()

        return main

    return decorate


def fail(error: UserInputError) -> NoReturn:
    """Print the sentence and leave with code 2."""
    print(f"rcdsac_trl: {error}", file=sys.stderr)
    raise SystemExit(2)


def precheck(config_name: str, argv: list[str], check: Task) -> None:
    """Compose and check the config without writing anything; multirun and Hydra's own flags are left to Hydra."""
    args = get_args_parser().parse_args(argv)
    if args.multirun or args.help or args.hydra_help or args.cfg or args.info:
        return
    check(compose(config_name, args.overrides))


def compose(config_name: str, overrides: list[str]) -> DictConfig:
    """Compose a config as the command line does.

    Raises:
        UserInputError: one sentence for whatever Hydra refuses.
    """
    # Inside a Hydra main the search path is set up already, and setting it up twice is an error.
    inside = GlobalHydra.instance().is_initialized()
    with nullcontext() if inside else hydra.initialize_config_dir(str(CONF_DIR), version_base="1.3"):
        try:
            cfg = hydra.compose(config_name, overrides=overrides)
            OmegaConf.to_container(cfg, resolve=True)
            return cfg
        except (HydraException, OmegaConfBaseException) as error:
            raise UserInputError(_sentence(error, config_name, overrides)) from error


def choices(group: str) -> list[str]:
    """List the options of a config group, such as ``"algo"``."""
    return sorted(path.stem for path in (CONF_DIR / group).glob("*.yaml"))


def _sentence(error: Exception, config_name: str, overrides: list[str]) -> str:
    text = str(error)
    if match := re.search(r"(?:Could not find|load) '([\w/]+)/([^/']+)'", text):
        group, name = match.groups()
        return f"{group}={name} does not exist: choose one of {', '.join(choices(group))}"
    if any(override.startswith("algo=") for override in overrides):
        return f"write +algo=<name> (with a plus): one of {', '.join(choices('algo'))}"
    if match := re.search(r"Key '([^']+)' is not in struct\s+full_key: (\S+)", text):
        close = difflib.get_close_matches(match[2], _all_keys(config_name, overrides), n=1, cutoff=0.5)
        return f"there is no key {match[2]}" + (f": did you mean {close[0]}?" if close else "")
    return " ".join(text.split())


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
