r"""An observation's layers up to the recurrent one on a CPU, with their backward pass written out.

They compute exactly what ordinary layers do (tests hold them against those, and against finite differences) and exist
because on a CPU an update spends its time moving memory and calling operations, not multiplying. Here few compiled
passes do it all, products included, and all layers write into one array of features.
"""

from collections.abc import Sequence
from typing import Any

import numpy as np
import torch
from torch import Tensor, nn
from torch.autograd.function import once_differentiable

from rcdsac_trl.agent.kernels import feature_kernels as kernels
from rcdsac_trl.agent.kernels.matmul import matmul_tn


class _ObservationFeatures(torch.autograd.Function):
    """Convolution 5/2, convolution 3/2, linear layer over the bins; a linear layer for every vector; all rectified.

    A row is what a position of the second convolution sees, so that this is one matrix product. Positions that
    see inactive bins alone have no rows: their activation is the same for every observation, and joins the linear
    layer's bias. The first convolution costs so little that its activations are computed again on the way back.
    """

    @staticmethod
    def forward(ctx: Any, bins: Tensor, vectors: Sequence[Tensor], *parameters: Tensor) -> Tensor:
        range_parameters, weights, biases = parameters[:6], parameters[6::2], parameters[7::2]
        w1, b1, b3 = (range_parameters[i] for i in (0, 1, 5))
        channels, places = len(b1), np.cumsum([len(b3), *map(len, biases)])
        positions = kernels.active_positions(bins.numpy(), w1.shape[2])
        active, inactive = bins.new_empty(len(b3), len(positions), channels), bins.new_empty(len(b3), channels)
        outputs = bins.new_empty(len(bins) * len(positions), channels)
        result = bins.new_empty(len(bins), places[-1])
        activations = _activations(positions, active, inactive, outputs)
        kernels.range_layers(bins.numpy(), _range_layers(range_parameters), activations, result.numpy())
        for vector, weight, bias, first in zip(vectors, weights, biases, places[:-1], strict=True):
            kernels.linear(vector.numpy(), weight.numpy(), bias.numpy(), first, result.numpy())
        ctx.save_for_backward(bins, *range_parameters, active, inactive, outputs, result, *vectors)
        ctx.positions, ctx.places = positions, places
        return result

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, gradient: Tensor) -> tuple[Tensor | None, ...]:
        bins, *saved = ctx.saved_tensors
        range_parameters, (active, inactive, outputs, result, *vectors) = saved[:6], saved[6:]
        d_biases = result.new_empty(result.shape[1])
        slopes = kernels.where_active(gradient.contiguous().numpy(), result.numpy(), d_biases.numpy())
        d_b3, *d_others = d_biases.tensor_split(ctx.places[:-1].tolist())
        d_range = [*(torch.empty_like(value) for value in range_parameters[:5]), d_b3]
        activations = _activations(ctx.positions, active, inactive, outputs)
        kernels.range_gradient(
            slopes, bins.numpy(), _range_layers(range_parameters), activations, _range_layers(d_range)
        )
        d_layers: list[Tensor] = []
        for vector, d_bias, first in zip(vectors, d_others, ctx.places[:-1], strict=True):
            d_weight = vector.new_empty(len(d_bias), vector.shape[1])
            matmul_tn(slopes[:, first : first + len(d_bias)], vector.numpy(), d_weight.numpy(), False)
            d_layers += [d_weight, d_bias]
        return None, None, *d_range, *d_layers


def _range_layers(parameters: Sequence[Tensor]) -> kernels.RangeLayers:
    """Hand the parameters of the range observation's layers, or their gradients, to the compiled passes."""
    *convolutions, w3, b3 = parameters
    by_position = w3.view(len(b3), -1, len(convolutions[0]))
    return kernels.RangeLayers(*(value.numpy() for value in (*convolutions, by_position, b3)))


def _activations(positions: np.ndarray, *tensors: Tensor) -> kernels.RangeActivations:
    return kernels.RangeActivations(positions, *(value.numpy() for value in tensors))


def observation_features(
    bins: Tensor,
    vectors: Sequence[Tensor],
    range_layers: tuple[nn.Conv1d, nn.Conv1d, nn.Linear],
    vector_layers: Sequence[nn.Module],
) -> Tensor:
    """Return the rectified layers' outputs side by side, those of the bins first, ``[n, features]``.

    Bins that are 0 in the whole batch cost nothing where their windows hold no other: a narrow sensor's do.

    Args:
        bins: ``[n, bins]``, at least one, padded as the layers read them; data, so no gradient flows to them, nor
            to the vectors.
        vectors: ``[n, size]`` each.
        range_layers: a convolution of kernel 5 and stride 2 with one input channel, one of kernel 3 and stride
            2, and a linear layer that reads the positions of the second, position by position; rectifiers between.
        vector_layers: a linear layer for each vector.
    """
    parameters = [p for layer in (*range_layers, *vector_layers) for p in (layer.weight, layer.bias)]
    vectors = [vector.contiguous() for vector in vectors]
    return _ObservationFeatures.apply(bins.contiguous(), vectors, *parameters)
