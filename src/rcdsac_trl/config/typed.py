"""Plain values, as YAML and a command line bring them, into settings: every key known, every type right."""

import difflib
import sys
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import MISSING, Field, fields, is_dataclass
from types import NoneType, UnionType
from typing import Any, Literal, TypeVar, Union, get_args, get_origin, get_type_hints

from rcdsac_trl.config.command_line import quoted
from rcdsac_trl.errors import UserInputError

Settings = TypeVar("Settings")

_NAMES = {int: "a whole number", float: "a number", bool: "true or false", str: "text", NoneType: "null"}
# Whole numbers from here on fit no tensor and no index.
_LARGEST = 2**63
_PLURALS = {int: "whole numbers", float: "numbers", bool: "true or false", str: "words"}


def read(cls: type[Settings], values: Mapping[str, Any], section: str = "") -> Settings:
    """Make a settings dataclass of a section whose keys are its fields; a field may be a section of its own.

    Understood are ``bool``, ``int``, ``float`` (which takes whole numbers, and nothing infinite), ``str``,
    ``Literal``, ``None``, tuples (from lists; one number stands for a list of one), dataclasses (from sections),
    mappings from text (from sections with keys of any name; of ``Any``, what they hold is left to whoever reads it)
    and unions of these.

    Args:
        cls: a dataclass.
        values: the section.
        section: where it lies, for messages; ``""`` is the root.

    Raises:
        UserInputError: for an unknown or missing key, a value of another type, and what the dataclass refuses.

    Example:
        >>> from dataclasses import dataclass
        >>> @dataclass
        ... class Lens:
        ...     focus_m: float
        >>> read(Lens, {"focus_m": "near"}, "lens")
        Traceback (most recent call last):
        rcdsac_trl.errors.UserInputError: lens.focus_m=near must be a number
    """
    hints = get_type_hints(cls)
    known = {field.name: field for field in fields(cls)}  # type: ignore[arg-type]
    for key in values:
        if key not in known:
            raise UserInputError(unknown_key(_join(section, str(key)), [_join(section, name) for name in known]))
    missing = [name for name, field in known.items() if name not in values and _is_required(field)]
    if missing:
        raise UserInputError(f"{_join(section, missing[0])} is missing: give it a value")
    return cls(**{key: _fit(value, hints[key], _join(section, key)) for key, value in values.items()})


def section_class(classes: Sequence[type[Settings]], values: Mapping[str, Any]) -> type[Settings]:
    """Choose the class that a section is of: the first that has all its keys and needs no other, else the nearest.

    Example:
        >>> from dataclasses import dataclass
        >>> @dataclass
        ... class Lens:
        ...     focus_m: float
        >>> @dataclass
        ... class Mirror:
        ...     radius_m: float
        >>> section_class([Lens, Mirror], {"radius_m": 2.0}).__name__
        'Mirror'
    """

    def misfits(cls: type[Settings]) -> int:
        known = {field.name: field for field in fields(cls)}  # type: ignore[arg-type]
        missing = [name for name, field in known.items() if name not in values and _is_required(field)]
        return len(missing) + sum(key not in known for key in values)

    return min(classes, key=misfits)


def unknown_key(key: str, known: Iterable[str]) -> str:
    """Say that a key does not exist, and which one may have been meant, else which ones its section has.

    Example:
        >>> unknown_key("lens.fokus_m", ["lens.focus_m", "seed"])
        'there is no key lens.fokus_m: did you mean lens.focus_m?'
        >>> unknown_key("lens.weight_kg", ["lens.focus_m", "seed"])
        'there is no key lens.weight_kg: lens has focus_m'
    """
    known = list(known)
    section, _, name = key.rpartition(".")
    beside = {_name(other): other for other in known if other.rpartition(".")[0] == section}
    named_so = [other for other in known if _name(other) == name]
    if len(named_so) == 1:  # in another section
        meant = named_so[0]
    elif beside and (close := difflib.get_close_matches(name, beside, n=1, cutoff=0.6)):
        meant = beside[close[0]]
    elif not (beside and section) and (close := difflib.get_close_matches(key, known, n=1, cutoff=0.6)):
        meant = close[0]
    else:
        return f"there is no key {key}" + (f": {section} has {', '.join(beside)}" if beside and section else "")
    return f"there is no key {key}: did you mean {meant}?"


def _name(key: str) -> str:
    return key.rpartition(".")[2]


def _join(section: str, key: str) -> str:
    return f"{section}.{key}" if section else key


def _is_required(field: Field) -> bool:
    return field.default is MISSING and field.default_factory is MISSING


def _fit(value: Any, hint: Any, path: str) -> Any:
    options = get_args(hint) if get_origin(hint) in (Union, UnionType) else (hint,)
    sections = [option for option in options if is_dataclass(option) and isinstance(option, type)]
    if sections and isinstance(value, Mapping):
        return read(section_class(sections, value), value, path)
    for option in options:
        if option in sections:
            continue
        if get_origin(option) is Mapping:
            if isinstance(value, Mapping):
                if get_args(option)[1] is Any:
                    return dict(value)
                each = get_args(option)[1]
                return {str(key): _fit(below, each, _join(path, str(key))) for key, below in value.items()}
        elif _is_a(value, option):
            return _with_tuples(value)
        elif _takes_one(option) and _is_a(value, get_args(option)[0]):
            return (value,)
    wanted = " or ".join(_describe(option) for option in options)
    shown = "null" if value is None else value
    as_text = f"; as a text: {quoted(path, str(shown))}" if str in options and isinstance(value, int | float) else ""
    raise UserInputError(f"{path}={shown} must be {wanted}{as_text}")


def _takes_one(hint: Any) -> bool:
    """Tell whether a value is a list of numbers of any length, for which one alone may be written without brackets."""
    return get_origin(hint) is tuple and get_args(hint)[0] in (int, float) and get_args(hint)[-1] is Ellipsis


def _with_tuples(value: Any) -> Any:
    """Return lists, of lists too, as tuples, and anything else as it is."""
    return tuple(map(_with_tuples, value)) if isinstance(value, list) else value


def _is_a(value: Any, hint: Any) -> bool:
    origin, args = get_origin(hint), get_args(hint)
    if origin is Literal:
        return value in args
    if origin is tuple:
        if not isinstance(value, list | tuple):
            return False
        each = [args[0]] * len(value) if args[-1] is Ellipsis else list(args)
        return len(value) == len(each) and all(_is_a(v, h) for v, h in zip(value, each, strict=True))
    if isinstance(value, bool):  # Python counts it as a number
        return hint is bool
    if hint is float:
        # Python compares whole numbers of any size, but turns only those below this into a float.
        return isinstance(value, int | float) and abs(value) <= sys.float_info.max
    if hint is int:
        return isinstance(value, int) and abs(value) < _LARGEST
    # No file system and no library takes a text with this character.
    return isinstance(value, hint) and not (hint is str and "\0" in value)


def _describe(hint: Any) -> str:
    origin, args = get_origin(hint), get_args(hint)
    if origin is Literal:
        return ("one of " if len(args) > 1 else "") + ", ".join(str(arg) for arg in args)
    if origin is tuple:
        if get_origin(args[0]) is Literal:
            return f"a list of some of {', '.join(map(str, get_args(args[0])))} in brackets"
        if get_origin(args[0]) is tuple:
            return f"a list of lists in brackets, each {_describe(args[0]).removesuffix(' in brackets')}"
        number = "" if args[-1] is Ellipsis else f"{len(args)} "
        alone = f"{_NAMES[args[0]]} or " if _takes_one(hint) else ""
        return f"{alone}a list of {number}{_PLURALS[args[0]]} in brackets"
    return _NAMES.get(hint, "a section with keys of its own")
