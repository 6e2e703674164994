"""The environment as one would write it first, to compare with: what is fast about ours is left out.

A worker process for each agent; walls and clutter as one PyBullet body each; a range sensor of 180 rays by
`rayTestBatch`, which can miss what stands between two rays.
"""

import math
from typing import Any

import numpy as np

import bench_world as bench


def _make_naive() -> None:
    """Make every simulation of this process a naive one."""
    from rcdsac_trl.robot.range_sensor import MAX_RANGE_M, NUM_BINS
    from rcdsac_trl.robot.robot_settings import PAPER
    from rcdsac_trl.world.sim import bodies, simulation
    from rcdsac_trl.world.sim.bullet import pybullet

    bodies.SHAPES_PER_BODY = 1

    def scan(self: Any) -> np.ndarray:
        x, y, yaw = self.pose
        # Each ray from the rim of the robot along the middle of a bin.
        angles = yaw + (np.arange(NUM_BINS) + 0.5) * (2.0 * math.pi / NUM_BINS)
        directions = np.stack([np.cos(angles), np.sin(angles), np.zeros(NUM_BINS)], axis=1)
        here = np.array([x, y, 0.0])
        near, far = PAPER.circumradius_m + 1e-3, MAX_RANGE_M
        hits = pybullet.rayTestBatch(
            (here + near * directions).tolist(), (here + far * directions).tolist(), physicsClientId=self._client
        )
        fractions = np.array([hit[2] for hit in hits])
        return np.where(fractions < 1.0, near + fractions * (far - near), np.inf)

    simulation.Simulation.scan = scan


def naive_env(agent_id: int) -> Any:
    """Make the environment of one agent, in a worker of its own."""
    from rcdsac_trl.world.task.env import NavigationEnv

    _make_naive()
    return NavigationEnv(agent_ids=(agent_id,))


def steps_per_second(steps: int) -> float:
    """Drive ten agents through their workers; return agent steps a second of wall time."""
    from functools import partial

    import torch
    from torchrl.envs import ParallelEnv

    from rcdsac_trl.rollout.planners.pursuit import pursuit_action

    makers = [partial(naive_env, agent_id) for agent_id in range(bench.NUM_AGENTS)]
    env = ParallelEnv(bench.NUM_AGENTS, makers, mp_start_method="forkserver")
    tensordict = env.reset()

    def drive() -> None:
        nonlocal tensordict
        for _ in range(steps):
            action = pursuit_action(tensordict["waypoint"]) + 0.7 * torch.randn(bench.NUM_AGENTS, 1, 2)
            tensordict = env.step(tensordict.set("action", action.clamp(-1.0, 1.0)))["next"]

    drive()
    seconds = min(bench.wall_seconds(drive) for _ in range(3))
    env.close()
    return steps * bench.NUM_AGENTS / seconds
