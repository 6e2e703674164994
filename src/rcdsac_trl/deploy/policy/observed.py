"""Observations of the environments, of Gymnasium or TorchRL, as an agent's networks read them."""

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rcdsac_trl.deploy.policy.agent_config import AgentConfig
from rcdsac_trl.deploy.sensors.arrays import numbers_of
from rcdsac_trl.errors import UserInputError
from rcdsac_trl.robot.observation import vector_observations
from rcdsac_trl.robot.range_sensor import NUM_BINS

_RANGE = "range"
_BEGINS = "is_init"


@dataclass(frozen=True)
class Observed:
    """What some agents, N of them, see.

    Attributes:
        bins: range observations, float32 [N, 180].
        vectors: all others side by side, float32 [N, V].
        begins: whose episode begins, bool [N]; none where the environment does not say.
        batch: shape of the agents; ``()`` is one.
    """

    bins: NDArray[np.float32]
    vectors: NDArray[np.float32]
    begins: NDArray[np.bool_]
    batch: tuple[int, ...]


def observed(observation: Any, config: AgentConfig) -> Observed:
    """Read an observation, a dict or a TensorDict with its keys.

    Raises:
        UserInputError: if it is none, lacks something, is not finite, or is of another sensor than the agent's.
    """
    sizes = {_RANGE: NUM_BINS} | vector_observations(config.memory_s)
    arrays = {key: _array(observation, key, size) for key, size in sizes.items()}
    batch = arrays[_RANGE].shape[:-1]
    for key, array in arrays.items():
        if array.shape[:-1] != batch:
            raise UserInputError(
                f"{key} is of agents {array.shape[:-1]}, and {_RANGE} of {batch}: give what one step returned"
            )
    if 0 in batch:
        raise UserInputError(f"the observation is of no agent (batch {list(batch)}): give one agent's or more")
    flat = {key: array.reshape(-1, array.shape[-1]) for key, array in arrays.items()}
    bins = flat.pop(_RANGE)
    if np.any(bins[:, ~config.sensor_mask]):
        raise UserInputError(
            f"there are ranges in sectors that sensor={config.sensor} of robot={config.robot.name} does not have: make "
            "the environment with **policy.world"
        )
    begins = np.zeros(len(bins), dtype=np.bool_)
    if _BEGINS in observation.keys():  # noqa: SIM118 (a TensorDict is asked for its keys)
        begins = np.asarray(observation[_BEGINS], dtype=np.bool_).reshape(-1)
    return Observed(bins, np.concatenate(list(flat.values()), axis=1), begins, batch)


def _array(observation: Any, key: str, size: int) -> NDArray[np.float32]:
    try:
        value = observation[key]
    except (KeyError, TypeError, IndexError) as error:
        raise UserInputError(
            f"the observation has no {key!r}: give what the environment returned, made with **policy.world"
        ) from error
    array = numbers_of(value, key).astype(np.float32)
    if array.shape[-1:] != (size,):
        raise UserInputError(f"{key} has shape {array.shape}, and ends in {size} numbers in an observation: give that")
    if (strange := array[~np.isfinite(array)]).size:
        raise UserInputError(f"the observation's {key!r} holds {strange[0]}: give finite numbers, as environments do")
    return array
