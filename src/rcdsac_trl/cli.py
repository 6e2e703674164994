"""Hydra entry points whose mistakes end in one sentence and exit code 2, before anything is written."""

import importlib
import sys
from argparse import Namespace
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from signal import SIGINT
from typing import Any, NoReturn

import hydra
from hydra._internal.utils import get_args_parser
from omegaconf import DictConfig

from rcdsac_trl.config.command_line import expanded, key_of, no_option
from rcdsac_trl.config.compose import combinations, compose, output_folder, with_sections
from rcdsac_trl.config.paths import CONF_DIR
from rcdsac_trl.config.verb_help import verb_help
from rcdsac_trl.errors import FaultError, UserInputError
from rcdsac_trl.system.interrupts import ended_by, endings_as_interrupts
from rcdsac_trl.system.progress import never_silent
from rcdsac_trl.system.resources import fault_sentence
from rcdsac_trl.system.runtime import bound_threads, keep_pages, let_workers_rest, quiet_libraries, speak_anywhere

Task = Callable[[DictConfig], None]

# What a shell reports for a process that a signal ended is this and the signal's number.
_ENDED_BY_SIGNAL = 128


@dataclass(frozen=True)
class Command:
    """A verb that makes one object of its config and runs it; called, it is the program.

    Functions may be named, ``"<module>:<function>"``, and are then imported when they are called: ``--help`` needs no
    torch.

    Attributes:
        name: of the verb, and of its root config in ``conf/``.
        make: takes the composed config, refuses what cannot work, writes nothing, and returns what has a ``run()`` that
            works, writes and prints.
        describe: puts a folder of results into words; ``run`` is given it.
        look: takes the composed config and refuses what can be told without torch, so that a mistake does not wait for
            the imports of ``make``.
    """

    name: str
    make: str | Callable[[DictConfig], Any]
    describe: str | None = None
    look: str | None = None

    def check(self, cfg: DictConfig) -> None:
        """Refuse what cannot work, before anything is written."""
        _function(self.make)(cfg)

    def __call__(self) -> None:
        """Do what ``python -m rcdsac_trl.<name>`` does."""

        def task(cfg: DictConfig) -> None:
            described_by = () if self.describe is None else (_function(self.describe),)
            _function(self.make)(cfg).run(*described_by)

        look = None if self.look is None else late(self.look)
        with never_silent():
            entry_point(self.name, check=self.check, look=look)(task)()


@dataclass(frozen=True)
class OverridesCommand:
    """A verb whose overrides are meant for more than one config, so that what it makes composes for itself.

    Attributes:
        name: of the verb, and of the root config that ``--help`` and the like show.
        make: as that of :class:`Command`, but takes the overrides.
    """

    name: str
    make: str

    def __call__(self) -> None:
        """Do what ``python -m rcdsac_trl.<name>`` does."""
        _program(self._start)

    def _start(self) -> None:
        if shows_help(self.name, sys.argv[1:]):
            return
        arguments = read_arguments(sys.argv[1:])
        if arguments is None:
            _hydra_main(self.name, lambda cfg: None)
        elif arguments.multirun:
            raise UserInputError("-m is for `train`: leave it out")
        else:
            _function(self.make)(arguments.overrides).run()


def entry_point(
    config_name: str,
    *,
    check: Task,
    look: Task | None = None,
    check_folder: Callable[[Path], None] | None = None,
    instead: Callable[[list[str], bool], bool] | None = None,
) -> Callable[[Task], Callable[[], None]]:
    """Make a Hydra main of a task.

    Args:
        config_name: the root config in ``conf/``.
        check: called with the composed config before Hydra creates a folder; raises
            :class:`~rcdsac_trl.errors.UserInputError` for what cannot work.
        look: called likewise, before it; refuses what can be told without torch.
        check_folder: called between the two with the folder that each run would write into.
        instead: called first, with the overrides and whether there are several jobs; returns whether it did what the
            call asks for, so that Hydra has nothing to start.
    """

    def decorate(task: Task) -> Callable[[], None]:
        def start() -> None:
            if shows_help(config_name, sys.argv[1:]):
                return
            arguments = read_arguments(sys.argv[1:])
            if instead is not None and arguments is not None and instead(arguments.overrides, arguments.multirun):
                return
            precheck(config_name, sys.argv[1:], check, look, check_folder)
            _hydra_main(config_name, task)

        return partial(_program, start)

    return decorate


def shows_help(verb: str, argv: list[str]) -> bool:
    """Explain a verb if its arguments ask for that, and say whether they did."""
    args, _ = _parsed(argv)
    if args.help:
        print(verb_help(verb, args.overrides))
    return bool(args.help)


def _hydra_main(config_name: str, task: Task) -> None:
    def guarded(cfg: DictConfig) -> None:
        try:
            task(cfg)
        except Exception as error:  # Hydra would print it in its own way
            _fail_or_raise(error)

    sys.argv[1:] = _in_hydras_order(config_name, sys.argv[1:])
    guarded.__module__ = f"rcdsac_trl.{config_name}"  # by which Hydra names the program
    hydra.main(version_base="1.3", config_path=str(CONF_DIR), config_name=config_name)(guarded)()


def late(name: str) -> Callable[..., Any]:
    """Return a function that is imported when it is called.

    Args:
        name: ``"<module>:<function>"``.

    Example:
        >>> late("math:hypot")(3.0, 4.0)
        5.0
    """
    return lambda *given: _function(name)(*given)


def _function(named: str | Callable[..., Any]) -> Callable[..., Any]:
    """Import the function that is named ``"<module>:<function>"``."""
    if not isinstance(named, str):
        return named
    module, _, name = named.partition(":")
    function: Callable[..., Any] = getattr(importlib.import_module(module), name)
    return function


def _program(start: Callable[[], None]) -> None:
    """Do what a program does, so that a mistake, a fault, Ctrl-C and SIGTERM each end it as its users expect."""
    try:
        bound_threads()
        keep_pages()
        quiet_libraries()
        let_workers_rest()
        speak_anywhere()
        with endings_as_interrupts():
            start()
    except KeyboardInterrupt:
        number = ended_by()
        print(f"rcdsac_trl: {'interrupted' if number is SIGINT else f'ended by {number.name}'}", file=sys.stderr)
        raise SystemExit(_ENDED_BY_SIGNAL + number) from None
    except Exception as error:
        _fail_or_raise(error)


def fail(error: UserInputError | FaultError) -> NoReturn:
    """Print the sentence and leave with code 2 for wrong input, else with 1."""
    print(f"rcdsac_trl: {error}", file=sys.stderr)
    raise SystemExit(2 if isinstance(error, UserInputError) else 1)


def _fail_or_raise(error: Exception) -> NoReturn:
    if isinstance(error, UserInputError | FaultError):
        fail(error)
    if (sentence := fault_sentence(error)) is not None:
        fail(FaultError(sentence))
    raise error


def read_arguments(argv: list[str]) -> Namespace | None:
    """Read Hydra's arguments (`overrides`, `multirun`, ..); None if they only show something (``--help``, ``--cfg``).

    Raises:
        UserInputError: for an option that does not exist, cannot be used, or does not go with another.
    """
    args, unknown = _parsed(argv)
    if unknown:
        raise UserInputError(no_option(unknown[0], argv))
    for option in ("config_path", "config_name", "config_dir"):
        if getattr(args, option) is not None:
            raise UserInputError(f"--{option.replace('_', '-')} cannot be used: choose with overrides, <key>=<value>")
    chosen = [f"--{option}" for option in ("run", "multirun", "cfg", "info") if getattr(args, option)]
    if len(chosen) > 1:
        raise UserInputError(f"{' and '.join(chosen)} do not go together: leave all but one out")
    for override in args.overrides:
        if key_of(override) in ("hydra", "hydra.mode"):
            raise UserInputError(f"{override} is not for users: leave it out; `train -m` runs several trainings")
    return None if args.help or args.hydra_help or args.cfg or args.info else args


def _parsed(argv: list[str]) -> tuple[Namespace, list[str]]:
    """Read overrides and options, which may stand in any order; also return what is neither."""
    parser = get_args_parser()

    def refuse(message: str) -> NoReturn:
        raise UserInputError(f"{message}: --help lists the options")

    parser.error = refuse  # type: ignore[method-assign]  # it would print how all options are used, and leave
    args, unknown = parser.parse_known_intermixed_args(argv)
    args.overrides = [expanded(override) for override in args.overrides]
    return args, unknown


def _in_hydras_order(config_name: str, argv: list[str]) -> list[str]:
    """Put the overrides first, as Hydra wants them, and what a shell would have expanded into them."""
    args, _ = _parsed(argv)
    given, options = list(args.overrides), []
    for word in argv:
        if given and not word.startswith("-") and expanded(word) == given[0]:
            given.pop(0)
        else:
            options.append(word)
    return [*with_sections(config_name, args.overrides), *options]


def precheck(
    config_name: str,
    argv: list[str],
    check: Task,
    look: Task | None = None,
    check_folder: Callable[[Path], None] | None = None,
) -> None:
    """Compose and check the config, in a multirun that of every job, without writing anything.

    Calls that only show something (``--help``, ``--cfg``, ..) are left to Hydra.
    """
    args = read_arguments(argv)
    if args is None:
        return
    jobs = combinations(args.overrides) if args.multirun else [args.overrides]
    composed = [compose(config_name, overrides) for overrides in jobs]
    if look is not None:
        for cfg in composed:
            look(cfg)
    if check_folder is not None:
        check_folder(output_folder(config_name, args.overrides))
    for cfg in composed:
        check(cfg)
