"""What evaluations and trainings left behind, checked to be comparable."""

import json
import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from rcdsac_trl.errors import UserInputError
from rcdsac_trl.report.evaluation_folders import DESCRIPTION, find_evaluations
from rcdsac_trl.report.statistics import Array

COLLISIONS = "collisions.csv"
TOLD = ("beta", "collision_weight", "beta_controller")
"""Columns that say what an agent was told, as far as an evaluation has them."""
CONDITION = ("agent", "sensor", *TOLD)
"""Columns that say what drove an episode."""
_OF_A_COLLISION = ("thing", "bearing_rad", "bearing_sensed", "unsensed_s")
_EPISODE = ("train_seed", "map", "episode")
# Keys of `navigation` in an evaluation, and what they are called.
_HELPS = {"replan": "detours", "watchdog": "watchdog", "stop_zone": "stop zone"}
# What must be equal for agents to have met the same maps, starts, goals and movers, under the same rules.
_PROTOCOL = ("split", "seed", "num_maps", "num_episodes", "sampled", "map", "task")

METRIC_NAMES: dict[str, str] = {
    "collisions": "collisions an episode",
    "reward": "reward an episode",
    "goals": "goals an episode",
    "mean_speed_m_per_s": "mean speed, m/s",
    "contact_fraction": "share of steps in contact",
    "collision_free": "share of episodes without collision",
    "success": "success at the first goal",
    "collided": "collision before the first goal",
    "timed_out": "timeout before the first goal",
    "time_to_goal_s": "time to the first goal, s",
    "spl": "SPL to the first goal",
    "distance_m": "distance driven, m",
    "contact_s": "time in contact, s",
    "smallest_clearance_m": "smallest clearance, m",
}
"""Metrics in the order of reports, and what they are called there."""
SHARES = ("contact_fraction", "collision_free", "success", "collided", "timed_out")
"""Metrics that are shares of something, and written in percent."""


def possible(metric: str) -> tuple[float, float]:
    """Return the smallest and the largest value that a metric can have.

    Example:
        >>> possible("collisions")
        (0.0, inf)
    """
    if metric in (*SHARES, "spl"):
        return 0.0, 1.0
    return (-math.inf if metric == "reward" else 0.0), math.inf


@dataclass(frozen=True)
class Evaluation:
    """One folder that ``evaluate`` wrote.

    Attributes:
        folder: where it lies.
        described: ``evaluation.json``.
        episodes: ``episodes.csv``.
        collisions: ``collisions.csv``; None in folders of versions that wrote none.
    """

    folder: Path
    described: dict[str, Any]
    episodes: pd.DataFrame
    collisions: pd.DataFrame | None = None

    @property
    def protocol(self) -> dict[str, Any]:
        """What decides which maps, starts, goals and movers were met, and under which rules."""
        return {key: self.described[key] for key in _PROTOCOL}

    @property
    def helped(self) -> str:
        """What stood between the agent and the wheels, such as "detours and watchdog"; empty: nothing did."""
        asked = self.described.get("navigation") or {}  # evaluations of earlier versions say nothing: there was none
        helps = [name for key, name in _HELPS.items() if asked.get(key)]
        return " and ".join([*([", ".join(helps[:-1])] if helps[1:] else []), *helps[-1:]])


def read_evaluation(folder: Path) -> Evaluation:
    """Read an evaluation.

    Raises:
        UserInputError: if it is incomplete, or of a version that described less.
    """
    try:
        described = json.loads((folder / DESCRIPTION).read_text(encoding="utf-8"))
        episodes = pd.read_csv(folder / "episodes.csv")
        missing = {*_PROTOCOL, "agent", "sensor"} - set(described)
        missing |= {"beta", "collision_weight", "map", "episode", "collisions", "reward"} - set(episodes)
        collisions = pd.read_csv(folder / COLLISIONS) if (folder / COLLISIONS).exists() else None
        if collisions is not None:
            missing |= {"beta", "collision_weight", *_OF_A_COLLISION} - set(collisions)
    except (OSError, ValueError, TypeError) as error:
        raise UserInputError(f"{folder} cannot be read ({error}): evaluate again into another folder") from error
    if missing:
        raise UserInputError(f"{folder} does not say {', '.join(sorted(missing))}: evaluate again with this version")
    # CSV files of whole numbers alone hold no floats.
    episodes = episodes.astype({"beta": float, "collision_weight": float})
    if collisions is not None:
        collisions = collisions.astype({"beta": float, "collision_weight": float})
    if "beta_controller" not in episodes:  # nothing turned beta
        episodes = episodes.assign(beta_controller=None, mean_beta=episodes["beta"])
    if collisions is not None and "beta_controller" not in collisions:
        collisions = collisions.assign(beta_controller=None)
    return Evaluation(folder, described, episodes, collisions)


def under(rows: pd.DataFrame, condition: pd.Series, by: Sequence[str]) -> pd.DataFrame:
    """Return the rows of a condition.

    Args:
        rows: with the columns of `by`.
        condition: values of these columns; missing ones match missing ones.
        by: columns that tell conditions apart.
    """
    for key in by:
        value = condition[key]
        rows = rows[rows[key].isna() if pd.isna(value) else rows[key] == value]
    return rows


@dataclass(frozen=True, eq=False)
class Episodes:
    """The episodes of several evaluations on the same maps. Each equals itself alone, so what follows can be kept.

    Attributes:
        table: one row an episode: :data:`CONDITION`, `mean_beta`, `train_seed`, `map`, `episode`, the metrics that
            all have, `helped` as in :class:`Evaluation`, `trained`: whether an agent drove, not a planner,
            `weights`: the digest of an agent's weights, None where it is not known, and `diagnosed`: whether its
            collisions are among `collisions`.
        protocol: of all evaluations.
        collisions: one row a collision, of the evaluations that wrote ``collisions.csv``, with :data:`CONDITION`.
    """

    table: pd.DataFrame
    protocol: dict[str, Any]
    collisions: pd.DataFrame

    @cached_property
    def metrics(self) -> list[str]:
        """The metrics there are, in the order of reports."""
        return [metric for metric in METRIC_NAMES if metric in self.table]

    @cached_property
    def conditions(self) -> pd.DataFrame:
        """One row a condition, with its measure, `helped` and `trained`, by evaluation, beta, and controller of it."""
        rows = self.table[[*CONDITION, "measure", "helped", "trained"]].drop_duplicates()
        agents = list(rows["agent"].unique())
        rows = rows.assign(order=rows["agent"].map(agents.index))
        by = ["sensor", "order", "beta", "collision_weight", "beta_controller"]
        return rows.sort_values(by, ignore_index=True).drop(columns="order")

    def of(self, condition: pd.Series, metric: str) -> Array:
        """Return a metric under a condition: ``[training seeds, maps, episodes]``."""
        shape = (-1, self.protocol["num_maps"], self.protocol["num_episodes"])
        return self._rows(condition)[metric].to_numpy(np.float64).reshape(shape)

    def seeds(self, condition: pd.Series) -> list[int]:
        """Return the training seeds under a condition, in the order of :meth:`of`."""
        return self._rows(condition)["train_seed"].unique().tolist()

    def _rows(self, condition: pd.Series) -> pd.DataFrame:
        return self._by_condition[_key(condition[list(CONDITION)])]

    @cached_property
    def _by_condition(self) -> dict[tuple[Any, ...], pd.DataFrame]:
        """The rows of each condition in the order of :meth:`of`: a report asks for them a thousand times."""
        groups = self.table.sort_values(list(_EPISODE)).groupby(list(CONDITION), dropna=False, sort=False)
        return {_key(values): rows for values, rows in groups}


def _key(values: Iterable[Any]) -> tuple[Any, ...]:
    """Return values that can be looked up: those that are missing equal each other."""
    return tuple(None if pd.isna(value) else value for value in values)


def read_episodes(folders: Sequence[Path]) -> Episodes:
    """Read evaluations that can be compared.

    Args:
        folders: as for :func:`~rcdsac_trl.report.evaluation_folders.find_evaluations`.

    Raises:
        UserInputError: if there are none, if maps, starts, goals or rules differ, if training seeds of one agent have
            other risk measures or act differently, or if two hold the same.
    """
    evaluations = [read_evaluation(folder) for folder in find_evaluations(folders)]
    _check_same_maps(evaluations)
    _check_one_agent(evaluations)
    tables = [
        evaluation.episodes.assign(
            agent=evaluation.described["agent"],
            sensor=evaluation.described["sensor"],
            measure=evaluation.described.get("measure"),
            helped=evaluation.helped,
            train_seed=evaluation.described.get("train_seed") or 0,
            # Evaluations of earlier versions that say nothing of it are of agents.
            trained=evaluation.described.get("train_seed", 0) is not None,
            weights=evaluation.described.get("weights_sha256"),
            folder=str(evaluation.folder),
            diagnosed=evaluation.collisions is not None,
        )
        for evaluation in evaluations
    ]
    shared = set.intersection(*(set(table) for table in tables))
    table = pd.concat([part[[column for column in part if column in shared]] for part in tables], ignore_index=True)
    _check_complete(table, evaluations[0].protocol)
    table = table.drop(columns="folder").assign(collision_free=(table["collisions"] == 0).astype(float))
    return Episodes(table, evaluations[0].protocol, _collisions(evaluations))


def _collisions(evaluations: Sequence[Evaluation]) -> pd.DataFrame:
    """Put the collisions of all evaluations that say something of them into one table."""
    tables = [
        evaluation.collisions.assign(agent=evaluation.described["agent"], sensor=evaluation.described["sensor"])
        for evaluation in evaluations
        if evaluation.collisions is not None and len(evaluation.collisions)
    ]
    if not tables:
        return pd.DataFrame(columns=[*CONDITION, *_OF_A_COLLISION])
    # Names are text also where no controller's agent collided.
    return pd.concat([table.astype({"beta_controller": object}) for table in tables], ignore_index=True)


def _check_same_maps(evaluations: Sequence[Evaluation]) -> None:
    first = evaluations[0]
    for other in evaluations[1:]:
        for key in _PROTOCOL:
            here, there = first.described[key], other.described[key]
            if here != there:
                what = key
                if isinstance(here, dict) and isinstance(there, dict):
                    part = next(name for name in [*here, *there] if here.get(name) != there.get(name))
                    what, here, there = f"{key}.{part}", here.get(part), there.get(part)
                raise UserInputError(
                    f"{first.folder} and {other.folder} did not meet the same maps, starts and goals ({what} is {here} "
                    f"and {there}): evaluate them alike, or report on them apart"
                )
        if not _same_robot(here := first.described.get("robot"), there := other.described.get("robot")):
            names = " and ".join(_robot_name(robot) for robot in (here, there))
            raise UserInputError(
                f"{first.folder} and {other.folder} are of two robots ({names}, or one with other numbers), whose "
                "results do not compare: report on them apart"
            )


def _check_one_agent(evaluations: Sequence[Evaluation]) -> None:
    """Refuse to call one agent what was trained or chooses its actions in two ways: its seeds would be averaged."""
    firsts: dict[tuple[str, str], Evaluation] = {}
    for other in evaluations:
        agent = other.described["agent"], other.described["sensor"]
        first = firsts.setdefault(agent, other)
        here, there = (evaluation.described.get("measure") for evaluation in (first, other))
        if None not in (here, there) and here != there:  # evaluations of earlier versions say nothing of theirs
            raise UserInputError(
                f"{first.folder} and {other.folder} are both of {agent[0]}, with the risk measures {here} and {there}: "
                "train with a name for each (algo.name), or report on them apart"
            )
        here, there = (evaluation.described.get("trained_collision_weight", 1.0) for evaluation in (first, other))
        if here != there:
            raise UserInputError(
                f"{first.folder} and {other.folder} are both of {agent[0]}, trained with collisions that count "
                f"{here:g} times and {there:g} times: train with a name for each (algo.name), or report on them apart"
            )
        here, there = _acting_of(first), _acting_of(other)
        if here != there:
            raise UserInputError(
                f"{first.folder} and {other.folder} let {agent[0]} act differently ({here} and {there}): evaluate them "
                "with the same acting.*, latency_s and navigation.*, or report on them apart"
            )


def _acting_of(evaluation: Evaluation) -> str:
    """Say how an agent acted; evaluations of earlier versions say nothing, all by tanh(mean)."""
    acting = evaluation.described.get("acting")
    if acting is None or acting["num_candidates"] == 1:
        acting = {"num_candidates": 1}
    said = [f"acting.{name}={value}" for name, value in acting.items()]
    if latency_s := evaluation.described.get("latency_s"):
        said.append(f"latency_s={latency_s:g}")
    return " ".join(said) + (f" with {evaluation.helped}" if evaluation.helped else "")


def _same_robot(one: dict[str, Any] | None, other: dict[str, Any] | None) -> bool:
    """Compare two robots; evaluations of earlier versions say nothing of theirs, the paper's."""
    if one is None or other is None:
        return _robot_name(one) == _robot_name(other)
    return one == other


def _robot_name(robot: dict[str, Any] | None) -> str:
    return "paper" if robot is None else str(robot["name"])


def _check_complete(table: pd.DataFrame, protocol: dict[str, Any]) -> None:
    expected = protocol["num_maps"] * protocol["num_episodes"]
    for _, rows in table.groupby([*CONDITION, "train_seed"], dropna=False):
        names = sorted(set(rows["folder"]))
        if len(names) > 1:
            raise UserInputError(
                f"{names[0]} and {names[1]} hold the same agent, training seed and beta: leave one out"
            )
        if len(rows) != expected or rows.duplicated(["map", "episode"]).any():
            raise UserInputError(
                f"{names[0]} holds {len(rows)} episodes of a beta instead of {expected}: evaluate again"
            )
