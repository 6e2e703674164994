"""Hydra entry points whose mistakes end in one sentence and exit code 2, before anything is written."""

import sys
from argparse import Namespace
from collections.abc import Callable
from functools import partial, wraps
from pathlib import Path
from typing import NoReturn

import hydra
from hydra._internal.utils import get_args_parser
from omegaconf import DictConfig

from rcdsac_trl.config.compose import combinations, compose, output_folder
from rcdsac_trl.config.paths import CONF_DIR
from rcdsac_trl.errors import FaultError, UserInputError
from rcdsac_trl.system.resources import fault_sentence
from rcdsac_trl.system.runtime import bound_threads, keep_pages, let_workers_rest, quiet_libraries

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
        let_workers_rest()
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
