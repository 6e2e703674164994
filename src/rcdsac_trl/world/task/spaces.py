"""What the environment emits: the one table of keys, sizes and limits, and the arrays that hold it.

Both adapters, TorchRL's and Gymnasium's, build their specs from :data:`SPACES` and read :class:`Buffers`.
"""

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, fields
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rcdsac_trl.robot.observation import RANGE_OFFSET, REMEMBERED_SIZE, WAYPOINT_DISTANCE_LIMITS_M, vector_observations
from rcdsac_trl.robot.range_sensor import MAX_RANGE_M, NUM_BINS
from rcdsac_trl.world.task.rules import REWARD_COMPONENTS


@dataclass(frozen=True)
class Space:
    """Size, limits and type of one array.

    Attributes:
        low: lower limit of each entry, -inf for none, float32 [n]; 0 for flags.
        high: upper limit of each entry, inf for none, float32 [n]; 1 for flags.
        dtype: ``np.float32`` or ``np.bool_``.
    """

    low: NDArray[np.float32]
    high: NDArray[np.float32]
    dtype: type

    @property
    def size(self) -> int:
        """Number of entries."""
        return len(self.low)

    @property
    def bounded(self) -> bool:
        """Whether every entry has limits."""
        return bool(np.isfinite(self.low).all() and np.isfinite(self.high).all())


def _numbers(low: Sequence[float], high: Sequence[float]) -> Space:
    return Space(np.asarray(low, np.float32), np.asarray(high, np.float32), np.float32)


def _unlimited(size: int) -> Space:
    return _numbers([-math.inf] * size, [math.inf] * size)


_FLAG = Space(np.zeros(1, np.float32), np.ones(1, np.float32), np.bool_)
# Velocities are measured after contacts, in which a mover can push; 10 m/s and 10 rad/s are far beyond that.
_FASTEST = 10.0
_LOG_NEAR, _LOG_FAR = (math.log10(limit) for limit in WAYPOINT_DISTANCE_LIMITS_M)

ACTION_SIZE = 2


def agent_observations(memory_s: float) -> tuple[str, ...]:
    """Return the keys that a policy may see; the others are for metrics and drawing.

    Args:
        memory_s: for how long points are remembered, s; 0: nothing is.
    """
    return "range", *vector_observations(memory_s)


SPACES: dict[str, Space] = {
    "range": _numbers([0.0] * NUM_BINS, [RANGE_OFFSET + math.log10(MAX_RANGE_M)] * NUM_BINS),
    "waypoint": _numbers([_LOG_NEAR, -1.0, -1.0] * 2, [_LOG_FAR, 1.0, 1.0] * 2),
    "velocity": _numbers([-_FASTEST] * 4, [_FASTEST] * 4),
    "remembered": _unlimited(REMEMBERED_SIZE),
    "pose": _unlimited(3),
    "contact": _FLAG,
    "goal_reached": _FLAG,
    "reward_components": _unlimited(len(REWARD_COMPONENTS)),
    "reward": _unlimited(1),
}


@dataclass(frozen=True)
class Buffers:
    """What a group of agents writes at every step: one array a key of :data:`SPACES`, one row an agent.

    Attributes:
        remembered: None where nothing is remembered; every other key is always there.
    """

    range: NDArray[np.float32]
    waypoint: NDArray[np.float32]
    velocity: NDArray[np.float32]
    pose: NDArray[np.float32]
    contact: NDArray[np.bool_]
    goal_reached: NDArray[np.bool_]
    reward_components: NDArray[np.float32]
    reward: NDArray[np.float32]
    remembered: NDArray[np.float32] | None

    @classmethod
    def zeros(cls, num_agents: int, memory_s: float) -> "Buffers":
        """Allocate the arrays for a number of agents that remember for so long, s."""
        arrays: dict[str, Any] = {key: np.zeros((num_agents, s.size), s.dtype) for key, s in SPACES.items()}
        return cls(**arrays if memory_s > 0.0 else arrays | {"remembered": None})

    def items(self) -> Iterator[tuple[str, NDArray]]:
        """Iterate over keys and arrays."""
        named = ((field.name, getattr(self, field.name)) for field in fields(self))
        return ((name, array) for name, array in named if array is not None)
