r"""A gated recurrent layer that learns, on a CPU, its backward pass written out.

It computes exactly what ``nn.GRU`` does (tests hold it against that, and against finite differences). Torch's own layer
records some twenty operations a step for its backward pass, among them a matrix product for every weight. Here a step
back is one compiled pass and one matrix product, and whatever does not wait for another step is one matrix product
over all of them.

Public names::

    gated_recurrence(inputs [T,B,I], gru) -> [T,B,H]
"""

from typing import Any

import numba
import numpy as np
import torch
from torch import Tensor, nn
from torch.autograd.function import once_differentiable


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _step_gradient(
    t: int,
    gradient: np.ndarray,
    carried: np.ndarray,
    gates: np.ndarray,
    recurrent: np.ndarray,
    states: np.ndarray,
    d_inputs: np.ndarray,
    d_recurrent: np.ndarray,
) -> None:
    """Write step t's gradients before the gates' nonlinearities, and into ``carried`` what h gets through z."""
    one = states.dtype.type(1)
    size = states.shape[2]
    for b in range(states.shape[1]):
        gate, before = gates[t, b], states[t, b]
        hidden, out, d_h = recurrent[t, b], gradient[t, b], carried[b]
        d_in, d_re = d_inputs[t, b], d_recurrent[t, b]
        for i in range(size):
            r, z, n = gate[i], gate[size + i], gate[2 * size + i]
            d_state = d_h[i] + out[i]
            d_n = d_state * (one - z) * (one - n * n)
            d_z = d_state * (before[i] - n) * z * (one - z)
            d_r = d_n * hidden[2 * size + i] * r * (one - r)
            d_in[i] = d_r
            d_in[size + i] = d_z
            d_in[2 * size + i] = d_n
            d_re[i] = d_r
            d_re[size + i] = d_z
            d_re[2 * size + i] = d_n * r
            d_h[i] = d_state * z


class _GatedRecurrence(torch.autograd.Function):
    """``h' = n + z (h - n)``, ``n = tanh(W_n x + b + r (U_n h + c))``; time comes first."""

    @staticmethod
    def forward(ctx: Any, inputs: Tensor, w_in: Tensor, w_re: Tensor, b_in: Tensor, b_re: Tensor) -> Tensor:
        steps, rows, size = inputs.shape[0], inputs.shape[1], w_re.shape[1]
        x = inputs.reshape(steps * rows, -1)
        gates = torch.addmm(b_in, x, w_in.t()).view(steps, rows, 3 * size)  # r, z, n; first of the inputs alone
        states = inputs.new_empty(steps + 1, rows, size)
        states[0].zero_()
        recurrent, weight = torch.empty_like(gates), w_re.t().contiguous()
        columns = (*gates.split(size, dim=-1), gates[..., : 2 * size], recurrent)
        columns = (*columns, *recurrent.split((2 * size, size), dim=-1), states[:-1], states[1:])
        for r, z, n, both, product, product_both, product_n, before, after in zip(
            *(value.unbind() for value in columns), strict=True
        ):
            torch.addmm(b_re, before, weight, out=product)
            both.add_(product_both).sigmoid_()
            n.addcmul_(r, product_n).tanh_()
            torch.lerp(n, before, z, out=after)
        ctx.save_for_backward(x, w_in, w_re, gates, recurrent, states)
        return states[1:]

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, gradient: Tensor) -> tuple[Tensor, ...]:
        x, w_in, w_re, gates, recurrent, states = ctx.saved_tensors
        steps, rows, size = gates.shape[0], gates.shape[1], states.shape[2]
        d_inputs, d_recurrent = torch.empty_like(recurrent), torch.empty_like(recurrent)
        carried = torch.zeros_like(states[0])
        arrays = [value.numpy() for value in (carried, gates, recurrent, states, d_inputs, d_recurrent)]
        out = gradient.contiguous().numpy()
        for t in range(steps - 1, -1, -1):
            _step_gradient(t, out, *arrays)
            if t > 0:
                carried.addmm_(d_recurrent[t], w_re)
        d_inputs, d_recurrent = d_inputs.view(-1, 3 * size), d_recurrent.view(-1, 3 * size)
        d_x = torch.mm(d_inputs, w_in).view(steps, rows, -1)
        d_w_in = torch.mm(d_inputs.t(), x)
        d_w_re = torch.mm(d_recurrent[rows:].t(), states[1:-1].reshape(-1, size))
        return d_x, d_w_in, d_w_re, d_inputs.sum(0), d_recurrent.sum(0)


def gated_recurrence(inputs: Tensor, gru: nn.GRU) -> Tensor:
    """Return the states of a one-layer ``nn.GRU`` that starts at zero, ``[T, B, H]``.

    Args:
        inputs: time first, ``[T, B, I]``.
        gru: gives the weights.
    """
    return _GatedRecurrence.apply(inputs, gru.weight_ih_l0, gru.weight_hh_l0, gru.bias_ih_l0, gru.bias_hh_l0)
