"""How far trainings lie apart: mean squares and errors by hand, coverage by simulation, what reports make of it."""

import numpy as np
import pandas as pd
import pytest
from scipy import stats

from rcdsac_trl.report import findings, statistics
from rcdsac_trl.report.claims import judged_claims
from rcdsac_trl.report.read import Episodes
from rcdsac_trl.report.rows import paper_table
from rcdsac_trl.report.table import own_table
from rcdsac_trl.report.training_errors import TrainingErrors
from rcdsac_trl.report.training_scatter import Array, TrainingError, TrainingScatter
from rcdsac_trl.report.verdict_words import over
from rcdsac_trl.report.verdicts import Verdict

TWO_SETTINGS = np.array([[1.0, 2.0], [3.0, 8.0]])
"""After two trainings: variances 2 and 18, of the difference 8."""
THREE_TRAININGS = np.array([[0.0], [3.0], [6.0]])
"""Variance 9."""


# ------------------------------------------------------------------------------------------------ by hand
def test_variances_by_hand() -> None:
    scatter = TrainingScatter([TWO_SETTINGS, THREE_TRAININGS, np.array([[7.0]])])
    assert scatter.spread(0) == (10.0, 1)  # the mean over both settings
    assert scatter.pooled() == (pytest.approx((10.0 + 2 * 9.0) / 3), 3)
    assert scatter.pooled(but=1) == (10.0, 1)
    assert scatter.spread(2) == (0.0, 0)


def test_a_training_that_was_not_measured_does_not_count() -> None:
    missing = TrainingScatter([np.array([[1.0], [np.nan], [3.0]])])
    assert missing.spread(0) == TrainingScatter([np.array([[1.0], [3.0]])]).spread(0)
    assert not TrainingScatter([np.array([[1.0], [np.nan]])]).is_known


def test_errors_of_sums_by_hand() -> None:
    scatter = TrainingScatter([TWO_SETTINGS, THREE_TRAININGS, np.array([[7.0, 8.0]])])
    of_one = pytest.approx((10.0 + 2 * 9.0) / 3)
    assert scatter.error([(2, {0: 1.0})]) == TrainingError(of_one, 3)
    # Over its four trainings, of which each counts a quarter.
    assert scatter.error([(1, {0: 0.25})] * 4).variance == pytest.approx(28.0 / 3 / 4)
    # A difference between two settings is learnt from the agent with two, and its average: of 1.5 and 5.5.
    assert scatter.error([(2, {0: 1.0, 1: -1.0})]) == TrainingError(pytest.approx(8.0), 1)
    assert scatter.error([(0, {0: 0.5, 1: 0.5})]) == TrainingError(pytest.approx(8.0), 1)
    # What two trainings bring does not cancel.
    assert scatter.error([(1, {0: 1.0}), (2, {0: -1.0})]) == TrainingError(pytest.approx(2 * 28.0 / 3), 3)
    assert scatter.error([]) == TrainingScatter([]).error([]) == TrainingError()


def test_settings_of_the_same_training_keep_their_weights() -> None:
    """The first agent's own settings are those asked for, other agents' are taken evenly: both ends of three."""
    own, other = np.array([[0.0, 1.0, 5.0], [0.0, 3.0, 5.0]]), np.array([[1.0, 9.0, 1.0], [1.0, 7.0, 5.0]])
    scatter = TrainingScatter([own, other])
    assert scatter.error([(0, {0: -1.0, 1: 1.0})]) == TrainingError(pytest.approx((2.0 + 8.0) / 2), 2)


def test_where_no_agent_tells_how_settings_go_together_the_worst_is_taken() -> None:
    scatter = TrainingScatter([THREE_TRAININGS, np.array([[1.0, 2.0]])])
    assert scatter.error([(1, {0: 1.0, 1: -1.0})]) == TrainingError(pytest.approx(4 * 9.0), 2)
    assert scatter.error([(1, {0: 0.5, 1: 0.5})]) == TrainingError(pytest.approx(9.0), 2)


def test_an_agent_that_scatters_far_more_is_not_pooled() -> None:
    calm = [np.array([[0.0], [1.0], [2.0]]) + number for number in range(6)]
    scatter = TrainingScatter([*calm, 40.0 * THREE_TRAININGS])
    assert scatter.apart == {6}
    assert scatter.error([(0, {0: 1.0})]) == TrainingError(pytest.approx(1.0), 12)
    assert scatter.error([(6, {0: 1.0})]) == TrainingError(pytest.approx(1600 * 9.0), 2)
    assert not TrainingScatter([*calm, THREE_TRAININGS]).apart  # three times as far: it may be chance


def test_independent_errors_add_up() -> None:
    assert TrainingError(1.0, 2.0) + TrainingError() == TrainingError(1.0, 2.0)
    assert TrainingError(1.0, 2.0) + TrainingError(1.0, 2.0) == TrainingError(2.0, 4.0)


def test_errors_are_students() -> None:
    drawn = TrainingError(9.0, 4.0).draw(2000)
    assert np.quantile(drawn, 0.975) == pytest.approx(3.0 * 2.776, rel=0.01)  # from any table of t
    assert not TrainingError().draw(3).any()


# ------------------------------------------------------------------------------------------------ coverage
def trained(rng: np.random.Generator, seeds: int, settings: int, moved: tuple[float, float, float]) -> Array:
    """Means after so many trainings whose truth is 0, moved together, along the settings and each for itself."""
    together, along, own = (
        spread * rng.normal(size=(seeds, each)) for spread, each in zip(moved, (1, 1, settings), strict=True)
    )
    return together + along * np.linspace(-1.0, 1.0, settings) + own


MOVED = {"together": (1.0, 0.0, 0.3), "along": (0.3, 1.0, 0.3), "for themselves": (0.0, 0.0, 1.0)}


@pytest.mark.parametrize("moved", MOVED.values(), ids=MOVED)
def test_errors_hold_the_truth_as_often_as_they_say(moved: tuple[float, float, float]) -> None:
    """Of agents as the paper's table has them, most with a training or two; 250 draws.

    What is moved along the settings makes those with one setting scatter less than the ends of others: 91 of 100.
    """
    rng = np.random.default_rng(0)
    kinds = [(3, 4), (3, 4), (2, 4), (2, 4), (2, 3), (2, 1), (2, 1), (1, 1)]
    sums: dict[str, dict[int, list[float]]] = {
        "the mean of the agent that was trained once": {7: [1.0]},
        "two settings of one agent": {0: [1.0, 0.0, 0.0, -1.0]},
        "an average over all settings": {0: [0.25, 0.25, 0.25, 0.25]},
        "an average of one agent against that of another": {0: [0.5, 0.0, 0.5, 0.0], 4: [-1.0]},
        "the agent that was trained once against another": {7: [1.0], 1: [-1.0]},
        "the rise of one agent": {2: [-0.9, -0.3, 0.3, 0.9]},
    }
    held = dict.fromkeys(sums, 0)
    for _ in range(250):
        agents = [trained(rng, *kind, moved) for kind in kinds]
        scatter = TrainingScatter(agents)
        for name, parts in sums.items():
            off, trainings = 0.0, []
            for agent, weights in parts.items():
                seeds = kinds[agent][0]
                told = {place: weight / seeds for place, weight in enumerate(weights) if weight}
                trainings += [(agent, told)] * seeds
                off += agents[agent].mean(0)[: len(weights)] @ weights
            error = scatter.error(trainings)
            held[name] += abs(off) <= error.variance**0.5 * stats.t.ppf(0.975, error.freedom)
    assert min(held.values()) >= 220, held


# ------------------------------------------------------------------------------------------------ reports
MAPS, EPISODES = 10, 2


def driven(collisions: dict[tuple[str, float], dict[int, float]]) -> Episodes:
    """Episodes of agents at a beta, with these means after their trainings; maps are alike but for their difficulty."""
    difficulty = np.linspace(-0.05, 0.05, MAPS)
    parts = [
        pd.DataFrame(
            {
                "agent": agent,
                "sensor": "narrow",
                "beta": beta,
                "collision_weight": np.nan,
                "beta_controller": None,
                "measure": None,
                "helped": "",
                "trained": agent != "mppi",
                "weights": None,
                "train_seed": seed,
                "map": np.repeat(np.arange(MAPS), EPISODES),
                "episode": np.tile(np.arange(EPISODES), MAPS),
                "collisions": np.repeat(mean + difficulty, EPISODES),
                "reward": np.repeat(500.0 - difficulty, EPISODES),
            }
        )
        for (agent, beta), means in collisions.items()
        for seed, mean in means.items()
    ]
    protocol = {"num_maps": MAPS, "num_episodes": EPISODES, "split": "evaluation", "seed": 0}
    return Episodes(pd.concat(parts, ignore_index=True), protocol, pd.DataFrame())


NONE = float("nan")
TABLE: dict[tuple[str, float], dict[int, float]] = {
    ("rcdsac_cvar", 0.25): {0: 0.1, 1: 0.3},
    ("rcdsac_cvar", 1.0): {0: 0.4, 1: 0.6},
    ("dsac_cvar", 0.25): {0: 0.2, 1: 0.1},
    ("dsac_cvar", 0.75): {0: 0.3},
    ("sac", NONE): {0: 0.5},
    ("mppi", NONE): {0: 0.5},
}
# CVaR's two settings have a variance of 0.02 each, DSAC's at one beta 0.005.
POOLED = (0.02 + 0.005) / 2


def conditions_of(episodes: Episodes) -> dict[tuple[str, float], pd.Series]:
    return {(row["agent"], row["beta"]): row for _, row in episodes.conditions.iterrows()}


def test_trainings_of_all_agents_are_pooled_and_each_of_dsacs_is_one() -> None:
    errors, of = TrainingErrors(driven(TABLE)), conditions_of(driven(TABLE))
    averse, bold = of["dsac_cvar", 0.25], of["dsac_cvar", 0.75]
    assert not errors.same(averse, bold)
    assert errors.same(of["rcdsac_cvar", 0.25], of["rcdsac_cvar", 1.0])
    assert errors.between(averse, averse, "collisions") == TrainingError()
    between = errors.between(averse, bold, "collisions")
    assert (between.variance, between.freedom) == (pytest.approx(POOLED * (1 / 2 + 1)), 2)
    table = errors.trainings(["collisions"]).set_index(["agent", "beta"])
    assert table["trainings"].tolist() == [2, 2, 1, 1]
    assert table.loc["rcdsac_cvar", "sd"].item() == pytest.approx(0.02**0.5)
    assert table.loc["rcdsac_cvar", "sd_others"].item() == pytest.approx(0.005**0.5)
    assert table["sd"].isna().tolist() == [False, False, True, True]


def test_settings_that_other_trainings_drove_do_not_cancel() -> None:
    """Averse was driven by seeds 0 and 1, each counting half. The difference of the two settings does not vary."""
    for bold, expected in (
        ({0: 0.4, 1: 0.6}, 0.0),
        # Of seed 1 half of averse less bold: no agent had both after two trainings, so the worst is taken.
        ({1: 0.6}, POOLED / 4 + POOLED * 1.5**2),
        ({2: 0.6}, POOLED / 4 * 2 + POOLED),
    ):
        rows = TABLE | {("rcdsac_cvar", 1.0): bold}
        errors, of = TrainingErrors(driven(rows)), conditions_of(driven(rows))
        found = errors.between(of["rcdsac_cvar", 0.25], of["rcdsac_cvar", 1.0], "collisions").variance
        assert found == pytest.approx(expected)


def test_weights_tell_trainings_apart_that_have_one_name() -> None:
    rows = {("mine", 0.25): {0: 0.1}, ("mine", 1.0): {0: 0.4}, ("sac", NONE): {0: 0.5, 1: 0.6}}
    episodes = driven(rows)
    of = conditions_of(episodes)
    assert TrainingErrors(episodes).same(of["mine", 0.25], of["mine", 1.0])
    weights = episodes.table["agent"] + episodes.table["beta"].astype(str)
    apart = Episodes(episodes.table.assign(weights=weights), episodes.protocol, pd.DataFrame())
    assert not TrainingErrors(apart).same(of["mine", 0.25], of["mine", 1.0])


def test_an_agent_with_one_training_has_the_others_scatter_and_a_planner_has_none() -> None:
    """Maps are exactly alike but for the difficulty that all share: differences vary with the training alone."""
    table = findings.comparisons(driven(TABLE)).set_index(["first", "second", "metric"])
    sac = table.loc["SAC", "MPPI", "collisions"]
    half = 4.303 * POOLED**0.5  # t of 2 degrees of freedom
    assert (sac["low"], sac["high"]) == (pytest.approx(-half, rel=0.02), pytest.approx(half, rel=0.02))
    turned = table.loc["RC-DSAC (resample) CVaR β = 0.25", "RC-DSAC (resample) CVaR β = 1", "collisions"]
    assert (turned["low"], turned["high"]) == (pytest.approx(-0.3), pytest.approx(-0.3))  # in both trainings

    once = {key: {0: means[0]} for key, means in TABLE.items()}
    table = findings.comparisons(driven(once)).set_index(["first", "second", "metric"])
    assert table.loc["SAC", "MPPI", "collisions"]["high"] == pytest.approx(0.0)  # nothing says how trainings differ


def test_intervals_of_the_papers_table_are_over_trainings_too() -> None:
    table = own_table(driven(TABLE)).set_index("agent")
    above = table["collisions_high"] - table["collisions_mean"]
    assert above["sac"] == pytest.approx(4.303 * POOLED**0.5, rel=0.02)
    assert above["mppi"] < 0.1


def test_a_verdict_speaks_of_the_recipe_and_of_the_agents(monkeypatch: pytest.MonkeyPatch) -> None:
    """SAC has 0.1 more than every other row. That is far less than what one training moves in another agent."""
    monkeypatch.setattr(statistics, "DRAWS", 100)
    monkeypatch.setattr(statistics, "PERMUTATIONS", 2)
    rows = {(row["agent"], row["beta"]): {0: 0.4} for _, row in paper_table().query("sensor == 'narrow'").iterrows()}
    rows = {key: means for key, means in rows.items() if key[0] not in ("rcwr", "sac")} | {("sac", NONE): {0: 0.5}}
    sure = next(one for one in judged_claims(driven(rows)) if one.claim.says.startswith("SAC collides most"))
    assert (sure.verdict, sure.of_agents) == (Verdict.HOLDS, None)
    assert over(sure) == f"{MAPS} maps alone: one training of each agent"

    rows["dsac_cvar", 0.25] = {0: 0.0, 1: 0.8}
    told = next(one for one in judged_claims(driven(rows)) if one.claim.says.startswith("SAC collides most"))
    assert told.verdict == Verdict.OPEN
    assert over(told) == f"{MAPS} maps and other trainings: 1 to 2 of each agent here"
    assert told.of_agents is not None
    assert told.of_agents.verdict == Verdict.HOLDS
