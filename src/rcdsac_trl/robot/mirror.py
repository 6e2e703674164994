"""Left and right exchanged: what an agent would have been told, and would have done, in the mirrored world.

Whatever a robot meets could as well be on its other side, so every experience is two.
"""

import numpy as np
from numpy.typing import NDArray

from rcdsac_trl.robot.foreseen_clearance import MIRRORED_COMMANDS
from rcdsac_trl.robot.observation import (
    NUM_FORESEEN_COMMANDS,
    NUM_REMEMBERED_MOVERS,
    NUM_REMEMBERED_SECTORS,
    REMEMBERED_MOVER_SIZE,
    REMEMBERED_SIZE,
)
from rcdsac_trl.robot.range_sensor import NUM_BINS

_SECTORS = np.arange(NUM_REMEMBERED_SECTORS)
_MOVERS = np.arange(REMEMBERED_MOVER_SIZE * NUM_REMEMBERED_MOVERS) + NUM_REMEMBERED_SECTORS
_SOON, _LATER = REMEMBERED_SIZE - 2 * NUM_FORESEEN_COMMANDS, REMEMBERED_SIZE - NUM_FORESEEN_COMMANDS

MIRRORED: dict[str, tuple[NDArray[np.intp], NDArray[np.float32]]] = {
    # The sine of a bearing, an angular velocity, and a velocity to the left change their sign.
    "waypoint": (np.arange(6), np.array([1, 1, -1] * 2, np.float32)),
    "velocity": (np.arange(4), np.array([1, -1] * 2, np.float32)),
    "remembered": (
        np.concatenate([_SECTORS[::-1], _MOVERS, _SOON + MIRRORED_COMMANDS, _LATER + MIRRORED_COMMANDS]),
        np.array(
            [1] * NUM_REMEMBERED_SECTORS
            + [1, 1, -1, 1, -1] * NUM_REMEMBERED_MOVERS
            + [1] * (2 * NUM_FORESEEN_COMMANDS),
            np.float32,
        ),
    ),
    "action": (np.arange(2), np.array([1, -1], np.float32)),
}
"""From which entry each entry is read in the mirrored world, and times what; ``range`` depends on the sensor."""


def mirrored_bins(sensed: NDArray[np.bool_]) -> NDArray[np.intp]:
    """Return from which bin each range bin is read in the mirrored world, intp [180].

    A bin whose mirror image the sensor lacks is read from the nearest bin that it has: of the narrow sensor bin 159
    alone (counted from 1), of the sparse sensor all, each 2 degrees off. What the sensor lacks stays as it is.

    Args:
        sensed: the bins that the sensor has, bool [180].

    Example:
        >>> mirrored_bins(np.ones(180, dtype=bool))[[0, 1, 179]].tolist()
        [179, 178, 0]
    """
    read, bins = np.arange(NUM_BINS), np.flatnonzero(sensed)
    for bin_ in bins:
        off = (bins - (NUM_BINS - 1 - bin_) + NUM_BINS // 2) % NUM_BINS - NUM_BINS // 2
        read[bin_] = bins[np.abs(off).argmin()]
    return read
