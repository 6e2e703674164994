r"""A gated recurrent layer that learns, on a CPU, its backward pass written out.

It computes exactly what ``nn.GRU`` does (tests hold it against that, and against finite differences). Torch's own layer
records some twenty operations a step for its backward pass, among them a matrix product for every weight. Here a step,
forth or back, is one compiled pass and one matrix product, and whatever does not wait for another step is one matrix
product over all of them.

Public names::

    gated_recurrence(inputs [T,B,I], gru) -> [T,B,H]
"""

from collections.abc import Callable
from typing import Any

import numba
import numpy as np
import torch
from numba.extending import overload
from torch import Tensor, nn
from torch.autograd.function import once_differentiable

_compiled = numba.njit(cache=True, nogil=True, error_model="numpy", fastmath={"contract"})

# tanh(x) = x P(x^2) / Q(x^2), fitted to 1e-8 of tanh for |x| up to the limit, where float32 has no number left below 1.
_LIMIT = np.float32(8.5)
_P0, _P1, _P2, _P3, _P4 = (np.float32(c) for c in (1.0, 1.3413249e-1, 3.5340297e-3, 2.1251091e-5, 1.4269291526e-8))
_Q0, _Q1, _Q2, _Q3, _Q4 = (np.float32(c) for c in (1.0, 4.6746573e-1, 2.6022762e-2, 3.348869404e-4, 8.1451497636e-7))


def _tanh(x: Any) -> Any:
    """Return tanh in the type of x, in compiled code alone."""
    raise NotImplementedError


@overload(_tanh)
def _compiled_tanh(x: Any) -> Callable[[Any], Any]:
    """Choose by the type: several float32 are computed at once, which calls of a library's tanh would prevent."""

    def rational(x: Any) -> Any:
        x = min(max(x, -_LIMIT), _LIMIT)
        s = x * x
        p = (((_P4 * s + _P3) * s + _P2) * s + _P1) * s + _P0
        q = (((_Q4 * s + _Q3) * s + _Q2) * s + _Q1) * s + _Q0
        one = np.float32(1)
        return min(max(x * p / q, -one), one)

    def exact(x: Any) -> Any:
        return np.tanh(x)

    return rational if x == numba.types.float32 else exact


# Rows are sliced into gates rather than indexed at an offset: only so does the compiler know that they are contiguous.
@_compiled
def _step(t: int, bias: np.ndarray, gates: np.ndarray, recurrent: np.ndarray, states: np.ndarray) -> None:
    """Do step t: what input and state contribute to the gates becomes r, z, n, and ``U_n h + c``."""
    half = states.dtype.type(0.5)
    size = states.shape[2]
    for b in range(states.shape[1]):
        both, of_state = gates[t, b, : 2 * size], recurrent[t, b, : 2 * size]
        for i in range(both.size):
            both[i] = half * _tanh(half * (both[i] + of_state[i] + bias[i])) + half  # the logistic function
        r, z, n = gates[t, b, :size], gates[t, b, size : 2 * size], gates[t, b, 2 * size :]
        inner, offset = recurrent[t, b, 2 * size :], bias[2 * size :]
        for i in range(size):
            inner[i] += offset[i]
            n[i] = _tanh(n[i] + r[i] * inner[i])
        before, after = states[t, b], states[t + 1, b]
        for i in range(size):
            after[i] = n[i] + z[i] * (before[i] - n[i])


@_compiled
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
        r, z, n = gates[t, b, :size], gates[t, b, size : 2 * size], gates[t, b, 2 * size :]
        before, inner, out, d_h = states[t, b], recurrent[t, b, 2 * size :], gradient[t, b], carried[b]
        d_r, d_z = d_inputs[t, b, :size], d_inputs[t, b, size : 2 * size]
        d_n, d_inner = d_inputs[t, b, 2 * size :], d_recurrent[t, b, 2 * size :]
        for i in range(size):
            d_state = d_h[i] + out[i]
            d_n[i] = d_state * (one - z[i]) * (one - n[i] * n[i])
            d_z[i] = d_state * (before[i] - n[i]) * z[i] * (one - z[i])
            d_h[i] = d_state * z[i]
        for i in range(size):
            d_r[i] = d_n[i] * inner[i] * r[i] * (one - r[i])
            d_inner[i] = d_n[i] * r[i]
        d_recurrent[t, b, : 2 * size] = d_inputs[t, b, : 2 * size]


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
        arrays = [value.numpy() for value in (b_re, gates, recurrent, states)]
        for t, (before, product) in enumerate(zip(states[:-1].unbind(), recurrent.unbind(), strict=True)):
            torch.mm(before, weight, out=product)
            _step(t, *arrays)
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
