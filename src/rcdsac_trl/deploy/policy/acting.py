"""How an agent acts: by its actor's mean, or by the best of some actions around it."""

from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from rcdsac_trl.errors import UserInputError
from rcdsac_trl.system.checks import check_least, one_of

OverCritics = Literal["minimum", "mean"]
"""What counts of what several critics say of an action."""

NUM_CHOICE_FRACTIONS = 8
"""At so many fractions, each distorted, an action's return is read."""

_MOST_CANDIDATES = 4096
_WIDEST = 10.0
_WIDEST_MARGIN_M = 0.2
_GOLDEN_ANGLE = np.pi * (3.0 - np.sqrt(5.0))


@dataclass(frozen=True)
class ActingSettings:
    """How an agent acts (``acting`` in ``conf/train.yaml``); the defaults are the paper's way.

    Attributes:
        num_candidates: actions that the critics choose among, tanh(mean) one of them; 1: tanh(mean) itself.
        spread: how far from the mean the others lie, in standard deviations of the policy.
        over_critics: what counts of what the critics say of one: the smallest value, or the mean.
        margin_m: while they choose, foreseen clearances are smaller by this safety margin, m; needs heads that look
            ahead.

    Raises:
        UserInputError: if a value is outside its limits.
    """

    num_candidates: int = 1
    spread: float = 1.0
    over_critics: OverCritics = "minimum"
    margin_m: float = 0.0

    def __post_init__(self) -> None:
        """Refuse what lies outside the limits; files bring plain values."""
        for name, kinds in (("num_candidates", (int,)), ("spread", (int, float)), ("margin_m", (int, float))):
            value = getattr(self, name)
            if isinstance(value, bool) or not isinstance(value, kinds):
                raise UserInputError(f"acting.{name}={value!r} is no {'whole ' if kinds == (int,) else ''}number")
        check_least("acting.num_candidates", self.num_candidates, 1)
        if self.num_candidates > _MOST_CANDIDATES:
            raise UserInputError(f"acting.num_candidates={self.num_candidates} must be at most {_MOST_CANDIDATES}")
        if not 0.0 < self.spread <= _WIDEST:
            raise UserInputError(
                f"acting.spread={self.spread:g} must be above 0 and at most {_WIDEST:g} standard deviations"
            )
        one_of("acting.over_critics", self.over_critics, OverCritics)
        if not 0.0 <= self.margin_m <= _WIDEST_MARGIN_M:
            raise UserInputError(f"acting.margin_m={self.margin_m:g} is outside [0, {_WIDEST_MARGIN_M:g}]: give metres")

    def __str__(self) -> str:
        """Say it in words, as a card does."""
        if not self.chooses:
            return "tanh(mean)"
        return (
            f"the best of {self.num_candidates} actions within {self.spread:g} x the policy's spread, by the "
            f"{self.over_critics} over its critics"
            + (f", with a safety margin of {100.0 * self.margin_m:g} cm" if self.margin_m > 0.0 else "")
        )

    def check_heads(self, look_ahead: bool) -> None:
        """Refuse a margin that heads do not read.

        Raises:
            UserInputError: if they do not look ahead.
        """
        if self.chooses and self.margin_m > 0.0 and not look_ahead:
            raise UserInputError(
                f"acting.margin_m={self.margin_m:g} needs an agent with network.look_ahead=true, which foresees "
                "clearances: set acting.margin_m=0"
            )

    @property
    def chooses(self) -> bool:
        """Whether critics choose at all."""
        return self.num_candidates > 1

    def noise(self) -> NDArray[np.float32]:
        r"""Return what is added to the mean, in standard deviations of the policy, float32 [num_candidates, 2].

        The first is 0. The others are the spread times a standard normal that is laid out evenly instead of drawn:
        point k of n has the radius :math:`\sqrt{-2 \ln(1 - (k - \tfrac12) / n)}`, a quantile of the Rayleigh
        distribution, and is turned by the golden angle from the one before (Vogel 1979). So actions are the same at
        every step, on every machine.

        Example:
            >>> ActingSettings(num_candidates=3, spread=2.0).noise().astype(float).round(2).tolist()
            [[0.0, 0.0], [-1.12, 1.02], [0.29, -3.32]]
        """
        number = self.num_candidates - 1
        k = np.arange(1, number + 1)
        radius = self.spread * np.sqrt(-2.0 * np.log1p(-(k - 0.5) / max(number, 1)))
        points = radius[:, None] * np.stack((np.cos(k * _GOLDEN_ANGLE), np.sin(k * _GOLDEN_ANGLE)), axis=1)
        return np.concatenate((np.zeros((1, 2)), points)).astype(np.float32)


BY_MEAN = ActingSettings()
"""The paper's way: tanh(mean)."""
