"""The compiled passes of :mod:`rcdsac_trl.agent.kernels.quantile_values`, on arrays.

Rows go through all layers, matrix products included, in blocks that stay in the cache. Shapes: B sequences of L steps
have N fractions each; H features, C cosines. What is constant along a sequence has one step.
"""

from typing import NamedTuple

import numpy as np

from rcdsac_trl.agent.kernels.feature_kernels import linear
from rcdsac_trl.agent.kernels.matmul import empty_aligned, matmul, matmul_nt, matmul_tn
from rcdsac_trl.system.jit import njit

#: Rows of (transition, quantile) that go through the layers together: an activation of theirs takes 512 kB.
ROWS_PER_BLOCK = 1024

# A sum over features may be added up in any order, which lets several be added at once. A loop has few arrays: of many
# the compiler gives up showing that they are apart.
_compiled = njit(nogil=True, error_model="numpy", fastmath={"reassoc", "nsz", "contract"})


class HeadWeights(NamedTuple):
    """Weights behind the input layer; the gate's bias is part of beta's offsets."""

    gate: np.ndarray  # of the fractions' cosines, [H, C]
    hidden: np.ndarray
    hidden_bias: np.ndarray
    output: np.ndarray  # [H]
    output_bias: np.ndarray


class HeadActivations(NamedTuple):
    """What the layers read and write on their way forth, and read on their way back."""

    x: np.ndarray  # features of memory and action, [B, L, H]
    cosines: np.ndarray  # of the fractions, [B, L|1, N, C]
    beta: np.ndarray  # its part of the gates, [B, L|1, H]
    tau_gate: np.ndarray  # the fractions' part of the gates, [B, L|1, N, H]
    hidden: np.ndarray  # [B, L, N, H], or of some sequences alone where nothing goes back


class HeadGradients(NamedTuple):
    """Gradients that the way back adds to, as the fields of the same names in the others."""

    x: np.ndarray
    beta: np.ndarray
    gate: np.ndarray
    hidden: np.ndarray
    hidden_bias: np.ndarray
    output: np.ndarray


@_compiled
def _multiply(x: np.ndarray, tau_gate: np.ndarray, beta: np.ndarray, product: np.ndarray) -> None:
    """Write ``x * relu(tau_gate + beta)``, broadcast over steps and quantiles."""
    zero = x.dtype.type(0)
    for s in range(x.shape[0]):
        for t in range(x.shape[1]):
            features, offset = x[s, t], beta[s, min(t, beta.shape[1] - 1)]
            gates = tau_gate[s, min(t, tau_gate.shape[1] - 1)]
            for n in range(gates.shape[0]):
                gate, out = gates[n], product[s, t, n]
                for h in range(out.size):
                    out[h] = features[h] * max(gate[h] + offset[h], zero)


@_compiled
def _output(hidden: np.ndarray, bias: np.ndarray, weight: np.ndarray, out_bias: np.ndarray, values: np.ndarray) -> None:
    """Add the bias to hidden and rectify it, in place, and write its product with the output layer."""
    zero = hidden.dtype.type(0)
    for r in range(hidden.shape[0]):
        row, total = hidden[r], out_bias[0]
        for h in range(row.size):
            row[h] = max(row[h] + bias[h], zero)
            total += row[h] * weight[h]
        values[r] = total


@_compiled
def _output_gradient(
    slopes: np.ndarray, hidden: np.ndarray, d_hidden: np.ndarray, d_bias: np.ndarray, d_weight: np.ndarray
) -> None:
    """Write the output's gradient where hidden is active, and add those of hidden's bias and of the output's weight."""
    zero = hidden.dtype.type(0)
    for r in range(hidden.shape[0]):
        row, d_row, slope = hidden[r], d_hidden[r], slopes[r]
        for h in range(row.size):
            d_row[h] = slope if row[h] > zero else zero
        for h in range(row.size):
            d_bias[h] += d_row[h]
            d_weight[h] += slope * row[h]


@_compiled
def _sloping_gradient(slopes: np.ndarray, hidden: np.ndarray, d_hidden: np.ndarray) -> int:
    """Write the output's gradient where hidden is active, of transitions that have one, and return their number."""
    zero, number = hidden.dtype.type(0), 0
    for s in range(slopes.shape[0]):
        for t in range(slopes.shape[1]):
            if slopes[s, t].any():
                for n in range(slopes.shape[2]):
                    row, d_row, slope = hidden[s, t, n], d_hidden[number, n], slopes[s, t, n]
                    for h in range(row.size):
                        d_row[h] = slope if row[h] > zero else zero
                number += 1
    return number


@_compiled
def _features_gradient(
    slopes: np.ndarray, d_product: np.ndarray, tau_gate: np.ndarray, beta: np.ndarray, d_x: np.ndarray
) -> None:
    """Add the gradient of x: the product's, of transitions that have one, times the gate."""
    zero, number = d_x.dtype.type(0), 0
    for s in range(d_x.shape[0]):
        for t in range(d_x.shape[1]):
            if slopes[s, t].any():
                d_features, offset = d_x[s, t], beta[s, min(t, beta.shape[1] - 1)]
                gates = tau_gate[s, min(t, tau_gate.shape[1] - 1)]
                for n in range(gates.shape[0]):
                    gate, d_out = gates[n], d_product[number, n]
                    for h in range(d_out.size):
                        d_features[h] += d_out[h] * max(gate[h] + offset[h], zero)
                number += 1


@_compiled
def _product_gradient(
    product: np.ndarray,
    x: np.ndarray,
    tau_gate: np.ndarray,
    beta: np.ndarray,
    d_x: np.ndarray,
    d_tau_gate: np.ndarray,
    d_beta: np.ndarray,
) -> None:
    """Add the gradients of x and of both halves of the gate; turn the product's gradient into the product."""
    zero = x.dtype.type(0)
    for s in range(x.shape[0]):
        for t in range(x.shape[1]):
            at_beta, at_tau = min(t, beta.shape[1] - 1), min(t, tau_gate.shape[1] - 1)
            features, d_features, offset, d_offset = x[s, t], d_x[s, t], beta[s, at_beta], d_beta[s, at_beta]
            for n in range(tau_gate.shape[2]):
                gate, d_gate, out = tau_gate[s, at_tau, n], d_tau_gate[s, at_tau, n], product[s, t, n]
                for h in range(out.size):
                    opened = max(gate[h] + offset[h], zero)
                    change = out[h] * features[h] if opened > zero else zero
                    d_features[h] += out[h] * opened
                    d_gate[h] += change
                    d_offset[h] += change
                    out[h] = features[h] * opened


@_compiled
def input_layer(joined: np.ndarray, weight: np.ndarray, bias: np.ndarray, x: np.ndarray) -> None:
    """Write the features ``[B, L, H]`` of memory and action side by side."""
    linear(_rows(joined), weight, bias, 0, _rows(x))


@_compiled
def input_gradient(x: np.ndarray, weight: np.ndarray, d_x: np.ndarray, d_joined: np.ndarray) -> None:
    """Turn the gradient of the features into that before their rectifier, and write that of memory and action."""
    rows, d_rows, zero = _rows(x), _rows(d_x), x.dtype.type(0)
    for r in range(rows.shape[0]):
        row, d_row = rows[r], d_rows[r]
        for h in range(row.size):
            d_row[h] = d_row[h] if row[h] > zero else zero
    matmul(d_rows, weight, _rows(d_joined), False)


@_compiled
def affine_gradient(d_out: np.ndarray, given: np.ndarray, d_weight: np.ndarray, d_bias: np.ndarray) -> None:
    """Write the gradients of a linear layer's weight and bias."""
    d_rows = _rows(d_out)
    matmul_tn(d_rows, _rows(given), d_weight, False)
    add_up(d_rows, d_bias)


@_compiled
def add_up(rows: np.ndarray, total: np.ndarray) -> None:
    """Write the sum of the rows."""
    total[:] = 0
    for r in range(rows.shape[0]):
        row = rows[r]
        for h in range(row.size):
            total[h] += row[h]


@_compiled
def offsets(cosines: np.ndarray, weight: np.ndarray, bias: np.ndarray, beta: np.ndarray) -> None:
    """Write beta's part of the gates, bias included, ``[B, L, H]``."""
    rows = _rows(beta)
    for r in range(rows.shape[0]):
        rows[r] = bias
    matmul_nt(_rows(cosines), weight, rows, True)


@_compiled
def layers(activations: HeadActivations, weights: HeadWeights, values: np.ndarray) -> None:
    """Write the gates, the hidden layer and the values ``[B, L, N]``."""
    x, cosines, beta, tau_gate, hidden = activations
    sequences, steps, number = values.shape
    matmul_nt(_rows(cosines), weights.gate, _rows(tau_gate), False)
    size = block(steps * number, sequences)
    product = empty_aligned((size, steps, number, x.shape[2]), x)
    for start in range(0, sequences, size):
        stop = min(start + size, sequences)
        first = start if hidden.shape[0] >= sequences else 0
        inner, factors = _rows(hidden[first : first + stop - start]), product[: stop - start]
        _multiply(x[start:stop], tau_gate[start:stop], beta[start:stop], factors)
        matmul_nt(_rows(factors), weights.hidden, inner, False)
        _output(inner, weights.hidden_bias, weights.output, weights.output_bias, values[start:stop].reshape(-1))


@_compiled
def layers_gradient(
    slopes: np.ndarray, activations: HeadActivations, through: np.ndarray, gradients: HeadGradients
) -> None:
    """Add the gradients of all layers; those of hidden and its bias lack the output's weight, a factor of each row.

    ``slopes`` are the values' gradients ``[B, L, N]``, ``through`` is the hidden layer's weight times the output's.
    """
    x, cosines, beta, tau_gate, hidden = activations
    d_x, d_beta, d_gate_weight, d_weight, d_bias, d_out_weight = gradients
    sequences, steps, number = slopes.shape
    size = block(steps * number, sequences)
    product, d_hidden = empty_aligned((size, steps, number, x.shape[2]), x), empty_aligned((size, *hidden.shape[1:]), x)
    d_tau_gate = empty_aligned(tau_gate.shape, x)
    d_tau_gate[:] = 0
    for start in range(0, sequences, size):
        stop = min(start + size, sequences)
        factors, d_inner = product[: stop - start], _rows(d_hidden[: stop - start])
        _output_gradient(slopes[start:stop].reshape(-1), _rows(hidden[start:stop]), d_inner, d_bias, d_out_weight)
        matmul(d_inner, through, _rows(factors), False)
        _product_gradient(
            factors,
            x[start:stop],
            tau_gate[start:stop],
            beta[start:stop],
            d_x[start:stop],
            d_tau_gate[start:stop],
            d_beta[start:stop],
        )
        matmul_tn(d_inner, _rows(factors), d_weight, True)
    matmul_tn(_rows(d_tau_gate), _rows(cosines), d_gate_weight, True)


@_compiled
def gradient_of_features(
    slopes: np.ndarray, activations: HeadActivations, through: np.ndarray, d_x: np.ndarray
) -> None:
    """Add the gradient of x alone; transitions with a gradient of 0, of a critic not chosen, cost nothing."""
    _, _, beta, tau_gate, hidden = activations
    sequences, steps, number = slopes.shape
    size = block(steps * number, sequences)
    d_hidden = empty_aligned((size * steps, number, hidden.shape[3]), d_x)
    d_product = empty_aligned((size * steps, number, d_x.shape[2]), d_x)
    for start in range(0, sequences, size):
        stop = min(start + size, sequences)
        sloping = _sloping_gradient(slopes[start:stop], hidden[start:stop], d_hidden)
        matmul(_rows(d_hidden[:sloping]), through, _rows(d_product[:sloping]), False)
        _features_gradient(slopes[start:stop], d_product, tau_gate[start:stop], beta[start:stop], d_x[start:stop])


@_compiled
def block(rows: int, sequences: int) -> int:
    """Return how many sequences of so many rows each go through the layers together."""
    return min(sequences, max(1, ROWS_PER_BLOCK // rows))


@_compiled
def _rows(array: np.ndarray) -> np.ndarray:
    """Return all but the last dimension as one."""
    return array.reshape(array.size // array.shape[-1], array.shape[-1])  # -1 cannot be inferred of no rows
