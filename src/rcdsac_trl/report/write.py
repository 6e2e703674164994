"""A report's folder: the table in four formats, the statistics, the figures, and one page that holds them all."""

from collections.abc import Sequence
from pathlib import Path

import pandas as pd
from matplotlib.figure import Figure

from rcdsac_trl.report import collision_report, findings, learning, table
from rcdsac_trl.report.figures import beta_response, collision_causes, learning_curves, paired_differences
from rcdsac_trl.report.page import Part, page
from rcdsac_trl.report.read import METRIC_NAMES, Episodes
from rcdsac_trl.report.statistics import CONFIDENCE, PERMUTATIONS

_ADAPTIVE = (
    "Controllers turn beta while the agent drives. Each is compared, map by map, with the best of the fixed betas on "
    "the same maps, starts and goals: the one with the fewest collisions, or with the most reward. That one is chosen "
    "by these very episodes, which favours it a little. p-values are adjusted by Holm's method for the number of "
    "controllers.",
    "clearance: by the nearest thing the sensor sees. tail_variance: by the lower tail of the return that the critics "
    "expect. bandit (of earlier versions): one beta an episode, chosen by the returns of the episodes before, over the "
    "maps in their order; so its maps are not independent, and its interval and p-value are a rough guide.",
)


_CAUSES = (
    "Collisions an episode by what was hit. Hatched in the figure: the contact lay where the sensor has no sector, so "
    "the agent could not see it coming at that moment.",
    "Last sensed: before the contact, the last moment at which the smallest distance in a sector of the sensor was to "
    "what was then hit (of walls and boxes, to the part within 0.5 m of the contact). The median leaves out "
    "what was never sensed. Evaluations of older versions say nothing of this and are missing here.",
)


def write_report(episodes: Episodes, folders: Sequence[Path], out: Path) -> None:
    """Write everything.

    Args:
        episodes: of all evaluations.
        folders: as they were named; learning curves are drawn of those that are runs.
        out: the folder; it may exist.
    """
    out.mkdir(parents=True, exist_ok=True)
    paper = table.comparison(episodes)
    table.write_table(paper, out / "table")
    summary, pairs, trends = findings.summary(episodes), findings.comparisons(episodes), findings.trends(episodes)
    turned = findings.adaptive(episodes)
    means = pd.concat([table.averages(table.paper_table()).assign(source="paper"), _own_averages(episodes)])
    tables = {"summary": summary, "comparisons": pairs, "trends": trends, "averages": means}
    if len(turned):
        tables["adaptive"] = turned
    hit = collision_report.of_episodes(episodes, findings.labels(episodes))
    if len(hit):
        tables["collision_summary"] = hit
    for name, values in tables.items():
        values.to_csv(out / f"{name}.csv", index=False, float_format="%.6g")
    figures = _figures(episodes, folders)
    if len(hit):
        figures["collision_causes"] = collision_causes(hit)
    for name, figure in figures.items():
        figure.savefig(out / f"{name}.png", dpi=130)
    sections = _sections(episodes, paper, summary, pairs, trends, means, turned, hit, figures)
    (out / "report.html").write_text(page("What was found", sections), encoding="utf-8")


def _own_averages(episodes: Episodes) -> pd.DataFrame:
    return table.averages(table.own_table(episodes)).assign(source="here")


def _figures(episodes: Episodes, folders: Sequence[Path]) -> dict[str, Figure]:
    figures: dict[str, Figure] = {}
    for measure in episodes.conditions["measure"].dropna().unique():
        if (figure := beta_response(episodes, measure)) is not None:
            figures[f"beta_response_{measure}"] = figure
    for sensor, reference in _references(episodes).items():
        for metric in ("collisions", "reward"):
            figures[f"differences_{metric}_{sensor}"] = paired_differences(episodes, reference, metric)
    if runs := learning.validation_of_runs(folders):
        figures["learning_curves"] = learning_curves(runs)
    return figures


def _references(episodes: Episodes) -> dict[str, int]:
    """Choose the condition that all others of a sensor are compared with: a baseline that knows no risk, if any.

    A sensor with one condition has none.
    """
    chosen = {}
    for sensor, conditions in episodes.conditions.groupby("sensor", sort=False):
        agents = conditions["agent"].tolist()
        if len(agents) > 1:
            at = next((agents.index(name) for name in ("sac", "pursuit") if name in agents), 0)
            chosen[str(sensor)] = int(conditions.index[at])
    return chosen


def _sections(
    episodes: Episodes,
    paper: pd.DataFrame,
    summary: pd.DataFrame,
    pairs: pd.DataFrame,
    trends: pd.DataFrame,
    means: pd.DataFrame,
    turned: pd.DataFrame,
    hit: pd.DataFrame,
    figures: dict[str, Figure],
) -> list[tuple[str, list[Part]]]:
    kept = episodes.protocol
    maps, each = kept["num_maps"], kept["num_episodes"]
    seeds = episodes.table.groupby(["agent", "sensor", "beta", "collision_weight"], dropna=False)[
        "train_seed"
    ].nunique()
    names = findings.labels(episodes)
    with_reference = [names[i] for i in _references(episodes).values()]
    shown = pairs[pairs["first"].isin(with_reference) | pairs["second"].isin(with_reference)] if len(pairs) else pairs
    learnt: list[Part] = [figure for name, figure in figures.items() if name == "learning_curves"]
    sections: list[tuple[str, list[Part]]] = [
        (
            "The table",
            [
                f"Mean ± standard deviation over {maps * each} episodes a training seed: {maps} {kept['split']} maps x "
                f"{each}, root seed {kept['seed']}. Every agent met the same maps, starts and goals. Training seeds an "
                f"agent and setting: {seeds.min()}" + ("." if seeds.min() == seeds.max() else f" to {seeds.max()}."),
                "The paper's numbers come from its own maps, which are not available: read them beside ours as an "
                "order of magnitude, and compare the agents of one source with each other.",
                paper,
                "Averages over both risk measures at the two settings of each that DSAC has, as in the paper's text.",
                _text(means),
            ],
        ),
        (
            "What beta does",
            [
                "Shaded: where the value lies with "
                f"{CONFIDENCE:.0%} confidence, if other maps of the same kind had been drawn, and other training "
                "seeds, where there are several.",
                *(figure for name, figure in figures.items() if name.startswith("beta_response")),
                "Does it hold map by map? Page's test for an order, maps as blocks. Correlation 1 means that the "
                f"metric rises with beta on every map, -1 that it falls on every map. p-values by {PERMUTATIONS:,} "
                "permutations within the maps, two-sided, one test at a time. They speak of these trained agents.",
                _text(trends) if len(trends) else "No agent was driven at three betas or more.",
            ],
        ),
        (
            "Who is better than whom",
            [
                *(figure for name, figure in figures.items() if name.startswith("differences")),
                "The column better is the probability that an episode of the first agent beats one of the second on "
                "the same map (fewer collisions, more reward). p-values: sign permutations over maps, with the error "
                "of the training seeds where there are several, adjusted by Holm's method for the number of pairs. "
                "With one training seed they speak of these trained agents, not of the algorithms.",
                _text(shown) if len(shown) else "There is only one agent.",
                "All other pairs are in comparisons.csv.",
            ],
        ),
        (
            "Everything measured",
            [
                f"Value [{CONFIDENCE:.0%} interval over maps, and over training seeds where there are several].",
                _wide(summary),
            ],
        ),
    ]
    if len(hit):
        sections.insert(
            -1, ("Why does it still collide?", [*_CAUSES, collision_report.wide(hit), figures["collision_causes"]])
        )
    if len(turned):
        sections.insert(2, ("Does it pay to turn beta?", [*_ADAPTIVE, _text(turned)]))
    return [*sections, ("Learning", learnt)] if learnt else sections


def _wide(summary: pd.DataFrame) -> pd.DataFrame:
    """Lay the summary out with a row a condition."""
    cells = summary.assign(
        text=[f"{row.value:.3g} [{row.low:.3g}, {row.high:.3g}]" for row in summary.itertuples(index=False)],
        statistic=summary["statistic"].map(lambda name: METRIC_NAMES.get(name, name)),
    )
    wide = cells.pivot(index="condition", columns="statistic", values="text")
    ordered = wide.loc[cells["condition"].drop_duplicates(), cells["statistic"].drop_duplicates()]
    return ordered.rename_axis(None, axis=1).reset_index()


def _text(values: pd.DataFrame) -> pd.DataFrame:
    """Write numbers with three digits."""
    return values.map(lambda value: f"{value:.3g}" if isinstance(value, float) else str(value))
