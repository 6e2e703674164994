r"""The quantile critics' hot pieces on a CPU, each with its backward pass written out.

They compute exactly what ordinary layers do (tests hold them against those, and against finite differences). A batch
of 6,400 transitions has 100,000 quantiles: as ordinary layers, every gate, product and activation of theirs is 50
MB that goes to main memory and back between two operations. Here rows go through all layers in blocks that stay in the
cache; the products are torch's matrix products, and what lies between two of them is one compiled pass.

Public names::

    quantile_values(x [B,L,H], tau [B,L|1,N], beta [B,L|1,H], frequencies [C], gate [H,C], hidden, output) -> [B,L,N]
"""

import math
from collections.abc import Sequence
from typing import Any

import numba
import numpy as np
import torch
from torch import Tensor, nn
from torch.autograd.function import once_differentiable

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
        result, keep = x.new_empty(sequences, steps, number), any(ctx.needs_input_grad)
        gate_blocks = _blocks(range(sequences), shared * number)
        longest, most = gate_blocks[0].stop, _blocks(range(sequences), steps * number)[0].stop
        product = _Room(x, most, (steps, number, size))
        cosines = _Room(x, longest, (shared, number, len(frequencies)), keep_all=ctx.needs_input_grad[4])
        tau_gate = _Room(x, longest, (shared, number, size), keep_all=keep)
        hidden = _Room(x, most, (steps, number, len(weight)), keep_all=keep)
        features, offsets, values = x.numpy(), beta.numpy(), result.numpy()
        parameters = bias.numpy(), out_weight.view(-1).numpy(), out_bias.numpy()
        for gated in gate_blocks:
            angles = torch.mul(tau[gated].unsqueeze(-1), frequencies)
            torch.cos(angles.flatten(0, 2), out=cosines.rows(gated))
            torch.mm(cosines.rows(gated), gate_weight.t(), out=tau_gate.rows(gated))
            gates = tau_gate.of(gated)
            for part in _blocks(range(sequences)[gated], steps * number):
                among = slice(part.start - gated.start, part.stop - gated.start)
                _multiply(features[part], gates[among], offsets[part], product.of(part))
                torch.mm(product.rows(part), weight.t(), out=hidden.rows(part))
                _output(_flat(hidden.of(part)), *parameters, values[part].reshape(-1))
        if keep:
            ctx.save_for_backward(x, beta, gate_weight, weight, out_weight, cosines.data, tau_gate.data, hidden.data)
        return result

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, gradient: Tensor) -> tuple[Tensor | None, ...]:
        x, beta, gate_weight, weight, out_weight, cosines, tau_gate, hidden = ctx.saved_tensors
        gradient = gradient.contiguous()
        slopes, features, gates, offsets = gradient.numpy(), x.numpy(), tau_gate.numpy(), beta.numpy()
        # The output layer's weight is the same for every row: it goes into the matrices instead of the rows.
        column = out_weight.view(-1, 1)
        through = weight * column
        if not ctx.needs_input_grad[5]:
            return _gradient_of_features(x, through, slopes, hidden.numpy(), gates, offsets), *[None] * 8
        (sequences, steps, number), shared = gradient.shape, tau_gate.shape[1]
        d_x, d_beta, d_gate_weight = torch.zeros_like(x), torch.zeros_like(beta), torch.zeros_like(gate_weight)
        d_weight, d_bias, d_out_weight = torch.zeros_like(weight), x.new_zeros(len(weight)), x.new_zeros(len(weight))
        gate_blocks = _blocks(range(sequences), shared * number)
        most = _blocks(range(sequences), steps * number)[0].stop
        d_gate = _Room(x, gate_blocks[0].stop, tau_gate.shape[1:])
        product, d_hidden = _Room(x, most, (steps, number, x.shape[2])), _Room(x, most, hidden.shape[1:])
        active, d_features, d_offsets = hidden.numpy(), d_x.numpy(), d_beta.numpy()
        sums = d_bias.numpy(), d_out_weight.numpy()
        for gated in gate_blocks:
            d_gates = d_gate.of(gated)
            d_gates.fill(0)
            for part in _blocks(range(sequences)[gated], steps * number):
                d_rows, products = d_hidden.rows(part), product.rows(part)
                _output_gradient(slopes[part].reshape(-1), _flat(active[part]), _flat(d_hidden.of(part)), *sums)
                torch.mm(d_rows, through, out=products)
                among = slice(part.start - gated.start, part.stop - gated.start)
                arrays = (
                    features[part],
                    gates[part],
                    offsets[part],
                    d_features[part],
                    d_gates[among],
                    d_offsets[part],
                )
                _product_gradient(product.of(part), *arrays)
                d_weight.addmm_(d_rows.t(), products)
            d_gate_weight.addmm_(d_gate.rows(gated).t(), cosines[gated].flatten(0, 2))
        d_weight, d_bias = d_weight.mul_(column), d_bias.mul_(out_weight.view(-1))
        d_output = d_out_weight.view_as(out_weight), gradient.sum().view(1)
        return d_x, None, d_beta, None, d_gate_weight, d_weight, d_bias, *d_output


def _gradient_of_features(
    x: Tensor, through: Tensor, slopes: np.ndarray, hidden: np.ndarray, gates: np.ndarray, offsets: np.ndarray
) -> Tensor:
    """Return the gradient of x alone; transitions with a gradient of 0, of a critic not chosen, cost nothing."""
    sequences, steps, number = slopes.shape
    d_x, blocks = torch.zeros_like(x), _blocks(range(sequences), steps * number)
    most, d_features = blocks[0].stop * steps, d_x.numpy()
    d_product, d_hidden = _Room(x, most, (number, x.shape[2])), _Room(x, most, (number, hidden.shape[3]))
    for part in blocks:
        sloping = slice(0, _sloping_gradient(slopes[part], hidden[part], d_hidden.array))
        torch.mm(d_hidden.rows(sloping), through, out=d_product.rows(sloping))
        _features_gradient(slopes[part], d_product.array, gates[part], offsets[part], d_features[part])
    return d_x


def _blocks(sequences: range, rows: int) -> list[slice]:
    """Cut the sequences of so many rows each into blocks."""
    size = max(1, _ROWS_PER_BLOCK // rows)
    starts = range(sequences.start, sequences.stop, size)
    return [slice(start, min(start + size, sequences.stop)) for start in starts]


class _Room:
    """Room ``[sequences, *shape]`` for one block after another, or for all sequences, which then keep their places.

    It is an array for compiled passes and a matrix of rows for products: a slice of a tensor, or a tensor made an
    array, takes longer than some of the passes.

    Args:
        x: features ``[B, L, H]``.
        block: sequences of a block.
        shape: of a sequence's part.
        keep_all: whether there is room for all.
    """

    def __init__(self, x: Tensor, block: int, shape: Sequence[int], *, keep_all: bool = False) -> None:
        self.data = x.new_empty(len(x) if keep_all else block, *shape)
        self.array = self.data.numpy()
        self._rows, self._each = self.data.flatten(0, -2), math.prod(shape[:-1])
        self._keep_all = keep_all

    def of(self, part: slice) -> np.ndarray:
        """Return the room for these sequences."""
        return self.array[part] if self._keep_all else self.array[: part.stop - part.start]

    def rows(self, part: slice) -> Tensor:
        """Return it as rows, ``[rows, size]``."""
        first = part.start if self._keep_all else 0
        return self._rows[first * self._each : (first + part.stop - part.start) * self._each]


def _flat(array: np.ndarray) -> np.ndarray:
    """Return all but the last dimension as one."""
    return array.reshape(-1, array.shape[-1])


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
