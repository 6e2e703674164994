"""Statistics against numbers worked out by hand, and against scipy."""

import itertools

import numpy as np
import pytest
from scipy import stats

from rcdsac_trl.report import statistics


def layout(*maps: list[float]) -> np.ndarray:
    """One seed, given map by map."""
    return np.array([maps], dtype=float)


def test_cvar_by_hand() -> None:
    returns = layout([10.0, 2.0, 8.0, 4.0], [6.0, 1.0, 7.0, 3.0])
    assert statistics.cvar(0.25)(returns) == 1.5  # the two lowest of eight
    assert statistics.cvar(0.125)(returns) == 1.0
    assert statistics.cvar(0.1)(returns) == pytest.approx(1.0)  # 0.8 of a value: the lowest alone
    assert statistics.cvar(1.0)(returns) == returns.mean()


def test_the_interquartile_mean_leaves_out_a_quarter_at_either_end() -> None:
    assert statistics.interquartile_mean(np.array([-1000.0, 0.0, 1.0, 2.0, 3.0, 4.0, 5.0, 1000.0])) == 2.5
    assert statistics.interquartile_mean(np.array([np.nan, 0.0, 1.0, 3.0, 9.0])) == 2.0


def test_missing_values_do_not_count() -> None:
    assert statistics.mean(np.array([1.0, np.nan, 4.0])) == 2.5
    assert np.isnan(statistics.mean(np.array([np.nan, np.nan])))


# ------------------------------------------------------------------------------------------------ intervals
def test_episodes_of_one_map_are_no_independent_observations() -> None:
    """Ten equal episodes a map: as wide as the standard error over 20 maps, not over 200 episodes."""
    maps = np.random.default_rng(1).normal(5.0, 2.0, 20)
    interval = statistics.bootstrap(np.repeat(maps, 10).reshape(1, 20, 10))
    assert interval.value == pytest.approx(maps.mean())
    expected = 2 * 1.96 * maps.std() / 20**0.5
    assert interval.high - interval.low == pytest.approx(expected, rel=0.1)


def test_means_of_all_draws_at_once_are_those_of_each(monkeypatch: pytest.MonkeyPatch) -> None:
    values = np.random.default_rng(7).normal(0.0, 1.0, (2, 5, 3))
    values[0, 1, :] = values[1, 2, 0] = np.nan
    monkeypatch.setattr(statistics, "DRAWS", 100)
    assert statistics.bootstrap(values, lambda drawn: float(np.nanmean(drawn))) == statistics.Interval(
        *(pytest.approx(number) for number in vars(statistics.bootstrap(values)).values())
    )


def test_seeds_that_differ_widen_the_interval() -> None:
    maps = np.random.default_rng(2).normal(0.0, 1.0, (1, 30, 1))
    alike = statistics.bootstrap(np.concatenate([maps, maps, maps]))
    apart = statistics.bootstrap(np.concatenate([maps - 5.0, maps, maps + 5.0]))
    assert apart.high - apart.low > 5 * (alike.high - alike.low)


def test_intervals_hold_the_truth_about_as_often_as_they_say(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(statistics, "DRAWS", 200)
    rng = np.random.default_rng(3)
    held = 0
    for _ in range(120):
        interval = statistics.bootstrap(rng.normal(1.0, 1.0, (1, 40, 1)))
        held += interval.low <= 1.0 <= interval.high
    assert 0.89 <= held / 120 <= 0.995


# ------------------------------------------------------------------------------------------------ pairs
def test_a_comparison_by_hand() -> None:
    first = layout([1.0, 3.0], [2.0, 2.0], [0.0, 4.0])
    second = layout([1.0, 1.0], [2.0, 5.0], [1.0, 2.0])
    found = statistics.compare(first, second)
    assert found.difference.value == pytest.approx((1.0 - 1.5 + 0.5) / 3)
    # Pairs of a map: (1,1) tie twice, (3,1) twice | ties 2, losses 2 | 0 loses twice, 4 wins twice.
    assert found.improvement.value == pytest.approx((3 / 4 + 1 / 4 + 2 / 4) / 3)
    assert found.p_value == 1.0  # no difference: every sign is as extreme


def test_improvement_is_the_mann_whitney_statistic_of_each_map() -> None:
    rng = np.random.default_rng(4)
    first, second = rng.integers(0, 4, (1, 5, 8)).astype(float), rng.integers(0, 4, (1, 5, 6)).astype(float)
    expected = [stats.mannwhitneyu(first[0, m], second[0, m]).statistic / 48 for m in range(5)]
    assert statistics.compare(first, second).improvement.value == pytest.approx(np.mean(expected))


def test_the_p_value_is_that_of_all_sign_permutations() -> None:
    rng = np.random.default_rng(5)
    first, second = rng.normal(0.7, 1.0, (1, 10, 1)), np.zeros((1, 10, 1))
    signs = np.array(list(itertools.product([-1.0, 1.0], repeat=10)))
    exact = (np.abs(signs @ first[0, :, 0]) >= abs(first.sum()) - 1e-9).mean()
    assert statistics.compare(first, second).p_value == pytest.approx(exact, abs=0.01)


def test_holm_by_hand() -> None:
    # 3 x 0.01; then 2 x 0.02; then 0.5, each at least the one before
    assert statistics.holm([0.5, 0.01, 0.02]) == [0.5, 0.03, 0.04]
    assert statistics.holm([0.4, 0.9]) == [0.8, 0.9]
    assert statistics.holm([]) == []


# ------------------------------------------------------------------------------------------------ trends
def test_the_trend_is_pages_test() -> None:
    values = np.random.default_rng(6).normal(0.0, 1.0, (12, 4)) + 0.35 * np.arange(4)
    found = statistics.trend(values)
    rising = stats.page_trend_test(values).pvalue
    assert found.p_value == pytest.approx(2 * rising, rel=0.15)
    expected = [stats.spearmanr(np.arange(4), row).statistic for row in values]
    assert found.correlation == pytest.approx(np.mean(expected))


def test_a_trend_either_way_is_found_and_none_is_not() -> None:
    rising = np.arange(4.0) + np.zeros((10, 1))
    assert statistics.trend(rising).correlation == pytest.approx(1.0)
    assert statistics.trend(-rising).correlation == pytest.approx(-1.0)
    assert statistics.trend(rising).p_value == statistics.trend(-rising).p_value == 1 / (statistics.PERMUTATIONS + 1)
    flat = statistics.trend(np.zeros((10, 4)))
    assert (flat.correlation, flat.p_value) == (0.0, 1.0)


def test_a_map_without_a_value_says_nothing_about_the_trend() -> None:
    values = np.array([[0.0, 1.0, 2.0], [3.0, np.nan, 1.0]])
    assert statistics.trend(values).correlation == pytest.approx(1.0)


def test_what_was_never_measured_has_no_interval() -> None:
    interval = statistics.bootstrap(np.full((1, 3, 2), np.nan))
    assert np.isnan([interval.value, interval.low, interval.high]).all()
