"""Mini-batches, losses and optimisers (``learner`` in ``conf/train.yaml``), checked."""

from dataclasses import dataclass
from typing import Literal

from rcdsac_trl.errors import UserInputError
from rcdsac_trl.system.checks import at_least, one_of, positive

OverCritics = Literal["minimum", "smaller", "mean"]


DrawnPer = Literal["transition", "sequence"]


FractionSampling = Literal["uniform", "stratified"]


@dataclass(frozen=True)
class LearnerSettings:
    """Mini-batches, losses and optimisers."""

    batch_size: int
    sequence_length: int
    burn_in: int
    num_quantiles: int
    num_target_quantiles: int
    num_risk_samples: int
    fractions_per: DrawnPer
    fraction_sampling: FractionSampling
    kappa: float
    num_critics: int
    target_over_critics: OverCritics
    gamma: float
    target_coefficient: float
    actor_average_decay: float
    actor_lr: float
    critic_lr: float
    alpha_lr: float
    alpha_init: float
    target_entropy: float
    max_grad_norm: float | None
    resample_per: DrawnPer

    def __post_init__(self) -> None:
        """Refuse values that cannot work."""
        at_least("learner", self, 1, "batch_size sequence_length num_quantiles num_target_quantiles num_risk_samples")
        positive("learner", self, "kappa actor_lr critic_lr alpha_lr alpha_init")
        one_of("learner.target_over_critics", self.target_over_critics, OverCritics)
        one_of("learner.resample_per", self.resample_per, DrawnPer)
        one_of("learner.fractions_per", self.fractions_per, DrawnPer)
        one_of("learner.fraction_sampling", self.fraction_sampling, FractionSampling)
        if self.num_critics not in (1, 2):
            raise UserInputError(f"learner.num_critics={self.num_critics} is neither 1 nor 2: use one of them")
        if not 0 <= self.burn_in < self.sequence_length:
            raise UserInputError(
                f"learner.burn_in={self.burn_in} leaves no transition of learner.sequence_length="
                f"{self.sequence_length} to learn from: make it smaller"
            )
        if not 0 <= self.gamma < 1:
            raise UserInputError(f"learner.gamma={self.gamma} is outside [0, 1): episodes never terminate")
        if not 0 < self.target_coefficient <= 1:
            raise UserInputError(f"learner.target_coefficient={self.target_coefficient} is outside (0, 1]")
        if not 0 <= self.actor_average_decay < 1:
            raise UserInputError(f"learner.actor_average_decay={self.actor_average_decay} is outside [0, 1)")
        if self.max_grad_norm is not None:
            positive("learner", self, "max_grad_norm")
