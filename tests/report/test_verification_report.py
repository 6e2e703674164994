"""Do cards hold: the test against SciPy's, how often true cards are refuted, and how often wrong ones."""

import math

import numpy as np
import pytest
from scipy import stats

from rcdsac_trl.report.statistics import Array, Interval, bootstrap
from rcdsac_trl.report.verification_report import agreement, compared, with_verdicts


def interval(mean: float, standard_error: float, maps: int) -> Interval:
    """Return the interval that so many maps give on the mean: Student's."""
    half_width = stats.t.ppf(0.975, maps - 1) * standard_error
    return Interval(mean, mean - half_width, mean + half_width)


def test_it_is_welch_s_test() -> None:
    for mean, error, maps in ((1.3, 0.2, 20), (0.9, 0.15, 40), (1.0, 0.4, 8)):
        found = agreement(interval(1.0, 0.1, 50), 50, interval(mean, error, maps), maps)
        expected = stats.ttest_ind_from_stats(
            1.0, 0.1 * math.sqrt(50), 50, mean, error * math.sqrt(maps), maps, equal_var=False
        )
        assert found == pytest.approx(expected.pvalue)


def test_few_maps_without_a_collision_are_not_surer_than_the_card() -> None:
    card = interval(0.4, 0.1, 50)
    of_ten_maps = 0.1 * math.sqrt(50 / 10)
    found = agreement(card, 50, Interval(0.0, 0.0, 0.0), 10)
    assert found == pytest.approx(agreement(card, 50, interval(0.0, of_ten_maps, 10), 10))
    assert found > 0.05
    assert agreement(Interval(0.0, 0.0, 0.0), 50, Interval(0.0, 0.0, 0.0), 10) == 1.0
    assert agreement(Interval(0.0, 0.0, 0.0), 50, Interval(0.1, 0.1, 0.1), 10) == 0.0


BETAS = (-2.0, -1.5, -1.0, -0.5)


def episodes(rng: np.random.Generator, maps: int, number: int, worse: float = 1.0) -> dict[float, dict[str, Array]]:
    """Drive an agent of which everything is known: maps are easy or hard, for all betas alike; collisions are rare."""
    hardness = rng.gamma(1.5, 1 / 1.5, maps)
    driven = {}
    for beta, rate in zip(BETAS, (0.4, 0.5, 0.6, 0.8), strict=True):
        collisions = rng.poisson(worse * rate * hardness[:, None], (maps, number)).astype(float)
        reward = 540.0 - 40.0 * hardness[:, None] - 10.0 * collisions + rng.normal(0.0, 90.0, (maps, number))
        driven[beta] = {"collisions": collisions, "reward": reward}
    return driven


def of_maps(values: Array) -> dict[str, float]:
    """Return mean and interval, the quick way: a bootstrap's is nearly this one."""
    found = interval(values.mean(), values.mean(1).std(ddof=1) / math.sqrt(len(values)), len(values))
    return {"mean": found.value, "low": found.low, "high": found.high}


def test_the_quick_interval_is_nearly_a_bootstrap_s() -> None:
    values = episodes(np.random.default_rng(2), 50, 10)[-2.0]["collisions"]
    quick, slow = of_maps(values), bootstrap(values[None])
    assert quick["mean"] == pytest.approx(slow.value)
    assert quick["high"] - quick["low"] == pytest.approx(slow.high - slow.low, rel=0.05)


def said(driven: dict[float, dict[str, Array]], maps: int) -> dict:
    """Return the entries of `measured.json` that are looked at."""
    conditions = [
        {
            "label": f"β = {beta:g}",
            "beta": beta,
            "collision_weight": None,
            "metrics": {metric: of_maps(values) for metric, values in metrics.items()},
        }
        for beta, metrics in driven.items()
    ]
    return {"conditions": conditions, "protocol": {"num_maps": maps}}


def refuted(rng: np.random.Generator, maps: int, number: int, worse: float = 1.0) -> bool:
    """Check a card of 50 maps x 10 on so many maps and episodes."""
    card, again = said(episodes(rng, 50, 10), 50), said(episodes(rng, maps, number, worse), maps)
    return not with_verdicts(compared("agent", card, again))["holds"].all()


@pytest.mark.parametrize(("maps", "number"), [(10, 2), (30, 4)])
def test_a_true_card_is_refuted_in_at_most_one_call_in_twenty(maps: int, number: int) -> None:
    rng = np.random.default_rng(0)
    calls = 150
    # Of a rate of one in twenty, more than this come about once in a hundred times.
    assert sum(refuted(rng, maps, number) for _ in range(calls)) <= stats.binom.ppf(0.99, calls, 0.05)


def test_a_card_that_claims_a_third_of_the_collisions_is_refuted() -> None:
    rng = np.random.default_rng(1)
    assert sum(refuted(rng, 30, 4, worse=3.0) for _ in range(40)) >= 36


def test_many_numbers_are_judged_together() -> None:
    rows = [{"p_value": p} for p in (0.03, 0.5, 0.9)]
    assert with_verdicts(rows[:1])["holds"].tolist() == [False]
    assert with_verdicts(rows)["holds"].tolist() == [True, True, True]
    assert with_verdicts(rows)["p_value"].tolist() == pytest.approx([0.09, 1.0, 1.0])
