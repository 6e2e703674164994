r"""The range observation's layers on a CPU, with their backward pass written out.

They compute exactly what ordinary layers do (tests hold them against those, and against finite differences) and exist
because on a CPU an update spends its time moving memory, not multiplying: every intermediate of a batch
of 6,500 observations is tens of megabytes, written and read again by the next operation. Here a batch goes through all
layers in blocks that stay in the cache, activations are rectified in place, and bins that are silent in the whole
batch, such as those a narrow sensor lacks, are left out.

Public names::

    range_features(bins [n,180], conv_1, conv_2, linear) -> [n, features]
"""

from typing import Any

import torch
from torch import Tensor, nn
from torch.autograd.function import once_differentiable
from torch.nn import functional as F

# Rows of two positions that go through the layers together: their activations take about 1 MB, which a core's own
# cache holds.
_ROWS_PER_BLOCK = 96 * 44


def _rectify_gradient(gradient: Tensor, activation: Tensor) -> Tensor:
    """Zero ``gradient`` in place where a rectified ``activation`` is zero."""
    return torch.ops.aten.threshold_backward.grad_input(gradient, activation, 0, grad_input=gradient)


# ------------------------------------------------------------------------------------------------ range features
class _RangeFeatures(torch.autograd.Function):
    """Convolution 5/2, convolution 3/2, linear layer, each rectified; activations are [n, row, channel].

    A row is two positions of the first convolution. The second one's window is contiguous memory, a row and the first
    half of the next, so that a run of its positions [a, b) takes the rows a .. b; the position of row b is one too
    many, and the linear layer's weight is zero there. Positions outside all runs see silent bins alone: their
    activation is the same for every observation, and joins the linear layer's bias.
    """

    @staticmethod
    def forward(
        ctx: Any,
        bins: Tensor,
        w1: Tensor,
        b1: Tensor,
        w2: Tensor,
        b2: Tensor,
        w3: Tensor,
        b3: Tensor,
        runs: list[tuple[int, int]],
    ) -> Tensor:
        channels, taps = w1.shape[0], w1.shape[2]
        kernel_1 = torch.cat((w1.view(channels, taps), b1.unsqueeze(1)), dim=1).t().contiguous()
        kernel_2 = w2.permute(2, 1, 0)
        pair, third = kernel_2[:2].reshape(2 * channels, channels), kernel_2[2].contiguous()
        by_position = w3.view(w3.shape[0], -1, channels)
        kernel_3 = torch.cat([F.pad(by_position[:, a:b], (0, 0, 0, 1)) for a, b in runs], dim=1).flatten(1)
        silent_1 = b1.relu()
        silent_2 = (b2 + w2.sum(-1) @ silent_1).relu()
        gaps = zip([0, *(b for _, b in runs)], [*(a for a, _ in runs), by_position.shape[1]], strict=True)
        silent_3 = torch.cat([by_position[:, a:b] for a, b in gaps], dim=1).sum(1)
        bias_3 = b3 + silent_3 @ silent_2
        result = bins.new_empty(bins.shape[0], w3.shape[0])
        saved: list[Tensor] = []
        block_size = _block_size(runs)
        for start in range(0, bins.shape[0], block_size):
            block = bins[start : start + block_size]
            first = torch.mm(_windows(block, taps, runs), kernel_1).relu_()
            rows = first.view(-1, 2 * channels)
            second = torch.addmm(b2, rows, pair)
            second[:-1].addmm_(rows[1:, :channels], third)
            second.relu_()
            out = result[start : start + block_size]
            torch.addmm(bias_3, second.view(block.shape[0], -1), kernel_3.t(), out=out).relu_()
            if any(ctx.needs_input_grad):
                saved += [first, second]
        ctx.save_for_backward(bins, w2, pair, third, kernel_3, silent_1, silent_2, silent_3, result, *saved)
        ctx.shapes, ctx.runs = (w1.shape, by_position.shape), runs
        return result

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, gradient: Tensor) -> tuple[Tensor | None, ...]:
        bins, w2, pair, third, kernel_3, silent_1, silent_2, silent_3, result, *saved = ctx.saved_tensors
        (shape_1, shape_3), runs = ctx.shapes, ctx.runs
        channels, taps = shape_1[0], shape_1[2]
        gradient = torch.ops.aten.threshold_backward(gradient, result, 0)
        d_kernel_1 = bins.new_zeros(taps + 1, channels)
        d_pair, d_third = torch.zeros_like(pair), torch.zeros_like(third)
        d_b2, d_kernel_3 = bins.new_zeros(channels), torch.zeros_like(kernel_3)
        block_size = _block_size(runs)
        for index, start in enumerate(range(0, bins.shape[0], block_size)):
            first, second = saved[2 * index], saved[2 * index + 1]
            out = gradient[start : start + block_size]
            rows = first.view(-1, 2 * channels)
            d_kernel_3.addmm_(out.t(), second.view(out.shape[0], -1))
            d_second = _rectify_gradient(torch.mm(out, kernel_3).view(-1, channels), second)
            d_b2 += d_second.sum(0)
            d_pair.addmm_(rows.t(), d_second)
            d_third.addmm_(rows[1:, :channels].t(), d_second[:-1])
            d_rows = torch.mm(d_second, pair.t())
            d_rows[1:, :channels].addmm_(d_second[:-1], third.t())
            d_first = _rectify_gradient(d_rows.view(-1, channels), first)
            d_kernel_1.addmm_(_windows(bins[start : start + block_size], taps, runs).t(), d_first)
        d_w1, d_b1 = d_kernel_1[:taps].t().reshape(shape_1), d_kernel_1[taps]
        d_w2 = torch.cat((d_pair.view(2, channels, channels), d_third.unsqueeze(0))).permute(2, 1, 0)
        d_b3 = gradient.sum(0)
        # What the silent positions add to the linear layer's bias, backwards.
        d_w3 = torch.outer(d_b3, silent_2).unsqueeze(1).expand(shape_3).contiguous()
        d_silent_2 = _rectify_gradient(d_b3 @ silent_3, silent_2)
        d_silent_1 = _rectify_gradient(d_silent_2 @ w2.sum(-1), silent_1)
        row = 0
        for a, b in runs:
            d_w3[:, a:b] = d_kernel_3.view(shape_3[0], -1, channels)[:, row : row + b - a]
            row += b - a + 1
        d_w2 = d_w2 + torch.outer(d_silent_2, silent_1).unsqueeze(-1)
        return None, d_w1, d_b1 + d_silent_1, d_w2, d_b2 + d_silent_2, d_w3.flatten(1), d_b3, None


def _block_size(runs: list[tuple[int, int]]) -> int:
    """Return how many observations go through the layers together."""
    return max(1, _ROWS_PER_BLOCK // sum(b - a + 1 for a, b in runs))


def _windows(block: Tensor, taps: int, runs: list[tuple[int, int]]) -> Tensor:
    """Return the windows of the first convolution that the runs need, a 1 appended, ``[n * positions, taps + 1]``."""
    windows = block.new_ones(block.shape[0], 2 * sum(b - a + 1 for a, b in runs), taps + 1)
    every, position = block.unfold(-1, taps, 2), 0
    for a, b in runs:
        number = 2 * (b - a + 1)
        windows[:, position : position + number, :taps] = every[:, 2 * a : 2 * a + number]
        position += number
    return windows.view(-1, taps + 1)


def _heard(bins: Tensor, taps: int) -> list[tuple[int, int]]:
    """Return the runs [a, b) of the second convolution's positions that see a bin which is not 0 in all the batch."""
    first = (bins != 0).any(0).unfold(0, taps, 2).any(-1)
    positions = first.unfold(0, 3, 2).any(-1).nonzero().flatten().tolist()
    runs: list[tuple[int, int]] = []
    for position in positions:
        # A gap of one position costs no less than the position.
        if runs and position <= runs[-1][1] + 1:
            runs[-1] = (runs[-1][0], position + 1)
        else:
            runs.append((position, position + 1))
    return runs or [(0, 1)]


def range_features(bins: Tensor, conv_1: nn.Conv1d, conv_2: nn.Conv1d, linear: nn.Linear) -> Tensor:
    """Return the rectified ``linear(conv_2(conv_1(bins)))`` with rectifiers between, ``[n, features]``.

    Bins that are 0 in the whole batch cost nothing where their windows hold no other: a narrow sensor's do.

    Args:
        bins: ``[n, bins]``; data, so no gradient flows to it.
        conv_1: kernel 5 (any), stride 2, one input channel; its number of output positions must be even.
        conv_2: kernel 3, stride 2.
        linear: reads the positions of ``conv_2``, position by position.
    """
    runs = _heard(bins, conv_1.kernel_size[0])
    return _RangeFeatures.apply(
        bins, conv_1.weight, conv_1.bias, conv_2.weight, conv_2.bias, linear.weight, linear.bias, runs
    )
