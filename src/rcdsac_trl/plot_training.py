"""Draw how a run learnt: ``python -m rcdsac_trl.plot_training run=<folder>``.

Every panel shows one metric against the number of updates: bold lines are validation, one for each beta (or
collision weight) and the mean over its episodes; the faint line is the mean over an iteration's training episodes,
which are driven with exploration and with betas of all kinds. It may leave the panels of reward and collisions for a
while: a few disastrous iterations at the start would flatten all that follows.
"""

import os
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import pandas as pd
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.ticker import MaxNLocator, PercentFormatter, StrMethodFormatter
from omegaconf import DictConfig, OmegaConf
from omegaconf.errors import OmegaConfBaseException
from yaml import YAMLError

from rcdsac_trl.cli import entry_point
from rcdsac_trl.config.run_config import CONFIG_NAME
from rcdsac_trl.errors import UserInputError
from rcdsac_trl.report.style import FAINT, INK, MARKERS, shades, style
from rcdsac_trl.rollout.metrics import validation_score
from rcdsac_trl.system.resources import check_picture
from rcdsac_trl.tables import read_growing
from rcdsac_trl.training.run_log import TRAINING_TABLE

PANELS: Mapping[str, str] = {
    "reward": "reward per episode",
    "collisions": "collisions per episode",
    "goals": "goals per episode",
    "mean_speed_m_per_s": "mean speed, m/s",
    "contact_fraction": "steps in contact",
}
"""The metrics of :mod:`rcdsac_trl.rollout.metrics` in the order of the panels, and what stands above each."""

_CONDITIONS = ("beta", "collision_weight")
_SYMBOLS = {"beta": "β", "collision_weight": "w_coll"}
_DOTS = (0, (1, 2))
# Metrics that have no bound, and the share of the training iterations at either end that may leave their panels.
_UNBOUNDED = ("reward", "collisions")
_OUTSIDE = 0.05


@dataclass(frozen=True)
class Curve:
    """One line of every panel: the means of each metric, indexed by the number of updates."""

    label: str
    color: str | tuple[float, float, float, float]
    marker: str
    means: pd.DataFrame


def validation_curves(episodes: pd.DataFrame) -> list[Curve]:
    """Return one curve for each beta or collision weight, from the lowest to the highest.

    Args:
        episodes: one row an episode, as training writes ``validation_episodes.csv``.
    """
    # Groups come in ascending order.
    groups = list(episodes.groupby(list(_CONDITIONS), dropna=False))
    curves = []
    for number, ((values, rows), color) in enumerate(zip(groups, shades(len(groups)), strict=True)):
        # A missing value is not equal to itself: a condition has one of the two, or neither.
        named = [
            f", {_SYMBOLS[key]} = {value:g}" for key, value in zip(_CONDITIONS, values, strict=True) if value == value
        ]
        label = "validation" + "".join(named)
        curves.append(Curve(label, color, MARKERS[number % len(MARKERS)], _means(rows)))
    return curves


def best_updates(episodes: pd.DataFrame, episode_steps: int) -> int:
    """Return the number of updates at which training saved its best checkpoint.

    Args:
        episodes: as for :func:`validation_curves`.
        episode_steps: length of an episode.
    """
    # As the trainer does it: every condition counts the same, and only a higher score replaces the best.
    by_condition = episodes.groupby(["updates", *_CONDITIONS], dropna=False)[list(PANELS)].mean()
    numbers = by_condition.index.unique("updates").to_numpy()
    scores = [validation_score(by_condition.loc[[number]], episode_steps) for number in numbers]
    return int(numbers[scores.index(max(scores))])


def learning_curve(title: str, training: pd.DataFrame, validation: pd.DataFrame | None, episode_steps: int) -> Figure:
    """Return the figure of one run.

    Args:
        title: what stands above the panels.
        training: ``training_episodes.csv``.
        validation: ``validation_episodes.csv``; None before the first validation.
        episode_steps: length of an episode.
    """
    curves = [] if validation is None else validation_curves(validation)
    best = None if validation is None else best_updates(validation, episode_steps)
    faint = Curve("training episodes", FAINT, "", _means(training))
    figure = Figure(figsize=(11.0, 6.2), layout="constrained")
    figure.suptitle(title, x=0.01, ha="left", fontsize=13, color=INK)
    for number, (metric, heading) in enumerate(PANELS.items(), start=1):
        axes = figure.add_subplot(2, 3, number)
        _draw_curve(axes, faint, metric, linewidth=1.2, alpha=0.8)
        for curve in curves:
            _draw_curve(axes, curve, metric, linewidth=1.9)
        if best is not None:
            axes.axvline(best, color=INK, linewidth=0.9, linestyle=_DOTS, zorder=0)
        style(axes, heading, "updates")
        _style_updates(axes)
        _set_limits(axes, metric, faint, curves)
    _draw_legend(figure, [faint, *curves], best)
    return figure


def draw_run(folder: Path, out: Path) -> None:
    """Write the figure of a run folder as a PNG file.

    Raises:
        UserInputError: if the folder holds no run, or its config or tables cannot be read.
    """
    figure = learning_curve(*_read_run(folder))
    out.parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(out, dpi=130)


def _read_run(folder: Path) -> tuple[str, pd.DataFrame, pd.DataFrame | None, int]:
    """Read what :func:`learning_curve` draws."""
    path = folder / CONFIG_NAME
    try:
        # Not the settings: the few keys that are shown are those of runs of earlier versions too.
        trained = OmegaConf.load(path)
        title = f"{trained.algo.name}, sensor {trained.sensor.name}, seed {trained.seed}"
        episode_steps = int(trained.task.episode_steps)
    except (OSError, ValueError, TypeError, AttributeError, RecursionError, YAMLError, OmegaConfBaseException) as error:
        reason = " ".join(str(error).split())
        raise UserInputError(f"{path} cannot be read ({reason}): name a folder that training wrote") from error
    validation = folder / "validation_episodes.csv"
    return (
        title,
        _read_table(folder / TRAINING_TABLE, ["updates", *PANELS]),
        _read_table(validation, ["updates", *_CONDITIONS, *PANELS]) if validation.is_file() else None,
        episode_steps,
    )


def _read_table(path: Path, columns: list[str]) -> pd.DataFrame:
    try:
        table = read_growing(path)
        if missing := [name for name in columns if name not in table]:
            raise ValueError(f"no column {missing[0]}")
        table = table[columns].astype(float)
    except pd.errors.EmptyDataError:  # its first line is being written
        table = pd.DataFrame()
    except (OSError, ValueError) as error:
        reason = " ".join(str(error).split())
        raise UserInputError(f"{path} cannot be read ({reason}): name a run whose tables are whole") from error
    if table.empty:
        raise UserInputError(f"{path} holds no episode: wait for one, or name another run")
    return table


def _means(episodes: pd.DataFrame) -> pd.DataFrame:
    return episodes.groupby("updates")[list(PANELS)].mean()


def _draw_curve(axes: Axes, curve: Curve, metric: str, linewidth: float, alpha: float = 1.0) -> None:
    # A long run has too many validations for a marker at each.
    step = max(1, len(curve.means) // 12)
    axes.plot(
        curve.means.index,
        curve.means[metric],
        color=curve.color,
        linewidth=linewidth,
        alpha=alpha,
        marker=curve.marker,
        markersize=5,
        markevery=step,
    )


def _style_updates(axes: Axes) -> None:
    axes.set_xlim(left=0)
    axes.xaxis.set_major_locator(MaxNLocator(4, integer=True))
    axes.xaxis.set_major_formatter(StrMethodFormatter("{x:,.0f}"))


def _set_limits(axes: Axes, metric: str, training: Curve, validation: list[Curve]) -> None:
    if metric == "contact_fraction":
        axes.yaxis.set_major_formatter(PercentFormatter(1.0, decimals=0))
    outside = _OUTSIDE if metric in _UNBOUNDED else 0.0
    usual = training.means[metric].quantile([outside, 1 - outside])
    shown = pd.concat([usual, *(curve.means[metric] for curve in validation)])
    margin = 0.06 * max(shown.max() - shown.min(), 1e-3)
    # Whatever cannot be negative begins at nothing: a panel that shows it cannot exaggerate.
    axes.set_ylim(shown.min() - margin if metric == "reward" else 0.0, shown.max() + margin)


def _draw_legend(figure: Figure, curves: list[Curve], best: int | None) -> None:
    """Fill the free panel with what the lines mean."""
    axes = figure.add_subplot(2, 3, len(PANELS) + 1)
    axes.set_axis_off()
    handles = [
        Line2D([], [], color=curve.color, marker=curve.marker, markersize=6, linewidth=2, label=curve.label)
        for curve in curves
    ]
    if best is not None:
        label = f"best checkpoint ({best:,} updates)"
        handles.append(Line2D([], [], color=INK, linewidth=0.9, linestyle=_DOTS, label=label))
    axes.legend(handles=handles, loc="center left", frameon=False, fontsize=10, labelcolor=INK)


def _run_folder(cfg: DictConfig) -> Path:
    """Return the run's folder.

    Raises:
        UserInputError: if none is named, or it holds no episodes.
    """
    if cfg.run is None:
        raise UserInputError("name what to draw: run=<folder> that training wrote")
    folder = Path(str(cfg.run))
    for name in (CONFIG_NAME, TRAINING_TABLE):
        if not os.path.isfile(folder / name):  # false for a name that is too long, too
            raise UserInputError(
                f"run={folder} holds no {name}: name a folder that training wrote, after its first iteration"
            )
    return folder


def _picture(cfg: DictConfig) -> Path:
    out = Path(cfg.run) / "learning_curve.png" if cfg.out is None else Path(str(cfg.out))
    check_picture(out)
    return out


def check(cfg: DictConfig) -> None:
    """Refuse what cannot be drawn, before anything is written."""
    _read_run(_run_folder(cfg))
    _picture(cfg)


@entry_point("plot_training", check=check)
def main(cfg: DictConfig) -> None:
    """Write the picture."""
    out = _picture(cfg)
    draw_run(_run_folder(cfg), out)
    print(f"drew {out}")


if __name__ == "__main__":
    main()
