"""Checks that settings share, each with its one sentence."""

import math
from typing import get_args

from rcdsac_trl.errors import UserInputError


def one_of(key: str, value: object, literal: object) -> None:
    """Refuse what is none of the values of a ``Literal``."""
    if value not in get_args(literal):
        raise UserInputError(f"{key}={value} is unknown: choose one of {', '.join(get_args(literal))}")


def at_least(section: str, settings: object, lowest: float, names: str) -> None:
    """Refuse fields of a section, their names apart by spaces, that are no finite number of at least the lowest."""
    for name in names.split():
        value = getattr(settings, name)
        if not isinstance(value, int | float) or not lowest <= value < math.inf:
            raise UserInputError(f"{section}.{name}={value} is not a number of at least {lowest:g}: give one")


def positive(section: str, settings: object, names: str) -> None:
    """Refuse fields of a section, their names apart by spaces, that are no finite positive number."""
    for name in names.split():
        value = getattr(settings, name)
        if not isinstance(value, int | float) or not 0 < value < math.inf:
            raise UserInputError(f"{section}.{name}={value} is not a positive number: use one")


def within(section: str, settings: object, lowest: float, highest: float, names: str) -> None:
    """Refuse fields of a section, their names apart by spaces, that are no number from the lowest to the highest."""
    for name in names.split():
        value = getattr(settings, name)
        if not isinstance(value, int | float) or not lowest <= value <= highest:
            raise UserInputError(f"{section}.{name}={value} must be from {lowest:g} to {highest:g}")


def check_least(key: str, value: int, lowest: int) -> None:
    """Refuse a whole number below the lowest."""
    if value < lowest:
        raise UserInputError(f"{key}={value} must be at least {lowest}")
