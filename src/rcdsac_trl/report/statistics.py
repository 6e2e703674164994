"""Statistics of episodes. The map is the unit: its episodes share walls, clutter and difficulty, so they are not so
many independent observations.

Values come as arrays ``[S, M, E]``: training seeds, maps, episodes on a map.
"""

from collections.abc import Callable
from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray
from scipy import stats

Array = NDArray[np.float64]
Statistic = Callable[[Array], float]

CONFIDENCE = 0.95
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


def interquartile_mean(values: Array) -> float:
    """Return the mean of the middle half (Agarwal et al., 2021): less noisy than the median, robust to disasters.

    Example:
        >>> interquartile_mean(np.array([0.0, 1.0, 3.0, 1000.0]))
        2.0
    """
    return float(stats.trim_mean(values[np.isfinite(values)], 0.25))


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


def cvar(share: float) -> Statistic:
    """Return the statistic "mean of the worst share of all episodes" of a return: realised CVaR.

    Example:
        >>> cvar(0.25)(np.arange(8.0))
        0.5
    """
    return lambda values: float(lower_mean(values.reshape(1, -1), share)[0])


def bootstrap(values: Array, statistic: Statistic = mean) -> Interval:
    """Return a statistic of all episodes and its percentile interval.

    Levels are resampled from the outside in: training seeds, where there are several, then maps within each seed; the
    episodes of a map stay together.

    Args:
        values: ``[S, M, E]``.
        statistic: of an array of any shape.
    """
    rng = np.random.default_rng(_SEED)
    seeds, maps, _ = values.shape
    seed = rng.integers(seeds, size=(DRAWS, seeds, 1))
    map_ = rng.integers(maps, size=(DRAWS, seeds, maps))
    if statistic is mean:  # of all draws at once, from the sums of maps
        counts, sums = np.isfinite(values).sum(2), np.nansum(values, 2)
        totals = counts[seed, map_].sum((1, 2))
        drawn = np.divide(sums[seed, map_].sum((1, 2)), totals, out=np.full(DRAWS, np.nan), where=totals > 0)
    else:
        drawn = np.array([statistic(values[seed[i], map_[i]]) for i in range(DRAWS)])
    return _interval(statistic(values), drawn)


def compare(first: Array, second: Array) -> Comparison:
    """Compare two sets of episodes on the same maps.

    Intervals resample maps, for both sides at once. The test permutes, map by map, which side is which (the mean of
    a map over seeds and episodes is one observation): exact, and without an assumption about the distribution.

    Args:
        first: ``[S, M, E]``.
        second: ``[S', M, E]``, the same maps, starts and goals.
    """
    differences = np.nanmean(first, axis=(0, 2)) - np.nanmean(second, axis=(0, 2))
    improvements = _improvements(first, second)
    chosen, signs = _resamples(len(differences), DRAWS, PERMUTATIONS)
    as_extreme = np.abs(signs @ differences) >= abs(differences.sum()) - 1e-9
    return Comparison(
        difference=_interval(differences.mean(), differences[chosen].mean(1)),
        improvement=_interval(improvements.mean(), improvements[chosen].mean(1)),
        p_value=_p_value(as_extreme),
    )


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


def _improvements(first: Array, second: Array) -> Array:
    """Return, for each map, the share of pairs of episodes in which the first is larger: [M]."""
    a, b = (np.moveaxis(values, 1, 0).reshape(values.shape[1], -1) for values in (first, second))
    pairs = a[:, :, None] - b[:, None, :]
    return ((pairs > 0) + 0.5 * (pairs == 0)).mean((1, 2))


def _interval(value: float, drawn: Array) -> Interval:
    if np.isnan(drawn).all():  # nobody ever measured it, such as a time to goals that none reached
        return Interval(float("nan"), float("nan"), float("nan"))
    low, high = np.nanquantile(drawn, [(1 - CONFIDENCE) / 2, (1 + CONFIDENCE) / 2])
    return Interval(float(value), float(low), float(high))


def _p_value(as_extreme: NDArray[np.bool_]) -> float:
    """Count what was observed as one of the permutations, so that no p-value is 0."""
    return float((1 + as_extreme.sum()) / (1 + len(as_extreme)))
