r"""Distortion risk measures: what "risk-averse" means, as one small object each.

A measure distorts the quantile fractions of a return :math:`Z`: its value is
:math:`\mathbb{E}_{\tau \sim U(0,1)} Z_{\psi(\tau;\beta)}` (paper, "Risk-Sensitive Objective"), estimated by
drawing :math:`\tau` and evaluating the quantile function at :math:`\psi(\tau;\beta)`.

One sign convention holds for all of them: returns are rewards, and a *smaller* :math:`\beta` is *more averse*.
"""

from abc import ABC, abstractmethod
from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, ClassVar, TypeVar

from rcdsac_trl.errors import UserInputError

# Settings are read by this module's ranges: what is wrong there is told before torch is imported, which takes a second.
if TYPE_CHECKING:
    import torch
    from torch import Tensor

Scalar = TypeVar("Scalar", float, "Tensor")

# Of an interval of length 1 they leave less than the spacing of float64 at 1.
_HALVINGS = 60


@dataclass(frozen=True)
class Interval:
    """The values a risk-measure parameter may take; prints as ``(0, 1]``."""

    low: float
    high: float
    low_inclusive: bool = True
    high_inclusive: bool = True

    def __contains__(self, value: float) -> bool:
        """Tell whether the value lies inside."""
        above = value >= self.low if self.low_inclusive else value > self.low
        below = value <= self.high if self.high_inclusive else value < self.high
        return above and below

    def __str__(self) -> str:
        """Write the interval with its brackets."""
        opening, closing = "[" if self.low_inclusive else "(", "]" if self.high_inclusive else ")"
        return f"{opening}{self.low:g}, {self.high:g}{closing}"


@dataclass(frozen=True)
class RiskMeasure(ABC):
    """One family of distortion risk measures, indexed by a scalar ``beta``.

    Args:
        low: smallest ``beta`` drawn in training, inside the measure's domain.
        high: largest ``beta`` drawn in training, inside the measure's domain.

    Raises:
        UserInputError: if the range is empty or leaves the domain.

    Example:
        >>> import torch
        >>> measure = CVaR()
        >>> measure.psi(torch.tensor([0.0, 0.5, 1.0]), torch.tensor(0.5))
        tensor([0.0000, 0.2500, 0.5000])
    """

    low: float
    high: float

    #: The name in configurations and messages.
    name: ClassVar[str]
    #: Every ``beta`` the measure is defined for *and* the embedding can tell apart.
    domain: ClassVar[Interval]
    #: The ``beta`` at which the value is the plain mean; None where no such ``beta`` exists.
    neutral_beta: ClassVar[float | None]

    def __post_init__(self) -> None:
        """Refuse a sampled range that is empty or leaves the domain."""
        self.check(self.low)
        self.check(self.high)
        if self.low > self.high:
            raise UserInputError(
                f"the beta range of measure {self.name!r} is empty ({self.low:g} to {self.high:g}): "
                "give the smaller value as low and the larger as high"
            )

    @abstractmethod
    def psi(self, tau: "Tensor", beta: "Tensor") -> "Tensor":
        """Return the distorted fractions; ``tau`` in [0, 1] and ``beta`` broadcast against each other."""

    def weight(self, u: "Tensor", beta: "Tensor") -> "Tensor":
        r"""Return the dual density at the fraction ``u``.

        It is :math:`g'(u)` with :math:`g = \psi^{-1}`, so that the value is :math:`\int_0^1 g'(u)\, Z_u\, du`.

        Raises:
            NotImplementedError: where the measure has no closed-form density.
        """
        raise NotImplementedError(f"{type(self).__name__} has no closed-form dual density")

    def inverse_psi(self, u: "Tensor", beta: "Tensor") -> "Tensor":
        r"""Return :math:`g(u) = \psi^{-1}(u)`, the weight of all quantiles at fractions up to ``u``.

        So the value of a sample :math:`x_{(1)} \le \ldots \le x_{(n)}` is, exactly,
        :math:`\sum_i x_{(i)} (g(i/n) - g((i-1)/n))`. It is found by bisection, the largest :math:`\tau` with
        :math:`\psi(\tau) \le u`, so it needs no more than a non-decreasing :meth:`psi`.

        Args:
            u: fractions in [0, 1].
            beta: broadcasts against ``u``.

        Returns:
            float64, to its precision.

        Example:
            >>> import torch
            >>> CVaR().inverse_psi(torch.tensor([0.0, 0.25, 0.5, 1.0]), torch.tensor(0.5)).diff()
            tensor([0.5000, 0.5000, 0.0000], dtype=torch.float64)
        """
        import torch

        u, beta = torch.broadcast_tensors(u.double(), beta.double())
        low, high = torch.zeros_like(u), torch.ones_like(u)
        for _ in range(_HALVINGS):
            middle = (low + high) / 2
            inside = self.psi(middle, beta) <= u
            low, high = torch.where(inside, middle, low), torch.where(inside, high, middle)
        return low

    def embed(self, beta: Scalar) -> Scalar:
        r"""Map ``beta`` into [0, 1], strictly increasing in averseness or in neutrality, for the networks.

        The cosine embedding :math:`\cos(\pi i x)` is injective on [0, 1] only, so raw values never reach it.
        """
        return (beta - self.domain.low) / (self.domain.high - self.domain.low)

    def from_uniform(self, u: Scalar) -> Scalar:
        """Map uniform numbers in [0, 1) to ``beta`` in the sampled range."""
        return self.low + (self.high - self.low) * u

    def sample(self, shape: Sequence[int], generator: "torch.Generator") -> "Tensor":
        """Draw ``beta`` uniformly over [``low``, ``high``], float32 of ``shape`` on the generator's device."""
        import torch

        return self.from_uniform(
            torch.rand(tuple(shape), generator=generator, device=generator.device, dtype=torch.float32)
        )

    def temper(self, beta: Scalar, strength: float) -> Scalar:
        """Move ``beta`` towards neutral: strength 0 gives the neutral value, 1 leaves ``beta`` as it is.

        Training that begins neutral and lets the distortion grow keeps an averse agent from never seeing success.

        Raises:
            UserInputError: if ``strength`` is below 1 and the measure has no neutral value.
        """
        if strength == 1.0:
            return beta
        if self.neutral_beta is None:
            raise UserInputError(
                f"measure {self.name!r} has no neutral beta to start from: train it without a warm-up of beta"
            )
        return self.neutral_beta + strength * (beta - self.neutral_beta)

    def check(self, beta: float) -> None:
        """Raise :class:`UserInputError` unless ``beta`` lies in the domain."""
        if beta not in self.domain:
            raise UserInputError(
                f"beta = {beta:g} is outside the domain {self.domain} of measure {self.name!r}: choose one inside"
            )


@dataclass(frozen=True)
class Neutral(RiskMeasure):
    r"""The mean: :math:`\psi(\tau) = \tau`; its only ``beta`` is 0 and means nothing."""

    low: float = 0.0
    high: float = 0.0

    name: ClassVar[str] = "neutral"
    domain: ClassVar[Interval] = Interval(0.0, 0.0)
    neutral_beta: ClassVar[float | None] = 0.0

    def psi(self, tau: "Tensor", beta: "Tensor") -> "Tensor":
        """Return ``tau``, broadcast against ``beta``."""
        return tau + 0.0 * beta

    def weight(self, u: "Tensor", beta: "Tensor") -> "Tensor":
        """Return ones: every quantile counts the same."""
        return (u + beta) * 0.0 + 1.0

    def embed(self, beta: Scalar) -> Scalar:
        """Return 0: there is one value to tell apart."""
        return 0.0 * beta


@dataclass(frozen=True)
class CVaR(RiskMeasure):
    r"""Conditional value-at-risk, the mean of the worst fraction ``beta``: :math:`\psi(\tau;\beta) = \beta\tau`.

    The domain is (0, 1] and 1 is neutral (paper, "Risk-Sensitive Objective"). Dual density
    :math:`g'(u) = \mathbb{I}\{u < \beta\} / \beta`. The paper draws from [0, 1], whose lower end is not in the
    domain: training draws from [0.01, 1] by default.
    """

    low: float = 0.01
    high: float = 1.0

    name: ClassVar[str] = "cvar"
    domain: ClassVar[Interval] = Interval(0.0, 1.0, low_inclusive=False)
    neutral_beta: ClassVar[float | None] = 1.0

    def psi(self, tau: "Tensor", beta: "Tensor") -> "Tensor":
        """Return ``beta * tau``."""
        return beta * tau

    def weight(self, u: "Tensor", beta: "Tensor") -> "Tensor":
        """Return ``1 / beta`` below ``beta`` and 0 above."""
        return (u < beta) / beta


@dataclass(frozen=True)
class PowerLaw(RiskMeasure):
    r"""The power law: :math:`\psi(\tau;\beta) = 1 - (1-\tau)^{1/(1-\beta)}` for ``beta`` in [-2, 0].

    0 is neutral and smaller is more averse (paper, "Risk-Sensitive Objective"). Dual density
    :math:`g'(u) = (1-\beta)(1-u)^{-\beta}`. The formula goes on below -2, but the embedding
    :math:`-\beta/2` must stay in [0, 1], so -2 ends the domain; :class:`WidePowerLaw` reaches farther.
    """

    low: float = -2.0
    high: float = 0.0

    name: ClassVar[str] = "pow"
    domain: ClassVar[Interval] = Interval(-2.0, 0.0)
    neutral_beta: ClassVar[float | None] = 0.0

    def psi(self, tau: "Tensor", beta: "Tensor") -> "Tensor":
        """Return the power-law distortion; log1p and expm1 keep small ``tau`` exact."""
        return -((-tau).log1p() / (1.0 - beta)).expm1()

    def weight(self, u: "Tensor", beta: "Tensor") -> "Tensor":
        """Return ``(1 - beta) * (1 - u) ** -beta``."""
        return (1.0 - beta) * (1.0 - u) ** (-beta)

    def embed(self, beta: Scalar) -> Scalar:
        """Return ``beta`` as a share of the most averse, ``-beta / 2``: 0 is neutral, 1 the most averse."""
        return beta / self.domain.low


@dataclass(frozen=True)
class WidePowerLaw(PowerLaw):
    r"""The power law for ``beta`` in [-8, 0]: as averse as CVaR from 0.2 on, by the mean of :math:`\psi`.

    That mean over :math:`\tau` is :math:`1/(2-\beta)`, and :math:`\beta/2` for CVaR. Training draws ``beta`` so that
    the mean is uniform, as CVaR's is: uniform in ``beta`` itself, three draws in four would be more averse than the
    paper's -2. Not in the paper.
    """

    low: float = -8.0
    high: float = 0.0

    name: ClassVar[str] = "pow_wide"
    domain: ClassVar[Interval] = Interval(-8.0, 0.0)

    def from_uniform(self, u: Scalar) -> Scalar:
        r"""Map uniform numbers in [0, 1) to ``beta``: the mean of :math:`\psi` becomes uniform."""
        lowest, highest = (1.0 / (2.0 - beta) for beta in (self.low, self.high))
        return 2.0 - 1.0 / (lowest + (highest - lowest) * u)


@dataclass(frozen=True)
class Wang(RiskMeasure):
    r"""Wang's transform: :math:`\psi(\tau;\beta) = \Phi(\Phi^{-1}(\tau) + \beta)`, ``beta`` in [-2, 2].

    0 is neutral, negative averse, positive seeking (Wang, 2000; in this form Dabney et al., 2018,
    "Implicit Quantile Networks"). On a normal return it shifts the mean by ``beta`` standard deviations. Dual
    density :math:`g'(u) = \exp(\beta \Phi^{-1}(u) - \beta^2/2)`. Training draws from [-2, 0] by default.
    """

    low: float = -2.0
    high: float = 0.0

    name: ClassVar[str] = "wang"
    domain: ClassVar[Interval] = Interval(-2.0, 2.0)
    neutral_beta: ClassVar[float | None] = 0.0

    def psi(self, tau: "Tensor", beta: "Tensor") -> "Tensor":
        """Return the normal quantile of ``tau``, shifted by ``beta``, as a fraction again."""
        import torch

        return torch.special.ndtr(torch.special.ndtri(tau) + beta)

    def weight(self, u: "Tensor", beta: "Tensor") -> "Tensor":
        """Return the likelihood ratio of the shifted normal."""
        import torch

        return torch.exp(beta * torch.special.ndtri(u) - 0.5 * beta.square())


@dataclass(frozen=True)
class CPW(RiskMeasure):
    r"""Cumulative probability weighting of Tversky and Kahneman (1992), ``beta`` in [0.3, 1].

    :math:`\psi(\tau;\beta) = \tau^\beta / (\tau^\beta + (1-\tau)^\beta)^{1/\beta}`; 1 is neutral, and people's choices
    fit 0.71. It overweights *both* tails, and the smaller ``beta`` the more pessimistic its centre: the median is
    mapped below one half. Below about 0.28 the formula is no longer monotone in ``tau``, hence the domain. Its
    inverse, and with it the dual density, has no closed form.
    """

    low: float = 0.3
    high: float = 1.0

    name: ClassVar[str] = "cpw"
    domain: ClassVar[Interval] = Interval(0.3, 1.0)
    neutral_beta: ClassVar[float | None] = 1.0

    def psi(self, tau: "Tensor", beta: "Tensor") -> "Tensor":
        """Return the inverse-S-shaped weighting of ``tau``."""
        weighted = tau**beta
        return weighted / (weighted + (1.0 - tau) ** beta) ** (1.0 / beta)


@dataclass(frozen=True)
class VaR(RiskMeasure):
    r"""Value-at-risk, the ``beta``-quantile itself: :math:`\psi(\tau;\beta) = \beta`, ``beta`` in (0, 1).

    No ``beta`` gives the mean, so there is no neutral value, and all weight lies in one point, so there is no
    dual density. Training draws from [0.05, 0.95] by default.
    """

    low: float = 0.05
    high: float = 0.95

    name: ClassVar[str] = "var"
    domain: ClassVar[Interval] = Interval(0.0, 1.0, low_inclusive=False, high_inclusive=False)
    neutral_beta: ClassVar[float | None] = None

    def psi(self, tau: "Tensor", beta: "Tensor") -> "Tensor":
        """Return ``beta``, broadcast against ``tau``."""
        return beta + 0.0 * tau


#: Every measure by its name.
MEASURES: dict[str, type[RiskMeasure]] = {
    measure.name: measure for measure in (Neutral, CVaR, PowerLaw, WidePowerLaw, Wang, CPW, VaR)
}


def make_measure(name: str, low: float | None = None, high: float | None = None) -> RiskMeasure:
    """Return the measure of that name, with its default sampled range where none is given.

    Args:
        name: a key of :data:`MEASURES`.
        low: smallest ``beta`` drawn in training.
        high: largest ``beta`` drawn in training.

    Raises:
        UserInputError: for an unknown name or a range outside the domain.

    Example:
        >>> make_measure("pow", low=-1.5)
        PowerLaw(low=-1.5, high=0.0)
    """
    if name not in MEASURES:
        raise UserInputError(
            f"there is no risk measure {name!r}: choose one of {', '.join(MEASURES)}, or add yours to MEASURES "
            "(docs/tutorials/own-measure.md)"
        )
    given = {key: value for key, value in (("low", low), ("high", high)) if value is not None}
    return MEASURES[name](**given)
