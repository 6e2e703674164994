"""What the page of a report says, section by section: the verdicts first."""

from collections.abc import Callable, Sequence

import pandas as pd

from rcdsac_trl.report import collision_report, findings, table
from rcdsac_trl.report.averages import FIRST, trainings_told
from rcdsac_trl.report.comparison_figures import collision_causes, paired_differences
from rcdsac_trl.report.course_claims import COURSE
from rcdsac_trl.report.course_table import DIRECTIONS
from rcdsac_trl.report.formats import heading, interval, number, p_value
from rcdsac_trl.report.learning_figures import learning_panels
from rcdsac_trl.report.page import Card, Figures, Folded, Heading, Part, Section
from rcdsac_trl.report.read import METRIC_NAMES
from rcdsac_trl.report.response_figures import beta_panels
from rcdsac_trl.report.results import Results
from rcdsac_trl.report.rows import condition_label
from rcdsac_trl.report.statistics import CONFIDENCE_TEXT, PERMUTATIONS
from rcdsac_trl.report.verdict_words import evidence, missing, numbers, of_agents, over, tally
from rcdsac_trl.report.verdicts import COMPARABLE, Finding, Verdict

_VERDICTS = (
    f"A claim holds, or does not, where the {CONFIDENCE_TEXT} interval of the difference says so. Otherwise it cannot "
    "be told. Differences are paired: all agents met the same maps, starts and goals. Intervals are over maps, and "
    "over trainings where some agent of the sensor has several: how these differ is pooled over all agents, and counts "
    "for those with one training, too. Where each has one, intervals speak of these agents alone: another may differ.",
    f"Differences below {100 * COMPARABLE:.0f} % of the mean count as none. A claim about many rows fails only where "
    "one of them fails beyond what one of so many does by chance. The paper's numbers stand in brackets. Its maps are "
    "not available: compare differences, not levels.",
)
_ADAPTIVE = (
    "Controllers turn β while the agent drives. Each is compared, map by map, with the best of the fixed β on the same "
    "maps, starts and goals: the one with the fewest collisions, or with the most reward. That one is chosen by these "
    "very episodes, which favours it a little. p-values are adjusted by Holm's method for the number of controllers.",
    "clearance: by the nearest thing the sensor sees. tail_variance: by the lower tail of the return that the critics "
    "expect. bandit (of earlier versions): one β an episode, chosen by the returns of the episodes before. So its maps "
    "are not independent, and its interval and p-value are a rough guide.",
)
_CAUSES = (
    "Collisions an episode by what was hit. Hatched in the figure: the contact lay where the sensor has no sector, so "
    "the agent could not see it coming at that moment.",
    "Last sensed: before the contact, the last moment at which the smallest distance in a sector of the sensor was to "
    "what was then hit (of walls and boxes, to the part within 0.5 m of the contact). The median leaves out "
    "what was never sensed. Evaluations of older versions say nothing of this and are missing here.",
)


def title(results: Results) -> str:
    """Say who drove where, and what is asked of it."""
    agents = results.paper["", "agent"]  # in the paper's order
    names = list(dict.fromkeys(agent.split(" (")[0] for agent in agents))
    told = f"{', '.join(names[:-1])} and {names[-1]}" if len(names) > 1 else names[0]
    kept = results.episodes.protocol
    return f"{told} on {kept['num_maps']} {kept['split']} maps: which of the paper's claims hold"


def lead(results: Results) -> list[str]:
    """Say what was driven, and count the verdicts."""
    episodes, kept = results.episodes, results.episodes.protocol
    seeds = _seeds(results)
    sensors = " and ".join(episodes.conditions["sensor"].unique())
    steps = f" of {kept['task']['episode_steps']:,} steps" if "episode_steps" in kept["task"] else ""
    driven = (
        f"{len(episodes.conditions)} agents and settings drove {kept['num_maps']} maps × {kept['num_episodes']} "
        f"episodes{steps} (root seed {kept['seed']}, sensor {sensors}). Training seeds an agent: {seeds}."
    )
    counted = [f"Claims, {sensor}: {tally(of)}." for sensor, of in _by_sensor(results.claims).items() if _anything(of)]
    return [*counted, driven]


def sections(results: Results) -> list[Section]:
    """Return all sections that there is something for."""
    made = [
        Section("Do the paper's claims hold?", _verdicts(results)),
        Section("Collisions and reward beside the paper's", _paper(results)),
    ]
    if results.course is not None:
        made.append(Section("The office course beside the paper's", _course(results)))
    made.append(Section("What β does", _beta(results)))
    if len(results.adaptive):
        made.append(Section("Does it pay to turn β?", [*_ADAPTIVE, *_by_metric(results.adaptive, _adaptive)]))
    made.append(Section("Who is better than whom", _pairs(results)))
    if len(results.causes):
        hit = collision_report.wide(results.causes)
        made.append(Section("Why does it still collide?", [*_CAUSES, Figures([collision_causes(results.causes)]), hit]))
    if results.trainings["sd"].notna().any():
        made.append(Section("How far trainings lie apart", _trainings(results)))
    made.append(Section("Everything measured", _everything(results)))
    if results.learnt:
        panels = learning_panels(results.learnt)
        made.append(Section("How they learnt", ["Validation.", Figures(panels.figures, panels.legend)]))
    return made


def _seeds(results: Results) -> str:
    by = ["agent", "sensor", "beta", "collision_weight"]
    seeds = results.episodes.table.groupby(by, dropna=False)["train_seed"].nunique()
    return f"{seeds.min()}" if seeds.min() == seeds.max() else f"{seeds.min()} to {seeds.max()}"


# ------------------------------------------------------------------------------------------------ verdicts
def _by_sensor(claims: Sequence[Finding]) -> dict[str, list[Finding]]:
    named: dict[str, list[Finding]] = {}
    for finding in claims:
        sensor = finding.claim.sensor
        of = sensor if sensor == COURSE else f"{sensor} sensors" if " and " in sensor else f"{sensor} sensor"
        named.setdefault(of, []).append(finding)
    return named


def _anything(claims: Sequence[Finding]) -> bool:
    return any(finding.judged for finding in claims)


def _verdicts(results: Results) -> list[Part]:
    parts: list[Part] = [*_VERDICTS]
    for sensor, claims in _by_sensor(results.claims).items():
        told = [finding for finding in claims if finding.judged]
        untold = [finding for finding in claims if not finding.judged]
        parts.append(Heading(sensor[0].upper() + sensor[1:]))
        if told:
            parts.append([_card(finding) for finding in sorted(told, key=lambda one: one.verdict == Verdict.MISSING)])
        if untold:
            lacking = [(finding.claim.says, missing(finding)) for finding in untold]
            line = (
                f"{len(untold)} claim{'s' * (len(untold) > 1)} of which nothing could be compared: the runs they lack"
            )
            parts.append(Folded(line, [pd.DataFrame(lacking, columns=["claim", "not measured"])]))
    compared = evidence(results.claims)
    if len(compared):
        by_unit: list[Part] = []
        for unit, rows in compared.groupby("mean of", sort=False):
            by_unit += [Heading(str(unit)), rows.drop(columns="mean of")]
        parts.append(Folded(f"All {len(compared)} comparisons behind these verdicts, row by row", by_unit))
    return parts


def _card(finding: Finding) -> Card:
    alone, lacking = of_agents(finding), missing(finding)
    notes = [f"Interval over {over(finding)}."]
    notes += [f"Of these very agents, over the maps alone: {alone}"] if alone else []
    notes += [f"Not measured: {lacking}."] if lacking else []
    return Card(finding.claim.says, finding.verdict.value, numbers(finding), notes)


# ------------------------------------------------------------------------------------------------ the paper's tables
def _paper(results: Results) -> list[Part]:
    kept = results.episodes.protocol
    maps, each = kept["num_maps"], kept["num_episodes"]
    lacking = [f"{sensor}: {', '.join(rows)}" for sensor, rows in table.missing_rows(results.episodes).items() if rows]
    parts: list[Part] = [
        f"Mean ± standard deviation over {maps * each} episodes a training seed, as in the paper, and the "
        f"{CONFIDENCE_TEXT} interval of the mean over maps (and trainings, where an agent of the sensor has several).",
        _rows_named(results.paper),
    ]
    if lacking:
        parts.append(Folded("Rows of the paper's table that were not measured", [f"{line}." for line in lacking]))
    parts += [
        Heading("Averaged as in the paper's text"),
        "Over both risk measures, at the two settings of each that DSAC has; RCWR over its weights.",
        _averages(results.averages),
    ]
    return parts


def _rows_named(paper: pd.DataFrame) -> pd.DataFrame:
    """Put what names a row of the table into one column, and the units into the headings."""
    out = paper.iloc[:, 3:].copy()
    pairs = ((str(column[0]), str(column[1])) for column in out.columns.to_flat_index())
    columns = [(f"{sensor}: {heading(name.split(', ')[0])}", _part_of(name)) for sensor, name in pairs]
    out = out.set_axis(pd.MultiIndex.from_tuples(columns), axis="columns")
    out.insert(0, ("", "agent"), _named(paper.iloc[:, :3]))
    return out


def _part_of(column: str) -> str:
    """Return what stands above a column below its metric: the mean, its interval, or the paper's."""
    _, _, part = column.partition(", ")
    return part or "mean ± SD"


def _named(rows: pd.DataFrame) -> list[str]:
    """Name rows by agent, measure and setting."""
    settings = rows.iloc[:, 2].map(
        lambda told: f"β = {told}" if told and told[-1].isdigit() and "=" not in told else told
    )
    parts = zip(rows.iloc[:, 0], rows.iloc[:, 1], settings, strict=True)
    return [" ".join(part for part in row if part) for row in parts]


def _averages(means: pd.DataFrame) -> pd.DataFrame:
    """Lay averages out with a row an agent and sensor, ours beside the paper's."""
    keys = ["name", "sensor"]
    here, paper = (means[means["source"] == source] for source in ("here", "paper"))
    paper = paper[[*keys, *table.TABULATED]].rename(columns={metric: f"{metric}_paper" for metric in table.TABULATED})
    rows = means[keys].drop_duplicates().merge(here, how="left", on=keys).merge(paper, how="left", on=keys)
    columns: dict[tuple[str, str], list[str]] = {
        ("", "agent"): rows["name"].tolist(),
        ("", "sensor"): rows["sensor"].tolist(),
        ("", "trainings"): [trainings_told(row) for _, row in rows.iterrows()],
    }
    for metric in table.TABULATED:
        title = heading(metric)
        columns[title, "here"] = [number(value, metric) for value in rows[metric]]
        columns[title, CONFIDENCE_TEXT] = table.intervals(rows, metric)
        columns[title, f"{FIRST} from it"] = table.intervals(rows, metric, "_from", signed=True)
        columns[title, "paper"] = [number(value, metric) for value in rows[f"{metric}_paper"]]
    return pd.DataFrame(columns)


def _course(results: Results) -> list[Part]:
    assert results.course is not None
    names = ["agent", "risk measure", "β"]
    shown = results.course.drop(columns=[*names, "run"])
    shown = shown.set_axis(pd.MultiIndex.from_tuples([_course_column(str(name)) for name in shown]), axis="columns")
    shown.insert(0, ("", "agent"), _named(results.course[names]))
    return [
        "53.7 m through an office, forward and in reverse. Mean ± standard deviation over the runs; the paper drove "
        "each once. A run that did not arrive counts with its collisions until the time limit, and has no time.",
        shown,
    ]


def _course_column(name: str) -> tuple[str, str]:
    """Return direction and rest of a column of the course's table; the paper's stand behind ours."""
    way = next((way for way in DIRECTIONS if name.startswith(way)), "")
    rest = name.removeprefix(way).strip()
    return way, "paper" if rest.endswith("paper") else rest


# ------------------------------------------------------------------------------------------------ what follows
def _beta(results: Results) -> list[Part]:
    parts: list[Part] = [
        f"Averse at the left. Shaded: the {CONFIDENCE_TEXT} interval of these agents, if other maps of the same kind "
        "had been drawn. Paler, where some agent of the sensor has several trainings: if these had been others."
    ]
    for measure in results.measures:
        if panels := beta_panels(results.episodes, measure):
            parts += [Heading(f"Risk measure: {measure}"), Figures(panels.figures, panels.legend)]
    parts.append(Heading("Does it hold map by map?"))
    if not len(results.trends):
        return [*parts, "No agent was driven at three values of β or more."]
    return [
        *parts,
        "Page's test for an order, maps as blocks. Correlation 1: the metric rises with β on every map, -1: it falls "
        f"on every map. p-values by {PERMUTATIONS:,} permutations within the maps, two-sided, one test at a time. They "
        "speak of these trained agents.",
        _trends(results.trends),
    ]


def _trends(trends: pd.DataFrame) -> pd.DataFrame:
    sensors = trends["sensor"].nunique()
    agents = (
        condition_label(agent, sensor, float("nan"), float("nan"), None, sensors)
        for agent, sensor in zip(trends["agent"], trends["sensor"], strict=True)
    )
    names = {metric: heading(metric) for metric in findings.TRENDS} | {
        "worst_reward": "reward of a map's worst episode"
    }
    return pd.DataFrame(
        {
            "agent": list(agents),
            "metric": trends["metric"].map(names),
            "values of β": trends["settings"],
            "rank correlation with β": trends["correlation"].map("{:+.2f}".format),
            "p": trends["p_value"].map(p_value),
        }
    )


def _by_metric(rows: pd.DataFrame, shown: Callable[[pd.DataFrame, str], pd.DataFrame]) -> list[Part]:
    """Show rows with a table a metric, so that a column has one unit."""
    parts: list[Part] = []
    for metric, of in rows.groupby("metric", sort=False):
        parts += [Heading(heading(str(metric))), shown(of, str(metric))]
    return parts


def _adaptive(rows: pd.DataFrame, metric: str) -> pd.DataFrame:
    return pd.DataFrame(
        {
            "agent": rows["agent"],
            "sensor": rows["sensor"],
            "controller": rows["controller"],
            "mean β": rows["mean_beta"].map("{:.2f}".format),
            "mean": rows["value"].map(lambda value: number(value, metric)),
            "best fixed β": rows["best_beta"].map("{:g}".format),
            "its mean": rows["best_value"].map(lambda value: number(value, metric)),
            "difference": _differences(rows, metric),
            f"{CONFIDENCE_TEXT}": _difference_intervals(rows, metric),
            "p": rows["p_value"].map(p_value),
        }
    )


def _pairs(results: Results) -> list[Part]:
    if not len(results.comparisons):
        return ["There is only one agent and setting."]
    names = findings.labels(results.episodes)
    references = {names[at] for at in results.references.values()}
    figures = [
        paired_differences(results.episodes, reference, metric)
        for reference in results.references.values()
        for metric in findings.COMPARED
    ]
    pairs = results.comparisons
    shown = pairs[pairs["first"].isin(references) | pairs["second"].isin(references)]
    return [
        f"A dot a map; a thick line is the {CONFIDENCE_TEXT} interval of these agents over other maps, a thin one over "
        "other trainings, too, where some agent of the sensor has several.",
        Figures(figures),
        "Probability: that an episode of the first is better than one of the second on the same map (fewer collisions, "
        "more reward). p-values: sign permutations over maps, with the error of the trainings where some agent has "
        "several, adjusted by Holm's method for the number of pairs. Where each has one they speak of these trained "
        "agents, not of the algorithms.",
        *_by_metric(shown, _compared),
        "All other pairs are in comparisons.csv.",
    ]


def _compared(rows: pd.DataFrame, metric: str) -> pd.DataFrame:
    return pd.DataFrame(
        {
            "first": rows["first"],
            "second": rows["second"],
            "difference": _differences(rows, metric),
            f"{CONFIDENCE_TEXT}": _difference_intervals(rows, metric),
            "probability that the first is better": rows["better"].map("{:.2f}".format),
            f"its {CONFIDENCE_TEXT}": [
                f"[{low:.2f}, {high:.2f}]" for low, high in zip(rows["better_low"], rows["better_high"], strict=True)
            ],
            "p": rows["p_value"].map(p_value),
        }
    )


def _differences(rows: pd.DataFrame, metric: str) -> "pd.Series[str]":
    return rows["difference"].map(lambda value: number(value, metric, signed=True))


def _difference_intervals(rows: pd.DataFrame, metric: str) -> list[str]:
    return [interval(low, high, metric, signed=True) for low, high in zip(rows["low"], rows["high"], strict=True)]


def _trainings(results: Results) -> list[Part]:
    shown: list[Part] = []
    for metric, rows in results.trainings.groupby("metric", sort=False):
        names = [
            condition_label(agent, sensor, beta, float("nan"), None, 2)
            for agent, sensor, beta in rows[["agent", "sensor", "beta"]].itertuples(index=False)
        ]
        columns = {
            "agent": names,
            "trainings": rows["trainings"].astype(str).tolist(),
            "standard deviation": [number(value, str(metric)) for value in rows["sd"]],
            "the others'": [number(value, str(metric)) for value in rows["sd_others"]],
            "": ["for sure larger: not pooled" if apart else "" for apart in rows["apart"]],
        }
        shown += [Heading(METRIC_NAMES[str(metric)]), pd.DataFrame(columns)]
    return [
        "Of one setting, from training to training; the noise of the episodes is part of it. Pooled over the agents of "
        "a sensor it widens all intervals. An agent whose trainings for sure lie farther apart (p < 0.001) is not "
        "pooled: its own alone count for it.",
        *shown,
    ]


def _everything(results: Results) -> list[Part]:
    """Lay the summary out with a row a condition."""
    metrics = {name: metric for name, (metric, _) in findings.SUMMARISED.items()}
    rows = results.summary
    texts, columns = [], []
    for name, value, low, high in rows[["statistic", "value", "low", "high"]].itertuples(index=False):
        metric = metrics.get(name, name)
        texts.append("-" if pd.isna(value) else f"{number(value, metric)} {interval(low, high, metric)}")
        columns.append(name if name in metrics else heading(name))
    cells = rows[["condition"]].assign(text=texts, column=columns)
    wide = cells.pivot(index="condition", columns="column", values="text")
    ordered = wide.loc[cells["condition"].drop_duplicates(), cells["column"].drop_duplicates()]
    shown = ordered.rename_axis(None, axis=1).reset_index().rename(columns={"condition": "agent"})
    return [
        f"Mean [{CONFIDENCE_TEXT} interval over maps, and over trainings where an agent of the sensor has several].",
        shown,
    ]
