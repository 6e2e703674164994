"""Statistics of episodes. The map is the unit: its episodes share walls, clutter and difficulty, so they are not so
many independent observations.

Values come as arrays ``[S, M, E]``: training seeds, maps, episodes on a map. Seeds and maps are crossed, not nested:
the agents of all seeds met the same maps. So a resample draws its maps once, for all seeds. The seeds themselves are
few, and resampling few values gives intervals that are too narrow (95 % intervals of two seeds hold the truth half of
the time): what seeds add to an error is taken from Student's t distribution. How far they lie apart is pooled over
agents: over all of a report where it gives the error (:mod:`rcdsac_trl.report.training_errors`), else over those that
are compared.
"""

from collections import defaultdict
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cache, lru_cache

import numpy as np
from numpy.typing import NDArray
from scipy import stats

from rcdsac_trl.report.training_scatter import Array, TrainingError, TrainingScatter

Statistic = Callable[[Array], float]

CONFIDENCE = 0.95
CONFIDENCE_TEXT = f"{100 * CONFIDENCE:.0f} %"
"""How it is written."""
_BOUNDS = (1 - CONFIDENCE) / 2, (1 + CONFIDENCE) / 2
DRAWS = 2000
"""Resamples of an interval."""
PERMUTATIONS = 20_000
"""Permutations of a test: its smallest p-value is 1 / 20,001."""
_SEED = 0


@dataclass(frozen=True)
class Interval:
    """A value with its confidence interval."""

    value: float
    low: float
    high: float

    def within(self, lowest: float, highest: float) -> "Interval":
        """Leave out what cannot be: few seeds can make an interval of collisions begin below zero.

        Example:
            >>> Interval(0.5, -0.2, 1.2).within(0.0, 9.9)
            Interval(value=0.5, low=0.0, high=1.2)
        """
        return Interval(self.value, max(self.low, lowest), min(self.high, highest))


@dataclass(frozen=True)
class Comparison:
    """One set of episodes against another on the same maps.

    Attributes:
        difference: mean of the first less that of the second.
        improvement: probability that an episode of the first has the larger value than one of the second on the same
            map, ties counting one half.
        p_value: of a difference this large, either way, if there is none.
    """

    difference: Interval
    improvement: Interval
    p_value: float


@dataclass(frozen=True)
class Trend:
    """How a metric goes with an ordered setting.

    Attributes:
        correlation: Spearman's rank correlation with the setting, mean over the maps; 1 rises on every map.
        p_value: of a trend this strong, either way, if there is none.
    """

    correlation: float
    p_value: float


def mean(values: Array) -> float:
    """Return the mean of what was measured."""
    return float(np.nanmean(values)) if np.isfinite(values).any() else float("nan")


def mean_over(values: Array, axis: tuple[int, ...]) -> Array:
    """Return the mean over some axes of what was measured, NaN where nothing was."""
    measured = np.isfinite(values).sum(axis)
    sums = np.nansum(values, axis)
    return np.divide(sums, measured, out=np.full(sums.shape, np.nan), where=measured > 0)


def of_these_agents(values: Array) -> Array:
    """Put the episodes of all training seeds together as one agent's: intervals then speak of these agents alone.

    Args:
        values: ``[S, M, E]``.

    Returns:
        ``[1, M, S E]``.

    Example:
        >>> of_these_agents(np.array([[[1.0], [2.0]], [[3.0], [4.0]]])).tolist()
        [[[1.0, 3.0], [2.0, 4.0]]]
    """
    return np.moveaxis(values, 0, 1).reshape(1, values.shape[1], -1)


def interquartile_mean(values: Array) -> float:
    """Return the mean of the middle half (Agarwal et al., 2021): less noisy than the median, robust to disasters.

    Example:
        >>> interquartile_mean(np.array([0.0, 1.0, 3.0, 1000.0]))
        2.0
    """
    measured = values[np.isfinite(values)]
    if not measured.size:
        return float("nan")
    cut = measured.size // 4
    # SciPy's `trim_mean`, to the bit, without the checks that take it twenty times as long: thousands of resamples ask.
    return float(np.partition(measured, (cut, measured.size - cut - 1))[cut : measured.size - cut].mean())


def lower_mean(values: Array, share: float) -> Array:
    """Return the mean of the lowest share of each row, of which the last value may count in part.

    Args:
        values: ``[G, M]``.
        share: above 0, at most 1.

    Example:
        >>> lower_mean(np.array([[4.0, 1.0, 2.0, 3.0]]), 0.375)  # 1, and half of 2
        array([1.33333333])
    """
    ordered = np.sort(values, axis=1)
    counted = np.clip(share * values.shape[1] - np.arange(values.shape[1]), 0.0, 1.0)
    return ordered @ counted / counted.sum()


@cache
def cvar(share: float) -> Statistic:
    """Return the statistic "mean of the worst share of all episodes" of a return: realised CVaR. One a share.

    Example:
        >>> cvar(0.25)(np.arange(8.0))
        0.5
    """
    return lambda values: float(lower_mean(values.reshape(1, -1), share)[0])


def bootstrap(values: Array, statistic: Statistic = mean, error: TrainingError | None = None) -> Interval:
    """Return a statistic of all episodes and its confidence interval.

    Resamples draw maps, the same ones for all training seeds; the episodes of a map stay together. Each also gets an
    error that other trainings would bring: with one the interval speaks of the recipe, else of the one agent. Its
    bounds are percentiles of the resamples.

    Args:
        values: ``[S, M, E]``.
        statistic: of an array of any shape.
        error: of the statistic; None: what these seeds say of it, and one seed says nothing.
    """
    chosen, _ = _resamples(values.shape[1], DRAWS, PERMUTATIONS)
    if statistic is mean:  # of all draws at once, from the sums of maps
        counts, sums = np.isfinite(values).sum((0, 2)), np.nansum(values, (0, 2))
        totals = counts[chosen].sum(1)
        drawn = np.divide(sums[chosen].sum(1), totals, out=np.full(DRAWS, np.nan), where=totals > 0)
    else:
        drawn = np.array([statistic(values[:, maps]) for maps in chosen])
    value = statistic(values)
    if error is None:
        of_seeds = np.array([[statistic(of_seed)] for of_seed in values])
        error = _own_error([([1.0], of_seeds)])
    return _interval(value, _widened(drawn, value, values.shape[1]) + error.draw(DRAWS))


def bootstrap_maps(values: Array, statistic: Callable[[Array], Array]) -> tuple[Array, Array, Array]:
    """Return a statistic that is an array, such as a table, and the bounds of its confidence intervals.

    Every resample of the maps serves the whole array, so differences inside it are paired.

    Args:
        values: ``[M, ..]``, of one agent.
        statistic: of as many maps, some of them drawn twice.

    Example:
        >>> value, low, high = bootstrap_maps(np.array([[0.0], [0.0], [6.0]]), lambda maps: maps.mean(0))
        >>> value.item(), low.item(), high.item()
        (2.0, 0.0, 6.0)
    """
    chosen, _ = _resamples(len(values), DRAWS, PERMUTATIONS)
    low, high = np.quantile([statistic(values[maps]) for maps in chosen], _BOUNDS, axis=0)
    return statistic(values), low, high


def compare(
    first: Array, second: Array, *, same_agents: bool = False, error: TrainingError | None = None
) -> Comparison:
    """Compare two sets of episodes on the same maps.

    Intervals resample maps, for both sides and all seeds at once. The test permutes, map by map, which side is which
    (the mean of a map over seeds and episodes is one observation): exact, and without an assumption about the
    distribution. Every resample and permutation also gets an error that other trainings would bring. Of two settings
    of the same agents what they have in common cancels. The improvement's interval is over maps alone.

    Args:
        first: ``[S, M, E]``.
        second: ``[S', M, E]``, the same maps, starts and goals.
        same_agents: whether both sides were driven by the same agents, in one order; else they are independent.
        error: of the difference; None: what these seeds say of it.
    """
    differences = np.nanmean(first, axis=(0, 2)) - np.nanmean(second, axis=(0, 2))
    maps = len(differences)
    chosen, signs = _resamples(maps, DRAWS, PERMUTATIONS)
    if error is None:
        names = ("both", "both") if same_agents else ("first", "second")
        error = _own_error(_seeds_of([Term(1.0, first, names[0]), Term(-1.0, second, names[1])]))
    drawn = _widened(differences[chosen].mean(1), differences.mean(), maps) + error.draw(DRAWS)
    permuted = signs @ differences + maps * error.draw(PERMUTATIONS)
    improvements = _improvements(first, second)
    improved = _widened(improvements.mean((0, 1))[chosen].mean(1), improvements.mean(), maps)
    return Comparison(
        difference=_interval(differences.mean(), drawn),
        improvement=_interval(improvements.mean(), np.clip(improved, 0.0, 1.0)),
        p_value=_p_value(np.abs(permuted) >= abs(differences.sum()) - 1e-9),
    )


@dataclass(frozen=True)
class Term:
    """A part of a sum of means.

    Attributes:
        weight: what the mean counts in the sum; -1 takes it off.
        values: ``[S, M, E]``.
        training: names the agents that drove; terms of one name were driven by the same ones, in one order of seeds.
    """

    weight: float
    values: Array
    training: str


def contrast(terms: Sequence[Term], confidence: float = CONFIDENCE, error: TrainingError | None = None) -> Interval:
    """Return a weighted sum of means over the same maps, and its interval with maps and training seeds crossed.

    Every resample draws its maps once, for all terms and all seeds. What other trainings would bring is common to the
    terms of one training, and independent from one training to another.

    Args:
        terms: at least one, all with the same maps.
        confidence: of the interval.
        error: of the sum; None: what these seeds say of it, all of them together.

    Returns:
        Bounds are NaN where one map was driven.

    Example:
        >>> averse, bold = np.array([[[0.0], [2.0]]]), np.array([[[1.0], [3.0]]])
        >>> contrast([Term(1.0, averse, "a"), Term(-1.0, bold, "a")])
        Interval(value=-1.0, low=-1.0, high=-1.0)
    """
    by_map = np.sum([term.weight * mean_over(term.values, (0, 2)) for term in terms], axis=0)
    by_map = by_map[np.isfinite(by_map)]  # a map on which a term was never measured says nothing
    if not len(by_map):
        return Interval(float("nan"), float("nan"), float("nan"))
    if len(by_map) < 2:  # of how others differ, one map says nothing
        return Interval(float(by_map.mean()), float("nan"), float("nan"))
    chosen, _ = _resamples(len(by_map), DRAWS, PERMUTATIONS)
    value = by_map.mean()
    error = _own_error(_seeds_of(terms)) if error is None else error
    drawn = _widened(by_map[chosen].mean(1), value, len(by_map)) + error.draw(DRAWS)
    return _interval(value, drawn, confidence)


def trend(values: Array) -> Trend:
    r"""Test whether a metric rises or falls with an ordered setting.

    Page's test, made for this layout: maps are blocks, each measured at every setting, and the alternative is an order.
    It uses the ranks within a map, so one disastrous map weighs no more than another. Its statistic
    :math:`L = \sum_j j R_j` is compared with that of ranks permuted within the maps instead of its table, because equal
    counts of collisions tie.

    Args:
        values: ``[M, K]``, mean of each map at each of K settings in ascending order.

    Example:
        >>> trend(np.array([[0.0, 1.0, 2.0], [5.0, 6.0, 9.0], [1.0, 2.0, 3.0], [0.0, 2.0, 4.0]])).correlation
        1.0
    """
    rng = np.random.default_rng(_SEED)
    # A map on which nothing was measured at some setting says nothing about the order.
    values = values[np.isfinite(values).all(1)]
    maps, settings = values.shape
    centred = stats.rankdata(values, axis=1) - (settings + 1) / 2
    order = np.arange(settings) - (settings - 1) / 2
    observed = (centred @ order).sum()
    permuted = rng.permuted(np.tile(centred, (PERMUTATIONS, 1, 1)), axis=2) @ order
    norms = np.sqrt((centred**2).sum(1) * (order**2).sum())
    correlations = np.divide(centred @ order, norms, out=np.zeros(maps), where=norms > 0)
    return Trend(
        correlation=float(correlations.mean()) if maps else float("nan"),
        p_value=_p_value(np.abs(permuted.sum(1)) >= abs(observed) - 1e-9),
    )


def holm(p_values: list[float]) -> list[float]:
    """Adjust p-values for so many comparisons (Holm, 1979): the chance of any false finding stays what it says.

    Example:
        >>> holm([0.01, 0.04, 0.03])
        [0.03, 0.06, 0.06]
    """
    adjusted = [0.0] * len(p_values)
    largest = 0.0
    for rank, i in enumerate(np.argsort(p_values, kind="stable")):
        largest = max(largest, min(1.0, (len(p_values) - rank) * p_values[i]))
        adjusted[i] = largest
    return adjusted


@lru_cache(maxsize=4)
def _resamples(maps: int, draws: int, permutations: int) -> tuple[NDArray[np.int64], Array]:
    """Draw maps ``[draws, maps]`` and signs ``[permutations, maps]``: the same for every pair of a report."""
    rng = np.random.default_rng(_SEED)
    return rng.integers(maps, size=(draws, maps)), rng.choice([-1.0, 1.0], size=(permutations, maps))


def _widened(drawn: Array, value: float, maps: int) -> Array:
    """Spread resamples of few maps as far as Student's t says: as they fall they are too near to each other.

    Their deviations are those of maps drawn from a handful (the root of n / (n - 1) too small), and their distribution
    is as good as normal (t wider than it). One map says nothing of others: its resamples stay what they are.
    """
    if maps < 2:
        return drawn
    factor = stats.t.ppf(_BOUNDS[1], maps - 1) / stats.norm.ppf(_BOUNDS[1]) * (maps / (maps - 1)) ** 0.5
    widened: Array = value + factor * (drawn - value)
    return widened


def _seeds_of(terms: Sequence[Term]) -> list[tuple[list[float], Array]]:
    """Return for each independent training the weights of its terms, and their means seed by seed, ``[S, K]``."""
    # A setting that fewer seeds were driven at is apart from the others of its agent: whose they are is not known.
    parts: defaultdict[tuple[str, int], list[Term]] = defaultdict(list)
    for term in terms:
        parts[term.training, len(term.values)].append(term)
    return [
        ([term.weight for term in part], np.stack([mean_over(term.values, (1, 2)) for term in part], axis=1))
        for part in parts.values()
    ]


def _own_error(seeds: Sequence[tuple[list[float], Array]]) -> TrainingError:
    """Return the error of a sum of means by what its own seeds say."""
    scatter = TrainingScatter([of_seeds for _, of_seeds in seeds])
    trainings = []
    for number, (weights, of_seeds) in enumerate(seeds):
        if measured := int(np.isfinite(of_seeds).all(1).sum()):
            trainings += [(number, {place: weight / measured for place, weight in enumerate(weights)})] * measured
    return scatter.error(trainings)


def _improvements(first: Array, second: Array) -> Array:
    """Return the share of pairs of episodes in which the first is larger, ``[S, S', M]``: of two seeds on a map."""
    pairs = first[:, None, :, :, None] - second[None, :, :, None, :]
    return ((pairs > 0) + 0.5 * (pairs == 0)).mean((3, 4))


def _interval(value: float, drawn: Array, confidence: float = CONFIDENCE) -> Interval:
    if np.isnan(drawn).all():  # nobody ever measured it, such as a time to goals that none reached
        return Interval(float("nan"), float("nan"), float("nan"))
    low, high = np.nanquantile(drawn, ((1 - confidence) / 2, (1 + confidence) / 2))
    return Interval(float(value), float(low), float(high))


def _p_value(as_extreme: NDArray[np.bool_]) -> float:
    """Count what was observed as one of the permutations, so that no p-value is 0."""
    return float((1 + as_extreme.sum()) / (1 + len(as_extreme)))
