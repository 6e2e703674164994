"""The paper's second table and a picture of the runs, from what ``course`` wrote.

The paper's numbers are ``paper_course.csv``: table "Results of real-world experiment" of Choi, Dance, Kim, Hwang and
Park (2021), under the names of our rows: one run an agent, setting and direction, on a real robot in their own office.
"""

import json
import math
from pathlib import Path
from typing import Any

import pandas as pd
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Circle, Patch, Polygon

from rcdsac_trl.colors import LIGHT
from rcdsac_trl.report.statistics import CONFIDENCE_TEXT, bootstrap
from rcdsac_trl.report.style import INK
from rcdsac_trl.report.table import markdown

DIRECTIONS = ("forward", "reverse")
KEY = ["run", "agent", "beta"]

_SHAPES = {"wall": LIGHT.wall, "glass": LIGHT.glass, "known": LIGHT.mapped, "unknown": LIGHT.unmapped}
_SHAPE_NAMES = {
    "wall": "wall",
    "glass": "glass, which cameras do not see",
    "known": "furniture the planner knows",
    "unknown": "furniture it does not know",
}
_COLORS = {"forward": LIGHT.robot, "reverse": LIGHT.mover}
_COURSE = LIGHT.way
_COLLISION = LIGHT.touching
_PANEL_INCHES = 6.4
_MAX_COLUMNS = 2


def paper_course() -> pd.DataFrame:
    """Return the paper's numbers, one row an agent, setting and direction."""
    return pd.read_csv(Path(__file__).with_name("paper_course.csv"))


def course_table(runs: pd.DataFrame) -> pd.DataFrame:
    """Return the paper's second table: our numbers beside the paper's, as text, one row an agent and setting.

    Collisions and required time are mean ± standard deviation (ddof 0) over the repetitions. A run that did not finish
    counts with its collisions until the time limit, and has no required time; `finished` says how many did. The last
    column is the mean over the runs of both directions with its interval, in which a run is the unit.

    Args:
        runs: ``runs.csv``.
    """
    paper = paper_course()
    named = paper[["agent", "name", "psi"]].drop_duplicates().fillna("")
    names = {agent: (name, psi) for agent, name, psi in named.itertuples(index=False)}
    rows = []
    for (run, agent, setting), group in runs.groupby(KEY, dropna=False, sort=False):
        beta = float(str(setting))
        row = {"run": Path(str(run)).name}
        row["agent"], row["risk measure"] = names.get(str(agent), (str(agent), ""))
        row["β"] = "" if pd.isna(beta) else f"{beta:g}"
        for direction in DIRECTIONS:
            part = group[group["direction"] == direction]
            there = paper[(paper["agent"] == agent) & _is(paper, beta) & (paper["direction"] == direction)]
            row[f"{direction} finished"] = f"{int(part['finished'].sum())} of {len(part)}"
            row[f"{direction} collisions"] = _spread(part["collisions"], 1)
            row[f"{direction} collisions, paper"] = "".join(f"{value:g}" for value in there["collisions"])
            row[f"{direction} time, s"] = _spread(part.loc[part["finished"], "time_s"], 0)
            row[f"{direction} time, s, paper"] = "".join(f"{value:g}" for value in there["time_s"])
        interval = bootstrap(group["collisions"].to_numpy(float)[None, :, None]).within(0.0, math.inf)
        row[f"collisions a run, {CONFIDENCE_TEXT}"] = f"{interval.value:.1f} [{interval.low:.1f}, {interval.high:.1f}]"
        rows.append(row)
    return pd.DataFrame(rows)


def course_figure(runs: pd.DataFrame, traces: pd.DataFrame, office: dict[str, Any]) -> Figure:
    """Draw the office from above with all runs of an agent and setting in one panel.

    Args:
        runs: ``runs.csv``.
        traces: ``traces.csv``.
        office: ``office.json``.
    """
    panels = list(traces.groupby(KEY, dropna=False, sort=False))
    columns = min(len(panels), _MAX_COLUMNS)
    lines = -(-len(panels) // columns)
    size = (columns * _PANEL_INCHES, lines * (_PANEL_INCHES + 0.4) + 0.8)
    figure = Figure(figsize=size, layout="constrained")
    for number, ((run, agent, setting), part) in enumerate(panels):
        beta = float(str(setting))
        axes = figure.add_subplot(lines, columns, number + 1)
        driven = runs[(runs["run"] == run) & (runs["agent"] == agent) & _is(runs, beta)]
        _draw_office(axes, office)
        _draw_runs(axes, part)
        axes.set_title(_title(agent, beta, driven), loc="left", fontsize=11, color=INK)
    figure.legend(handles=_legend(), loc="outside lower center", ncols=2 * columns, frameon=False, labelcolor=INK)
    return figure


def write_course(folder: Path) -> str:
    """Write ``table.csv``, ``table.md`` and ``course.png`` into a folder that ``course`` wrote.

    Returns:
        The table as text.
    """
    runs, traces = (pd.read_csv(folder / f"{name}.csv") for name in ("runs", "traces"))
    table = course_table(runs)
    table.to_csv(folder / "table.csv", index=False)
    (folder / "table.md").write_text(markdown(table), encoding="utf-8")
    office = json.loads((folder / "office.json").read_text(encoding="utf-8"))
    course_figure(runs, traces, office).savefig(folder / "course.png", dpi=110)
    return str(table.set_index(["run", "agent", "risk measure", "β"]).T.to_string())


def _spread(values: pd.Series, decimals: int) -> str:
    return f"{values.mean():.{decimals}f} ± {values.std(ddof=0):.{decimals}f}" if len(values) else ""


def _is(table: pd.DataFrame, beta: float) -> "pd.Series[bool]":
    """Say which rows are of a setting, NaN for none."""
    return table["beta"].isna() if pd.isna(beta) else table["beta"] == beta


def _title(agent: object, beta: float, runs: pd.DataFrame) -> str:
    told = "" if pd.isna(beta) else f"  β = {beta:g}"
    finished = f"{int(runs['finished'].sum())} of {len(runs)} runs finished"
    return f"{agent}{told}:  {finished}, {runs['collisions'].mean():.1f} collisions a run"


def _draw_office(axes: Axes, office: dict[str, Any]) -> None:
    size = office["size_m"]
    axes.set(xlim=(0, size), ylim=(0, size), aspect="equal", xticks=[], yticks=[])
    axes.set_facecolor(LIGHT.floor)
    axes.spines[:].set_visible(False)
    for shape in office["shapes"]:
        color = _SHAPES[shape["kind"]]
        if "corners" in shape:
            axes.add_patch(Polygon(shape["corners"], facecolor=color))
        else:
            # A pole of 5 cm would be less than a pixel.
            axes.add_patch(Circle(shape["centre"], max(shape["radius"], 0.06), facecolor=color))
    x, y = zip(*office["course"], strict=True)
    axes.plot(x, y, color=_COURSE, linewidth=1.0, linestyle=(0, (4, 3)), zorder=2)
    axes.scatter([x[0], x[-1]], [y[0], y[-1]], s=46, color=_COURSE, zorder=5)
    axes.annotate("A", (x[0], y[0]), (-11, -3), textcoords="offset points", color=_COURSE, weight="bold")
    axes.annotate("B", (x[-1], y[-1]), (7, -3), textcoords="offset points", color=_COURSE, weight="bold")


def _draw_runs(axes: Axes, traces: pd.DataFrame) -> None:
    for (direction, _), steps in traces.groupby(["direction", "repetition"], sort=False):
        axes.plot(steps["x_m"], steps["y_m"], color=_COLORS[str(direction)], linewidth=1.4, alpha=0.75, zorder=3)
        contact = steps["in_contact"].astype(bool)
        onsets = steps[contact & ~contact.shift(fill_value=False)]
        axes.scatter(onsets["x_m"], onsets["y_m"], s=42, marker="x", color=_COLLISION, linewidths=1.6, zorder=4)
        last = steps.iloc[-1]
        axes.scatter([last["x_m"]], [last["y_m"]], s=26, color=_COLORS[str(direction)], edgecolor=LIGHT.card, zorder=6)


def _legend() -> list[Line2D | Patch]:
    lines = [Line2D([], [], color=color, label=f"driven {name}") for name, color in _COLORS.items()]
    course = Line2D([], [], color=_COURSE, linestyle=(0, (4, 3)), label="the course, A to B: 53.7 m")
    collision = Line2D([], [], color=_COLLISION, marker="x", linestyle="", label="a collision begins")
    patches = [Patch(facecolor=color, label=_SHAPE_NAMES[kind]) for kind, color in _SHAPES.items()]
    return [course, *lines, collision, *patches]
