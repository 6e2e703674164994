"""What a sweep (``conf/experiment``) or a search (``conf/search.yaml``) may choose, checked."""

from collections.abc import Mapping
from dataclasses import dataclass

from rcdsac_trl.errors import UserInputError
from rcdsac_trl.system.checks import check_least


@dataclass(frozen=True)
class ExperimentSettings:
    """A set of trainings (``conf/experiment``); overrides are written as on the command line."""

    name: str
    every: tuple[str, ...]
    runs: Mapping[str, tuple[str, ...]]
    only: tuple[str, ...] | None
    evaluate: tuple[str, ...] | None


@dataclass(frozen=True)
class SearchSettings:
    """A search for better hyper-parameters (``conf/search.yaml``)."""

    name: str
    trials: int
    collision_cost: float
    averaged_validations: int
    startup_trials: int
    warmup_iterations: int
    seed: int
    storage: str | None

    def __post_init__(self) -> None:
        """Refuse what is below its limit, and a name that no folder beside the others can have."""
        if not self.name.strip(". ") or "/" in self.name:
            raise UserInputError(f"search.name={self.name} names no folder in multirun/: give a word, or leave it out")
        for key in ("trials", "averaged_validations"):
            check_least(f"search.{key}", getattr(self, key), 1)
        for key in ("startup_trials", "warmup_iterations", "seed"):
            check_least(f"search.{key}", getattr(self, key), 0)
        if self.collision_cost < 0:
            raise UserInputError(f"search.collision_cost={self.collision_cost:g} must be at least 0")
