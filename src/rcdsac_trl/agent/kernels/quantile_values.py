r"""The quantile critics' head on a CPU, with its backward pass written out.

It computes exactly what ordinary layers do (tests hold it against those, and against finite differences). A batch
of 6,400 transitions has 100,000 quantiles: as ordinary layers, every gate, product and activation of theirs is 50
MB that goes to main memory and back between two operations. Of a batch of 256, calling the layers takes as long as
what they compute. Here few compiled passes do it all, in blocks that stay in the cache.
"""

from typing import Any, NamedTuple

import torch
from torch import Tensor, nn
from torch.autograd.function import once_differentiable

from rcdsac_trl.agent.kernels import quantile_kernels as kernels


class HeadLayers(NamedTuple):
    """The linear layers of a quantile head.

    Attributes:
        input: of memory and action.
        gate_tau: of a fraction's cosines; its bias is that of the whole gate.
        gate_beta: of beta's cosines, without bias; None where beta is not read.
        hidden: of the gated features.
        output: of the hidden layer, one value.
    """

    input: nn.Linear
    gate_tau: nn.Linear
    gate_beta: nn.Linear | None
    hidden: nn.Linear
    output: nn.Linear


class _QuantileValues(torch.autograd.Function):
    """``output(relu(hidden(x * relu(gate_tau(cos(frequencies * tau)) + gate_beta(beta)))))``, x = ``relu(input(..))``.

    Gates are computed for some sequences at a time, and multiplied with their features for fewer: along a sequence
    that shares its fractions there are far more products than gates.
    """

    @staticmethod
    def forward(
        ctx: Any, memory: Tensor, action: Tensor, tau: Tensor, beta: Tensor | None, frequencies: Tensor, *layers: Tensor
    ) -> Tensor:
        w_in, b_in, w_tau, b_tau, w_beta, weight, bias, w_out, b_out = layers
        (sequences, steps), (shared, number) = memory.shape[:2], tau.shape[1:]
        joined = torch.cat((memory, action), -1)
        x = memory.new_empty(sequences, steps, len(w_in))
        kernels.input_layer(joined.numpy(), w_in.numpy(), b_in.numpy(), x.numpy())
        if beta is None:
            offsets = b_tau.expand(sequences, 1, -1).contiguous()
        else:
            offsets = memory.new_empty(*beta.shape[:2], len(b_tau))
            kernels.offsets(beta.numpy(), w_beta.numpy(), b_tau.numpy(), offsets.numpy())
        keep, blocks = any(ctx.needs_input_grad), _gate_blocks(tau)
        # What nothing goes back through needs no place of its own.
        gated = sequences if keep else blocks[0].stop
        inner = sequences if keep else kernels.block(steps * number, gated)
        cosines = memory.new_empty(gated, shared, number, len(frequencies))
        tau_gate = memory.new_empty(gated, shared, number, len(w_tau))
        hidden = memory.new_empty(inner, steps, number, len(weight))
        result = memory.new_empty(sequences, steps, number)
        weights = kernels.HeadWeights(*(value.numpy() for value in (w_tau, weight, bias, w_out.view(-1), b_out)))
        features, added, values = x.numpy(), offsets.numpy(), result.numpy()
        for block in blocks:
            place = block if keep else slice(0, block.stop - block.start)
            torch.cos(tau[block].unsqueeze(-1) * frequencies, out=cosines[place])
            activations = kernels.HeadActivations(
                features[block],
                cosines[place].numpy(),
                added[block],
                tau_gate[place].numpy(),
                hidden[place].numpy() if keep else hidden.numpy(),
            )
            kernels.layers(activations, weights, values[block])
        if keep:
            ctx.save_for_backward(joined, x, beta, offsets, cosines, tau_gate, hidden, w_in, w_tau, weight, w_out)
            ctx.memory_size = memory.shape[-1]
        return result

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, gradient: Tensor) -> tuple[Tensor | None, ...]:
        joined, x, beta, offsets, cosines, tau_gate, hidden, w_in, w_tau, weight, w_out = ctx.saved_tensors
        gradient = gradient.contiguous()
        # The output layer's weight is the same for every row: it goes into the matrices instead of the rows.
        column = w_out.view(-1, 1)
        through = weight * column
        d_x, d_joined = torch.zeros_like(x), torch.empty_like(joined)
        d_layers: tuple[Tensor | None, ...] = (None,) * 9
        seen = kernels.HeadActivations(*(value.numpy() for value in (x, cosines, offsets, tau_gate, hidden)))
        slopes = gradient.numpy()
        if not ctx.needs_input_grad[5]:
            kernels.gradient_of_features(slopes, seen, through.numpy(), d_x.numpy())
            kernels.input_gradient(*(value.numpy() for value in (x, w_in, d_x, d_joined)))
        else:
            d_offsets, d_tau = torch.zeros_like(offsets), torch.zeros_like(w_tau)
            d_weight, (d_bias, d_out) = torch.zeros_like(weight), weight.new_zeros(2, len(weight))
            sums = kernels.HeadGradients(*(value.numpy() for value in (d_x, d_offsets, d_tau, d_weight, d_bias, d_out)))
            for block in _gate_blocks(tau_gate):
                activations = kernels.HeadActivations(*(value[block] for value in seen))
                gradients = sums._replace(x=sums.x[block], beta=sums.beta[block])
                kernels.layers_gradient(slopes[block], activations, through.numpy(), gradients)
            kernels.input_gradient(*(value.numpy() for value in (x, w_in, d_x, d_joined)))
            d_in, (d_b_in, d_b_tau) = torch.empty_like(w_in), w_in.new_empty(2, len(w_in))
            kernels.affine_gradient(*(value.numpy() for value in (d_x, joined, d_in, d_b_in)))
            d_beta = None
            if beta is None:
                kernels.add_up(d_offsets.flatten(0, 1).numpy(), d_b_tau.numpy())
            else:
                d_beta = torch.empty_like(w_tau)
                kernels.affine_gradient(*(value.numpy() for value in (d_offsets, beta, d_beta, d_b_tau)))
            d_weight, d_bias = d_weight.mul_(column), d_bias.mul_(w_out.view(-1))
            d_output = d_out.view_as(w_out), gradient.sum().view(1)
            d_layers = d_in, d_b_in, d_tau, d_b_tau, d_beta, d_weight, d_bias, *d_output
        d_memory, d_action = d_joined[..., : ctx.memory_size], d_joined[..., ctx.memory_size :]
        return d_memory, d_action, None, None, None, *d_layers


def _gate_blocks(gates: Tensor) -> list[slice]:
    """Cut the sequences ``[B, L|1, N, ..]`` into blocks whose gates are computed together."""
    size = kernels.block(gates.shape[1:3].numel(), len(gates))
    return [slice(start, min(start + size, len(gates))) for start in range(0, len(gates), size)]


def quantile_values(
    memory: Tensor, action: Tensor, tau: Tensor, beta: Tensor | None, frequencies: Tensor, layers: HeadLayers
) -> Tensor:
    """Return the quantiles of the return, ``[B, L, N]``.

    Either all layers take a gradient, or none does.

    Args:
        memory: of the observations, ``[B, L, M]``.
        action: ``[B, L, A]``.
        tau: fractions ``[B, L, N]``, or ``[B, 1, N]`` where constant along a sequence; data, without gradient.
        beta: cosines of beta, ``[B, L, C]`` or ``[B, 1, C]``, data; None where the head does not read it.
        frequencies: of the fractions' cosines ``[C]``.
        layers: of the head.
    """
    shape = memory.shape[:2]
    if tau.shape[1] == shape[1] and (beta is None or beta.shape[1] == shape[1]):
        # Nothing is shared along a sequence: blocks need not hold whole ones.
        memory, action, tau = (value.reshape(-1, 1, value.shape[-1]) for value in (memory, action, tau))
        beta = None if beta is None else beta.reshape(-1, 1, beta.shape[-1])
    parameters = [
        *(layers.input.weight, layers.input.bias, layers.gate_tau.weight, layers.gate_tau.bias),
        None if layers.gate_beta is None else layers.gate_beta.weight,
        *(layers.hidden.weight, layers.hidden.bias, layers.output.weight, layers.output.bias),
    ]
    beta = None if beta is None else beta.contiguous()
    return _QuantileValues.apply(memory, action, tau, beta, frequencies, *parameters).view(*shape, -1)
