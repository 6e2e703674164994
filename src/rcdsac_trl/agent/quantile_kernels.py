r"""The quantile critics' hot pieces on a CPU, each with its backward pass written out.

They compute exactly what ordinary layers do (tests hold them against those, and against finite differences). A batch
of 6,400 transitions has 100,000 quantiles: as ordinary layers, every gate, product and activation of theirs is 50
MB that goes to main memory and back between two operations. Here one compiled pass takes rows through all layers, matrix
products included, in blocks that stay in the cache.

Public names::

    quantile_values(x [B,L,H], tau [B,L|1,N], beta [B,L|1,H], frequencies [C], gate [H,C], hidden, output) -> [B,L,N]
"""

from typing import Any

import numba
import numpy as np
import torch
from torch import Tensor, nn
from torch.autograd.function import once_differentiable

from rcdsac_trl.agent.products import times, times_transposed, transposed_times

# Rows of (transition, quantile) that go through the layers together: an activation of theirs takes 512 kB.
_ROWS_PER_BLOCK = 1024


# ------------------------------------------------------------------------------------------------ compiled passes
# A sum over features may be added up in any order, which lets several be added at once. A loop has few arrays: of many
# the compiler gives up showing that they are apart.
_compiled = numba.njit(cache=True, nogil=True, error_model="numpy", fastmath={"reassoc", "nsz", "contract"})


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
def _layers(
    x: np.ndarray,
    cosines: np.ndarray,
    beta: np.ndarray,
    gate_weight: np.ndarray,
    weight: np.ndarray,
    bias: np.ndarray,
    out_weight: np.ndarray,
    out_bias: np.ndarray,
    tau_gate: np.ndarray,
    hidden: np.ndarray,
    values: np.ndarray,
) -> None:
    """Write the gates, the hidden layer and the values; hidden may have room for some sequences alone."""
    sequences, steps, number = values.shape
    times_transposed(_rows(cosines), gate_weight, _rows(tau_gate), False)
    size = _block(steps * number, sequences)
    product = np.empty((size, steps, number, x.shape[2]), x.dtype)
    for start in range(0, sequences, size):
        stop = min(start + size, sequences)
        first = start if hidden.shape[0] >= sequences else 0
        inner, factors = _rows(hidden[first : first + stop - start]), product[: stop - start]
        _multiply(x[start:stop], tau_gate[start:stop], beta[start:stop], factors)
        times_transposed(_rows(factors), weight, inner, False)
        _output(inner, bias, out_weight, out_bias, values[start:stop].reshape(-1))


@_compiled
def _layers_gradient(
    slopes: np.ndarray,
    x: np.ndarray,
    cosines: np.ndarray,
    beta: np.ndarray,
    tau_gate: np.ndarray,
    hidden: np.ndarray,
    through: np.ndarray,
    d_x: np.ndarray,
    d_beta: np.ndarray,
    d_gate_weight: np.ndarray,
    d_weight: np.ndarray,
    d_bias: np.ndarray,
    d_out_weight: np.ndarray,
) -> None:
    """Add the gradients of all layers; those of weight and bias lack the output's weight, a factor of each row."""
    sequences, steps, number = slopes.shape
    size = _block(steps * number, sequences)
    product, d_hidden = np.empty((size, steps, number, x.shape[2]), x.dtype), np.empty_like(hidden[:size])
    d_tau_gate = np.zeros_like(tau_gate)
    for start in range(0, sequences, size):
        stop = min(start + size, sequences)
        factors, d_inner = product[: stop - start], _rows(d_hidden[: stop - start])
        _output_gradient(slopes[start:stop].reshape(-1), _rows(hidden[start:stop]), d_inner, d_bias, d_out_weight)
        times(d_inner, through, _rows(factors), False)
        _product_gradient(
            factors,
            x[start:stop],
            tau_gate[start:stop],
            beta[start:stop],
            d_x[start:stop],
            d_tau_gate[start:stop],
            d_beta[start:stop],
        )
        transposed_times(d_inner, _rows(factors), d_weight, True)
    transposed_times(_rows(d_tau_gate), _rows(cosines), d_gate_weight, True)


@_compiled
def _gradient_of_features(
    slopes: np.ndarray,
    beta: np.ndarray,
    tau_gate: np.ndarray,
    hidden: np.ndarray,
    through: np.ndarray,
    d_x: np.ndarray,
) -> None:
    """Add the gradient of x alone; transitions with a gradient of 0, of a critic not chosen, cost nothing."""
    sequences, steps, number = slopes.shape
    size = _block(steps * number, sequences)
    d_hidden = np.empty((size * steps, number, hidden.shape[3]), hidden.dtype)
    d_product = np.empty((size * steps, number, d_x.shape[2]), d_x.dtype)
    for start in range(0, sequences, size):
        stop = min(start + size, sequences)
        sloping = _sloping_gradient(slopes[start:stop], hidden[start:stop], d_hidden)
        times(_rows(d_hidden[:sloping]), through, _rows(d_product[:sloping]), False)
        _features_gradient(slopes[start:stop], d_product, tau_gate[start:stop], beta[start:stop], d_x[start:stop])


@_compiled
def _block(rows: int, sequences: int) -> int:
    """Return how many sequences of so many rows each go through the layers together."""
    return min(sequences, max(1, _ROWS_PER_BLOCK // rows))


@_compiled
def _rows(array: np.ndarray) -> np.ndarray:
    """Return all but the last dimension as one."""
    return array.reshape(array.size // array.shape[-1], array.shape[-1])  # -1 cannot be inferred of no rows


# ------------------------------------------------------------------------------------------------ quantile values
class _QuantileValues(torch.autograd.Function):
    """``output(relu(hidden(x * relu(gate @ cos(frequencies * tau) + beta))))``.

    Gates are computed for some sequences at a time, and multiplied with their features for fewer: along a sequence
    that shares its fractions there are far more products than gates.
    """

    @staticmethod
    def forward(
        ctx: Any,
        x: Tensor,
        tau: Tensor,
        beta: Tensor,
        frequencies: Tensor,
        gate_weight: Tensor,
        weight: Tensor,
        bias: Tensor,
        out_weight: Tensor,
        out_bias: Tensor,
    ) -> Tensor:
        (sequences, steps, size), (shared, number) = x.shape, tau.shape[1:]
        keep, blocks = any(ctx.needs_input_grad), _gate_blocks(tau)
        gated = sequences if keep else blocks[0].stop
        cosines = x.new_empty(gated, shared, number, len(frequencies))
        tau_gate = x.new_empty(gated, shared, number, size)
        # What nothing goes back through needs no place of its own.
        inner = sequences if keep else min(blocks[0].stop, max(1, _ROWS_PER_BLOCK // (steps * number)))
        hidden = x.new_empty(inner, steps, number, len(weight))
        result = x.new_empty(sequences, steps, number)
        layers = [value.numpy() for value in (gate_weight, weight, bias, out_weight.view(-1), out_bias)]
        features, offsets, values = x.numpy(), beta.numpy(), result.numpy()
        for block in blocks:
            place = block if keep else slice(0, block.stop - block.start)
            torch.cos(tau[block].unsqueeze(-1) * frequencies, out=cosines[place])
            given = features[block], cosines[place].numpy(), offsets[block]
            rooms = tau_gate[place].numpy(), hidden[place].numpy() if keep else hidden.numpy()
            _layers(*given, *layers, *rooms, values[block])
        if keep:
            ctx.save_for_backward(x, beta, gate_weight, weight, out_weight, cosines, tau_gate, hidden)
        return result

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, gradient: Tensor) -> tuple[Tensor | None, ...]:
        x, beta, gate_weight, weight, out_weight, cosines, tau_gate, hidden = ctx.saved_tensors
        gradient = gradient.contiguous()
        # The output layer's weight is the same for every row: it goes into the matrices instead of the rows.
        column = out_weight.view(-1, 1)
        through = weight * column
        d_x = torch.zeros_like(x)
        if not ctx.needs_input_grad[5]:
            known = gradient, beta, tau_gate, hidden, through
            _gradient_of_features(*(value.numpy() for value in (*known, d_x)))
            return d_x, *[None] * 8
        d_beta, d_gate_weight = torch.zeros_like(beta), torch.zeros_like(gate_weight)
        d_weight, d_bias, d_out_weight = torch.zeros_like(weight), x.new_zeros(len(weight)), x.new_zeros(len(weight))
        along = [value.numpy() for value in (gradient, x, cosines, beta, tau_gate, hidden)]
        sums = [value.numpy() for value in (d_gate_weight, d_weight, d_bias, d_out_weight)]
        for block in _gate_blocks(tau_gate):
            written = d_x[block].numpy(), d_beta[block].numpy()
            _layers_gradient(*(value[block] for value in along), through.numpy(), *written, *sums)
        d_weight, d_bias = d_weight.mul_(column), d_bias.mul_(out_weight.view(-1))
        d_output = d_out_weight.view_as(out_weight), gradient.sum().view(1)
        return d_x, None, d_beta, None, d_gate_weight, d_weight, d_bias, *d_output


def _gate_blocks(gates: Tensor) -> list[slice]:
    """Cut the sequences ``[B, L|1, N, ..]`` into blocks whose gates are computed together."""
    size = max(1, _ROWS_PER_BLOCK // gates.shape[1:3].numel())
    return [slice(start, min(start + size, len(gates))) for start in range(0, len(gates), size)]


def quantile_values(
    x: Tensor, tau: Tensor, beta: Tensor, frequencies: Tensor, gate: Tensor, hidden: nn.Linear, output: nn.Linear
) -> Tensor:
    """Return ``output(relu(hidden(x * relu(gate @ cos(frequencies * tau) + beta))))``, ``[B, L, N]``.

    Either all layers and ``beta`` take a gradient, or only ``x`` does.

    Args:
        x: features of a transition ``[B, L, H]``.
        tau: fractions ``[B, L, N]``, or ``[B, 1, N]`` where constant along a sequence.
        beta: its part of the gate before rectification, bias included, ``[B, L, H]`` or ``[B, 1, H]``.
        frequencies: of the fractions' cosines ``[C]``.
        gate: weight of the fractions' part of the gate ``[H, C]``.
        hidden: linear layer H to H'.
        output: linear layer H' to 1.
    """
    shape = x.shape[:2]
    if tau.shape[1] == beta.shape[1] == shape[1]:
        # Nothing is shared along a sequence: blocks need not hold whole ones.
        x, tau, beta = (value.reshape(-1, 1, value.shape[-1]) for value in (x, tau, beta))
    parameters = [p for layer in (hidden, output) for p in (layer.weight, layer.bias)]
    values = _QuantileValues.apply(x.contiguous(), tau, beta.contiguous(), frequencies, gate, *parameters)
    return values.view(*shape, -1)
