"""Draw beta_trainings, beta_response, beta_response_cvar and differences_collisions.png, of what results/ holds.

python docs/images/results_figures.py
"""

import math
from functools import cache
from pathlib import Path

import pandas as pd
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from rcdsac_trl.colors import LIGHT
from rcdsac_trl.report.comparison_figures import paired_differences
from rcdsac_trl.report.evaluation_folders import all_trainings
from rcdsac_trl.report.panels import include_zero
from rcdsac_trl.report.read import Episodes, read_episodes
from rcdsac_trl.report.response_figures import beta_response
from rcdsac_trl.report.style import style

HERE = Path(__file__).parent
RESULTS = HERE.parents[1] / "results"
REFERENCE = "sac"
# At which CVaR's agents for one beta were trained.
_BETAS_OF_DSAC = (0.25, 0.75)
# Rows that the paper's table lacks, left out of the differences.
BESIDE = ("rcdsac_pow_wide", "rcdsac_cvar_long", "pursuit")
# Agents first, then what they are compared with; others behind them.
ORDER = ("rcdsac_pow", "rcdsac_cvar", "dsac", "rcwr", "sac", "pursuit")


def place(run: Path) -> int:
    """Return where a run stands in the order."""
    return next((i for i, name in enumerate(ORDER) if run.name.startswith(name)), len(ORDER))


def beta_trainings() -> Figure:
    """Draw collisions and reward of all trainings of CVaR over beta, beside SAC's and MPPI's."""
    figure = Figure(figsize=(11.0, 5.2), layout="constrained")
    rows = zip(("collisions", "reward"), ("collisions an episode", "reward an episode"), strict=True)
    for (metric, heading), panels in zip(rows, figure.subplots(2, 2, sharex=True, sharey="row"), strict=True):
        for sensor, axes in zip(("narrow", "sparse"), panels, strict=True):
            _draw_trainings(axes, metric, sensor)
            first = metric == "collisions"
            title = f"{heading}, {sensor} sensor" if first else heading
            style(axes, title, "" if first else "β: averse at the left, neutral at the right")
            if first:
                include_zero(axes)
    return figure


def _draw_trainings(axes: Axes, metric: str, sensor: str) -> None:
    """Draw a line for each training, one for their mean and one for a long one, and level lines of who has no beta."""
    trained = [_means(run, metric).dropna() for run in all_trainings(RESULTS, f"rcdsac_cvar-{sensor}")]
    by_training = pd.concat(trained, axis=1, join="inner")
    axes.plot(by_training, color=LIGHT.robot, linewidth=1.0, alpha=0.45)
    mean = by_training.mean(axis=1)
    axes.plot(mean, color=LIGHT.robot, linewidth=2.4, marker="o", markersize=6)
    long = RESULTS / f"rcdsac_cvar_long-{sensor}"
    ends = {"RC-DSAC": mean}
    if long.is_dir():
        ends["RC-DSAC, long"] = _means(long, metric)[mean.index]
        axes.plot(ends["RC-DSAC, long"], color=LIGHT.robot_edge, linewidth=1.8, marker="s", markersize=5)
    others = {"SAC": ("sac", LIGHT.alarm, "--"), "MPPI": ("mppi", LIGHT.ink, ":")}
    levels = {
        name: float(pd.concat([_means(run, metric) for run in all_trainings(RESULTS, f"{agent}-{sensor}")]).mean())
        for name, (agent, _, _) in others.items()
    }
    for name, (_, color, line) in others.items():
        axes.axhline(levels[name], color=color, linestyle=line, linewidth=1.6)
    for beta in _BETAS_OF_DSAC:
        of_one = pd.concat([_means(run, metric) for run in all_trainings(RESULTS, f"dsac_cvar_{beta}-{sensor}")])
        axes.plot([beta] * len(of_one), of_one, color=LIGHT.goal, marker=".", markersize=5, linestyle="none", alpha=0.6)
        axes.plot(beta, of_one.mean(), color=LIGHT.goal, marker="D", markersize=7)
    texts = {name: (level, others[name][1]) for name, level in levels.items()}
    if metric == "collisions":
        texts |= {name: (float(values.iloc[-1]), LIGHT.robot) for name, values in ends.items()}
        at = (_BETAS_OF_DSAC[-1], float(of_one.mean()))
        axes.annotate("DSAC", at, xytext=(8, -4), textcoords="offset points", fontsize=9, color=LIGHT.goal)
    _label_at_the_right(axes, texts)
    axes.set_xticks(mean.index)


def _label_at_the_right(axes: Axes, texts: dict[str, tuple[float, str]]) -> None:
    """Write names, each with its level and colour, behind the axes; of two that are near the upper one goes up."""
    low, high = axes.get_ylim()
    near = 0.06 * (high - low)
    ordered = sorted(texts.items(), key=lambda item: item[1][0])
    levels = [-math.inf, *(level for _, (level, _) in ordered), math.inf]
    for number, (name, (level, color)) in enumerate(ordered, 1):
        below, above = level - levels[number - 1] < near, levels[number + 1] - level < near
        va = "bottom" if below else "top" if above else "center"
        axes.annotate(name, (1.01, level), xycoords=("axes fraction", "data"), va=va, fontsize=9, color=color)


def _means(run: Path, metric: str) -> pd.Series:
    """Return the mean of a metric at each beta; of who has none under NaN."""
    return _episodes(run).table.groupby("beta", dropna=False)[metric].mean()


@cache
def _episodes(run: Path) -> Episodes:
    """Read what a run drove, once for all metrics."""
    return read_episodes([run])


def main() -> None:
    """Read, draw."""
    # An agent or a baseline a folder; those of the study lie deeper, or are called otherwise.
    narrow = sorted(RESULTS.glob("*-narrow"), key=lambda run: (place(run), run))
    compared = [run for run in narrow if not run.name.startswith(BESIDE)]
    episodes = read_episodes([training for run in compared for training in all_trainings(RESULTS, run.name)])
    of_both_sensors = read_episodes([*narrow, *sorted(RESULTS.glob("*-sparse"))])
    reference = episodes.conditions["agent"].tolist().index(REFERENCE)
    figures: dict[str, Figure | None] = {
        "beta_trainings": beta_trainings(),
        "beta_response": beta_response(of_both_sensors, "pow"),
        "beta_response_cvar": beta_response(of_both_sensors, "cvar"),
        "differences_collisions": paired_differences(episodes, reference, "collisions"),
    }
    for name, figure in figures.items():
        if figure is None:
            raise SystemExit(f"{name}.png: results/ has no agent that was driven at two betas")
        figure.savefig(HERE / f"{name}.png", dpi=130)


if __name__ == "__main__":
    main()
