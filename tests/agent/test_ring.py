"""The ring of bins: every bin of every sensor is read, and no direction otherwise than another, by all twins."""

import json
from collections.abc import Callable
from pathlib import Path
from typing import get_args

import numpy as np
import pytest
import torch
from tensordict.nn import TensorDictModule, TensorDictSequential
from torch import Tensor
from torch.nn import functional as F

from rcdsac_trl.agent.kernels import dispatch
from rcdsac_trl.agent.kernels.compiled_actor import CompiledActor
from rcdsac_trl.agent.networks import Encoder
from rcdsac_trl.deploy.export.modules import ActorStep
from rcdsac_trl.deploy.policy.inference import Encoders
from rcdsac_trl.deploy.policy.policy import Policy
from rcdsac_trl.deploy.policy.registry import shipped_agents
from rcdsac_trl.deploy.policy.weights import FORMAT_VERSION, Weights, packed, read_weights
from rcdsac_trl.robot.observation import RangeCode, range_observation
from rcdsac_trl.robot.range_sensor import SENSORS, sensor_mask
from robots import full_size

STRIDE = 4
"""Bins between two positions of the second convolution."""


def encoder_of(weights: Weights) -> Encoder:
    encoder = ActorStep.of_weights(weights).encoder
    assert isinstance(encoder, Encoder)
    return encoder


def by_layers(weights: Weights, bins: Tensor) -> Tensor:
    encoder = encoder_of(weights)
    given = bins.new_zeros(1, 6), bins.new_zeros(1, 4), torch.ones(1, 1, dtype=torch.bool), bins.new_zeros(1, 128)
    return torch.cat([encoder.step(row, *given)[0] for row in bins.split(1)])


def by_kernels(weights: Weights, bins: Tensor) -> Tensor:
    number = len(bins)
    vectors = bins.new_zeros(number, 1, 6), bins.new_zeros(number, 1, 4)
    return dispatch.forward(encoder_of(weights), bins.unsqueeze(1), *vectors)[:, 0]


def by_compiled_actor(weights: Weights, bins: Tensor) -> Tensor:
    module = ActorStep.of_weights(weights)
    actor = TensorDictSequential(
        TensorDictModule(module.encoder, in_keys=["range", "waypoint", "velocity"], out_keys=["memory"]),
        TensorDictModule(module.head, in_keys=["memory", "risk"], out_keys=["loc", "scale"]),
    )
    number = len(bins)
    vectors, first = [bins.new_zeros(number, 6), bins.new_zeros(number, 4)], torch.ones(number, 1, dtype=torch.bool)
    return CompiledActor(actor).step(bins, vectors, bins.new_zeros(number, 1), first, bins.new_zeros(number, 128))[3]


def by_numpy(weights: Weights, bins: Tensor) -> Tensor:
    config = weights.config
    encoders = Encoders([weights.part("actor.encoder")], sensor_mask(config.sensor), config.padding, config.range_code)
    nothing = np.zeros(10, np.float32), np.zeros((1, 128), np.float32)
    return torch.from_numpy(np.concatenate([encoders.step(row, *nothing) for row in bins.numpy()]))


TWINS = [by_layers, by_kernels, by_compiled_actor, by_numpy]


def effect_of_each_bin(twin: Callable[[Weights, Tensor], Tensor], weights: Weights) -> Tensor:
    """Return how far each bin of the sensor moves the memory."""
    mask = torch.from_numpy(sensor_mask(weights.config.sensor))
    base = torch.rand(180, generator=torch.Generator().manual_seed(0)) * mask
    changed = base.repeat(180, 1)
    changed.diagonal().add_(1.0)
    memories = twin(weights, torch.cat((base[None], changed[mask])))
    return (memories[1:] - memories[0]).abs().amax(1)


@pytest.mark.parametrize("sensor", sorted(SENSORS))
@pytest.mark.parametrize("twin", TWINS)
def test_every_bin_of_every_sensor_is_read(twin: Callable, sensor: str) -> None:
    effects = effect_of_each_bin(twin, full_size(sensor=sensor))
    assert len(effects) == sensor_mask(sensor).sum()
    assert effects.min() > 1e-5


@pytest.mark.parametrize("twin", TWINS)
def test_without_padding_the_last_three_bins_are_not_read(twin: Callable) -> None:
    effects = effect_of_each_bin(twin, full_size(sensor="full", padding="none"))
    assert effects[:177].min() > 1e-5
    assert effects[177:].max() < 1e-6


@pytest.mark.parametrize("range_code", get_args(RangeCode))
@pytest.mark.parametrize("padding", ["circular", "none"])
@pytest.mark.parametrize("twin", TWINS[1:])
def test_twins_agree_on_the_ring(twin: Callable, padding: str, range_code: str) -> None:
    weights = full_size(sensor="full", padding=padding, range_code=range_code)
    bins = torch.rand(40, 180, generator=torch.Generator().manual_seed(1))
    bins[bins < 0.3] = 0.0
    torch.testing.assert_close(twin(weights, bins), by_layers(weights, bins), rtol=1e-5, atol=2e-6)


def test_nearness_is_0_where_nothing_is_and_at_3_m() -> None:
    layers = encoder_of(full_size(sensor="full", range_code="nearness")).range
    seen = np.full(180, np.inf)
    seen[:3] = 2.9999, 0.3, 0.03
    read = layers.read(torch.from_numpy(range_observation(seen, np.ones(180, bool)))[None])[0, 1:181]
    torch.testing.assert_close(read[:3], torch.tensor([0.0, 1.0, 2.0]), rtol=0.0, atol=1e-4)
    assert not read[3:].any()


def test_turning_the_ring_shifts_the_positions() -> None:
    """By layers that pad each on its own, by ours, and by NumPy's."""
    weights = full_size(sensor="full")
    layers = encoder_of(weights).range
    encoders = Encoders([weights.part("actor.encoder")], sensor_mask("full"), "circular", "paper")

    def apart(bins: Tensor) -> Tensor:
        first = F.relu(layers.conv_1(F.pad(bins[None, None], (1, 2), mode="circular")))
        return F.relu(layers.conv_2(F.pad(first, (0, 1), mode="circular")))[0].T

    def ours(bins: Tensor) -> Tensor:
        return F.relu(layers.conv_2(F.relu(layers.conv_1(layers.read(bins[None]).unsqueeze(1)))))[0].T

    def numpys(bins: Tensor) -> Tensor:
        return torch.from_numpy(encoders._positions(bins.numpy())[0])

    bins = torch.rand(180, generator=torch.Generator().manual_seed(2))
    for turns in (0, 1, 7, 44):
        expected = apart(bins).roll(turns, 0)
        assert expected.shape == (45, 32)
        for positions in (apart, ours, numpys):
            torch.testing.assert_close(positions(bins.roll(STRIDE * turns)), expected, rtol=1e-5, atol=1e-6)


def test_each_position_reads_nine_bins_around_the_ring() -> None:
    layers = encoder_of(full_size(sensor="full")).range.double()
    for layer in (layers.conv_1, layers.conv_2):
        layer.weight.data.fill_(1.0)
    bins = torch.eye(180, dtype=torch.float64).unsqueeze(1)
    positions = layers.conv_2(layers.conv_1(layers.read(bins[:, 0]).unsqueeze(1)))
    empty = layers.conv_2(layers.conv_1(layers.read(0.0 * bins[:1, 0]).unsqueeze(1)))
    read = (positions - empty)[:, 0] > 1e-9  # [bin, position]
    for q in (0, 1, 22, 44):
        assert set(read[:, q].nonzero().flatten().tolist()) == {b % 180 for b in range(4 * q - 1, 4 * q + 8)}


def test_weights_of_format_1_keep_their_reading(tmp_path: Path) -> None:
    weights = full_size(padding="none")
    for name, content in packed(weights).items():
        (tmp_path / name).write_bytes(content)
    config = json.loads((tmp_path / "config.json").read_bytes())
    assert (config.pop("padding"), config.pop("format_version")) == ("none", FORMAT_VERSION)
    assert (config.pop("memory_s"), config.pop("range_code")) == (0.0, "paper")  # of agents of formats 1 and 2
    unsaid_by_3 = config.pop("robot")["name"], config.pop("restart_steps"), config.pop("look_ahead")
    assert unsaid_by_3 == ("paper", None, False)
    assert (config.pop("acting")["num_candidates"], config.pop("recalibration")) == (1, None)
    (tmp_path / "config.json").write_text(json.dumps(config | {"format_version": 1}))
    old = read_weights(tmp_path)
    assert old.config == weights.config
    Policy(old)
    for folder in shipped_agents().values():
        assert read_weights(folder).config.padding in ("circular", "none")
