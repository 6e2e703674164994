"""What is given as numbers, as a NumPy array: what is masked, has a unit, or is no number does not pass as one."""

from typing import Any

import numpy as np
from numpy.typing import NDArray

from rcdsac_trl.errors import UserInputError, first_line

# More than any sensor gives: reading them would only cost memory.
_MOST_NUMBERS = 20_000_000
# What lists of numbers mostly hold: neither masked nor with a unit.
_PLAIN = frozenset((float, int, list, tuple, np.float64, np.float32, np.ndarray))


def numbers_of(value: Any, name: str) -> NDArray[np.float64]:
    """Return numbers as float64; what is masked becomes NaN.

    Args:
        value: an array, nested lists, a tensor of torch (with a gradient or without), or what else NumPy can read.
        name: what the numbers are, for the sentence of a refusal.

    Raises:
        UserInputError: if they are missing, or none: texts, objects, booleans, complex numbers, numbers too large for
            float64, or an object that cannot be read; or if they carry a unit, which the array would lose.

    Example:
        >>> numbers_of(np.ma.array([1, 2], mask=[False, True]), "ranges").tolist()
        [1.0, nan]
    """
    if type(value) is np.ndarray and value.dtype == np.float64:
        return value
    are = "are" if is_plural(name) else "is"
    if value is None:
        raise UserInputError(f"{name} {are} missing: give numbers")
    try:
        _refuse_masses(value, name)
        array = _array(value, name)
        _refuse_masses(array, name)
        if array.dtype.kind not in "fiu":
            raise UserInputError(f"{name} {are} not numbers but {array.dtype}: give floats")
        with np.errstate(over="raise"):  # else what is too large becomes inf, which means that nothing is there
            floats: NDArray[np.float64] = array.astype(np.float64, copy=False)
        return floats.filled(np.nan) if isinstance(floats, np.ma.MaskedArray) else np.asarray(floats)
    except UserInputError:
        raise
    except Exception as error:  # what an object does when it is read is not ours to know
        raise UserInputError(f"{name} {are} not numbers: a {type(value).__name__} gives {described(error)}") from error


def is_plural(name: str) -> bool:
    """Tell which verb a name takes in a sentence.

    Example:
        >>> is_plural("ranges"), is_plural("velocity")
        (True, False)
    """
    return name.endswith("s")


def masked(value: Any) -> NDArray[np.bool_] | None:
    """Return where a masked array is masked, [..]; None for anything else."""
    return np.ma.getmaskarray(value) if isinstance(value, np.ma.MaskedArray) else None


def described(error: BaseException) -> str:
    """Return name and first line of a foreign error, whatever it holds."""
    try:
        return f"{type(error).__name__}: {first_line(error)[:120]}"
    except Exception:
        return type(error).__name__


def _array(value: Any, name: str) -> NDArray[Any]:
    """Return what NumPy makes of a value without losing a mask or a unit on the way."""
    if type(value) in (list, tuple):
        if _PLAIN.issuperset(map(type, value)):
            return np.asanyarray(value)
        for item in value:
            _refuse_unit(item, name)
        if any(isinstance(item, np.ma.MaskedArray) for item in value):
            return np.ma.stack([np.ma.asanyarray(item) for item in value])
    else:
        _refuse_unit(value, name)
        detach = getattr(value, "detach", None)  # of torch, which is not imported for this
        if callable(detach):
            value = detach().cpu()
    return np.asanyarray(value)


def _refuse_masses(value: Any, name: str) -> None:
    number = value.size if isinstance(value, np.ndarray) else len(value) if hasattr(value, "__len__") else 0
    if number > _MOST_NUMBERS:
        raise UserInputError(f"{name} are {number}, more than {_MOST_NUMBERS}: no sensor gives so many")


def _refuse_unit(value: Any, name: str) -> None:
    unit = getattr(value, "units", getattr(value, "unit", None))
    if unit is not None:
        raise UserInputError(
            f"{name} carry a unit ({unit}), which an array would lose: give plain numbers, in SI units"
        )
