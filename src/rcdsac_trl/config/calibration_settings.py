"""The root of ``conf/calibrate.yaml``: what a calibration may choose."""

import math
from dataclasses import dataclass
from typing import Literal

from rcdsac_trl.config.acting_override import ActingOverride
from rcdsac_trl.config.checkpoint_name import CheckpointName
from rcdsac_trl.config.conditions import Condition
from rcdsac_trl.config.training_settings import Threads, TrainingSettings, Workers
from rcdsac_trl.deploy.policy.acting import ActingSettings
from rcdsac_trl.errors import UserInputError
from rcdsac_trl.system import runtime
from rcdsac_trl.system.checks import check_least
from rcdsac_trl.system.processes import resolve_processes

MOST_MISSING = 0.02
"""Share of a discounted return that may lie beyond the horizon of a calibration as driven."""


@dataclass(frozen=True)
class CalibrationSettings:
    """The root of ``conf/calibrate.yaml``."""

    run: str | None
    beta: tuple[float, ...] | None
    checkpoint: CheckpointName | None
    half_precision: bool
    split: Literal["evaluation", "validation"]
    seed: int
    num_maps: int
    num_states: int
    num_rollouts: int
    horizon_steps: int | None
    cross_evaluate: bool
    as_driven: bool
    num_episodes: int
    every_steps: int
    acting: ActingOverride
    out: str | None
    num_workers: Workers
    threads: Threads

    def __post_init__(self) -> None:
        """Refuse what is below its limit, what does not go together, and a cross-evaluation of nothing."""
        check_least("seed", self.seed, 0)
        for key in ("num_maps", "num_states", "num_rollouts", "num_episodes", "every_steps"):
            check_least(key, getattr(self, key), 1)
        if self.as_driven and self.cross_evaluate:
            raise UserInputError(
                "as_driven=true drives whole episodes, and cross_evaluate=true branches off from states: leave one out"
            )
        if self.acting.given and not self.as_driven:
            raise UserInputError(
                f"acting.{next(iter(self.acting.given))} says how an agent acts, and here its actions are drawn: give "
                "as_driven=true, too, or leave acting out"
            )
        if self.cross_evaluate and self.num_maps < 2:
            raise UserInputError(
                f"cross_evaluate=true gives intervals over maps, and num_maps={self.num_maps} has none: give at least 2"
            )
        resolve_processes(self.num_workers, self.num_maps)
        runtime.resolve_threads(self.threads)

    def conditions_of(self, trained: TrainingSettings) -> list[Condition]:
        """Return the conditions under which the critics of an agent are measured.

        Raises:
            UserInputError: for critics without quantiles, values of beta that the agent does not take, and a
                cross-evaluation of a single one.
        """
        if trained.algo.critic != "quantile":
            raise UserInputError(
                f"run={self.run} has {trained.algo.critic} critics, which predict no quantiles: name an agent of "
                "another row"
            )
        conditions = trained.algo.conditions(self.beta, None)
        if self.cross_evaluate and len(conditions) < 2:
            raise UserInputError(
                f"cross_evaluate=true holds values of beta against each other, and {self.run} is asked for one: give "
                "two or more to a risk-conditioned agent, such as beta=[0.25,1], or leave cross_evaluate out"
            )
        return conditions

    def horizon_in(self, episode_steps: int) -> int:
        """Return the steps of a roll-out in episodes of some length: half of one, unless a user says otherwise.

        Raises:
            UserInputError: if that leaves no step of an episode for states.
        """
        horizon = max(1, episode_steps // 2) if self.horizon_steps is None else self.horizon_steps
        if not 0 < horizon < episode_steps:
            raise UserInputError(
                f"horizon_steps={horizon} must be below the {episode_steps} steps of an episode, so that states can be "
                "met in it: shorten it, or leave it out for half of an episode"
            )
        return horizon

    def check_missing(self, gamma: float, episode_steps: int) -> None:
        """Refuse returns as driven of which the horizon cuts off too much: offsets fitted on them would be too low.

        Raises:
            UserInputError: if more than :data:`MOST_MISSING` is missing.
        """
        horizon = self.horizon_in(episode_steps)
        if self.as_driven and gamma**horizon > MOST_MISSING:
            enough = math.ceil(math.log(MOST_MISSING) / math.log(gamma)) if gamma < 1.0 else "more"
            raise UserInputError(
                f"horizon_steps={horizon} leaves out {gamma**horizon:.0%} of a return (gamma={gamma:g}), and "
                f"as_driven=true allows {MOST_MISSING:.0%}: that takes {enough} steps, and episodes that are longer"
            )

    def acting_of(self, trained: TrainingSettings) -> ActingSettings:
        """Return how the agent acts as driven: as its config says, with what was chosen in its place.

        Raises:
            UserInputError: if its heads read no margin.
        """
        acting = self.acting.of(trained.acting)
        acting.check_heads(trained.network.look_ahead)
        return acting
