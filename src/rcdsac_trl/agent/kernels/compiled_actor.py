"""The actor for a handful of agents on a CPU: one compiled pass an agent, its encoder's and its head's."""

from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
import torch
from tensordict.nn import TensorDictSequential
from torch import Tensor

from rcdsac_trl.agent.heads import ActorHead
from rcdsac_trl.agent.kernels.compiled_encoder import (
    EncoderWeights,
    Floats,
    WeightsOfNow,
    add_product,
    copied,
    encode,
    encoder_weights,
    layer,
)
from rcdsac_trl.agent.networks import Encoder
from rcdsac_trl.robot.action import LOG_STD_RANGE
from rcdsac_trl.system.jit import njit

_LOG_STD_LOW, _LOG_STD_HIGH = (np.float32(limit) for limit in LOG_STD_RANGE)
# As TorchRL's TanhNormal: an action at the very limit has no finite inverse.
_LARGEST_ACTION = np.float32(1.0 - torch.finfo(torch.float32).resolution)

_compiled = njit(nogil=True, error_model="numpy", fastmath={"contract"})


class Agents(NamedTuple):
    """A step of some agents: what :func:`_act` reads of each, and what it writes."""

    ranges: Floats  # padded, [N, bins]
    vectors: Floats  # one behind the other, [N, k]
    embedded: Floats  # beta, [N]
    states: Floats  # advanced in place, [N, state]
    noise: Floats  # [N, action]
    loc: Floats  # written, [N, action], as the other two
    scale: Floats
    action: Floats


class ActorHeadWeights(NamedTuple):
    """What :func:`_act` multiplies with behind the encoder: every matrix as [inputs, outputs].

    What belongs to the gate is empty where there is none.
    """

    input: Floats
    input_bias: Floats
    frequencies: Floats  # of the gate's cosines
    gate: Floats
    gate_bias: Floats
    hidden: Floats
    hidden_bias: Floats
    output: Floats
    output_bias: Floats


@_compiled
def _act(agents: Agents, encoder: EncoderWeights, weights: ActorHeadWeights) -> None:
    """Do a step of every agent."""
    ranges, vectors, embedded, states, noise, loc, scale, action = agents
    features = np.empty(encoder.linear_bias.size + encoder.vectors_bias.size, np.float32)
    size = weights.input_bias.size
    memory = np.empty(weights.input.shape[0], np.float32)
    head, gate, hidden = np.empty(size, np.float32), np.empty(size, np.float32), np.empty(size, np.float32)
    cosines = np.empty(weights.frequencies.size, np.float32)
    out = np.empty(weights.output_bias.size, np.float32)
    for agent in range(ranges.shape[0]):
        encode(ranges[agent], vectors[agent], states[agent], features, memory, encoder)
        layer(memory, weights.input, weights.input_bias, head)
        if cosines.size > 0:
            for c in range(cosines.size):
                cosines[c] = np.cos(embedded[agent] * weights.frequencies[c])
            layer(cosines, weights.gate, weights.gate_bias, gate)
            head *= gate
        layer(head, weights.hidden, weights.hidden_bias, hidden)
        out[:] = weights.output_bias
        add_product(hidden, weights.output, out)
        for a in range(loc.shape[1]):
            loc[agent, a] = out[a]
            scale[agent, a] = np.exp(min(max(out[loc.shape[1] + a], _LOG_STD_LOW), _LOG_STD_HIGH))
            drawn = np.tanh(loc[agent, a] + noise[agent, a] * scale[agent, a])
            action[agent, a] = min(max(drawn, -_LARGEST_ACTION), _LARGEST_ACTION)


def _head_weights(head: Any) -> ActorHeadWeights:
    """Lay out the weights of an actor's head."""
    gated = head.measure is not None
    none = head.input.bias.new_empty(0)
    tensors = {
        "input": head.input.weight.t(),
        "input_bias": head.input.bias,
        "frequencies": head.cosines.frequencies if gated else none,
        "gate": head.gate.weight.t() if gated else none.view(0, 0),
        "gate_bias": head.gate.bias if gated else none,
        "hidden": head.hidden.weight.t(),
        "hidden_bias": head.hidden.bias,
        "output": head.output.weight.t(),
        "output_bias": head.output.bias,
    }
    return ActorHeadWeights(**copied(tensors))


class CompiledActor:
    """One step of an actor on a CPU, for any number of agents; agrees with the actor to rounding.

    Its weights are the actor's, see :class:`~rcdsac_trl.agent.kernels.compiled_encoder.WeightsOfNow`.

    Args:
        actor: encoder and head, from :func:`rcdsac_trl.agent.actor.build_actor`, on the CPU.

    Example:
        >>> from rcdsac_trl.agent.actor import build_actor
        >>> actor = CompiledActor(build_actor())
        >>> seen = torch.zeros(3, 180), [torch.zeros(3, 6), torch.zeros(3, 4)], None
        >>> loc, scale, action, state = actor.step(*seen, torch.ones(3, 1, dtype=torch.bool), torch.zeros(3, 128))
        >>> action.shape, state.shape
        (torch.Size([3, 2]), torch.Size([3, 128]))
    """

    def __init__(self, actor: TensorDictSequential) -> None:
        self._encoder: Encoder = actor[0].module
        self._head: ActorHead = actor[1].module
        self._weights = WeightsOfNow([self._encoder, self._head], self._copied)

    @torch.no_grad()
    def step(
        self,
        range_: Tensor,
        vectors: Sequence[Tensor],
        risk: Tensor | None,
        is_init: Tensor,
        state: Tensor,
        noise: Tensor | None = None,
    ) -> tuple[Tensor, Tensor, Tensor, Tensor]:
        """Advance all agents by one observation.

        Args:
            range_: ``[N, 180]``.
            vectors: the vector observations ``[N, size]``, in the actor's order.
            risk: beta, ``[N, 1]``; None where the actor reads none.
            is_init: ``[N, 1]``, whether this is an episode's first observation: the state is then zero.
            state: recurrent state, ``[N, state_size]``; left as it is.
            noise: standard normal, ``[N, action]``; None for the deterministic action, tanh(loc).

        Returns:
            ``loc`` and ``scale`` of the normal distribution before tanh and the action, ``[N, action]``, and the next
            recurrent state.
        """
        number, measure = len(range_), self._head.measure
        embedded = range_.new_zeros(number, 1) if measure is None or risk is None else measure.embed(risk)
        following = torch.where(is_init, 0.0, state)
        size = self._head.output.out_features // 2
        loc, scale, action = range_.new_empty(3, number, size).unbind()
        tensors = (
            self._encoder.range.read(range_).contiguous(),
            torch.cat(list(vectors), dim=-1),
            embedded.view(-1),
            following,
            range_.new_zeros(number, size) if noise is None else noise,
            *(loc, scale, action),
        )
        _act(Agents(*(value.numpy() for value in tensors)), *self._weights.current(bool(is_init.any())))
        return loc, scale, action, following

    def _copied(self) -> tuple[EncoderWeights, ActorHeadWeights]:
        return encoder_weights(self._encoder), _head_weights(self._head)
