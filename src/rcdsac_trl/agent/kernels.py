r"""The two hot pieces of the networks, each with its backward pass written out.

They compute exactly what ordinary layers do (tests hold them against those, and against finite differences) and exist
because on a CPU an update spends its time moving memory, not multiplying: every intermediate of a batch
of 6,500 observations or 100,000 quantiles is tens of megabytes, written and read again by the next operation. Here a
batch goes through all layers in blocks that stay in the cache and activations are rectified in place: 2 to 4 times
faster on batches of that size, and on small ones no slower.

Public names::

    range_features(bins [n,180], conv_1, conv_2, linear) -> [n, features]
    gated_values(x [B,L,H], gate [B,L|1,N,H], hidden, output) -> [B,L,N]
"""

from typing import Any

import torch
from torch import Tensor, nn
from torch.autograd.function import once_differentiable
from torch.nn import functional as F

# Observations, and rows of (transition, quantile), that go through the layers together: their activations take about
# 1 MB, which a core's own cache holds.
_OBSERVATIONS_PER_BLOCK = 96
_ROWS_PER_BLOCK = 1024


def _rectify_gradient(gradient: Tensor, activation: Tensor) -> Tensor:
    """Zero ``gradient`` in place where a rectified ``activation`` is zero."""
    return torch.ops.aten.threshold_backward.grad_input(gradient, activation, 0, grad_input=gradient)


# ------------------------------------------------------------------------------------------------ range features
class _RangeFeatures(torch.autograd.Function):
    """Convolution 5/2, convolution 3/2, linear layer, each rectified; activations are [n, position, channel].

    The first convolution multiplies its windows, which carry a 1 for the bias. In the second a window is contiguous
    memory: with two positions to a row, it is one whole row and the first half of the next. That leaves one
    position too many at the end of every observation; the linear layer's weight is zero there.
    """

    @staticmethod
    def forward(
        ctx: Any, bins: Tensor, w1: Tensor, b1: Tensor, w2: Tensor, b2: Tensor, w3: Tensor, b3: Tensor
    ) -> Tensor:
        channels, taps = w1.shape[0], w1.shape[2]
        positions = (bins.shape[1] - taps) // 2 + 1
        kernel_1 = torch.cat((w1.view(channels, taps), b1.unsqueeze(1)), dim=1).t().contiguous()
        kernel_2 = w2.permute(2, 1, 0)
        pair, third = kernel_2[:2].reshape(2 * channels, channels), kernel_2[2].contiguous()
        padded = F.pad(w3, (0, positions // 2 * channels - w3.shape[1]))
        result = bins.new_empty(bins.shape[0], w3.shape[0])
        saved: list[Tensor] = []
        for start in range(0, bins.shape[0], _OBSERVATIONS_PER_BLOCK):
            block = bins[start : start + _OBSERVATIONS_PER_BLOCK]
            windows = _windows(block, taps, positions)
            first = torch.mm(windows, kernel_1).relu_()
            rows = first.view(-1, 2 * channels)
            second = torch.addmm(b2, rows, pair)
            second[:-1].addmm_(rows[1:, :channels], third)
            second.relu_()
            out = result[start : start + _OBSERVATIONS_PER_BLOCK]
            torch.addmm(b3, second.view(block.shape[0], -1), padded.t(), out=out).relu_()
            if any(ctx.needs_input_grad):
                saved += [first, second]
        ctx.save_for_backward(bins, pair, third, padded, result, *saved)
        ctx.shapes = (w1.shape, w2.shape, w3.shape)
        return result

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, gradient: Tensor) -> tuple[Tensor | None, ...]:
        bins, pair, third, padded, result, *saved = ctx.saved_tensors
        shape_1, shape_2, shape_3 = ctx.shapes
        channels, taps = shape_1[0], shape_1[2]
        positions = (bins.shape[1] - taps) // 2 + 1
        gradient = torch.ops.aten.threshold_backward(gradient, result, 0)
        d_kernel_1 = bins.new_zeros(taps + 1, channels)
        d_pair, d_third = torch.zeros_like(pair), torch.zeros_like(third)
        d_b2, d_padded = bins.new_zeros(channels), torch.zeros_like(padded)
        for index, start in enumerate(range(0, bins.shape[0], _OBSERVATIONS_PER_BLOCK)):
            first, second = saved[2 * index], saved[2 * index + 1]
            out = gradient[start : start + _OBSERVATIONS_PER_BLOCK]
            rows = first.view(-1, 2 * channels)
            d_padded.addmm_(out.t(), second.view(out.shape[0], -1))
            d_second = _rectify_gradient(torch.mm(out, padded).view(-1, channels), second)
            d_b2 += d_second.sum(0)
            d_pair.addmm_(rows.t(), d_second)
            d_third.addmm_(rows[1:, :channels].t(), d_second[:-1])
            d_rows = torch.mm(d_second, pair.t())
            d_rows[1:, :channels].addmm_(d_second[:-1], third.t())
            d_first = _rectify_gradient(d_rows.view(-1, channels), first)
            windows = _windows(bins[start : start + _OBSERVATIONS_PER_BLOCK], taps, positions)
            d_kernel_1.addmm_(windows.t(), d_first)
        d_w1 = d_kernel_1[:taps].t().reshape(shape_1)
        d_w2 = torch.cat((d_pair.view(2, channels, channels), d_third.unsqueeze(0))).permute(2, 1, 0).reshape(shape_2)
        return None, d_w1, d_kernel_1[taps], d_w2, d_b2, d_padded[:, : shape_3[1]], gradient.sum(0)


def _windows(block: Tensor, taps: int, positions: int) -> Tensor:
    """Return every window of the first convolution with a 1 appended, ``[n * positions, taps + 1]``."""
    windows = block.new_ones(block.shape[0], positions, taps + 1)
    windows[..., :taps] = block.unfold(-1, taps, 2)
    return windows.view(-1, taps + 1)


def range_features(bins: Tensor, conv_1: nn.Conv1d, conv_2: nn.Conv1d, linear: nn.Linear) -> Tensor:
    """Return the rectified ``linear(conv_2(conv_1(bins)))`` with rectifiers between, ``[n, features]``.

    Args:
        bins: ``[n, bins]``; data, so no gradient flows to it.
        conv_1: kernel 5 (any), stride 2, one input channel; its number of output positions must be even.
        conv_2: kernel 3, stride 2.
        linear: reads the positions of ``conv_2``, position by position.
    """
    return _RangeFeatures.apply(
        bins, conv_1.weight, conv_1.bias, conv_2.weight, conv_2.bias, linear.weight, linear.bias
    )


# ------------------------------------------------------------------------------------------------ gated values
class _GatedValues(torch.autograd.Function):
    """``output(relu(hidden(x * gate)))`` with x broadcast over quantiles and the gate, where constant, over time."""

    @staticmethod
    def forward(
        ctx: Any, x: Tensor, gate: Tensor, weight: Tensor, bias: Tensor, out_weight: Tensor, out_bias: Tensor
    ) -> Tensor:
        number, (sequences, steps, size) = gate.shape[2], x.shape
        result = x.new_empty(sequences, steps, number)
        block = max(1, _ROWS_PER_BLOCK // (steps * number))
        saved = []
        for start in range(0, sequences, block):
            part = slice(start, start + block)
            product = (x[part].unsqueeze(2) * gate[part]).view(-1, size)
            hidden = torch.addmm(bias, product, weight.t()).relu_()
            torch.addmv(out_bias, hidden, out_weight.view(-1), out=result[part].view(-1))
            if any(ctx.needs_input_grad):
                saved.append(hidden)
        ctx.save_for_backward(x, gate, weight, out_weight, *saved)
        return result

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, gradient: Tensor) -> tuple[Tensor | None, ...]:
        x, gate, weight, out_weight, *saved = ctx.saved_tensors
        need_x, need_gate, need_weight = ctx.needs_input_grad[:3]
        d_x, d_gate = torch.empty_like(x), torch.empty_like(gate)
        d_weight, d_bias = torch.zeros_like(weight), x.new_zeros(weight.shape[0])
        d_out_weight = torch.zeros_like(out_weight).view(-1)
        gradient = gradient.contiguous()
        block = max(1, _ROWS_PER_BLOCK // (x.shape[1] * gate.shape[2]))
        for index, hidden in enumerate(saved):
            part = slice(index * block, (index + 1) * block)
            out = gradient[part].view(-1)
            features, factors = x[part].unsqueeze(2), gate[part]
            d_hidden = _rectify_gradient(torch.outer(out, out_weight.view(-1)), hidden)
            if need_weight:
                d_out_weight.addmv_(hidden.t(), out)
                d_bias += d_hidden.sum(0)
                d_weight.addmm_(d_hidden.t(), (features * factors).view(d_hidden.shape[0], -1))
            d_product = torch.mm(d_hidden, weight).view(*gradient[part].shape, -1)
            if need_gate:
                if gate.shape[1] == 1:
                    torch.sum(d_product * features, dim=1, keepdim=True, out=d_gate[part])
                else:
                    torch.mul(d_product, features, out=d_gate[part])
            if need_x:
                torch.sum(d_product.mul_(factors), dim=2, out=d_x[part])
        return (
            d_x if need_x else None,
            d_gate if need_gate else None,
            d_weight if need_weight else None,
            d_bias if need_weight else None,
            d_out_weight.view_as(out_weight) if need_weight else None,
            gradient.sum().view(1) if need_weight else None,
        )


def gated_values(x: Tensor, gate: Tensor, hidden: nn.Linear, output: nn.Linear) -> Tensor:
    """Return ``output(relu(hidden(x * gate)))``, ``[B, L, N]``.

    Args:
        x: features of a transition ``[B, L, H]``.
        gate: one gate a quantile, ``[B, L, N, H]``, or ``[B, 1, N, H]`` where it is constant along a sequence.
        hidden: linear layer H to H'; either all four parameters take a gradient or none does.
        output: linear layer H' to 1.
    """
    return _GatedValues.apply(x, gate, hidden.weight, hidden.bias, output.weight, output.bias)
