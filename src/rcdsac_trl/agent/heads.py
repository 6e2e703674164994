r"""The heads on an encoder's output: the actor's, the quantile critics', the scalar critics'.

Pass ``risk`` and ``tau`` with a time dimension of 1 where they are constant along a sequence: the gate is then computed
once for it. What feeds them: :mod:`rcdsac_trl.agent.networks`.
"""

import math

import torch
from torch import Tensor, nn
from torch.nn import functional as F

from rcdsac_trl.agent.float32 import made_in_float32
from rcdsac_trl.agent.network_settings import NetworkSettings
from rcdsac_trl.agent.risk import RiskMeasure
from rcdsac_trl.robot.action import LOG_STD_RANGE
from rcdsac_trl.robot.look_ahead import FORESEEN_SIZE, HAT_OFFSETS, HAT_SLOPES, NUM_LOOK_AHEAD, told_of_action


@made_in_float32
class CosineFeatures(nn.Module):
    r"""Cosine embedding: ``[..] -> [.., n]`` with elements :math:`\cos(\pi i x)`, i = 1..n, for x in [0, 1]."""

    frequencies: Tensor

    def __init__(self, number: int) -> None:
        """Keep the angular frequencies as a buffer that no checkpoint carries."""
        super().__init__()
        self.register_buffer("frequencies", math.pi * torch.arange(1, number + 1), persistent=False)

    def forward(self, x: Tensor) -> Tensor:
        """Embed every element of ``x``."""
        return torch.cos(x.unsqueeze(-1) * self.frequencies)


class LookAhead(nn.Module):
    """What foreseen clearances say of an action; the twin of :func:`rcdsac_trl.robot.look_ahead.look_ahead`."""

    slopes: Tensor
    offsets: Tensor

    def __init__(self) -> None:
        """Keep the hat functions as buffers that no checkpoint carries."""
        super().__init__()
        self.register_buffer("slopes", torch.from_numpy(HAT_SLOPES), persistent=False)
        self.register_buffer("offsets", torch.from_numpy(HAT_OFFSETS), persistent=False)

    def forward(self, memory: Tensor, action: Tensor) -> Tensor:
        """Return how near an action leads, soon and later.

        Args:
            memory: what the heads read, foreseen clearances last, ``[.., n]``.
            action: ``[.., 2]``.

        Returns:
            ``[.., 2]``.
        """
        sides = [action.unsqueeze(-1) * slope + offset for slope, offset in zip(self.slopes, self.offsets, strict=True)]
        first, second = torch.minimum(*sides).clamp(0.0, 1.0).unbind(-2)
        foreseen = memory[..., -FORESEEN_SIZE:].unflatten(-1, (NUM_LOOK_AHEAD, -1))
        return (foreseen * (first * second).unsqueeze(-2)).sum(-1)


@made_in_float32
class ActorHead(nn.Module):
    r"""Memory (and ``beta``) to the mean and the standard deviation of the pre-tanh action.

    :math:`g^{actor}(o_{0:t}) \odot g^{actorRisk}(\phi^\beta)`, a linear layer, then the two outputs. Without a
    measure there is no gate: the policy of SAC, RCWR and DSAC.

    Args:
        action_size: number of action dimensions.
        network: sizes of the layers.
        measure: embeds ``beta``; None for no risk gate.
    """

    def __init__(self, action_size: int, network: NetworkSettings, measure: RiskMeasure | None = None) -> None:
        """Build the layers."""
        super().__init__()
        self.measure = measure
        self.input = nn.Linear(network.memory, network.head)
        if measure is not None:
            self.cosines = CosineFeatures(network.cosines)
            self.gate = nn.Linear(network.cosines, network.head)
        self.hidden = nn.Linear(network.head, network.head)
        self.output = nn.Linear(network.head, 2 * action_size)

    def forward(self, memory: Tensor, risk: Tensor | None = None) -> tuple[Tensor, Tensor]:
        """Return ``loc`` and ``scale`` ``[.., action]`` of the normal distribution before tanh."""
        x = F.relu(self.input(memory))
        if self.measure is not None:
            if risk is None:
                raise ValueError("this actor is conditioned on risk: pass it")
            x = x * F.relu(self.gate(self.cosines(self.measure.embed(risk).squeeze(-1))))
        loc, log_std = self.output(F.relu(self.hidden(x))).chunk(2, dim=-1)
        return loc, log_std.clamp(*LOG_STD_RANGE).exp()


@made_in_float32
class QuantileHead(nn.Module):
    r"""Memory, action and fractions to the quantiles of the return.

    :math:`g^{critic}(o_{0:t},u_t) \odot g^{criticRisk}([\phi^\beta; \phi^\tau])`, a linear layer, one output a
    fraction. The gate's linear layer is kept as its two halves, so that the ``beta`` half and the ``tau`` half
    are each computed at their own shape and added. Without a measure the gate depends on ``tau`` alone (DSAC).

    Args:
        action_size: number of action dimensions.
        network: sizes of the layers.
        measure: embeds ``beta``; None for a gate of ``tau`` alone.
    """

    def __init__(self, action_size: int, network: NetworkSettings, measure: RiskMeasure | None = None) -> None:
        """Build the layers."""
        super().__init__()
        self.measure = measure
        self.look_ahead = LookAhead() if network.look_ahead else None
        self.input = nn.Linear(network.memory + told_of_action(action_size, network.look_ahead), network.head)
        self.cosines = CosineFeatures(network.cosines)
        self.gate_tau = nn.Linear(network.cosines, network.head)
        if measure is not None:
            self.gate_beta = nn.Linear(network.cosines, network.head, bias=False)
            # One linear layer over both halves draws from its whole fan-in: so do its halves.
            bound = 1.0 / math.sqrt(2 * network.cosines)
            for parameter in (self.gate_tau.weight, self.gate_tau.bias, self.gate_beta.weight):
                nn.init.uniform_(parameter, -bound, bound)
        self.hidden = nn.Linear(network.head, network.head)
        self.output = nn.Linear(network.head, 1)

    def forward(self, memory: Tensor, action: Tensor, tau: Tensor, risk: Tensor | None = None) -> Tensor:
        """Return the quantiles ``[B, L, N]``.

        Args:
            memory: ``[B, L, memory]``.
            action: ``[B, L, action]``.
            tau: fractions in [0, 1], ``[B, L, N]`` or, the same along a sequence, ``[B, 1, N]``.
            risk: ``beta``, ``[B, L, 1]`` or ``[B, 1, 1]``; not read without a measure.
        """
        return self.layers(memory, with_look_ahead(self.look_ahead, memory, action), tau, self.beta_cosines(risk))

    def beta_cosines(self, risk: Tensor | None) -> Tensor | None:
        """Return the cosines of ``beta``, ``[B, L|1, cosines]``; None without a measure."""
        if self.measure is None:
            return None
        if risk is None:
            raise ValueError("this critic is conditioned on risk: pass it")
        return self.cosines(self.measure.embed(risk).squeeze(-1))

    def layers(self, memory: Tensor, action: Tensor, tau: Tensor, beta: Tensor | None) -> Tensor:
        """Do what follows beta's cosines and the look ahead, which is a part of the action here."""
        x = F.relu(self.input(torch.cat((memory, action), dim=-1)))
        return self.output(F.relu(self.hidden(x.unsqueeze(2) * self.gates(tau, beta)))).squeeze(-1)

    def gates(self, tau: Tensor, beta: Tensor | None) -> Tensor:
        """Return what the features are multiplied with at each fraction, of beta's cosines, ``[B, L|1, N, head]``."""
        gate = self.gate_tau(self.cosines(tau))
        if beta is not None:
            gate = gate + self.gate_beta(beta).unsqueeze(2)
        return F.relu(gate)


@made_in_float32
class ScalarHead(nn.Module):
    """Memory and action to one value, the mean return: the critic of SAC and RCWR.

    Args:
        action_size: number of action dimensions.
        network: sizes of the layers.
    """

    def __init__(self, action_size: int, network: NetworkSettings) -> None:
        """Build the layers."""
        super().__init__()
        self.look_ahead = LookAhead() if network.look_ahead else None
        self.input = nn.Linear(network.memory + told_of_action(action_size, network.look_ahead), network.head)
        self.hidden = nn.Linear(network.head, network.head)
        self.output = nn.Linear(network.head, 1)

    def forward(self, memory: Tensor, action: Tensor) -> Tensor:
        """Return the value ``[.., 1]``."""
        told = with_look_ahead(self.look_ahead, memory, action)
        x = F.relu(self.input(torch.cat((memory, told), dim=-1)))
        return self.output(F.relu(self.hidden(x)))


def with_look_ahead(look_ahead: LookAhead | None, memory: Tensor, action: Tensor) -> Tensor:
    """Return what a critic is told of an action: the action ``[.., 2]``, and what is foreseen of it."""
    return action if look_ahead is None else torch.cat((action, look_ahead(memory, action)), dim=-1)
