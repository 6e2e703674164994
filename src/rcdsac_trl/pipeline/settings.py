"""What a run may choose, checked: each class mirrors one section of ``conf/train.yaml``, which explains it."""

from collections.abc import Sequence
from dataclasses import dataclass, fields
from typing import Literal, get_args

from rcdsac_trl.agent.risk import RiskMeasure, make_measure
from rcdsac_trl.errors import UserInputError
from rcdsac_trl.interface import SENSORS
from rcdsac_trl.pipeline.metrics import Condition, check_unique
from rcdsac_trl.world.env import resolve_num_workers
from rcdsac_trl.world.maps import MapSettings
from rcdsac_trl.world.task import TaskSettings

Critic = Literal["quantile", "scalar"]
Conditioning = Literal["per_episode", "fixed", "none"]
Relabel = Literal["resample", "stored"]
OverCritics = Literal["minimum", "smaller", "mean"]
DrawnPer = Literal["transition", "sequence"]
FractionSampling = Literal["uniform", "stratified"]


def _one_of(key: str, value: object, literal: object) -> None:
    if value not in get_args(literal):
        raise UserInputError(f"{key}={value} is unknown: choose one of {', '.join(get_args(literal))}")


def _at_least(section: str, settings: object, lowest: float, names: str) -> None:
    for name in names.split():
        value = getattr(settings, name)
        if not isinstance(value, int | float) or not value >= lowest:
            raise UserInputError(f"{section}.{name}={value} is not a number of at least {lowest:g}: raise it")


def _positive(section: str, settings: object, names: str) -> None:
    for name in names.split():
        value = getattr(settings, name)
        if not isinstance(value, int | float) or not value > 0:
            raise UserInputError(f"{section}.{name}={value} is not a positive number: use one")


@dataclass(frozen=True)
class DistortionSettings:
    """A risk measure and the values of beta that are looked at (``conf/algo/distortion``)."""

    name: str
    low: float
    high: float
    evaluation_betas: tuple[float, ...]

    def __post_init__(self) -> None:
        """Check every beta against the measure's domain."""
        object.__setattr__(self, "evaluation_betas", tuple(float(beta) for beta in self.evaluation_betas))
        measure = self.measure
        for beta in self.evaluation_betas:
            measure.check(beta)

    @property
    def measure(self) -> RiskMeasure:
        """The measure, with its training range."""
        return make_measure(self.name, self.low, self.high)


@dataclass(frozen=True)
class AlgoSettings:
    """A row of the paper's table as a choice of parts (``conf/algo``)."""

    name: str
    critic: Critic
    conditioning: Conditioning
    relabel: Relabel
    beta: float | None
    collision_weight: tuple[float, float] | None
    evaluation_collision_weights: tuple[float, ...]
    distortion: DistortionSettings

    def __post_init__(self) -> None:
        """Refuse parts that do not fit together."""
        _one_of("algo.critic", self.critic, Critic)
        _one_of("algo.conditioning", self.conditioning, Conditioning)
        _one_of("algo.relabel", self.relabel, Relabel)
        neutral = self.distortion.name == "neutral"
        if (self.conditioning == "none") != neutral:
            raise UserInputError(
                f"algo.conditioning={self.conditioning} does not go with algo/distortion={self.distortion.name}: "
                "none goes with neutral, per_episode and fixed with every other measure"
            )
        if self.critic == "scalar" and not neutral:
            raise UserInputError(
                f"algo.critic=scalar knows only the mean, so algo/distortion={self.distortion.name} does nothing: "
                "use algo/distortion=neutral algo.conditioning=none, or algo.critic=quantile"
            )
        if (self.beta is not None) != (self.conditioning == "fixed"):
            raise UserInputError(
                f"algo.beta={self.beta} does not go with algo.conditioning={self.conditioning}: "
                "fixed needs one beta, per_episode and none take null"
            )
        if self.beta is not None:
            self.distortion.measure.check(self.beta)
        if self.relabel == "resample" and self.conditioning != "per_episode":
            raise UserInputError(
                f"algo.relabel=resample does nothing with algo.conditioning={self.conditioning}: use stored"
            )
        if self.collision_weight is not None:
            low, high = self.collision_weight
            if not 0 <= low <= high:
                raise UserInputError(
                    f"algo.collision_weight=[{low},{high}] is no range: give [low,high] with 0 <= low <= high"
                )
            object.__setattr__(self, "collision_weight", (float(low), float(high)))
        weights = tuple(float(weight) for weight in self.evaluation_collision_weights)
        object.__setattr__(self, "evaluation_collision_weights", weights)
        if bool(weights) != (self.collision_weight is not None):
            raise UserInputError(
                f"algo.evaluation_collision_weights={list(weights)} does not go with "
                f"algo.collision_weight={self.collision_weight}: give both or neither"
            )
        if weights and self.conditioning == "per_episode":
            raise UserInputError(
                "algo.collision_weight does not go with algo.conditioning=per_episode: an episode tells the networks "
                "either a weight or a beta"
            )
        for weight in weights:
            self._check_weight(weight)
        check_unique(self.default_conditions)

    def _check_weight(self, weight: float) -> None:
        low, high = self.collision_weight or (1.0, 1.0)
        if not low <= weight <= high:
            raise UserInputError(
                f"collision weight {weight:g} is outside {self.name}'s range [{low:g}, {high:g}]: choose one inside"
            )

    @property
    def network_measure(self) -> RiskMeasure | None:
        """The measure whose beta the networks read; None where they read none."""
        return self.distortion.measure if self.conditioning == "per_episode" else None

    @property
    def context_key(self) -> str | None:
        """What is drawn for an episode and told to the networks."""
        if self.conditioning == "per_episode":
            return "risk"
        return "collision_weight" if self.collision_weight is not None else None

    @property
    def default_conditions(self) -> list[Condition]:
        """Where validation looks, and the paper's table."""
        if self.conditioning == "per_episode":
            return [Condition(beta=beta) for beta in self.distortion.evaluation_betas]
        if self.collision_weight is not None:
            return [Condition(collision_weight=weight) for weight in self.evaluation_collision_weights]
        return [Condition(beta=self.beta)]

    def conditions(self, betas: Sequence[float] | None, weights: Sequence[float] | None) -> list[Condition]:
        """Turn what a user asks of an evaluation into conditions.

        Raises:
            UserInputError: if a beta is missing, or a beta or a weight is superfluous or outside its domain.
        """
        if weights is not None and self.collision_weight is None:
            raise UserInputError(f"{self.name} has no collision weight: leave collision_weight out")
        if self.conditioning == "per_episode":
            if not betas:
                shown = ",".join(f"{beta:g}" for beta in self.distortion.evaluation_betas)
                raise UserInputError(f"{self.name} drives as its beta says: give one, such as beta=[{shown}]")
            for beta in betas:
                self.distortion.measure.check(beta)
            asked = [Condition(beta=float(beta)) for beta in betas]
        elif betas is not None and [float(beta) for beta in betas] != [self.beta]:
            told = f"was trained for beta={self.beta:g} alone" if self.beta is not None else "has no beta"
            raise UserInputError(f"{self.name} {told}: leave beta={list(betas)} out")
        elif weights is not None:
            for weight in weights:
                self._check_weight(weight)
            asked = [Condition(collision_weight=float(weight)) for weight in weights]
        else:
            asked = self.default_conditions
        check_unique(asked)
        return asked


@dataclass(frozen=True)
class WorldSettings:
    """What an environment is made of."""

    map_settings: MapSettings
    task: TaskSettings
    sensor: str
    num_agents: int
    num_workers: int | Literal["auto"]
    worker_timeout_s: float | None = None
    gui: bool = False

    def __post_init__(self) -> None:
        """Refuse an unknown sensor and agents that the workers cannot share."""
        if self.sensor not in SENSORS:
            raise UserInputError(f"sensor.name={self.sensor} is unknown: choose one of {', '.join(sorted(SENSORS))}")
        if self.num_agents < 1:
            raise UserInputError(f"world.num_agents={self.num_agents} is below 1: raise it")
        resolve_num_workers(self.num_workers, self.num_agents)
        if self.worker_timeout_s is not None:
            _positive("world", self, "worker_timeout_s")


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
        _at_least("learner", self, 1, "batch_size sequence_length num_quantiles num_target_quantiles num_risk_samples")
        _positive("learner", self, "kappa actor_lr critic_lr alpha_lr alpha_init")
        _one_of("learner.target_over_critics", self.target_over_critics, OverCritics)
        _one_of("learner.resample_per", self.resample_per, DrawnPer)
        _one_of("learner.fractions_per", self.fractions_per, DrawnPer)
        _one_of("learner.fraction_sampling", self.fraction_sampling, FractionSampling)
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
            _positive("learner", self, "max_grad_norm")


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
        _at_least("schedule", self, 1, "iterations")
        _at_least("schedule", self, 0, " ".join(f.name for f in fields(self)))
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
