"""Which compiled twin runs in the place of a plain module, and where.

The layers of :mod:`rcdsac_trl.agent.networks` define what is computed, and tests hold the twins against them. A twin is
chosen where it knows all that it replaces: the very classes, not subclasses, with the layers that they are made with,
on a CPU, in single or double precision. Everything else runs its own layers: an encoder of yours, another recurrent
layer put into ours, another device, a compiler or an exporter.
"""

from collections.abc import Callable, Sequence
from typing import Any

import torch
from torch import Tensor, nn

from rcdsac_trl.agent.heads import ActorHead, CosineFeatures, LookAhead, QuantileHead, ScalarHead, with_look_ahead
from rcdsac_trl.agent.kernels.compiled_encoder import CompiledEncoder
from rcdsac_trl.agent.kernels.observation_features import observation_features
from rcdsac_trl.agent.kernels.quantile_values import HeadLayers, quantile_values
from rcdsac_trl.agent.kernels.recurrent_kernels import gated_recurrence
from rcdsac_trl.agent.networks import Encoder, HistoryEncoder, RangeFeatures, in_turn
from rcdsac_trl.robot.ring import KERNELS

#: Below this number, one call of a layer costs more than what it computes.
FEW_OBSERVATIONS = 32


def forward(module: nn.Module, *inputs: Tensor | None) -> Any:
    """Return ``module(*inputs)``, by its compiled twin where there is one.

    No gradient flows to the inputs of an encoder: they are data.
    """
    if _is_ours(inputs):
        if is_plain_encoder(module) and _many(inputs[0]):
            return _encode(module, *inputs)
        if _is_plain_quantile_head(module):
            return _evaluate(module, *inputs)
    return module(*inputs)


def step(encoder: HistoryEncoder, range_: Tensor, *rest: Tensor) -> tuple[Tensor, Tensor]:
    """Return ``encoder.step(range_, *rest)``, its features by their compiled twin where there is one."""
    if not (_is_ours((range_, *rest)) and is_plain_encoder(encoder) and _many(range_)):
        return encoder.step(range_, *rest)
    assert isinstance(encoder, Encoder)
    *vectors, is_init, state = rest
    lead = range_.shape[:-1]
    features = _features(encoder, [value.reshape(-1, value.shape[-1]) for value in (range_, *vectors)])
    memory, after = encoder.advance(features.view(*lead, -1), is_init, state)
    return encoder.with_foreseen(memory, vectors), after


def one_by_one(encoder: HistoryEncoder) -> Callable[..., tuple[Tensor, Tensor]]:
    """Return what does ``encoder.step`` for a handful of agents ``[N]`` on a CPU.

    The compiled twin computes an agent's numbers from its own row alone; the layers of others need not.
    """
    return CompiledEncoder(encoder).step if is_plain_encoder(encoder) else encoder.step  # type: ignore[arg-type]


def has_compiled_actor(encoder: nn.Module, head: nn.Module) -> bool:
    """Return whether :class:`~rcdsac_trl.agent.kernels.compiled_actor.CompiledActor` knows both."""
    layers = "input", "hidden", "output"
    return (
        is_plain_encoder(encoder)
        and type(head) is ActorHead
        and (head.measure is None or (type(head.cosines) is CosineFeatures and _is_linear(head.gate)))
        and all(_is_linear(getattr(head, name)) for name in layers)
    )


def has_compiled_values(head: nn.Module) -> bool:
    """Return whether :class:`~rcdsac_trl.agent.kernels.compiled_values.CompiledValues` knows a critic's head."""
    return _is_plain_quantile_head(head) or _is_plain_scalar_head(head)


def _is_ours(inputs: Sequence[Tensor | None]) -> bool:
    """Return whether kernels know the place of the inputs: a CPU, and nothing that wants to see the layers."""
    known = all(
        value is None or (value.device.type == "cpu" and value.dtype in (torch.float32, torch.float64, torch.bool))
        for value in inputs
    )
    return known and not torch.compiler.is_compiling() and not torch.jit.is_tracing()


def _many(range_: Tensor | None) -> bool:
    return range_ is not None and range_.shape[:-1].numel() >= FEW_OBSERVATIONS


def _is_linear(layer: nn.Module) -> bool:
    return type(layer) is nn.Linear and layer.bias is not None


def is_plain_encoder(module: nn.Module) -> bool:
    """Return whether an encoder is the package's own, with the layers that it is made with."""
    if type(module) is not Encoder or type(module.range) is not RangeFeatures or type(module.gru) is not nn.GRU:
        return False
    gru, layers = module.gru, module.range
    return (
        (gru.num_layers, gru.bidirectional, gru.bias, gru.batch_first) == (1, False, True, True)
        and all(map(_is_convolution, (layers.conv_1, layers.conv_2), KERNELS))
        and all(map(_is_linear, (layers.linear, *module.vectors)))
    )


def _is_convolution(layer: nn.Module, kernel: int) -> bool:
    return (
        type(layer) is nn.Conv1d
        and (layer.kernel_size, layer.stride, layer.padding, layer.dilation) == ((kernel,), (2,), (0,), (1,))
        and layer.groups == 1
        and layer.bias is not None
    )


def _is_plain_quantile_head(module: nn.Module) -> bool:
    if type(module) is not QuantileHead or type(module.cosines) is not CosineFeatures:
        return False
    gated = module.measure is None or type(module.gate_beta) is nn.Linear
    return gated and _looks_ahead_plainly(module) and all(map(_is_linear, (*_layers(module), module.gate_tau)))


def _is_plain_scalar_head(module: nn.Module) -> bool:
    return type(module) is ScalarHead and _looks_ahead_plainly(module) and all(map(_is_linear, _layers(module)))


def _looks_ahead_plainly(head: QuantileHead | ScalarHead) -> bool:
    return head.look_ahead is None or type(head.look_ahead) is LookAhead


def _layers(head: QuantileHead | ScalarHead) -> tuple[nn.Module, nn.Module, nn.Module]:
    return head.input, head.hidden, head.output


def _encode(encoder: Any, *inputs: Any) -> Tensor:
    """Run whole sequences; see :meth:`Encoder.forward`."""
    sequences, steps = inputs[0].shape[:2]
    # Step after step, as the recurrence reads them.
    rows = [value.transpose(0, 1).reshape(sequences * steps, -1) for value in inputs]
    features = _features(encoder, rows)

    def run(part: Tensor) -> Tensor:
        return gated_recurrence(part.transpose(0, 1), encoder.gru).transpose(0, 1)

    memory = in_turn(run, features.view(steps, sequences, -1).transpose(0, 1), encoder.restart_steps)
    return encoder.with_foreseen(memory, inputs[1:])


def _features(encoder: Any, rows: Sequence[Tensor]) -> Tensor:
    """Return the features of observations ``[n, ..]``; see :meth:`Encoder.features`."""
    bins, *vectors = rows
    layers = encoder.range
    stack = layers.conv_1, layers.conv_2, layers.linear
    return observation_features(layers.read(bins), vectors, stack, list(encoder.vectors))


def _evaluate(head: Any, memory: Any, action: Any, tau: Any, risk: Tensor | None = None) -> Tensor:
    """Return the quantiles; see :meth:`QuantileHead.forward`."""
    layers = HeadLayers(
        head.input, head.gate_tau, None if head.measure is None else head.gate_beta, head.hidden, head.output
    )
    told = with_look_ahead(head.look_ahead, memory, action)
    return quantile_values(memory, told, tau, head.beta_cosines(risk), head.cosines.frequencies, layers)
