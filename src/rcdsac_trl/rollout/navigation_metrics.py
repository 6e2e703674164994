"""What users of navigation benchmarks ask of an episode: the way to its first goal, clearance, and times in seconds.

Worked out after the episode, from the recorded poses and the map, so that driving costs nothing more.
"""

import torch
from tensordict import TensorDictBase
from torch import Tensor

from rcdsac_trl.world.maps.geometry import segment_clearance
from rcdsac_trl.world.maps.planner import Planner

TRIP_METRICS = (
    "success",
    "collided",
    "timed_out",
    "time_to_goal_s",
    "spl",
    "distance_m",
    "contact_s",
    "smallest_clearance_m",
)

# What is farther away does not count as near.
_CLEARANCE_LIMIT_M = 3.0


def navigation_metrics(episodes: TensorDictBase, planner: Planner, period_s: Tensor) -> dict[str, Tensor]:
    """Measure the ways of episodes on one map.

    The first goal is one trial, as in BARN and CrowdNav: a success reached it without touching anything, a collision
    touched something first, and what did neither ran out of time.

    Args:
        episodes: ``[N, T]`` with ``"pose"``, ``("next", "pose")``, ``("next", "contact")`` and
            ``("next", "goal_reached")``.
        planner: of the map.
        period_s: length of an agent step in each episode, ``[N]``, s.

    Returns:
        One float64 ``[N]`` for each of :data:`TRIP_METRICS`: `success`, `collided` and `timed_out`, one of which is
        1; `time_to_goal_s`, NaN where the first goal was not reached; `spl`, success weighted by path length (Anderson
        et al., 2018, "On Evaluation of Embodied Navigation Agents"), shortest way past everything that stands;
        `distance_m` driven and `contact_s` in the whole episode; `smallest_clearance_m` between the robot's
        circumcircle and what stands (not what walks).
    """
    after = episodes["next"]
    pose = torch.cat([episodes["pose"][:, :1], after["pose"]], 1).double()
    rows = zip(pose, after["contact"].squeeze(-1), after["goal_reached"].squeeze(-1), strict=True)
    trips = [_trip(*row, planner, period) for row, period in zip(rows, period_s.tolist(), strict=True)]
    return {key: torch.tensor([trip[key] for trip in trips], dtype=torch.float64, device="cpu") for key in TRIP_METRICS}


def _trip(pose: Tensor, contact: Tensor, reached: Tensor, planner: Planner, period_s: float) -> dict[str, float]:
    legs_m = (pose[1:, :2] - pose[:-1, :2]).norm(dim=1)
    # Steps until the first goal and the first contact; one more than there are where there was none.
    to_goal, to_contact = _first(reached), _first(contact)
    arrived = to_goal <= len(legs_m)
    success = arrived and to_contact > to_goal
    spl = 0.0
    if success:
        start, goal = pose[0, :2].numpy(), pose[to_goal, :2].numpy()
        shortest_m = planner.path_length(start, goal)
        spl = shortest_m / max(shortest_m, float(legs_m[:to_goal].sum()))
    return {
        "success": float(success),
        "collided": float(not success and to_contact <= len(legs_m)),
        "timed_out": float(not arrived and to_contact > len(legs_m)),
        "time_to_goal_s": to_goal * period_s if arrived else float("nan"),
        "spl": spl,
        "distance_m": float(legs_m.sum()),
        "contact_s": float(contact.sum()) * period_s,
        "smallest_clearance_m": _smallest_clearance_m(pose, planner),
    }


def _first(flags: Tensor) -> int:
    """Count the steps up to the first flag, itself included."""
    return int(flags.int().argmax()) + 1 if bool(flags.any()) else len(flags) + 1


def _smallest_clearance_m(pose: Tensor, planner: Planner) -> float:
    boxes, circles = planner.map.solids()
    nearest = min(segment_clearance(x, y, x, y, boxes, circles, _CLEARANCE_LIMIT_M) for x, y, _ in pose.tolist())
    return max(float(nearest) - planner.robot_radius_m, 0.0)
