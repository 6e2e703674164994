"""How far trainings of one recipe lie apart, learnt from all agents together.

Trainings are dear, so an agent has one, two or three. Two of one agent hardly say how the next would differ: Student's
t with one degree of freedom is 12.7. The trainings of all agents together do. So they are pooled, as the residual of an
analysis of variance is: trainings of every agent are taken to scatter alike. An agent with a single training then has
an interval that covers other trainings, too.

A training moves all settings of its agent together, and each of them for itself::

    mean of setting k after training s = agent k + common_s + own_ks

Its two mean squares are estimated: that of the trainings' means over the settings, and that of what is left. Both hold
the noise of the episodes, so intervals are a little too wide rather than too narrow.
"""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy import stats

Array = NDArray[np.float64]

_SEED = 1


@dataclass(frozen=True)
class TrainingError:
    """By how much other trainings would have changed a result.

    Attributes:
        variance: of the result.
        freedom: degrees of freedom that the variance is known with.
    """

    variance: float = 0.0
    freedom: float = float("inf")

    def __add__(self, other: "TrainingError") -> "TrainingError":
        """Add an independent error, its degrees of freedom by Welch and Satterthwaite."""
        return _summed((self.variance, self.freedom), (other.variance, other.freedom))

    def draw(self, number: int) -> Array:
        """Draw so many errors: quantiles of Student's t, evenly, so that its far tails do not depend on luck.

        Example:
            >>> sorted(TrainingError(4.0, 1.0).draw(5).round(2).tolist())
            [-6.16, -1.45, 0.0, 1.45, 6.16]
        """
        if self.variance == 0.0:
            return np.zeros(number)
        t = stats.t.ppf((np.arange(number) + 0.5) / number, self.freedom)
        # Independent of the maps drawn.
        drawn: Array = np.random.default_rng([0, _SEED]).permutation(t) * self.variance**0.5
        return drawn


@dataclass(frozen=True)
class TrainingScatter:
    """Mean squares of trainings, pooled over agents.

    Attributes:
        of_means: mean square of the trainings' means over the settings of their agent, around the agent's.
        means_freedom: its degrees of freedom; 0 where no agent has two trainings.
        of_settings: mean square of what is left, setting by setting.
        settings_freedom: its degrees of freedom; 0 where no agent with two trainings has two settings.
        share: of `of_settings` in `of_means`: one over the number of settings, mean over the trainings.
    """

    of_means: float = 0.0
    means_freedom: int = 0
    of_settings: float = 0.0
    settings_freedom: int = 0
    share: float = 0.0

    @property
    def is_known(self) -> bool:
        """Whether any agent has two trainings."""
        return self.means_freedom > 0

    @classmethod
    def of(cls, trainings: Iterable[Array]) -> "TrainingScatter":
        """Learn it from the trainings of each agent.

        Args:
            trainings: an agent each, ``[S, K]``: means after S trainings, at K settings. A training of which one is NaN
                is left out.

        Example:
            >>> TrainingScatter.of([np.array([[1.0], [3.0]]), np.array([[5.0], [5.0]])]).of_means
            1.0
        """
        several = [whole for values in trainings if len(whole := values[np.isfinite(values).all(1)]) > 1]
        means_freedom = sum(len(values) - 1 for values in several)
        if not means_freedom:
            return cls()
        settings_freedom = sum((len(values) - 1) * (values.shape[1] - 1) for values in several)
        of_means = of_settings = 0.0
        for values in several:
            moved = values - values.mean(0)
            together = moved.mean(1)
            of_means += (together**2).sum()
            of_settings += ((moved - together[:, None]) ** 2).sum()
        return cls(
            of_means / means_freedom,
            means_freedom,
            of_settings / max(settings_freedom, 1),
            settings_freedom,
            sum((len(values) - 1) / values.shape[1] for values in several) / means_freedom,
        )

    def error(self, sums: Iterable[tuple[Sequence[float], int]]) -> TrainingError:
        """Return the error of a sum of means.

        Args:
            sums: a part for each agent: the weights of its settings, and over how many trainings each is a mean. Parts
                are independent.

        Example:
            >>> scatter = TrainingScatter.of([np.array([[1.0, 2.0], [3.0, 4.0]])])
            >>> scatter.error([([1.0], 1)]).variance, scatter.error([([1.0, -1.0], 1)]).variance
            (2.0, 0.0)
        """
        together = own = 0.0
        for weights, trainings in sums:
            together += sum(weights) ** 2 / trainings
            own += sum(weight**2 for weight in weights) / trainings
        if self.of_means <= self.share * self.of_settings:  # nothing moves the settings together
            return _summed((own * self.of_settings, self.settings_freedom))
        return _summed(
            (together * self.of_means, self.means_freedom),
            ((own - self.share * together) * self.of_settings, self.settings_freedom),
        )


def _summed(*parts: tuple[float, float]) -> TrainingError:
    """Add variances up, each with its degrees of freedom, as Welch and Satterthwaite do; one may count negatively."""
    known = [(variance, freedom) for variance, freedom in parts if variance != 0.0]
    total = sum(variance for variance, _ in known)
    if total <= 0.0:
        return TrainingError()
    return TrainingError(total, total**2 / sum(variance**2 / freedom for variance, freedom in known))
