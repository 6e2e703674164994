"""What half precision changes: agents ship in it, at half the size, and must drive as they were trained."""

from dataclasses import replace
from typing import Any

import numpy as np

from rcdsac_trl.deploy import Policy, Weights
from rcdsac_trl.deploy.policy.acting import BY_MEAN
from rcdsac_trl.errors import FaultError
from rcdsac_trl.robot.range_sensor import NUM_BINS
from rcdsac_trl.seeding import stream

LIMITS = {"linear_speed_m_per_s": 0.02, "angular_speed_rad_per_s": 0.05, "quantile": 0.5}
"""How far an agent that ships may be from the one that was trained, at any step: of speeds of up to 0.6 m/s and 1.6
rad/s, and of returns whose quantiles lie tens apart."""
STEPS = 200
"""Steps in which they are compared, under each of some values of beta."""
# Share of the trained range of beta, from the most averse to the least.
_SHARES = (0.0, 0.5, 1.0)


def largest_differences(one: Weights, other: Weights, steps: int = STEPS) -> dict[str, float]:
    """Return how far two agents are apart at most that see the same, in drives of random observations.

    Recurrent states run on, so what rounding adds up to is in it. Angular speeds are those before the robot's dead
    band, at whose edge a hair's breadth decides.

    Args:
        one: an agent.
        other: likewise, of the same kind.
        steps: of each drive.

    Returns:
        By the names of :data:`LIMITS`: what they want before any guard, and the quantiles of the return that they
        expect, where they have any.
    """
    rng = stream(0, "publish")
    # Of the mean: a choice among actions may fall otherwise where two are worth the same.
    policies = [Policy(_without_dead_band(weights), guard=None, acting=BY_MEAN) for weights in (one, other)]
    largest = dict.fromkeys(LIMITS, 0.0)
    for context in _contexts(one):
        for policy in policies:
            policy.reset()
        for _ in range(steps):
            ranges = rng.uniform(0.3, 6.0, NUM_BINS)
            waypoints = rng.uniform(-3.0, 3.0, (2, 2))
            velocity = rng.uniform((-0.2, -1.5), (0.6, 1.5))
            first, second = (policy.act(ranges, waypoints, velocity, **context) for policy in policies)
            assert first.wanted is not None
            assert second.wanted is not None
            found = dict(zip(LIMITS, np.abs(np.subtract(first.wanted, second.wanted)), strict=False))
            if first.quantiles is not None and second.quantiles is not None:
                found["quantile"] = np.abs(np.subtract(first.quantiles, second.quantiles)).max()
            largest = {name: max(by, float(found.get(name, 0.0))) for name, by in largest.items()}
    if one.config.critic != "quantile":
        del largest["quantile"]
    return largest


def _without_dead_band(weights: Weights) -> Weights:
    robot = replace(weights.config.robot, dead_band_deg_per_s=0.0)
    return Weights(replace(weights.config, robot=robot), weights.tensors)


def _contexts(weights: Weights) -> list[dict[str, Any]]:
    config = weights.config
    if config.context is None or config.context_range is None:
        return [{}]
    low, high = config.context_range
    key = "beta" if config.context == "beta" else "collision_weight"
    return [{key: low + share * (high - low)} for share in _SHARES]


def check_rounding(name: str, differences: dict[str, float]) -> None:
    """Refuse an agent that half precision changes too much.

    Args:
        name: of the agent.
        differences: from :func:`largest_differences`.

    Raises:
        FaultError: naming what changed, and by how much.
    """
    for quantity, by in differences.items():
        if not by <= LIMITS[quantity]:
            raise FaultError(
                f"half precision changes {quantity} of {name} by {by:.2g}, more than {LIMITS[quantity]:g}: nothing was "
                "published; leave its run out, and `export` it, in single precision"
            )
