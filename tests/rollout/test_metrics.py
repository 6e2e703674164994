"""What an episode amounts to, by hand-made episodes."""

import math

import pandas as pd
import pytest
import torch
from tensordict import TensorDict

from rcdsac_trl.config.conditions import Condition, check_unique
from rcdsac_trl.errors import UserInputError
from rcdsac_trl.rollout.metrics import METRICS, contact_onsets, episode_metrics, summarise, validation_score


def flags(text: str) -> torch.Tensor:
    return torch.tensor([[mark == "x" for mark in row] for row in text.split()])


@pytest.mark.parametrize(
    ("contact", "onsets"),
    [
        ("......", "......"),
        ("x.....", "x....."),  # an episode begins without contact, so contact in its first step is an onset
        ("xxxxxx", "x....."),
        ("..xx..", "..x..."),
        (".x.x.x", ".x.x.x"),
        ("xx.xx.", "x..x.."),  # one contact-free step separates two collisions
        (".....x", ".....x"),
        ("xx.... ..xxxx", "x..... ..x..."),  # episodes do not run into each other
    ],
)
def test_contact_onsets(contact: str, onsets: str) -> None:
    assert torch.equal(contact_onsets(flags(contact)), flags(onsets))


def test_episode_metrics_by_hand() -> None:
    contact = flags("..xx.x").unsqueeze(-1)
    #                 base  goal   waypoint angular collision
    components = torch.tensor(
        [
            [
                [-0.02, 0.0, 0.50, 1.2, 0.0],
                [-0.02, 10.0, 0.40, 0.5, 0.0],
                [-0.02, 0.0, 0.00, 1.2, -10.0],
                [-0.02, 0.0, 0.00, 0.8, 0.0],
                [-0.02, 10.0, -0.10, 1.0, 0.0],
                [-0.02, 0.0, 0.00, 1.2, -10.0],
            ]
        ]
    )
    speed = torch.tensor([0.6, 0.5, 0.0, -0.2, -0.1, 0.4])
    velocity = torch.stack([speed, *3 * [torch.full((6,), 9.0)]], -1).unsqueeze(0)
    after = {
        "contact": contact,
        "goal_reached": flags(".x..x.").unsqueeze(-1),
        "reward_components": components,
        "velocity": velocity,
    }
    measured = episode_metrics(TensorDict({"next": after}, batch_size=[1, 6]))
    assert tuple(measured) == METRICS
    values = {key: value.item() for key, value in measured.items()}
    assert values["collisions"] == 2
    # -0.12 base, +20 goals, 0.6 + 0.2 - 0.1 for waypoints, -20 for two collisions
    assert values["reward"] == pytest.approx(0.58, abs=1e-6)
    assert values["goals"] == 2
    # backwards counts as moving: (0.6 + 0.5 + 0 + 0.2 + 0.1 + 0.4) / 6
    assert values["mean_speed_m_per_s"] == pytest.approx(0.3, abs=1e-6)
    assert values["contact_fraction"] == pytest.approx(0.5)


def test_metrics_of_several_episodes_stay_apart() -> None:
    steps = 4
    components = torch.zeros(2, steps, 5)
    components[1, :, 1] = 10.0
    after = {
        "contact": torch.zeros(2, steps, 1, dtype=torch.bool),
        "goal_reached": torch.tensor([False, True]).view(2, 1, 1).expand(2, steps, 1),
        "reward_components": components,
        "velocity": torch.zeros(2, steps, 4),
    }
    measured = episode_metrics(TensorDict({"next": after}, batch_size=[2, steps]))
    assert measured["reward"].tolist() == [0.0, 40.0]
    assert measured["goals"].tolist() == [0.0, 4.0]


def test_summary_by_hand_groups_missing_values_too() -> None:
    rows = pd.DataFrame({"beta": [-1.0, -1.0, math.nan], "collision_weight": [math.nan] * 3})
    for metric in METRICS:
        rows[metric] = [1.0, 4.0, 7.0]
    summary = summarise(rows, ["beta", "collision_weight"])
    assert summary["episodes"].tolist() == [2, 1]
    for metric in METRICS:
        assert summary[f"{metric}_mean"].tolist() == [2.5, 7.0]
        assert summary[f"{metric}_std"].tolist() == [1.5, 0.0]  # over the episodes measured: ddof 0


def test_the_validation_score_charges_collisions_and_contact_by_hand() -> None:
    means = pd.DataFrame({"reward": [100.0, 50.0], "collisions": [1.0, 0.5], "contact_fraction": [0.01, 0.0]})
    # 100 - 10 * 1 - 1000 * 0.01 = 80 and 50 - 10 * 0.5 = 45, which count alike.
    assert validation_score(means, episode_steps=1000) == pytest.approx(62.5)


def test_conditions_name_themselves() -> None:
    assert str(Condition(beta=-1.5)) == "beta=-1.5"
    assert str(Condition(beta=0.0)) == "beta=0"
    assert str(Condition(collision_weight=2.0)) == "w_coll=2"
    assert str(Condition()) == "all"


def test_the_same_condition_twice_is_refused() -> None:
    check_unique([Condition(beta=-1.0), Condition(beta=-2.0)])
    with pytest.raises(UserInputError, match="beta=-1 is given more than once"):
        check_unique([Condition(beta=-1.0), Condition(beta=-2.0), Condition(beta=-1.0)])
