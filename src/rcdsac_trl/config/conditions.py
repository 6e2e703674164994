"""The context of an agent in an episode of an evaluation."""

from dataclasses import dataclass

from rcdsac_trl.errors import UserInputError


@dataclass(frozen=True)
class Condition:
    """An agent's context for an episode: beta, a collision weight, or none; or the controller that turns its beta."""

    beta: float | None = None
    collision_weight: float | None = None
    controller: str | None = None

    def __str__(self) -> str:
        """Name the condition in logs and tables."""
        if self.controller is not None:
            return self.controller
        if self.beta is not None:
            return f"beta={self.beta:g}"
        if self.collision_weight is not None:
            return f"w_coll={self.collision_weight:g}"
        return "all"

    @property
    def heading(self) -> str:
        """Name the condition in pictures; empty where the agent has no context."""
        if self.controller is not None:
            return self.controller.replace("_", " ")
        if self.beta is not None:
            return f"β = {self.beta:g}"
        return "" if self.collision_weight is None else f"w_coll = {self.collision_weight:g}"


def check_unique(conditions: list[Condition]) -> None:
    """Refuse to measure the same thing twice, which would shrink the apparent spread, or what tables would not tell."""
    names = [str(condition) for condition in conditions]
    for condition in conditions:
        if names.count(str(condition)) > 1:
            raise UserInputError(f"{condition} is given more than once: name every value once")
