"""The agent's policy made lean, the pursuit baseline and the noisy pursuit that collects the first episodes."""

import math
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import torch
from tensordict import TensorDict, TensorDictBase
from tensordict.nn import TensorDictModuleBase
from torchrl.checkpoint import Checkpoint
from torchrl.data import Bounded
from torchrl.envs.utils import ExplorationType, set_exploration_type
from torchrl.objectives import LossModule

from rcdsac_trl.agent.actor import build_policy
from rcdsac_trl.robot.observation import REMEMBERED_SIZE
from rcdsac_trl.robot.range_sensor import sensor_mask
from rcdsac_trl.rollout.make_agent import make_average, make_loss
from rcdsac_trl.rollout.planners.pursuit import pursuit_action
from rcdsac_trl.rollout.policies import PERSISTENCE, AgentNoise, CollectionPolicy, LeanPolicy, OnDevice, PursuitPolicy
from rcdsac_trl.seeding import stream
from tiny import tiny_settings

AHEAD = torch.tensor([0.0, 1.0, 0.0, 0.0, 1.0, 0.0])
NOISE = 0.1


class Agent(TensorDictModuleBase):
    """Stands in for the agent's policy: draws its action, and writes a recurrent state."""

    in_keys = ["waypoint"]  # noqa: RUF012
    out_keys = ["action", "recurrent_state"]  # noqa: RUF012

    def __init__(self, noise: AgentNoise) -> None:
        super().__init__()
        self.noise = noise

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        tensordict["action"] = self.noise.draw() - 7.0  # no pursuit gives that
        tensordict["recurrent_state"] = torch.ones(*tensordict.batch_size, 3)
        return tensordict


def observed(batch: int = 1, is_init: bool = False) -> TensorDict:
    return TensorDict(
        {"waypoint": AHEAD.expand(batch, 6), "is_init": torch.full((batch, 1), is_init)}, batch_size=[batch]
    )


def collection_policy(
    pursuit_iterations: int = 2, noise: float = NOISE, seed: int = 0, agents: int = 1
) -> CollectionPolicy:
    draws = AgentNoise(range(agents))
    return CollectionPolicy(
        Agent(draws),
        noise=draws,
        seed=seed,
        pursuit_iterations=pursuit_iterations,
        pursuit_noise=noise,
    )


def actions(policy: CollectionPolicy, iteration: int, steps: int, batch: int = 1) -> torch.Tensor:
    policy.set_iteration(iteration)
    return torch.stack([policy(observed(batch, is_init=step == 0))["action"] for step in range(steps)])


def test_pursuit_policy_writes_the_pursuit_action_at_any_batch() -> None:
    out = PursuitPolicy()(observed(3))
    assert torch.equal(out["action"], pursuit_action(AHEAD).expand(3, 2))


def test_pursuit_drives_the_first_iterations_and_the_agent_the_rest() -> None:
    policy = collection_policy(pursuit_iterations=2)
    for iteration, pursuing in ((0, True), (1, True), (2, False), (3, False)):
        policy.set_iteration(iteration)
        out = policy(observed(is_init=True))
        assert bool((out["action"] >= -1.0).all()) == pursuing
        assert torch.equal(out["recurrent_state"], torch.ones(1, 3)), "the agent remembers whoever drives"


def test_without_warm_up_the_agent_drives_at_once() -> None:
    policy = collection_policy(pursuit_iterations=0)
    assert (actions(policy, 0, 1) < -1.0).all()


@pytest.mark.parametrize("pursuit_iterations", [0, 5])
def test_exploration_noise_derives_from_seed_and_iteration_alone(pursuit_iterations: int) -> None:
    first, again = collection_policy(pursuit_iterations), collection_policy(pursuit_iterations)
    actions(again, 0, 7)  # what came before leaves no trace
    assert torch.equal(actions(first, 3, 5), actions(again, 3, 5))
    assert torch.equal(actions(first, 3, 5), actions(first, 3, 5))
    assert not torch.equal(actions(first, 3, 5), actions(first, 4, 5))
    assert not torch.equal(actions(first, 3, 5), actions(collection_policy(pursuit_iterations, seed=1), 3, 5))


def test_warm_up_noise_is_autoregressive_with_its_deviation_and_persistence() -> None:
    # The turn of a waypoint straight ahead is 0, so the second action is the noise itself; 0.1 never reaches the clamp.
    noise = actions(collection_policy(noise=NOISE, agents=40), 0, 1000, batch=40)[..., 1]
    assert pursuit_action(AHEAD)[1] == 0
    assert noise.abs().max() < 1
    # Its standard deviation is the stated one from the first step to the last, not only in the long run.
    assert noise[0].std().item() == pytest.approx(NOISE, rel=0.4)  # 40 numbers
    assert noise[-100:].std().item() == pytest.approx(NOISE, rel=0.1)
    assert noise.mean().item() == pytest.approx(0.0, abs=0.01)
    for lag in (1, 5, 10):
        together = (noise[lag:] * noise[:-lag]).mean() / noise.square().mean()
        assert together.item() == pytest.approx(PERSISTENCE**lag, abs=0.04)
    innovation = noise[1:] - PERSISTENCE * noise[:-1]
    assert innovation.std().item() == pytest.approx(NOISE * math.sqrt(1 - PERSISTENCE**2), rel=0.02)


def test_a_new_episode_begins_with_fresh_noise() -> None:
    policy = collection_policy(noise=NOISE)
    policy.set_iteration(0)
    pairs = []
    for _ in range(600):
        policy(observed(is_init=True))
        before = policy(observed())["action"][0, 1]
        pairs.append((before, policy(observed(is_init=True))["action"][0, 1]))
    last, first = torch.tensor(pairs).T
    assert abs(torch.corrcoef(torch.stack([last, first]))[0, 1].item()) < 0.15


def test_warm_up_actions_stay_within_the_limits() -> None:
    wild = actions(collection_policy(noise=3.0), 0, 200)
    assert wild.abs().max() == 1.0
    assert torch.equal(actions(collection_policy(noise=0.0), 0, 1)[0], pursuit_action(AHEAD).expand(1, 2))


def test_on_device_writes_what_the_policy_writes() -> None:
    # No CUDA here: what can be tested is that it reads and writes the policy's keys, and only those.
    policy = OnDevice(PursuitPolicy(), "cpu")
    given = observed(2).set("extra", torch.zeros(2))
    out = policy(given.clone())
    assert set(out.keys()) == {*given.keys(), "action"}
    assert torch.equal(out["action"], PursuitPolicy()(observed(2))["action"])


# ------------------------------------------------------------------------------------------------ the agent's own
SIZES = {"range": 180, "waypoint": 6, "velocity": 4, "recurrent_state": 128, "risk": 1, "collision_weight": 1}
SIZES |= {"remembered": REMEMBERED_SIZE}
REMEMBERS = ["sensor.memory_s=12", "network.look_ahead=true"]


def seen(batch: tuple[int, ...], seed: int, sensor: str = "narrow") -> TensorDict:
    """What agents may see, at random; a third of the sensor's bins sees nothing."""
    generator = torch.Generator().manual_seed(seed)
    given = {key: -torch.rand(*batch, size, generator=generator) for key, size in SIZES.items()}
    seeing = torch.rand(given["range"].shape, generator=generator) > 1 / 3
    given["range"] = (0.5 - 2.4 * given["range"]) * seeing * torch.from_numpy(sensor_mask(sensor))
    given["is_init"] = torch.rand(*batch, 1, generator=generator) < 0.1
    return TensorDict(given, batch_size=batch)


def noise_of(number: int) -> AgentNoise:
    noise = AgentNoise(range(number))
    noise.begin(0, "test")
    return noise


@pytest.mark.parametrize(
    ("row", "sensor", "chosen"),
    [
        ("rcdsac_pow", "narrow", ["network.restart_steps=2"]),
        ("sac", "sparse", REMEMBERS),
        ("rcwr", "full", ["network.restart_steps=3", *REMEMBERS]),
    ],
)
@pytest.mark.parametrize("batch", [(3,), (2, 2)])
def test_the_lean_policy_is_the_policy_to_rounding(
    row: str, sensor: str, chosen: list[str], batch: tuple[int, ...]
) -> None:
    actor = make_loss(tiny_settings(row, *chosen), "cpu").actor_network
    plain = build_policy(actor, Bounded(-1.0, 1.0, (2,)))
    lean = LeanPolicy(actor, noise_of(math.prod(batch)))
    drawn = noise_of(math.prod(batch))
    assert set(lean.in_keys) == set(plain.in_keys)
    assert set(lean.out_keys) == set(plain.out_keys)
    states = [torch.zeros(*batch, actor[0].module.state_size)] * 2
    for step in range(200):
        given = seen(batch, step, sensor)
        with torch.no_grad(), set_exploration_type(ExplorationType.DETERMINISTIC):
            expected = plain(given.clone().set("recurrent_state", states[0]))
        with set_exploration_type(ExplorationType.RANDOM if step % 2 else ExplorationType.DETERMINISTIC):
            found = lean(given.set("recurrent_state", states[1]))
        if step % 2:
            noisy = expected["loc"] + drawn.draw().view(*batch, 2) * expected["scale"]
            expected["action"] = noisy.tanh().clamp(-1 + 1e-6, 1 - 1e-6)
        for key in plain.out_keys:
            torch.testing.assert_close(found[key], expected[key], rtol=1e-5, atol=2e-6)
        states = [out["next", "recurrent_state"] for out in (expected, found)]


@pytest.mark.parametrize("batch", [(7, 1), (2, 3)])
def test_what_an_agent_does_does_not_depend_on_the_others(batch: tuple[int, ...]) -> None:
    actor = make_loss(tiny_settings(), "cpu").actor_network
    number = math.prod(batch)
    together = LeanPolicy(actor, noise_of(number))
    alone = []
    for agent in range(number):
        noise = AgentNoise([agent])
        noise.begin(0, "test")
        alone.append(LeanPolicy(actor, noise))
    for step in range(20):
        given = seen(batch, step)
        found = together(given.clone()).reshape(-1)
        for agent in range(number):
            expected = alone[agent](given.reshape(-1)[agent : agent + 1].clone())
            for key in together.out_keys:
                assert torch.equal(found[key][agent : agent + 1], expected[key]), key


def change_by_optimizer(loss: LossModule, tmp_path: Path) -> None:
    parameters = list(loss.actor_network_params.values(True, True))
    optimizer = torch.optim.Adam(parameters, lr=0.1, fused=True)
    for parameter in parameters:
        parameter.grad = torch.ones_like(parameter)
    optimizer.step()


def change_by_loading(loss: LossModule, tmp_path: Path) -> None:
    actor = loss.actor_network
    actor.load_state_dict({key: 2.0 * value for key, value in actor.state_dict().items()})


def change_by_checkpoint(loss: LossModule, tmp_path: Path) -> None:
    Checkpoint(loss=make_loss(tiny_settings("rcdsac_pow", "seed=9"), "cpu")).save(tmp_path / "saved")
    Checkpoint(loss=loss).load(tmp_path / "saved")


def change_one_number(loss: LossModule, tmp_path: Path) -> None:
    with torch.no_grad():
        next(iter(loss.actor_network_params.values(True, True)))[0] += 1.0


@pytest.mark.parametrize("change", [change_by_optimizer, change_by_loading, change_by_checkpoint, change_one_number])
def test_the_lean_policy_acts_with_the_weights_of_now(
    change: Callable[[LossModule, Path], None], tmp_path: Path
) -> None:
    loss = make_loss(tiny_settings(), "cpu")
    policy = LeanPolicy(loss.actor_network, noise_of(2))
    now = seen((2,), 0).set("is_init", torch.zeros(2, 1, dtype=torch.bool))
    before = policy(now)["loc"].clone()
    change(loss, tmp_path)
    # What PyTorch counts is seen at once, all else when the next episode of any agent begins.
    uncounted = change in (change_by_optimizer, change_by_checkpoint)
    now = seen((2,), 0).set("is_init", torch.tensor([[uncounted], [False]]))
    after = policy(now.clone())["loc"]
    assert not torch.equal(after, before)
    assert torch.equal(after, LeanPolicy(loss.actor_network, noise_of(2))(now)["loc"])


def test_the_lean_policy_of_an_average_moves_with_it() -> None:
    settings = tiny_settings("rcdsac_pow", "learner.actor_average_decay=0.5")
    loss = make_loss(settings, "cpu")
    average = make_average(loss, settings.learner)
    policy = LeanPolicy(average.module, noise_of(2))
    average.update_parameters(loss.actor_network)  # the first call copies
    before = policy(seen((2,), 0))["loc"].clone()
    change_by_loading(loss, Path())
    average.update_parameters(loss.actor_network)
    assert not torch.equal(policy(seen((2,), 0))["loc"], before)


def test_another_device_has_the_layers_and_makes_no_tensor_elsewhere() -> None:
    policy = LeanPolicy(make_loss(tiny_settings(), "cpu").actor_network.to("meta"), noise_of(2))
    out = policy(seen((2,), 0).to("meta"))
    assert {out[key].device.type for key in policy.out_keys} == {"meta"}
    assert out["action"].shape == (2, 2)


# ------------------------------------------------------------------------------------------------ noise
def test_each_agent_has_its_own_stream_of_noise() -> None:
    several, one = AgentNoise([0, 5, 7]), AgentNoise([5])
    several.begin(3, "exploration", 2)
    one.begin(3, "exploration", 2)
    drawn = torch.stack([several.draw() for _ in range(600)])
    assert torch.equal(drawn[:, 1:2], torch.stack([one.draw() for _ in range(600)]))
    expected = stream(3, "exploration", 2, 5).standard_normal((600, 2), np.float32)
    assert np.array_equal(drawn[:, 1].numpy(), expected), "blocks go on where the last one ended"
    assert abs(torch.corrcoef(drawn.flatten(1).T) - torch.eye(6)).max() < 0.15
    several.begin(3, "exploration", 2)
    assert torch.equal(several.draw(), drawn[0]), "what was drawn before is forgotten"
