"""The quantile Huber loss on a CPU, in one compiled pass that makes no table of pairs."""

from typing import Any

import numpy as np
import torch
from torch import Tensor
from torch.autograd.function import once_differentiable

from rcdsac_trl.system.jit import njit


# A sum may be added up in any order, which lets several of its terms be added at once.
@njit(nogil=True, error_model="numpy", fastmath={"reassoc", "nsz", "contract"})
def _huber(
    quantiles: np.ndarray, targets: np.ndarray, tau: np.ndarray, kappa: float, errors: np.ndarray, slopes: np.ndarray
) -> None:
    """Add up each quantile's weighted Huber errors over the targets, and their slopes in it."""
    one, half, zero, limit = tau.dtype.type(1), tau.dtype.type(0.5), tau.dtype.type(0), tau.dtype.type(kappa)
    for r in range(quantiles.shape[0]):
        quantile, fraction, error, slope = quantiles[r], tau[r], errors[r], slopes[r]
        for j in range(targets.shape[1]):
            target = targets[r, j]
            for i in range(quantile.size):
                delta = target - quantile[i]
                clipped = min(max(delta, -limit), limit)
                weighted = clipped * (fraction[i] if delta >= zero else one - fraction[i])
                error[i] += weighted * (delta - half * clipped)
                slope[i] -= weighted


class _QuantileHuber(torch.autograd.Function):
    """Each quantile's error, the mean over the targets; forward already knows the slope."""

    @staticmethod
    def forward(ctx: Any, quantiles: Tensor, targets: Tensor, tau: Tensor, kappa: float) -> Tensor:
        errors, slopes = torch.zeros_like(quantiles), torch.zeros_like(quantiles)
        _huber(quantiles.numpy(), targets.numpy(), tau.numpy(), kappa, errors.numpy(), slopes.numpy())
        share = 1.0 / (kappa * targets.shape[1])
        ctx.save_for_backward(slopes.mul_(share))
        return errors.sum(-1).mul_(share)

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, gradient: Tensor) -> tuple[Tensor | None, ...]:
        (slopes,) = ctx.saved_tensors
        return slopes * gradient.unsqueeze(-1), None, None, None


def quantile_huber(quantiles: Tensor, targets: Tensor, tau: Tensor, kappa: float) -> Tensor:
    """Return the quantile Huber loss ``[..]``; see :func:`rcdsac_trl.agent.loss.functional.quantile_huber_loss`.

    Args:
        quantiles: predictions ``[.., N]``.
        targets: target samples ``[.., N']``; no gradient flows to them.
        tau: fractions ``[.., N]`` of the predictions.
        kappa: where the loss turns from quadratic to linear.
    """
    lead = torch.broadcast_shapes(quantiles.shape[:-1], targets.shape[:-1], tau.shape[:-1])
    rows = [
        value.expand(*lead, value.shape[-1]).reshape(-1, value.shape[-1]).to(quantiles.dtype).contiguous()
        for value in (quantiles, targets.detach(), tau)
    ]
    return _QuantileHuber.apply(*rows, kappa).view(lead)
