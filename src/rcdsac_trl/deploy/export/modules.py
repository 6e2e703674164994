"""An agent as torch modules that take one step: what is exported, and what everything else is held against."""

from collections.abc import Sequence
from typing import Self

import torch
from torch import Tensor, nn

from rcdsac_trl.agent.actor import network_of_heads
from rcdsac_trl.agent.heads import ActorHead, QuantileHead, ScalarHead
from rcdsac_trl.agent.network_settings import NetworkSettings
from rcdsac_trl.agent.networks import Encoder, HistoryEncoder
from rcdsac_trl.agent.risk import RiskMeasure, make_measure
from rcdsac_trl.deploy.policy.agent_config import AgentConfig
from rcdsac_trl.deploy.policy.weights import Weights

ACTION_SIZE = 2


class ActorStep(nn.Module):
    """One step of the actor: observations, what it is told and the memory before to the action and the memory after.

    Args:
        encoder: of the actor, ours or yours.
        head: of the actor.
        weighted: whether the encoder reads the collision weight.
    """

    def __init__(self, encoder: HistoryEncoder, head: ActorHead, *, weighted: bool = False) -> None:
        super().__init__()
        self.encoder, self.head, self.weighted = encoder, head, weighted

    @classmethod
    def of_weights(cls, weights: Weights) -> Self:
        """Make the step of an agent's actor."""
        config, network = weights.config, network_of(weights.config)
        encoder = Encoder(config.vectors, network)
        head = ActorHead(ACTION_SIZE, network_of_heads(network), measure_of(config))
        _load(encoder, weights, "actor.encoder")
        _load(head, weights, "actor.head")
        return cls(encoder, head, weighted=config.context == "collision_weight")

    def forward(
        self,
        range_: Tensor,
        waypoint: Tensor,
        velocity: Tensor,
        context: Tensor,
        memory: Tensor,
        remembered: Tensor | None = None,
    ) -> tuple[Tensor, Tensor]:
        """Return the action tanh(mean) [B, 2] and the encoder's next state [B, state].

        Args:
            range_: range observation, [B, 180].
            waypoint: [B, 6].
            velocity: [B, 4].
            context: ``beta`` or the collision weight, [B, 1]; not read by an agent that is told neither.
            memory: the state, [B, state]; zeros at the start.
            remembered: [B, 90], of an agent that is told what it saw.
        """
        vectors = (waypoint, velocity, remembered, context if self.weighted else None)
        read, after = _encode(self.encoder, range_, vectors, memory)
        loc, _ = self.head(read, None if self.head.measure is None else context)
        return torch.tanh(loc), after


class CriticStep(nn.Module):
    """One step of all critics: observations and the action to the lower of their quantiles (or means).

    Args:
        weights: of the agent.
        fractions: of the quantiles, [N].
    """

    fractions: Tensor

    def __init__(self, weights: Weights, fractions: Tensor) -> None:
        super().__init__()
        config, network = weights.config, network_of(weights.config)
        numbers = range(config.num_critics)
        self.encoders = nn.ModuleList(Encoder(config.vectors, network) for _ in numbers)
        self.heads = nn.ModuleList(_critic_head(config, network_of_heads(network)) for _ in numbers)
        self.weighted = config.context == "collision_weight"
        self.register_buffer("fractions", fractions.reshape(1, 1, -1))
        for number in numbers:
            _load(self.encoders[number], weights, f"critics.{number}.encoder")
            _load(self.heads[number], weights, f"critics.{number}.head")

    def forward(
        self,
        range_: Tensor,
        waypoint: Tensor,
        velocity: Tensor,
        context: Tensor,
        action: Tensor,
        memories: Tensor,
        remembered: Tensor | None = None,
    ) -> tuple[Tensor, Tensor]:
        """Return quantiles in rising order [B, N] (or the mean [B, 1]) and the next states [critics, B, state].

        Args:
            range_: range observation, [B, 180].
            waypoint: [B, 6].
            velocity: [B, 4].
            context: as in :meth:`ActorStep.forward`, [B, 1].
            action: [B, 2].
            memories: the states, [critics, B, state]; zeros at the start.
            remembered: as in :meth:`ActorStep.forward`.
        """
        vectors = (waypoint, velocity, remembered, context if self.weighted else None)
        values, after = [], []
        for number, (encoder, head) in enumerate(zip(self.encoders, self.heads, strict=True)):
            assert isinstance(encoder, Encoder)
            memory, state = _encode(encoder, range_, vectors, memories[number])
            after.append(state)
            if isinstance(head, QuantileHead):
                risk = None if head.measure is None else context.unsqueeze(1)
                quantiles = head(memory.unsqueeze(1), action.unsqueeze(1), self.fractions, risk).squeeze(1)
                values.append(quantiles.sort(dim=-1).values)
            else:
                values.append(head(memory, action))
        return torch.stack(values).amin(dim=0), torch.stack(after)


def measure_of(config: AgentConfig) -> RiskMeasure | None:
    """Return the measure whose ``beta`` the networks read; None where they read none."""
    return make_measure(config.measure) if config.context == "beta" else None


def network_of(config: AgentConfig) -> NetworkSettings:
    """Return what the networks of an agent are made of."""
    return NetworkSettings(
        padding=config.padding,
        range_code=config.range_code,
        restart_steps=config.restart_steps,
        look_ahead=config.look_ahead,
        **config.network,  # type: ignore[arg-type]
    )


def _critic_head(config: AgentConfig, network: NetworkSettings) -> nn.Module:
    if config.critic == "scalar":
        return ScalarHead(ACTION_SIZE, network)
    return QuantileHead(ACTION_SIZE, network, measure_of(config))


def _encode(
    encoder: HistoryEncoder, range_: Tensor, vectors: Sequence[Tensor | None], memory: Tensor
) -> tuple[Tensor, Tensor]:
    is_first = torch.zeros(len(range_), 1, dtype=torch.bool)
    return encoder.step(range_, *(vector for vector in vectors if vector is not None), is_first, memory)


def _load(module: nn.Module, weights: Weights, prefix: str) -> None:
    module.load_state_dict({name: torch.from_numpy(value.copy()) for name, value in weights.part(prefix).items()})
    module.requires_grad_(False)
