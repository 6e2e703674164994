"""Critics choose among actions around the mean: in a simulation and on a robot alike, by the measure of their beta."""

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from tensordict import TensorDict, TensorDictBase
from tensordict.nn import TensorDictModule, TensorDictModuleBase, TensorDictSequential
from torch import Tensor, nn
from torchrl.envs.utils import ExplorationType, set_exploration_type

from rcdsac_trl.agent.actor import build_critic
from rcdsac_trl.agent.kernels import dispatch
from rcdsac_trl.agent.kernels.compiled_values import CompiledValues
from rcdsac_trl.agent.network_settings import NetworkSettings
from rcdsac_trl.agent.risk import CVaR, PowerLaw, RiskMeasure
from rcdsac_trl.config.training_settings import TrainingSettings
from rcdsac_trl.deploy import Policy
from rcdsac_trl.deploy.policy.acting import ActingSettings
from rcdsac_trl.deploy.policy.distortion import fractions_of
from rcdsac_trl.release.run_weights import weights_of_run
from rcdsac_trl.robot.look_ahead import told_of_action
from rcdsac_trl.rollout.choosing_policy import ChoosingPolicy, LayerValues
from rcdsac_trl.rollout.environments import rollout_worker
from rcdsac_trl.rollout.make_agent import make_loss, make_policy
from rcdsac_trl.rollout.policies import AgentNoise
from tiny import tiny_settings, untrained_run

AGENTS = 3
ACTING = ActingSettings(num_candidates=8, spread=1.5)
REMEMBERS = ["network.restart_steps=2", "sensor.memory_s=12", "network.look_ahead=true"]
OBSERVED = ("range", "waypoint", "velocity", "remembered")
CONTEXTS = {"risk": "beta", "collision_weight": "collision_weight"}


def choosing(
    policy: TensorDictModuleBase,
    critics: Sequence[TensorDictSequential],
    settings: TrainingSettings,
    number: int,
    acting: ActingSettings = ACTING,
) -> ChoosingPolicy:
    algo = settings.algo
    return ChoosingPolicy(policy, critics, acting, measure=algo.distortion.measure, beta=algo.beta, num_agents=number)


class BesideRobots(TensorDictModuleBase):
    """Drives as a policy does, and asks robots what they would do in the place of its agents."""

    def __init__(self, policy: TensorDictModuleBase, robots: Sequence[Policy], context: str | None) -> None:
        super().__init__()
        self.in_keys, self.out_keys = policy.in_keys, policy.out_keys
        self.policy, self.robots, self.context = policy, robots, context
        self.differences: list[float] = []
        self.from_mean: list[float] = []

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        after = self.policy(tensordict)
        for row, robot in enumerate(self.robots):
            told = {} if self.context is None else {CONTEXTS[self.context]: after[self.context][row].item()}
            seen = {key: after[key][row].numpy() for key in OBSERVED if key in after}
            found = after["action"][row].numpy()
            self.differences.append(np.abs(found - robot.act_on(seen, **told)).max())
            self.from_mean.append(np.abs(found - after["loc"][row].tanh().numpy()).max())
        return after


@pytest.mark.parametrize(
    ("row", "more", "acting"),
    [
        ("rcdsac_cvar", REMEMBERS, replace(ACTING, margin_m=0.05)),
        ("dsac_pow", ["learner.num_critics=1"], ACTING),
        ("rcwr", [], ACTING),
        ("sac", REMEMBERS, ACTING),
    ],
)
def test_a_robot_chooses_as_the_simulation_does(
    tmp_path: Path, row: str, more: list[str], acting: ActingSettings
) -> None:
    run, loss, average = untrained_run(tmp_path / "run", row, *more)
    settings, ids = tiny_settings(row, *more), range(AGENTS)
    policy = make_policy(average.module, AgentNoise(ids), "cpu")
    robots = [Policy(weights_of_run(run, "last"), acting=acting) for _ in ids]
    beside = BesideRobots(choosing(policy, loss.critics, settings, AGENTS, acting), robots, settings.algo.context_key)
    worker = rollout_worker(
        settings.training_world,
        settings.algo,
        split="train",
        seed=0,
        agent_ids=ids,
        state_size=settings.network.state_size,
    )
    try:
        with set_exploration_type(ExplorationType.DETERMINISTIC):
            worker.rollout(beside, 0, observed=(), happened=())
    finally:
        worker.close()
    assert len(beside.differences) == AGENTS * settings.task.episode_steps
    # Two actions may be worth the same but for the last bits.
    assert np.mean(np.array(beside.differences) < 1e-5) > 0.95
    assert np.mean(np.array(beside.from_mean) > 1e-3) > 0.5, "the critics have a choice, and make it"


def seen(agents: int, step: int) -> TensorDict:
    generator = torch.Generator().manual_seed(step)
    sizes = {"range": 180, "waypoint": 6, "velocity": 4, "remembered": 90, "recurrent_state": 257}
    given = {key: torch.rand(agents, size, generator=generator) for key, size in sizes.items()}
    begins = torch.zeros(agents, 1, dtype=torch.bool)
    begins[step % agents] = step % 5 == 0
    return TensorDict({**given, "risk": -2.0 * torch.rand(agents, 1, generator=generator), "is_init": begins}, [agents])


def test_what_an_agent_chooses_does_not_depend_on_the_others() -> None:
    settings, number = tiny_settings("rcdsac_pow", *REMEMBERS), 5
    loss = make_loss(settings, "cpu")

    def made(ids: Sequence[int]) -> ChoosingPolicy:
        return choosing(make_policy(loss.actor_network, AgentNoise(ids), "cpu"), loss.critics, settings, len(ids))

    together, alone = made(range(number)), [made([agent]) for agent in range(number)]
    with set_exploration_type(ExplorationType.DETERMINISTIC):
        for step in range(12):
            given = seen(number, step)
            found = together(given.clone())["action"]
            for agent, other in enumerate(alone):
                assert torch.equal(found[agent : agent + 1], other(given[agent : agent + 1].clone())["action"])


# ----------------------------------------------------------------------------------------------- values of many actions
FRACTIONS = torch.from_numpy(fractions_of(8))


def critic_head(kind: str, measure: RiskMeasure | None, look_ahead: bool) -> TensorDictModule:
    torch.manual_seed(3)
    network = NetworkSettings(head=48, look_ahead=look_ahead)
    critic = build_critic(2, {"waypoint": 6, "remembered": 90}, kind, measure, network)  # type: ignore[arg-type]
    return critic[1]  # type: ignore[no-any-return]


def asked(number: int, head: TensorDictModule, measure: RiskMeasure) -> tuple[Tensor, Tensor, Tensor]:
    """Return what heads read, actions and betas of some agents."""
    told = told_of_action(2, head.module.look_ahead is not None)
    memory = torch.rand(number, head.module.input.in_features - told)
    return memory, 2.0 * torch.rand(number, 9, 2) - 1.0, measure.from_uniform(torch.rand(number, 1))


@pytest.mark.parametrize("look_ahead", [True, False])
@pytest.mark.parametrize(
    ("kind", "told", "measure"),
    [
        ("quantile", CVaR(), CVaR()),
        ("quantile", PowerLaw(), PowerLaw()),
        ("quantile", None, PowerLaw()),
        ("scalar", None, CVaR()),
    ],
)
def test_compiled_values_are_the_layers(
    kind: str, told: RiskMeasure | None, measure: RiskMeasure, look_ahead: bool
) -> None:
    head = critic_head(kind, told, look_ahead)
    assert dispatch.has_compiled_values(head.module)
    compiled = CompiledValues(head.module, FRACTIONS, measure)
    layers = LayerValues(head, FRACTIONS, measure)
    memory, actions, betas = asked(4, head, measure)
    with torch.no_grad():
        found = compiled(memory, actions, betas, begins=True)
        torch.testing.assert_close(found, layers(memory, actions, betas, begins=True))
        assert found.std(1).min() > 1e-4  # else all actions are alike here
        rows = zip(memory.split(1), actions.split(1), betas.split(1), strict=True)
        alone = [compiled(*row, begins=False) for row in rows]
        assert torch.equal(found, torch.cat(alone))

        turned = betas.flip(0)
        again = compiled(memory, actions, turned, begins=False)
        torch.testing.assert_close(again, layers(memory, actions, turned, begins=False))
        assert torch.equal(again, found) == (kind == "scalar")

        head.module.output.weight.mul_(2.0)
        torch.testing.assert_close(
            compiled(memory, actions, turned, begins=False), layers(memory, actions, turned, begins=False)
        )


def test_the_layers_of_a_head_that_was_changed_are_asked() -> None:
    head = critic_head("quantile", CVaR(), look_ahead=False)
    head.module.hidden = nn.Sequential(head.module.hidden, nn.LayerNorm(48))
    assert not dispatch.has_compiled_values(head.module)


# ------------------------------------------------------------------------------------------------ a critic made by hand
class Mean(TensorDictModuleBase):
    """Wants to stand, with a standard deviation of 0.5."""

    in_keys = ["range", "risk"]  # noqa: RUF012
    out_keys = ["loc", "scale", "action"]  # noqa: RUF012

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        stand = torch.zeros(*tensordict.batch_size, 2)
        return tensordict.update({"loc": stand, "scale": stand + 0.5, "action": stand})


class NoMemory(nn.Module):
    state_size = 1

    def step(self, range_: Tensor, is_init: Tensor, state: Tensor) -> tuple[Tensor, Tensor]:
        return torch.zeros(len(range_), 1), state


class RiskySpeed(nn.Module):
    """Z at tau = u_0 (gain + 2 tau - 1): more speed, more reward on average, and a worse tail."""

    def __init__(self, gain: float) -> None:
        super().__init__()
        self.gain = gain

    def forward(self, memory: Tensor, action: Tensor, tau: Tensor, risk: Tensor) -> Tensor:
        return action[..., :1] * (self.gain + 2.0 * tau - 1.0)


def risky(gain: float) -> TensorDictSequential:
    return TensorDictSequential(
        TensorDictModule(NoMemory(), in_keys=["range"], out_keys=["memory"]),
        TensorDictModule(RiskySpeed(gain), in_keys=["memory", "action", "tau", "risk"], out_keys=["quantiles"]),
    )


def speeds(gains: Sequence[float], over: str, betas: Sequence[float]) -> list[float]:
    """Return the speed that is chosen at each beta."""
    acting = ActingSettings(num_candidates=32, over_critics=over)
    policy = ChoosingPolicy(
        Mean(), [risky(gain) for gain in gains], acting, measure=PowerLaw(), beta=None, num_agents=len(betas)
    )
    told = {"range": torch.zeros(len(betas), 180), "risk": torch.tensor(betas).unsqueeze(1)}
    told["is_init"] = torch.ones(len(betas), 1, dtype=torch.bool)
    return policy(TensorDict(told, [len(betas)]))["action"][:, 0].tolist()


def test_a_neutral_beta_takes_the_risky_action_and_an_averse_one_does_not() -> None:
    candidates = np.tanh(0.5 * ActingSettings(num_candidates=32).noise()[:, 0])
    # At beta -2 the mean of psi(tau) is 1/4: an action is worth u_0 (0.2 - 0.5); at -0.2 it is 5/11, still worth > 0.
    found = speeds([0.2], "minimum", [0.0, -0.2, -2.0])
    assert found == pytest.approx([candidates.max(), candidates.max(), candidates.min()], abs=1e-6)


def test_the_smaller_of_two_critics_counts_or_their_mean() -> None:
    highest = np.tanh(0.5 * ActingSettings(num_candidates=32).noise()[:, 0]).max()
    # One gains by speed, the other loses more: the minimum is largest where both say 0, at the mean action.
    assert speeds([0.5, -0.3], "minimum", [0.0]) == [0.0]
    assert speeds([0.5, -0.3], "mean", [0.0]) == pytest.approx([highest], abs=1e-6)
