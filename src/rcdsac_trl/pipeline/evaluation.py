"""Evaluation: the same maps, starts and goals for every agent, deterministic actions, one row an episode."""

import contextlib
import json
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import pandas as pd
import torch
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModuleBase
from torchrl.envs import EnvBase
from torchrl.envs.utils import ExplorationType, set_exploration_type
from tqdm import tqdm

from rcdsac_trl.errors import UserInputError
from rcdsac_trl.pipeline.metrics import METRICS, Condition, episode_metrics, summarise

# What an episode's row needs; everything else of a step is dropped at once.
_KEPT = [("next", key) for key in ("contact", "goal_reached", "reward_components", "velocity")]


def run_episodes(env: EnvBase, policy: TensorDictModuleBase, steps: int) -> TensorDictBase:
    """Drive one episode in every agent of the env, from its next reset on.

    Returns:
        TensorDict ``[N, steps]`` with the keys that :func:`episode_metrics` reads; N counts the env's agents in
        the order of their batch.
    """
    tensordict = env.reset()
    kept = []
    for _ in range(steps):
        tensordict = env.step(policy(tensordict))
        kept.append(tensordict.select(*_KEPT).flatten())
        tensordict = env.step_mdp(tensordict)
    return torch.stack(kept, 1)


def evaluate(
    env: EnvBase,
    policy: TensorDictModuleBase,
    *,
    conditions: Sequence[Condition],
    num_agents: int,
    num_maps: int,
    steps: int,
    sampled: bool = False,
    on_map: Callable[[int], None] | None = None,
) -> pd.DataFrame:
    """Measure a policy on the env's next maps.

    Args:
        env: holds ``len(conditions) * num_agents`` agents, condition after condition; agent i of every condition
            meets the same map, start and goals.
        policy: writes `action`.
        conditions: what the agents of each block are told (the env's transforms tell them; here it labels rows).
        num_agents: episodes a map and a condition.
        num_maps: maps to drive on.
        steps: length of an episode.
        sampled: draw actions instead of taking tanh(mean).
        on_map: called with the number of maps done after each.

    Returns:
        One row an episode: `beta`, `collision_weight`, `map`, `episode` and :data:`METRICS`.
    """
    kind = ExplorationType.RANDOM if sampled else ExplorationType.DETERMINISTIC
    rows = []
    with torch.no_grad(), set_exploration_type(kind):
        for map_index in range(num_maps):
            measured = episode_metrics(run_episodes(env, policy, steps))
            for i in range(len(conditions) * num_agents):
                condition = conditions[i // num_agents]
                row = {
                    "beta": condition.beta,
                    "collision_weight": condition.collision_weight,
                    "map": map_index,
                    "episode": i % num_agents,
                }
                rows.append(row | {metric: measured[metric][i].item() for metric in METRICS})
            if on_map is not None:
                on_map(map_index + 1)
    table = pd.DataFrame(rows).astype({"beta": float, "collision_weight": float})
    return table.sort_values(["beta", "collision_weight", "map", "episode"], ignore_index=True)


class Validation:
    """Measures a policy on the same maps at every call, for as long as it trains.

    Args:
        env: as for :func:`evaluate`; made for this alone, and closed by :meth:`close`.
        policy: acts; its weights may change between calls.
        conditions: what the agents of each block are told.
        num_agents: episodes a map and a condition.
        num_maps: maps to drive on.
        steps: length of an episode.
        seed: root seed of the maps.
    """

    def __init__(
        self,
        env: EnvBase,
        policy: TensorDictModuleBase,
        *,
        conditions: Sequence[Condition],
        num_agents: int,
        num_maps: int,
        steps: int,
        seed: int,
    ) -> None:
        self.env = env
        self.policy = policy
        self.conditions = conditions
        self.num_agents = num_agents
        self.num_maps = num_maps
        self.steps = steps
        self.seed = seed

    def __call__(self) -> pd.DataFrame:
        """Return one row an episode, see :func:`evaluate`."""
        self.env.set_seed(self.seed)
        return evaluate(
            self.env,
            self.policy,
            conditions=self.conditions,
            num_agents=self.num_agents,
            num_maps=self.num_maps,
            steps=self.steps,
        )

    def close(self) -> None:
        """Close the environment, and bear that its workers may be gone."""
        with contextlib.suppress(RuntimeError):
            self.env.close(raise_if_closed=False)


def _without_commit(described: str) -> dict[str, Any]:
    """Return what was evaluated; the same by a later commit may take its place."""
    values: dict[str, Any] = json.loads(described)
    values.pop("commit", None)
    return values


class EvaluationRun:
    """An evaluation and the folder it writes: ``episodes.csv``, ``summary.csv`` and ``evaluation.json``.

    Args:
        out: the folder; made when the results are there.
        described: what is evaluated and how; equal descriptions give equal files.
        num_maps: maps to drive on.
        rows: drives the episodes; called with what to call after each map.

    Raises:
        UserInputError: if the folder holds another evaluation.
    """

    def __init__(
        self,
        *,
        out: Path,
        described: Mapping[str, Any],
        num_maps: int,
        rows: Callable[[Callable[[int], None]], pd.DataFrame],
    ) -> None:
        self.out = out
        self.described = json.dumps(described, indent=2) + "\n"
        self.num_maps = num_maps
        self.rows = rows
        if out.exists() and not out.is_dir():
            raise UserInputError(f"out={out} is not a folder: give another with out=<folder>")
        path = out / "evaluation.json"
        if path.exists() and _without_commit(path.read_text()) != _without_commit(self.described):
            raise UserInputError(f"{out} holds an evaluation of something else: give another folder with out=<folder>")

    def run(self) -> None:
        """Drive, write, and print the summary."""
        with tqdm(total=self.num_maps, unit="map", disable=None) as bar:

            def show(maps_done: int) -> None:
                bar.update(maps_done - bar.n)

            episodes = self.rows(show)
        summary = summarise(episodes, ["beta", "collision_weight"])
        self.out.mkdir(parents=True, exist_ok=True)
        episodes.to_csv(self.out / "episodes.csv", index=False, float_format="%.9g")
        summary.to_csv(self.out / "summary.csv", index=False, float_format="%.6g")
        (self.out / "evaluation.json").write_text(self.described)
        shown = summary.dropna(axis="columns", how="all").set_index("episodes")
        print(shown.T.to_string(header=True, float_format="%.3f"))
        print(f"written to {self.out}")
