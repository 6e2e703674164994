"""The pure functions of the loss."""

import math

import torch
from tensordict import NestedKey, TensorDict
from tensordict.nn import TensorDictModule, TensorDictModuleBase
from torch import Tensor
from torch.nn import functional as F

from rcdsac_trl.agent.kernels import dispatch
from rcdsac_trl.agent.kernels.huber_kernel import quantile_huber


def quantile_huber_loss(quantiles: Tensor, targets: Tensor, tau: Tensor, kappa: float = 1.0) -> Tensor:
    r"""Quantile regression by pairwise Huber errors, as the paper normalises it.

    .. math:: \frac{1}{N'} \sum_{i=1}^{N} \sum_{j=1}^{N'}
              |\tau_i - \mathbb{I}\{\delta_{ij} < 0\}| \, L_\kappa(\delta_{ij}) / \kappa,
              \qquad \delta_{ij} = \text{targets}_j - \text{quantiles}_i

    with :math:`L_\kappa(x) = x^2/2` up to :math:`\kappa` and :math:`\kappa(|x| - \kappa/2)` beyond (paper, critic loss;
    its printed :math:`\min\{x^2, 2|x|-1\}/2` is never quadratic, a misprint).

    Args:
        quantiles: predictions ``[.., N]``; gradients flow.
        targets: target samples ``[.., N']``; treated as constants by the caller.
        tau: fractions ``[.., N]`` of the predictions, broadcastable to them.
        kappa: where the loss turns from quadratic to linear, above 0.

    Returns:
        The loss ``[..]``: a sum over the predictions, a mean over the targets.

    Example:
        >>> quantile_huber_loss(torch.zeros(1), torch.tensor([2.0]), torch.tensor([0.25]))
        tensor(0.3750)
    """
    if quantiles.device.type == "cpu":
        return quantile_huber(quantiles, targets, tau, kappa)
    return _quantile_huber_pairwise(quantiles, targets, tau, kappa)


def _quantile_huber_pairwise(quantiles: Tensor, targets: Tensor, tau: Tensor, kappa: float) -> Tensor:
    """Compute the loss by ordinary operations on every pair."""
    shape = torch.broadcast_shapes(quantiles.unsqueeze(-1).shape, targets.unsqueeze(-2).shape)
    prediction, target = quantiles.unsqueeze(-1).expand(shape), targets.unsqueeze(-2).expand(shape)
    huber = F.huber_loss(prediction, target, reduction="none", delta=kappa)
    with torch.no_grad():
        weight = (tau.unsqueeze(-1) - (target < prediction).to(tau.dtype)).abs_()
    # One product and sum instead of a mean and a sum: the [.., N, N'] tensors dominate the cost.
    return (huber * weight).sum((-2, -1)) / (kappa * targets.shape[-1])


def squash(loc: Tensor, scale: Tensor, noise: Tensor) -> tuple[Tensor, Tensor]:
    r"""Return ``tanh(loc + scale * noise)`` and its log density, both differentiable.

    The distribution is TorchRL's ``TanhNormal(loc, scale)``; written out here because the noise comes from an
    explicit generator and because it is a small part of that class's cost.

    Args:
        loc: mean before tanh ``[.., A]``.
        scale: standard deviation before tanh ``[.., A]``.
        noise: standard normal numbers ``[.., A]``.

    Returns:
        The action ``[.., A]`` and the log density ``[..]``.
    """
    raw = loc + scale * noise
    # log(1 - tanh(x)^2), which stays exact where tanh saturates
    log_slope = 2.0 * (math.log(2.0) - raw - F.softplus(-2.0 * raw))
    log_prob = -0.5 * noise.square() - scale.log() - 0.5 * math.log(2.0 * math.pi) - log_slope
    return raw.tanh(), log_prob.sum(-1)


def call_module(module: TensorDictModuleBase, entries: dict[NestedKey, Tensor | None]) -> tuple[Tensor, ...]:
    """Run an encoder or a head on the entries it reads, and return what it writes, in the order of its keys.

    The first dimension of the entries is the batch's; their time dimensions may be 1. A plain ``TensorDictModule``'s
    network, or its compiled twin, is called directly: TensorDicts of its inputs and outputs cost as much as a small
    batch's layers.
    """
    inputs = [entries[key] for key in module.in_keys]
    if type(module) is TensorDictModule:
        outputs = dispatch.forward(module.module, *inputs)
        return outputs if isinstance(outputs, tuple) else (outputs,)
    memory = next(value for value in inputs if value is not None)
    written = module(TensorDict(dict(zip(module.in_keys, inputs, strict=True)), batch_size=memory.shape[:1]))
    return tuple(written.get(key) for key in module.out_keys)


def minimum(values: list[Tensor]) -> Tensor:
    """Element-wise minimum over the critics."""
    smallest = values[0]
    for value in values[1:]:
        smallest = torch.minimum(smallest, value)
    return smallest


def mean(values: list[Tensor]) -> Tensor:
    """Element-wise mean over the critics."""
    return torch.stack(values).mean(0)


def smaller(values: list[Tensor]) -> Tensor:
    """Return ``[.., N]`` of ``[.., N]`` a critic: of each entry all fractions of the critic whose mean is smallest.

    Example:
        >>> smaller([torch.tensor([[0.0, 9.0]]), torch.tensor([[3.0, 4.0]])])
        tensor([[3., 4.]])
    """
    smallest, its_mean = values[0], values[0].mean(-1, keepdim=True)
    for value in values[1:]:
        other_mean = value.mean(-1, keepdim=True)
        smallest = torch.where(other_mean < its_mean, value, smallest)
        its_mean = torch.minimum(other_mean, its_mean)
    return smallest
