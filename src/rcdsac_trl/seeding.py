"""Random streams that derive from (seed, purpose, index) and from nothing else.

No code of this package draws from a global generator: whoever needs randomness asks for the stream of its
purpose, so that what one part draws never changes what another part sees.
"""

import hashlib
from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    import torch


def seed_sequence(seed: int, purpose: str, *index: int) -> np.random.SeedSequence:
    """Return the seed sequence of one purpose.

    Args:
        seed: the run's (or the evaluation's) root seed, at least 0.
        purpose: what the numbers are for, such as ``"goal"``; each purpose is independent of every other.
        index: any number of non-negative integers, such as the episode and the agent.

    Example:
        >>> a = np.random.default_rng(seed_sequence(0, "goal", 3)).integers(1000)
        >>> b = np.random.default_rng(seed_sequence(0, "goal", 3)).integers(1000)
        >>> bool(a == b)
        True
    """
    tag = int.from_bytes(hashlib.sha256(purpose.encode()).digest()[:8], "little")
    # The number of indices goes in too: SeedSequence pads with zeros, so (1,) and (1, 0) would be equal.
    return np.random.SeedSequence([seed, tag, len(index), *index])


def stream(seed: int, purpose: str, *index: int) -> np.random.Generator:
    """Return a NumPy generator for one purpose; see :func:`seed_sequence`."""
    return np.random.default_rng(seed_sequence(seed, purpose, *index))


def torch_seed(seed: int, purpose: str, *index: int) -> int:
    """Return a 63-bit integer seed for one purpose, for :func:`torch.manual_seed`."""
    return int(seed_sequence(seed, purpose, *index).generate_state(1, np.uint64)[0] >> 1)


def torch_stream(seed: int, purpose: str, *index: int) -> "torch.Generator":
    """Return a torch generator on the CPU for one purpose; see :func:`seed_sequence`."""
    import torch  # late: maps, and with them the settings, need none

    return torch.Generator(device="cpu").manual_seed(torch_seed(seed, purpose, *index))
