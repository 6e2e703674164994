"""Overrides before Hydra reads them: what a shell would have expanded, and what to write where Hydra misreads them."""

import os
import re
import shlex
from collections.abc import Sequence
from itertools import takewhile
from pathlib import Path

from rcdsac_trl.errors import UserInputError

SEARCHPATH = "hydra.searchpath"
"""Says in which folders of a user's own Hydra looks for configs."""

# Where a path may begin in a value is behind the key, in a list, behind a quote; a variable may be any part of it.
_HOME = re.compile(r"""(?<=[=\[,'"])~(?P<user>[\w.-]*)(?=[/,\]'"]|$)""")
# What neither a shell nor Hydra reads as its own.
_PLAIN = r"[\w/.+-]+"
_VARIABLE = re.compile(r"""(?<=[=\[,'"/])\$(?P<name>[A-Za-z_]\w*)""")


def key_of(override: str) -> str:
    """Return the key that an override is about.

    Example:
        >>> key_of("+experiment=table"), key_of("learner.gamma=0.9")
        ('experiment', 'learner.gamma')
    """
    return override.lstrip("+~").partition("=")[0]


def expanded(override: str) -> str:
    """Put home folders and variables of the environment into a value, which no shell does behind a key.

    Raises:
        UserInputError: for a user or a variable that does not exist: the folder would be called as it is written.

    Example:
        >>> expanded("out=~/x") == expanded("out=$HOME/x"), expanded("~learner.gamma")
        (True, '~learner.gamma')
    """
    with_home = _HOME.sub(lambda found: _home(override, found), override)
    return _VARIABLE.sub(lambda found: _variable(override, found), with_home)


def _home(override: str, found: re.Match[str]) -> str:
    home = os.path.expanduser(found[0])
    if home == found[0]:
        raise UserInputError(f"{override}: there is no home folder {found[0]}: write the path in full")
    return _within(found, home)


def _variable(override: str, found: re.Match[str]) -> str:
    if found["name"] not in os.environ:
        raise UserInputError(f"{override}: there is no environment variable {found['name']}: write its value")
    return _within(found, os.environ[found["name"]])


def _within(found: re.Match[str], text: str) -> str:
    """Return a text as Hydra must be given it in place of what was found: what is no plain path needs quotes there."""
    before = found.string[: found.start()]
    is_quoted = before.count("'") % 2 or before.count('"') % 2
    return text if is_quoted else re.sub(r"([^\w/.+%@-])", r"\\\1", text)


def as_text(value: str) -> str:
    r"""Put a text in quotes as Hydra reads them: only quotes are escaped, and backslashes before one.

    Example:
        >>> print(as_text(r'C:\maps "new"'))
        "C:\maps \"new\""
    """
    escaped = re.sub(r'(\\*)"', r"\1\1\"", value)
    return '"' + re.sub(r"(\\+)$", r"\1\1", escaped) + '"'


def quoted(key: str, value: str) -> str:
    r"""Write an override so that a shell and Hydra leave its value as it is.

    Example:
        >>> print(quoted("out", "a,b"))
        'out="a,b"'
    """
    text = as_text(value.strip("'\""))
    return shlex.quote(f"{key}={text}")


def assigned(key: str, value: str) -> str:
    """Write an override so that a shell and Hydra leave its value as it is, plainly where that will do.

    Example:
        >>> print(assigned("run", "runs/a"), assigned("run", "my runs/a"))
        run=runs/a 'run="my runs/a"'
    """
    return f"{key}={value}" if re.fullmatch(_PLAIN, value) else quoted(key, value)


def listed(key: str, value: str) -> str:
    """Write an override whose value is a list of one text, as :func:`assigned` does.

    Example:
        >>> print(listed("runs", "runs/a"), listed("runs", "my runs/a"))
        runs=[runs/a] 'runs=["my runs/a"]'
    """
    if re.fullmatch(_PLAIN, value):
        return f"{key}=[{value}]"
    return shlex.quote(f"{key}=[{as_text(value)}]")


def with_names(key: str, words: Sequence[str]) -> list[str]:
    """Put the key before names that stand first without it, in one list.

    Example:
        >>> with_names("agents", ["sac-narrow", "rcwr-narrow", "seed=1"])
        ['agents=["sac-narrow","rcwr-narrow"]', 'seed=1']
        >>> with_names("agents", ["seed=1"]), with_names("agents", ["--help"])
        (['seed=1'], ['--help'])
    """
    names = list(takewhile(lambda word: word and not word.startswith("-") and "=" not in word, words))
    escaped = [name.replace("\\", "\\\\").replace('"', '\\"') for name in names]
    listed_names = ",".join(f'"{name}"' for name in escaped)
    return [*([f"{key}=[{listed_names}]"] if names else []), *words[len(names) :]]


def unreadable(override: str, overrides: list[str], meant: str | None = None) -> str:
    """Say what to write in place of an override that Hydra's grammar does not take.

    Args:
        override: which one.
        overrides: all of them.
        meant: what was probably meant by it, if that is known.
    """
    if meant is not None:
        return f"{override} cannot be read: did you mean {meant}?"
    key, equals, value = override.partition("=")
    sentence = f"{override} cannot be read: write it as <key>=<value>"
    number = overrides.index(override) if override in overrides else 0
    if not equals:
        if number and "=" in (before := overrides[number - 1]):  # a shell has split a value at its space
            start, _, text = before.partition("=")
            return f"{sentence}, or, if it belongs to what stands before it, {quoted(start, f'{text} {override}')}"
        return sentence
    return f"{sentence}, lists in brackets, and a text with characters such as , = ( [ as {quoted(key, value)}"


def no_option(option: str, argv: Sequence[str]) -> str:
    """Say what to write in place of an option that does not exist: a key takes no dashes.

    Example:
        >>> no_option("--num_maps", ["run=a", "--num_maps", "3"])
        'there is no option --num_maps: did you mean num_maps=3?'
    """
    key, equals, value = option.removeprefix("--").partition("=")
    if not option.startswith("--") or not re.fullmatch(r"[A-Za-z_][\w.]*", key):
        return f"there is no option {option}: --help lists them; put a value with spaces in quotes"
    behind = next(iter(argv[argv.index(option) + 1 :]), "-") if option in argv else "-"
    if not equals and not behind.startswith("-") and "=" not in behind:
        equals, value = "=", behind
    if equals:
        return f"there is no option --{key}: did you mean {assigned(key, value)}?"
    return f"there is no option {option}: --help lists them; a key takes no dashes, {key}=<value>"


def several(override: str, *, as_jobs: bool) -> str:
    """Say what to write in place of an override with a comma in its value.

    Args:
        override: the override.
        as_jobs: whether the verb can do one job for each of the values.
    """
    key, _, value = override.partition("=")
    jobs = ", or add -m to run one job for each" if as_jobs else ""
    text = quoted(key, value)
    return f"{override} holds several values: write a list in brackets{jobs}, or a text with commas as {text}"


def folder_of(override: str) -> Path:
    """Return the folder that an override names, with or without quotes.

    Example:
        >>> folder_of("hydra.run.dir='runs/a'").as_posix()
        'runs/a'
    """
    return Path(override.partition("=")[2].strip("'\""))
