"""The navigation task for Gymnasium, registered as ``RCDSACNavigation-v0`` when this module is imported."""

from typing import Any

import gymnasium
import numpy as np

from rcdsac_trl.errors import UserInputError
from rcdsac_trl.world.maps.generator import MapSettings, Split
from rcdsac_trl.world.render import Renderer
from rcdsac_trl.world.task.agent_group import AgentGroup
from rcdsac_trl.world.task.rules import TaskSettings
from rcdsac_trl.world.task.spaces import ACTION_SIZE, AGENT_OBSERVATIONS, SPACES

ENV_ID = "RCDSACNavigation-v0"
FRAMES_PER_S = 7  # a control period is 0.14 s on average


class NavigationGymEnv(gymnasium.Env[dict[str, np.ndarray], np.ndarray]):
    """One agent of :class:`~rcdsac_trl.world.task.env.NavigationEnv`, with the same episodes and numbers.

    Observations: a dict of ``range`` [180], ``waypoint`` [6] and ``velocity`` [4], float32.

    Info: ``pose`` [3] (x, y in m, yaw in rad), ``contact``, ``goal_reached`` and ``reward_components`` [5].

    Finish condition: ``truncated`` after ``task.episode_steps`` steps; never ``terminated``.

    ``reset(seed=s)`` sets the root seed and begins at the first episode; ``reset()`` begins the next one, and
    ``reset(options={"episode": k})`` that one.

    Args:
        map_settings: how maps are generated.
        task: rules of the task.
        sensor: ``"narrow"``, ``"sparse"`` or ``"full"``.
        split: which of the disjoint map sets.
        seed: root seed until a reset brings another.
        agent_id: the agent's global number.
        first_episode: number of the first episode.
        gui: show PyBullet's window.
        render_mode: ``"rgb_array"`` or None.

    Example:
        >>> env = gymnasium.make("rcdsac_trl.world.task.gymnasium_env:RCDSACNavigation-v0", sensor="full")
        >>> observation, info = env.reset(seed=0)
        >>> observation["range"].shape
        (180,)
    """

    metadata = {"render_modes": ["rgb_array"], "render_fps": FRAMES_PER_S}  # noqa: RUF012 (as Gymnasium has it)

    def __init__(
        self,
        map_settings: MapSettings | None = None,
        task: TaskSettings | None = None,
        *,
        sensor: str = "narrow",
        split: Split = "train",
        seed: int = 0,
        agent_id: int = 0,
        first_episode: int = 0,
        gui: bool = False,
        render_mode: str | None = None,
    ) -> None:
        if render_mode not in (None, *self.metadata["render_modes"]):
            raise UserInputError(f"render_mode={render_mode!r} does not exist; use 'rgb_array' or None")
        self.observation_space = gymnasium.spaces.Dict(  # type: ignore[assignment]
            {key: _box(key) for key in AGENT_OBSERVATIONS}
        )
        self.action_space = gymnasium.spaces.Box(-1.0, 1.0, (ACTION_SIZE,), np.float32)
        self.render_mode = render_mode
        self._agents = AgentGroup(
            map_settings,
            task,
            sensor=sensor,
            split=split,
            seed=seed,
            agent_ids=(agent_id,),
            first_episode=first_episode,
            gui=gui,
        )
        self._steps = 0
        self._renderer = Renderer() if render_mode == "rgb_array" else None

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[dict[str, np.ndarray], dict[str, Any]]:
        """Begin an episode; see the class for ``seed`` and ``options``."""
        super().reset(seed=seed)
        if seed is not None:
            self._agents.set_seed(seed)
        self._agents.reset((0,), (options or {}).get("episode"))
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

    def _observation(self) -> dict[str, np.ndarray]:
        return {key: getattr(self._agents.buffers, key)[0].copy() for key in AGENT_OBSERVATIONS}

    def _info(self) -> dict[str, Any]:
        buffers = self._agents.buffers
        return {
            "pose": buffers.pose[0].copy(),
            "contact": bool(buffers.contact[0, 0]),
            "goal_reached": bool(buffers.goal_reached[0, 0]),
            "reward_components": buffers.reward_components[0].copy(),
        }


def _box(key: str) -> gymnasium.spaces.Box:
    space = SPACES[key]
    return gymnasium.spaces.Box(space.low, space.high, dtype=np.float32)


def register() -> None:
    """Register :data:`ENV_ID` with Gymnasium; harmless when done before."""
    if ENV_ID not in gymnasium.registry:
        gymnasium.register(ENV_ID, entry_point=f"{__name__}:NavigationGymEnv")


register()
