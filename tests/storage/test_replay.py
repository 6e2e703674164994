"""The replay: compact storage, sequences inside one episode, every observation once."""

import pytest
import torch
from tensordict import TensorDict

from rcdsac_trl.errors import UserInputError
from rcdsac_trl.storage.sequence_replay import RANGE_HIGH, RANGE_LOW, RangeCodec, SequenceReplay, bytes_per_slot

EPISODE_STEPS = 20
FULL = torch.ones(180, dtype=torch.bool)


def narrow() -> torch.Tensor:
    mask = torch.ones(180, dtype=torch.bool)
    mask[21:158] = False
    return mask


def make_replay(**changes: object) -> SequenceReplay:
    arguments = {
        "capacity_steps": 60,
        "episode_steps": EPISODE_STEPS,
        "sequence_length": 4,
        "batch_size": 50,
        "sensor_mask": FULL,
        "context_keys": ("risk",),
        "seed": 0,
    }
    return SequenceReplay(**arguments | changes)


def numbered_episodes(first: int, number: int = 1, steps: int = EPISODE_STEPS) -> TensorDict:
    """Episodes in which everything says which episode and step it belongs to: 100 * episode + step."""
    episode = torch.arange(first, first + number).view(-1, 1, 1)
    step = torch.arange(steps).view(1, -1, 1)
    mark = (100 * episode + step).float()
    components = torch.cat([mark, 0 * mark, 0 * mark + 2, 0 * mark + 3, 0 * mark - 10], -1)

    def observed(mark: torch.Tensor) -> dict[str, torch.Tensor]:
        return {
            "range": torch.zeros(number, steps, 180),
            "waypoint": mark.expand(-1, -1, 6),
            "velocity": mark.expand(-1, -1, 4),
        }

    return TensorDict(
        {
            **observed(mark),
            "action": mark.expand(-1, -1, 2),
            "risk": -episode.float().expand(-1, steps, 1),
            "collision_weight": episode.float().expand(-1, steps, 1),
            "next": {**observed(mark + 1), "reward_components": components},
        },
        batch_size=[number, steps],
    )


def test_codec_keeps_zero_exactly_and_rounds_the_rest_by_less_than_a_hundredth_of_a_percent() -> None:
    codec = RangeCodec(FULL)
    distances = torch.logspace(-1.99, 0.477, 180)
    ranges = 2.5 + distances.log10()
    ranges[::7] = 0.0
    decoded = codec.decode(codec.encode(ranges))
    assert torch.equal(decoded == 0, ranges == 0)
    seen = ranges != 0
    error = (10 ** (decoded[seen] - 2.5) / distances[seen] - 1).abs().max()
    assert error < 1e-4


def test_codec_reaches_both_ends_of_its_interval() -> None:
    codec = RangeCodec(FULL)
    ends = torch.tensor([RANGE_LOW, RANGE_HIGH]).repeat(90)
    torch.testing.assert_close(codec.decode(codec.encode(ends)), ends)


def test_codec_stores_the_bins_of_the_sensor_only() -> None:
    codec = RangeCodec(narrow())
    ranges = torch.full((180,), 2.0)
    codes = codec.encode(ranges)
    assert codes.shape == (43,)
    decoded = codec.decode(codes)
    assert torch.equal(decoded != 0, narrow())


def test_sequences_stay_inside_one_episode_and_line_up() -> None:
    replay = make_replay()
    replay.add_episodes(numbered_episodes(0, 3))
    batch = replay.sample()
    assert batch.shape == (50, 5)
    mark = batch["waypoint"][..., 0]
    assert torch.equal(mark.diff(dim=1), torch.ones(50, 4))
    assert torch.equal(mark[:, 0] // 100, mark[:, -1] // 100)
    assert torch.equal(batch["velocity"][..., 0], mark)
    assert torch.equal(batch["action"][:, :-1, 0], mark[:, :-1])
    assert torch.equal(batch["risk"][..., 0], -(mark // 100))
    # r = mark + 0 + 2 * 3 - 10
    assert torch.equal(batch["next", "reward"][:, :-1, 0], mark[:, :-1] - 4)
    assert not batch["next", "terminated"].any()


def test_every_start_is_drawn_the_last_one_included() -> None:
    replay = make_replay(batch_size=2000)
    replay.add_episodes(numbered_episodes(0, 3))
    first = replay.sample()["waypoint"][:, 0, 0]
    counts = torch.stack([(first == 100 * e + s).sum() for e in range(3) for s in range(EPISODE_STEPS - 4 + 1)])
    expected = 2000 / 51
    # Chi-square with 50 degrees of freedom: 99.9 % lie below 86.7.
    assert ((counts - expected) ** 2 / expected).sum() < 86.7


def test_the_oldest_episode_leaves_first() -> None:
    replay = make_replay(batch_size=500)
    for episode in range(5):
        replay.add_episodes(numbered_episodes(episode))
    assert len(replay) == 60
    assert set((replay.sample()["waypoint"][..., 0] // 100).unique().tolist()) == {2.0, 3.0, 4.0}


def test_collision_weight_scales_the_stored_component() -> None:
    replay = make_replay(context_keys=("collision_weight",))
    replay.add_episodes(numbered_episodes(2))
    batch = replay.sample()
    mark = batch["waypoint"][:, :-1, 0]
    # Episode 2 has weight 2: mark + 2 * 3 + 2 * (-10)
    assert torch.equal(batch["next", "reward"][:, :-1, 0], mark - 14)


def test_where_no_weight_is_stored_the_replays_own_scales_the_component() -> None:
    replay = make_replay(collision_weight=3.0)
    replay.add_episodes(numbered_episodes(2))
    batch = replay.sample()
    # mark + 2 * 3 + 3 * (-10)
    assert torch.equal(batch["next", "reward"][:, :-1, 0], batch["waypoint"][:, :-1, 0] - 24)


def test_batches_derive_from_the_seed() -> None:
    batches = []
    for seed in (0, 0, 1):
        replay = make_replay(seed=seed)
        replay.add_episodes(numbered_episodes(0, 3))
        batches.append(replay.sample()["waypoint"])
    assert torch.equal(batches[0], batches[1])
    assert not torch.equal(batches[0], batches[2])


def test_five_million_steps_fit_in_3_gb() -> None:
    slots = 5_000 * 1_001
    assert slots * bytes_per_slot(180, ("risk",)) < 3e9


def test_the_storage_takes_what_the_specs_say() -> None:
    replay = make_replay(sensor_mask=narrow())
    replay.add_episodes(numbered_episodes(0, 3))
    stored = replay.buffer.storage[:]
    held = sum(value.untyped_storage().nbytes() for value in stored.exclude("index").values(True, True))
    assert held == 3 * 21 * bytes_per_slot(43, ("risk",))


def test_wrong_sizes_are_refused() -> None:
    with pytest.raises(UserInputError, match="longer than an episode"):
        make_replay(sequence_length=21)
    with pytest.raises(UserInputError, match="holds no episode"):
        make_replay(capacity_steps=19)
    with pytest.raises(ValueError, match="episodes of 19 steps"):
        make_replay().add_episodes(numbered_episodes(0, steps=19))
