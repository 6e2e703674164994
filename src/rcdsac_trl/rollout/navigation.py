"""The navigation around an agent, in a simulation: the same as on a robot, for a whole worker."""

from collections.abc import Callable

import numpy as np
import torch
from numpy.typing import NDArray
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModuleBase

from rcdsac_trl.config.navigation_settings import NavigationSettings
from rcdsac_trl.deploy.navigation.navigator import Advice, Navigator, NavigatorSettings
from rcdsac_trl.deploy.navigation.static_layer import StaticLayer
from rcdsac_trl.robot.action import action_of, desired_velocities
from rcdsac_trl.robot.guard import Guard
from rcdsac_trl.robot.latency import at_once
from rcdsac_trl.robot.observation import AT_ORIGIN, range_distances, waypoint_observation, waypoint_positions
from rcdsac_trl.robot.robot_settings import PAPER, RobotSettings
from rcdsac_trl.robot.sectors import Sectors
from rcdsac_trl.rollout.foresight import ForesightedPolicy
from rcdsac_trl.rollout.timed import Timed


def navigator_of(
    settings: NavigationSettings, robot: RobotSettings, static_layer: StaticLayer | None = None
) -> Navigator | None:
    """Make what navigates around an agent, on a map if there is one; None where nothing is asked for."""
    if not (settings.replan or settings.watchdog or static_layer is not None):
        return None
    switched = NavigatorSettings.switched(replan=settings.replan, watchdog=settings.watchdog)
    return Navigator(switched, robot, static_layer)


class NavigatedPolicy(Timed, TensorDictModuleBase):
    """A policy whose agents are advised, each by a navigator of its own.

    Args:
        policy: acts on `waypoint`, and on `risk` if its agents are told one; where it is a
            :class:`ForesightedPolicy`, the guard limits from where that foresees its robots.
        make: makes a navigator.
        sensed: which of the 180 sectors the sensor has, bool [180].
        num_agents: that it acts for.
        boldest: the beta towards which an agent that stands still is turned; None: agents are told none.
        robot: that is driven.
        guard: stands between the agents and the wheels, and minds what their navigators know; None: nothing does.
    """

    def __init__(
        self,
        policy: TensorDictModuleBase,
        make: Callable[[], Navigator],
        sensed: NDArray[np.bool_],
        num_agents: int,
        boldest: float | None,
        robot: RobotSettings = PAPER,
        guard: Guard | None = None,
    ) -> None:
        super().__init__()
        self.in_keys, self.out_keys = policy.in_keys, policy.out_keys
        self.policy = policy
        self._navigators = [make() for _ in range(num_agents)]
        self._sensed = sensed
        self._boldest = boldest
        self._robot = robot
        self._guard = guard

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Write what the policy writes, acting on what the navigators say; observations stay as they were."""
        asked = tensordict.clone(recurse=False)
        distances_m = range_distances(tensordict["range"].numpy(), self._robot.lidar.max_range_m)
        velocities: list[tuple[float, float]] = [(v, omega) for v, omega, *_ in tensordict["velocity"].tolist()]
        advice = self._advice(tensordict, distances_m, velocities)
        waypoints = [waypoint_observation(AT_ORIGIN, *each.waypoints) for each in advice]
        asked["waypoint"] = torch.tensor(waypoints, dtype=torch.float32, device="cpu")
        if self._boldest is not None:
            boldness = torch.tensor([[each.boldness] for each in advice], dtype=torch.float32, device="cpu")
            asked["risk"] = tensordict["risk"] + boldness * (self._boldest - tensordict["risk"])
        asked = self.policy(asked)
        foreseen = self.policy.foreseen if isinstance(self.policy, ForesightedPolicy) else None
        action = asked["action"].clone()
        for row, each in enumerate(advice):
            driven = each.instead
            if driven is not None:  # as far as an action can say it: slow turns are none, and the guard is to know
                driven = desired_velocities(action_of(*driven, self._robot), self._robot)
            if self._guard is not None:
                wish = desired_velocities(action[row].tolist(), self._robot) if driven is None else driven
                seen = Sectors(distances_m[row], self._sensed, self._robot.lidar.max_range_m)
                ahead = at_once(velocities[row]) if foreseen is None else foreseen[row]
                known = self._navigators[row].known(seen, None, self._guard.reach_m(abs(wish[0]), ahead))
                v, omega, limited = self._guard.limit(*wish, known, velocities[row], each.been, ahead)
                driven = driven if limited is None else (v, omega)
            if driven is not None:
                action[row] = torch.tensor(action_of(*driven, self._robot), dtype=torch.float32, device="cpu")
        for key in self.policy.out_keys:
            tensordict[key] = asked[key]
        return tensordict.set("action", action)

    def _advice(
        self, tensordict: TensorDictBase, distances_m: NDArray[np.float64], velocities: list[tuple[float, float]]
    ) -> list[Advice]:
        waypoints = waypoint_positions(tensordict["waypoint"].numpy()).tolist()
        begins = tensordict["is_init"][:, 0].tolist()
        advice = []
        for row, navigator in enumerate(self._navigators):
            if begins[row]:
                navigator.reset()
            (x, y), (x_after, y_after) = waypoints[row]
            elapsed_s = 0.0 if begins[row] else self.periods_s[row]
            following = (x, y), (x_after, y_after)
            advice.append(navigator.advise(distances_m[row], self._sensed, following, velocities[row], elapsed_s))
        return advice
