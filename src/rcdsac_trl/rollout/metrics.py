"""What an episode amounted to: one row of plain numbers each."""

import pandas as pd
import torch
from tensordict import TensorDictBase
from torch import Tensor

from rcdsac_trl.world.task.rules import COLLISION_REWARD, combined

METRICS = ("collisions", "reward", "goals", "mean_speed_m_per_s", "contact_fraction")
# What they and the replay read of what a step led to, beside the observations.
HAPPENED = ("contact", "goal_reached", "reward_components")


def contact_onsets(contact: Tensor) -> Tensor:
    """Mark the steps at which a contact begins.

    Args:
        contact: bool ``[N, T]``, in contact during the step. Episodes begin without contact.

    Returns:
        bool ``[N, T]``: in contact, after at least one contact-free step.
    """
    before = torch.zeros_like(contact)
    before[:, 1:] = contact[:, :-1]
    return contact & ~before


def episode_metrics(episodes: TensorDictBase) -> dict[str, Tensor]:
    """Sum episodes up.

    Args:
        episodes: ``[N, T]`` with ``("next", "contact")``, ``("next", "goal_reached")``,
            ``("next", "reward_components")`` and ``("next", "velocity")``.

    Returns:
        One ``[N]`` tensor for each of :data:`METRICS`. `reward` is the undiscounted sum with a collision weight of
        1 for every algorithm, so that rows compare; `mean_speed_m_per_s` averages abs(v_c).
    """
    after = episodes["next"]
    contact = after["contact"].squeeze(-1)
    return {
        "collisions": contact_onsets(contact).sum(1).double(),
        "reward": combined(after["reward_components"].double()).sum(1),
        "goals": after["goal_reached"].squeeze(-1).sum(1).double(),
        "mean_speed_m_per_s": after["velocity"][..., 0].abs().double().mean(1),
        "contact_fraction": contact.double().mean(1),
    }


def validation_score(by_condition: pd.DataFrame, episode_steps: int) -> float:
    """Return what the best agent is chosen by: the mean reward, less 10 a collision and 1 for every step in contact.

    The reward charges a collision 10 already. Here it costs that once more, so that of two agents that earn alike the
    one that earns it with fewer collisions is the better one. And the reward charges a contact's onset alone, so an
    agent that leans on a wall would only seem slow.

    Args:
        by_condition: mean `reward`, `collisions` and `contact_fraction`, one row a condition; conditions count alike.
        episode_steps: length of an episode.
    """
    charged = -COLLISION_REWARD * by_condition["collisions"] + episode_steps * by_condition["contact_fraction"]
    return float((by_condition["reward"] - charged).mean())


def summarise(episodes: pd.DataFrame, by: list[str]) -> pd.DataFrame:
    """Give mean and standard deviation (over episodes, ddof 0) of every metric, and the number of episodes.

    Args:
        episodes: one row an episode, as :func:`rcdsac_trl.rollout.measurement.table_of` returns them.
        by: columns that make a group; missing values form groups of their own.

    Metrics are all columns but those and `map` and `episode`; an episode that has none of one does not count in it.
    """
    groups = episodes.groupby(by, dropna=False, sort=False)
    parts: dict[str, pd.Series] = {"episodes": groups.size()}
    for metric in episodes.columns.drop([*by, "map", "episode"], errors="ignore"):
        parts[f"{metric}_mean"] = groups[metric].mean()
        parts[f"{metric}_std"] = groups[metric].std(ddof=0)
    return pd.DataFrame(parts).reset_index()
