"""Limits of the numbers that maps are made from: one sentence that names the value and its limits."""

from collections.abc import Sequence
from numbers import Real

from rcdsac_trl.errors import UserInputError


def check_number(name: str, value: object, low: float, high: float) -> None:
    """Refuse what is no number from ``low`` to ``high``.

    Raises:
        UserInputError: naming all of them.
    """
    # Written so that NaN fails too.
    if isinstance(value, bool) or not isinstance(value, Real) or not low <= float(value) <= high:
        raise UserInputError(f"{name} is {value!r} but must be a number from {low:g} to {high:g}")


def check_whole(name: str, value: object, low: int, high: int) -> None:
    """Refuse what is no whole number from ``low`` to ``high``.

    Raises:
        UserInputError: naming all of them.
    """
    check_number(name, value, low, high)
    if not isinstance(value, int):
        raise UserInputError(f"{name} is {value!r} but must be a whole number from {low} to {high}")


def check_range(name: str, value: tuple[float, ...], low: float, high: float) -> None:
    """Refuse what is not two numbers from ``low`` to ``high``, the smaller one first.

    Raises:
        UserInputError: naming what is wrong.
    """
    if not isinstance(value, Sequence) or len(value) != 2:
        given = list(value) if isinstance(value, tuple) else value
        raise UserInputError(f"{name} is {given} but must be two numbers, smallest and largest")
    for end in value:
        check_number(name, end, low, high)
    if value[0] > value[1]:
        raise UserInputError(f"{name} is {list(value)} but its smallest value must not exceed its largest")
