"""What a hand-written controller is, and a policy that drives every agent of a batch with one of its own."""

import math
from collections.abc import Callable, Sequence
from typing import Protocol

import numpy as np
import torch
from numpy.typing import NDArray
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModuleBase

from rcdsac_trl.errors import UserInputError
from rcdsac_trl.robot.action import action_of
from rcdsac_trl.robot.observation import range_distances, waypoint_positions
from rcdsac_trl.robot.robot_settings import PAPER, RobotSettings
from rcdsac_trl.rollout.timed import Timed
from rcdsac_trl.seeding import stream


class Controller(Protocol):
    """Drives one robot with what an agent is told, decoded to metres: no pose, no map.

    A class whose objects are made without arguments and have these two methods can be evaluated with
    ``baseline=<module>:<class>``. Limits and sizes of the robot that it drives it has to know itself.
    """

    def reset(self, sensed: NDArray[np.bool_], rng: np.random.Generator, period_s: float) -> None:
        """Begin an episode, and forget the last one.

        Args:
            sensed: which of the 180 sectors the sensor has, bool [180]; sector i (from 0) covers [2i, 2i + 2) degrees
                counter-clockwise from straight ahead.
            rng: the only source of randomness to use; results repeat then.
            period_s: how long after one call of :meth:`act` the next one follows in this episode, s.
        """
        ...

    def act(
        self, ranges_m: NDArray[np.float64], waypoints_m: NDArray[np.float64], velocity: NDArray[np.float64]
    ) -> tuple[float, float]:
        """Return the desired velocities: linear in m/s and angular in rad/s; what is beyond the robot's is clipped.

        Args:
            ranges_m: smallest distance in each sector, float64 [180], m; ``inf`` where nothing is in reach and
                where the sensor has no sector.
            waypoints_m: the next two waypoints, float64 [2, 2], x ahead and y to the left, m; both are the goal on
                the last leg.
            velocity: linear and angular velocity measured, then those desired last, float64 [4], m/s and rad/s.
        """
        ...


class ControllerPolicy(Timed, TensorDictModuleBase):
    """Drives each agent with a controller of its own, so that none depends on which others there are.

    Args:
        make: makes a controller.
        name: of the controller, for messages and as the purpose of its random streams.
        sensed: which of the 180 sectors the sensor has, bool [180].
        agent_ids: numbers of the agents, in the order of the flattened batch.
        seed: root seed; agent j on map i draws from the stream (seed, name, i, j).
        robot: that is driven.

    Example:
        >>> from tensordict import TensorDict
        >>> from rcdsac_trl.robot.range_sensor import sensor_mask
        >>> from rcdsac_trl.rollout.planners.dwa import Dwa
        >>> policy = ControllerPolicy(Dwa, "dwa", sensor_mask("narrow"), agent_ids=[0], seed=0)
        >>> policy.set_periods([0.14])
        >>> ahead = torch.tensor([[1.0, 1.0, 0.0, 1.0, 1.0, 0.0]])
        >>> seen = {"range": torch.zeros(1, 180), "waypoint": ahead, "velocity": torch.zeros(1, 4)}
        >>> begin = torch.ones(1, 1, dtype=torch.bool)
        >>> policy(TensorDict({**seen, "is_init": begin}, [1]))["action"][:, 0]  # full speed
        tensor([1.])
    """

    in_keys = ["range", "waypoint", "velocity", "is_init"]  # noqa: RUF012 (TensorDictModuleBase's own form)
    out_keys = ["action"]  # noqa: RUF012

    def __init__(
        self,
        make: Callable[[], Controller],
        name: str,
        sensed: NDArray[np.bool_],
        agent_ids: Sequence[int],
        seed: int,
        robot: RobotSettings = PAPER,
    ) -> None:
        super().__init__()
        self._name = name
        self._robot = robot
        self._sensed = sensed
        self._agent_ids = tuple(agent_ids)
        self._seed = seed
        self._map_index = 0
        self._controllers = [make() for _ in self._agent_ids]

    def set_map(self, map_index: int) -> None:
        """Choose the random streams of the episodes that begin from now on."""
        self._map_index = map_index

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Write `action`.

        Raises:
            UserInputError: if a controller returns something else than two finite numbers.
        """

        def rows(key: str) -> NDArray:
            value = tensordict.get(key)
            return value.reshape(-1, value.shape[-1]).numpy()

        ranges_m = range_distances(rows("range"), self._robot.lidar.max_range_m)
        waypoints_m = waypoint_positions(rows("waypoint"))
        velocities = rows("velocity").astype(np.float64)
        is_init = rows("is_init")[:, 0]
        actions = np.empty((len(self._controllers), 2), np.float32)
        for row, controller in enumerate(self._controllers):
            if is_init[row]:
                noise = stream(self._seed, self._name, self._map_index, self._agent_ids[row])
                controller.reset(self._sensed, noise, self.periods_s[row])
            actions[row] = self._action(controller.act(ranges_m[row], waypoints_m[row], velocities[row]))
        return tensordict.set("action", torch.from_numpy(actions).view(*tensordict.batch_size, -1))

    def _action(self, answer: object) -> tuple[float, float]:
        """Return the action of what a controller answered."""
        try:
            v, omega = (float(value) for value in answer)  # type: ignore[attr-defined]
        except (TypeError, ValueError):
            v = omega = math.nan
        if not (math.isfinite(v) and math.isfinite(omega)):
            raise UserInputError(
                f"baseline={self._name} answered {answer!r}: act() must return the desired velocities, two finite "
                "numbers in m/s and rad/s"
            )
        return action_of(v, omega, self._robot)
