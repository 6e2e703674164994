"""WorkerGroup: agents that drive whole episodes side by side on one map.

TorchRL's collector, its transforms and the tensordicts of every step cost a few agents more than driving them does. A
worker therefore steps the environment's own arrays, and writes what is asked for into arrays of the whole episode. The
numbers are, bit by bit, those of the environment with its transforms.
"""

from collections.abc import Callable, Mapping, Sequence
from typing import NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from tensordict import TensorDict
from tensordict.nn import TensorDictModuleBase

from rcdsac_trl.agent.actor import STATE_KEY
from rcdsac_trl.agent.transforms import EpisodeSampler
from rcdsac_trl.system.interrupts import interruption_point
from rcdsac_trl.world.task.env import COLLISION_WEIGHT, NavigationEnv
from rcdsac_trl.world.task.spaces import ACTION_SIZE


class EpisodeBatch(NamedTuple):
    """Whole episodes of N agents, T steps each; plain arrays, so that they go from process to process.

    Attributes:
        observed: what is known before and after each step, ``[N, T + 1, ..]``.
        done: what was done in each step and what came of it, ``[N, T, ..]``.
        context: what holds for the whole episode, ``[N, 1]``.
    """

    observed: dict[str, NDArray]
    done: dict[str, NDArray]
    context: dict[str, NDArray]

    def tensordict(self) -> TensorDict:
        """Return the episodes as a collector does, ``[N, T]``; nothing is copied."""
        action = torch.from_numpy(self.done["action"])
        number, steps = action.shape[:2]
        observed = {key: torch.from_numpy(value) for key, value in self.observed.items()}
        after = {key: value[:, 1:] for key, value in observed.items()}
        after |= {key: torch.from_numpy(value) for key, value in self.done.items() if key != "action"}
        before = {key: value[:, :-1] for key, value in observed.items()}
        context = {
            key: torch.from_numpy(value).unsqueeze(1).expand(-1, steps, -1) for key, value in self.context.items()
        }
        return TensorDict({**before, **context, "action": action, "next": after}, batch_size=[number, steps])


def side_by_side(parts: Sequence[EpisodeBatch]) -> EpisodeBatch:
    """Put the agents of several workers together, in their order."""
    groups = zip(*parts, strict=True)
    return EpisodeBatch(*({key: np.concatenate([part[key] for part in group]) for key in group[0]} for group in groups))


class RolloutWorker:
    """The agents of one :class:`NavigationEnv`, without a transform or a new tensordict at any step.

    Args:
        env: holds the agents.
        sampler: what the agents are told; None: nothing.
        state_size: size of the policy's recurrent state.
        steps: length of an episode.
    """

    def __init__(self, env: NavigationEnv, sampler: EpisodeSampler | None, *, state_size: int, steps: int) -> None:
        self.env = env
        self.sampler = sampler
        self.state_size = state_size
        self.steps = steps

    def rollout(
        self,
        policy: TensorDictModuleBase,
        episode: int,
        *,
        observed: Sequence[str],
        happened: Sequence[str],
        before_step: Callable[[], None] = interruption_point,
        ended: Callable[[Mapping[str, NDArray]], bool] | None = None,
    ) -> EpisodeBatch:
        """Drive one episode with every agent.

        Args:
            policy: writes `action`, and the next recurrent state if it has one.
            episode: number of the episode and its map.
            observed: keys to return of the observations.
            happened: keys to return of what the steps led to.
            before_step: called before each step.
            ended: given what the agents wrote after each step; returns whether all episodes may end now. None: they
                take their full length.
        """
        agents, number = self.env.agents, len(self.env.agents)
        agents.reset(range(number), episode)
        written = dict(agents.buffers.items())
        context = {} if self.sampler is None else {self.sampler.key: self.sampler.told(episode)}
        weights = context[COLLISION_WEIGHT].view(-1).numpy() if COLLISION_WEIGHT in context else None
        # Made once: the agents write into the same arrays at every step.
        now = TensorDict({key: torch.from_numpy(written[key]) for key in agents.observations} | context, [number])
        now["is_init"] = torch.ones(number, 1, dtype=torch.bool, device="cpu")
        now[STATE_KEY] = torch.zeros(number, self.state_size, dtype=torch.float32, device="cpu")
        seen = {key: _empty_rows(written[key], self.steps + 1) for key in observed}
        done = {key: _empty_rows(written[key], self.steps) for key in happened}
        done["action"] = np.empty((number, self.steps, ACTION_SIZE), np.float32)
        _note(seen, written, 0)
        for step in range(self.steps):
            before_step()
            policy(now)
            action = now["action"].numpy()
            agents.step(action, weights)
            _note(done, written | {"action": action}, step)
            _note(seen, written, step + 1)
            if (state := now.get(("next", STATE_KEY), None)) is not None:
                now[STATE_KEY] = state
            now["is_init"].fill_(False)
            if ended is not None and ended(written):
                seen = {key: value[:, : step + 2] for key, value in seen.items()}
                done = {key: value[:, : step + 1] for key, value in done.items()}
                break
        return EpisodeBatch(seen, done, {key: value.numpy() for key, value in context.items()})

    def close(self) -> None:
        """Disconnect all simulations."""
        self.env.close(raise_if_closed=False)


def _empty_rows(array: NDArray, times: int) -> NDArray:
    """Return an array for an agent's rows at some times, ``[N, times, ..]``."""
    return np.empty((len(array), times, *array.shape[1:]), array.dtype)


def _note(into: dict[str, NDArray], arrays: dict[str, NDArray], time: int) -> None:
    for key, kept in into.items():
        kept[:, time] = arrays[key]
