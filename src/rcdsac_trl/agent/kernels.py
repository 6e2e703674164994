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
def _rectify(rows: np.ndarray, bias: np.ndarray) -> None:
    """Add the bias to every row and rectify, in place."""
    zero = rows.dtype.type(0)
    for r in range(rows.shape[0]):
        row = rows[r]
        for h in range(row.size):
            row[h] = max(row[h] + bias[h], zero)


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
def _range_layers(
    bins: np.ndarray,
    positions: np.ndarray,
    taps: np.ndarray,
    bias_1: np.ndarray,
    kernel: np.ndarray,
    bias_2: np.ndarray,
    heard: np.ndarray,
    windows: np.ndarray,
    activations: np.ndarray,
    out: np.ndarray,
) -> None:
    """Write the second convolution's activations and the linear layer's product with them."""
    number = positions.size
    size = windows.shape[0] // number
    for start in range(0, bins.shape[0], size):
        stop = min(start + size, bins.shape[0])
        window, rows = windows[: (stop - start) * number], activations[start * number : stop * number]
        _first_layer(bins[start:stop], positions, taps, bias_1, window)
        times(window, kernel, rows, False)
        _rectify(rows, bias_2)
        times_transposed(rows.reshape(stop - start, -1), heard, out[start:stop], False)


@_compiled
def _range_gradient(
    gradient: np.ndarray,
    bins: np.ndarray,
    positions: np.ndarray,
    taps: np.ndarray,
    bias_1: np.ndarray,
    kernel: np.ndarray,
    heard: np.ndarray,
    windows: np.ndarray,
    activations: np.ndarray,
    d_taps: np.ndarray,
    d_bias_1: np.ndarray,
    d_kernel: np.ndarray,
    d_bias_2: np.ndarray,
    d_heard: np.ndarray,
) -> None:
    """Add the gradients of all that the range layers read but the bins."""
    number, zero = positions.size, bins.dtype.type(0)
    size = windows.shape[0] // number
    d_windows, d_activations = np.empty_like(windows), np.empty_like(activations[: size * number])
    for start in range(0, bins.shape[0], size):
        stop = min(start + size, bins.shape[0])
        window, d_window = windows[: (stop - start) * number], d_windows[: (stop - start) * number]
        rows, d_rows = activations[start * number : stop * number], d_activations[: (stop - start) * number]
        transposed_times(gradient[start:stop], rows.reshape(stop - start, -1), d_heard, True)
        times(gradient[start:stop], heard, d_rows.reshape(stop - start, -1), False)
        for r in range(rows.shape[0]):
            row, d_row = rows[r], d_rows[r]
            for c in range(row.size):
                d_row[c] = d_row[c] if row[c] > zero else zero
                d_bias_2[c] += d_row[c]
        _first_layer(bins[start:stop], positions, taps, bias_1, window)
        transposed_times(window, d_rows, d_kernel, True)
        times_transposed(d_rows, kernel, d_window, False)
        _first_layer_gradient(bins[start:stop], positions, window, d_window, d_taps, d_bias_1)


# ------------------------------------------------------------------------------------------------ features
class _ObservationFeatures(torch.autograd.Function):
    """Convolution 5/2, convolution 3/2, linear layer over the bins; a linear layer for every vector; all rectified.

    A row is what a position of the second convolution sees, so that this is one matrix product. Positions that
    see silent bins alone have no rows: their activation is the same for every observation, and joins the linear
    layer's bias. The first convolution costs so little that its activations are computed again on the way back.
    """

    @staticmethod
    def forward(ctx: Any, bins: Tensor, vectors: Sequence[Tensor], *parameters: Tensor) -> Tensor:
        w1, b1, w2, b2, w3, b3, *others = parameters
        positions = _heard(bins.numpy(), w1.shape[2])
        kernel = w2.permute(2, 1, 0).reshape(-1, w2.shape[0])  # [position seen and channel, channel]
        taps = w1[:, 0].t().contiguous().numpy()
        heard, silent = _divided(w3, positions, w2.shape[0])
        silent_1 = b1.relu()
        silent_2 = torch.addmv(b2, kernel.t(), torch.cat([silent_1] * _SEEN)).relu_()
        widths = [len(b3), *(len(bias) for bias in others[1::2])]
        result = bins.new_empty(len(bins), sum(widths))
        range_features, *vector_features = result.split(widths, dim=1)
        activations = bins.new_empty(len(bins) * len(positions), w2.shape[0])
        windows = _window_buffer(bins, positions, kernel)
        layers = (value.numpy() for value in (b1, kernel, b2, heard, windows, activations, range_features))
        _range_layers(bins.numpy(), positions, taps, *layers)
        for vector, weight, out in zip(vectors, others[::2], vector_features, strict=True):
            torch.mm(vector, weight.t(), out=out)
        _rectify(result.numpy(), torch.cat((torch.addmv(b3, silent, silent_2), *others[1::2])).numpy())
        ctx.save_for_backward(bins, w1, b1, kernel, heard, silent, silent_1, silent_2, activations, result, *vectors)
        ctx.positions, ctx.taps, ctx.widths, ctx.shape_3 = positions, taps, widths, w3.shape
        return result

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, gradient: Tensor) -> tuple[Tensor | None, ...]:
        bins, w1, b1, kernel, heard, silent, silent_1, silent_2, activations, result, *vectors = ctx.saved_tensors
        positions, taps, channels = ctx.positions, ctx.taps, len(b1)
        gradient = torch.ops.aten.threshold_backward(gradient, result, 0)
        d_features, *d_vectors = gradient.split(ctx.widths, dim=1)
        d_b3, *d_biases = gradient.sum(0).split(ctx.widths)
        d_w1, d_b1, d_b2 = bins.new_zeros(w1.shape[2], channels), torch.zeros_like(b1), torch.zeros_like(b1)
        d_kernel, d_heard = torch.zeros_like(kernel), torch.zeros_like(heard)
        windows = _window_buffer(bins, positions, kernel)
        layers = (value.numpy() for value in (b1, kernel, heard, windows, activations))
        gradients = (value.numpy() for value in (d_w1, d_b1, d_kernel, d_b2, d_heard))
        _range_gradient(d_features.numpy(), bins.numpy(), positions, taps, *layers, *gradients)
        # What the silent positions add to the linear layer's bias, backwards.
        d_silent_2 = (silent.t() @ d_b3).mul_(silent_2 > 0)
        d_silent_1 = (kernel @ d_silent_2).view(_SEEN, channels).sum(0).mul_(silent_1 > 0)
        d_kernel.addr_(torch.cat([silent_1] * _SEEN), d_silent_2)
        d_w3 = bins.new_empty(ctx.shape_3)
        d_by_position, d_heard = d_w3.view(len(d_b3), -1, channels), d_heard.view(len(d_b3), -1, channels)
        _unite(d_by_position.numpy(), positions, d_heard.numpy(), d_b3.numpy(), silent_2.numpy())
        d_w2 = d_kernel.view(_SEEN, channels, channels).permute(2, 1, 0)
        d_others = [
            value
            for d_vector, vector, d_bias in zip(d_vectors, vectors, d_biases, strict=True)
            for value in (torch.mm(d_vector.t(), vector), d_bias)
        ]
        d_w1 = d_w1.t().reshape(w1.shape)
        return None, None, d_w1, d_b1 + d_silent_1, d_w2, d_b2 + d_silent_2, d_w3, d_b3, *d_others


def _divided(w3: Tensor, positions: np.ndarray, channels: int) -> tuple[Tensor, Tensor]:
    """Return the linear layer's weight at the heard positions, and its sum over the silent ones."""
    by_position = w3.detach().view(len(w3), -1, channels)
    heard = w3.new_empty(len(w3), len(positions), channels)
    silent = w3.new_empty(len(w3), channels)
    _divide(by_position.numpy(), positions, heard.numpy(), silent.numpy())
    return heard.flatten(1), silent


def _window_buffer(bins: Tensor, positions: np.ndarray, kernel: Tensor) -> Tensor:
    """Return room for the windows of a block of whole observations."""
    observations = min(len(bins), max(1, _ROWS_PER_BLOCK // len(positions)))
    return bins.new_empty(observations * len(positions), len(kernel))


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
