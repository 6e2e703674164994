"""The page of a replay: what an agent would have done over a recording, beside what was done.

It reads what ``replay`` wrote: ``commands.csv`` and ``replay.json``.
"""

import json
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from rcdsac_trl.colors import LIGHT
from rcdsac_trl.report.page import Picture, Section, page
from rcdsac_trl.report.style import FAINT, GRID, INK, style

_AGENT, _RECORDED, _MEASURED = LIGHT.robot, LIGHT.mover, LIGHT.mapped
_STOPPED, _LIMITED = LIGHT.alarm, LIGHT.unmapped
_TAIL = 0.1
# Velocities are drawn from here on both sides of 0, m/s or rad/s: what is less is nothing.
_LEAST_SHOWN = 0.1
_NOTE = (
    "Nothing moved by what the agent said: each command is for the place where the recorded robot was. Its memory is "
    "of what the sensors saw, and what it is told of its own commands is what it said here."
)
# A command is another one if it differs by more than this.
_SAME_V_M_PER_S, _SAME_OMEGA_RAD_PER_S = 0.1, 0.2


def summary_table(commands: pd.DataFrame) -> pd.DataFrame:
    """Return what happened in numbers, as text: one row each.

    Args:
        commands: ``commands.csv``.
    """
    driving = commands[commands["stopped"] == 0]
    limited = driving["cause"].fillna("") != ""
    rows = [
        ("control periods", f"{len(commands)}"),
        ("stands because it must", f"{_share(commands['stopped'] == 1)}"),
        ("limited by the guard", f"{_share(limited)} of those in which it drives"),
    ]
    for name, column in (("would have driven", ""), ("was measured", "measured_"), ("was told", "recorded_")):
        v, omega = driving[f"{column}v_m_per_s"], driving[f"{column}omega_rad_per_s"]
        if v.notna().any():
            turn = f"{omega.abs().mean():.2f} rad/s"
            rows.append((f"{name}, mean", f"{v.mean():.2f} m/s, {turn} either way"))
    reference = "recorded_" if driving["recorded_v_m_per_s"].notna().any() else "measured_"
    apart_v = (driving["v_m_per_s"] - driving[f"{reference}v_m_per_s"]).abs()
    apart_omega = (driving["omega_rad_per_s"] - driving[f"{reference}omega_rad_per_s"]).abs()
    known = apart_v.notna()
    same = (apart_v <= _SAME_V_M_PER_S) & (apart_omega <= _SAME_OMEGA_RAD_PER_S)
    what = "told" if reference == "recorded_" else "measured"
    rows.append(
        (f"within {_SAME_V_M_PER_S:g} m/s and {_SAME_OMEGA_RAD_PER_S:g} rad/s of what was {what}", _share(same[known]))
    )
    return pd.DataFrame(rows, columns=["", "value"])


def causes_table(commands: pd.DataFrame) -> pd.DataFrame:
    """Return why the robot would have stood, or been limited, and how often: the first reason of each kind.

    Args:
        commands: ``commands.csv``.
    """
    told = commands[commands["cause"].fillna("") != ""]
    rows = [
        {
            "why": group["reason"].iloc[0],
            "does": "stands" if group["stopped"].iloc[0] else "is limited",
            "periods": f"{len(group)}",
            "share": f"{len(group) / len(commands):.1%}",
            "first at, s": f"{group['time_s'].iloc[0]:.1f}",
        }
        for _, group in told.groupby("cause", sort=False)
    ]
    rows.sort(key=lambda row: -int(row["periods"]))
    return pd.DataFrame(rows, columns=["why", "does", "periods", "share", "first at, s"])


def replay_figure(commands: pd.DataFrame, seen: pd.DataFrame, described: dict[str, Any]) -> Figure:
    """Draw commands, quantiles and distances over time, and where the robot was.

    Args:
        commands: ``commands.csv``.
        seen: ``seen.csv``.
        described: ``replay.json``.
    """
    figure = Figure(figsize=(13.0, 9.0), layout="constrained")
    beta = "" if described["beta"] is None else f", β = {described['beta']:g}"
    title = f"{described['recording']}: what {described['agent']} ({described['sensor']}{beta}) would have done"
    figure.suptitle(title, x=0.01, ha="left", fontsize=13, color=INK)
    grid = figure.add_gridspec(4, 2, width_ratios=(1.7, 1.0))
    first = figure.add_subplot(grid[0, 0])
    panels = [first, *(figure.add_subplot(grid[row, 0], sharex=first) for row in range(1, 4))]
    _draw_velocity(panels[0], commands, "v_m_per_s", "linear velocity, m/s")
    _draw_velocity(panels[1], commands, "omega_rad_per_s", "angular velocity, rad/s")
    _draw_quantiles(panels[2], commands, np.array(described["fractions"]))
    panels[3].plot(commands["time_s"], commands["nearest_m"], color=_AGENT, linewidth=1.2)
    panels[3].set_ylim(0.0, 1.05 * described["max_range_m"])
    style(panels[3], "nearest thing sensed, m", "time, s")
    for axes in panels:
        _shade(axes, commands)
    _draw_way(figure.add_subplot(grid[:, 1]), commands, seen, described["max_range_m"])
    handles = [
        first.plot([], [], color=color, linewidth=width, label=label)[0]
        for color, width, label in (
            (_AGENT, 1.6, "the agent's command"),
            (_RECORDED, 1.2, "what the robot was told"),
            (_MEASURED, 1.2, "what odometry measured"),
            (_STOPPED, 6.0, "it stands because it must"),
            (_LIMITED, 6.0, "limited by the guard"),
        )
    ]
    figure.legend(handles=handles, loc="outside lower center", ncols=5, frameon=False, fontsize=9, labelcolor=INK)
    return figure


def write_replay(folder: Path) -> str:
    """Write ``replay.png`` and ``replay.html`` into a folder that ``replay`` wrote.

    Returns:
        What is printed: the tables as text.
    """
    commands, seen = (pd.read_csv(folder / f"{name}.csv") for name in ("commands", "seen"))
    described = json.loads((folder / "replay.json").read_text(encoding="utf-8"))
    figure = replay_figure(commands, seen, described)
    figure.savefig(folder / "replay.png", dpi=110)
    summary, causes = summary_table(commands), causes_table(commands)
    nothing = "The robot would have driven in every period, as the agent wanted."
    ways = {
        "plan": "The waypoints are those of the recorded plans.",
        "goal": "The waypoints are the recorded goals, straight on.",
        "trajectory": "The waypoints are the corners of the way that was driven, by odometry: no plan is used.",
    }
    title = f"{described['recording']}: what {described['agent']} would have done"
    drawn = Picture(figure, "Commands, expected return and nearest thing over time, and where the robot was")
    sections = [
        Section("What it would have done", [ways[described["waypoints"]], drawn, summary]),
        Section("Why it stood, or was limited", [causes if len(causes) else nothing]),
        Section("What was read", [pd.DataFrame(_readable(described), columns=["", "value"])]),
    ]
    (folder / "replay.html").write_text(page(title, [_NOTE], sections), encoding="utf-8")
    text = [summary.to_string(index=False, header=False), causes.to_string(index=False) if len(causes) else nothing]
    return "\n\n".join(text)


def _readable(described: dict[str, Any]) -> list[tuple[str, str]]:
    shown = {key: value for key, value in described.items() if key not in ("fractions", "topics") and value is not None}
    topics = [(name, kind) for name, kind in described["topics"].items()]
    return [(key.replace("_", " "), str(value)) for key, value in shown.items()] + topics


def _share(which: "pd.Series[bool]") -> str:
    return f"{which.mean():.1%}" if len(which) else "none"


def _draw_velocity(axes: Axes, commands: pd.DataFrame, column: str, title: str) -> None:
    for prefix, color, width in (("measured_", _MEASURED, 1.2), ("recorded_", _RECORDED, 1.2), ("", _AGENT, 1.6)):
        axes.plot(commands["time_s"], commands[f"{prefix}{column}"], color=color, linewidth=width)
    axes.axhline(0.0, color=FAINT, linewidth=0.8)
    low, high = axes.get_ylim()
    axes.set_ylim(min(low, -_LEAST_SHOWN), max(high, _LEAST_SHOWN))
    style(axes, title)


def _draw_quantiles(axes: Axes, commands: pd.DataFrame, fractions: np.ndarray) -> None:
    columns = [name for name in commands if str(name).startswith("q") and str(name)[1:].isdigit()]
    style(axes, "return it expected, higher is better: mean, quantiles (dark: the middle half; red: the worst tenth)")
    if not columns:
        axes.plot(commands["time_s"], commands["value"], color=_AGENT, linewidth=1.4)
        return
    # Quantiles are those of a critic, which need not be in order.
    quantiles = np.sort(commands[columns].to_numpy(), axis=1)
    time_s = commands["time_s"]
    low, high = (quantiles[:, np.abs(fractions - at).argmin()] for at in (0.25, 0.75))
    axes.fill_between(time_s, quantiles[:, 0], quantiles[:, -1], color=GRID, linewidth=0)
    axes.fill_between(time_s, low, high, color=_AGENT, alpha=0.25, linewidth=0)
    axes.plot(time_s, commands["value"], color=_AGENT, linewidth=1.4)
    axes.plot(time_s, quantiles[:, fractions <= _TAIL].mean(axis=1), color=_STOPPED, linewidth=1.0)


def _shade(axes: Axes, commands: pd.DataFrame) -> None:
    """Mark along the lower edge when the robot stands because it must, and when it is limited."""
    stopped = (commands["stopped"] == 1).to_numpy()
    limited = ~stopped & (commands["cause"].fillna("") != "").to_numpy()
    for which, color in ((stopped, _STOPPED), (limited, _LIMITED)):
        axes.fill_between(
            commands["time_s"],
            0.0,
            0.05,
            where=which,
            step="post",
            color=color,
            linewidth=0,
            transform=axes.get_xaxis_transform(),
        )


def _draw_way(axes: Axes, commands: pd.DataFrame, seen: pd.DataFrame, max_range_m: float) -> None:
    placed = commands.dropna(subset=["x_m"])
    axes.scatter(seen["x_m"], seen["y_m"], s=3, color=INK, marker="s", linewidths=0, zorder=1)
    axes.plot(placed["x_m"], placed["y_m"], color=FAINT, linewidth=1.6, zorder=1)
    limited = placed[(placed["stopped"] == 0) & (placed["cause"].fillna("") != "")]
    stopped = placed[placed["stopped"] == 1]
    axes.scatter(limited["x_m"], limited["y_m"], s=14, color=_LIMITED, zorder=2)
    axes.scatter(stopped["x_m"], stopped["y_m"], s=14, color=_STOPPED, zorder=3)
    if len(placed):
        ends = placed.iloc[[0, -1]]
        axes.scatter(ends["x_m"], ends["y_m"], s=46, color=[_AGENT, INK], zorder=4)
        for name, (_, end) in zip(("start", "end"), ends.iterrows(), strict=True):
            axes.annotate(name, (end["x_m"], end["y_m"]), (7, 4), textcoords="offset points", fontsize=9, color=INK)
    axes.set_aspect("equal", adjustable="datalim")
    axes.margins(0.1)
    style(axes, f"where the robot was, and what it saw within {max_range_m:g} m", "x, m", "y, m")
