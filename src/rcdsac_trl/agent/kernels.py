r"""An observation's layers up to the recurrent one on a CPU, with their backward pass written out.

They compute exactly what ordinary layers do (tests hold them against those, and against finite differences) and exist
because on a CPU an update spends its time moving memory and calling operations, not multiplying. Here a batch goes
through the range observation's layers in blocks that stay in the cache; what is not a matrix product is one compiled
pass; all layers write into one array of features; and bins that are silent in the whole batch, such as those a
narrow sensor lacks, are left out.

Public names::

    observation_features(bins [n,180], vectors [n,k].., (conv_1, conv_2, linear), layers) -> [n, features]
    rectify(rows, bias)     adds the bias and rectifies in place; compiled
"""

from collections.abc import Sequence
from typing import Any

import numba
import numpy as np
import torch
from torch import Tensor, nn
from torch.autograd.function import once_differentiable

# Windows of the second convolution that go through the layers together: their inputs and activations take some 2 MB.
_ROWS_PER_BLOCK = 96 * 43
# Positions of the first convolution that one of the second sees, its kernel's size; both have stride 2.
_SEEN = 3


# ------------------------------------------------------------------------------------------------ compiled passes
_compiled = numba.njit(cache=True, nogil=True, error_model="numpy", fastmath={"contract"})


@_compiled
def rectify(rows: np.ndarray, bias: np.ndarray) -> None:
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
        for rows, block in _blocks(len(bins), len(positions)):
            window = windows[: rows.stop - rows.start]
            _first_layer(bins[block].numpy(), positions, taps, b1.numpy(), window.numpy())
            torch.mm(window, kernel, out=activations[rows])
            rectify(activations[rows].numpy(), b2.numpy())
            torch.mm(activations[rows].view(-1, heard.shape[1]), heard.t(), out=range_features[block])
        for vector, weight, out in zip(vectors, others[::2], vector_features, strict=True):
            torch.mm(vector, weight.t(), out=out)
        rectify(result.numpy(), torch.cat((torch.addmv(b3, silent, silent_2), *others[1::2])).numpy())
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
        d_windows = torch.empty_like(windows)
        for rows, block in _blocks(len(bins), len(positions)):
            window, d_window = windows[: rows.stop - rows.start], d_windows[: rows.stop - rows.start]
            d_heard.addmm_(d_features[block].t(), activations[rows].view(-1, heard.shape[1]))
            d_rows = torch.mm(d_features[block], heard).view(-1, channels)
            torch.ops.aten.threshold_backward.grad_input(d_rows, activations[rows], 0, grad_input=d_rows)
            d_b2 += d_rows.sum(0)
            _first_layer(bins[block].numpy(), positions, taps, b1.numpy(), window.numpy())
            d_kernel.addmm_(window.t(), d_rows)
            torch.mm(d_rows, kernel.t(), out=d_window)
            arrays = window.numpy(), d_window.numpy(), d_w1.numpy(), d_b1.numpy()
            _first_layer_gradient(bins[block].numpy(), positions, *arrays)
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


def _blocks(observations: int, positions: int) -> list[tuple[slice, slice]]:
    """Cut the observations into blocks; return the rows and the observations of each."""
    size = max(1, _ROWS_PER_BLOCK // positions)
    starts = range(0, observations, size)
    blocks = [slice(start, min(start + size, observations)) for start in starts]
    return [(slice(block.start * positions, block.stop * positions), block) for block in blocks]


def _window_buffer(bins: Tensor, positions: np.ndarray, kernel: Tensor) -> Tensor:
    """Return room for a block's windows."""
    rows = _blocks(len(bins), len(positions))[0][0]
    return bins.new_empty(rows.stop, len(kernel))


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
