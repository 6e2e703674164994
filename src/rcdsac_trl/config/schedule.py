"""How a run is laid out (``schedule`` in ``conf/train.yaml``), checked."""

from dataclasses import dataclass, fields

from rcdsac_trl.errors import UserInputError
from rcdsac_trl.system.checks import at_least


@dataclass(frozen=True)
class Schedule:
    """How a run is laid out."""

    iterations: int
    updates_per_iteration: int
    pursuit_iterations: int
    pursuit_noise: float
    neutral_iterations: int
    ramp_iterations: int
    decay_iterations: int
    final_learning_rate_share: float

    def __post_init__(self) -> None:
        """Refuse what cannot be scheduled."""
        at_least("schedule", self, 1, "iterations")
        at_least("schedule", self, 0, " ".join(f.name for f in fields(self)))
        if not 0 < self.final_learning_rate_share <= 1:
            raise UserInputError(
                f"schedule.final_learning_rate_share={self.final_learning_rate_share} is outside (0, 1]: "
                "the last updates need some learning rate"
            )

    def distortion_strength(self, iteration: int) -> float:
        """Return how much of beta counts in the actor's loss: 0 as if neutral, 1 all of it."""
        if iteration < self.neutral_iterations:
            return 0.0
        if self.ramp_iterations == 0:
            return 1.0
        return min(1.0, (iteration - self.neutral_iterations + 1) / self.ramp_iterations)

    def learning_rate_share(self, iteration: int) -> float:
        """Return the share of the learning rates that an iteration uses; the last one uses the final share.

        A run shorter than the decay begins in the middle of it.
        """
        if self.decay_iterations == 0:
            return 1.0
        decayed = max(0, iteration + 1 - (self.iterations - self.decay_iterations)) / self.decay_iterations
        return 1.0 - decayed * (1.0 - self.final_learning_rate_share)
