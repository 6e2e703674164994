"""What happens to data: where beta comes from, in an episode and in a batch, and left and right of a batch."""

from collections.abc import Callable, Sequence
from typing import Literal

import torch
from tensordict import TensorDictBase
from torch import Tensor
from torchrl.data import Composite, Unbounded
from torchrl.envs.transforms import Transform

from rcdsac_trl.agent.risk import RiskMeasure
from rcdsac_trl.robot.mirror import MIRRORED, mirrored_bins
from rcdsac_trl.seeding import stream


class EpisodeSampler(Transform):
    """Tells each agent one number for a whole episode: its beta, or its collision weight.

    The number of agent i in episode k derives from (seed, key, k, i) alone, so that neither the number of workers
    nor what other agents do changes it. Every reset of an agent begins its next episode. A value that the reset
    itself brings under `key` is taken instead of a draw.

    Args:
        key: where the number is written, ``[*batch, 1]``.
        draw: turns a uniform number in [0, 1) into the number told.
        seed: root seed.
        agent_ids: global numbers of the agents, in the order of the flattened batch.
        first_episode: number of the first episode.
        fixed: one number for each agent, told in every episode instead of a draw.

    Example:
        >>> from torchrl.envs import TransformedEnv
        >>> from rcdsac_trl.world.task.env import make_env
        >>> sampler = EpisodeSampler("risk", lambda u: -2.0 * u, seed=0, agent_ids=range(2))
        >>> TransformedEnv(make_env(num_workers=0, agent_ids=range(2)), sampler).reset()["risk"].shape
        torch.Size([2, 1])
    """

    def __init__(
        self,
        key: str,
        draw: Callable[[float], float],
        *,
        seed: int,
        agent_ids: Sequence[int],
        first_episode: int = 0,
        fixed: Sequence[float] | None = None,
    ) -> None:
        super().__init__(in_keys=[], out_keys=[key])
        if fixed is not None and len(fixed) != len(agent_ids):
            raise ValueError(f"{len(fixed)} fixed values for {len(agent_ids)} agents: give one for each")
        self.key = key
        self.draw = draw
        self.seed = seed
        self.agent_ids = tuple(agent_ids)
        self.fixed = fixed
        self._next_episodes = [first_episode] * len(self.agent_ids)
        self._told = torch.zeros(len(self.agent_ids), 1, dtype=torch.float32, device="cpu")

    def told(self, episode: int) -> Tensor:
        """Return what all agents are told in an episode, ``[N, 1]``."""
        numbers = [[self._of(row, episode)] for row in range(len(self.agent_ids))]
        return torch.tensor(numbers, dtype=torch.float32, device="cpu")

    def _of(self, row: int, episode: int) -> float:
        if self.fixed is not None:
            return self.fixed[row]
        return self.draw(stream(self.seed, self.key, episode, self.agent_ids[row]).random())

    def _reset(self, tensordict: TensorDictBase | None, tensordict_reset: TensorDictBase) -> TensorDictBase:
        marked = None if tensordict is None else tensordict.get("_reset", None)
        brought = None if tensordict is None else tensordict.get(self.key, None)
        rows = range(len(self.agent_ids)) if marked is None else marked.flatten().nonzero().flatten().tolist()
        for row in rows:
            episode = self._next_episodes[row]
            self._next_episodes[row] += 1
            self._told[row] = self._of(row, episode) if brought is None else brought.reshape(-1)[row]
        return tensordict_reset.set(self.key, self._told.clone().view(*tensordict_reset.batch_size, 1))

    def _step(self, tensordict: TensorDictBase, next_tensordict: TensorDictBase) -> TensorDictBase:
        return next_tensordict.set(self.key, tensordict.get(self.key))

    def transform_observation_spec(self, observation_spec: Composite) -> Composite:
        """Add the key to the observations."""
        observation_spec[self.key] = Unbounded(
            (*observation_spec.shape, 1), device=observation_spec.device, dtype=torch.float32
        )
        return observation_spec

    def transform_input_spec(self, input_spec: Composite) -> Composite:
        """Add the key to the state: a reset shows transforms nothing else of what it was given."""
        if input_spec["full_state_spec"] is None:
            input_spec["full_state_spec"] = Composite(shape=input_spec.shape, device=input_spec.device)
        self.transform_observation_spec(input_spec["full_state_spec"])
        return input_spec


class Relabel:
    """Sets the `risk` of a batch of sequences: the paper's *resample* and *stored*, or one beta for all.

    Args:
        measure: draws beta.
        mode: ``"resample"`` draws a fresh beta; ``"stored"`` keeps the one in the batch; ``"fixed"`` sets `beta`.
        per: draw once for each ``"transition"`` or each ``"sequence"`` (resample only).
        beta: the value of ``"fixed"``.
        generator: source of the draws, which are brought to the batch's device (resample only).

    Example:
        >>> from tensordict import TensorDict
        >>> from rcdsac_trl.agent.risk import PowerLaw
        >>> relabel = Relabel(PowerLaw(), mode="resample", generator=torch.Generator().manual_seed(0))
        >>> relabel(TensorDict(batch_size=[3, 9]))["risk"].shape
        torch.Size([3, 9, 1])
    """

    def __init__(
        self,
        measure: RiskMeasure,
        *,
        mode: Literal["resample", "stored", "fixed"],
        per: Literal["transition", "sequence"] = "transition",
        beta: float | None = None,
        generator: torch.Generator | None = None,
    ) -> None:
        if mode == "fixed" and beta is None:
            raise ValueError("mode='fixed' needs a beta")
        if mode == "resample" and generator is None:
            raise ValueError("mode='resample' needs a generator")
        self.measure = measure
        self.mode = mode
        self.per = per
        self.beta = beta
        self.generator = generator

    def __call__(self, batch: TensorDictBase) -> TensorDictBase:
        """Set `risk` ``[B, L + 1, 1]``."""
        sequences, slots = batch.shape
        if self.mode == "fixed" and self.beta is not None:
            one = torch.full((1, 1, 1), self.beta, device=batch.device, dtype=torch.float32)
            return batch.set("risk", one.expand(sequences, slots, 1))
        if self.mode == "resample" and self.generator is not None:
            drawn = self.measure.sample((sequences, slots if self.per == "transition" else 1, 1), self.generator)
            return batch.set("risk", drawn.to(batch.device or drawn.device).expand(sequences, slots, 1))
        return batch


class Mirror:
    """Exchanges left and right in half of a batch's sequences, which are as random as all of them.

    Args:
        sensed: bins that the sensor has, bool ``[180]``.
        device: of the batches.

    Example:
        >>> from tensordict import TensorDict
        >>> mirror = Mirror(torch.ones(180, dtype=torch.bool))
        >>> batch = TensorDict({"range": torch.zeros(2, 9, 180), "action": torch.ones(2, 9, 2)}, batch_size=[2, 9])
        >>> mirror(batch)["action"][:, 0].tolist()
        [[1.0, -1.0], [1.0, 1.0]]
    """

    def __init__(self, sensed: Tensor, device: torch.device | str = "cpu") -> None:
        self._bins = torch.from_numpy(mirrored_bins(sensed.numpy())).to(device)
        self._others = {
            key: (torch.from_numpy(order).to(device), torch.from_numpy(sign).to(device))
            for key, (order, sign) in MIRRORED.items()
        }

    def __call__(self, batch: TensorDictBase) -> TensorDictBase:
        """Mirror the first half of the sequences ``[B, L + 1]`` in place."""
        half = batch.shape[0] // 2
        seen = batch["range"][:half]
        seen.copy_(seen[..., self._bins])
        for key, (order, sign) in self._others.items():
            if key in batch.keys():  # noqa: SIM118 (a TensorDict iterates over its rows)
                value = batch[key][:half]
                value.copy_(value[..., order] * sign)
        return batch
