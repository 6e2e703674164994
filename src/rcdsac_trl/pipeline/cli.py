"""Hydra entry points whose mistakes end in one sentence and exit code 2, before anything is written."""

import re
import sys
from argparse import Namespace
from collections.abc import Callable
from contextlib import nullcontext
from functools import partial, wraps
from pathlib import Path
from typing import NoReturn

import hydra
from hydra._internal.core_plugins.basic_sweeper import BasicSweeper
from hydra._internal.utils import get_args_parser
from hydra.core.global_hydra import GlobalHydra
from hydra.core.override_parser.overrides_parser import OverridesParser
from hydra.core.override_parser.types import Override
from hydra.errors import HydraException, OverrideParseException
from omegaconf import DictConfig, OmegaConf
from omegaconf.errors import OmegaConfBaseException

from rcdsac_trl.errors import FaultError, UserInputError
from rcdsac_trl.paths import CONF_DIR
from rcdsac_trl.pipeline.resources import fault_sentence
from rcdsac_trl.pipeline.runtime import bound_threads, keep_pages, quiet_libraries
from rcdsac_trl.pipeline.typed import unknown_key

Task = Callable[[DictConfig], None]

# What a shell reports for a process that Ctrl-C ended.
INTERRUPTED = 130


def entry_point(
    config_name: str,
    *,
    check: Task,
    check_folder: Callable[[Path], None] | None = None,
    instead: Callable[[list[str], bool], bool] | None = None,
) -> Callable[[Task], Callable[[], None]]:
    """Make a Hydra main of a task.

    Args:
        config_name: the root config in ``conf/``.
        check: called with the composed config before Hydra creates a folder; raises
            :class:`~rcdsac_trl.errors.UserInputError` for what cannot work.
        check_folder: called likewise with the folder that each run would write into.
        instead: called first, with the overrides and whether there are several jobs; returns whether it did what the
            call asks for, so that Hydra has nothing to start.
    """

    def decorate(task: Task) -> Callable[[], None]:
        @wraps(task)
        def guarded(cfg: DictConfig) -> None:
            try:
                check(cfg)
                task(cfg)
            except Exception as error:
                _fail_or_raise(error)

        def started() -> None:
            asked = read_arguments(sys.argv[1:])
            if instead is not None and asked is not None and instead(asked.overrides, asked.multirun):
                return
            precheck(config_name, sys.argv[1:], check, check_folder)
            hydra.main(version_base="1.3", config_path=str(CONF_DIR), config_name=config_name)(guarded)()

        return partial(_program, started)

    return decorate


def overrides_entry_point(config_name: str) -> Callable[[Callable[[list[str]], None]], Callable[[], None]]:
    """Make a main of a task that composes for itself, since its overrides are meant for more than one config.

    Args:
        config_name: the root config that ``--help`` and the like show.
    """

    def decorate(task: Callable[[list[str]], None]) -> Callable[[], None]:
        def started() -> None:
            asked = read_arguments(sys.argv[1:])
            if asked is None:
                hydra.main(version_base="1.3", config_path=str(CONF_DIR), config_name=config_name)(lambda cfg: None)()
            elif asked.multirun:
                raise UserInputError("-m is for `train`: leave it out")
            else:
                task(asked.overrides)

        return partial(_program, started)

    return decorate


def _program(started: Callable[[], None]) -> None:
    """Do what a program does, so that a mistake, a fault and Ctrl-C each end it as its users expect."""
    try:
        bound_threads()
        keep_pages()
        quiet_libraries()
        started()
    except KeyboardInterrupt:
        print("rcdsac_trl: interrupted", file=sys.stderr)
        raise SystemExit(INTERRUPTED) from None
    except Exception as error:
        _fail_or_raise(error)


def fail(error: UserInputError | FaultError) -> NoReturn:
    """Print the sentence and leave with code 2 for wrong input, else with 1."""
    print(f"rcdsac_trl: {error}", file=sys.stderr)
    raise SystemExit(2 if isinstance(error, UserInputError) else 1)


def _fail_or_raise(error: Exception) -> NoReturn:
    if isinstance(error, UserInputError | FaultError):
        fail(error)
    if (told := fault_sentence(error)) is not None:
        fail(FaultError(told))
    raise error


def read_arguments(argv: list[str]) -> Namespace | None:
    """Read Hydra's arguments (`overrides`, `multirun`, ..); None if they only show something (``--help``, ``--cfg``).

    Raises:
        UserInputError: for an option that does not exist, cannot be used, or does not go with another.
    """
    args, unknown = get_args_parser().parse_known_args(argv)
    if unknown:
        raise UserInputError(f"there is no option {unknown[0]}: --help lists them")
    for option in ("config_path", "config_name", "config_dir"):
        if getattr(args, option) is not None:
            raise UserInputError(f"--{option.replace('_', '-')} cannot be used: choose with overrides, <key>=<value>")
    chosen = [f"--{option}" for option in ("run", "multirun", "cfg", "info") if getattr(args, option)]
    if len(chosen) > 1:
        raise UserInputError(f"{' and '.join(chosen)} do not go together: leave all but one out")
    return None if args.help or args.hydra_help or args.cfg or args.info else args


def precheck(
    config_name: str, argv: list[str], check: Task, check_folder: Callable[[Path], None] | None = None
) -> None:
    """Compose and check the config, in a multirun that of every job, without writing anything.

    Calls that only show something (``--help``, ``--cfg``, ..) are left to Hydra.
    """
    args = read_arguments(argv)
    if args is None:
        return
    for overrides in combinations(args.overrides) if args.multirun else [args.overrides]:
        check(compose(config_name, overrides))
    if check_folder is not None:
        check_folder(output_folder(config_name, args.overrides))


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
        if not override.lstrip("+~").partition("=")[0].partition("@")[0].strip():  # Hydra fails an assertion
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
