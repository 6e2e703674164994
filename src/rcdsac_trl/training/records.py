"""What is written of an iteration's training episodes: a row an episode, and the scalars that sum them up."""

import pandas as pd
from tensordict import TensorDictBase

from rcdsac_trl.rollout.metrics import METRICS, episode_metrics


def training_rows(
    episodes: TensorDictBase, context_key: str | None, *, iteration: int, updates: int
) -> tuple[pd.DataFrame, dict[str, float]]:
    """Sum up the training episodes of an iteration.

    Args:
        episodes: ``[N, T]``, as :func:`~rcdsac_trl.rollout.metrics.episode_metrics` takes them.
        context_key: what tells episodes apart: ``"risk"``, ``"collision_weight"`` or None.
        iteration: that drove them.
        updates: that the agent had when it drove them.

    Returns:
        One row an episode, and the means to log: over all episodes, and over the half with the lower context and that
        with the higher one. The mean over all betas would hide an averse half that stands still.
    """
    metrics = episode_metrics(episodes)
    rows = pd.DataFrame({key: value.numpy() for key, value in metrics.items()})
    scalars = {f"train/{metric}": float(rows[metric].mean()) for metric in METRICS}
    if context_key is not None:
        column = "beta" if context_key == "risk" else context_key
        rows.insert(0, column, episodes[context_key][:, 0, 0].cpu().numpy())
        in_order = rows.sort_values(column)
        halves = {"low": in_order[: len(rows) // 2], "high": in_order[len(rows) // 2 :]}
        for half, part in halves.items():
            if len(part):  # a single agent has no lower half
                scalars |= {f"train/{metric}/{half}_{column}": float(part[metric].mean()) for metric in METRICS}
    rows.insert(0, "episode", range(len(rows)))
    rows.insert(0, "iteration", iteration)
    rows.insert(1, "updates", updates)
    return rows, scalars
