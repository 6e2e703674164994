"""What a program has made torch's default type and device reaches neither specs nor networks nor any number."""

from collections.abc import Iterator

import pytest
import torch
from tensordict import TensorDictBase
from torch import Tensor

from rcdsac_trl.agent.actor import build_actor, build_critic
from rcdsac_trl.agent.risk import PowerLaw
from rcdsac_trl.rollout.environments import environment, rollout_worker
from rcdsac_trl.rollout.make_agent import make_policy
from rcdsac_trl.rollout.policies import AgentNoise, PursuitPolicy
from rcdsac_trl.training.make_learner import make_learner
from tiny import tiny_settings

AGENTS = 2
ROWS = ("rcdsac_pow", "rcwr")


@pytest.fixture(params=["float64", "meta"])
def other_default(request: pytest.FixtureRequest) -> Iterator[None]:
    if request.param == "float64":
        torch.set_default_dtype(torch.float64)
    else:
        torch.set_default_device("meta")  # what lands there has no numbers
    yield
    torch.set_default_dtype(torch.float32)
    torch.set_default_device(None)


def learnt(row: str) -> dict[str, Tensor]:
    """Make a row's agent, let it drive and take it through a loss; return every tensor that comes of it, by name."""
    settings = tiny_settings(row)
    learner = make_learner(settings, "cpu")
    loss = learner.loss
    noise = AgentNoise(range(AGENTS))
    noise.begin(0, "exploration", 0)
    group = rollout_worker(
        settings.training_world,
        settings.algo,
        split="train",
        seed=0,
        agent_ids=range(AGENTS),
        state_size=settings.network.state_size,
    )
    keys = ("range", "waypoint", "velocity")
    happened = ("reward", "reward_components", "contact", "goal_reached")
    policy = make_policy(loss.actor_network, noise, "cpu")
    episodes = group.rollout(policy, 0, observed=keys, happened=happened).tensordict()
    group.close()
    learner.replay.add_episodes(episodes)
    losses = learner.update()
    found = {f"parameter {name}": value for name, value in loss.named_parameters()}
    found |= {f"episode {key}": value for key, value in episodes.flatten_keys().items()}
    return found | {f"loss {key}": value for key, value in losses.items()}


def assert_equal(found: dict[str, Tensor], expected: dict[str, Tensor]) -> None:
    assert found.keys() == expected.keys()
    for name, value in expected.items():
        assert (found[name].dtype, found[name].device) == (value.dtype, value.device), name
        assert torch.equal(found[name], value), name


@pytest.fixture(scope="module")
def expected() -> dict[str, dict[str, Tensor]]:
    return {row: learnt(row) for row in ROWS}


@pytest.mark.parametrize("row", ROWS)
def test_an_agent_drives_and_learns_the_same(expected: dict, row: str, other_default: None) -> None:
    assert_equal(learnt(row), expected[row])


def rolled_out() -> tuple[TensorDictBase, dict[str, tuple]]:
    settings = tiny_settings("rcdsac_pow")
    env = environment(
        settings.training_world,
        settings.algo,
        split="train",
        seed=0,
        agent_ids=range(AGENTS),
        state_size=settings.network.state_size,
    )
    episodes = env.rollout(4, PursuitPolicy()).cpu()
    specs = {
        str(key): (spec.dtype, spec.device)
        for whole in (env.observation_spec, env.full_action_spec, env.full_reward_spec, env.full_done_spec)
        for key, spec in whole.items(True, True)
    }
    env.close()
    return episodes, specs


@pytest.fixture(scope="module")
def told() -> tuple[TensorDictBase, dict[str, tuple]]:
    return rolled_out()


def test_an_environment_tells_the_same_of_the_same_types(told: tuple, other_default: None) -> None:
    found, specs = rolled_out()
    assert specs == told[1]
    assert_equal(dict(found.flatten_keys().items()), dict(told[0].flatten_keys().items()))


@pytest.mark.usefixtures("other_default")
def test_networks_of_ones_own_are_of_float32_on_the_cpu() -> None:
    made = [build_actor(measure=PowerLaw()), build_critic(measure=PowerLaw()), build_critic(kind="scalar")]
    tensors = [tensor for module in made for tensor in (*module.parameters(), *module.buffers())]
    assert {(tensor.dtype, tensor.device.type) for tensor in tensors} == {(torch.float32, "cpu")}
    assert torch.empty(()).dtype == torch.get_default_dtype()
