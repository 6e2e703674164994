"""The pursuit baseline: its rule by hand, and that it drives where nothing stands in the way."""

import math

import pytest
import torch

from rcdsac_trl.robot.action import desired_velocities
from rcdsac_trl.rollout.planners.pursuit import pursuit_action
from rcdsac_trl.world.maps.generator import MapSettings
from rcdsac_trl.world.task.env import NavigationEnv


def seen(bearing_deg: float) -> torch.Tensor:
    bearing = math.radians(bearing_deg)
    return torch.tensor([0.3, math.cos(bearing), math.sin(bearing), 1.0, -1.0, 0.0])


@pytest.mark.parametrize(
    ("bearing_deg", "v_u", "omega_u_deg"),
    [
        (0.0, 0.6, 0.0),
        (9.0, 0.6, 0.0),  # asks for 13.5 deg/s, which is inside the dead band
        (20.0, 0.6, 30.0),
        (-20.0, 0.6, -30.0),
        (40.0, 0.0, 60.0),
        (-90.0, 0.0, -90.0),
        (179.0, 0.0, 90.0),
    ],
)
def test_it_turns_to_the_waypoint_and_drives_when_aligned(bearing_deg: float, v_u: float, omega_u_deg: float) -> None:
    driven = desired_velocities(pursuit_action(seen(bearing_deg)).tolist())
    assert driven == pytest.approx((v_u, math.radians(omega_u_deg)), abs=1e-6)


def test_it_works_on_any_batch_and_looks_at_the_next_waypoint_alone() -> None:
    batch = torch.stack([seen(angle) for angle in range(-180, 180, 15)]).view(2, 3, 4, 6)
    actions = pursuit_action(batch)
    assert actions.shape == (2, 3, 4, 2)
    assert (actions.abs() <= 1.0).all()
    other = batch.clone()
    other[..., 3:] = 0.5
    assert torch.equal(pursuit_action(other), actions)


def test_it_reaches_goals_without_a_collision_where_nothing_stands() -> None:
    empty = MapSettings(size_m=12.0, layouts=("clutter",), clutter_per_m2=0.0, num_movers=0)
    env = NavigationEnv(map_settings=empty, agent_ids=tuple(range(4)))
    tensordict = env.reset()
    goals, collisions, speed = torch.zeros(4), torch.zeros(4), torch.zeros(4)
    for _ in range(500):
        after = env.step(tensordict.set("action", pursuit_action(tensordict["waypoint"])))["next"]
        goals += after["goal_reached"][:, 0]
        collisions += (after["contact"] & ~tensordict["contact"])[:, 0]
        speed += after["velocity"][:, 0] / 500
        tensordict = after.exclude("reward")
    env.close()
    assert (goals >= 3).all()
    assert (collisions == 0).all()
    assert (speed > 0.45).all()
