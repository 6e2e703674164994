"""A policy measured on one map: one row an episode."""

from collections.abc import Callable, Iterable, Mapping, Sequence
from typing import Any

import numpy as np
import pandas as pd
import torch
from numpy.typing import NDArray
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModuleBase
from torch import Tensor
from torchrl.envs.utils import ExplorationType, set_exploration_type

from rcdsac_trl.config.conditions import Condition
from rcdsac_trl.rollout.evaluation_pool import Rows
from rcdsac_trl.rollout.metrics import HAPPENED, episode_metrics
from rcdsac_trl.rollout.worker import RolloutWorker
from rcdsac_trl.system.interrupts import interruption_point

# What an episode's row needs; everything else of a step is dropped at once.
_OBSERVED = ("velocity", "pose")

# Columns that say what drove an episode, as far as there are such.
CONDITION_COLUMNS = ("beta", "collision_weight", "beta_controller")


def measure_map(
    worker: RolloutWorker,
    policy: TensorDictModuleBase,
    *,
    conditions: Sequence[Condition],
    num_agents: int,
    map_index: int,
    sampled: bool = False,
    controlled: bool = False,
    one_trip: bool = False,
    before_step: Callable[[], None] = interruption_point,
    more: Callable[[TensorDictBase], dict[str, Tensor]] | None = None,
) -> Rows:
    """Measure a policy on one map.

    Args:
        worker: ``len(conditions) * num_agents`` agents, condition after condition; agent i of every condition meets the
            same map, start and goals.
        policy: writes `action`.
        conditions: what the agents of each block are told (the worker tells them; here it labels rows).
        num_agents: episodes a map and a condition.
        map_index: number of the map and its episode.
        sampled: draw actions instead of taking tanh(mean).
        controlled: say in `beta_controller` what turned beta.
        one_trip: end the map once every agent has reached its first goal or touched something; what is counted over an
            episode then says little.
        before_step: called before each step.
        more: measures more of the episodes, ``[N]`` a column.

    Returns:
        One row an episode: `beta`, `collision_weight`, `map`, `episode`, the metrics of :func:`episode_metrics` and
        what `more` measures.
    """
    kind = ExplorationType.RANDOM if sampled else ExplorationType.DETERMINISTIC
    with torch.no_grad(), set_exploration_type(kind):
        driven = worker.rollout(
            policy,
            map_index,
            observed=_OBSERVED,
            happened=HAPPENED,
            before_step=before_step,
            ended=_TripsEnded(len(conditions) * num_agents) if one_trip else None,
        )
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


class _TripsEnded:
    """Tells whether every agent has reached a goal or touched something before this step.

    So a step follows the last of them: who watches agents as they act, as a film does, sees how it ended.
    """

    def __init__(self, num_agents: int) -> None:
        self._ended = np.zeros(num_agents, np.bool_)

    def __call__(self, written: Mapping[str, NDArray]) -> bool:
        over = bool(self._ended.all())
        self._ended |= (written["contact"] | written["goal_reached"])[:, 0]
        return over


def table_of(maps: Iterable[Rows]) -> pd.DataFrame:
    """Return the rows of all maps in the order of condition, map and episode, whatever order they come in."""
    rows = [row for rows in maps for row in rows]
    table = pd.DataFrame(rows).astype({"beta": float, "collision_weight": float})
    by = [key for key in CONDITION_COLUMNS if key in table]
    return table.sort_values([*by, "map", "episode"], ignore_index=True)
