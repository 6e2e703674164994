"""Draw scaling_learner.png and scaling_world.png, of what benchmarks/scaling_learner.py and scaling_world.py measured.

python docs/images/scaling_figures.py
"""

import json
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import NullLocator

from rcdsac_trl.colors import LIGHT
from rcdsac_trl.report.style import FAINT, INK, style

HERE = Path(__file__).parent
RESULTS = HERE.parents[1] / "results"
# What is turned, and what it is called.
LEARNER = {
    "learner.batch_size": ("sequences of a mini-batch", "sequences"),
    "learner.sequence_length": ("transitions of a sequence", "transitions"),
    "quantiles": ("quantile fractions, N = N′ = K", "fractions"),
}
PANEL_INCHES = 3.0
# Beyond the largest value of a linear axis, so that its marker lies within.
ROOM = 1.1


def learner_figure(measured: Mapping[str, Mapping[str, float]]) -> Figure:
    """Draw milliseconds an update against every size, and what they would be in proportion to the size.

    Args:
        measured: seconds an update, by what is turned and its value.
    """
    figure = Figure(figsize=(PANEL_INCHES * len(measured), 3.4), layout="constrained")
    panels = figure.subplots(1, len(measured), sharey=True, squeeze=False)[0]
    for axes, (key, curve) in zip(panels, measured.items(), strict=True):
        sizes, times = numbers(curve)
        times = [1e3 * seconds for seconds in times]
        proportional = [times[-1] * size / sizes[-1] for size in sizes]
        axes.loglog(sizes, times, "o-", color=LIGHT.accent, label="measured", base=2)
        axes.loglog(sizes, proportional, ":", color=FAINT, label="in proportion to the size", base=2)
        title, of = LEARNER[key]
        style(axes, title, f"{of}, logarithmic")
        axes.set_xticks(sizes, [f"{size:,.0f}" for size in sizes])
        axes.xaxis.set_minor_locator(NullLocator())
        axes.yaxis.set_major_formatter("{x:,g}")
    panels[0].set_ylabel("milliseconds, logarithmic", fontsize=9, color=INK)
    head(figure, "An update's duration: the laptop's mini-batch with one size turned, one thread")
    handles, names = panels[0].get_legend_handles_labels()
    figure.legend(handles, names, loc="outside lower center", ncols=2, frameon=False, fontsize=9, labelcolor=INK)
    return figure


def world_figure(measured: Mapping[str, Any]) -> Figure:
    """Draw the world's rates, and the replay's memory.

    Args:
        measured: curves by what is turned, and `cores` and `num_agents`.
    """
    figure = Figure(figsize=(8.0, 5.6), layout="constrained")
    workers = f"of {measured['num_agents']} agents, {measured['cores']} cores"
    panels = {
        "agents": ("agents in one process", "agents", "agent steps a second"),
        "workers": (f"worker processes {workers}", "worker processes (0: none, all in one)", "agent steps a second"),
        "clutter_per_m2": ("clutter", "pieces per m²", "agent steps a second"),
        "replay_megabytes": ("memory of the replay", "agent steps held", "MB"),
    }
    for axes, (key, words) in zip(figure.subplots(2, 2).flat, panels.items(), strict=True):
        draw_curve(axes, *numbers(measured[key]))
        style(axes, *words)
    head(figure, "Agent steps a second, and memory of the replay")
    return figure


def draw_curve(axes: Axes, x: Sequence[float], y: Sequence[float]) -> None:
    """Draw one curve on an axis that begins at 0."""
    axes.plot(x, y, "o-", color=LIGHT.accent)
    axes.set_ylim(0.0, ROOM * max(y))
    axes.yaxis.set_major_formatter("{x:,g}")
    axes.xaxis.set_major_formatter("{x:,g}")


def numbers(curve: Mapping[str, float]) -> tuple[list[float], list[float]]:
    """Return both coordinates of a curve that was read, whose keys are texts."""
    return [float(x) for x in curve], list(curve.values())


def head(figure: Figure, title: str) -> None:
    """Write what a figure is about above its panels."""
    figure.suptitle(title, x=0.01, ha="left", fontsize=11, color=INK)


FIGURES: Mapping[str, Callable[[Mapping[str, Any]], Figure]] = {
    "scaling_learner": learner_figure,
    "scaling_world": world_figure,
}


def main() -> None:
    """Draw what was measured, and say what was not."""
    for name, draw in FIGURES.items():
        measured = RESULTS / f"{name}.json"
        if measured.is_file():
            draw(json.loads(measured.read_text())).savefig(HERE / f"{name}.png", dpi=130)
        else:
            print(f"{name}.png stays: nothing was measured yet; on idle cores, python benchmarks/{name}.py")


if __name__ == "__main__":
    main()
