r"""The networks of RC-DSAC as plain ``nn.Module`` parts: one encoder, then heads on its output.

Here are the encoders; the heads are :mod:`rcdsac_trl.agent.heads`, and have their names here, too. The action, ``beta``
and :math:`\tau` enter *after* the recurrent layer (paper, "Network Architectures"), so one encoder pass over the
observations of a sequence serves current and next step, data and policy action, every ``beta`` and every
:math:`\tau`. :mod:`rcdsac_trl.agent.actor` wires the parts to tensor keys.

These layers define what is computed. On a CPU :mod:`rcdsac_trl.agent.kernels.dispatch` runs a compiled twin in their
place where it knows the module.
"""

import importlib
from collections.abc import Callable, Mapping, Sequence

import torch
from torch import Tensor, nn
from torch.nn import functional as F

from rcdsac_trl.agent.float32 import made_in_float32
from rcdsac_trl.agent.heads import ActorHead, CosineFeatures, LookAhead, QuantileHead, ScalarHead
from rcdsac_trl.agent.network_settings import NetworkSettings
from rcdsac_trl.errors import UserInputError
from rcdsac_trl.robot.look_ahead import FORESEEN_SIZE, foreseen_among, read_by_heads
from rcdsac_trl.robot.observation import MAX_RANGE_OBSERVATION, RangeCode
from rcdsac_trl.robot.range_sensor import NUM_BINS
from rcdsac_trl.robot.ring import KERNELS, RING_ENDS, Padding, num_positions

__all__ = [
    "ActorHead",
    "CosineFeatures",
    "Encoder",
    "HistoryEncoder",
    "LookAhead",
    "NetworkSettings",
    "QuantileHead",
    "RangeFeatures",
    "ScalarHead",
    "encoder_class",
    "imported_encoder",
    "in_turn",
]


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
