r"""An observation's layers up to the recurrent one on a CPU, with their backward pass written out.

They compute exactly what ordinary layers do (tests hold them against those, and against finite differences) and exist
because on a CPU an update spends its time moving memory and calling operations, not multiplying. Here the range
observation's layers are one compiled pass, matrix products included, in which a batch goes through them in blocks that
stay in the cache; all layers write into one array of features; and bins that are silent in the whole batch, such as
those a narrow sensor lacks, are left out.

Public names::

    observation_features(bins [n,180], vectors [n,k].., (conv_1, conv_2, linear), layers) -> [n, features]
"""

from collections.abc import Sequence
from typing import Any

import numba
import numpy as np
import torch
from torch import Tensor, nn
from torch.autograd.function import once_differentiable

from rcdsac_trl.agent.products import times, times_transposed, transposed_times

# Windows of the second convolution that go through the layers together: their inputs and activations take some 2 MB.
_ROWS_PER_BLOCK = 96 * 43
# Positions of the first convolution that one of the second sees, its kernel's size; both have stride 2.
_SEEN = 3


# ------------------------------------------------------------------------------------------------ compiled passes
_compiled = numba.njit(cache=True, nogil=True, error_model="numpy", fastmath={"contract"})


@_compiled
def _heard(bins: np.ndarray, taps: int) -> np.ndarray:
    """Return the positions of the second convolution that see a bin which is not 0 in all the batch, or the first."""
    sounds = np.zeros(bins.shape[1], np.uint8)
    for o in range(bins.shape[0]):
        row = bins[o]
        for i in range(row.size):
            sounds[i] |= row[i] != 0
    last = ((bins.shape[1] - taps) // 2 + 1 - _SEEN) // 2
    span = 2 * (_SEEN - 1) + taps
    return np.array([p for p in range(last + 1) if p == 0 or sounds[4 * p : 4 * p + span].any()], np.int64)


@_compiled
def _first_layer(
    bins: np.ndarray, positions: np.ndarray, weight: np.ndarray, bias: np.ndarray, windows: np.ndarray
) -> None:
    """Write the rectified first convolution at all positions that each position of the second sees, side by side."""
    zero, channels = bins.dtype.type(0), bias.size
    for o in range(bins.shape[0]):
        row = bins[o]
        for p in range(positions.size):
            window = windows[o * positions.size + p]
            for s in range(_SEEN):
                i, j = 4 * positions[p] + 2 * s, s * channels
                x0, x1, x2, x3, x4 = row[i], row[i + 1], row[i + 2], row[i + 3], row[i + 4]
                for c in range(channels):
                    value = bias[c] + x0 * weight[0, c] + x1 * weight[1, c] + x2 * weight[2, c]
                    window[j + c] = max(value + x3 * weight[3, c] + x4 * weight[4, c], zero)


@_compiled
def _first_layer_gradient(
    bins: np.ndarray,
    positions: np.ndarray,
    windows: np.ndarray,
    d_windows: np.ndarray,
    d_weight: np.ndarray,
    d_bias: np.ndarray,
) -> None:
    """Add the gradients of the first convolution's weight ``[taps, channels]`` and bias."""
    zero, channels = bins.dtype.type(0), d_bias.size
    for o in range(bins.shape[0]):
        row = bins[o]
        for p in range(positions.size):
            window, d_window = windows[o * positions.size + p], d_windows[o * positions.size + p]
            for s in range(_SEEN):
                i, j = 4 * positions[p] + 2 * s, s * channels
                x0, x1, x2, x3, x4 = row[i], row[i + 1], row[i + 2], row[i + 3], row[i + 4]
                for c in range(channels):
                    slope = d_window[j + c] if window[j + c] > zero else zero
                    d_bias[c] += slope
                    d_weight[0, c] += x0 * slope
                    d_weight[1, c] += x1 * slope
                    d_weight[2, c] += x2 * slope
                    d_weight[3, c] += x3 * slope
                    d_weight[4, c] += x4 * slope


@_compiled
def _divide(by_position: np.ndarray, positions: np.ndarray, heard: np.ndarray, silent: np.ndarray) -> None:
    """Copy the linear layer's weight ``[features, position, channel]`` where heard, and add it up where silent."""
    for f in range(by_position.shape[0]):
        total, number = silent[f], 0
        for c in range(total.size):
            total[c] = 0
        for p in range(by_position.shape[1]):
            row = by_position[f, p]
            if number < positions.size and positions[number] == p:
                out = heard[f, number]
                for c in range(row.size):
                    out[c] = row[c]
                number += 1
            else:
                for c in range(row.size):
                    total[c] += row[c]


@_compiled
def _unite(
    d_by_position: np.ndarray, positions: np.ndarray, d_heard: np.ndarray, d_bias: np.ndarray, value: np.ndarray
) -> None:
    """Write the gradient of the linear layer's weight: silent positions all have the same activation."""
    for f in range(d_by_position.shape[0]):
        number = 0
        for p in range(d_by_position.shape[1]):
            row = d_by_position[f, p]
            if number < positions.size and positions[number] == p:
                out = d_heard[f, number]
                for c in range(row.size):
                    row[c] = out[c]
                number += 1
            else:
                for c in range(row.size):
                    row[c] = d_bias[f] * value[c]


@_compiled
def _silent_activations(w2: np.ndarray, b1: np.ndarray, b2: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return both convolutions' activations where they see silent bins alone."""
    first, second = np.maximum(b1, b1.dtype.type(0)), b2.copy()
    for o in range(second.size):
        for i in range(first.size):
            for s in range(_SEEN):
                second[o] += w2[o, i, s] * first[i]
    return first, np.maximum(second, b2.dtype.type(0))


@_compiled
def _by_tap(w1: np.ndarray, w2: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the weights as the passes read them: ``[taps, channel]``, and ``[tap and channel in, channel out]``."""
    taps, channels = np.empty((w1.shape[2], w1.shape[0]), w1.dtype), w2.shape[1]
    for c in range(w1.shape[0]):
        for k in range(w1.shape[2]):
            taps[k, c] = w1[c, 0, k]
    kernel = np.empty((_SEEN * channels, w2.shape[0]), w2.dtype)
    for o in range(w2.shape[0]):
        for i in range(channels):
            for s in range(_SEEN):
                kernel[s * channels + i, o] = w2[o, i, s]
    return taps, kernel


@_compiled
def _range_layers(
    bins: np.ndarray,
    positions: np.ndarray,
    convolutions: tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray],
    by_position: np.ndarray,
    b3: np.ndarray,
    heard: np.ndarray,
    silent: np.ndarray,
    activations: np.ndarray,
    out: np.ndarray,
) -> None:
    """Write the features into out's first columns, and what the way back reads of heard and silent positions."""
    w1, b1, w2, b2 = convolutions
    number, zero, features = positions.size, bins.dtype.type(0), b3.size
    taps, kernel = _by_tap(w1, w2)
    _divide(by_position, positions, heard, silent)
    _, quiet = _silent_activations(w2, b1, b2)
    offset = b3 + (silent * quiet).sum(1)
    size = _block(bins.shape[0], number)
    windows = np.empty((size * number, kernel.shape[0]), bins.dtype)
    for start in range(0, bins.shape[0], size):
        stop = min(start + size, bins.shape[0])
        window, rows = windows[: (stop - start) * number], activations[start * number : stop * number]
        _first_layer(bins[start:stop], positions, taps, b1, window)
        times(window, kernel, rows, False)
        for r in range(rows.shape[0]):
            row = rows[r]
            for c in range(row.size):
                row[c] = max(row[c] + b2[c], zero)
        times_transposed(rows.reshape(stop - start, -1), _flat(heard), out[start:stop, :features], False)
    _rectify(out, 0, offset)


@_compiled
def _linear(vector: np.ndarray, weight: np.ndarray, bias: np.ndarray, first: int, out: np.ndarray) -> None:
    """Write a rectified linear layer into out's columns from the first on."""
    times_transposed(vector, weight, out[:, first : first + bias.size], False)
    _rectify(out, first, bias)


@_compiled
def _rectify(out: np.ndarray, first: int, bias: np.ndarray) -> None:
    """Add the bias to the columns from the first on and rectify, in place."""
    zero = out.dtype.type(0)
    for r in range(out.shape[0]):
        row = out[r, first : first + bias.size]
        for h in range(row.size):
            row[h] = max(row[h] + bias[h], zero)


@_compiled
def _where_active(gradient: np.ndarray, out: np.ndarray, d_bias: np.ndarray) -> np.ndarray:
    """Return the gradient where out is active, and write its sums."""
    zero = out.dtype.type(0)
    result = np.empty_like(out)
    d_bias[:] = zero
    for r in range(out.shape[0]):
        row, slopes, values = result[r], gradient[r], out[r]
        for h in range(row.size):
            row[h] = slopes[h] if values[h] > zero else zero
            d_bias[h] += row[h]
    return result


@_compiled
def _range_gradient(
    gradient: np.ndarray,
    bins: np.ndarray,
    positions: np.ndarray,
    convolutions: tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray],
    heard: np.ndarray,
    silent: np.ndarray,
    activations: np.ndarray,
    d_convolutions: tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray],
    d_by_position: np.ndarray,
    d_b3: np.ndarray,
) -> None:
    """Write the gradients of all layers from that of the linear layer's output, ``gradient``; that of b3 is given."""
    (w1, b1, w2, b2), (d_w1, d_b1, d_w2, d_b2) = convolutions, d_convolutions
    number, zero, channels = positions.size, bins.dtype.type(0), b1.size
    taps, kernel = _by_tap(w1, w2)
    d_taps, d_kernel, d_heard = np.zeros_like(taps), np.zeros_like(kernel), np.zeros_like(heard)
    d_b1[:], d_b2[:] = zero, zero
    size = _block(bins.shape[0], number)
    windows = np.empty((size * number, kernel.shape[0]), bins.dtype)
    d_windows, d_activations = np.empty_like(windows), np.empty_like(activations[: size * number])
    for start in range(0, bins.shape[0], size):
        stop = min(start + size, bins.shape[0])
        window, d_window = windows[: (stop - start) * number], d_windows[: (stop - start) * number]
        rows, d_rows = activations[start * number : stop * number], d_activations[: (stop - start) * number]
        slopes = gradient[start:stop, : d_b3.size]
        transposed_times(slopes, rows.reshape(stop - start, -1), _flat(d_heard), True)
        times(slopes, _flat(heard), d_rows.reshape(stop - start, -1), False)
        for r in range(rows.shape[0]):
            row, d_row = rows[r], d_rows[r]
            for c in range(row.size):
                d_row[c] = d_row[c] if row[c] > zero else zero
                d_b2[c] += d_row[c]
        _first_layer(bins[start:stop], positions, taps, b1, window)
        transposed_times(window, d_rows, d_kernel, True)
        times_transposed(d_rows, kernel, d_window, False)
        _first_layer_gradient(bins[start:stop], positions, window, d_window, d_taps, d_b1)
    # What the silent positions add to the linear layer's bias, backwards.
    first, second = _silent_activations(w2, b1, b2)
    d_second = np.zeros_like(second)
    for f in range(d_b3.size):
        for o in range(channels):
            d_second[o] += d_b3[f] * silent[f, o]
    for o in range(channels):
        d_second[o] = d_second[o] if second[o] > zero else zero
        d_b2[o] += d_second[o]
    for o in range(channels):
        for i in range(channels):
            for s in range(_SEEN):
                d_w2[o, i, s] = d_kernel[s * channels + i, o] + first[i] * d_second[o]
                d_b1[i] += w2[o, i, s] * d_second[o] if first[i] > zero else zero
    for c in range(channels):
        for k in range(taps.shape[0]):
            d_w1[c, 0, k] = d_taps[k, c]
    _unite(d_by_position, positions, d_heard, d_b3, second)


@_compiled
def _flat(heard: np.ndarray) -> np.ndarray:
    """Return ``[features, position, channel]`` as a matrix."""
    return heard.reshape(heard.shape[0], heard.shape[1] * heard.shape[2])


@_compiled
def _block(observations: int, positions: int) -> int:
    """Return how many observations go through the layers together."""
    return min(observations, max(1, _ROWS_PER_BLOCK // positions))


# ------------------------------------------------------------------------------------------------ features
class _ObservationFeatures(torch.autograd.Function):
    """Convolution 5/2, convolution 3/2, linear layer over the bins; a linear layer for every vector; all rectified.

    A row is what a position of the second convolution sees, so that this is one matrix product. Positions that
    see silent bins alone have no rows: their activation is the same for every observation, and joins the linear
    layer's bias. The first convolution costs so little that its activations are computed again on the way back.
    """

    @staticmethod
    def forward(ctx: Any, bins: Tensor, vectors: Sequence[Tensor], *parameters: Tensor) -> Tensor:
        *convolutions, w3, b3 = parameters[:6]
        weights, biases = parameters[6::2], parameters[7::2]
        channels, places = len(convolutions[0]), np.cumsum([len(b3), *map(len, biases)])
        positions = _heard(bins.numpy(), convolutions[0].shape[2])
        heard, silent = bins.new_empty(len(b3), len(positions), channels), bins.new_empty(len(b3), channels)
        activations = bins.new_empty(len(bins) * len(positions), channels)
        result = bins.new_empty(len(bins), places[-1])
        of_range = tuple(value.numpy() for value in convolutions), w3.view(len(b3), -1, channels).numpy(), b3.numpy()
        kept = heard.numpy(), silent.numpy(), activations.numpy()
        _range_layers(bins.numpy(), positions, *of_range, *kept, result.numpy())
        for vector, weight, bias, first in zip(vectors, weights, biases, places[:-1], strict=True):
            _linear(vector.numpy(), weight.numpy(), bias.numpy(), first, result.numpy())
        ctx.save_for_backward(bins, *convolutions, w3, heard, silent, activations, result, *vectors)
        ctx.positions, ctx.places = positions, places
        return result

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, gradient: Tensor) -> tuple[Tensor | None, ...]:
        bins, w1, b1, w2, b2, w3, heard, silent, activations, result, *vectors = ctx.saved_tensors
        d_biases = result.new_empty(result.shape[1])
        slopes = _where_active(gradient.contiguous().numpy(), result.numpy(), d_biases.numpy())
        d_w3, (d_b3, *d_others) = torch.empty_like(w3), d_biases.tensor_split(ctx.places[:-1].tolist())
        d_convolutions = [torch.empty_like(value) for value in (w1, b1, w2, b2)]
        _range_gradient(
            slopes,
            bins.numpy(),
            ctx.positions,
            tuple(value.numpy() for value in (w1, b1, w2, b2)),
            *(value.numpy() for value in (heard, silent, activations)),
            tuple(value.numpy() for value in d_convolutions),
            d_w3.view(len(d_b3), -1, len(b1)).numpy(),
            d_b3.numpy(),
        )
        d_layers: list[Tensor] = []
        for vector, d_bias, first in zip(vectors, d_others, ctx.places[:-1], strict=True):
            d_weight = vector.new_empty(len(d_bias), vector.shape[1])
            transposed_times(slopes[:, first : first + len(d_bias)], vector.numpy(), d_weight.numpy(), False)
            d_layers += [d_weight, d_bias]
        return None, None, *d_convolutions, d_w3, d_b3, *d_layers


def observation_features(
    bins: Tensor,
    vectors: Sequence[Tensor],
    range_layers: tuple[nn.Conv1d, nn.Conv1d, nn.Linear],
    vector_layers: Sequence[nn.Module],
) -> Tensor:
    """Return the rectified layers' outputs side by side, those of the bins first, ``[n, features]``.

    Bins that are 0 in the whole batch cost nothing where their windows hold no other: a narrow sensor's do.

    Args:
        bins: ``[n, bins]``, at least one; data, so no gradient flows to them, nor to the vectors.
        vectors: ``[n, size]`` each.
        range_layers: a convolution of kernel 5 and stride 2 with one input channel, one of kernel 3 and stride
            2, and a linear layer that reads the positions of the second, position by position; rectifiers between.
        vector_layers: a linear layer for each vector.
    """
    parameters = [p for layer in (*range_layers, *vector_layers) for p in (layer.weight, layer.bias)]
    vectors = [vector.contiguous() for vector in vectors]
    return _ObservationFeatures.apply(bins.contiguous(), vectors, *parameters)
