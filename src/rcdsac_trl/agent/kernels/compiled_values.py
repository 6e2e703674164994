"""What a critic says of many actions of each agent, on a CPU: one compiled pass an agent.

The plain layers take some thirty calls of torch for it, which cost more than the one large product among them. Here
what was read is multiplied once for all actions, gates are computed anew only where beta changes, and the rest is a
product of BLAS between two loops.
"""

from typing import Any, NamedTuple

import numpy as np
import torch
from torch import Tensor

from rcdsac_trl.agent.heads import QuantileHead, ScalarHead
from rcdsac_trl.agent.kernels.compiled_encoder import Floats, WeightsOfNow, add_product, copied
from rcdsac_trl.agent.kernels.matmul import empty_aligned, matmul
from rcdsac_trl.agent.risk import RiskMeasure
from rcdsac_trl.robot.look_ahead import FORESEEN_SIZE, HAT_OFFSETS, HAT_SLOPES, told_of_action
from rcdsac_trl.system.jit import njit

# Sums are vectorised: in which order follows from the sizes alone.
_compiled = njit(nogil=True, error_model="numpy", fastmath={"contract", "reassoc", "nsz"})


class CriticHeadWeights(NamedTuple):
    """What a critic's head multiplies with behind its gate: every matrix as [inputs, outputs].

    The gate is computed before, once for every beta.
    """

    memory: Floats  # of the first layer: what the encoder hands on, [m, head]
    told: Floats  # of the first layer: what is told of an action, [2 or 4, head]
    input_bias: Floats
    hidden: Floats
    hidden_bias: Floats
    output: Floats  # [head]
    output_bias: Floats  # [1]


@_compiled
def _look_ahead(foreseen: Floats, slopes: Floats, offsets: Floats, told: Floats) -> None:
    """Write how near an action leads behind its own two numbers; see :func:`rcdsac_trl.robot.look_ahead.look_ahead`."""
    number = slopes.shape[2]
    told[2:] = 0
    for i in range(number):
        weight = np.float32(1)
        for axis in range(2):
            rising = slopes[0, axis, i] * told[axis] + offsets[0, axis, i]
            falling = slopes[1, axis, i] * told[axis] + offsets[1, axis, i]
            weight *= min(max(min(rising, falling), np.float32(0)), np.float32(1))
        for which in range(told.size - 2):
            told[2 + which] += weight * foreseen[which * number + i]


@_compiled
def _evaluate(
    memories: Floats,
    actions: Floats,
    gates: Floats,
    hats: tuple[Floats, Floats],
    weights: CriticHeadWeights,
    values: Floats,
) -> None:
    """Write the mean over the fractions of each agent's actions; see :meth:`CompiledValues.__call__`."""
    num_agents, num_actions, _ = actions.shape
    _, num_fractions, size = gates.shape
    told = np.empty(weights.told.shape[0], np.float32)
    read, entered = np.empty(size, np.float32), np.empty(size, np.float32)
    gated = empty_aligned((num_actions * num_fractions, size), read)
    hidden = empty_aligned((num_actions * num_fractions, size), read)
    zero = np.float32(0)
    for agent in range(num_agents):
        read[:] = weights.input_bias
        add_product(memories[agent], weights.memory, read)
        for k in range(num_actions):
            told[:2] = actions[agent, k]
            if told.size > 2:
                _look_ahead(memories[agent, memories.shape[1] - FORESEEN_SIZE :], hats[0], hats[1], told)
            entered[:] = read
            for t in range(told.size):
                for h in range(size):
                    entered[h] += told[t] * weights.told[t, h]
            for n in range(num_fractions):
                row = gated[k * num_fractions + n]
                for h in range(size):
                    row[h] = max(entered[h], zero) * gates[agent, n, h]
        matmul(gated, weights.hidden, hidden, False)
        for k in range(num_actions):
            total = zero
            for row in range(k * num_fractions, (k + 1) * num_fractions):
                for h in range(size):
                    total += max(hidden[row, h] + weights.hidden_bias[h], zero) * weights.output[h]
            values[agent, k] = total / np.float32(num_fractions) + weights.output_bias[0]


class CompiledValues:
    """The risk-adjusted value that a critic gives to many actions of each agent; agrees with its layers to rounding.

    It is the mean of the quantiles at some fractions, distorted by a risk measure; a scalar critic says the mean.
    An agent's values are computed from its own row alone. The head's weights are watched as
    :class:`~rcdsac_trl.agent.kernels.compiled_encoder.WeightsOfNow` does.

    Args:
        head: of a critic, on the CPU, in single precision.
        tau: the fractions, ``[F]``.
        measure: distorts them.

    Example:
        >>> from rcdsac_trl.agent.network_settings import NetworkSettings
        >>> from rcdsac_trl.agent.risk import CVaR
        >>> values = CompiledValues(ScalarHead(2, NetworkSettings()), torch.rand(8), CVaR())
        >>> values(torch.zeros(3, 128), torch.zeros(3, 32, 2), torch.ones(3, 1), begins=True).shape
        torch.Size([3, 32])
    """

    def __init__(self, head: QuantileHead | ScalarHead, tau: Tensor, measure: RiskMeasure) -> None:
        self._head, self._tau, self._measure = head, tau, measure
        self._weights = WeightsOfNow([head], lambda: _head_weights(head))
        # What the gates were computed of, and these.
        self._known: tuple[CriticHeadWeights, Tensor, Floats] | None = None

    @torch.no_grad()
    def __call__(self, memory: Tensor, actions: Tensor, risk: Tensor, *, begins: bool) -> Tensor:
        """Return the values, ``[N, K]``.

        Args:
            memory: what the head reads, ``[N, m]``.
            actions: ``[N, K, 2]``.
            risk: beta, ``[N, 1]``.
            begins: whether an episode does, and weights may be new.
        """
        weights = self._weights.current(begins)
        values = memory.new_empty(actions.shape[:2])
        rows = (tensor.contiguous().numpy() for tensor in (memory, actions))
        _evaluate(*rows, self._gates(weights, risk), (HAT_SLOPES, HAT_OFFSETS), weights, values.numpy())
        return values

    def _gates(self, weights: CriticHeadWeights, risk: Tensor) -> Floats:
        """Return the gates of each agent, [N, F, head]; those of before where neither weights nor beta are new."""
        known = self._known
        if known is None or known[0] is not weights or not torch.equal(known[1], risk):
            # Agent by agent: torch may round some rows otherwise than one.
            known = weights, risk.clone(), np.concatenate([self._gates_at(beta) for beta in risk.split(1)])
            self._known = known
        return known[2]

    def _gates_at(self, beta: Tensor) -> Floats:
        """Return the gates at one beta ``[1, 1]``, [1, F, head]; ones of a scalar critic."""
        head = self._head
        if isinstance(head, ScalarHead):
            return np.ones((1, 1, head.hidden.in_features), np.float32)
        tau = self._measure.psi(self._tau.view(1, 1, -1), beta.unsqueeze(1))
        gates: Floats = head.gates(tau, head.beta_cosines(beta.unsqueeze(1))).squeeze(1).numpy()
        return gates


def _head_weights(head: Any) -> CriticHeadWeights:
    """Lay out the weights of a critic's head."""
    weight = head.input.weight.t()
    told = told_of_action(2, head.look_ahead is not None)
    tensors = {
        "memory": weight[:-told],
        "told": weight[-told:],
        "input_bias": head.input.bias,
        "hidden": head.hidden.weight.t(),
        "hidden_bias": head.hidden.bias,
        "output": head.output.weight[0],
        "output_bias": head.output.bias,
    }
    return CriticHeadWeights(**copied(tensors))
