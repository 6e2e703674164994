"""The way to a goal, by hand-made episodes in a room with one wall."""

import math
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import torch
from tensordict import TensorDict

from rcdsac_trl.rollout.navigation_metrics import TRIP_METRICS, navigation_metrics

PERIOD_S = 0.5


class Room:
    """Stands in for a planner: one pillar, and every way straight."""

    robot_radius_m = 0.25
    map = SimpleNamespace(solids=lambda: (np.zeros((0, 6)), np.array([[0.0, 1.0, 0.25]])))

    def path_length(self, start: Any, goal: Any) -> float:
        return math.dist(start, goal)


def measure(points: list[tuple[float, float]], contact: str, goal: str) -> dict[str, float]:
    """Measure one episode from its positions, the start first, and its marked steps."""
    flags = {
        key: torch.tensor([mark == "x" for mark in text]).view(1, -1, 1)
        for key, text in (("contact", contact), ("goal_reached", goal))
    }
    pose = torch.tensor([[(x, y, 0.0) for x, y in points]])
    after = {"pose": pose[:, 1:], **flags}
    episodes = TensorDict({"pose": pose[:, :-1], "next": after}, batch_size=[1, len(points) - 1])
    measured = navigation_metrics(episodes, Room(), torch.tensor([PERIOD_S]))  # type: ignore[arg-type]
    assert tuple(measured) == TRIP_METRICS
    return {key: value.item() for key, value in measured.items()}


# Standing, then along two sides of a right-angled triangle, then on.
WAY = [(0.0, 0.0), (0.0, 0.0), (3.0, 0.0), (3.0, 4.0), (3.0, 5.0)]


def test_a_success_by_hand() -> None:
    trip = measure(WAY, contact="...x", goal="..x.")
    assert (trip["success"], trip["collided"], trip["timed_out"]) == (1.0, 0.0, 0.0)
    assert trip["time_to_goal_s"] == 3 * PERIOD_S
    assert trip["spl"] == pytest.approx(5.0 / 7.0)  # the hypotenuse over the two sides
    assert trip["distance_m"] == 8.0
    assert trip["contact_s"] == PERIOD_S
    # At the origin 1 m from the pillar's centre, its radius and the robot's taken off.
    assert trip["smallest_clearance_m"] == pytest.approx(1.0 - 0.25 - 0.25)


@pytest.mark.parametrize(
    ("contact", "goal", "outcome"),
    [
        (".x..", "..x.", "collided"),  # reached, but after a contact
        ("..x.", "..x.", "collided"),  # in the very step
        ("...x", "....", "collided"),
        ("....", "....", "timed_out"),
        ("....", "...x", "success"),
        ("x...", "x...", "collided"),
    ],
)
def test_one_outcome_each(contact: str, goal: str, outcome: str) -> None:
    trip = measure(WAY, contact, goal)
    assert {key for key in ("success", "collided", "timed_out") if trip[key]} == {outcome}
    assert (trip["spl"] > 0) == (outcome == "success")
    assert math.isnan(trip["time_to_goal_s"]) == ("x" not in goal)
