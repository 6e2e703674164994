"""How networks read the ring of range bins: the last bin and the first are neighbours.

Two convolutions read the bins: kernel 5, stride 2, then kernel 3, stride 2. Padded circularly, the first by one bin
before and two behind, the second by one position behind, they make of 180 bins 90 positions, and of these 45. Position
q then reads the nine bins from 4 q - 1 to 4 q + 7 (counted from 0, around the ring), so that turning the ring by four
bins shifts the positions by one, and no direction is read otherwise than another. Both paddings at once are one bin
before the first and four behind the last; the convolutions then need no padding of their own.

With kernel 5 and stride 2, three positions read every second bin and two the others: the sparse sensor's bins are of
the first kind.
"""

from typing import Literal

from rcdsac_trl.robot.range_sensor import NUM_BINS

Padding = Literal["circular", "none"]
"""``circular`` closes the ring; ``none`` is the reading of weights older than it, which ends before the last three
bins, right of straight ahead."""

RING_ENDS: dict[Padding, tuple[int, int]] = {"circular": (1, 4), "none": (0, 0)}
"""How many bins stand before the first, from the ring's end, and behind the last, from its beginning."""

KERNELS = (5, 3)
"""Of the two convolutions."""


def num_positions(padding: Padding) -> int:
    """Return how many positions the second convolution has.

    Example:
        >>> num_positions("circular"), num_positions("none")
        (45, 43)
    """
    number = NUM_BINS + sum(RING_ENDS[padding])
    for kernel in KERNELS:
        number = (number - kernel) // 2 + 1
    return number
