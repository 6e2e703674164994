"""The paper's table: collisions and rewards of every agent, beside the paper's own numbers."""

from pathlib import Path

import numpy as np
import pandas as pd

from rcdsac_trl.report.formats import interval, number
from rcdsac_trl.report.read import Episodes, possible
from rcdsac_trl.report.rows import called, condition_label, paper_table
from rcdsac_trl.report.statistics import CONFIDENCE_TEXT, bootstrap
from rcdsac_trl.report.training_errors import training_errors

SENSORS = ("narrow", "sparse")
TABULATED = ("collisions", "reward")
KEY = ["agent", "beta", "collision_weight"]


def own_table(episodes: Episodes) -> pd.DataFrame:
    """Return our numbers in the form of :func:`paper_table`, with `low` and `high` of each mean's interval beside it.

    Standard deviations (ddof 0) are over the episodes, as the paper's; intervals are over maps, and over trainings
    where it is known how these differ.
    """
    conditions = episodes.conditions
    rows, errors = [], training_errors(episodes)
    for _, condition in conditions[conditions["beta_controller"].isna()].iterrows():  # the paper turns no beta
        row = {key: condition[key] for key in [*KEY, "sensor"]}
        for metric in TABULATED:
            values = episodes.of(condition, metric)
            found = bootstrap(values, error=errors.of(condition, metric)).within(*possible(metric))
            row |= {f"{metric}_mean": found.value, f"{metric}_std": np.nanstd(values)}
            bounds = (found.low, found.high) if values.shape[1] > 1 else (np.nan, np.nan)  # one map tells none
            row |= dict(zip((f"{metric}_low", f"{metric}_high"), bounds, strict=True))
        rows.append(row)
    return pd.DataFrame(rows)


def missing_rows(episodes: Episodes) -> dict[str, list[str]]:
    """Return the rows of the paper's table that were not driven, by sensor."""
    own = episodes.conditions
    driven = own[own["beta_controller"].isna()][[*KEY, "sensor"]]
    found = paper_table().merge(driven, on=[*KEY, "sensor"], how="left", indicator=True)
    absent = found[found["_merge"] == "left_only"]
    return {
        sensor: [
            condition_label(agent, sensor, beta, weight, None)
            for agent, beta, weight in absent.loc[absent["sensor"] == sensor, KEY].itertuples(index=False)
        ]
        for sensor in SENSORS
    }


def _pairs(table: pd.DataFrame) -> list[tuple[str, str]]:
    """Return the columns of :func:`comparison`: sensor and what of it."""
    return [(str(pair[0]), str(pair[1])) for pair in table.columns.to_flat_index()]


def comparison(episodes: Episodes) -> pd.DataFrame:
    """Return our numbers and the paper's side by side, one row an agent and setting.

    Columns are pairs: a sensor and what of it. Rows are in the paper's order, what it lacks behind.
    """
    own, paper = own_table(episodes), paper_table()
    order = pd.concat([paper[KEY], own[KEY]]).drop_duplicates()
    order = order.merge(own[KEY].drop_duplicates(), on=KEY)  # the rows we have, in the paper's order
    out = pd.DataFrame(
        [(*called(agent), _setting(beta, weight)) for agent, beta, weight in order.itertuples(index=False)],
        columns=pd.MultiIndex.from_tuples([("", "agent"), ("", "risk measure"), ("", "β or weight")]),
    )
    there = list(own["sensor"].unique())
    for sensor in sorted(there, key=lambda name: (*SENSORS, name).index(name)):
        of_own, of_paper = (
            order.merge(source[source["sensor"] == sensor], on=KEY, how="left") for source in (own, paper)
        )
        for metric in TABULATED:
            out[(sensor, metric)] = _spreads(of_own, metric)
            out[(sensor, f"{metric}, {CONFIDENCE_TEXT}")] = intervals(of_own, metric)
            out[(sensor, f"{metric}, paper")] = _spreads(of_paper, metric)
    return out


def _spreads(rows: pd.DataFrame, metric: str) -> list[str]:
    """Write mean ± standard deviation with the paper's decimals; nothing where there is none."""
    pairs = zip(rows[f"{metric}_mean"], rows[f"{metric}_std"], strict=True)
    return ["" if pd.isna(mean) else f"{number(mean, metric)} ± {number(std, metric)}" for mean, std in pairs]


def intervals(rows: pd.DataFrame, metric: str, of: str = "", signed: bool = False) -> list[str]:
    """Write the intervals of a metric, or of what stands `of` behind its name; nothing where there is none."""
    pairs = zip(rows[f"{metric}{of}_low"], rows[f"{metric}{of}_high"], strict=True)
    return ["" if pd.isna(low) else interval(low, high, metric, signed) for low, high in pairs]


def write_table(table: pd.DataFrame, stem: Path) -> None:
    """Write a table of text as ``.md``, ``.csv``, ``.tex`` and ``.html``.

    Args:
        table: its columns are pairs, as from :func:`comparison`.
        stem: the files' path without suffix.
    """
    flat = flattened(table)
    stem.with_suffix(".csv").write_text(flat.to_csv(index=False), encoding="utf-8")
    stem.with_suffix(".md").write_text(markdown(flat), encoding="utf-8")
    stem.with_suffix(".tex").write_text(latex(table), encoding="utf-8")
    stem.with_suffix(".html").write_text(html(table), encoding="utf-8")


def flattened(table: pd.DataFrame) -> pd.DataFrame:
    """Return a table whose pairs of columns are single names."""
    return table.set_axis([f"{group} {name}".strip() for group, name in _pairs(table)], axis="columns")


def markdown(table: pd.DataFrame) -> str:
    """Return a table of text as Markdown."""
    lines = [list(map(str, table.columns)), ["---"] * table.shape[1], *table.to_numpy().tolist()]
    return "".join("| " + " | ".join(line) + " |\n" for line in lines)


def latex(table: pd.DataFrame) -> str:
    """Return a table of text as a LaTeX ``tabular`` that needs no package."""
    groups = [group for group, _ in _pairs(table)]
    spans = [(group, groups.count(group)) for group in dict.fromkeys(groups)]
    top = " & ".join(f"\\multicolumn{{{span}}}{{c}}{{{_tex(group)}}}" for group, span in spans)
    body = [[name for _, name in _pairs(table)], *table.to_numpy().tolist()]
    lines = [" & ".join(map(_tex, row)) + r" \\" for row in body]
    begin = [rf"\begin{{tabular}}{{{'l' * table.shape[1]}}}", r"\hline", top + r" \\", lines[0], r"\hline"]
    return "\n".join([*begin, *lines[1:], r"\hline", r"\end{tabular}", ""])


def html(table: pd.DataFrame) -> str:
    """Return a table of text as an HTML table."""
    return str(table.to_html(index=False, border=0, na_rep="")) + "\n"


def _setting(beta: float, weight: float) -> str:
    if pd.notna(beta):
        return f"{beta:g}"
    return f"w_coll = {weight:g}" if pd.notna(weight) else ""


def _tex(text: object) -> str:
    special = {"ψ": r"$\psi$", "β": r"$\beta$", "±": r"$\pm$", "_": r"\_", "%": r"\%", "-": "$-$"}
    words = str(text)
    # A minus sign, but no hyphen.
    if not words.lstrip("-").replace(".", "").isdigit():
        special.pop("-")
    return "".join(special.get(letter, letter) for letter in words)
