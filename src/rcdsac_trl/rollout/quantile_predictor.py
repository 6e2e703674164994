"""What the critics say of the actions that agents take, step after step."""

from collections.abc import Sequence

import torch
from tensordict import TensorDictBase
from tensordict.nn import TensorDictSequential
from torch import Tensor

from rcdsac_trl.agent.kernels import dispatch
from rcdsac_trl.deploy.policy.distortion import NUM_REPORTED_QUANTILES, fractions_of


class QuantilePredictor:
    """Predicts the return of some agents of a worker as a robot does: the critics look back to the episode's start, and
    the lower one counts at each fraction.

    Args:
        critics: an encoder and a quantile head each, from :func:`rcdsac_trl.agent.actor.build_critic`.
        rows: the agents.

    Attributes:
        rows: the agents, ``[R]``.
    """

    def __init__(self, critics: Sequence[TensorDictSequential], rows: Sequence[int]) -> None:
        self.rows = torch.tensor(list(rows), device="cpu")
        self._critics = critics
        self._tau = torch.from_numpy(fractions_of(NUM_REPORTED_QUANTILES)).expand(len(rows), 1, -1)
        self._states = [self._tau.new_zeros(len(rows), critic[0].module.state_size) for critic in critics]

    def step(self, tensordict: TensorDictBase) -> Tensor:
        """Return the quantiles ``[R, 16]`` of each agent's return from its action on.

        Args:
            tensordict: ``[N]``, the observations, `is_init`, `action`, and `risk` where the critics read it. Call it
                for every step of an episode.
        """
        lowest = None
        with torch.no_grad():
            for number, (encoder, head) in enumerate(self._critics):
                seen = [tensordict[key][self.rows] for key in (*encoder.in_keys, "is_init")]
                memory, self._states[number] = dispatch.step(encoder.module, *seen, self._states[number])
                entries = {
                    head.in_keys[0]: memory.unsqueeze(1),
                    "action": tensordict["action"][self.rows].unsqueeze(1),
                    "tau": self._tau,
                }
                if "risk" in head.in_keys:
                    entries["risk"] = tensordict["risk"][self.rows].unsqueeze(1)
                quantiles = dispatch.forward(head.module, *[entries[key] for key in head.in_keys])[:, 0]
                quantiles = quantiles.sort(dim=-1).values  # as a robot's policy has them
                lowest = quantiles if lowest is None else torch.minimum(lowest, quantiles)
        assert lowest is not None
        return lowest
