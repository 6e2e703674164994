"""Mini-batches, losses and optimisers (``learner`` in ``conf/train.yaml``), checked."""

from dataclasses import dataclass
from typing import ClassVar

from rcdsac_trl.agent.loss.loss_settings import DrawnPer, LossSettings
from rcdsac_trl.errors import UserInputError
from rcdsac_trl.system.checks import at_least, one_of, positive


@dataclass(frozen=True, kw_only=True)
class LearnerSettings(LossSettings):
    """The loss's settings, and those of mini-batches, targets and optimisers."""

    section: ClassVar[str] = "learner"

    batch_size: int
    sequence_length: int
    num_critics: int
    gamma: float
    target_coefficient: float
    actor_average_decay: float
    actor_lr: float
    critic_lr: float
    alpha_lr: float
    max_grad_norm: float | None
    resample_per: DrawnPer
    # Runs of earlier versions name none: they had one side.
    mirror: bool = False

    def __post_init__(self) -> None:
        """Refuse values that cannot work."""
        super().__post_init__()
        at_least("learner", self, 1, "batch_size sequence_length")
        positive("learner", self, "actor_lr critic_lr alpha_lr")
        one_of("learner.resample_per", self.resample_per, DrawnPer)
        if self.num_critics not in (1, 2):
            raise UserInputError(f"learner.num_critics={self.num_critics} is neither 1 nor 2: use one of them")
        if self.burn_in >= self.sequence_length:
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
