"""Statistics against numbers worked out by hand, and against scipy."""

import itertools

import numpy as np
import pytest
from scipy import stats

from rcdsac_trl.report import statistics
from rcdsac_trl.report.statistics import Array


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
    assert np.isnan(statistics.interquartile_mean(np.array([np.nan])))


def test_the_interquartile_mean_is_scipys_trimmed_one() -> None:
    for size in range(1, 30):
        values = np.random.default_rng(size).normal(size=size)
        assert statistics.interquartile_mean(values) == stats.trim_mean(values, 0.25)


def test_missing_values_do_not_count() -> None:
    assert statistics.mean(np.array([1.0, np.nan, 4.0])) == 2.5
    assert np.isnan(statistics.mean(np.array([np.nan, np.nan])))


# ------------------------------------------------------------------------------------------------ intervals
def test_episodes_of_one_map_are_no_independent_observations() -> None:
    """Ten equal episodes a map: as wide as Student's interval over 20 maps, not over 200 episodes."""
    maps = np.random.default_rng(1).normal(5.0, 2.0, 20)
    interval = statistics.bootstrap(np.repeat(maps, 10).reshape(1, 20, 10))
    assert interval.value == pytest.approx(maps.mean())
    expected = 2 * 2.093 * maps.std(ddof=1) / 20**0.5  # t of 19 degrees of freedom, from any table
    assert interval.high - interval.low == pytest.approx(expected, rel=0.05)


def test_means_of_all_draws_at_once_are_those_of_each(monkeypatch: pytest.MonkeyPatch) -> None:
    values = np.random.default_rng(7).normal(0.0, 1.0, (2, 5, 3))
    values[0, 1, :] = values[1, 2, 0] = np.nan
    monkeypatch.setattr(statistics, "DRAWS", 100)
    assert statistics.bootstrap(values, lambda drawn: float(np.nanmean(drawn))) == statistics.Interval(
        *(pytest.approx(number) for number in vars(statistics.bootstrap(values)).values())
    )


def crossed(
    rng: np.random.Generator, seeds: int, maps: Array, *, seed_spread: float, episode_spread: float = 0.0
) -> Array:
    """Values of seeds that met the same maps, whose effects are given: the truth is the maps' own mean, 0."""
    of_seeds = seed_spread * rng.normal(size=(seeds, 1, 1))
    return maps.reshape(1, -1, 1) + of_seeds + episode_spread * rng.normal(size=(seeds, len(maps), 1))


def test_seeds_that_met_the_same_maps_say_no_more_about_other_maps() -> None:
    """Were maps drawn anew for each seed, five equal seeds would shrink the interval by the root of five."""
    one = np.random.default_rng(2).normal(0.0, 1.0, (1, 30, 2))
    five = statistics.bootstrap(np.repeat(one, 5, axis=0))
    assert vars(five) == pytest.approx(vars(statistics.bootstrap(one)))
    other = one + np.random.default_rng(3).normal(0.0, 1.0, (1, 30, 2))
    compared = statistics.compare(np.repeat(other, 5, axis=0), np.repeat(one, 5, axis=0))
    assert vars(compared.difference) == pytest.approx(vars(statistics.compare(other, one).difference))
    assert compared.p_value == statistics.compare(other, one).p_value


def test_seeds_alone_give_students_interval() -> None:
    for seeds, t in ((2, 12.71), (3, 4.303), (5, 2.776)):  # from any table of t
        values = np.arange(float(seeds))
        interval = statistics.bootstrap(np.tile(values[:, None, None], (1, 8, 3)))
        half = t * values.std(ddof=1) / seeds**0.5
        assert interval.high - interval.value == pytest.approx(half, rel=0.02)
        assert interval.value - interval.low == pytest.approx(half, rel=0.02)


def test_what_two_settings_of_the_same_agents_share_cancels_seed_by_seed() -> None:
    rng = np.random.default_rng(4)
    second = crossed(rng, 3, rng.normal(0.0, 1.0, 12), seed_spread=50.0)
    found = statistics.compare(second + 1.0, second, same_agents=True)
    assert vars(found.difference) == pytest.approx({"value": 1.0, "low": 1.0, "high": 1.0})
    assert found.p_value < 0.01


def test_seeds_that_differ_more_than_the_agents_decide_nothing() -> None:
    rng = np.random.default_rng(5)
    maps = rng.normal(0.0, 1.0, 20)
    first = maps[None, :, None] + np.array([-5.0, 0.0, 8.0])[:, None, None]
    second = maps[None, :, None] + np.array([-3.0, 3.0])[:, None, None]
    found = statistics.compare(first, second)
    assert found.difference.value == pytest.approx(1.0)
    assert found.difference.low < -10.0 < 12.0 < found.difference.high
    assert found.p_value > 0.3
    # 0, 1 and 2 pairs of seeds are won of 6, on every map.
    assert vars(found.improvement) == pytest.approx({"value": 3 / 6, "low": 3 / 6, "high": 3 / 6})


def test_a_seed_on_which_nothing_was_measured_says_nothing_of_the_seeds() -> None:
    values = np.random.default_rng(6).normal(0.0, 1.0, (3, 10, 1))
    values[2] = np.nan
    assert statistics.bootstrap(values) == statistics.bootstrap(values[:2])


SPREADS = {"maps": (1.0, 0.0, 0.0), "seeds": (0.0, 1.0, 0.0), "both": (1.0, 0.3, 0.3)}


@pytest.mark.parametrize("seeds", [1, 2, 5])
@pytest.mark.parametrize(("of_maps", "of_seeds", "of_episodes"), SPREADS.values(), ids=SPREADS)
def test_intervals_hold_the_truth_as_often_as_they_say(
    monkeypatch: pytest.MonkeyPatch, of_maps: float, of_seeds: float, of_episodes: float, seeds: int
) -> None:
    """Of 300 draws of maps and seeds. Maps nested in seeds held it in 83 and 58 of 100, two and five seeds resampled in
    50 and 81."""
    monkeypatch.setattr(statistics, "DRAWS", 300)
    monkeypatch.setattr(statistics, "PERMUTATIONS", 300)
    if seeds == 1:
        of_seeds = 0.0  # one seed cannot tell
    rng = np.random.default_rng(8)
    held = differences_held = found = 0
    for _ in range(300):
        maps = of_maps * rng.normal(size=50)
        own = 0.5 * of_maps * rng.normal(size=50)
        first, second = (
            crossed(rng, seeds, effects, seed_spread=of_seeds, episode_spread=of_episodes)
            for effects in (maps, maps + own)
        )
        interval, compared = statistics.bootstrap(first), statistics.compare(first, second)
        held += interval.low <= 1e-9 and interval.high >= -1e-9
        differences_held += compared.difference.low <= 1e-9 and compared.difference.high >= -1e-9
        found += compared.p_value < 0.05
    assert min(held, differences_held) >= 0.91 * 300
    assert found <= 0.09 * 300


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


# ------------------------------------------------------------------------------------------------ sums of means
def test_a_sum_of_means_by_hand() -> None:
    first, second = layout([1.0, 3.0], [2.0, 2.0]), layout([0.0, 0.0], [1.0, 1.0])
    found = statistics.contrast([statistics.Term(2.0, first, "a"), statistics.Term(-1.0, second, "b")])
    assert vars(found) == pytest.approx({"value": 3.5, "low": found.low, "high": found.high})
    # By map 4 and 3, paired: a quarter of the resamples are one map twice, 0.5 from the mean, as many the other.
    # Spread by t of 1 degree of freedom over the normal's, 12.706 / 1.960, and by the root of 2 / (2 - 1): 3.5 ± 4.58.
    assert (found.low, found.high) == pytest.approx((3.5 - 4.584, 3.5 + 4.584), abs=0.001)


def test_a_map_without_a_value_is_left_out_of_a_sum() -> None:
    values = layout([1.0], [np.nan], [1.0])
    assert statistics.contrast([statistics.Term(1.0, values, "a")]) == statistics.Interval(1.0, 1.0, 1.0)
    nothing = statistics.contrast([statistics.Term(1.0, np.full((1, 3, 1), np.nan), "a")])
    assert np.isnan([nothing.value, nothing.low, nothing.high]).all()


def test_independent_trainings_know_more_of_seeds_than_one() -> None:
    """Each has seeds at 0 and 2: one gives t of 1 degree of freedom, ten give t of 10 and a tenth of the variance."""
    values = np.tile(np.array([0.0, 2.0])[:, None, None], (1, 8, 1))
    one = statistics.contrast([statistics.Term(1.0, values, "a")])
    ten = statistics.contrast([statistics.Term(0.1, values, str(number)) for number in range(10)])
    assert one.high - one.value == pytest.approx(12.71, rel=0.02)
    assert ten.high - ten.value == pytest.approx(2.228 / 10**0.5, rel=0.02)
    same = statistics.contrast([statistics.Term(0.1, values, "a") for _ in range(10)])
    assert vars(same) == pytest.approx(vars(one))


@pytest.mark.parametrize("seeds", [1, 2, 3])
@pytest.mark.parametrize(("of_maps", "of_seeds"), [(1.0, 0.0), (0.0, 1.0), (0.5, 0.5)], ids=["maps", "seeds", "both"])
def test_intervals_of_sums_hold_the_truth_as_often_as_they_say(
    monkeypatch: pytest.MonkeyPatch, of_maps: float, of_seeds: float, seeds: int
) -> None:
    """Two settings of one agent against two other agents, as the paper averages; 200 draws of 20 maps and seeds."""
    monkeypatch.setattr(statistics, "DRAWS", 200)
    monkeypatch.setattr(statistics, "PERMUTATIONS", 2)
    if seeds == 1:
        of_seeds = 0.0  # one seed cannot tell
    rng = np.random.default_rng(9)
    held = 0
    for _ in range(200):
        shared, own = rng.normal(size=20), {name: of_seeds * rng.normal(size=(seeds, 1, 1)) for name in "abc"}
        terms = [
            statistics.Term(
                weight, crossed(rng, seeds, of_maps * (shared + rng.normal(size=20)), seed_spread=0.0) + own[name], name
            )
            for weight, name in ((0.5, "a"), (0.5, "a"), (-0.5, "b"), (-0.5, "c"))
        ]
        interval = statistics.contrast(terms)
        held += interval.low <= 1e-9 and interval.high >= -1e-9
    assert held >= 0.9 * 200
