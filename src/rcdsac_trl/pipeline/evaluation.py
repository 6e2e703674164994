"""Evaluation: the same maps, starts and goals for every agent, deterministic actions, one row an episode."""

import contextlib
from collections.abc import Callable, Generator, Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

import pandas as pd
import torch
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModuleBase
from torch import Tensor
from torchrl.envs.utils import ExplorationType, set_exploration_type
from tqdm import tqdm

from rcdsac_trl.pipeline.drivers import Rows
from rcdsac_trl.pipeline.interrupts import interruption_point
from rcdsac_trl.pipeline.metrics import Condition, episode_metrics, summarise
from rcdsac_trl.pipeline.results import ResultsFolder
from rcdsac_trl.pipeline.teams import Team

# What an episode's row needs; everything else of a step is dropped at once.
_OBSERVED = ("velocity", "pose")
_HAPPENED = ("contact", "goal_reached", "reward_components")
# Columns that say what drove an episode, as far as there are such.
_CONDITION = ("beta", "collision_weight", "beta_controller")


def measure_map(
    team: Team,
    policy: TensorDictModuleBase,
    *,
    conditions: Sequence[Condition],
    num_agents: int,
    map_index: int,
    sampled: bool = False,
    controlled: bool = False,
    before_step: Callable[[], None] = interruption_point,
    more: Callable[[TensorDictBase], dict[str, Tensor]] | None = None,
) -> Rows:
    """Measure a policy on one map.

    Args:
        team: ``len(conditions) * num_agents`` agents, condition after condition; agent i of every condition meets the
            same map, start and goals.
        policy: writes `action`.
        conditions: what the agents of each block are told (the team tells them; here it labels rows).
        num_agents: episodes a map and a condition.
        map_index: number of the map and its episode.
        sampled: draw actions instead of taking tanh(mean).
        controlled: say in `beta_controller` what turned beta.
        before_step: called before each step.
        more: measures more of the episodes, ``[N]`` a column.

    Returns:
        One row an episode: `beta`, `collision_weight`, `map`, `episode`, the metrics of :func:`episode_metrics` and
        what `more` measures.
    """
    kind = ExplorationType.RANDOM if sampled else ExplorationType.DETERMINISTIC
    with torch.no_grad(), set_exploration_type(kind):
        driven = team.drive(policy, map_index, observed=_OBSERVED, happened=_HAPPENED, before_step=before_step)
    episodes = driven.tensordict()
    measured = episode_metrics(episodes) | ({} if more is None else more(episodes))
    rows = []
    for i in range(len(conditions) * num_agents):
        condition = conditions[i // num_agents]
        row: dict[str, Any] = {
            "beta": condition.beta,
            "collision_weight": condition.collision_weight,
            "map": map_index,
            "episode": i % num_agents,
        }
        if controlled:
            row["beta_controller"] = condition.controller
        rows.append(row | {metric: values[i].item() for metric, values in measured.items()})
    return rows


def table_of(maps: Iterable[Rows]) -> pd.DataFrame:
    """Return the rows of all maps in the order of condition, map and episode, whatever order they come in."""
    rows = [row for rows in maps for row in rows]
    table = pd.DataFrame(rows).astype({"beta": float, "collision_weight": float})
    by = [key for key in _CONDITION if key in table]
    return table.sort_values([*by, "map", "episode"], ignore_index=True)


class EvaluationRun:
    """An evaluation and the folder it writes: ``episodes.csv``, ``summary.csv`` and ``evaluation.json``.

    Args:
        out: the folder; made when the results are there.
        described: what is evaluated and how; equal descriptions give equal files.
        num_maps: maps to drive on.
        maps: yields the rows of each map as it has been driven.
        more: makes further rows of all rows that were driven; None: there are none.
        film: writes a film into the folder of the results and returns its files; None: there is none.

    Raises:
        UserInputError: if the folder holds another evaluation.
    """

    def __init__(
        self,
        *,
        out: Path,
        described: Mapping[str, Any],
        num_maps: int,
        maps: Callable[[], Generator[Rows, None, None]],
        more: Callable[[pd.DataFrame], pd.DataFrame] | None = None,
        film: Callable[[Path], Sequence[Path]] | None = None,
    ) -> None:
        self.results = ResultsFolder(out, "evaluation.json", described)
        self.num_maps = num_maps
        self.maps = maps
        self.more = more
        self.film = film

    def run(self) -> None:
        """Drive, print the summary, and write.

        Raises:
            UserInputError: if another evaluation was written into the folder meanwhile.
        """
        # Closed here and now where Ctrl-C comes between two maps, and with them what drives.
        with contextlib.closing(self.maps()) as maps:
            episodes = table_of(tqdm(maps, total=self.num_maps, unit="map", disable=None))
        if self.more is not None:
            episodes = pd.concat([episodes, self.more(episodes)], ignore_index=True)
        summary = summarise(episodes, [key for key in _CONDITION if key in episodes])
        shown = summary.dropna(axis="columns", how="all").set_index("episodes")
        print(shown.T.to_string(header=True, float_format="{:.3f}".format, na_rep=""))
        self.results.write(
            {
                "episodes.csv": episodes.to_csv(index=False, float_format="%.9g"),
                "summary.csv": summary.to_csv(index=False, float_format="%.6g"),
            }
        )
        print(f"written to {self.results.path}")
        if self.film is not None:
            print(f"filmed: {', '.join(map(str, self.film(self.results.path)))}")
