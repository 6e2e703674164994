"""Replay of sequences: whole episodes in, sequences inside one episode out.

Every observation is stored once. An episode of T transitions takes T + 1 slots of a flat
:class:`torchrl.data.TensorDictReplayBuffer`; slot t + 1 holds the next observation of slot t, and the last slot's
action and reward are padding that no sequence uses.
"""

from collections.abc import Iterable, Mapping
from typing import Any

import torch
from tensordict import TensorDict, TensorDictBase
from torch import Tensor
from torchrl.data import LazyTensorStorage, TensorDictReplayBuffer
from torchrl.data.replay_buffers.samplers import Sampler
from torchrl.data.replay_buffers.storages import Storage

from rcdsac_trl.errors import UserInputError
from rcdsac_trl.robot.observation import VECTOR_OBSERVATIONS
from rcdsac_trl.seeding import torch_stream
from rcdsac_trl.world.task.rules import REWARD_COMPONENTS, total_reward
from rcdsac_trl.world.task.spaces import ACTION_SIZE

# What o_rng can be where it is not 0: 2.5 + log10(d) for d in (0.01, 3) m.
RANGE_LOW = 0.5
RANGE_HIGH = 2.978
_LEVELS = 65534
_OFFSET = 32768


class RangeCodec:
    """Packs `range` observations: only the sensor's bins, 16 bits each, 0 kept exactly.

    The code is linear in o_rng, which is logarithmic in distance, so the rounding is the same 0.005 % of the
    distance everywhere.

    Args:
        mask: bool ``[180]``, the bins the sensor keeps.
    """

    def __init__(self, mask: Tensor) -> None:
        self.bins = mask.nonzero().squeeze(-1)
        self.num_bins = mask.numel()

    def encode(self, ranges: Tensor) -> Tensor:
        """Turn ``[..., 180]`` float32 into ``[..., kept]`` int16 (torch cannot index uint16)."""
        kept = ranges[..., self.bins]
        level = (kept.clamp(RANGE_LOW, RANGE_HIGH) - RANGE_LOW) * (_LEVELS / (RANGE_HIGH - RANGE_LOW))
        return (torch.where(kept == 0, 0, level.round().to(torch.int32) + 1) - _OFFSET).to(torch.int16)

    def decode(self, codes: Tensor) -> Tensor:
        """Turn ``[..., kept]`` int16 into ``[..., 180]`` float32."""
        level = codes.to(torch.float32) + _OFFSET
        kept = torch.where(level == 0, 0.0, RANGE_LOW + (level - 1) * ((RANGE_HIGH - RANGE_LOW) / _LEVELS))
        ranges = torch.zeros(*codes.shape[:-1], self.num_bins, device=codes.device, dtype=torch.float32)
        ranges[..., self.bins] = kept
        return ranges


class SequenceSampler(Sampler):
    """Draws the slots of sequences that stay inside one episode, uniformly over episodes and starts.

    TorchRL's ``SliceSampler`` finds the episodes by reading the whole storage; here all episodes are equally
    long, so that a draw costs the same whatever the storage holds.

    Args:
        episode_slots: slots an episode takes, T + 1.
        sequence_slots: slots a sequence takes, L + 1.
    """

    def __init__(self, episode_slots: int, sequence_slots: int) -> None:
        if sequence_slots > episode_slots:
            raise UserInputError(
                f"learner.sequence_length={sequence_slots - 1} is longer than an episode of "
                f"task.episode_steps={episode_slots - 1} transitions: shorten it"
            )
        self.episode_slots = episode_slots
        self.sequence_slots = sequence_slots

    def sample(self, storage: Storage, batch_size: int) -> tuple[Tensor, dict]:
        """Return flat slot indices ``[batch_size]``, sequence after sequence."""
        num_sequences = batch_size // self.sequence_slots
        num_episodes = len(storage) // self.episode_slots
        episode = torch.randint(num_episodes, (num_sequences,), generator=self._rng, device="cpu")
        starts = self.episode_slots - self.sequence_slots + 1
        start = torch.randint(starts, (num_sequences,), generator=self._rng, device="cpu")
        first = episode * self.episode_slots + start
        return (first.unsqueeze(-1) + torch.arange(self.sequence_slots, device="cpu")).flatten(), {}

    def state_dict(self) -> dict[str, Any]:
        """There is no state beside the generator, which the buffer owns."""
        return {}

    def load_state_dict(self, state_dict: dict[str, Any]) -> None:
        """See :meth:`state_dict`."""

    def dumps(self, path: Any) -> None:
        """See :meth:`state_dict`."""

    def loads(self, path: Any) -> None:
        """See :meth:`state_dict`."""

    def _empty(self) -> None:
        """See :meth:`state_dict`."""


def slot_spec(
    num_bins_kept: int, context_keys: tuple[str, ...], vectors: Mapping[str, int] = VECTOR_OBSERVATIONS
) -> dict[str, tuple[int, torch.dtype]]:
    """Return the features and type of every key of a slot; the memory of the replay follows from it."""
    spec = {
        "range": (num_bins_kept, torch.int16),
        **{key: (size, torch.float32) for key, size in vectors.items()},
        "action": (ACTION_SIZE, torch.float32),
        "reward_rest": (1, torch.float32),
        "reward_collision": (1, torch.float32),
    }
    return spec | dict.fromkeys(context_keys, (1, torch.float32))


def bytes_per_slot(
    num_bins_kept: int, context_keys: tuple[str, ...], vectors: Mapping[str, int] = VECTOR_OBSERVATIONS
) -> int:
    """Return how many bytes one stored agent step takes."""
    return sum(n * dtype.itemsize for n, dtype in slot_spec(num_bins_kept, context_keys, vectors).values())


def replay_bytes(
    capacity_steps: int,
    episode_steps: int,
    num_bins_kept: int,
    context_keys: tuple[str, ...],
    vectors: Mapping[str, int] = VECTOR_OBSERVATIONS,
) -> int:
    """Return how many bytes a full replay takes, in memory and on the disk."""
    slots = capacity_steps // episode_steps * (episode_steps + 1)
    return slots * bytes_per_slot(num_bins_kept, context_keys, vectors)


class SequenceReplay:
    """Replay of whole episodes that returns batches of sequences.

    Args:
        capacity_steps: agent steps to hold; rounded down to whole episodes, at least one.
        episode_steps: transitions of an episode, T.
        sequence_length: transitions of a sequence, L.
        batch_size: sequences of a batch, B.
        sensor_mask: bool ``[180]``, the bins the sensor keeps; only they are stored.
        context_keys: what else an episode holds constant and the networks read, such as ``"risk"``.
        vectors: name and size of the observations besides `range`.
        seed: root seed; batches are drawn from its stream ``"replay"``.
        device: where sampled batches go; the storage stays in main memory.
        collision_weight: scale of the collision reward where no weight is stored.

    Raises:
        UserInputError: if a sequence is longer than an episode or the capacity is below one episode.
    """

    def __init__(
        self,
        *,
        capacity_steps: int,
        episode_steps: int,
        sequence_length: int,
        batch_size: int,
        sensor_mask: Tensor,
        context_keys: tuple[str, ...],
        vectors: Mapping[str, int] = VECTOR_OBSERVATIONS,
        seed: int,
        device: torch.device | str = "cpu",
        collision_weight: float = 1.0,
    ) -> None:
        if capacity_steps < episode_steps:
            raise UserInputError(
                f"replay.capacity_steps={capacity_steps} holds no episode of {episode_steps} steps: raise it"
            )
        self.codec = RangeCodec(sensor_mask)
        self.context_keys = context_keys
        self.vectors = dict(vectors)
        self.episode_steps = episode_steps
        self.sequence_slots = sequence_length + 1
        self.batch_size = batch_size
        self.device = torch.device(device)
        self.collision_weight = collision_weight
        episode_slots = episode_steps + 1
        self.capacity_episodes = capacity_steps // episode_steps
        self.episodes_added = 0
        self.generator = torch_stream(seed, "replay")
        self.buffer = TensorDictReplayBuffer(
            storage=LazyTensorStorage(self.capacity_episodes * episode_slots),
            sampler=SequenceSampler(episode_slots, self.sequence_slots),
            batch_size=batch_size * self.sequence_slots,
            generator=self.generator,
        )

    def __len__(self) -> int:
        """Return the number of transitions held."""
        return len(self.buffer) // (self.episode_steps + 1) * self.episode_steps

    def add_episodes(self, episodes: TensorDictBase) -> None:
        """Store whole episodes.

        Args:
            episodes: ``[N, T]`` as the collector returns them, with `range`, the vectors, `action`,
                the context keys, and in ``next`` the observations and `reward_components` (unscaled).
        """
        if episodes.shape[-1] != self.episode_steps:
            raise ValueError(f"episodes of {episodes.shape[-1]} steps, not {self.episode_steps}")
        final = episodes[:, -1]
        components = episodes["next", "reward_components"]
        collision = components[..., [REWARD_COMPONENTS.index("collision")]]
        rest = torch.from_numpy(total_reward(components.numpy(), collision_weight=0.0)).unsqueeze(-1)
        slots = {
            key: torch.cat([episodes[key], final["next", key].unsqueeze(1)], 1) for key in ("range", *self.vectors)
        }
        slots["range"] = self.codec.encode(slots["range"])
        for key, value in {"action": episodes["action"], "reward_rest": rest, "reward_collision": collision}.items():
            slots[key] = torch.cat([value, torch.zeros_like(value[:, :1])], 1)
        for key in self.context_keys:
            slots[key] = torch.cat([episodes[key], episodes[key][:, -1:]], 1)
        self._extend(TensorDict(slots, batch_size=slots["action"].shape[:2]))

    def _extend(self, slots: TensorDict) -> None:
        self.buffer.extend(slots.flatten(0, 1))
        self.episodes_added += slots.shape[0]

    @property
    def oldest_episode(self) -> int:
        """Number of the oldest episode held; episodes count from 0 in the order in which they were added."""
        return max(0, self.episodes_added - self.capacity_episodes)

    def stored_episodes(self, first: int, number: int) -> TensorDict:
        """Return episodes as they are stored.

        Args:
            first: number of the first one, see :attr:`oldest_episode`.
            number: how many.

        Returns:
            TensorDict ``[number, T + 1]`` with the keys of :func:`slot_spec`.
        """
        if first < self.oldest_episode or first + number > self.episodes_added:
            raise ValueError(f"episodes {first} to {first + number - 1} are not all in the replay")
        episode = torch.arange(first, first + number, device="cpu") % self.capacity_episodes
        episode_slots = self.episode_steps + 1
        index = episode.unsqueeze(-1) * episode_slots + torch.arange(episode_slots, device="cpu")
        return self.buffer.storage[index.flatten()].exclude("index").reshape(number, episode_slots)

    def restore(self, first: int, parts: Iterable[TensorDict]) -> None:
        """Fill an empty replay with what :meth:`stored_episodes` returned, each episode where it was.

        Args:
            first: number of the first episode.
            parts: ``[N, T + 1]`` each, episode after episode.
        """
        if self.episodes_added:
            raise ValueError("only an empty replay can be restored")
        self.episodes_added = first
        slot = first % self.capacity_episodes * (self.episode_steps + 1)
        self.buffer.writer.load_state_dict({"_cursor": slot})
        for part in parts:
            self._extend(part)

    def sample(self) -> TensorDict:
        """Return a batch of sequences.

        Returns:
            TensorDict ``[B, L + 1]`` with `range`, the vectors, `action`, the context keys,
            ``("next", "reward")`` (its collision part scaled by the episode's `collision_weight`, or the replay's) and
            ``("next", "terminated")`` (always false: an episode is only ever truncated). In the last slot only
            the observation counts.
        """
        flat = self.buffer.sample().to(self.device)
        slots = flat.reshape(self.batch_size, self.sequence_slots)
        weight = slots["collision_weight"] if "collision_weight" in self.context_keys else self.collision_weight
        reward = slots["reward_rest"] + weight * slots["reward_collision"]
        kept = {key: _step_by_step(slots[key]) for key in self.vectors} | {"action": slots["action"]}
        # One value expanded: the loss then knows that a sequence shares it.
        kept |= {key: slots[key][:, :1].expand(-1, self.sequence_slots, -1) for key in self.context_keys}
        return TensorDict(
            {
                **kept,
                "range": _step_by_step(self.codec.decode(slots["range"])),
                "next": {"reward": reward, "terminated": torch.zeros_like(reward, dtype=torch.bool)},
            },
            batch_size=slots.batch_size,
            device=self.device,
        )


def _step_by_step(observation: Tensor) -> Tensor:
    """Lay a batch ``[B, T, ..]`` out as recurrent layers read it, which every network would do for itself."""
    return observation.transpose(0, 1).contiguous().transpose(0, 1)
