r"""The networks of RC-DSAC as plain ``nn.Module`` parts: one encoder, then heads on its output.

The action, ``beta`` and :math:`\tau` enter *after* the recurrent layer (paper, "Network Architectures"), so one
encoder pass over the observations of a sequence serves current and next step, data and policy action, every
``beta`` and every :math:`\tau`. :mod:`rcdsac_trl.agent.actor` wires the parts to tensor keys.

Pass ``risk`` and ``tau`` with a time dimension of 1 where they are constant along a sequence: the gate is then computed
once for it.

These layers define what is computed. On a CPU :mod:`rcdsac_trl.agent.kernels.dispatch` runs a compiled twin in their
place where it knows the module.
"""

import importlib
import math
from collections.abc import Callable, Mapping, Sequence

import torch
from torch import Tensor, nn
from torch.nn import functional as F

from rcdsac_trl.agent.float32 import made_in_float32
from rcdsac_trl.agent.network_settings import NetworkSettings
from rcdsac_trl.agent.risk import RiskMeasure
from rcdsac_trl.errors import UserInputError
from rcdsac_trl.robot.action import LOG_STD_RANGE as LOG_STD_RANGE
from rcdsac_trl.robot.look_ahead import (
    FORESEEN_SIZE,
    HAT_OFFSETS,
    HAT_SLOPES,
    NUM_LOOK_AHEAD,
    foreseen_among,
    read_by_heads,
    told_of_action,
)
from rcdsac_trl.robot.observation import MAX_RANGE_OBSERVATION, RangeCode
from rcdsac_trl.robot.range_sensor import NUM_BINS
from rcdsac_trl.robot.ring import KERNELS, RING_ENDS, Padding, num_positions


@made_in_float32
class RangeFeatures(nn.Module):
    """Two strided convolutions and a linear layer over the ring of bins: ``[n, 180] -> [n, features]``.

    The linear layer reads the last convolution position by position (all channels of a position together).

    Args:
        channels: of both convolutions.
        features: of the linear layer.
        padding: how the ring is closed; see :mod:`rcdsac_trl.robot.ring`.
        range_code: how a bin is read; see :data:`rcdsac_trl.robot.observation.RangeCode`.
    """

    def __init__(
        self, channels: int, features: int, padding: Padding = "circular", range_code: RangeCode = "paper"
    ) -> None:
        """Build the layers for :data:`NUM_BINS` bins."""
        super().__init__()
        self.padding = padding
        self.range_code = range_code
        self.conv_1 = nn.Conv1d(1, channels, KERNELS[0], stride=2)
        self.conv_2 = nn.Conv1d(channels, channels, KERNELS[1], stride=2)
        self.linear = nn.Linear(num_positions(padding) * channels, features)

    def read(self, bins: Tensor) -> Tensor:
        """Return what both convolutions read of bins ``[n, 180]``: in their code, with the ring's ends closed."""
        if self.range_code == "nearness":
            bins = torch.where(bins > 0.0, MAX_RANGE_OBSERVATION - bins, 0.0)
        before, behind = RING_ENDS[self.padding]
        return torch.cat((bins[:, NUM_BINS - before :], bins, bins[:, :behind]), dim=1) if before else bins

    def forward(self, bins: Tensor) -> Tensor:
        """Map ``[n, 180]`` to ``[n, features]``."""
        positions = F.relu(self.conv_2(F.relu(self.conv_1(self.read(bins).unsqueeze(1)))))
        return F.relu(self.linear(positions.transpose(1, 2).flatten(1)))


class HistoryEncoder(nn.Module):
    """What an encoder has to be; derive yours from it and name it in ``network.encoder``.

    It runs by its own layers wherever an agent does: losses, acting, evaluation, ``torch.export``.

    Args:
        vectors: name and size of every vector observation besides ``range``, in the order of the call, such as
            ``{"waypoint": 6, "velocity": 4}``.
        network: sizes of the layers.

    Attributes:
        memory_size: how many numbers the heads read.
        state_size: how many numbers it carries from step to step: ``network.state_size``, of yours ``network.memory``.
    """

    def __init__(self, vectors: Mapping[str, int], network: NetworkSettings) -> None:
        super().__init__()
        self.memory_size, self.state_size = self.memory_size_of(network), network.state_size

    @classmethod
    def memory_size_of(cls, network: NetworkSettings) -> int:
        """Return how many numbers the heads read; all of the state unless you say otherwise."""
        return network.memory

    def forward(self, range_: Tensor, *vectors: Tensor) -> Tensor:
        """Run whole sequences ``[B, T, ..]`` from a zero state; returns the memory ``[B, T, memory_size]``."""
        raise NotImplementedError

    def step(self, range_: Tensor, *rest: Tensor) -> tuple[Tensor, Tensor]:
        """Advance any batch ``[*]`` of agents by one observation, to what :meth:`forward` gives there.

        Args:
            range_: range observation ``[*, 180]``.
            rest: the vector observations ``[*, size]``, then ``is_init`` ``[*, 1]`` (bool: this is the first
                observation of an episode, so the state is zeroed first), then the state ``[*, state_size]``.

        Returns:
            The memory that the heads read, ``[*, memory_size]``, and the next state ``[*, state_size]``.
        """
        raise NotImplementedError


@made_in_float32
class Encoder(HistoryEncoder):
    """Observation history to memory: per-input features, concatenated, into a GRU. Its state is its memory.

    With ``network.restart_steps`` R it looks back as far as training unrolls it, no matter how long an episode is: a
    state that has run for hundreds of steps is none that was trained. Two states take turns. Every R observations the
    older one is dropped and a new one begins at zero; the older of the two is the memory. So it has read R + 1 to 2 R
    observations, all of them at an episode's start. What is carried is both, the older first, and how many observations
    the younger has read.

    With ``network.look_ahead`` the heads read one thing more of the newest observation than the memory: the foreseen
    clearances, which end what is remembered.

    Args:
        vectors: as for :class:`HistoryEncoder`; each gets its own linear layer.
        network: sizes of the layers.

    Attributes:
        foreseen_in: number of the vector observation that foreseen clearances end; None where heads do not read them.
        foreseen_from: where they begin in all vector observations, one behind the other.

    Raises:
        UserInputError: if heads are to look ahead and nothing is remembered.

    Example:
        >>> encoder = Encoder({"waypoint": 6, "velocity": 4}, NetworkSettings())
        >>> encoder(torch.zeros(2, 8, 180), torch.zeros(2, 8, 6), torch.zeros(2, 8, 4)).shape
        torch.Size([2, 8, 128])
    """

    def __init__(self, vectors: Mapping[str, int], network: NetworkSettings) -> None:
        """Build the layers."""
        super().__init__(vectors, network)
        self.foreseen_in: int | None = None
        self.foreseen_from = 0
        if network.look_ahead:
            if "remembered" not in vectors:
                raise UserInputError("network.look_ahead=true reads what is remembered: set sensor.memory_s above 0")
            self.foreseen_in = list(vectors).index("remembered")
            self.foreseen_from = foreseen_among(vectors).start
        self.range = RangeFeatures(network.conv, network.range, network.padding, network.range_code)
        self.vectors = nn.ModuleList(nn.Linear(size, network.vector) for size in vectors.values())
        self.gru = nn.GRU(network.range + network.vector * len(vectors), network.memory, batch_first=True)
        self.restart_steps = network.restart_steps

    @classmethod
    def memory_size_of(cls, network: NetworkSettings) -> int:
        """Return how many numbers the heads read."""
        return read_by_heads(network.memory, network.look_ahead)

    def forward(self, range_: Tensor, *vectors: Tensor) -> Tensor:
        """Run whole sequences ``[B, T, ...]`` from a zero state; returns the memory ``[B, T, memory]``.

        A sequence of up to 2 R + 1 observations, as training unrolls, is read as a whole.
        """
        run = in_turn(lambda features: self.gru(features)[0], self.features(range_, vectors), self.restart_steps)
        return self.with_foreseen(run, vectors)

    def step(self, range_: Tensor, *rest: Tensor) -> tuple[Tensor, Tensor]:
        """Advance any batch ``[*]`` of agents by one observation; see :meth:`HistoryEncoder.step`."""
        *vectors, is_init, state = rest
        memory, state = self.advance(self.features(range_, tuple(vectors)), is_init, state)
        return self.with_foreseen(memory, vectors), state

    def with_foreseen(self, memory: Tensor, vectors: Sequence[Tensor]) -> Tensor:
        """Return what the heads read of a memory ``[*, memory]`` and the vector observations of the same moment."""
        if self.foreseen_in is None:
            return memory
        return torch.cat((memory, vectors[self.foreseen_in][..., -FORESEEN_SIZE:]), dim=-1)

    def advance(self, features: Tensor, is_init: Tensor, state: Tensor) -> tuple[Tensor, Tensor]:
        """Do the recurrent part of :meth:`step`, from the features ``[*, n]`` of an observation."""
        state = torch.where(is_init, torch.zeros_like(state), state)
        if self.restart_steps is None:
            state = self._read(features, state)
            return state, state
        older, younger, age = state.split((self.gru.hidden_size, self.gru.hidden_size, 1), dim=-1)
        is_due = age >= self.restart_steps
        older, younger = torch.where(is_due, younger, older), torch.where(is_due, 0.0, younger)
        older, younger = self._read(torch.stack((features, features)), torch.stack((older, younger)))
        return older, torch.cat((older, younger, torch.where(is_due, 0.0, age) + 1.0), dim=-1)

    def _read(self, features: Tensor, state: Tensor) -> Tensor:
        """Return the states ``[*, memory]`` after one observation each."""
        rows, states = features.reshape(-1, 1, features.shape[-1]), state.reshape(1, -1, self.gru.hidden_size)
        return self.gru(rows, states)[1].view(state.shape)

    def features(self, range_: Tensor, vectors: Sequence[Tensor]) -> Tensor:
        """Return the rectified features of observations ``[*, ..]``, those of the bins first, ``[*, n]``."""
        lead = range_.shape[:-1]
        parts = [self.range(range_.reshape(-1, NUM_BINS)).reshape(*lead, -1)]
        parts += [F.relu(layer(value)) for layer, value in zip(self.vectors, vectors, strict=True)]
        return torch.cat(parts, dim=-1)


def in_turn(run: Callable[[Tensor], Tensor], features: Tensor, restart_steps: int | None) -> Tensor:
    """Run a recurrent layer over whole sequences with restarts; see :class:`Encoder`.

    Args:
        run: the layer from a zero state, ``[B, t, n]`` to ``[B, t, memory]``.
        features: ``[B, T, n]``.
        restart_steps: R, or None.

    Returns:
        ``[B, T, memory]``.
    """
    steps = features.shape[1]
    if restart_steps is None or steps <= 2 * restart_steps + 1:
        return run(features)
    starts = range(restart_steps, steps - restart_steps, restart_steps)
    first = run(features[:, : 2 * restart_steps])
    later = [run(features[:, start : start + 2 * restart_steps])[:, restart_steps:] for start in starts]
    return torch.cat([first, *later], dim=1)


def encoder_class(network: NetworkSettings) -> type[HistoryEncoder]:
    """Return :class:`Encoder`, or the class that ``network.encoder`` names."""
    return Encoder if network.encoder is None else imported_encoder(network.encoder)


def imported_encoder(path: str) -> type[HistoryEncoder]:
    """Import an encoder of a user's.

    Raises:
        UserInputError: if it cannot be imported, or is none.
    """
    module, _, name = path.rpartition(".")
    try:
        found = getattr(importlib.import_module(module), name)
    except (ImportError, AttributeError, ValueError) as error:
        raise UserInputError(
            f"network.encoder={path} cannot be imported ({error}): name a class as package.module.Class"
        ) from error
    if not isinstance(found, type) or not issubclass(found, HistoryEncoder):
        raise UserInputError(f"network.encoder={path} is no HistoryEncoder: derive it from rcdsac_trl.agent.networks'")
    return found


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
        gate = self.gate_tau(self.cosines(tau))
        if beta is not None:
            gate = gate + self.gate_beta(beta).unsqueeze(2)
        return self.output(F.relu(self.hidden(x.unsqueeze(2) * F.relu(gate)))).squeeze(-1)


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
