"""An encoder for a handful of agents on a CPU: one compiled pass an agent.

A step of ten agents takes some twenty calls of torch, each of which costs more than what it computes. Here an agent
goes through all layers in one pass that multiplies only what is not zero: bins that nothing is seen in, which with the
narrow sensor are most, and what a rectifier has set to zero. An agent's numbers are computed from its own row alone,
in an order that follows from it, so they do not depend, to the last bit, on how many others there are.
"""

from collections.abc import Callable, Sequence
from typing import Any, Generic, NamedTuple, TypeVar

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn

from rcdsac_trl.agent.networks import Encoder
from rcdsac_trl.robot.look_ahead import FORESEEN_SIZE
from rcdsac_trl.system.jit import njit

Floats = NDArray[np.float32]
Copy = TypeVar("Copy")

_compiled = njit(nogil=True, error_model="numpy", fastmath={"contract"})


class EncoderWeights(NamedTuple):
    """What an encoder multiplies with: every matrix as [inputs, outputs]."""

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
    restart_steps: int  # 0: the state never restarts
    foreseen_from: int  # where in the vectors what heads read besides the memory begins


@_compiled
def add_product(inputs: Floats, weights: Floats, out: Floats) -> None:
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
def layer(inputs: Floats, weights: Floats, bias: Floats, out: Floats) -> None:
    """Write a rectified linear layer."""
    out[:] = bias
    add_product(inputs, weights, out)
    _rectify(out)


@_compiled
def _range_features(bins: Floats, weights: EncoderWeights, out: Floats) -> None:
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
            layer(window, weights.conv_1, weights.conv_1_bias, first[p])
        else:
            first[p] = weights.inactive_1
    second = np.empty(channels, np.float32)
    out[:] = weights.linear_bias
    for p in range(positions):
        if active[2 * p] or active[2 * p + 1] or active[2 * p + 2]:
            windows = first[2 * p : 2 * p + 3].reshape(3 * channels)
            layer(windows, weights.conv_2, weights.conv_2_bias, second)
            add_product(second, weights.linear[p], out)
        else:
            out += weights.inactive_3[p]
    _rectify(out)


@_compiled
def _recurrence(inputs: Floats, state: Floats, weights: EncoderWeights) -> None:
    """Advance the recurrent layer by one step, in place; PyTorch's order of the gates: r, z, n."""
    size = state.size
    recurrent = weights.recurrent_bias.copy()
    add_product(state, weights.recurrent, recurrent)
    one = np.float32(1)
    for i in range(size):
        r = one / (one + np.exp(-(inputs[i] + recurrent[i])))
        z = one / (one + np.exp(-(inputs[size + i] + recurrent[size + i])))
        n = np.tanh(inputs[2 * size + i] + r * recurrent[2 * size + i])
        state[i] = n + z * (state[i] - n)


@_compiled
def _remember(features: Floats, state: Floats, weights: EncoderWeights) -> None:
    """Advance a state by one observation, in place; see :class:`rcdsac_trl.agent.networks.Encoder`."""
    size = weights.recurrent.shape[0]
    inputs = weights.input_bias.copy()
    add_product(features, weights.input, inputs)
    if weights.restart_steps > 0:
        younger = state[size : 2 * size]
        if state[2 * size] >= weights.restart_steps:
            state[:size] = younger
            state[size:] = 0
        _recurrence(inputs, younger, weights)
        state[2 * size] += 1
    _recurrence(inputs, state[:size], weights)


@_compiled
def encode(
    bins: Floats, vectors: Floats, state: Floats, features: Floats, memory: Floats, weights: EncoderWeights
) -> None:
    """Advance an agent's state by one observation, in place, and write what heads read.

    Args:
        bins: range observation, padded.
        vectors: one behind the other.
        state: of the agent.
        features: room for the features of an observation.
        memory: written.
        weights: of the encoder.
    """
    num_range, num_memory = weights.linear_bias.size, weights.recurrent.shape[0]
    _range_features(bins, weights, features[:num_range])
    layer(vectors, weights.vectors, weights.vectors_bias, features[num_range:])
    _remember(features, state, weights)
    memory[:num_memory] = state[:num_memory]
    memory[num_memory:] = vectors[weights.foreseen_from : weights.foreseen_from + memory.size - num_memory]


@_compiled
def _encode_all(ranges: Floats, vectors: Floats, states: Floats, memories: Floats, weights: EncoderWeights) -> None:
    features = np.empty(weights.linear_bias.size + weights.vectors_bias.size, np.float32)
    for agent in range(ranges.shape[0]):
        encode(ranges[agent], vectors[agent], states[agent], features, memories[agent], weights)


def encoder_weights(encoder: Any) -> EncoderWeights:
    """Lay out the weights of an encoder."""
    conv_1, conv_2, linear = encoder.range.conv_1, encoder.range.conv_2, encoder.range.linear
    channels = conv_2.out_channels
    inactive_1 = conv_1.bias.relu()
    inactive_2 = (conv_2.bias + conv_2.weight.sum(-1) @ inactive_1).relu()
    by_position = linear.weight.view(linear.out_features, -1, channels).permute(1, 2, 0)
    gru = encoder.gru
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
    }
    return EncoderWeights(
        **copied(tensors), restart_steps=encoder.restart_steps or 0, foreseen_from=encoder.foreseen_from
    )


def copied(tensors: dict[str, Tensor]) -> dict[str, Floats]:
    """Copy tensors, row by row."""
    return {name: np.array(value.detach().numpy(), order="C") for name, value in tensors.items()}


class WeightsOfNow(Generic[Copy]):
    """A copy of layers' weights, made anew when they have changed.

    They are copied whenever an episode begins, and whenever an operation has changed one of them in place, which
    PyTorch counts. It does not count fused optimisers and what is written past it, as TorchRL's checkpoints do: what
    they change within an episode holds from the next one on.

    Args:
        layers: whose parameters are watched.
        copy: lays them out.
    """

    def __init__(self, layers: Sequence[nn.Module], copy: Callable[[], Copy]) -> None:
        self._parameters = [parameter for layer in layers for parameter in layer.parameters()]
        self._copy = copy
        self._versions: list[tuple[int, int]] = []
        self._weights: Copy | None = None

    def current(self, begins: bool) -> Copy:
        """Return the copy; make it if an episode begins, or a weight was changed in place or another put there."""
        versions = [(parameter._version, parameter.data_ptr()) for parameter in self._parameters]
        if begins or self._weights is None or versions != self._versions:
            self._weights = self._copy()
            self._versions = versions
        return self._weights


class CompiledEncoder:
    """One step of an encoder on a CPU, for any number of agents; agrees with its layers to rounding.

    Its weights are the encoder's, see :class:`WeightsOfNow`.

    Args:
        encoder: on the CPU, in single precision.
    """

    def __init__(self, encoder: Encoder) -> None:
        self._encoder = encoder
        self._weights = WeightsOfNow([encoder], lambda: encoder_weights(encoder))
        foreseen = 0 if encoder.foreseen_in is None else FORESEEN_SIZE
        self._memory_size = encoder.gru.hidden_size + foreseen

    @torch.no_grad()
    def step(self, range_: Tensor, *rest: Tensor) -> tuple[Tensor, Tensor]:
        """Advance agents ``[N]`` by one observation; see :meth:`rcdsac_trl.agent.networks.HistoryEncoder.step`."""
        *vectors, is_init, state = rest
        following = torch.where(is_init, 0.0, state)
        memory = range_.new_empty(len(range_), self._memory_size)
        tensors = self._encoder.range.read(range_).contiguous(), torch.cat(vectors, dim=-1), following, memory
        _encode_all(*(value.numpy() for value in tensors), self._weights.current(bool(is_init.any())))
        return memory, following
