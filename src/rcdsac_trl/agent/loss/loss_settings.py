"""What may be chosen about the loss: every hyper-parameter of it, once."""

from dataclasses import dataclass
from typing import ClassVar, Literal

from rcdsac_trl.system.checks import at_least, one_of, positive

DrawnPer = Literal["transition", "sequence"]
FractionSampling = Literal["uniform", "stratified"]
OverCritics = Literal["minimum", "smaller", "mean"]


@dataclass(frozen=True, kw_only=True)
class LossSettings:
    r"""Hyper-parameters of :class:`~rcdsac_trl.agent.loss.distributional_sac.DistributionalSACLoss`.

    The discount is given to ``make_value_estimator``, as to any TorchRL loss.

    Args:
        num_quantiles: N, fractions of the prediction.
        num_target_quantiles: N', fractions of the target.
        num_risk_samples: K, fractions of the risk-adjusted value.
        fractions_per: draw fractions anew for every ``"transition"``, or once a ``"sequence"``; each term of the
            loss has the same distribution, but the gates of a sequence are then computed once.
        fraction_sampling: ``"uniform"`` draws a set of fractions independently; ``"stratified"`` draws one in each of
            as many equal parts of [0, 1], so that a set misses no part of the return. The expectation of a mean over
            one critic's set is the same, its variance falls with :math:`N^{-3}` where quantiles are smooth, not
            :math:`N^{-1}`. What takes the lower of two such means, the actor's loss and the target ``"smaller"``, has
            another expectation: less noise, less of a bias downwards.
        n_steps: transitions that a target sums rewards over before it bootstraps, fewer at a sequence's end. The
            actions on the way are the replay's, whatever the policy would do now.
        kappa: where the quantile Huber loss turns from quadratic to linear, in units of the return.
        alpha_init: temperature at the start, above 0.
        target_entropy: the entropy the temperature aims for, in nats.
        burn_in: number of leading transitions of a sequence that only warm the memory up and carry no loss.
        target_over_critics: what the target takes of the target critics: at each fraction their ``"minimum"`` or
            ``"mean"``, or all fractions of the one whose mean is the ``"smaller"``. The minimum of two quantile
            functions that disagree lowers *both* tails, and bootstrapping adds that up; choosing a whole function
            lowers the mean alone, as with scalar critics, where it is the minimum; the mean has no such bias, but the
            policy then finds what both overestimate.

    Raises:
        UserInputError: for a value outside its range.

    Example:
        >>> LossSettings(kappa=0.3).num_quantiles
        16
    """

    #: What messages call the settings.
    section: ClassVar[str] = "loss"

    num_quantiles: int = 16
    num_target_quantiles: int = 16
    num_risk_samples: int = 16
    fractions_per: DrawnPer = "transition"
    fraction_sampling: FractionSampling = "uniform"
    n_steps: int = 1
    kappa: float = 1.0
    alpha_init: float = 0.05
    target_entropy: float = -2.0
    burn_in: int = 0
    target_over_critics: OverCritics = "minimum"

    def __post_init__(self) -> None:
        """Refuse values that cannot work."""
        at_least(self.section, self, 1, "num_quantiles num_target_quantiles num_risk_samples n_steps")
        at_least(self.section, self, 0, "burn_in")
        positive(self.section, self, "kappa alpha_init")
        one_of(f"{self.section}.fractions_per", self.fractions_per, DrawnPer)
        one_of(f"{self.section}.fraction_sampling", self.fraction_sampling, FractionSampling)
        one_of(f"{self.section}.target_over_critics", self.target_over_critics, OverCritics)
