"""Untrained agents for the tests of what leaves the simulator: real networks, weights drawn from a seed."""

from typing import Any

import numpy as np

from rcdsac_trl.deploy.policy.agent_config import AgentConfig
from rcdsac_trl.deploy.policy.weights import Weights

POW: dict[str, Any] = {
    "name": "rcdsac_pow",
    "sensor": "narrow",
    "critic": "quantile",
    "num_critics": 2,
    "context": "beta",
    "context_range": (-2.0, 0.0),
    "measure": "pow",
    "embedding": (-0.5, 0.0),
    "fixed_beta": None,
    "network": {"conv": 4, "range": 8, "vector": 4, "memory": 8, "head": 8, "cosines": 4},
    "period_s": (0.12, 0.16),
    "waypoint_radius_m": 0.5,
    "goal_radius_m": 0.15,
    "provenance": {"seed": 0},
}
NOT_TOLD = {"context": None, "context_range": None, "embedding": None}
SAC = NOT_TOLD | {"name": "sac", "critic": "scalar", "measure": "neutral"}
DSAC = NOT_TOLD | {"name": "dsac_pow", "fixed_beta": -1.0}
RCWR = SAC | {"name": "rcwr", "context": "collision_weight", "context_range": (0.1, 2.0)}
CVAR = {"name": "rcdsac_cvar", "measure": "cvar", "context_range": (0.01, 1.0), "embedding": (1.0, 0.0)}
ROWS: dict[str, dict[str, Any]] = {"rcdsac_pow": {}, "rcdsac_cvar": CVAR, "dsac_pow": DSAC, "rcwr": RCWR, "sac": SAC}


def agent(seed: int = 0, **changes: Any) -> Weights:
    """Make an agent whose weights have the size that torch's layers begin with."""
    config = AgentConfig(**(POW | changes))
    rng = np.random.default_rng(seed)
    tensors = {}
    for name, shape in config.shapes().items():
        bound = 1.0 / np.sqrt(np.prod(shape[1:])) if len(shape) > 1 else 0.1
        tensors[name] = rng.uniform(-bound, bound, shape).astype(np.float32)
    return Weights(config, tensors)


def full_size(**changes: Any) -> Weights:
    """Make an agent with the paper's widths."""
    widths = {"conv": 32, "range": 128, "vector": 32, "memory": 128, "head": 128, "cosines": 64}
    return agent(network=widths, **changes)


OPEN = np.full(180, np.inf)
AHEAD = [[2.0, 0.0], [4.0, 0.0]]
STANDING = [0.0, 0.0]
