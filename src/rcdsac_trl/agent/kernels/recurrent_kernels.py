r"""A gated recurrent layer that learns, on a CPU, its backward pass written out.

It computes exactly what ``nn.GRU`` does (tests hold it against that, and against finite differences). Torch's own layer
records some twenty operations a step for its backward pass, among them a matrix product for every weight. Here all
steps, forth or back, are one compiled pass, with one matrix product a step; whatever does not wait for another step is
one product over all of them.
"""

from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import numpy as np
import torch
from numba import types
from numba.extending import overload
from torch import Tensor, nn
from torch.autograd.function import once_differentiable

from rcdsac_trl.agent.kernels.matmul import empty_aligned, matmul, matmul_nt, matmul_tn
from rcdsac_trl.system.jit import njit

_compiled = njit(nogil=True, error_model="numpy", fastmath={"contract"})

# tanh(x) = x P(x^2) / Q(x^2), fitted to 1e-8 of tanh for |x| up to the limit, where float32 has no number left below 1.
_LIMIT = np.float32(8.5)
_P0, _P1, _P2, _P3, _P4 = (np.float32(c) for c in (1.0, 1.3413249e-1, 3.5340297e-3, 2.1251091e-5, 1.4269291526e-8))
_Q0, _Q1, _Q2, _Q3, _Q4 = (np.float32(c) for c in (1.0, 4.6746573e-1, 2.6022762e-2, 3.348869404e-4, 8.1451497636e-7))


class _Weights(NamedTuple):
    """Weights and biases for what comes in and for what is remembered, or their gradients."""

    w_in: np.ndarray
    w_re: np.ndarray
    b_in: np.ndarray
    b_re: np.ndarray


class _Activations(NamedTuple):
    """What the steps write on their way forth and read on their way back."""

    gates: np.ndarray  # r, z, n, [T, B, 3 H]
    recurrent: np.ndarray  # what the state contributes to them, [T, B, 3 H]
    states: np.ndarray  # from the first, 0, to the last, [T + 1, B, H]


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

    return rational if x == types.float32 else exact


# Rows are sliced into gates rather than indexed at an offset: only so does the compiler know that they are contiguous.
@_compiled
def _step(
    gates: np.ndarray, recurrent: np.ndarray, b_in: np.ndarray, b_re: np.ndarray, before: np.ndarray, after: np.ndarray
) -> None:
    """Do a step: what input and state contribute to the gates becomes r, z, n, and ``U_n h + c``."""
    half = before.dtype.type(0.5)
    size = before.shape[1]
    for b in range(before.shape[0]):
        both, of_state = gates[b, : 2 * size], recurrent[b, : 2 * size]
        for i in range(both.size):
            both[i] = half * _tanh(half * (both[i] + of_state[i] + b_in[i] + b_re[i])) + half  # the logistic function
        r, z, n = gates[b, :size], gates[b, size : 2 * size], gates[b, 2 * size :]
        inner, offset, inner_offset = recurrent[b, 2 * size :], b_in[2 * size :], b_re[2 * size :]
        for i in range(size):
            inner[i] += inner_offset[i]
            n[i] = _tanh(n[i] + offset[i] + r[i] * inner[i])
        old, new = before[b], after[b]
        for i in range(size):
            new[i] = n[i] + z[i] * (old[i] - n[i])


@_compiled
def _step_gradient(
    gradient: np.ndarray,
    carried: np.ndarray,
    gates: np.ndarray,
    recurrent: np.ndarray,
    states: np.ndarray,
    d_inputs: np.ndarray,
    d_recurrent: np.ndarray,
) -> None:
    """Write a step's gradients before the gates' nonlinearities, and into ``carried`` what h gets through z."""
    one = states.dtype.type(1)
    size = states.shape[1]
    for b in range(states.shape[0]):
        r, z, n = gates[b, :size], gates[b, size : 2 * size], gates[b, 2 * size :]
        before, inner, out, d_h = states[b], recurrent[b, 2 * size :], gradient[b], carried[b]
        d_r, d_z = d_inputs[b, :size], d_inputs[b, size : 2 * size]
        d_n, d_inner = d_inputs[b, 2 * size :], d_recurrent[b, 2 * size :]
        for i in range(size):
            d_state = d_h[i] + out[i]
            d_n[i] = d_state * (one - z[i]) * (one - n[i] * n[i])
            d_z[i] = d_state * (before[i] - n[i]) * z[i] * (one - z[i])
            d_h[i] = d_state * z[i]
        for i in range(size):
            d_r[i] = d_n[i] * inner[i] * r[i] * (one - r[i])
            d_inner[i] = d_n[i] * r[i]
        d_recurrent[b, : 2 * size] = d_inputs[b, : 2 * size]


@_compiled
def _steps(x: np.ndarray, weights: _Weights, activations: _Activations) -> None:
    """Do all steps from the state 0."""
    w_in, w_re, b_in, b_re = weights
    gates, recurrent, states = activations
    states[0], recurrent[0] = 0, 0
    matmul_nt(x, w_in, gates.reshape(x.shape[0], -1), False)
    for t in range(gates.shape[0]):
        if t > 0:
            matmul_nt(states[t], w_re, recurrent[t], False)
        _step(gates[t], recurrent[t], b_in, b_re, states[t], states[t + 1])


@_compiled
def _steps_gradient(
    gradient: np.ndarray,
    x: np.ndarray,
    weights: _Weights,
    activations: _Activations,
    d_x: np.ndarray,
    gradients: _Weights,
) -> None:
    """Write the gradients of the inputs and of the weights."""
    w_in, w_re, _, _ = weights
    gates, recurrent, states = activations
    d_w_in, d_w_re, d_b_in, d_b_re = gradients
    d_inputs, d_recurrent, carried = (
        empty_aligned(gates.shape, x),
        empty_aligned(gates.shape, x),
        empty_aligned(states.shape[1:], x),
    )
    carried[:] = 0
    for t in range(len(gates) - 1, -1, -1):
        _step_gradient(gradient[t], carried, gates[t], recurrent[t], states[t], d_inputs[t], d_recurrent[t])
        if t > 0:
            matmul(d_recurrent[t], w_re, carried, True)
    rows, first, size = x.shape[0], states.shape[1], states.shape[2]
    of_inputs, of_states = d_inputs.reshape(rows, -1), d_recurrent.reshape(rows, -1)
    matmul(of_inputs, w_in, d_x, False)
    matmul_tn(of_inputs, x, d_w_in, False)
    matmul_tn(of_states[first:], states[1:-1].reshape(rows - first, size), d_w_re, False)
    d_b_in[:], d_b_re[:] = 0, 0
    for r in range(rows):
        row, other = of_inputs[r], of_states[r]
        for i in range(row.size):
            d_b_in[i] += row[i]
            d_b_re[i] += other[i]


class _GatedRecurrence(torch.autograd.Function):
    """``h' = n + z (h - n)``, ``n = tanh(W_n x + b + r (U_n h + c))``; time comes first."""

    @staticmethod
    def forward(ctx: Any, inputs: Tensor, w_in: Tensor, w_re: Tensor, b_in: Tensor, b_re: Tensor) -> Tensor:
        steps, rows, size = inputs.shape[0], inputs.shape[1], w_re.shape[1]
        x = inputs.reshape(steps * rows, -1)
        gates = inputs.new_empty(steps, rows, 3 * size)  # r, z, n
        recurrent, states = torch.empty_like(gates), inputs.new_empty(steps + 1, rows, size)
        weights = w_in, w_re, b_in, b_re
        _steps(x.numpy(), _weights(weights), _activations(gates, recurrent, states))
        ctx.save_for_backward(x, *weights, gates, recurrent, states)
        return states[1:]

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, gradient: Tensor) -> tuple[Tensor, ...]:
        x, *weights, gates, recurrent, states = ctx.saved_tensors
        d_x, gradients = torch.empty_like(x), [torch.empty_like(value) for value in weights]
        activations = _activations(gates, recurrent, states)
        slopes = gradient.contiguous().numpy()
        _steps_gradient(slopes, x.numpy(), _weights(weights), activations, d_x.numpy(), _weights(gradients))
        return d_x.view(*gates.shape[:2], -1), *gradients


def _weights(tensors: Sequence[Tensor]) -> _Weights:
    return _Weights(*(value.numpy() for value in tensors))


def _activations(*tensors: Tensor) -> _Activations:
    return _Activations(*(value.numpy() for value in tensors))


def gated_recurrence(inputs: Tensor, gru: nn.GRU) -> Tensor:
    """Return the states of a one-layer ``nn.GRU`` that starts at zero, ``[T, B, H]``.

    Args:
        inputs: time first, ``[T, B, I]``.
        gru: gives the weights.
    """
    return _GatedRecurrence.apply(inputs, gru.weight_ih_l0, gru.weight_hh_l0, gru.bias_ih_l0, gru.bias_hh_l0)
