"""The paper's table: collisions and rewards of every agent, beside the paper's own numbers.

The paper's numbers are ``paper.csv``: table "Performance evaluation against baselines" of Choi, Dance, Kim, Hwang and
Park (2021), *Risk-Conditioned Distributional Soft Actor-Critic for Risk-Sensitive Navigation*, under the names of our
rows. Mean and standard deviation over 500 episodes, 50 maps x 10.
"""

from pathlib import Path

import pandas as pd

from rcdsac_trl.report.read import Episodes

SENSORS = ("narrow", "sparse")
TABULATED = ("collisions", "reward")
KEY = ["agent", "beta", "collision_weight"]


def paper_table() -> pd.DataFrame:
    """Return the paper's numbers, one row an agent, setting and sensor."""
    return pd.read_csv(Path(__file__).with_name("paper.csv"))


def own_table(episodes: Episodes) -> pd.DataFrame:
    """Return mean and standard deviation (ddof 0) over the episodes, in the form of :func:`paper_table`."""
    fixed = episodes.table[episodes.table["beta_controller"].isna()]  # the paper turns no beta
    groups = fixed.groupby([*KEY, "sensor"], dropna=False, sort=False)
    parts: dict[str, pd.Series] = {"episodes": groups.size()}
    for metric in TABULATED:
        parts |= {f"{metric}_mean": groups[metric].mean(), f"{metric}_std": groups[metric].std(ddof=0)}
    return pd.DataFrame(parts).reset_index().merge(_names(), on="agent", how="left")


def averages(table: pd.DataFrame) -> pd.DataFrame:
    """Average over both measures, at the two settings each that the paper evaluates DSAC at, as its text does.

    Args:
        table: from :func:`paper_table` or :func:`own_table`.

    Returns:
        `name`, `sensor`, `collisions` and `reward`, for each name of which all four rows are there.
    """
    paper = paper_table()
    wanted = pd.MultiIndex.from_frame(paper[paper["name"] == "DSAC"][["psi", "beta"]].drop_duplicates())
    rows = []
    for (name, sensor), part in table.groupby(["name", "sensor"], sort=False):
        found = part.set_index(["psi", "beta"])
        if wanted.isin(found.index).all():
            means = found.loc[wanted, ["collisions_mean", "reward_mean"]].mean()
            rows.append((name, sensor, means["collisions_mean"], means["reward_mean"]))
    return pd.DataFrame(rows, columns=["name", "sensor", "collisions", "reward"])


def condition_label(
    agent: str, sensor: str, beta: float, weight: float, controller: str | None, sensors: int = 1
) -> str:
    """Name a condition in figures and lists; the sensor only where there are several."""
    if isinstance(controller, str):
        told = f" β by {controller.replace('_', ' ')}"
    else:
        told = f" β = {beta:g}" if pd.notna(beta) else f" w_coll = {weight:g}" if pd.notna(weight) else ""
    return f"{row_label(agent)}{told}{', ' + sensor if sensors > 1 else ''}"


def row_label(agent: str) -> str:
    """Name a row as the paper does, with its measure.

    Example:
        >>> row_label("rcdsac_pow"), row_label("sac"), row_label("mine")
        ('RC-DSAC (resample) pow', 'SAC', 'mine')
    """
    return " ".join(part for part in _called(agent) if part)


def _names() -> pd.DataFrame:
    """Return what the paper calls each of our rows, and the row's measure."""
    return paper_table()[["agent", "name", "psi"]].drop_duplicates()


def _called(agent: str) -> tuple[str, str]:
    """Return the paper's name and measure of a row; its own name where the paper has none."""
    names = _names().set_index("agent").fillna("")
    return (str(names.at[agent, "name"]), str(names.at[agent, "psi"])) if agent in names.index else (agent, "")


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
        [(*_called(agent), _setting(beta, weight)) for agent, beta, weight in order.itertuples(index=False)],
        columns=pd.MultiIndex.from_tuples([("", "agent"), ("", "ψ"), ("", "β")]),
    )
    there = list(own["sensor"].unique())
    for sensor in sorted(there, key=lambda name: (*SENSORS, name).index(name)):
        for metric in TABULATED:
            for label, source in (("", own), (", paper", paper)):
                of_sensor = order.merge(source[source["sensor"] == sensor], on=KEY, how="left")
                decimals = 2 if metric == "collisions" else 1
                cells = [
                    "" if pd.isna(mean) else f"{mean:.{decimals}f} ± {std:.{decimals}f}"
                    for mean, std in zip(of_sensor[f"{metric}_mean"], of_sensor[f"{metric}_std"], strict=True)
                ]
                out[(sensor, f"{metric}{label}")] = cells
    return out


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
