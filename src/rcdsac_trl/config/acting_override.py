"""What a command may say of how an agent acts, in the place of what the agent's own config says."""

from dataclasses import dataclass, fields, replace

from rcdsac_trl.deploy.policy.acting import ActingSettings, OverCritics
from rcdsac_trl.deploy.policy.weights import Weights
from rcdsac_trl.errors import UserInputError


@dataclass(frozen=True)
class ActingOverride:
    """``acting`` of the commands that let an agent act; None: as the agent's config says.

    Attributes:
        num_candidates: as in :class:`~rcdsac_trl.deploy.policy.acting.ActingSettings`.
        spread: likewise.
        over_critics: likewise.
        margin_m: likewise.

    Raises:
        UserInputError: for what no agent can do.
    """

    num_candidates: int | None = None
    spread: float | None = None
    over_critics: OverCritics | None = None
    margin_m: float | None = None

    def __post_init__(self) -> None:
        """Refuse what lies outside the limits."""
        replace(ActingSettings(), **self.given)  # type: ignore[arg-type]

    @property
    def given(self) -> dict[str, int | float | str]:
        """What is said, by name."""
        said = {field.name: getattr(self, field.name) for field in fields(self)}
        return {name: value for name, value in said.items() if value is not None}

    def of(self, own: ActingSettings) -> ActingSettings:
        """Return how an agent acts whose own config says that.

        Raises:
            UserInputError: if its critics are not to choose, and something is said of how they would.

        Example:
            >>> ActingOverride(num_candidates=32).of(ActingSettings(spread=0.5))
            ActingSettings(num_candidates=32, spread=0.5, over_critics='minimum', margin_m=0.0)
        """
        acting = replace(own, **self.given)  # type: ignore[arg-type]
        if not acting.chooses and (idle := [name for name in self.given if name != "num_candidates"]):
            raise UserInputError(
                f"acting.{idle[0]}={self.given[idle[0]]} says how critics choose, and with acting.num_candidates=1 "
                "they do not: leave it out, or raise that"
            )
        return acting

    def in_weights(self, weights: Weights) -> Weights:
        """Return an agent that acts so; acting otherwise than before, it has no offsets of its quantiles."""
        acting = self.of(weights.config.acting)
        if acting == weights.config.acting:
            return weights
        return replace(weights, config=replace(weights.config, acting=acting, recalibration=None))
