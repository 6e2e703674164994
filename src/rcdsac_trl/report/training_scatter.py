"""How far trainings of one recipe lie apart, learnt from all agents together.

Trainings are dear, so an agent has one, two or three. Two of one agent hardly say how the next would differ: Student's
t with one degree of freedom is 12.7. The trainings of all agents together do. So they are pooled, as the residual of an
analysis of variance is: trainings of every agent are taken to scatter alike. An agent with a single training then has
an interval that covers other trainings, too.

What a training moves, it may move at all settings of its agent, along them, or at each for itself. Nothing is assumed
of that: of a sum of means over settings, such as a difference between two, that very sum scatters from training to
training, in each agent that has several and as many settings. Both hold the noise of the episodes, which the maps of a
resample hold, too: intervals are too wide rather than too narrow.
"""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray
from scipy import stats

Array = NDArray[np.float64]

_SEED = 1
_APART = 0.001
"""An agent that scatters more than the others by chance this rarely is not pooled with them."""


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
        total = self.variance + other.variance
        if total == 0.0:
            return TrainingError()
        return TrainingError(total, total**2 / (self.variance**2 / self.freedom + other.variance**2 / other.freedom))

    def draw(self, number: int) -> Array:
        """Draw so many errors: quantiles of Student's t, evenly, so that its far tails do not depend on luck.

        Example:
            >>> sorted(TrainingError(4.0, 1.0).draw(5).round(2).tolist())
            [-6.16, -1.45, 0.0, 1.45, 6.16]
        """
        if self.variance == 0.0:
            return np.zeros(number)
        return _errors_of_one(self.freedom, number) * float(self.variance) ** 0.5


# A report asks thousands of times, for a few degrees of freedom.
@lru_cache(maxsize=32)
def _errors_of_one(freedom: float, number: int) -> Array:
    """Draw errors of variance 1, in an order that is independent of the maps drawn."""
    t = stats.t.ppf((np.arange(number) + 0.5) / number, freedom)
    drawn: Array = np.random.default_rng([0, _SEED]).permutation(t)
    return drawn


class TrainingScatter:
    """How far trainings lie apart, pooled over agents.

    Args:
        agents: an agent each, ``[S, K]``: means after S trainings, at K settings in their order. NaN is a setting at
            which that training was not measured.

    Attributes:
        apart: numbers of the agents whose trainings for sure lie farther apart than the others' (an F test, p < 0.001):
            they are not pooled, and their own trainings alone count for them.

    Example:
        >>> scatter = TrainingScatter([np.array([[1.0, 2.0], [3.0, 4.0]]), np.array([[5.0]])])
        >>> scatter.error([(1, {0: 1.0})])  # the one training of the second agent
        TrainingError(variance=2.0, freedom=1)
        >>> scatter.error([(0, {0: 1.0, 1: -1.0})]).variance  # what a training of the first moves at both, cancels
        0.0
    """

    def __init__(self, agents: Sequence[Array]) -> None:
        self._agents = list(agents)
        self._spreads = [_spread(values, [1.0]) for values in agents]
        self.apart: frozenset[int] = frozenset()
        while (farthest := self._farthest_apart()) is not None:
            self.apart |= {farthest}

    @property
    def is_known(self) -> bool:
        """Whether any agent has two trainings."""
        return any(freedom for _, freedom in self._spreads)

    def spread(self, agent: int) -> tuple[float, int]:
        """Return the variance of one setting from training to training by an agent's own, and its freedom."""
        return self._spreads[agent]

    def pooled(self, but: int | None = None) -> tuple[float, int]:
        """Return the same of all agents that are pooled, but for one."""
        return _pooled(self._spreads[number] for number in self._pool(but))

    def error(self, trainings: Iterable[tuple[int, Mapping[int, float]]]) -> TrainingError:
        """Return the error of a sum of means.

        Args:
            trainings: for each that takes part the number of its agent, and the weights of the settings at which it
                was measured, by their numbers.
        """
        variance, freedom = 0.0, float("inf")
        for agent, weights in trainings:
            of_training, known_with = self._variance(agent, dict(sorted(weights.items())))
            if known_with:
                # Parts are learnt from the same trainings: together they are known no better than the worst.
                variance, freedom = variance + of_training, min(freedom, known_with)
        return TrainingError(variance, freedom) if variance else TrainingError()

    def _variance(self, agent: int, weights: Mapping[int, float]) -> tuple[float, int]:
        """Return the variance of a sum over settings of one agent from training to training, and its freedom."""
        of_sum = list(weights.values())
        others = [] if agent in self.apart else self._pool(agent)
        if len(of_sum) > 1:
            own = _spread(self._agents[agent][:, list(weights)], of_sum)
            variance, freedom = _pooled([own, *(_spread(self._agents[number], of_sum) for number in others)])
            if freedom:
                return variance, freedom
        # Also where no agent with two trainings has so many settings: more than if all moved together it cannot be.
        of_one, freedom = _pooled(self._spreads[number] for number in (agent, *others))
        return of_one * sum(map(abs, of_sum)) ** 2, freedom

    def _pool(self, but: int | None = None) -> list[int]:
        return [number for number in range(len(self._agents)) if number not in self.apart and number != but]

    def _farthest_apart(self) -> int | None:
        """Return the agent that scatters most among those pooled, if that is no chance."""
        found: list[tuple[float, int]] = []
        for number in self._pool():
            (own, own_freedom), (others, others_freedom) = self.spread(number), self.pooled(number)
            if own_freedom and others_freedom and others > 0.0:
                found.append((float(stats.f.sf(own / others, own_freedom, others_freedom)), number))
        p_value, number = min(found, default=(1.0, 0))
        return number if p_value < _APART else None


def _spread(values: Array, weights: Sequence[float]) -> tuple[float, int]:
    """Return the variance of a weighted sum over settings from training to training, and its degrees of freedom.

    Of more settings the sum is over as many of them, evenly. One weight is at any setting: the mean over all of them
    counts. Of too few settings, and of one training, nothing is known.
    """
    settings = values.shape[1]
    if len(weights) == 1:
        sums = list(weights[0] * values.T)
    elif settings >= len(weights):
        sums = [values[:, np.linspace(0, settings - 1, len(weights)).round().astype(int)] @ np.array(weights)]
    else:
        return 0.0, 0
    measured = [finite for each in sums if len(finite := each[np.isfinite(each)]) > 1]
    if not measured:
        return 0.0, 0
    # Settings of one training go together: they are not so many independent ones.
    return float(np.mean([each.var(ddof=1) for each in measured])), max(len(each) - 1 for each in measured)


def _pooled(spreads: Iterable[tuple[float, int]]) -> tuple[float, int]:
    """Return the mean square of several variances, and its degrees of freedom."""
    known = [(variance, freedom) for variance, freedom in spreads if freedom]
    total = sum(freedom for _, freedom in known)
    return (sum(variance * freedom for variance, freedom in known) / total if total else 0.0), total
