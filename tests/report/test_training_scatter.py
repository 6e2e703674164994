"""How far trainings lie apart: mean squares and errors by hand, coverage by simulation, what reports make of it."""

import numpy as np
import pandas as pd
import pytest
from scipy import stats

from rcdsac_trl.report import findings
from rcdsac_trl.report.claims import judged_claims
from rcdsac_trl.report.read import Episodes
from rcdsac_trl.report.rows import paper_table
from rcdsac_trl.report.table import own_table
from rcdsac_trl.report.training_errors import TrainingErrors
from rcdsac_trl.report.training_scatter import Array, TrainingError, TrainingScatter
from rcdsac_trl.report.verdict_words import over
from rcdsac_trl.report.verdicts import Verdict

TWO_SETTINGS = np.array([[1.0, 2.0], [3.0, 8.0]])
"""Means 1.5 and 5.5 after two trainings; what is left is ∓1 and ±1."""


# ------------------------------------------------------------------------------------------------ by hand
def test_mean_squares_by_hand() -> None:
    found = TrainingScatter.of([TWO_SETTINGS, np.array([[0.0], [3.0], [6.0]]), np.array([[7.0]])])
    assert (found.of_means, found.means_freedom) == (pytest.approx((8.0 + 18.0) / 3), 3)
    assert (found.of_settings, found.settings_freedom) == (4.0, 1)
    assert found.share == pytest.approx((1 / 2 + 2 * 1) / 3)


def test_a_training_that_was_not_measured_does_not_count() -> None:
    assert TrainingScatter.of([np.array([[1.0], [np.nan], [3.0]])]) == TrainingScatter.of([np.array([[1.0], [3.0]])])
    assert not TrainingScatter.of([np.array([[1.0], [np.nan]])]).is_known


def test_errors_of_sums_by_hand() -> None:
    scatter = TrainingScatter.of([TWO_SETTINGS])  # of means 8, of settings 4, half of it in the former: 6 in common
    one, other = scatter.error([([1.0], 1)]), scatter.error([([0.5, 0.5], 1)])
    assert (one.variance, other.variance) == (pytest.approx(6.0 + 4.0), pytest.approx(8.0))
    assert other.freedom == 1.0
    assert one.freedom == pytest.approx(10.0**2 / (8.0**2 + 2.0**2))
    assert scatter.error([([1.0], 4)]).variance == pytest.approx(10.0 / 4)
    # What two settings of a training have in common cancels, what two trainings have does not.
    assert scatter.error([([1.0, -1.0], 1)]).variance == pytest.approx(8.0)
    assert scatter.error([([1.0], 1), ([-1.0], 1)]).variance == pytest.approx(20.0)


def test_trainings_that_move_nothing_together_have_no_negative_variance() -> None:
    scatter = TrainingScatter.of([np.array([[1.0, -1.0], [-1.0, 1.0]])])  # means are equal
    assert scatter.error([([0.5, 0.5], 1)]) == TrainingError(pytest.approx(2.0), 1.0)
    assert TrainingScatter().error([([1.0], 1)]) == TrainingError()


def test_independent_errors_add_up() -> None:
    assert TrainingError(1.0, 2.0) + TrainingError() == TrainingError(1.0, 2.0)
    assert TrainingError(1.0, 2.0) + TrainingError(1.0, 2.0) == TrainingError(2.0, 4.0)


def test_errors_are_students() -> None:
    drawn = TrainingError(9.0, 4.0).draw(2000)
    assert np.quantile(drawn, 0.975) == pytest.approx(3.0 * 2.776, rel=0.01)  # from any table of t
    assert not TrainingError().draw(3).any()


# ------------------------------------------------------------------------------------------------ coverage
def trained(rng: np.random.Generator, seeds: int, settings: int, together: float, own: float) -> Array:
    """Means after so many trainings whose truth is 0."""
    return together * rng.normal(size=(seeds, 1)) + own * rng.normal(size=(seeds, settings))


@pytest.mark.parametrize(("together", "own"), [(1.0, 0.3), (0.3, 1.0), (0.0, 1.0)])
def test_errors_hold_the_truth_as_often_as_they_say(together: float, own: float) -> None:
    """Of agents as the paper's table has them, most with a training or two; 1,000 draws."""
    rng = np.random.default_rng(0)
    kinds = [(3, 4), (3, 4), (2, 4), (2, 4), (2, 3), (2, 1), (2, 1), (1, 1)]
    sums = {
        "the mean of the agent that was trained once": {7: [1.0]},
        "two settings of one agent": {0: [1.0, -1.0]},
        "an average of one agent against that of another": {0: [0.5, 0.5], 4: [-1.0]},
        "the agent that was trained once against another": {7: [1.0], 1: [-1.0]},
    }
    held = dict.fromkeys(sums, 0)
    for _ in range(1000):
        agents = [trained(rng, seeds, settings, together, own) for seeds, settings in kinds]
        scatter = TrainingScatter.of(agents)
        for name, parts in sums.items():
            error = scatter.error((weights, kinds[agent][0]) for agent, weights in parts.items())
            off = sum(agents[agent].mean(0)[: len(weights)] @ weights for agent, weights in parts.items())
            held[name] += abs(off) <= error.variance**0.5 * stats.t.ppf(0.975, error.freedom)
    assert all(0.93 <= number / 1000 <= 0.99 for number in held.values()), held


# ------------------------------------------------------------------------------------------------ reports
MAPS, EPISODES = 10, 2


def driven(collisions: dict[tuple[str, float], list[float]]) -> Episodes:
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
                "train_seed": seed,
                "map": np.repeat(np.arange(MAPS), EPISODES),
                "episode": np.tile(np.arange(EPISODES), MAPS),
                "collisions": np.repeat(mean + difficulty, EPISODES),
                "reward": np.repeat(500.0 - difficulty, EPISODES),
            }
        )
        for (agent, beta), means in collisions.items()
        for seed, mean in enumerate(means)
    ]
    protocol = {"num_maps": MAPS, "num_episodes": EPISODES, "split": "evaluation", "seed": 0}
    return Episodes(pd.concat(parts, ignore_index=True), protocol, pd.DataFrame())


NONE = float("nan")
TABLE: dict[tuple[str, float], list[float]] = {
    ("rcdsac_cvar", 0.25): [0.1, 0.3],
    ("rcdsac_cvar", 1.0): [0.4, 0.6],
    ("dsac_cvar", 0.25): [0.2, 0.1],
    ("dsac_cvar", 0.75): [0.3],
    ("sac", NONE): [0.5],
    ("mppi", NONE): [0.5],
}


def test_trainings_of_all_agents_are_pooled_and_each_of_dsacs_is_one() -> None:
    """CVaR's means are 0.25 and 0.45, DSAC's 0.2 and 0.1 at one beta; at the other it has one training, as SAC."""
    errors = TrainingErrors(driven(TABLE))
    scatter = errors.scatter("narrow", "collisions")
    assert scatter.of_means == pytest.approx((0.02 + 0.005) / 2)
    assert (scatter.means_freedom, scatter.settings_freedom) == (2, 1)
    conditions = {(row["agent"], row["beta"]): row for _, row in driven(TABLE).conditions.iterrows()}
    averse, bold = conditions["dsac_cvar", 0.25], conditions["dsac_cvar", 0.75]
    assert not errors.same(averse, bold)
    assert errors.same(conditions["rcdsac_cvar", 0.25], conditions["rcdsac_cvar", 1.0])
    assert errors.between(averse, bold, "collisions").variance == pytest.approx(0.0125 * (1 / 2 + 1))


def test_an_agent_with_one_training_has_the_others_scatter_and_a_planner_has_none() -> None:
    """Maps are exactly alike but for the difficulty that all share: differences vary with the training alone."""
    table = findings.comparisons(driven(TABLE)).set_index(["first", "second", "metric"])
    sac = table.loc["SAC", "MPPI", "collisions"]
    half = 4.303 * 0.0125**0.5  # t of 2 degrees of freedom
    assert (sac["low"], sac["high"]) == (pytest.approx(-half, rel=0.02), pytest.approx(half, rel=0.02))
    turned = table.loc["RC-DSAC (resample) CVaR β = 0.25", "RC-DSAC (resample) CVaR β = 1", "collisions"]
    assert (turned["low"], turned["high"]) == (pytest.approx(-0.3), pytest.approx(-0.3))  # in both trainings

    once = {key: means[:1] for key, means in TABLE.items()}
    table = findings.comparisons(driven(once)).set_index(["first", "second", "metric"])
    assert table.loc["SAC", "MPPI", "collisions"]["high"] == pytest.approx(0.0)  # nothing says how trainings differ


def test_intervals_of_the_papers_table_are_over_trainings_too() -> None:
    table = own_table(driven(TABLE)).set_index("agent")
    above = table["collisions_high"] - table["collisions_mean"]
    assert above["sac"] == pytest.approx(4.303 * 0.0125**0.5, rel=0.02)
    assert above["mppi"] < 0.1


def test_a_verdict_speaks_of_the_recipe_and_of_the_agents() -> None:
    """SAC has 0.1 more than every other row. That is far less than what one training moves in another agent."""
    rows = {(row["agent"], row["beta"]): [0.4] for _, row in paper_table().query("sensor == 'narrow'").iterrows()}
    rows = {key: means for key, means in rows.items() if key[0] not in ("rcwr", "sac")} | {("sac", NONE): [0.5]}
    sure = next(one for one in judged_claims(driven(rows)) if one.claim.says.startswith("SAC collides most"))
    assert (sure.verdict, sure.of_agents) == (Verdict.HOLDS, None)
    assert over(sure) == f"{MAPS} maps alone: one training seed"

    rows["dsac_cvar", 0.25] = [0.0, 0.8]
    told = next(one for one in judged_claims(driven(rows)) if one.claim.says.startswith("SAC collides most"))
    assert told.verdict == Verdict.OPEN
    assert over(told) == f"{MAPS} maps and 2 training seeds, of some agents 1"
    assert told.of_agents is not None
    assert told.of_agents.verdict == Verdict.HOLDS
