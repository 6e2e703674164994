"""What a run may choose, checked: each class mirrors one section of ``conf/train.yaml``, which explains it."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

from rcdsac_trl.agent.risk import RiskMeasure, make_measure
from rcdsac_trl.config.conditions import Condition, check_unique
from rcdsac_trl.errors import UserInputError

Critic = Literal["quantile", "scalar"]
Conditioning = Literal["per_episode", "fixed", "none"]
Relabel = Literal["resample", "stored"]


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


# A collision then costs 10,000, an episode earns about 550: larger is a slip.
_LARGEST_WEIGHT = 1000.0


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
            if not 0 <= low <= high <= _LARGEST_WEIGHT:
                raise UserInputError(
                    f"algo.collision_weight=[{low},{high}] is no range: give [low,high] with 0 <= low <= high <= "
                    f"{_LARGEST_WEIGHT:g}"
                )
            object.__setattr__(self, "collision_weight", (float(low), float(high)))
        weights = tuple(float(weight) for weight in self.evaluation_collision_weights)
        object.__setattr__(self, "evaluation_collision_weights", weights)
        if bool(weights) != (self.told_weights is not None):
            given = None if self.collision_weight is None else list(self.collision_weight)
            told_none = "nobody is told a weight, so give [], and a name (algo.name)"
            raise UserInputError(
                f"algo.evaluation_collision_weights={list(weights)} does not go with algo.collision_weight={given}: "
                f"{told_none if weights else 'give some of the range'}"
            )
        if weights and self.conditioning == "per_episode":
            raise UserInputError(
                f"algo.collision_weight={list(self.told_weights or ())} does not go with algo.conditioning=per_episode:"
                " an episode tells the networks either a weight or a beta, so give [w,w], one weight for all"
            )
        for weight in weights:
            self._check_weight(weight)
        check_unique(self.default_conditions)

    def _check_weight(self, weight: float) -> None:
        low, high = self.told_weights or (1.0, 1.0)
        if not low <= weight <= high:
            raise UserInputError(
                f"collision weight {weight:g} is outside {self.name}'s range [{low:g}, {high:g}]: choose one inside"
            )

    @property
    def told_weights(self) -> tuple[float, float] | None:
        """Range of the collision weights that episodes are told; None where there is nothing to tell."""
        if self.collision_weight is None or self.collision_weight[0] == self.collision_weight[1]:
            return None
        return self.collision_weight

    @property
    def fixed_weight(self) -> float:
        """Factor of the collision reward in training and in returns where episodes are told none; 1 where they are."""
        return 1.0 if self.collision_weight is None or self.told_weights is not None else self.collision_weight[0]

    @property
    def network_measure(self) -> RiskMeasure | None:
        """The measure whose beta the networks read; None where they read none."""
        return self.distortion.measure if self.conditioning == "per_episode" else None

    @property
    def context_key(self) -> str | None:
        """Key of the context that is drawn for an episode and read by the networks."""
        if self.conditioning == "per_episode":
            return "risk"
        return "collision_weight" if self.told_weights is not None else None

    @property
    def default_conditions(self) -> list[Condition]:
        """Where validation looks, and the paper's table."""
        if self.conditioning == "per_episode":
            return [Condition(beta=beta) for beta in self.distortion.evaluation_betas]
        if self.told_weights is not None:
            return [Condition(collision_weight=weight) for weight in self.evaluation_collision_weights]
        return [Condition(beta=self.beta)]

    def conditions(self, betas: Sequence[float] | None, weights: Sequence[float] | None) -> list[Condition]:
        """Turn what a user asks of an evaluation into conditions; of a user who asks for none, those of the row.

        Raises:
            UserInputError: if a beta or a weight is superfluous or outside its domain, or none is left.
        """
        if weights is not None and self.told_weights is None:
            raise UserInputError(f"{self.name} is told no collision weight: leave collision_weight out")
        if self.conditioning == "per_episode" and betas is not None:
            if not betas:
                shown = ",".join(f"{beta:g}" for beta in self.distortion.evaluation_betas)
                raise UserInputError(f"beta=[] names none: leave it out for beta=[{shown}], or give one")
            for beta in betas:
                self.distortion.measure.check(beta)
            asked = [Condition(beta=float(beta)) for beta in betas]
        elif betas is not None and [float(beta) for beta in betas] != [self.beta]:
            drives = f"was trained for beta={self.beta:g} alone" if self.beta is not None else "has no beta"
            raise UserInputError(f"{self.name} {drives}: leave beta={list(betas)} out")
        elif weights is not None:
            for weight in weights:
                self._check_weight(weight)
            asked = [Condition(collision_weight=float(weight)) for weight in weights]
        else:
            asked = self.default_conditions
        check_unique(asked)
        return asked
