"""The agent's policy made lean, the pursuit baseline and the noisy pursuit that collects the first episodes."""

import math

import pytest
import torch
from tensordict import TensorDict, TensorDictBase
from tensordict.nn import TensorDictModuleBase
from torchrl.data import Bounded
from torchrl.envs.utils import ExplorationType, set_exploration_type

from rcdsac_trl.agent.actor import build_policy
from rcdsac_trl.pipeline.build.agent import make_loss
from rcdsac_trl.pipeline.policies import PERSISTENCE, CollectionPolicy, LeanPolicy, OnDevice, PursuitPolicy
from rcdsac_trl.world.pursuit import pursuit_action
from tiny import tiny_settings

AHEAD = torch.tensor([0.0, 1.0, 0.0, 0.0, 1.0, 0.0])
NOISE = 0.1


class Agent(TensorDictModuleBase):
    """Stands in for the agent's policy: draws its action, and writes a recurrent state."""

    in_keys = ["waypoint"]  # noqa: RUF012
    out_keys = ["action", "recurrent_state"]  # noqa: RUF012

    def __init__(self, generator: torch.Generator) -> None:
        super().__init__()
        self.generator = generator

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        shape = (*tensordict.batch_size, 2)
        tensordict["action"] = torch.rand(shape, generator=self.generator) - 5.0  # no pursuit gives that
        tensordict["recurrent_state"] = torch.ones(*tensordict.batch_size, 3)
        return tensordict


def observed(batch: int = 1, is_init: bool = False) -> TensorDict:
    return TensorDict(
        {"waypoint": AHEAD.expand(batch, 6), "is_init": torch.full((batch, 1), is_init)}, batch_size=[batch]
    )


def collection_policy(pursuit_iterations: int = 2, noise: float = NOISE, seed: int = 0) -> CollectionPolicy:
    generator = torch.Generator()
    return CollectionPolicy(
        Agent(generator),
        generator=generator,
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
    noise = actions(collection_policy(noise=NOISE), 0, 1000, batch=40)[..., 1]
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


@pytest.mark.parametrize("row", ["rcdsac_pow", "sac", "rcwr"])
@pytest.mark.parametrize("kind", [ExplorationType.RANDOM, ExplorationType.DETERMINISTIC])
@pytest.mark.parametrize("batch", [(4,), (2, 2)])
def test_the_lean_policy_is_the_policy_bit_by_bit(row: str, kind: ExplorationType, batch: tuple[int, ...]) -> None:
    actor = make_loss(tiny_settings(row), "cpu").actor_network
    plain = build_policy(actor, Bounded(-1.0, 1.0, (2,)), torch.Generator().manual_seed(5))
    lean = LeanPolicy(actor, torch.Generator().manual_seed(5))
    assert set(lean.in_keys) == set(plain.in_keys)
    assert set(lean.out_keys) == set(plain.out_keys)
    sizes = {"range": 180, "waypoint": 6, "velocity": 4, "recurrent_state": 128, "risk": 1, "collision_weight": 1}
    with torch.no_grad(), set_exploration_type(kind):
        for seed in range(3):
            generator = torch.Generator().manual_seed(seed)
            given = {key: -torch.rand(*batch, size, generator=generator) for key, size in sizes.items()}
            given["is_init"] = torch.rand(*batch, 1, generator=generator) < 0.5
            expected = plain(TensorDict(given, batch_size=batch))
            found = lean(TensorDict(given, batch_size=batch))
            for key in plain.out_keys:
                assert torch.equal(found[key], expected[key]), key
