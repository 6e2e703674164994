"""A group of agents, as one environment holds them: the core that both adapters share.

It knows neither TorchRL nor Gymnasium: :mod:`rcdsac_trl.world.task.env` and
:mod:`rcdsac_trl.world.task.gymnasium_env` are thin adapters over :class:`AgentGroup`.
"""

import math
from collections.abc import Iterable, Sequence
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from rcdsac_trl.errors import UserInputError
from rcdsac_trl.robot.observation import range_observation, waypoint_observation
from rcdsac_trl.robot.robot_settings import PAPER, RobotSettings
from rcdsac_trl.world.maps.generator import SPLITS, MapSettings, Split
from rcdsac_trl.world.maps.map_source import MapSource, with_digests
from rcdsac_trl.world.render import Scene
from rcdsac_trl.world.sim.bullet import OfOneProcess
from rcdsac_trl.world.sim.simulation import Simulation
from rcdsac_trl.world.task import rules
from rcdsac_trl.world.task.episode import NavigationAgent
from rcdsac_trl.world.task.rules import TaskSettings
from rcdsac_trl.world.task.spaces import ACTION_SIZE, SPACES, Buffers, agent_observations

# What is written together, in the order in which an agent's numbers are gathered, and its columns there.
_GATHERED = ("waypoint", "velocity", "pose", "reward_components", "contact", "goal_reached")
_EDGES = np.cumsum([0, *(SPACES[key].size for key in _GATHERED)]).tolist()
_COLUMNS = {key: slice(*edges) for key, edges in zip(_GATHERED, pairwise(_EDGES), strict=True)}
# A tanh or a clamp in float32 stays within 1; this forgives rounding in other arithmetic.
_ACTION_TOLERANCE = 1e-6


class AgentGroup(OfOneProcess):
    """The agents that one environment holds, each in its own simulation and with its own episode counter.

    It can be neither copied nor pickled: its simulations live in PyBullet.

    Args:
        map_settings: what maps are made from, the generator's settings or those of files.
        task: rules of the task.
        sensor: one of :data:`rcdsac_trl.robot.range_sensor.SENSORS`.
        split: which of the disjoint map sets.
        seed: root seed, at least 0.
        agent_ids: the agents' global numbers, at least 0; agents with equal numbers meet the same episodes.
        first_episode: number of each agent's first episode, at least 0.
        gui: show PyBullet's window for the first agent.
        memory_s: for how long an agent is told of points that it saw, s; 0: not at all.
        robot: which one every agent is.
        collision_weight: factor of the collision reward in steps that name none.

    Attributes:
        buffers: what the agents wrote last, overwritten by every reset and step.
        observations: keys of it that a policy may see.

    Raises:
        UserInputError: a value is outside its limits.
    """

    def __init__(
        self,
        map_settings: MapSource | None,
        task: TaskSettings | None,
        *,
        sensor: str,
        split: Split,
        seed: int,
        agent_ids: Sequence[int],
        first_episode: int,
        gui: bool,
        memory_s: float = 0.0,
        robot: RobotSettings = PAPER,
        collision_weight: float = 1.0,
    ) -> None:
        if split not in SPLITS:
            raise UserInputError(f"split={split!r} does not exist; choose one of {', '.join(SPLITS)}")
        if not agent_ids or not all(isinstance(number, int | np.integer) and number >= 0 for number in agent_ids):
            raise UserInputError(f"agent_ids={list(agent_ids)} must be one or more whole numbers of at least 0")
        self.task = task or TaskSettings()
        mask = robot.sensor_mask(sensor)
        # As the files are now: what is read of them is kept, and another environment may find others.
        maps = with_digests(map_settings or MapSettings())
        self._agents = [
            NavigationAgent(
                maps,
                self.task,
                mask,
                split,
                agent_id,
                memory_s=memory_s,
                gui=gui and row == 0,  # PyBullet opens one window a process
                robot=robot,
            )
            for row, agent_id in enumerate(agent_ids)
        ]
        if not 0.0 <= collision_weight < math.inf:
            raise UserInputError(f"collision_weight={collision_weight} must be a number of at least 0: 1 is the task's")
        self._collision_weight = collision_weight
        self._mask = mask
        self._max_range_m = robot.lidar.max_range_m
        self._first_episode = _not_negative("first_episode", first_episode)
        self.observations = agent_observations(memory_s)
        self.buffers = Buffers.zeros(len(agent_ids), memory_s)
        self.set_seed(seed)

    def __len__(self) -> int:
        """Return the number of agents."""
        return len(self._agents)

    @property
    def seed(self) -> int:
        """The root seed."""
        return self._seed

    def episode(self, row: int) -> int:
        """Return the number of the episode that an agent has begun last."""
        return self._next_episodes[row] - 1

    def set_seed(self, seed: int) -> None:
        """Set the root seed; the next reset of each agent begins its first episode."""
        self._seed = _not_negative("seed", seed)
        self._next_episodes = [self._first_episode] * len(self)

    def reset(self, rows: Iterable[int], episode: int | None = None) -> None:
        """Begin an episode of some agents: their next one, or the given one, from which they count on.

        Args:
            rows: which agents, in any order; one that is named twice begins one episode.
            episode: its number; None: each agent's next one.
        """
        begun = sorted(set(rows))  # all of them are then written as the buffers lie
        for row in begun:
            number = self._next_episodes[row] if episode is None else _not_negative("episode", episode)
            self._agents[row].reset(self._seed, number)
            self._next_episodes[row] = number + 1
        self.buffers.reward[begun] = 0.0
        self._collect(begun)

    def step(self, actions: NDArray, collision_weights: NDArray | None = None) -> None:
        """Take one agent step with every agent.

        Args:
            actions: normalised actions, [n, 2], in [-1, 1].
            collision_weights: factor of each agent's collision reward, [n], None for that of the group; the components
                are written without it.

        Raises:
            UserInputError: an action is not a number in [-1, 1], or an agent was never reset.
        """
        buffers = self.buffers
        for agent, action in zip(self._agents, self._checked(actions), strict=True):
            agent.step(action)
        self._collect(range(len(self)))
        weights = self._collision_weight if collision_weights is None else collision_weights
        buffers.reward[:, 0] = rules.total_reward(buffers.reward_components, weights)

    def scene(self, row: int) -> Scene:
        """Return what a picture of one agent shows."""
        return self._agents[row].scene()

    def simulation(self, row: int) -> Simulation:
        """Return the physics of one agent, to read from; a reset keeps it."""
        return self._agents[row].simulation

    def close(self) -> None:
        """Disconnect all simulations."""
        for agent in self._agents:
            agent.close()

    def _checked(self, actions: NDArray) -> list[list[float]]:
        values: list[list[float]] = actions.tolist()
        if actions.dtype.kind not in "fiu":
            raise UserInputError(f"actions {values} are not numbers but {actions.dtype}: give floats in [-1, 1]")
        limit = 1.0 + _ACTION_TOLERANCE
        # The comparison is false for NaN too. As plain numbers: there are few, and NumPy has a price a call.
        inside = actions.shape == (len(self), ACTION_SIZE) and all(
            -limit <= linear <= limit and -limit <= angular <= limit for linear, angular in values
        )
        if not inside:
            raise UserInputError(
                f"actions {values} must be {ACTION_SIZE} numbers in [-1, 1] for each of "
                f"{len(self)} agents; look for NaN in the policy, or scale its output"
            )
        return values

    def _collect(self, rows: Sequence[int]) -> None:
        """Write what some agents found: one array operation a key for all of them, not one for each."""
        if not rows:
            return
        buffers, agents = self.buffers, [self._agents[row] for row in rows]
        at = slice(None) if len(rows) == len(self) else rows
        distances = np.array([agent.distances_m for agent in agents])
        buffers.range[at] = range_observation(distances, self._mask, self._max_range_m)
        if buffers.remembered is not None:
            buffers.remembered[at] = [agent.remembered for agent in agents]
        numbers = np.array(
            [
                (
                    *waypoint_observation(agent.believed_pose, *agent.next_waypoints),
                    *agent.velocities,
                    *agent.pose,
                    *agent.reward_components,
                    agent.in_contact,
                    agent.goal_reached,
                )
                for agent in agents
            ],
            dtype=np.float32,
        )
        limits = SPACES["velocity"]
        for key, columns in _COLUMNS.items():
            getattr(buffers, key)[at] = numbers[:, columns]
        # Two plain calls cost a fraction of np.clip.
        np.minimum(np.maximum(buffers.velocity, limits.low), limits.high, out=buffers.velocity)


def _not_negative(name: str, value: int) -> int:
    if not isinstance(value, int | np.integer) or value < 0:
        raise UserInputError(f"{name}={value!r} must be a whole number of at least 0")
    return int(value)
