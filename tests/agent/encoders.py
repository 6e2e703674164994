"""Encoders that the compiled twins do not know, for the tests of the plain path."""

from collections.abc import Mapping

import torch
from torch import Tensor, nn
from torch.nn import functional as F

from rcdsac_trl.agent.networks import Encoder, HistoryEncoder, NetworkSettings


class DeepEncoder(Encoder):
    """Our features into a GRU of two layers, each with half of the state; the heads read the upper one."""

    def __init__(self, vectors: Mapping[str, int], network: NetworkSettings) -> None:
        super().__init__(vectors, network)
        self.gru = nn.GRU(self.gru.input_size, self.memory_size, num_layers=2, batch_first=True)

    @classmethod
    def memory_size_of(cls, network: NetworkSettings) -> int:
        return network.memory // 2

    def advance(self, features: Tensor, is_init: Tensor, state: Tensor) -> tuple[Tensor, Tensor]:
        lead = features.shape[:-1]
        before = torch.where(is_init, torch.zeros_like(state), state).reshape(-1, 2, self.memory_size).transpose(0, 1)
        out, after = self.gru(features.reshape(-1, 1, features.shape[-1]), before.contiguous())
        return out.reshape(*lead, -1), after.transpose(0, 1).reshape(*lead, -1)


class FrameStack(HistoryEncoder):
    """No recurrent layer: the features of the last four observations side by side."""

    FRAMES = 4

    def __init__(self, vectors: Mapping[str, int], network: NetworkSettings) -> None:
        super().__init__(vectors, network)
        self.layer = nn.Linear(180 + sum(vectors.values()), network.memory // self.FRAMES)

    def forward(self, range_: Tensor, *vectors: Tensor) -> Tensor:
        frames = F.relu(self.layer(torch.cat((range_, *vectors), -1)))
        before = F.pad(frames, (0, 0, self.FRAMES - 1, 0))
        return torch.cat([before[:, lag : lag + frames.shape[1]] for lag in range(self.FRAMES)], -1)

    def step(self, range_: Tensor, *rest: Tensor) -> tuple[Tensor, Tensor]:
        *vectors, is_init, state = rest
        state = torch.where(is_init, torch.zeros_like(state), state)
        frame = F.relu(self.layer(torch.cat((range_, *vectors), -1)))
        state = torch.cat((state[..., frame.shape[-1] :], frame), -1)
        return state, state
