"""What foreseen clearances say of one action: interpolated over the actions that they were computed for.

A critic that is told how near *this* action leads need not learn to look it up, and its slope along the action says
which way there is more room. Between the actions of :data:`FORESEEN_ACTIONS` it is linear along both axes: over the
turns of a row, then from row to row.
"""

from collections.abc import Mapping
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from rcdsac_trl.robot.observation import NUM_FORESEEN_COMMANDS

FORESEEN_ACTIONS: tuple[tuple[float, tuple[float, ...]], ...] = (
    (1.0, (-1.0, -0.75, -0.5, -0.25, 0.0, 0.25, 0.5, 0.75, 1.0)),
    (0.25, (-1.0, -2.0 / 3.0, -1.0 / 3.0, 0.0, 1.0 / 3.0, 2.0 / 3.0, 1.0)),
    (-0.5, (-1.0, 0.0, 1.0)),
    (-1.0, (-0.5, 0.0, 0.5)),
)
"""Rows of actions, each its first number and the second ones from right to left. Of the paper's robot the rows are
full speed, half of it, standing, and backwards."""

FORESEEN_SPAN_M = (0.02, 0.8)
"""Gaps between the robot's inside and what it foresees, m: below the first all are alike, beyond the second none is
near."""

NUM_LOOK_AHEAD = 2
"""Numbers that are told of an action: how near it leads soon, and later."""

FORESEEN_SIZE = NUM_LOOK_AHEAD * NUM_FORESEEN_COMMANDS
"""Numbers they are interpolated from: the last of what is remembered."""


def foreseen_among(vectors: Mapping[str, int]) -> slice:
    """Return where the foreseen clearances stand in all vector observations, one behind the other.

    Args:
        vectors: name and size of each, in their order; what is remembered is one of them.

    Example:
        >>> foreseen_among({"waypoint": 6, "velocity": 4, "remembered": 90, "collision_weight": 1})
        slice(56, 100, None)
    """
    end = sum(list(vectors.values())[: list(vectors).index("remembered") + 1])
    return slice(end - FORESEEN_SIZE, end)


def read_by_heads(memory: int, look_ahead: bool) -> int:
    """Return how many numbers of an encoder's a head reads: the memory, and with a look ahead what is foreseen."""
    return memory + (FORESEEN_SIZE if look_ahead else 0)


def told_of_action(action_size: int, look_ahead: bool) -> int:
    """Return how many numbers a critic is told of an action: its own, and with a look ahead how near it leads."""
    return action_size + (NUM_LOOK_AHEAD if look_ahead else 0)


def _lines(grid: tuple[float, ...]) -> list[tuple[tuple[float, float], tuple[float, float]]]:
    """Return slope and offset of the line that rises to each place of a grid, and of the one that falls behind it.

    A line is 1 at its place and 0 at the neighbour; at the ends of the grid it stays 1.
    """
    rising = [(0.0, 1.0), *((1.0 / (b - a), -a / (b - a)) for a, b in pairwise(grid))]
    falling = [*((-1.0 / (b - a), b / (b - a)) for a, b in pairwise(grid)), (0.0, 1.0)]
    return list(zip(rising, falling, strict=True))


def _hats() -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    rows = [speed for speed, _ in FORESEEN_ACTIONS]
    of_row = dict(zip(sorted(rows), _lines(tuple(sorted(rows))), strict=True))
    lines = [(of_row[speed], line) for speed, turns in FORESEEN_ACTIONS for line in _lines(turns)]
    # [action, axis, side, slope or offset] to [slope or offset, side, axis, action]
    slopes, offsets = np.array(lines, np.float32).transpose(3, 2, 1, 0)
    return np.ascontiguousarray(slopes), np.ascontiguousarray(offsets)


def nearer(read: NDArray[np.float32], margin_m: float) -> NDArray[np.float32]:
    """Return what heads read if all that is foreseen were nearer by a margin, but for what is too far to count.

    Args:
        read: what heads read, what is foreseen last, float32 [.., n >= 44]; without a margin any.
        margin_m: the margin, m.

    Example:
        >>> read = np.full(44, np.log10(0.8 / 0.1), np.float32)  # 0.1 m from the circle inside the robot
        >>> [round(float(0.8 / 10.0**told), 3) for told in nearer(read, 0.03)[:2]]
        [0.07, 0.07]
    """
    if margin_m == 0.0:
        return read
    told = read[..., -FORESEEN_SIZE:]
    least_m, far_m = (np.float32(gap_m) for gap_m in FORESEEN_SPAN_M)
    gap_m = far_m * np.power(np.float32(10.0), -told) - np.float32(margin_m)
    moved = np.log10(far_m / np.maximum(gap_m, least_m))
    return np.concatenate((read[..., :-FORESEEN_SIZE], np.where(told > 0.0, moved, told)), axis=-1, dtype=np.float32)


HAT_SLOPES, HAT_OFFSETS = _hats()
"""Both sides of every action's hat function, float32 [2, 2, 22]: the rising and the falling one, along the action's
first and second number. A hat is the smaller of both sides, within [0, 1]; an action's weight is the product of its
two hats, and all weights add up to 1."""


def look_ahead(foreseen: NDArray[np.float32], action: NDArray[np.float32]) -> NDArray[np.float32]:
    """Return how near an action leads, in the numbers of what is foreseen.

    Args:
        foreseen: [n >= 44], last of it what is foreseen; see
            :meth:`~rcdsac_trl.robot.foreseen_clearance.ForeseenClearance.nearness`.
        action: u, [..., 2], in [-1, 1].

    Returns:
        float32 [..., 2]: soon, and later.

    Example:
        >>> foreseen = np.zeros(44, np.float32)
        >>> foreseen[[4, 22 + 4]] = 0.5, 1.0  # straight ahead at full speed
        >>> look_ahead(foreseen, np.array([1.0, 0.125], np.float32)).tolist()  # half of it, half of what lies beside
        [0.25, 0.5]
    """
    sides = HAT_SLOPES * action[..., None, :, None] + HAT_OFFSETS
    hats = sides.min(axis=-3).clip(0.0, 1.0)
    told: NDArray[np.float32] = hats.prod(axis=-2) @ foreseen[-FORESEEN_SIZE:].reshape(NUM_LOOK_AHEAD, -1).T
    return told
