"""Networks wired to tensor keys: the actor and the critics that learn, and the policy that acts."""

from collections.abc import Mapping
from dataclasses import replace
from typing import Literal

import torch
from tensordict.nn import TensorDictModule, TensorDictSequential
from torch import Tensor, nn
from torchrl.data import TensorSpec, Unbounded
from torchrl.envs.transforms import TensorDictPrimer
from torchrl.envs.utils import ExplorationType
from torchrl.modules import ProbabilisticActor, TanhNormal

from rcdsac_trl.agent.heads import ActorHead, QuantileHead, ScalarHead
from rcdsac_trl.agent.network_settings import NetworkSettings
from rcdsac_trl.agent.networks import HistoryEncoder, encoder_class
from rcdsac_trl.agent.risk import RiskMeasure
from rcdsac_trl.errors import UserInputError
from rcdsac_trl.robot.observation import VECTOR_OBSERVATIONS

#: What the encoder hands to the heads.
MEMORY_KEY = "memory"
#: Where the acting policy keeps its memory between steps.
STATE_KEY = "recurrent_state"


def _encoder(vectors: Mapping[str, int], network: NetworkSettings) -> TensorDictModule:
    encoder = encoder_class(network)(vectors, network)
    return TensorDictModule(encoder, in_keys=["range", *vectors], out_keys=[MEMORY_KEY])


def network_of_heads(network: NetworkSettings) -> NetworkSettings:
    """Return what heads are made of: the memory is what they read of it."""
    return replace(network, memory=encoder_class(network).memory_size_of(network))


def build_actor(
    action_size: int = 2,
    vectors: Mapping[str, int] = VECTOR_OBSERVATIONS,
    measure: RiskMeasure | None = None,
    network: NetworkSettings | None = None,
) -> TensorDictSequential:
    """Return the actor on sequences: an encoder and a head.

    Args:
        action_size: number of action dimensions.
        vectors: name and size of the vector observations; add ``collision_weight: 1`` for RCWR.
        measure: conditions the actor on ``risk``; None for no conditioning.
        network: sizes of the layers, and the encoder; None for the paper's.

    Returns:
        Two modules: observations ``[B, T, ..]`` to ``memory`` ``[B, T, 128]``, and ``memory`` (and ``risk``
        ``[B, T, 1]``) to ``loc`` and ``scale`` ``[B, T, action_size]``.

    Example:
        >>> from rcdsac_trl.agent.risk import CVaR
        >>> actor = build_actor(measure=CVaR())
        >>> actor.in_keys
        ['range', 'waypoint', 'velocity', 'risk']
    """
    network = network or NetworkSettings()
    of_heads = network_of_heads(network)
    head = TensorDictModule(
        ActorHead(action_size, of_heads, measure),
        in_keys=[MEMORY_KEY] if measure is None else [MEMORY_KEY, "risk"],
        out_keys=["loc", "scale"],
    )
    return TensorDictSequential(_encoder(vectors, network), head)


def build_critic(
    action_size: int = 2,
    vectors: Mapping[str, int] = VECTOR_OBSERVATIONS,
    kind: Literal["quantile", "scalar"] = "quantile",
    measure: RiskMeasure | None = None,
    network: NetworkSettings | None = None,
) -> TensorDictSequential:
    """Return one critic on sequences: its own encoder and a quantile or a scalar head.

    Args:
        action_size: number of action dimensions.
        vectors: name and size of the vector observations.
        kind: ``"quantile"`` for the distribution of the return at the fractions ``tau``, ``"scalar"`` for its mean.
        measure: conditions a quantile critic on ``risk``; None for no conditioning.
        network: sizes of the layers, and the encoder; None for the paper's.

    Raises:
        UserInputError: for an unknown kind, or a scalar critic with a measure.
    """
    network = network or NetworkSettings()
    of_heads = network_of_heads(network)
    head: nn.Module
    if kind == "quantile":
        head = QuantileHead(action_size, of_heads, measure)
        in_keys = [MEMORY_KEY, "action", "tau"] + ([] if measure is None else ["risk"])
        out_keys = ["quantiles"]
    elif kind == "scalar":
        if measure is not None:
            raise UserInputError(
                f"a scalar critic cannot be conditioned on risk (measure {measure.name!r}): choose critic 'quantile'"
            )
        head = ScalarHead(action_size, of_heads)
        in_keys, out_keys = [MEMORY_KEY, "action"], ["state_action_value"]
    else:
        raise UserInputError(f"there is no critic {kind!r}: choose 'quantile' or 'scalar'")
    return TensorDictSequential(_encoder(vectors, network), TensorDictModule(head, in_keys=in_keys, out_keys=out_keys))


class _Step(nn.Module):
    """One-step view of an encoder; shares its parameters."""

    def __init__(self, encoder: HistoryEncoder) -> None:
        super().__init__()
        self.encoder = encoder

    def forward(self, *inputs: Tensor) -> tuple[Tensor, Tensor]:
        return self.encoder.step(*inputs)


def build_policy(
    actor: TensorDictSequential, action_spec: TensorSpec, generator: torch.Generator | None = None
) -> ProbabilisticActor:
    """Return the acting policy of an actor; it shares the actor's parameters.

    It reads the observations, ``risk`` where the actor does, ``is_init`` and ``recurrent_state`` at any leading
    dimensions and writes ``loc``, ``scale``, ``action`` and ``("next", "recurrent_state")``. Under
    ``ExplorationType.DETERMINISTIC`` the action is ``tanh(loc)``.

    Args:
        actor: from :func:`build_actor`.
        action_spec: the environment's action spec, within [-1, 1].
        generator: source of the action noise; None for torch's global one.
    """
    encoder, head = actor[0], actor[1]
    step = TensorDictModule(
        _Step(encoder.module),
        in_keys=[*encoder.in_keys, "is_init", STATE_KEY],
        out_keys=[MEMORY_KEY, ("next", STATE_KEY)],
    )
    network = TensorDictSequential(step, head, selected_out_keys=["loc", "scale", ("next", STATE_KEY)])
    return ProbabilisticActor(
        network,
        in_keys=["loc", "scale"],
        spec=action_spec,
        distribution_class=TanhNormal,
        default_interaction_type=ExplorationType.RANDOM,
        generator=generator,
    )


def recurrent_state_primer(state_size: int = NetworkSettings.memory) -> TensorDictPrimer:
    """Return the transform that puts a zero ``recurrent_state`` ``[*, state_size]`` into every reset."""
    state = Unbounded((state_size,), device="cpu", dtype=torch.float32)
    return TensorDictPrimer({STATE_KEY: state}, default_value=0.0, expand_specs=True)
