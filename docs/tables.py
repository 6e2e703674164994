"""Write anew what follows from files: tables of README.md and docs/, and the cards of weights/: ``make tables``.

A table of agents stands between two comments, of which the first names whose it is, in their order: agents of
``weights/``, and baselines of ``results/``, of which an evaluation is read; ``<agent>:<beta>,<beta>``, of RCWR
weights, takes these rows of it alone. A table of seeds names agents of ``results/`` that were trained again, and finds
the other trainings in ``results/seed-*/``. Tables beside the paper name a sensor, and are over all trainings of its
rows in ``results/``: the means, the claims with their verdicts, differences from agents or baselines, and averages
over the settings that the paper's text averages. The comment of a table of the office course names the folder of what
``course`` wrote, that of a table of disturbances the files of ``docs/disturbances.py``, in their order. The table of an
accelerator is what ``benchmarks/accelerator.py`` wrote::

    <!-- agents: sac-narrow pursuit-narrow -->
    | agent | collisions | ..
    <!-- agents: end -->
    <!-- seeds: sac-narrow -->
    <!-- seeds: end -->
    <!-- paper: narrow -->
    <!-- paper: end -->
    <!-- claims: narrow -->
    <!-- claims: end -->
    <!-- differences: narrow rcdsac_cvar rcdsac_pow from sac mppi -->
    <!-- differences: end -->
    <!-- averages: narrow sparse -->
    <!-- averages: end -->
    <!-- course: results/course -->
    <!-- course: end -->
    <!-- disturbances: mppi -->
    <!-- disturbances: end -->
"""

import json
import re
from collections.abc import Callable, Mapping, Sequence
from functools import cache, partial
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
from numpy.typing import NDArray

from rcdsac_trl.deploy.policy.weights import card_of, read_weights
from rcdsac_trl.report.averages import FIRST, averages, trainings_told
from rcdsac_trl.report.card import measured_values
from rcdsac_trl.report.claims import judged_claims
from rcdsac_trl.report.course_table import course_table
from rcdsac_trl.report.evaluation_folders import all_trainings
from rcdsac_trl.report.findings import labels
from rcdsac_trl.report.read import Episodes, read_episodes
from rcdsac_trl.report.rows import condition_label, paper_table, row_label
from rcdsac_trl.report.statistics import Interval, compare
from rcdsac_trl.report.table import comparison
from rcdsac_trl.report.training_errors import training_errors
from rcdsac_trl.report.verdict_words import numbers, of_agents
from rcdsac_trl.report.verdicts import Finding

Floats = NDArray[np.float64]

ROOT = Path(__file__).resolve().parents[1]
DOCUMENTS = sorted([ROOT / "README.md", *(ROOT / "docs").glob("*.md")])
CARDS = sorted((ROOT / "weights").glob("*/README.md"))
_ACCELERATOR = re.compile(r"(<!-- accelerator: begin -->\n).*?(<!-- accelerator: end -->)", re.S)
_COURSE_HEADINGS = (
    *("agent", "β", "forward: arrived", "collisions a run", "time, s"),
    *("in reverse: arrived", "collisions a run", "time, s"),
)
_HEADINGS = ("agent", "collisions", "reward", "episodes without collision", "goals")


def renewed(text: str) -> str:
    """Return a document with its tables as the measured numbers have them."""
    tables: Mapping[str, Callable[[list[str]], str]] = {
        "agents": table_of,
        "seeds": lambda names: table_of_seeds(_trainings(names)),
        "paper": lambda sensor: table_beside_the_paper(_paper(), *sensor),
        "claims": lambda sensors: table_of_claims(_claims(), " ".join(sensors)),
        "differences": lambda names: table_of_differences(_paper(), names),
        "averages": lambda sensors: table_of_averages(_paper(), sensors),
        "course": lambda folders: table_of_course(*(ROOT / folder for folder in folders)),
        "disturbances": lambda names: table_of_disturbances(_driven(names)),
    }
    for kind, table in tables.items():
        between = rf"(<!-- {kind}: (?!end)([^>]*?) -->\n).*?(<!-- {kind}: end -->)"
        text = re.sub(between, partial(_filled, table), text, flags=re.S)
    measured = ROOT / "results" / "accelerator.json"
    values = json.loads(measured.read_text(encoding="utf-8")) if measured.is_file() else None
    return _ACCELERATOR.sub(lambda found: found[1] + accelerator_table(values) + found[2], text)


def _filled(table: Callable[[list[str]], str], found: re.Match[str]) -> str:
    """Return a table between its two comments, of which the first says what it is of."""
    return found[1] + table(found[2].split()) + found[3]


def table_of(names: list[str]) -> str:
    """Return the table of some agents and baselines, Markdown: a row a condition.

    Args:
        names: of each, with ``:`` and betas, or weights, behind it where not all are to be shown.
    """
    return _markdown(_HEADINGS, [_cells(condition) for name in names for condition in _conditions(name)])


def _conditions(name: str) -> list[Mapping[str, Any]]:
    whose, _, chosen = name.partition(":")
    conditions: list[Mapping[str, Any]] = measured_of(whose)["conditions"]
    if not chosen:
        return conditions
    by_setting = {
        condition["collision_weight"] if condition["beta"] is None else condition["beta"]: condition
        for condition in conditions
    }
    return [by_setting[float(setting)] for setting in chosen.split(",")]


def _trainings(names: Sequence[str]) -> list[Episodes]:
    """Return what all trainings of each of some agents drove."""
    return [read_episodes(all_trainings(ROOT / "results", name)) for name in names]


def table_of_seeds(agents: Sequence[Episodes]) -> str:
    """Return how far trainings of the same agents lie apart, Markdown: a row a condition that all of them drove.

    The last row is the standard deviation from one training to another: the root of its mean square over all rows.

    Args:
        agents: of each the episodes of all its trainings, as many as of any other.
    """
    rows, variances = [], []
    for episodes in agents:
        seeds = sorted(episodes.table["train_seed"].unique())
        for (_, condition), label in zip(episodes.conditions.iterrows(), labels(episodes), strict=True):
            values = [episodes.of(condition, metric) for metric in ("collisions", "reward")]
            if len(values[0]) < len(seeds):
                continue
            of_seeds = np.stack([metric.mean(axis=(1, 2)) for metric in values], axis=1)  # [S, 2]
            variances.append(of_seeds.var(axis=0, ddof=1))
            rows.append(
                [label, *(f"{collisions:.2f} / {reward:.0f}" for collisions, reward in (*of_seeds, of_seeds.mean(0)))]
            )
    headings = ["agent", *(f"seed {seed}" for seed in seeds), "mean"]
    collisions, reward = np.sqrt(np.mean(variances, axis=0))
    apart = ["standard deviation, one training to another", *([""] * len(seeds)), f"{collisions:.2f} / {reward:.0f}"]
    return _markdown(headings, [*rows, apart])


@cache
def _paper() -> Episodes:
    """Return what all trainings of the paper's rows drove, with both sensors, and MPPI."""
    agents = paper_table()[["agent", "beta"]].itertuples(index=False)
    names = {name for agent, beta in agents for name in (agent, f"{agent}_{beta:g}")} | {"mppi"}
    folders = sorted((ROOT / "results").glob("*-*"))
    chosen = [folder.name for folder in folders if folder.name.rpartition("-")[0] in names]
    return read_episodes([training for name in chosen for training in all_trainings(ROOT / "results", name)])


@cache
def _claims() -> list[Finding]:
    return judged_claims(_paper())


def table_beside_the_paper(episodes: Episodes, sensor: str) -> str:
    """Return collisions and rewards of a sensor beside the paper's, Markdown: a row an agent and setting."""
    table = comparison(episodes)
    told = [column for column in table.columns if column[0] in ("", sensor)]
    rows = table.loc[table[sensor, "collisions"] != "", told]
    return _markdown([str(name) for _, name in told], rows.to_numpy().tolist())


def table_of_claims(findings: Sequence[Finding], sensor: str) -> str:
    """Return the claims about a sensor, Markdown: verdicts over other trainings and of these agents, and numbers."""
    rows = [
        [finding.claim.says, f"**{finding.verdict.value}**", of_agents(finding), numbers(finding)]
        for finding in findings
        if finding.claim.sensor == sensor
    ]
    return _markdown(["claim", "verdict", "of these agents alone", "numbers"], rows)


def table_of_differences(episodes: Episodes, names: Sequence[str]) -> str:
    """Return differences of means with their intervals over maps and trainings, Markdown: a row a condition.

    Args:
        episodes: of all of them.
        names: the sensor, agents, ``from``, and what they are compared with.
    """
    sensor, *agents = names[: names.index("from")]
    errors, conditions = training_errors(episodes), episodes.conditions[episodes.conditions["sensor"] == sensor]
    against = [conditions[conditions["agent"] == name].iloc[0] for name in names[names.index("from") + 1 :]]
    rows = []
    for agent in agents:
        for _, condition in conditions[conditions["agent"] == agent].iterrows():
            cells = [condition_label(agent, sensor, condition["beta"], condition["collision_weight"], None)]
            for other in against:
                if other.equals(condition):
                    cells += ["", ""]
                    continue
                for metric, form in (("collisions", ".2f"), ("reward", ".0f")):
                    more = errors.contrast([(1.0, condition), (-1.0, other)], metric)
                    cells.append(_with_interval(more, form))
            rows.append(cells)
    headings = [f"{metric}, from {row_label(each['agent'])}" for each in against for metric in ("collisions", "reward")]
    return _markdown(["agent", *headings], rows)


def table_of_averages(episodes: Episodes, sensors: Sequence[str]) -> str:
    """Return kinds of agents, averaged as the paper's text does, and how RC-DSAC (resample) differs, Markdown.

    Of RC-DSAC and DSAC the four settings that DSAC has are averaged, of RCWR its weights. Intervals are over maps and
    trainings.

    Args:
        episodes: of all of them.
        sensors: two columns each.
    """
    means = averages(episodes)
    order = [*dict.fromkeys(paper_table()["name"]), *means["name"]]  # what the paper lacks comes last
    columns = [_averages_with(means[means["sensor"] == sensor]) for sensor in sensors]
    headings = [heading for sensor in sensors for heading in (f"{sensor}: collisions / reward", f"{FIRST} from it")]
    names = [name for name in dict.fromkeys(order) if any(name in column for column in columns)]
    return _markdown(
        ["averaged", *headings], [[name, *(c for of in columns for c in of.get(name, ("", "")))] for name in names]
    )


def _averages_with(means: pd.DataFrame) -> dict[str, tuple[str, str]]:
    """Return each kind's means with a sensor, and what RC-DSAC (resample) has more, by its name."""
    cells = {}
    for _, row in means.iterrows():
        trainings = f" ({told})" if (told := trainings_told(row)) else ""
        more = [
            _with_interval(Interval(*(row[f"{metric}_from{part}"] for part in ("", "_low", "_high"))), form)
            for metric, form in (("collisions", ".2f"), ("reward", ".0f"))
            if pd.notna(row[f"{metric}_from"])
        ]
        cells[row["name"]] = f"{row['collisions']:.2f} / {row['reward']:.0f}{trainings}", ", ".join(more)
    return cells


def _with_interval(found: Interval, form: str) -> str:
    return f"{found.value:{form}} [{found.low:{form}}, {found.high:{form}}]"


def table_of_course(folder: Path) -> str:
    """Return the table of the drives over the office course in a folder, Markdown, with the paper's in parentheses.

    Args:
        folder: of some ``runs.csv``, at any depth.
    """
    found = [pd.read_csv(path) for path in sorted(folder.rglob("runs.csv"))]
    if not found:
        return "Not driven yet.\n"
    rows = []
    for row in course_table(pd.concat(found)).to_dict("records"):
        cells = [f"{row['agent']} {row['risk measure']}".strip(), row["β"]]
        for direction in ("forward", "reverse"):
            cells.append(row[f"{direction} finished"])
            for number in ("collisions", "time, s"):
                paper = row[f"{direction} {number}, paper"]
                cells.append(f"{row[f'{direction} {number}']} ({paper})" if paper else row[f"{direction} {number}"])
        rows.append(cells)
    return _markdown(_COURSE_HEADINGS, rows)


def _driven(names: Sequence[str]) -> dict[str, pd.DataFrame]:
    return {name: pd.read_csv(ROOT / "results" / "disturbances" / f"{name}.csv") for name in names}


def table_of_disturbances(driven: Mapping[str, pd.DataFrame]) -> str:
    """Return what disturbances cost, Markdown: a row a disturbance, the first of them none.

    Args:
        driven: of each name episodes, with their ``disturbance``, ``map``, ``collisions`` and ``reward``.
    """
    rows: dict[str, list[str]] = {}
    for table in driven.values():
        undisturbed = _by_map(table, "none")
        for disturbance in table["disturbance"].unique():
            found = _by_map(table, disturbance)
            cells = [f"{found['collisions'].mean():.2f} / {found['reward'].mean():.0f}", ""]
            if disturbance != "none":
                more = compare(found["collisions"], undisturbed["collisions"]).difference
                cells[1] = f"{more.value:+.2f} [{more.low:+.2f}, {more.high:+.2f}]"
            rows.setdefault(disturbance, []).extend(cells)
    headings = [heading for name in driven for heading in (name, "more collisions")]
    return _markdown(["disturbance", *headings], [[disturbance, *cells] for disturbance, cells in rows.items()])


def _by_map(table: pd.DataFrame, disturbance: str) -> dict[str, Floats]:
    """Return collisions and reward of what was driven under a disturbance, [1, M, E]."""
    rows = table[table["disturbance"] == disturbance].set_index(["map", "episode"])
    return {name: rows[name].unstack("episode").to_numpy(float)[None] for name in ("collisions", "reward")}


def _markdown(headings: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    lines = [f"| {' | '.join(cells)} |\n" for cells in (headings, *rows)]
    return "".join([lines[0], f"|{'---|' * len(headings)}\n", *lines[1:]])


@cache
def measured_of(name: str) -> Mapping[str, Any]:
    """Return what was measured of an agent that ships, or of a baseline.

    Raises:
        SystemExit: if there is neither.
    """
    path = ROOT / "weights" / name / "measured.json"
    if path.is_file():
        values: dict[str, Any] = json.loads(path.read_text(encoding="utf-8"))
        return values
    evaluations = sorted((ROOT / "results" / name).glob("evaluation/*"))
    if len(evaluations) != 1:
        raise SystemExit(f"{name} is neither in weights/ nor, with one evaluation, in results/: correct the comment")
    return measured_values(evaluations[0])


def _cells(condition: Mapping[str, Any]) -> list[str]:
    metrics = condition["metrics"]
    collisions, reward = (
        f"{of['mean']:{form}} [{of['low']:{form}}, {of['high']:{form}}]"
        for of, form in ((metrics["collisions"], ".2f"), (metrics["reward"], ".0f"))
    )
    free, goals = metrics["collision_free"]["mean"], metrics["goals"]["mean"]
    return [condition["label"], collisions, reward, f"{100 * free:.0f} %", f"{goals:.2f}"]


def accelerator_table(values: Mapping[str, Any] | None) -> str:
    """Return what was measured of an accelerator, Markdown: a row a number.

    Args:
        values: what ``benchmarks/accelerator.py`` has written; None: nobody has called it where there is one.
    """
    if values is None:
        return "No machine with a GPU was at hand yet: all of it is unmeasured.\n"
    rows = [
        (part, name.replace("_", " "), f"{value:.4g}" if isinstance(value, float) else str(value))
        for part, found in values.items()
        if isinstance(found, Mapping)
        for name, value in found.items()
    ]
    return "".join(f"| {' | '.join(cells)} |\n" for cells in (("part", "", ""), ("---",) * 3, *rows))


def _card_in(folder: Path) -> str:
    """Return the card of a shipped agent, as ``publish`` would write it today."""
    weights = read_weights(folder)
    return card_of(weights, weights.measured)


if __name__ == "__main__":
    for document in (*DOCUMENTS, *CARDS):
        text = document.read_text(encoding="utf-8")
        if (new := _card_in(document.parent) if document in CARDS else renewed(text)) != text:
            document.write_text(new, encoding="utf-8")
            print(f"{document.relative_to(ROOT)}: written anew")
