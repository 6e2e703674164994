"""Reports: the paper's own averages, refusals, and a whole report of made-up evaluations."""

import json
import re
import sys
from html.parser import HTMLParser
from pathlib import Path
from typing import get_args

import numpy as np
import pandas as pd
import pytest
from omegaconf import OmegaConf

from rcdsac_trl.errors import UserInputError
from rcdsac_trl.report import __main__ as command
from rcdsac_trl.report import collision_report, findings, statistics, table
from rcdsac_trl.report.averages import paper_averages
from rcdsac_trl.report.comparison_figures import collision_causes, paired_differences
from rcdsac_trl.report.evaluation_folders import find_evaluations, runs_among
from rcdsac_trl.report.evaluation_summary import summarised
from rcdsac_trl.report.learning import validation_of_runs
from rcdsac_trl.report.learning_figures import learning_curves
from rcdsac_trl.report.read import read_episodes
from rcdsac_trl.report.read_course import read_courses
from rcdsac_trl.report.response_figures import beta_response
from rcdsac_trl.report.results import Results
from rcdsac_trl.report.rows import paper_table
from rcdsac_trl.report.write import write_report
from rcdsac_trl.world.maps.shapes import Kind

MAPS, EPISODES = 6, 3
PROTOCOL = {
    "split": "evaluation",
    "seed": 0,
    "num_maps": MAPS,
    "num_episodes": EPISODES,
    "sampled": False,
    "map": {"version": 1, "size_m": 20.0},
    "task": {"episode_steps": 1000},
}


def evaluate(
    folder: Path,
    agent: str,
    told: dict[float, float],
    *,
    column: str = "beta",
    train_seed: int = 0,
    **described: object,
) -> Path:
    """Write an evaluation whose collisions are, at each setting, 0, 1, 2, .. plus a number, over and over."""
    rows = [
        {"beta": np.nan, "collision_weight": np.nan}
        | ({} if np.isnan(setting) else {column: setting})
        | {
            "map": m,
            "episode": e,
            "collisions": e + more,
            "reward": 100.0 * m + 10 * e - 5 * more,
            "goals": 2,
            "mean_speed_m_per_s": 0.4 + 0.01 * more,
        }
        for setting, more in told.items()
        for m in range(MAPS)
        for e in range(EPISODES)
    ]
    folder.mkdir(parents=True)
    pd.DataFrame(rows).to_csv(folder / "episodes.csv", index=False)
    measure = {"rcdsac_pow": "pow", "dsac_pow": "pow"}.get(agent)
    says = PROTOCOL | {"agent": agent, "sensor": "narrow", "measure": measure, "train_seed": train_seed} | described
    (folder / "evaluation.json").write_text(json.dumps(says))
    return folder


NONE = float("nan")


@pytest.fixture(autouse=True)
def _few_draws(monkeypatch: pytest.MonkeyPatch) -> None:
    """How well intervals and p-values are estimated is not the matter here."""
    monkeypatch.setattr(statistics, "DRAWS", 50)
    monkeypatch.setattr(statistics, "PERMUTATIONS", 500)


# ------------------------------------------------------------------------------------------------ the paper's numbers
def test_the_averages_of_the_papers_text_come_out_of_its_table() -> None:
    found = paper_averages().set_index(["name", "sensor"])

    def average(name: str, sensor: str) -> tuple[float, float]:
        row = found.loc[(name, sensor)]
        return row["collisions"], row["reward"]

    # Section "Performance Comparison"; it rounds, once upwards from exactly one half.
    assert average("DSAC", "narrow") == pytest.approx((0.91, 425.0), abs=0.051)
    assert average("RC-DSAC (stored)", "narrow") == pytest.approx((0.95, 449.9), abs=0.0051)
    assert average("DSAC", "sparse") == pytest.approx((0.68, 492.9), abs=0.051)
    assert average("RC-DSAC (stored)", "sparse") == pytest.approx((0.44, 498.1), abs=0.051)
    assert average("RC-DSAC (resample)", "narrow") == pytest.approx((0.64, 470.0), abs=0.0051)
    assert average("RC-DSAC (resample)", "sparse")[0] == pytest.approx(0.26, abs=0.0051)
    assert average("RCWR", "narrow")[0] == pytest.approx((1.58 + 1.50 + 1.60) / 3)
    assert len(found) == 2 * len(("RC-DSAC (resample)", "RC-DSAC (stored)", "DSAC", "RCWR", "SAC"))


def test_the_paper_has_twenty_four_rows_for_each_sensor() -> None:
    paper = paper_table()
    assert paper.groupby("sensor").size().to_dict() == {"narrow": 24, "sparse": 24}
    # What the paper says of its own table.
    narrow = paper[paper["sensor"] == "narrow"].set_index(["agent", "beta"])
    assert narrow["reward_mean"].idxmax() == ("rcdsac_pow", -1.0)
    for _, part in paper.groupby("sensor"):
        assert tuple(part.loc[part["collisions_mean"].idxmin(), ["agent", "beta"]]) == ("rcdsac_pow", -1.5)
    sac = narrow.loc["sac", "collisions_mean"].iloc[0]
    assert (narrow.drop(index=["sac", "rcwr"])["collisions_mean"] < sac).all()


# ------------------------------------------------------------------------------------------------ our table
def test_our_cells_are_mean_and_deviation_over_all_episodes(tmp_path: Path) -> None:
    evaluate(tmp_path / "a", "rcwr", {1.5: 0}, column="collision_weight")
    evaluate(tmp_path / "b", "rcdsac_pow", {-1.0: 1, -2.0: 0})
    evaluate(tmp_path / "c", "mine", {NONE: 0}, sensor="full")
    shown = table.comparison(read_episodes([tmp_path / name for name in "abc"]))
    assert shown[("", "agent")].tolist() == ["RC-DSAC (resample)", "RC-DSAC (resample)", "RCWR", "mine"]
    assert shown[("", "β or weight")].tolist() == ["-2", "-1", "w_coll = 1.5", ""]
    assert shown[("narrow", "collisions")].tolist() == ["1.00 ± 0.82", "2.00 ± 0.82", "1.00 ± 0.82", ""]
    assert shown[("narrow", "collisions, paper")].tolist() == ["0.50 ± 0.84", "0.58 ± 1.36", "1.50 ± 2.39", ""]
    rewards = np.array([100.0 * m + 10 * e for m in range(MAPS) for e in range(EPISODES)])
    assert shown[("narrow", "reward")].iloc[0] == f"{rewards.mean():.1f} ± {rewards.std():.1f}"
    assert shown[("full", "collisions")].tolist() == ["", "", "", "1.00 ± 0.82"]
    assert not any(sensor == "sparse" for sensor, _ in shown.columns)


def test_the_four_formats_hold_every_cell(tmp_path: Path) -> None:
    evaluate(tmp_path / "a", "rcdsac_pow", {-2.0: 0})
    shown = table.comparison(read_episodes([tmp_path / "a"]))
    table.write_table(shown, tmp_path / "table")
    for suffix, cell in (("md", "| 1.00 ± 0.82 |"), ("csv", ",1.00 ± 0.82,"), ("html", "<td>1.00 ± 0.82</td>")):
        assert cell in (tmp_path / f"table.{suffix}").read_text()
    tex = (tmp_path / "table.tex").read_text()
    assert r"RC-DSAC (resample) & pow & $-$2 & 1.00 $\pm$ 0.82 & [1.00, 1.00] & 0.50 $\pm$ 0.84" in tex
    assert tex.count(r"\\") == 3
    assert pd.read_csv(tmp_path / "table.csv").shape == shown.shape


def test_intervals_over_two_seeds_are_wide_but_hold_nothing_that_cannot_be(tmp_path: Path) -> None:
    one = evaluate(tmp_path / "a", "rcdsac_pow", {-1.0: 0})
    two = evaluate(tmp_path / "b", "rcdsac_pow", {-1.0: 1}, train_seed=1)
    alone, both = (findings.summary(read_episodes(named)).set_index("statistic") for named in ([one], [one, two]))
    # All maps have the same collisions, so that the seeds alone make the interval: 0 and 1 more, 1.5 ± 12.7 x 0.5.
    assert tuple(alone.loc["collisions", ["value", "low", "high"]]) == (1.0, 1.0, 1.0)
    assert both.loc["collisions", "value"] == 1.5
    assert both.loc["collisions", "low"] == 0.0
    assert both.loc["collisions", "high"] > 4.0
    assert tuple(both.loc["collision_free", ["low", "high"]]) == (0.0, 1.0)


# ------------------------------------------------------------------------------------------------ refusals
@pytest.mark.parametrize(
    ("changed", "sentence"),
    [
        ({"seed": 1}, "seed is 0 and 1"),
        ({"split": "validation"}, "split is evaluation and validation"),
        ({"map": {"version": 2, "size_m": 20.0}}, "map.version is 1 and 2"),
        ({"task": {"episode_steps": 500}}, "task.episode_steps is 1000 and 500"),
        ({"num_maps": 7}, "num_maps is 6 and 7"),
        ({"sampled": True}, "sampled is False and True"),
    ],
)
def test_other_maps_starts_or_rules_are_refused(tmp_path: Path, changed: dict, sentence: str) -> None:
    a, b = evaluate(tmp_path / "a", "sac", {NONE: 0}), evaluate(tmp_path / "b", "rcdsac_pow", {-1.0: 0}, **changed)
    with pytest.raises(UserInputError, match=f"did not meet the same maps, starts and goals .{sentence}"):
        read_episodes([a, b])


def test_results_of_two_robots_are_refused(tmp_path: Path) -> None:
    paper, slow, burger = {"name": "paper", "speed": 0.6}, {"name": "paper", "speed": 0.4}, {"name": "burger"}
    before = evaluate(tmp_path / "before", "sac", {NONE: 0})  # says nothing of a robot
    own = evaluate(tmp_path / "own", "dsac_pow", {NONE: 0}, robot=paper)
    assert len(read_episodes([before, own]).conditions) == 2
    for name, robot, told in (("slow", slow, "paper and paper"), ("other", burger, "paper and burger")):
        other = evaluate(tmp_path / name, "rcdsac_pow", {-1.0: 0}, robot=robot)
        with pytest.raises(UserInputError, match=rf"are of two robots \({told}, or one with other numbers\)"):
            read_episodes([own, other])
    with pytest.raises(UserInputError, match=r"are of two robots \(paper and burger"):
        read_episodes([before, other])


def test_the_same_agent_twice_is_refused_but_another_training_seed_is_not(tmp_path: Path) -> None:
    a, b = evaluate(tmp_path / "a", "sac", {NONE: 0}), evaluate(tmp_path / "b", "sac", {NONE: 2})
    with pytest.raises(UserInputError, match="hold the same agent, training seed and beta"):
        read_episodes([a, b])
    c = evaluate(tmp_path / "c", "sac", {NONE: 2}, train_seed=1)
    episodes = read_episodes([a, c])
    values = episodes.of(episodes.conditions.iloc[0], "collisions")
    assert values.shape == (2, MAPS, EPISODES)
    assert values.mean((1, 2)).tolist() == [1.0, 3.0]


def test_what_stands_between_an_agent_and_the_wheels_is_named_and_not_averaged_away(tmp_path: Path) -> None:
    every = {"replan": True, "watchdog": True, "stop_zone": True}
    helped = evaluate(tmp_path / "helped", "sac", {NONE: 0}, navigation=every)
    zone = evaluate(tmp_path / "zone", "mppi", {NONE: 0}, navigation={"replan": False, "stop_zone": True})
    alone = evaluate(tmp_path / "alone", "sac", {NONE: 2}, train_seed=1)
    assert findings.labels(read_episodes([alone])) == ["SAC"]
    assert findings.labels(read_episodes([helped, zone])) == [
        "SAC, with detours, watchdog and stop zone",
        "MPPI, with stop zone",
    ]
    with pytest.raises(UserInputError, match=r"=1 with detours, watchdog and stop zone and acting.num_candidates=1\)"):
        read_episodes([helped, alone])


def test_seeds_of_an_agent_that_act_differently_are_not_averaged(tmp_path: Path) -> None:
    choice = {"num_candidates": 32, "spread": 1.0, "over_critics": "minimum"}
    chooses = evaluate(tmp_path / "chooses", "sac", {NONE: 0}, acting=choice)
    before = evaluate(tmp_path / "before", "sac", {NONE: 2}, train_seed=1)  # of a version that knew no choice
    with pytest.raises(UserInputError, match=r"let sac act differently \(acting.num_candidates=32 .* and .*=1\)"):
        read_episodes([chooses, before])
    mean = evaluate(tmp_path / "mean", "sac", {NONE: 2}, train_seed=2, acting=choice | {"num_candidates": 1})
    assert len(read_episodes([before, mean]).conditions) == 1
    late = evaluate(tmp_path / "late", "sac", {NONE: 2}, train_seed=3, latency_s=0.28)
    with pytest.raises(UserInputError, match=r"\(acting.num_candidates=1 and .*=1 latency_s=0\.28\)"):
        read_episodes([before, late])
    other = evaluate(tmp_path / "other", "rcwr", {NONE: 2})  # another agent may
    assert len(read_episodes([chooses, other]).conditions) == 2


def test_whole_betas_are_compared_without_a_warning(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A CSV file of whole numbers alone holds no floats; warnings are errors here."""
    monkeypatch.setattr(statistics, "DRAWS", 2000)
    folder = evaluate(tmp_path / "pow", "rcdsac_pow", {-2.0: 0, -1.0: 1})
    rows = pd.read_csv(folder / "episodes.csv").astype({"beta": int})
    rows.to_csv(folder / "episodes.csv", index=False)
    shown = table.comparison(read_episodes([folder]))
    assert shown[("", "β or weight")].tolist() == ["-2", "-1"]
    assert (shown[("narrow", "collisions, paper")] != "").all()


def test_seeds_of_an_agent_that_were_trained_otherwise_are_not_averaged(tmp_path: Path) -> None:
    power = evaluate(tmp_path / "power", "rcdsac_pow", {-1.0: 0}, measure="pow")
    wang = evaluate(tmp_path / "wang", "rcdsac_pow", {-1.0: 2}, train_seed=1, measure="wang")
    with pytest.raises(
        UserInputError, match=r"rcdsac_pow, with the risk measures pow and wang: train .* \(algo\.name\)"
    ):
        read_episodes([power, wang])
    twice = evaluate(tmp_path / "twice", "rcdsac_pow", {-1.0: 2}, train_seed=1, trained_collision_weight=2.0)
    with pytest.raises(UserInputError, match=r"rcdsac_pow, trained with collisions that count 1 times and 2 times: "):
        read_episodes([power, twice])
    again = evaluate(tmp_path / "again", "rcdsac_pow", {-1.0: 2}, train_seed=2, measure="pow")
    assert len(read_episodes([power, again]).conditions) == 1


def test_what_is_no_evaluation_is_refused(tmp_path: Path) -> None:
    with pytest.raises(UserInputError, match="name what to report on"):
        read_episodes([])
    barn = tmp_path / "barn"
    barn.mkdir()
    (barn / "barn.json").write_text("{}")
    with pytest.raises(UserInputError, match=r"barn holds runs through BARN's worlds, which its summary\.csv sums up"):
        read_episodes([barn])
    with pytest.raises(UserInputError, match=r"holds no evaluation\.json"):
        read_episodes([tmp_path])
    folder = evaluate(tmp_path / "a", "sac", {NONE: 0})
    rows = pd.read_csv(folder / "episodes.csv")
    rows[:-1].to_csv(folder / "episodes.csv", index=False)
    with pytest.raises(UserInputError, match="holds 17 episodes of a beta instead of 18"):
        read_episodes([folder])
    rows.drop(columns="map").to_csv(folder / "episodes.csv", index=False)
    with pytest.raises(UserInputError, match="does not say map"):
        read_episodes([folder])
    (folder / "evaluation.json").write_text("{")
    with pytest.raises(UserInputError, match="cannot be read"):
        read_episodes([folder])


# ------------------------------------------------------------------------------------------------ findings
def test_findings_by_hand(tmp_path: Path) -> None:
    evaluate(tmp_path / "a", "rcdsac_pow", {-2.0: 0, -1.0: 1, -0.5: 2})
    episodes = read_episodes([tmp_path / "a"])
    summary = findings.summary(episodes).set_index(["condition", "statistic"])["value"]
    averse = "RC-DSAC (resample) pow β = -2"
    assert summary[averse, "collisions"] == 1.0
    assert summary[averse, "collision_free"] == pytest.approx(1 / 3)  # the first of three episodes a map
    assert summary[averse, "reward, mean of the worst 25%"] == pytest.approx((0 + 10 + 20 + 100 + 0.5 * 110) / 4.5)
    pairs = findings.comparisons(episodes).set_index(["first", "second", "metric"])
    first = pairs.loc[(averse, "RC-DSAC (resample) pow β = -1", "collisions")]
    assert (first["difference"], first["low"], first["high"]) == (-1.0, -1.0, -1.0)
    # 0 1 2 against 1 2 3: fewer in 6 of 9 pairs, equal in 2.
    assert first["better"] == pytest.approx((6 + 1) / 9)
    assert findings.adaptive(episodes).empty
    trends = findings.trends(episodes).set_index("metric")
    assert trends["correlation"].round(9).to_dict() == {
        "collisions": 1.0,
        "mean_speed_m_per_s": 1.0,
        "goals": 0.0,
        "reward": -1.0,
        "worst_reward": -1.0,
    }
    assert trends.loc["collisions", "p_value"] < 0.01
    assert trends.loc["goals", "p_value"] == 1.0


def with_controllers(folder: Path, agent: str, told: dict[float, float], turned: dict[str, float]) -> Path:
    """Write an evaluation in which controllers had so many collisions more than :func:`evaluate`'s number."""
    evaluate(folder, agent, told | {10.0 + i: more for i, more in enumerate(turned.values())})
    episodes = pd.read_csv(folder / "episodes.csv")
    names = {10.0 + i: name for i, name in enumerate(turned)}
    episodes["beta_controller"] = episodes["beta"].map(names)
    episodes["mean_beta"] = episodes["beta"].where(episodes["beta"] < 10.0, -1.25)
    episodes["beta"] = episodes["beta"].where(episodes["beta"] < 10.0)
    episodes.to_csv(folder / "episodes.csv", index=False)
    return folder


def test_controllers_are_compared_with_the_best_fixed_beta(tmp_path: Path) -> None:
    run = with_controllers(tmp_path / "a", "rcdsac_pow", {-2.0: 2, -1.0: 1}, {"clearance": 0, "bandit": 1})
    episodes = read_episodes([run, evaluate(tmp_path / "b", "sac", {NONE: 3})])
    found = findings.adaptive(episodes).set_index(["controller", "metric"])
    assert found["best_beta"].tolist() == [-1.0] * 4
    assert found["mean_beta"].tolist() == [-1.25] * 4
    assert found["difference"].to_dict() == pytest.approx(
        {
            ("bandit", "collisions"): 0.0,
            ("clearance", "collisions"): -1.0,
            ("bandit", "reward"): 0.0,
            ("clearance", "reward"): 5.0,
        }
    )
    # Six maps, all one way: 2 of 2^6 sign patterns are as extreme, times two controllers.
    assert found.loc[("clearance", "collisions"), "p_value"] == pytest.approx(2 * 2 / 2**6, abs=0.04)
    assert found.loc[("bandit", "collisions"), "p_value"] == 1.0
    assert "RC-DSAC (resample) pow β by clearance" in findings.labels(episodes)
    # The paper's table is of fixed betas.
    assert table.comparison(episodes)[("", "β or weight")].tolist() == ["-2", "-1", ""]
    write_report(Results(episodes, [run]), tmp_path / "out")
    assert "Does it pay to turn β?" in (tmp_path / "out" / "report.html").read_text()
    assert len(pd.read_csv(tmp_path / "out" / "adaptive.csv")) == 4


# ------------------------------------------------------------------------------------------------ collisions
def with_collisions(folder: Path, rows: list[tuple[float, str, int, float]]) -> Path:
    """Add collisions to an evaluation: beta, thing, whether the bearing is sensed, and since when it was not."""
    names = ["beta", "thing", "bearing_sensed", "unsensed_s"]
    table = pd.DataFrame(rows, columns=names).assign(collision_weight=np.nan, map=0, episode=0, bearing_rad=-1.0)
    table.to_csv(folder / "collisions.csv", index=False)
    return folder


def test_collisions_are_summed_up_by_hand(tmp_path: Path) -> None:
    hit = [(-2.0, "mover", 0, 0.2), (-2.0, "mover", 0, 0.6), (-2.0, "mover", 1, NONE), (-2.0, "outer_wall", 0, 1.0)]
    new = with_collisions(evaluate(tmp_path / "a", "rcdsac_pow", {-2.0: 0, -1.0: 1}), hit)
    untouched = with_collisions(evaluate(tmp_path / "b", "sac", {NONE: 0}), [])
    old = evaluate(tmp_path / "c", "pursuit", {NONE: 3})
    episodes = read_episodes([new, untouched, old])
    assert "diagnosed" not in episodes.metrics
    summary = collision_report.of_episodes(episodes, findings.labels(episodes))
    averse, bold, sac = "RC-DSAC (resample) pow β = -2", "RC-DSAC (resample) pow β = -1", "SAC"
    # The old evaluation does not say what was hit: it is missing, not at 0.
    assert summary[["condition", "thing", "collisions"]].to_numpy().tolist() == [
        [averse, "all", 4],
        [averse, "outer_wall", 1],
        [averse, "mover", 3],
        [bold, "all", 0],
        [sac, "all", 0],
    ]
    found = summary.set_index(["condition", "thing"])
    movers = found.loc[(averse, "mover")]
    assert movers["per_episode"] == 3 / (MAPS * EPISODES)
    assert movers[["share", "outside_share", "never_share"]].tolist() == pytest.approx([3 / 4, 2 / 3, 1 / 3])
    assert (movers["median_unsensed_s"], movers["median_abs_bearing_rad"]) == pytest.approx((0.4, 1.0))
    assert found.loc[(averse, "all"), "median_unsensed_s"] == 0.6
    assert found.loc[(bold, "all"), ["per_episode", "share"]].isna().tolist() == [False, True]
    wide = collision_report.wide(summary).set_index("condition")
    assert wide.loc[averse].tolist() == [
        "0.22",
        "0.06",
        "0.00",
        "0.00",
        "0.00",
        "0.17",
        "75%",
        "25%",
        "0.60 s before",
        "57°",
    ]
    assert wide.loc[sac].tolist() == ["0.00"] * 6 + [""] * 4


def test_the_bars_add_up_to_the_collisions_of_an_episode(tmp_path: Path) -> None:
    hit = [(-2.0, "mover", 0, 0.2), (-2.0, "mover", 1, 0.2), (-2.0, "inner_wall", 0, 0.2)]
    episodes = read_episodes([with_collisions(evaluate(tmp_path / "a", "rcdsac_pow", {-2.0: 0, -1.0: 1}), hit)])
    figure = collision_causes(collision_report.of_episodes(episodes, findings.labels(episodes)))
    bars = [bar for bar in figure.axes[0].patches if bar.get_width() > 0]
    assert [bar.get_width() * MAPS * EPISODES for bar in bars] == pytest.approx([1, 1, 1])
    assert [bool(bar.get_hatch()) for bar in bars] == [True, False, True]
    assert bars[-1].get_x() + bars[-1].get_width() == pytest.approx(3 / (MAPS * EPISODES))
    names = ["RC-DSAC (resample) pow β = -2", "RC-DSAC (resample) pow β = -1"]
    assert [text.get_text() for text in figure.axes[0].texts] == ["0.17", "0.00", *names]


def test_differences_say_of_whom_and_which_way_they_are(tmp_path: Path) -> None:
    agents = {"rcdsac_pow": {-2.0: 0}, "rcdsac_pow_wide": {-8.0: 1}, "mppi": {NONE: 0}, "sac": {NONE: 2}}
    episodes = read_episodes([evaluate(tmp_path / name, name, told) for name, told in agents.items()])
    reference = episodes.conditions["agent"].tolist().index("sac")
    figure = paired_differences(episodes, reference, "collisions")
    beside = [label.get_text() for label in figure.axes[0].get_yticklabels()]
    assert beside == ["RC-DSAC (resample)\npow β = -2", "RC-DSAC (resample)\nwide pow β = -8", "MPPI"]
    assert figure.axes[0].get_xlabel() == "fewer ← difference in collisions an episode → more"
    assert [text.get_text() for text in figure.legends[0].get_texts()] == ["a map", "mean, 95 % interval over maps"]


@pytest.mark.parametrize("seeds", [1, 2])
def test_what_beta_does_is_said_in_words_on_axes_from_zero(tmp_path: Path, seeds: int) -> None:
    told = {0.5: 0, 1.0: 1}
    folders = [
        evaluate(tmp_path / str(seed), "rcdsac_cvar", told, train_seed=seed, measure="cvar") for seed in range(seeds)
    ]
    figure = beta_response(read_episodes(folders), "cvar")
    assert figure is not None
    over = " (dark), and trainings, too (pale)" if seeds > 1 else ""
    assert figure.get_suptitle() == f"What β does, CVaR: averse at the left; 95 % intervals over maps{over}"
    reward = figure.axes[3]
    assert reward.get_legend() is not None
    assert [axes.get_ylim()[0] for axes in figure.axes[:3]] == [0.0] * 3
    assert reward.get_ylim()[0] <= 0.0


def test_agents_for_one_beta_each_are_not_joined_by_a_line(tmp_path: Path) -> None:
    folders = [evaluate(tmp_path / "rc", "rcdsac_cvar", {0.25: 0, 0.75: 1}, measure="cvar")]
    folders += [evaluate(tmp_path / f"{beta}", "dsac_cvar", {beta: 1}, measure="cvar") for beta in (0.25, 0.75)]
    figure = beta_response(read_episodes(folders), "cvar")
    assert figure is not None
    styles = {line.get_label(): line.get_linestyle() for line in figure.axes[0].lines}
    assert styles["RC-DSAC (resample) CVaR"] == "-"
    assert styles["DSAC CVaR"] == "None"


def test_controllers_collide_under_their_names(tmp_path: Path) -> None:
    """Also where only the fixed betas of another evaluation, or none of the controllers, did."""
    turned = with_controllers(tmp_path / "a", "rcdsac_pow", {-2.0: 2}, {"clearance": 0, "tail_variance": 1})
    with_collisions(turned, [(-2.0, "mover", 0, 0.2), (NONE, "mover", 0, 0.2)])
    collisions = pd.read_csv(turned / "collisions.csv").assign(beta_controller=[None, "clearance"])
    collisions.to_csv(turned / "collisions.csv", index=False)
    fixed = with_collisions(evaluate(tmp_path / "b", "rcdsac_cvar", {0.5: 1}), [(0.5, "outer_wall", 0, 1.0)])
    quiet = with_controllers(tmp_path / "c", "dsac_pow", {-2.0: 2}, {"clearance": 0})
    with_collisions(quiet, [(-2.0, "mover", 0, 0.2)])
    pd.read_csv(quiet / "collisions.csv").assign(beta_controller=None).to_csv(quiet / "collisions.csv", index=False)
    episodes = read_episodes([turned, fixed, quiet])
    summary = collision_report.of_episodes(episodes, findings.labels(episodes))
    counted = summary[summary["thing"] == "all"].set_index(["agent", "beta_controller"])["collisions"]
    assert counted["rcdsac_pow", "clearance"] == 1
    assert counted["rcdsac_pow", "tail_variance"] == counted["dsac_pow", "clearance"] == 0
    assert summary[summary["thing"] == "all"]["collisions"].sum() == 4


def test_an_evaluation_is_told_what_was_hit(tmp_path: Path) -> None:
    folder = with_collisions(evaluate(tmp_path / "a", "rcdsac_pow", {-2.0: 0, -1.0: 1}), [(-1.0, "mover", 0, 0.2)])
    written = collision_report.write_collisions(folder)
    summary = pd.read_csv(folder / "collision_summary.csv")
    assert summary[["beta", "thing", "collisions"]].to_numpy().tolist() == [
        [-2, "all", 0],
        [-1, "all", 1],
        [-1, "mover", 1],
    ]
    assert written["thing"].tolist() == summary["thing"].tolist()
    (folder / "collisions.csv").write_text("beta,collision_weight,map,episode,thing\n")
    with pytest.raises(UserInputError, match="does not say bearing_rad, bearing_sensed, unsensed_s"):
        read_episodes([folder])


def test_an_evaluation_in_a_few_lines(tmp_path: Path) -> None:
    """Its collisions are 0, 1, 2 of three episodes, plus 0 or 1: deviation sqrt(2/3) = 0.82."""
    folder = evaluate(tmp_path / "a", "rcdsac_pow", {-2.0: 0, -1.5: 1})
    episodes = pd.read_csv(folder / "episodes.csv").assign(contact_fraction=[0.0, 0.03, 0.03] * 2 * MAPS)
    episodes.to_csv(folder / "episodes.csv", index=False)
    with_collisions(folder, [(-2.0, "mover", 0, 0.2)] * 3 + [(-1.5, "outer_wall", 1, 0.2)])
    heading, columns, *rows, hit = summarised(folder).splitlines()
    assert (
        heading == "rcdsac_pow, evaluation maps 6 × 3 episodes of 1000 steps; mean ± standard deviation of an episode:"
    )
    assert " ".join(columns.split()) == "collisions reward goals speed, m/s in contact without collision"
    # Rewards: 100 map + 10 episode - 5 more; of 0 to 5 and of 0 to 2: 250 + 10, deviation sqrt(100² 35/12 + 10² 2/3).
    averse = "beta=-2 1.00 ± 0.82 260 ± 171 2.00 ± 0.00 0.40 ± 0.00 2.0% ± 1.4% 33%"
    bolder = "beta=-1.5 2.00 ± 0.82 255 ± 171 2.00 ± 0.00 0.41 ± 0.00 2.0% ± 1.4% 0%"
    assert [" ".join(row.split()) for row in rows] == [averse, bolder]
    assert hit == "hit: mover 75%, outer wall 25%"
    assert len(pd.read_csv(folder / "collision_summary.csv")) == 4


def test_one_episode_has_no_spread(tmp_path: Path) -> None:
    folder = evaluate(tmp_path / "a", "pursuit", {NONE: 0})
    episodes = pd.read_csv(folder / "episodes.csv").assign(contact_fraction=0.0)
    episodes[:1].to_csv(folder / "episodes.csv", index=False)
    with_collisions(folder, [])
    assert summarised(folder).splitlines()[2].count(" ± –  ") == 5


def test_a_few_lines_name_controllers_weights_and_who_is_told_nothing(tmp_path: Path) -> None:
    def named(folder: Path) -> list[str]:
        episodes = pd.read_csv(folder / "episodes.csv").assign(contact_fraction=0.0)
        episodes.to_csv(folder / "episodes.csv", index=False)
        with_collisions(folder, [])
        *_, hit = lines = summarised(folder).splitlines()
        assert hit == "nothing was hit"
        return [line.split("  ")[0] for line in lines[2:-1]]

    turned = with_controllers(tmp_path / "a", "rcdsac_pow", {-2.0: 2}, {"clearance": 0})
    assert named(turned) == ["beta=-2", "clearance"]
    assert named(evaluate(tmp_path / "b", "rcwr", {1.5: 0}, column="collision_weight")) == ["w_coll=1.5"]
    assert named(evaluate(tmp_path / "c", "pursuit", {NONE: 0})) == ["pursuit"]


def test_things_are_those_of_the_world() -> None:
    assert list(collision_report.THINGS) == [*get_args(Kind), "mover"]


class Images(HTMLParser):
    """Counts what a page shows and what it would fetch."""

    def __init__(self) -> None:
        super().__init__()
        self.links: list[str] = []
        self.anchors: list[str] = []
        self.tables = self.figures = 0

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.tables += tag == "table"
        self.figures += tag == "svg"
        self.anchors += [value or "" for name, value in attrs if name == "id"]
        self.links += [value or "" for name, value in attrs if name in ("src", "href", "xlink:href")]


def run_folder(path: Path) -> Path:
    """Make a run that has validated twice and was evaluated."""
    evaluate(path / "evaluation" / "best", "rcdsac_pow", {-2.0: 0, -1.0: 1, -0.5: 2})
    (path / "csv" / "scalars" / "time").mkdir(parents=True)
    (path / "csv" / "scalars" / "time" / "elapsed_s.csv").write_text("1000,60.0\n2000,120.0\n")
    rows = [
        {"iteration": i, "updates": 10 * (i + 1), "beta": -1.0, "collisions": 2 - i, "reward": 100 * i} for i in (0, 1)
    ]
    pd.DataFrame(rows).to_csv(path / "validation_episodes.csv", index=False)
    return path


def test_a_report_is_one_page_that_fetches_nothing(tmp_path: Path) -> None:
    run = run_folder(tmp_path / "run")
    with_collisions(run / "evaluation" / "best", [(-2.0, "mover", 0, 0.2)])
    folders = [run, evaluate(tmp_path / "sac", "sac", {NONE: 3})]
    out = tmp_path / "out"
    out.mkdir()
    for name in ("claims.md", "course.md", "beta_response_cvar.png", "differences_reward_sparse.png"):
        (out / name).touch()  # an earlier report of something else
    results = Results(read_episodes(folders), folders)
    write_report(results, out)
    with pytest.raises(UserInputError, match="holds something else than a report"):
        write_report(results, folders[1])
    assert {path.name for path in out.iterdir()} == {
        *(f"table.{suffix}" for suffix in ("md", "csv", "tex", "html")),
        *(f"{name}.csv" for name in ("summary", "comparisons", "trends", "trainings", "averages", "collision_summary")),
        "claims.csv",
        "claims.md",
        "claims_evidence.csv",
        *(
            f"{name}.png"
            for name in ("beta_response_pow", "differences_collisions_narrow", "differences_reward_narrow")
        ),
        "learning_curves.png",
        "collision_causes.png",
        "report.html",
    }
    averages = pd.read_csv(out / "averages.csv")
    own = averages[averages["source"] == "here"]
    assert own["name"].tolist() == ["SAC"]  # of RC-DSAC's settings CVaR's were not driven
    assert own["collisions_from"].isna().all()
    text = (out / "report.html").read_text()
    page = Images()
    page.feed(text)
    # Four panels of beta, two of differences, one of causes, two metrics of learning over two clocks.
    assert page.figures == 4 + 2 + 1 + 4
    assert {link.removeprefix("#") for link in page.links} <= set(page.anchors)
    assert not re.search(r"url\((?!#)|@import|https?://", text)
    assert "RC-DSAC and SAC on 6 evaluation maps: which of the paper&#x27;s claims hold" in text
    verdicts, beta = text.index("Averse RC-DSAC collides less"), text.index('<h2 id="what-does">')
    assert verdicts < text.index('<h2 id="collisions-and-reward-beside-the-paper-s">') < beta
    assert text.index("SAC collides most: every row of RC-DSAC and DSAC collides less: <b>runs missing</b>") < beta
    # Each colour has one by night.
    by_day, by_night = (
        set(re.findall(r"--c[0-9a-f]{6}(?=:)", part)) for part in text.split("prefers-color-scheme")[:2]
    )
    assert by_day == by_night == {f"--c{name}" for name in re.findall(r"var\(--c([0-9a-f]{6})\)", text)}


def test_the_office_course_stands_beside_the_paper(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(statistics, "DRAWS", 2000)
    rows = [
        {"run": f"runs/{agent}", "agent": agent, "beta": beta, "direction": direction, "repetition": repetition}
        | {"finished": True, "time_s": 100.0 + repetition, "collisions": collisions + repetition}
        for agent, beta, collisions in (("rcdsac_pow", -2.0, 0), ("sac", NONE, 9))
        for direction in ("forward", "reverse")
        for repetition in range(3)
    ]
    course = tmp_path / "course"
    course.mkdir()
    pd.DataFrame(rows).to_csv(course / "runs.csv", index=False)
    (course / "course.json").write_text("{}")
    run = evaluate(tmp_path / "sac", "sac", {NONE: 3})
    report = command.make_report(OmegaConf.create({"runs": [str(run), str(course)], "out": str(tmp_path / "out")}))
    report.run()
    shown = pd.read_csv(tmp_path / "out" / "course.csv", dtype=str, keep_default_na=False).set_index("agent")
    assert shown.loc["RC-DSAC", ["forward collisions", "forward collisions, paper"]].tolist() == ["1.0 ± 0.8", "0"]
    # Student's t of 5 degrees of freedom over six runs of 9, 10 and 11 collisions: 10 ± 2.57 x 0.37.
    value, low, high = map(float, re.findall(r"[\d.]+", shown.loc["SAC", "collisions a run, 95 %"]))
    assert (value, low, high) == pytest.approx((10.0, 9.06, 10.94), abs=0.11)
    claims = pd.read_csv(tmp_path / "out" / "claims.csv").set_index("claim")
    found = claims.loc["SAC collides more than RC-DSAC and DSAC, row by row"]
    assert found["verdict"] == "runs missing"
    assert found["numbers"].startswith("1 comparison: 1 as claimed. Weakest: RC-DSAC pow β = -2: 1.00 (paper 0.00)")
    assert "The office course beside the paper" in (tmp_path / "out" / "report.html").read_text()
    with pytest.raises(UserInputError, match=r"holds drives over the office course, whose table is table\.md"):
        command.make_report(OmegaConf.create({"runs": [str(course)], "out": str(tmp_path / "out")}))


def test_courses_of_two_agents_stand_together_but_not_one_agent_acting_in_two_ways(tmp_path: Path) -> None:
    def course(folder: str, agent: str, beta: float, spread: float) -> Path:
        rows = [
            {"run": agent, "agent": agent, "beta": beta, "direction": "forward", "repetition": 0}
            | {"finished": True, "time_s": 100.0, "collisions": 0}
        ]
        (tmp_path / folder).mkdir()
        pd.DataFrame(rows).to_csv(tmp_path / folder / "runs.csv", index=False)
        described = {"seed": 0, "acting": {agent: {"num_candidates": 32, "spread": spread}}}
        (tmp_path / folder / "course.json").write_text(json.dumps(described))
        return tmp_path / folder

    pow_, sac = course("a", "rcdsac_pow", -1.0, 1.0), course("b", "sac", NONE, 1.0)
    assert read_courses([pow_, sac])["agent"].tolist() == ["rcdsac_pow", "sac"]
    with pytest.raises(UserInputError, match=r"a and .*c let rcdsac_pow act differently \({'num_candidates': 32, "):
        read_courses([pow_, sac, course("c", "rcdsac_pow", -2.0, 0.5)])


def test_the_command_refuses_before_it_writes(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("MALLOC_MMAP_MAX_", "0")  # else the process would start itself again
    monkeypatch.setattr(sys, "argv", ["report", "runs=[nowhere]"])
    with pytest.raises(SystemExit) as left:
        command.main()
    assert left.value.code == 2
    assert "there is no folder nowhere: name runs" in capsys.readouterr().err
    assert list(tmp_path.iterdir()) == []


def test_a_folder_of_runs_stands_for_those_that_were_evaluated(tmp_path: Path) -> None:
    evaluated, other, single = (
        tmp_path / name for name in ("sweep/b/evaluation/last", "sweep/a/evaluation/best", "of/a/baseline")
    )
    for folder in (evaluated, other, single):
        folder.mkdir(parents=True)
        (folder / "evaluation.json").write_text("{}")
    (tmp_path / "sweep" / "training" / "evaluation").mkdir(parents=True)
    (tmp_path / "sweep" / "notes.md").touch()
    sweep = tmp_path / "sweep"
    # A run, an evaluation and what is not there stay; evaluations deeper down are another folder's.
    named = [sweep, sweep / "a", evaluated, tmp_path / "of", tmp_path / "nowhere"]
    assert runs_among(named) == [sweep / "a", sweep / "b", *named[1:]]
    assert find_evaluations(runs_among([sweep])) == [other, evaluated]
    with pytest.raises(UserInputError, match=r"of holds no evaluation\.json"):
        find_evaluations(runs_among([tmp_path / "of"]))


def test_a_run_that_logged_no_time_is_drawn_over_its_updates(tmp_path: Path) -> None:
    logged, silent = tmp_path / "logged", tmp_path / "silent"
    for folder in (logged, silent):
        folder.mkdir()
        (folder / "validation_episodes.csv").write_text("iteration,updates,collisions,reward\n0,200,4,10\n1,400,2,30\n")
    scalars = logged / "csv" / "scalars" / "time"
    scalars.mkdir(parents=True)
    (scalars / "elapsed_s.csv").write_text("10000,60\n20000,180\n")
    runs = validation_of_runs([logged, silent, tmp_path])
    assert list(runs) == ["logged", "silent"]
    assert runs["logged"]["elapsed_s"].tolist() == [60, 180]
    panels = learning_curves(runs).axes
    over_updates, over_minutes = ([len(axes.lines) for axes in panels[side::2]] for side in (0, 1))
    assert (over_updates, over_minutes) == ([2, 2], [1, 1])
    assert panels[1].lines[0].get_xdata().tolist() == [1, 3]
    assert len(learning_curves({"silent": runs["silent"]}).axes) == 2


def test_learning_curves_of_a_run_that_is_training(tmp_path: Path) -> None:
    folder = tmp_path / "run"
    (folder / "csv/scalars/time").mkdir(parents=True)
    table, clock = folder / "validation_episodes.csv", folder / "csv/scalars/time/elapsed_s.csv"
    table.write_text("iterat")
    assert validation_of_runs([folder]) == {}
    table.write_text("iteration,updates,collisions,reward\n0,200,4,10\n1,400,2,3")  # 30 to be
    clock.write_text("10000,60\n20000,18")  # 180 to be
    found = validation_of_runs([folder])["run"]
    assert found.to_dict("records") == [
        {"iteration": 0, "updates": 200, "collisions": 4, "reward": 10, "elapsed_s": 60}
    ]
    table.write_text("iteration,updates\n0,200,4,10\n1,2,3,4,5\n")
    with pytest.raises(UserInputError, match=r"run cannot be read \(.*\): leave it out"):
        validation_of_runs([folder])
