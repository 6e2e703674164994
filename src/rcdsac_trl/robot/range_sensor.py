"""The range sensor: its bins, its reach, and which bins a sensor of a name has (paper, "States and Observations")."""

import math
from typing import Literal, get_args

import numpy as np
from numpy.typing import NDArray

from rcdsac_trl.errors import UserInputError

# The range sensor (paper, section "States and Observations").
NUM_BINS = 180
"""Number of sectors; bin i (counted from 1) covers [2i-2, 2i) degrees counter-clockwise from the x axis."""


BIN_RAD = 2.0 * math.pi / NUM_BINS
"""Width of a sector."""


MAX_RANGE_M = 3.0
"""What is this far away or farther is not sensed."""


Sensor = Literal["narrow", "sparse", "full"]
"""Which bins the sensor has; see :func:`sensor_mask`."""


SENSORS: frozenset[str] = frozenset(get_args(Sensor))


LONGEST_MEMORY_S = 3600.0
"""Longer than an episode by far; more than that was meant in other units."""


def check_memory(memory_s: float) -> None:
    """Refuse a time that nothing can be remembered for.

    Raises:
        UserInputError: if it is no number, negative, not finite, or above :data:`LONGEST_MEMORY_S`.
    """
    if isinstance(memory_s, bool) or not isinstance(memory_s, int | float | np.integer | np.floating):
        raise UserInputError(f"sensor.memory_s={memory_s!r} is no number: give seconds, 0 for no memory")
    if not 0.0 <= memory_s <= LONGEST_MEMORY_S:
        raise UserInputError(
            f"sensor.memory_s={memory_s:g} is outside [0, {LONGEST_MEMORY_S:g}]: give seconds, 0 for no memory"
        )


def sensor_mask(name: str) -> NDArray[np.bool_]:
    """Return which of the 180 bins a sensor has, bool [180].

    ``full`` has all of them; ``narrow`` lacks bins 22 to 158 (counted from 1, both inclusive), so 43 remain:
    42 degrees to the left and 44 to the right; ``sparse`` has every tenth bin, 10, 20, ..., 180.

    Args:
        name: one of :data:`SENSORS`.

    Raises:
        UserInputError: there is no such sensor.

    Example:
        >>> int(sensor_mask("narrow").sum()), int(sensor_mask("sparse").sum())
        (43, 18)
    """
    if name not in SENSORS:
        raise UserInputError(f"sensor={name!r} does not exist; choose one of {', '.join(sorted(SENSORS))}")
    number = np.arange(1, NUM_BINS + 1)
    if name == "narrow":
        return (number < 22) | (number > 158)
    if name == "sparse":
        return number % 10 == 0
    return np.ones(NUM_BINS, dtype=np.bool_)
