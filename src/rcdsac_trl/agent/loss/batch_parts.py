"""Into how many parts a mini-batch is cut, and how many threads find work in it; known before torch is imported."""

from itertools import pairwise

# A smaller part is mostly calls of operations, and Python makes one at a time.
_TRANSITIONS_PER_PART = 1024


def split_batch(sequences: int, steps: int, threads: int) -> list[slice]:
    """Cut a batch into as many parts as there are threads, fewer where they would be small.

    Args:
        sequences: of the batch.
        steps: of a sequence.
        threads: their number.

    Example:
        >>> split_batch(sequences=3, steps=8, threads=2)
        [slice(0, 3, None)]
    """
    number = max(1, min(threads, sequences * steps // _TRANSITIONS_PER_PART, sequences))
    edges = [sequences * part // number for part in range(number + 1)]
    return [slice(start, stop) for start, stop in pairwise(edges)]


def useful_threads(sequences: int, steps: int, critics: int, threads: int) -> int:
    """Return how many of some threads find work in a batch: all where it is cut, else about one a network.

    Args:
        sequences: of the batch.
        steps: of a sequence.
        critics: their number.
        threads: that there are.

    Example:
        >>> useful_threads(100, 64, critics=2, threads=16), useful_threads(32, 8, critics=2, threads=16)
        (16, 3)
    """
    return threads if len(split_batch(sequences, steps, threads)) > 1 else min(threads, 1 + critics)
