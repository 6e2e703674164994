"""The actor for a handful of agents on a CPU: one compiled pass an agent.

A step of ten agents takes some forty calls of torch, each of which costs more than what it computes. Here an agent goes
through all layers in one pass that multiplies only what is not zero: bins that nothing is seen in, which with the
narrow sensor are most, and what a rectifier has set to zero. An agent's numbers are computed from its own row alone,
in an order that follows from it, so they do not depend, to the last bit, on how many others there are.
"""

from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from tensordict.nn import TensorDictSequential
from torch import Tensor

from rcdsac_trl.agent.networks import LOG_STD_RANGE, ActorHead, Encoder
from rcdsac_trl.system.jit import njit

Floats = NDArray[np.float32]

_LOG_STD_LOW, _LOG_STD_HIGH = (np.float32(limit) for limit in LOG_STD_RANGE)
# As TorchRL's TanhNormal: an action at the very limit has no finite inverse.
_LARGEST_ACTION = np.float32(1.0 - torch.finfo(torch.float32).resolution)

_compiled = njit(nogil=True, error_model="numpy", fastmath={"contract"})


@_compiled
def _add_product(inputs: Floats, weights: Floats, out: Floats) -> None:
    """Add ``inputs @ weights`` to out, input after input, four at a time; inputs of 0 cost nothing."""
    nonzero = np.empty(inputs.size, np.int64)
    number = 0
    for i in range(inputs.size):
        nonzero[number] = i
        number += inputs[i] != 0
    whole = number // 4 * 4
    for k in range(0, whole, 4):
        i0, i1, i2, i3 = nonzero[k], nonzero[k + 1], nonzero[k + 2], nonzero[k + 3]
        x0, x1, x2, x3 = inputs[i0], inputs[i1], inputs[i2], inputs[i3]
        w0, w1, w2, w3 = weights[i0], weights[i1], weights[i2], weights[i3]
        for o in range(out.size):
            out[o] += (x0 * w0[o] + x1 * w1[o]) + (x2 * w2[o] + x3 * w3[o])
    for k in range(whole, number):
        x, w = inputs[nonzero[k]], weights[nonzero[k]]
        for o in range(out.size):
            out[o] += x * w[o]


@_compiled
def _rectify(values: Floats) -> None:
    for o in range(values.size):
        values[o] = max(values[o], np.float32(0))


@_compiled
def _layer(inputs: Floats, weights: Floats, bias: Floats, out: Floats) -> None:
    """Write a rectified linear layer."""
    out[:] = bias
    _add_product(inputs, weights, out)
    _rectify(out)


@_compiled
def _range_features(bins: Floats, weights: "Weights", out: Floats) -> None:
    """Write the features of one observation, its bins padded: both convolutions and the linear layer."""
    taps, channels = weights.conv_1.shape
    positions = weights.linear.shape[0]
    first = np.empty((2 * positions + 1, channels), np.float32)
    active = np.zeros(2 * positions + 1, np.bool_)
    for p in range(2 * positions + 1):
        window = bins[2 * p : 2 * p + taps]
        for t in range(taps):
            active[p] |= window[t] != 0
        if active[p]:
            _layer(window, weights.conv_1, weights.conv_1_bias, first[p])
        else:
            first[p] = weights.inactive_1
    second = np.empty(channels, np.float32)
    out[:] = weights.linear_bias
    for p in range(positions):
        if active[2 * p] or active[2 * p + 1] or active[2 * p + 2]:
            windows = first[2 * p : 2 * p + 3].reshape(3 * channels)
            _layer(windows, weights.conv_2, weights.conv_2_bias, second)
            _add_product(second, weights.linear[p], out)
        else:
            out += weights.inactive_3[p]
    _rectify(out)


@_compiled
def _recurrence(inputs: Floats, state: Floats, weights: "Weights") -> None:
    """Advance the recurrent layer by one step, in place; PyTorch's order of the gates: r, z, n."""
    size = state.size
    recurrent = weights.recurrent_bias.copy()
    _add_product(state, weights.recurrent, recurrent)
    one = np.float32(1)
    for i in range(size):
        r = one / (one + np.exp(-(inputs[i] + recurrent[i])))
        z = one / (one + np.exp(-(inputs[size + i] + recurrent[size + i])))
        n = np.tanh(inputs[2 * size + i] + r * recurrent[2 * size + i])
        state[i] = n + z * (state[i] - n)


@_compiled
def _remember(features: Floats, state: Floats, weights: "Weights") -> None:
    """Advance a state by one observation, in place; see :class:`rcdsac_trl.agent.networks.Encoder`."""
    size = weights.recurrent.shape[0]
    inputs = weights.input_bias.copy()
    _add_product(features, weights.input, inputs)
    if weights.restart_steps > 0:
        younger = state[size : 2 * size]
        if state[2 * size] >= weights.restart_steps:
            state[:size] = younger
            state[size:] = 0
        _recurrence(inputs, younger, weights)
        state[2 * size] += 1
    _recurrence(inputs, state[:size], weights)


@_compiled
def _act(agents: "Agents", weights: "Weights") -> None:
    """Do a step of every agent."""
    ranges, vectors, embedded, states, noise, loc, scale, action = agents
    num_range = weights.linear_bias.size
    features = np.empty(num_range + weights.vectors_bias.size, np.float32)
    num_memory, size = weights.recurrent.shape[0], weights.head_bias.size
    memory = np.empty(weights.head.shape[0], np.float32)
    head, gate, hidden = np.empty(size, np.float32), np.empty(size, np.float32), np.empty(size, np.float32)
    cosines = np.empty(weights.frequencies.size, np.float32)
    out = np.empty(weights.output_bias.size, np.float32)
    for agent in range(ranges.shape[0]):
        _range_features(ranges[agent], weights, features[:num_range])
        _layer(vectors[agent], weights.vectors, weights.vectors_bias, features[num_range:])
        state = states[agent]
        _remember(features, state, weights)
        memory[:num_memory] = state[:num_memory]
        memory[num_memory:] = vectors[agent, weights.foreseen_from : weights.foreseen_from + memory.size - num_memory]
        _layer(memory, weights.head, weights.head_bias, head)
        if cosines.size > 0:
            for c in range(cosines.size):
                cosines[c] = np.cos(embedded[agent] * weights.frequencies[c])
            _layer(cosines, weights.gate, weights.gate_bias, gate)
            head *= gate
        _layer(head, weights.hidden, weights.hidden_bias, hidden)
        out[:] = weights.output_bias
        _add_product(hidden, weights.output, out)
        for a in range(loc.shape[1]):
            loc[agent, a] = out[a]
            scale[agent, a] = np.exp(min(max(out[loc.shape[1] + a], _LOG_STD_LOW), _LOG_STD_HIGH))
            drawn = np.tanh(loc[agent, a] + noise[agent, a] * scale[agent, a])
            action[agent, a] = min(max(drawn, -_LARGEST_ACTION), _LARGEST_ACTION)


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


class Weights(NamedTuple):
    """What :func:`_act` multiplies with: every matrix as [inputs, outputs]."""

    conv_1: Floats  # [taps, channels]
    conv_1_bias: Floats
    conv_2: Floats  # [3 * channels, channels]
    conv_2_bias: Floats
    linear: Floats  # [positions, channels, features]
    linear_bias: Floats
    inactive_1: Floats  # what the first convolution gives where all is inactive, [channels]
    inactive_3: Floats  # what a position that sees only such gives to the linear layer, [positions, features]
    vectors: Floats  # the layers of all vector observations, one below and beside the other
    vectors_bias: Floats
    input: Floats
    input_bias: Floats
    recurrent: Floats
    recurrent_bias: Floats
    head: Floats
    head_bias: Floats
    frequencies: Floats  # of the gate's cosines; [0] without a gate
    gate: Floats
    gate_bias: Floats
    hidden: Floats
    hidden_bias: Floats
    output: Floats
    output_bias: Floats
    restart_steps: int  # 0: the state never restarts
    foreseen_from: int  # where in the vectors what the head reads besides the memory begins


def _copied(encoder: Any, head: Any) -> Weights:
    """Lay out the weights of an actor."""
    conv_1, conv_2, linear = encoder.range.conv_1, encoder.range.conv_2, encoder.range.linear
    channels = conv_2.out_channels
    inactive_1 = conv_1.bias.relu()
    inactive_2 = (conv_2.bias + conv_2.weight.sum(-1) @ inactive_1).relu()
    by_position = linear.weight.view(linear.out_features, -1, channels).permute(1, 2, 0)
    gru = encoder.gru
    gated = head.measure is not None
    none = conv_1.bias.new_empty(0)
    tensors = {
        "conv_1": conv_1.weight.squeeze(1).t(),
        "conv_1_bias": conv_1.bias,
        "conv_2": conv_2.weight.permute(2, 1, 0).reshape(-1, channels),
        "conv_2_bias": conv_2.bias,
        "linear": by_position,
        "linear_bias": linear.bias,
        "inactive_1": inactive_1,
        "inactive_3": inactive_2 @ by_position,
        "vectors": torch.block_diag(*[layer.weight.t() for layer in encoder.vectors]),
        "vectors_bias": torch.cat([layer.bias for layer in encoder.vectors]),
        "input": gru.weight_ih_l0.t(),
        "input_bias": gru.bias_ih_l0,
        "recurrent": gru.weight_hh_l0.t(),
        "recurrent_bias": gru.bias_hh_l0,
        "head": head.input.weight.t(),
        "head_bias": head.input.bias,
        "frequencies": head.cosines.frequencies if gated else none,
        "gate": head.gate.weight.t() if gated else none.view(0, 0),
        "gate_bias": head.gate.bias if gated else none,
        "hidden": head.hidden.weight.t(),
        "hidden_bias": head.hidden.bias,
        "output": head.output.weight.t(),
        "output_bias": head.output.bias,
    }
    arrays = {name: np.array(value.detach().numpy(), order="C") for name, value in tensors.items()}
    return Weights(**arrays, restart_steps=encoder.restart_steps or 0, foreseen_from=encoder.foreseen_from)


class CompiledActor:
    """One step of an actor on a CPU, for any number of agents; agrees with the actor to rounding.

    Its weights are the actor's: they are copied whenever an episode begins, and whenever an operation has changed one
    of the actor's in place, which PyTorch counts. It does not count fused optimisers and what is written past it, as
    TorchRL's checkpoints do: what they change within an episode holds from the next one on.

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
        self._parameters = [*self._encoder.parameters(), *self._head.parameters()]
        self._versions: list[tuple[int, int]] = []
        self._weights: Weights | None = None

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
        _act(Agents(*(value.numpy() for value in tensors)), self._current(bool(is_init.any())))
        return loc, scale, action, following

    def _current(self, begins: bool) -> Weights:
        """Copy the weights if an episode begins, an operation has changed one in place or put another in its place."""
        versions = [(parameter._version, parameter.data_ptr()) for parameter in self._parameters]
        if begins or self._weights is None or versions != self._versions:
            self._weights = _copied(self._encoder, self._head)
            self._versions = versions
        return self._weights
