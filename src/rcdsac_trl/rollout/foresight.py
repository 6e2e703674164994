"""Agents whose commands act late, told in a simulation what they will meet by then: the same as on a robot."""

import numpy as np
import torch
from numpy.typing import NDArray
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModuleBase

from rcdsac_trl.robot.latency import Ahead, Latency
from rcdsac_trl.robot.observation import AT_ORIGIN, range_distances, waypoint_observation, waypoint_positions
from rcdsac_trl.robot.remembered_ranges import RememberedRanges
from rcdsac_trl.robot.robot_settings import PAPER, RobotSettings
from rcdsac_trl.rollout.timed import Timed


class ForesightedPolicy(Timed, TensorDictModuleBase):
    """A policy whose agents are told waypoints, velocities and what is remembered as they will be.

    Range bins stay as they are.

    Attributes:
        foreseen: where each robot will be when the command that follows the last observation begins to act.

    Args:
        policy: acts on `waypoint`, `velocity` and `remembered`.
        latency_s: from an observation until the command that follows it acts, s.
        sensed: which of the 180 sectors the sensor has, bool [180].
        memory_s: for how long an agent remembers points, s.
        num_agents: that drive side by side.
        robot: that is driven.
    """

    def __init__(
        self,
        policy: TensorDictModuleBase,
        latency_s: float,
        sensed: NDArray[np.bool_],
        memory_s: float,
        num_agents: int,
        robot: RobotSettings = PAPER,
    ) -> None:
        super().__init__()
        self.in_keys, self.out_keys = policy.in_keys, policy.out_keys
        self.policy = policy
        self._latencies = [Latency(latency_s, robot) for _ in range(num_agents)]
        self._memories = [RememberedRanges(sensed, memory_s, robot) for _ in range(num_agents)]
        self._times_s = [0.0] * num_agents
        self.foreseen: list[Ahead] = []
        self._max_range_m = robot.lidar.max_range_m

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Write what the policy writes, acting on what its agents will meet; observations stay as they were."""
        told = self.policy(tensordict.clone(recurse=False).update(self._ahead(tensordict)))
        for key in self.out_keys:
            tensordict[key] = told[key]
        return tensordict

    def _ahead(self, tensordict: TensorDictBase) -> dict[str, torch.Tensor]:
        """Return the observations that will be others."""
        distances_m = range_distances(tensordict["range"].numpy(), self._max_range_m)
        places = waypoint_positions(tensordict["waypoint"].numpy())
        velocities = tensordict["velocity"].tolist()
        begins = tensordict["is_init"][:, 0].tolist()
        waypoints, moving, remembered = [], [], []
        self.foreseen = []
        for row, (latency, memory) in enumerate(zip(self._latencies, self._memories, strict=True)):
            v, omega, *commanded = velocities[row]
            elapsed_s = 0.0 if begins[row] else self.periods_s[row]
            if begins[row]:
                latency.reset()
                memory.reset()
                self._times_s[row] = 0.0
            else:
                latency.note((commanded[0], commanded[1]), self._times_s[row])
                self._times_s[row] += elapsed_s
            ahead = latency.ahead((v, omega), self._times_s[row])
            self.foreseen.append(ahead)
            first, second = ahead.seen(places[row]).tolist()
            waypoints.append(waypoint_observation(AT_ORIGIN, first, second))
            moving.append([*ahead.velocities, *commanded])
            remembered.append(memory.observe(distances_m[row], v, omega, elapsed_s, ahead=ahead))
        return {
            "waypoint": torch.tensor(waypoints, dtype=torch.float32, device="cpu"),
            "velocity": torch.tensor(moving, dtype=torch.float32, device="cpu"),
            "remembered": torch.from_numpy(np.array(remembered)),
        }
