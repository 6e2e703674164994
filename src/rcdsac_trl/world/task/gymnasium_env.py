"""The navigation task for Gymnasium; ``gymnasium.make("RCDSACNavigation-v0")`` makes one."""

from collections.abc import Mapping
from dataclasses import replace
from typing import Any

import gymnasium
import numpy as np

from rcdsac_trl.errors import UserInputError
from rcdsac_trl.robot.limits import MEAN_PERIOD_S
from rcdsac_trl.world.maps.generator import Split
from rcdsac_trl.world.render import Renderer
from rcdsac_trl.world.sim.bullet import OfOneProcess
from rcdsac_trl.world.task.agent_group import AgentGroup
from rcdsac_trl.world.task.spaces import ACTION_SIZE, SPACES
from rcdsac_trl.world.task.world_settings import WorldSettings


class NavigationGymEnv(OfOneProcess, gymnasium.Env[dict[str, np.ndarray], np.ndarray]):
    """One agent of :class:`~rcdsac_trl.world.task.env.NavigationEnv`, with the same episodes and numbers.

    Observations: a dict of ``range`` [180], ``waypoint`` [6], ``velocity`` [4] and, with ``memory_s`` above 0,
    ``remembered`` [90], float32.

    Info: ``pose`` [3] (x, y in m, yaw in rad), ``contact``, ``goal_reached``, ``reward_components`` [5], and the
    ``seed`` and ``episode`` that map, start, goals and movers derive from.

    Finish condition: ``truncated`` after ``task.episode_steps`` steps; never ``terminated``.

    ``reset(seed=s)`` sets the root seed and begins at the first episode; ``reset()`` begins the next one, and
    ``reset(options={"episode": k})`` that one. Where no seed was ever given, the first reset draws one.

    It can be neither copied nor pickled: its simulation lives in PyBullet. It is freed by :meth:`close`, or with it.

    Args:
        world: what it is made of; None: the defaults. Of its agents there is one.
        split: which of the disjoint map sets.
        seed: root seed until a reset brings another; None: the first reset draws one.
        agent_id: the agent's global number.
        first_episode: number of the first episode.
        render_mode: ``"rgb_array"`` or None.
        changes: fields of :class:`~rcdsac_trl.world.task.world_settings.WorldSettings` that differ from `world`.

    Example:
        >>> env = gymnasium.make("rcdsac_trl:RCDSACNavigation-v0", sensor="full")
        >>> observation, info = env.reset(seed=0)
        >>> observation["range"].shape
        (180,)
    """

    metadata = {  # noqa: RUF012 (as Gymnasium has it)
        "render_modes": ["rgb_array"],
        "render_fps": round(1.0 / MEAN_PERIOD_S),
    }

    def __init__(
        self,
        world: WorldSettings | None = None,
        *,
        split: Split = "train",
        seed: int | None = None,
        agent_id: int = 0,
        first_episode: int = 0,
        render_mode: str | None = None,
        **changes: Any,
    ) -> None:
        if render_mode not in (None, *self.metadata["render_modes"]):
            raise UserInputError(f"render_mode={render_mode!r} does not exist; use 'rgb_array' or None")
        world = replace(world or WorldSettings(), **changes)
        self._agents = AgentGroup(
            world.map_settings,
            world.task,
            sensor=world.sensor,
            memory_s=world.memory_s,
            robot=world.robot,
            split=split,
            seed=0 if seed is None else seed,
            agent_ids=(agent_id,),
            first_episode=first_episode,
            gui=world.gui,
        )
        self.observation_space = gymnasium.spaces.Dict(  # type: ignore[assignment]
            {key: _box(key) for key in self._agents.observations}
        )
        self.action_space = gymnasium.spaces.Box(-1.0, 1.0, (ACTION_SIZE,), np.float32)
        self.render_mode = render_mode
        self._seed = seed
        self._has_begun = False
        self._steps = 0
        self._renderer = Renderer() if render_mode == "rgb_array" else None

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[dict[str, np.ndarray], dict[str, Any]]:
        """Begin an episode; see the class for ``seed`` and ``options``."""
        if not isinstance(options, Mapping | None):
            raise UserInputError(f"options={options!r} are no dictionary: give {{'episode': <number>}}")
        if strange := next((key for key in options or () if key != "episode"), None):
            raise UserInputError(f"a reset has no option {strange!r}: give {{'episode': <number>}}, or none")
        root = seed
        if root is None and not self._has_begun:
            root = self._drawn_seed() if self._seed is None else self._seed
        # Without a seed, a generator that is there already stays as it is.
        super().reset(seed=root if self._np_random is None else seed)
        if root is not None:
            self._agents.set_seed(root)
        self._has_begun = True
        self._agents.reset((0,), options.get("episode") if options else None)
        self._steps = 0
        return self._observation(), self._info()

    def step(self, action: np.ndarray) -> tuple[dict[str, np.ndarray], float, bool, bool, dict[str, Any]]:
        """Take one agent step."""
        self._agents.step(np.asarray(action)[None])
        self._steps += 1
        truncated = self._steps >= self._agents.task.episode_steps
        reward = float(self._agents.buffers.reward[0, 0])
        return self._observation(), reward, False, truncated, self._info()

    def render(self) -> np.ndarray | None:
        """Return a uint8 RGB frame [height, width, 3] in the render mode ``"rgb_array"``, else None."""
        return None if self._renderer is None else self._renderer.draw(self._agents.scene(0))

    def close(self) -> None:
        """Disconnect the simulation."""
        self._agents.close()

    def _drawn_seed(self) -> int:
        """Draw a seed of 31 bits, from the generator that a user may have brought, else from entropy."""
        if self._np_random is not None:
            return int(self._np_random.integers(2**31))
        return int(np.random.SeedSequence().generate_state(1)[0]) >> 1

    def _observation(self) -> dict[str, np.ndarray]:
        return {key: getattr(self._agents.buffers, key)[0].copy() for key in self._agents.observations}

    def _info(self) -> dict[str, Any]:
        buffers = self._agents.buffers
        return {
            "pose": buffers.pose[0].copy(),
            "contact": bool(buffers.contact[0, 0]),
            "goal_reached": bool(buffers.goal_reached[0, 0]),
            "reward_components": buffers.reward_components[0].copy(),
            "seed": self._agents.seed,
            "episode": self._agents.episode(0),
        }


def _box(key: str) -> gymnasium.spaces.Box:
    space = SPACES[key]
    return gymnasium.spaces.Box(space.low, space.high, dtype=np.float32)
