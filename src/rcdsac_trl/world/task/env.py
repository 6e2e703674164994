"""The navigation task as a TorchRL environment, in one process or over several workers."""

import multiprocessing
import signal
from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np
import torch
from tensordict import TensorDict, TensorDictBase
from torchrl.data import Binary, Bounded, Composite, TensorSpec, Unbounded
from torchrl.envs import EnvBase, ParallelEnv, SerialEnv

from rcdsac_trl.errors import UserInputError
from rcdsac_trl.system.processes import START_METHOD, check_may_start_processes, resolve_num_workers
from rcdsac_trl.world.maps.generator import Split
from rcdsac_trl.world.render import Renderer
from rcdsac_trl.world.sim.bullet import OfOneProcess
from rcdsac_trl.world.task.agent_group import AgentGroup
from rcdsac_trl.world.task.spaces import ACTION_SIZE, SPACES, Space
from rcdsac_trl.world.task.world_settings import WorldSettings

COLLISION_WEIGHT = "collision_weight"
# How long workers may take to close.
_SHUTDOWN_S = 5.0


class NavigationEnv(OfOneProcess, EnvBase):
    """Several agents, each in its own simulation of the same map, stepped as one batch.

    Agents neither see nor touch each other. Agent ``i`` spends its episode ``k`` on map ``k`` of the split; a
    reset of an agent begins its next episode. Whatever process holds an agent, and whatever the others do, its
    starts and goals are the same, and the same actions give bit-identical results.

    Observations: ``range`` [180], ``waypoint`` [6], ``velocity`` [4], with ``memory_s`` above 0 ``remembered`` [90],
    and for metrics and drawing only ``pose`` [3] (x, y in m, yaw in rad, map frame), ``contact`` [1],
    ``goal_reached`` [1] and ``reward_components`` [5].

    Reward: the paper's (section Reward), from ``reward_components``.

    Finish condition: none, ``terminated`` is never true; add ``StepCounter(max_steps=task.episode_steps)``.

    It can be neither copied nor pickled: its simulations live in PyBullet. They are freed by :meth:`close`, or with it.

    Args:
        world: what it is made of; None: the defaults.
        split: which of the disjoint map sets.
        seed: root seed of maps, starts, goals, movers and noise.
        agent_ids: global numbers of the n agents held here, batch size [n]; agents with equal numbers meet the
            same starts, goals and movers. None: those from 0 to ``world.num_agents`` - 1.
        first_episode: number of the first episode, also after :meth:`set_seed`.
        weighted_collisions: read ``collision_weight`` [1] from the input and scale the collision reward by
            it; ``reward_components`` stay unscaled. It is an observation too: 1, or what a reset brings.
        collision_weight: scale of the collision reward where none is read.
        changes: fields of :class:`WorldSettings` that differ from `world`.

    Raises:
        UserInputError: for wrong settings, a step before the first reset, and actions outside [-1, 1].

    Example:
        >>> env = NavigationEnv(agent_ids=(0, 1), sensor="sparse")
        >>> env.rollout(3)["next", "reward"].shape
        torch.Size([2, 3, 1])
    """

    def __init__(
        self,
        world: WorldSettings | None = None,
        *,
        split: Split = "train",
        seed: int = 0,
        agent_ids: Sequence[int] | None = None,
        first_episode: int = 0,
        weighted_collisions: bool = False,
        collision_weight: float = 1.0,
        **changes: Any,
    ) -> None:
        if weighted_collisions and collision_weight != 1.0:
            raise UserInputError(
                f"collision_weight={collision_weight:g} is not for weighted_collisions, which bring theirs: drop it"
            )
        world, ids = _with_agents(world, agent_ids, {**changes, "num_workers": 0})
        super().__init__(device=torch.device("cpu"), batch_size=torch.Size([len(ids)]))
        self.agents = AgentGroup(
            world.map_settings,
            world.task,
            sensor=world.sensor,
            memory_s=world.memory_s,
            robot=world.robot,
            split=split,
            seed=seed,
            agent_ids=ids,
            first_episode=first_episode,
            gui=world.gui,
            collision_weight=collision_weight,
        )
        self._weighted = weighted_collisions
        # The arrays that the agents write into, as tensors; what is never true is among them.
        self._written = {key: torch.from_numpy(array) for key, array in self.agents.buffers.items()}
        for key in ("done", "terminated"):
            self._written[key] = torch.zeros(*self.batch_size, 1, dtype=torch.bool, device=self.device)
        self._renderer: Renderer | None = None
        self._make_specs()

    def _make_specs(self) -> None:
        batch = self.batch_size
        specs = {key: _torch_spec(SPACES[key], batch) for key, _ in self.agents.buffers.items()}
        reward = specs.pop("reward")
        if self._weighted:
            specs[COLLISION_WEIGHT] = Unbounded(shape=(*batch, 1), dtype=torch.float32, device=self.device)
            self.state_spec = Composite({COLLISION_WEIGHT: specs[COLLISION_WEIGHT].clone()}, shape=batch)
        self.observation_spec = Composite(specs, shape=batch)
        self.reward_spec = Composite({"reward": reward}, shape=batch)
        self.action_spec = Bounded(-1.0, 1.0, shape=(*batch, ACTION_SIZE), dtype=torch.float32, device=self.device)
        flag = Binary(1, shape=(*batch, 1), dtype=torch.bool, device=self.device)
        done = {key: flag.clone() for key in ("done", "terminated")}
        self.done_spec = Composite(done, shape=batch)

    def set_seed(self, seed: int | None = None, static_seed: bool = False) -> int | None:
        """Set the root seed and begin again at the first episode.

        The returned seed is the given one, not another as usual: ``ParallelEnv`` hands it on to the next
        worker, and agents differ by their numbers, so all workers of one experiment need the same root seed.
        """
        self._set_seed(seed)
        return seed

    def _set_seed(self, seed: int | None) -> None:
        if seed is not None:
            self.agents.set_seed(seed)

    def _reset(self, tensordict: TensorDictBase | None = None, episode: int | None = None) -> TensorDictBase:
        """Begin an episode of all agents, or of those that ``_reset`` marks.

        Args:
            tensordict: may hold ``_reset`` and, if collisions are weighted, ``collision_weight``.
            episode: the episode's number; each agent's next one if None.
        """
        marked = None if tensordict is None else tensordict.get("_reset", None)
        rows = range(len(self.agents)) if marked is None else marked.view(-1).nonzero().view(-1).tolist()
        self.agents.reset(rows, episode)
        out = self._emit()
        del out["reward"]
        if self._weighted:
            weight = None if tensordict is None else tensordict.get(COLLISION_WEIGHT, None)
            out[COLLISION_WEIGHT] = (
                self._written["reward"].new_ones(*self.batch_size, 1) if weight is None else weight.clone()
            )
        return self._packed(out)

    def _step(self, tensordict: TensorDictBase) -> TensorDictBase:
        weights = tensordict.get(COLLISION_WEIGHT) if self._weighted else None
        self.agents.step(
            tensordict.get("action").detach().numpy(), None if weights is None else weights.view(-1).numpy()
        )
        out = self._emit()
        if weights is not None:
            out[COLLISION_WEIGHT] = weights.clone()
        return self._packed(out)

    def _step_proc_data(self, next_tensordict_out: TensorDictBase) -> TensorDictBase:
        """Return what a step wrote: it has the shapes and types of the specs, which TorchRL would look up again."""
        return next_tensordict_out

    @classmethod
    def _complete_done(cls, done_spec: Composite, data: TensorDictBase) -> TensorDictBase:
        """Return what a step or reset wrote: ``done`` and ``terminated`` are never missing."""
        return data

    def _packed(self, out: dict[str, torch.Tensor]) -> TensorDictBase:
        """Make a tensordict of what has the shapes of the specs: unsafe is what would check that again."""
        return TensorDict._new_unsafe(out, batch_size=self.batch_size, device=self.device)

    def _emit(self) -> dict[str, torch.Tensor]:
        """Copy what the agents wrote: they write into the same arrays again next time."""
        return {key: tensor.clone() for key, tensor in self._written.items()}

    def render(self, row: int = 0, caption: str = "") -> np.ndarray:
        """Draw one of the agents from above.

        Args:
            row: which agent of this environment.
            caption: a line of text in the picture.

        Returns:
            uint8 RGB frame, [height, width, 3].
        """
        if self._renderer is None:
            self._renderer = Renderer()
        return self._renderer.draw(self.agents.scene(row), caption)

    def close(self, *, raise_if_closed: bool = True) -> None:
        """Disconnect all simulations."""
        self.agents.close()
        super().close(raise_if_closed=raise_if_closed)


def _torch_spec(space: Space, batch: torch.Size) -> TensorSpec:
    shape = torch.Size([*batch, space.size])
    if space.dtype is np.bool_:
        return Binary(space.size, shape=shape, dtype=torch.bool, device="cpu")
    if not space.bounded:
        return Unbounded(shape=shape, dtype=torch.float32, device="cpu")
    low, high = (torch.from_numpy(limit).expand(shape).clone() for limit in (space.low, space.high))
    return Bounded(low, high, shape=shape, dtype=torch.float32, device="cpu")


def make_env(
    world: WorldSettings | None = None,
    *,
    split: Split = "train",
    seed: int = 0,
    agent_ids: Sequence[int] | None = None,
    first_episode: int = 0,
    weighted_collisions: bool = False,
    collision_weight: float = 1.0,
    serial: bool = False,
    **changes: Any,
) -> EnvBase:
    """Make the environment of some agents, spread over worker processes.

    Args:
        world: what it is made of; its `num_workers` 0 makes one :class:`NavigationEnv` of batch [n] in this process,
            W >= 1 a ``ParallelEnv`` of W processes with n / W agents each, batch [W, n / W]. None: the defaults.
        split: as for :class:`NavigationEnv`, like all that is not listed here.
        seed: root seed.
        agent_ids: global numbers of the n agents, in the order of the flattened batch.
        first_episode: number of the first episode.
        weighted_collisions: whether the environment reads ``collision_weight``.
        collision_weight: scale of the collision reward where it does not.
        serial: put the W environments into a ``SerialEnv`` in this process instead (for tests and debugging).
        changes: fields of :class:`WorldSettings` that differ from `world`.

    Raises:
        UserInputError: the workers cannot share the agents evenly, or as :class:`NavigationEnv`.

    With workers it is TorchRL's own ``ParallelEnv``: where a worker process dies or gives no answer in time, it raises
    ``RuntimeError`` and can then only be closed; and when it is closed, it lets torch use up to a thread a worker more.

    Example:
        >>> make_env(sensor="sparse", num_workers=0).batch_size
        torch.Size([10])
    """
    world, ids = _with_agents(world, agent_ids, changes)
    workers = resolve_num_workers(world.num_workers, len(ids))
    shared: dict[str, Any] = {
        "split": split,
        "seed": seed,
        "first_episode": first_episode,
        "weighted_collisions": weighted_collisions,
        "collision_weight": collision_weight,
    }
    if workers == 0:
        return NavigationEnv(world, agent_ids=ids, **shared)
    share = len(ids) // workers
    kwargs = [
        {
            "world": replace(world, num_agents=share, num_workers=0, gui=world.gui and worker == 0),
            "agent_ids": ids[worker * share : (worker + 1) * share],
            **shared,
        }
        for worker in range(workers)
    ]
    if serial:
        return SerialEnv(workers, NavigationEnv, create_env_kwargs=kwargs)
    check_may_start_processes()
    multiprocessing.set_forkserver_preload([__name__])
    env = ParallelEnv(
        workers,
        _env_of_a_worker,
        create_env_kwargs=kwargs,
        mp_start_method=START_METHOD,
        daemon=True,
        # Else it takes a thread a worker from this process; here workers rest while the learner computes.
        num_threads=torch.get_num_threads(),
        shutdown_timeout=_SHUTDOWN_S,
    )
    env.start()
    if world.worker_timeout_s is not None:
        env.BATCHED_PIPE_TIMEOUT = world.worker_timeout_s
    return env


def _with_agents(
    world: WorldSettings | None, agent_ids: Sequence[int] | None, changes: dict[str, Any]
) -> tuple[WorldSettings, tuple[int, ...]]:
    """Return settings with changes, and the numbers of their agents."""
    if agent_ids is None:
        world = replace(world or WorldSettings(), **changes)
        return world, tuple(range(world.num_agents))
    if not len(agent_ids):
        raise UserInputError("there are no agent_ids: give at least one.")
    return replace(world or WorldSettings(), **{**changes, "num_agents": len(agent_ids)}), tuple(agent_ids)


def _env_of_a_worker(**named: Any) -> NavigationEnv:
    """Make the environment of a worker process; the main process makes one too, to learn its specs."""
    if multiprocessing.parent_process() is not None:
        # A terminal sends Ctrl-C to all processes; workers that died of it could not be closed properly any more.
        signal.signal(signal.SIGINT, signal.SIG_IGN)
    return NavigationEnv(**named)
