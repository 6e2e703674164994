"""The compiled passes of :mod:`rcdsac_trl.agent.kernels.observation_features`, on arrays.

A batch goes through the range observation's layers, matrix products included, in blocks that stay in the cache. Bins
that are inactive in the whole batch, such as those a narrow sensor lacks, are left out.
"""

from typing import NamedTuple

import numpy as np

from rcdsac_trl.agent.kernels.matmul import empty_aligned, matmul, matmul_nt, matmul_tn
from rcdsac_trl.system.jit import njit

#: Windows of the second convolution that go through the layers together: their inputs and activations take some 2 MB.
ROWS_PER_BLOCK = 96 * 43
# Positions of the first convolution that one of the second sees, its kernel's size; both have stride 2.
_SEEN = 3

_compiled = njit(nogil=True, error_model="numpy", fastmath={"contract"})


class RangeLayers(NamedTuple):
    """Weights and biases of the layers, or their gradients."""

    conv_1: np.ndarray  # [channels, 1, taps]
    conv_1_bias: np.ndarray
    conv_2: np.ndarray  # [channels, channels, taps]
    conv_2_bias: np.ndarray
    linear: np.ndarray  # [features, position, channel]
    linear_bias: np.ndarray


class RangeActivations(NamedTuple):
    """What the layers write on their way forth and read on their way back."""

    positions: np.ndarray  # the active ones of the second convolution
    active: np.ndarray  # the linear layer's weight at these, [features, position, channel]
    inactive: np.ndarray  # its sum over the others, [features, channel]
    outputs: np.ndarray  # of the second convolution, [observation and active position, channel]


@_compiled
def active_positions(bins: np.ndarray, taps: int) -> np.ndarray:
    """Return the positions of the second convolution that see a bin which is not 0 in all the batch, or the first."""
    seen = np.zeros(bins.shape[1], np.uint8)
    for o in range(bins.shape[0]):
        row = bins[o]
        for i in range(row.size):
            seen[i] |= row[i] != 0
    last = ((bins.shape[1] - taps) // 2 + 1 - _SEEN) // 2
    span = 2 * (_SEEN - 1) + taps
    return np.array([p for p in range(last + 1) if p == 0 or seen[4 * p : 4 * p + span].any()], np.int64)


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
def _divide(by_position: np.ndarray, positions: np.ndarray, active: np.ndarray, inactive: np.ndarray) -> None:
    """Copy the linear layer's weight ``[features, position, channel]`` where active, and add it up where inactive."""
    for f in range(by_position.shape[0]):
        total, number = inactive[f], 0
        for c in range(total.size):
            total[c] = 0
        for p in range(by_position.shape[1]):
            row = by_position[f, p]
            if number < positions.size and positions[number] == p:
                out = active[f, number]
                for c in range(row.size):
                    out[c] = row[c]
                number += 1
            else:
                for c in range(row.size):
                    total[c] += row[c]


@_compiled
def _unite(
    d_by_position: np.ndarray, positions: np.ndarray, d_active: np.ndarray, d_bias: np.ndarray, value: np.ndarray
) -> None:
    """Write the gradient of the linear layer's weight: inactive positions all have the same activation."""
    for f in range(d_by_position.shape[0]):
        number = 0
        for p in range(d_by_position.shape[1]):
            row = d_by_position[f, p]
            if number < positions.size and positions[number] == p:
                out = d_active[f, number]
                for c in range(row.size):
                    row[c] = out[c]
                number += 1
            else:
                for c in range(row.size):
                    row[c] = d_bias[f] * value[c]


@_compiled
def _inactive_activations(w2: np.ndarray, b1: np.ndarray, b2: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return both convolutions' activations where they see inactive bins alone."""
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
    kernel = empty_aligned((_SEEN * channels, w2.shape[0]), w2)
    for o in range(w2.shape[0]):
        for i in range(channels):
            for s in range(_SEEN):
                kernel[s * channels + i, o] = w2[o, i, s]
    return taps, kernel


@_compiled
def range_layers(bins: np.ndarray, weights: RangeLayers, activations: RangeActivations, out: np.ndarray) -> None:
    """Write the features into out's first columns, and what the way back reads of active and inactive positions."""
    w1, b1, w2, b2, by_position, b3 = weights
    positions, active, inactive, outputs = activations
    number, features = positions.size, b3.size
    taps, kernel = _by_tap(w1, w2)
    _divide(by_position, positions, active, inactive)
    _, inactive_output = _inactive_activations(w2, b1, b2)
    offset = b3 + (inactive * inactive_output).sum(1)
    size = _block(bins.shape[0], number)
    windows = empty_aligned((size * number, kernel.shape[0]), bins)
    for start in range(0, bins.shape[0], size):
        stop = min(start + size, bins.shape[0])
        window, rows = windows[: (stop - start) * number], outputs[start * number : stop * number]
        _first_layer(bins[start:stop], positions, taps, b1, window)
        matmul(window, kernel, rows, False)
        _rectify(rows, 0, b2)
        matmul_nt(rows.reshape(stop - start, -1), _flat(active), out[start:stop, :features], False)
    _rectify(out, 0, offset)


@_compiled
def linear(vector: np.ndarray, weight: np.ndarray, bias: np.ndarray, first: int, out: np.ndarray) -> None:
    """Write a rectified linear layer into out's columns from the first on."""
    matmul_nt(vector, weight, out[:, first : first + bias.size], False)
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
def where_active(gradient: np.ndarray, out: np.ndarray, d_bias: np.ndarray) -> np.ndarray:
    """Return the gradient where out is active, and write its sums."""
    zero = out.dtype.type(0)
    result = empty_aligned(out.shape, out)
    d_bias[:] = zero
    for r in range(out.shape[0]):
        row, slopes, values = result[r], gradient[r], out[r]
        for h in range(row.size):
            row[h] = slopes[h] if values[h] > zero else zero
            d_bias[h] += row[h]
    return result


@_compiled
def range_gradient(
    gradient: np.ndarray,
    bins: np.ndarray,
    weights: RangeLayers,
    activations: RangeActivations,
    gradients: RangeLayers,
) -> None:
    """Write the gradients of all layers from that of the linear layer before its rectifier, ``[n, features ..]``.

    That of the linear layer's bias is given.
    """
    w1, b1, w2, b2, _, _ = weights
    positions, active, inactive, outputs = activations
    d_w1, d_b1, d_w2, d_b2, d_by_position, d_b3 = gradients
    number, zero, channels = positions.size, bins.dtype.type(0), b1.size
    taps, kernel = _by_tap(w1, w2)
    d_taps, d_kernel, d_active = (
        np.zeros_like(taps),
        empty_aligned(kernel.shape, bins),
        empty_aligned(active.shape, bins),
    )
    d_kernel[:], d_active[:] = zero, zero
    d_b1[:], d_b2[:] = zero, zero
    size = _block(bins.shape[0], number)
    windows = empty_aligned((size * number, kernel.shape[0]), bins)
    d_windows, d_activations = empty_aligned(windows.shape, bins), empty_aligned((size * number, channels), bins)
    for start in range(0, bins.shape[0], size):
        stop = min(start + size, bins.shape[0])
        window, d_window = windows[: (stop - start) * number], d_windows[: (stop - start) * number]
        rows, d_rows = outputs[start * number : stop * number], d_activations[: (stop - start) * number]
        slopes = gradient[start:stop, : d_b3.size]
        matmul_tn(slopes, rows.reshape(stop - start, -1), _flat(d_active), True)
        matmul(slopes, _flat(active), d_rows.reshape(stop - start, -1), False)
        for r in range(rows.shape[0]):
            row, d_row = rows[r], d_rows[r]
            for c in range(row.size):
                d_row[c] = d_row[c] if row[c] > zero else zero
                d_b2[c] += d_row[c]
        _first_layer(bins[start:stop], positions, taps, b1, window)
        matmul_tn(window, d_rows, d_kernel, True)
        matmul_nt(d_rows, kernel, d_window, False)
        _first_layer_gradient(bins[start:stop], positions, window, d_window, d_taps, d_b1)
    # What the inactive positions add to the linear layer's bias, backwards.
    first, second = _inactive_activations(w2, b1, b2)
    d_second = np.zeros_like(second)
    for f in range(d_b3.size):
        for o in range(channels):
            d_second[o] += d_b3[f] * inactive[f, o]
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
    _unite(d_by_position, positions, d_active, d_b3, second)


@_compiled
def _flat(active: np.ndarray) -> np.ndarray:
    """Return ``[features, position, channel]`` as a matrix."""
    return active.reshape(active.shape[0], active.shape[1] * active.shape[2])


@_compiled
def _block(observations: int, positions: int) -> int:
    """Return how many observations go through the layers together."""
    return min(observations, max(1, ROWS_PER_BLOCK // positions))
