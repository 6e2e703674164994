"""Draw how a run learnt: ``python -m rcdsac_trl.plot_training run=<folder>``."""

import os
from dataclasses import dataclass
from pathlib import Path

import pandas as pd
from omegaconf import DictConfig, OmegaConf
from omegaconf.errors import OmegaConfBaseException
from yaml import YAMLError

from rcdsac_trl.cli import Command
from rcdsac_trl.config.run_config import CONFIG_NAME
from rcdsac_trl.errors import UserInputError
from rcdsac_trl.report.learning_curve import CONDITIONS, PANELS, learning_curve
from rcdsac_trl.system.resources import check_picture
from rcdsac_trl.tables import read_growing
from rcdsac_trl.training.run_folder import TRAINING_TABLE


@dataclass(frozen=True)
class LearningCurve:
    """A picture that is about to be drawn: of which run folder, and where it goes."""

    folder: Path
    out: Path

    def run(self) -> None:
        """Write the picture."""
        draw_run(self.folder, self.out)
        print(f"drew {self.out}")


def make_learning_curve(cfg: DictConfig) -> LearningCurve:
    """Read a run; refuses what cannot be drawn, before anything is written.

    Raises:
        UserInputError: if no run is named, the folder holds none whose tables can be read, or no picture can be
            written.
    """
    folder = _run_folder(cfg)
    _read_run(folder)
    out = folder / "learning_curve.png" if cfg.out is None else Path(str(cfg.out))
    check_picture(out)
    return LearningCurve(folder, out)


def draw_run(folder: Path, out: Path) -> None:
    """Write the figure of a run folder as a PNG file.

    Raises:
        UserInputError: if the folder holds no run, or its config or tables cannot be read.
    """
    title, training, validation, episode_steps = _read_run(folder)
    best = None if validation is None else best_updates(validation, episode_steps)
    figure = learning_curve(title, training, validation, best)
    out.parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(out, dpi=130)


def best_updates(episodes: pd.DataFrame, episode_steps: int) -> int:
    """Return the number of updates at which training saved its best checkpoint.

    Args:
        episodes: one row an episode, as training writes ``validation_episodes.csv``.
        episode_steps: length of an episode.
    """
    from rcdsac_trl.rollout.metrics import validation_score  # late: torch takes a second, which no mistake waits for

    # As the trainer does it: every condition counts the same, and only a higher score replaces the best.
    by_condition = episodes.groupby(["updates", *CONDITIONS], dropna=False)[list(PANELS)].mean()
    numbers = by_condition.index.unique("updates").to_numpy()
    scores = [validation_score(by_condition.loc[[number]], episode_steps) for number in numbers]
    return int(numbers[scores.index(max(scores))])


def _read_run(folder: Path) -> tuple[str, pd.DataFrame, pd.DataFrame | None, int]:
    """Return title, training episodes, validation episodes and the length of an episode."""
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
        _read_table(validation, ["updates", *CONDITIONS, *PANELS]) if validation.is_file() else None,
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


main = Command("plot_training", make_learning_curve)

if __name__ == "__main__":
    main()
