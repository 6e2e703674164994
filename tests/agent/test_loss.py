"""The loss against hand-computed numbers, TorchRL's own SAC, and TorchRL's idiom."""

import copy
import math
from collections.abc import Callable
from dataclasses import replace
from typing import Any, Literal

import pytest
import torch
from tensordict import TensorDict, TensorDictBase
from tensordict.nn import NormalParamExtractor, TensorDictModule, TensorDictSequential
from torch import Tensor, nn
from torchrl.data import Bounded
from torchrl.modules import ProbabilisticActor, TanhNormal, ValueOperator
from torchrl.objectives import SACLoss, SoftUpdate
from torchrl.objectives.utils import ValueEstimators

from rcdsac_trl.agent.actor import build_actor, build_critic
from rcdsac_trl.agent.loss.distributional_sac import DistributionalSACLoss
from rcdsac_trl.agent.loss.functional import _quantile_huber_pairwise, quantile_huber_loss, squash
from rcdsac_trl.agent.loss.loss_settings import LossSettings
from rcdsac_trl.agent.loss.samples import LossSamples
from rcdsac_trl.agent.loss.target_updates import FusedSoftUpdate
from rcdsac_trl.agent.networks import NetworkSettings
from rcdsac_trl.agent.risk import CVaR, Neutral, PowerLaw, RiskMeasure
from rcdsac_trl.robot.observation import VECTOR_OBSERVATIONS

SMALL = NetworkSettings(conv=4, range=8, vector=4, memory=6, head=5, cosines=7)
LOSSES = ("loss_actor", "loss_qvalue", "loss_alpha")
#: Of the losses computed by hand.
LINEAR = LossSettings(
    num_quantiles=3, num_target_quantiles=2, num_risk_samples=4, fractions_per="sequence", alpha_init=0.2
)
Reduction = Literal["mean", "sum", "none"]


@pytest.fixture(autouse=True)
def _seed() -> None:
    torch.manual_seed(0)


def make_batch(sequences: int = 3, steps: int = 4, beta: float | None = None) -> TensorDict:
    shape = (sequences, steps + 1)
    content = {"range": torch.rand(*shape, 180)} | {k: torch.randn(*shape, n) for k, n in VECTOR_OBSERVATIONS.items()}
    content["action"] = 2.0 * torch.rand(*shape, 2) - 1.0
    content["risk"] = torch.full((*shape, 1), beta) if beta is not None else -2.0 * torch.rand(*shape, 1)
    content["next"] = {"reward": torch.randn(*shape, 1), "terminated": torch.rand(*shape, 1) < 0.3}
    return TensorDict(content, batch_size=shape)


def make_loss(
    kind: str = "rcdsac", number: int = 2, *, reduction: Reduction = "mean", **settings: Any
) -> DistributionalSACLoss:
    measure = PowerLaw()
    told = measure if kind == "rcdsac" else None
    critic = "scalar" if kind == "sac" else "quantile"
    loss = DistributionalSACLoss(
        build_actor(2, VECTOR_OBSERVATIONS, told, SMALL),
        [build_critic(2, VECTOR_OBSERVATIONS, critic, told, SMALL) for _ in range(number)],
        LossSettings(**settings),
        measure=measure,
        reduction=reduction,
        generator=torch.Generator().manual_seed(3),
    )
    loss.make_value_estimator(gamma=0.9)
    SoftUpdate(loss, eps=0.99)
    return loss


# ------------------------------------------------------------------------------------------------ pure functions
def test_quantile_huber_by_hand() -> None:
    # delta = 2 (beyond kappa) and -0.5 (inside); fractions 0.25 and 0.75; two targets each.
    quantiles = torch.tensor([0.0, 2.0], requires_grad=True)
    targets, tau = torch.tensor([2.0, -0.5]), torch.tensor([0.25, 0.75])
    # i=1: delta 2 -> 0.25 * 1.5, delta -0.5 -> 0.75 * 0.125; i=2: delta 0 -> 0, delta -2.5 -> 0.25 * 2.0
    expected = ((0.25 * 1.5 + 0.75 * 0.125) + (0.0 + 0.25 * 2.0)) / 2.0
    loss = quantile_huber_loss(quantiles, targets, tau)
    assert loss.item() == pytest.approx(expected)
    loss.backward()
    # slope -delta inside and -sign(delta) beyond, times the weight
    assert quantiles.grad is not None
    assert quantiles.grad.tolist() == pytest.approx([(-0.25 * 1.0 + 0.75 * 0.5) / 2.0, 0.25 * 1.0 / 2.0])


def test_quantile_huber_sums_over_predictions_and_averages_over_targets() -> None:
    quantiles, targets, tau = torch.randn(2, 3, 4), torch.randn(2, 3, 5), torch.rand(2, 1, 4)
    for kappa in (0.3, 1.0, 5.0):
        expected = torch.zeros(2, 3)
        for b in range(2):
            for t in range(3):
                for i in range(4):
                    for j in range(5):
                        x = float(targets[b, t, j] - quantiles[b, t, i])
                        huber = 0.5 * x * x if abs(x) <= kappa else kappa * (abs(x) - 0.5 * kappa)
                        expected[b, t] += abs(float(tau[b, 0, i]) - (x < 0)) * huber / kappa / 5
        torch.testing.assert_close(quantile_huber_loss(quantiles, targets, tau, kappa), expected)


@pytest.mark.parametrize("kappa", [0.3, 1.0])
def test_quantile_huber_kernel_equals_ordinary_operations(kappa: float) -> None:
    quantiles = torch.randn(3, 5, 4, dtype=torch.float64, requires_grad=True)
    targets, tau = torch.randn(3, 5, 6, dtype=torch.float64), torch.rand(3, 1, 4, dtype=torch.float64)
    found, expected = (f(quantiles, targets, tau, kappa) for f in (quantile_huber_loss, _quantile_huber_pairwise))
    torch.testing.assert_close(found, expected)
    weights = torch.rand(3, 5, dtype=torch.float64)
    slopes = [torch.autograd.grad((loss * weights).sum(), quantiles)[0] for loss in (found, expected)]
    torch.testing.assert_close(*slopes)
    assert torch.autograd.gradcheck(lambda q: quantile_huber_loss(q, targets, tau, kappa), (quantiles,))


def test_quantile_huber_is_least_at_the_quantile() -> None:
    """With a small kappa the loss is the quantile loss: over 1..100 its minimum at tau = 0.8 lies at 80."""
    targets, candidates = torch.arange(1.0, 101.0), torch.arange(1.0, 101.0).unsqueeze(-1)
    loss = quantile_huber_loss(candidates, targets.expand(100, -1), torch.tensor([0.8]), kappa=1e-3)
    assert candidates[loss.argmin()].item() == 80.0


def test_squash_is_torchrls_tanh_normal() -> None:
    loc, scale = 3.0 * torch.randn(50, 2, requires_grad=True), torch.rand(50, 2) + 0.1
    noise = torch.randn(50, 2)
    action, log_prob = squash(loc, scale, noise)
    distribution = TanhNormal(loc, scale)
    expected = distribution.base_dist.log_prob(loc + scale * noise) - distribution._t.log_abs_det_jacobian(
        loc + scale * noise, action
    ).sum(-1)
    torch.testing.assert_close(action, (loc + scale * noise).tanh())
    torch.testing.assert_close(log_prob, expected)
    # Far out, tanh is 1 in float32 and log(1 - tanh^2) would be -inf.
    _, far = squash(torch.tensor([[30.0]], requires_grad=True), torch.ones(1, 1), torch.zeros(1, 1))
    assert far.item() == pytest.approx(-0.5 * math.log(2 * math.pi) - 2 * math.log(2) + 60.0, rel=1e-6)


# ------------------------------------------------------------------------------------------------ by hand
class Passes(nn.Module):
    """An encoder that remembers a multiple of the observation."""

    def __init__(self, factor: float) -> None:
        super().__init__()
        self.factor = nn.Parameter(torch.tensor(factor))

    def forward(self, observation: Tensor) -> Tensor:
        return self.factor * observation


class LinearActor(nn.Module):
    def __init__(self) -> None:
        super().__init__()
        self.slope = nn.Parameter(torch.tensor(0.3))
        self.log_scale = nn.Parameter(torch.tensor(-0.5))

    def forward(self, memory: Tensor, risk: Tensor) -> tuple[Tensor, Tensor]:
        loc = self.slope * memory + 0.1 * risk
        return loc, self.log_scale.exp().expand_as(loc)


class LinearCritic(nn.Module):
    def __init__(self, slope: float) -> None:
        super().__init__()
        self.slope = nn.Parameter(torch.tensor(slope))

    def forward(self, memory: Tensor, action: Tensor, tau: Tensor, risk: Tensor) -> Tensor:
        return memory + self.slope * action + tau * (2.0 + risk)


def linear_loss(*, reduction: Reduction = "mean", **settings: Any) -> DistributionalSACLoss:
    def network(factor: float, head: nn.Module, in_keys: list[str], out_keys: list[str]) -> TensorDictSequential:
        return TensorDictSequential(
            TensorDictModule(Passes(factor), in_keys=["observation"], out_keys=["memory"]),
            TensorDictModule(head, in_keys=["memory", *in_keys], out_keys=out_keys),
        )

    keys = ["action", "tau", "risk"]
    loss = DistributionalSACLoss(
        network(1.0, LinearActor(), ["risk"], ["loc", "scale"]),
        [network(f, LinearCritic(s), keys, ["quantiles"]) for f, s in ((0.5, 0.7), (0.8, -0.4))],
        replace(LINEAR, **settings),
        measure=CVaR(),
        reduction=reduction,
        generator=torch.Generator().manual_seed(11),
    )
    loss.make_value_estimator(gamma=0.9)
    SoftUpdate(loss, eps=0.99)
    return loss


def linear_batch() -> TensorDict:
    content = {
        "observation": torch.randn(2, 3, 1),
        "action": torch.rand(2, 3, 1),
        "risk": torch.tensor([[[0.3], [0.6], [0.9]], [[1.0], [0.2], [0.5]]]),
        "next": {
            "reward": torch.randn(2, 3, 1),
            "terminated": torch.tensor([[0, 1, 0], [0, 0, 0]]).bool().unsqueeze(-1),
        },
    }
    return TensorDict(content, batch_size=(2, 3))


def by_hand(batch: TensorDictBase, over_critics: str = "minimum") -> tuple[dict[str, Tensor], dict[str, Tensor]]:
    """Compute the linear networks' losses of each transition in scalar arithmetic, from the same random numbers."""
    g = torch.Generator().manual_seed(11)
    next_noise = torch.randn((2, 2, 1), generator=g)
    tau_target, tau = torch.rand((2, 1, 2), generator=g), torch.rand((2, 1, 3), generator=g)
    noise, tau_risk = torch.randn((2, 2, 1), generator=g), torch.rand((2, 1, 4), generator=g)
    p = {k: torch.tensor(v, requires_grad=True) for k, v in (("a", 1.0), ("s", 0.3), ("l", -0.5), ("f0", 0.5))}
    p |= {k: torch.tensor(v, requires_grad=True) for k, v in (("f1", 0.8), ("c0", 0.7), ("c1", -0.4))}
    p["log_alpha"] = torch.tensor(math.log(0.2), requires_grad=True)

    def sample(o: Tensor, beta: Tensor, eps: Tensor) -> tuple[Tensor, Tensor]:
        x = p["s"] * p["a"] * o + 0.1 * beta + p["l"].exp() * eps
        log_normal = -0.5 * eps**2 - p["l"] - 0.5 * math.log(2 * math.pi)
        return x.tanh(), log_normal - torch.log(1 - x.tanh() ** 2)

    def z(k: int, o: Tensor, a: Tensor, t: Tensor, beta: Tensor, frozen: bool = False) -> Tensor:
        f, c = (p[f"f{k}"].detach(), p[f"c{k}"].detach()) if frozen else (p[f"f{k}"], p[f"c{k}"])
        return f * o + c * a + t * (2.0 + beta)

    out: dict[str, list[Tensor]] = {key: [] for key in LOSSES}
    for b in range(2):
        for t in range(2):
            o, o2, beta = batch["observation"][b, t, 0], batch["observation"][b, t + 1, 0], batch["risk"][b, t, 0]
            with torch.no_grad():
                a2, log_prob2 = sample(o2, beta, next_noise[b, t, 0])
                targets = []
                for tt in tau_target[b, 0]:
                    both = z(0, o2, a2, tt, beta), z(1, o2, a2, tt, beta)
                    # These two never cross along tau, so that the smaller one is the minimum.
                    value = (both[0] + both[1]) / 2 if over_critics == "mean" else torch.minimum(*both)
                    value = value - 0.2 * log_prob2
                    alive = 0.0 if batch["next", "terminated"][b, t, 0] else 1.0
                    targets.append(batch["next", "reward"][b, t, 0] + 0.9 * alive * value)
            q = torch.zeros(())
            for k in range(2):
                for ti in tau[b, 0]:
                    for target in targets:
                        x = target - z(k, o, batch["action"][b, t, 0], ti, beta)
                        huber = 0.5 * x**2 if abs(x) <= 1 else abs(x) - 0.5
                        q = q + (ti - (x < 0).float()).abs() * huber / 2
            out["loss_qvalue"].append(q)
            a, log_prob = sample(o, beta, noise[b, t, 0])
            values = [
                torch.stack([z(k, o, a, beta * ti, beta, True) for ti in tau_risk[b, 0]]).mean() for k in range(2)
            ]
            out["loss_actor"].append(0.2 * log_prob - torch.minimum(*values))
            out["loss_alpha"].append(-p["log_alpha"] * (log_prob.detach() - 2.0))
    return {key: torch.stack(value).view(2, 2) for key, value in out.items()}, p


@pytest.mark.parametrize("over_critics", ["minimum", "smaller", "mean"])
def test_losses_and_gradients_by_hand(over_critics: str) -> None:
    batch = linear_batch()
    loss = linear_loss(reduction="none", target_over_critics=over_critics)
    expected, p = by_hand(batch, over_critics)
    found = loss(batch)
    for key in LOSSES:
        torch.testing.assert_close(found[key], expected[key])
    sum(expected[key].sum() for key in LOSSES).backward()
    sum(found[key].sum() for key in LOSSES).backward()
    actor, critics = loss.actor_network_params, loss.critic_network_params
    pairs = [(actor["module", "0", "module", "factor"], "a"), (actor["module", "1", "module", "slope"], "s")]
    pairs += [(actor["module", "1", "module", "log_scale"], "l"), (loss.log_alpha, "log_alpha")]
    for k in range(2):
        pairs.append((critics[str(k), "module", "0", "module", "factor"], f"f{k}"))
        pairs.append((critics[str(k), "module", "1", "module", "slope"], f"c{k}"))
    for parameter, name in pairs:
        torch.testing.assert_close(parameter.grad, p[name].grad)


def test_reduction() -> None:
    batch = linear_batch()
    none, mean, total = (linear_loss(reduction=r)(batch) for r in ("none", "mean", "sum"))
    assert none.batch_size == (2, 2)
    for key in LOSSES:
        torch.testing.assert_close(mean[key], none[key].mean())
        torch.testing.assert_close(total[key], none[key].sum())
    assert all(value.shape == (2, 2) for value in none.values())
    assert all(value.shape == () for value in mean.values())


def test_diagnostics() -> None:
    batch = linear_batch()
    out = linear_loss()(batch)
    assert set(out.keys()) == set(linear_loss().out_keys)
    assert out["alpha"].item() == pytest.approx(0.2)
    # d(loss_alpha)/d(log alpha) = entropy - target entropy = entropy + 2
    assert out["loss_alpha"].item() == pytest.approx(math.log(0.2) * (out["entropy"].item() + 2.0), rel=1e-5)
    spread = (2.0 + batch["risk"][:, :-1, 0]) * _fractions_of_the_prediction().std(-1, correction=0)
    assert out["quantile_spread"].item() == pytest.approx(spread.mean().item(), rel=1e-5)
    assert not any(out[key].requires_grad for key in out.keys() if key not in LOSSES)  # noqa: SIM118


def _fractions_of_the_prediction() -> Tensor:
    g = torch.Generator().manual_seed(11)
    torch.randn((2, 2, 1), generator=g)
    torch.rand((2, 1, 2), generator=g)
    return torch.rand((2, 1, 3), generator=g)


@pytest.mark.parametrize("per", ["sequence", "transition"])
def test_one_beta_expanded_is_the_same_as_repeated(per: str) -> None:
    repeated = make_batch(beta=-1.5)
    expanded = repeated.clone()
    expanded["risk"] = repeated["risk"][:, :1].expand(-1, repeated.shape[1], -1)
    assert expanded["risk"].stride(1) == 0 != repeated["risk"].stride(1)
    loss = make_loss(fractions_per=per, reduction="none")
    shared = loss(expanded)
    loss.rng_state = torch.Generator().manual_seed(3).get_state()
    for key, value in loss(repeated).items():
        torch.testing.assert_close(shared[key], value)


# ------------------------------------------------------------------------------------------------ structure
@pytest.mark.parametrize("kind", ["rcdsac", "dsac", "sac"])
@pytest.mark.parametrize("number", [1, 2])
def test_each_loss_trains_its_own_parameters(kind: str, number: int) -> None:
    loss, batch = make_loss(kind, number), make_batch()
    owners = {"loss_actor": "actor_network_params", "loss_qvalue": "critic_network_params", "loss_alpha": "log_alpha"}
    for key, owner in owners.items():
        loss.zero_grad()
        loss(batch)[key].backward()
        for name, parameter in loss.named_parameters():
            if name.startswith(owner):
                assert parameter.grad is not None, name
                assert name == "log_alpha" or "hidden" not in name or parameter.grad.abs().sum() > 0, name
            else:
                assert parameter.grad is None, name
    assert not any(p.requires_grad for p in loss.target_critic_network_params.values(True, True))
    # The actor's loss goes through the critics: what it would add to their gradients is not even computed.
    for moved in (loss, copy.deepcopy(loss), loss.to(torch.float64)):
        assert not any(p.requires_grad for critic in moved.frozen_critics for p in critic.parameters())


def test_every_parameter_is_trained() -> None:
    loss = make_loss()
    out = loss(make_batch())
    sum(out[key] for key in LOSSES).backward()
    assert all(p.grad is not None for p in loss.parameters())
    encoders = [n for n, p in loss.named_parameters() if "conv_1.weight" in n and p.grad.abs().sum() > 0]
    assert len(encoders) == 3  # one for the actor and one for each critic


@pytest.mark.parametrize("kind", ["rcdsac", "sac"])
def test_the_last_slots_outcome_is_ignored(kind: str) -> None:
    batch = make_batch()
    other = batch.clone()
    for key in ("action", "risk", ("next", "reward")):
        other[key][:, -1] = math.nan
    other["next", "terminated"][:, -1] ^= True
    first, second = make_loss(kind, reduction="none"), make_loss(kind, reduction="none")
    second.load_state_dict(first.state_dict())
    assert (first(batch) == second(other)).all()


def test_burn_in_drops_the_first_transitions_and_keeps_their_memory() -> None:
    batch = make_batch(steps=5, beta=-1.0)
    loss = make_loss(burn_in=3, reduction="none")
    found = loss(batch)
    assert found.batch_size == (3, 2)
    other = batch.clone()
    other["action"][:, :3] = 0.0
    other["next", "reward"][:, :3] = 9.0
    loss.rng_state = torch.Generator().manual_seed(3).get_state()
    assert (loss(other) == found).all()
    other["range"][:, 0] = 0.0  # but what was seen is remembered
    loss.rng_state = torch.Generator().manual_seed(3).get_state()
    assert not (loss(other) == found).all()


def test_no_bootstrap_beyond_termination() -> None:
    batch = make_batch(beta=-1.0)
    batch["next", "terminated"][:] = True
    loss = make_loss(num_target_quantiles=5)
    target = loss.compute_target(batch, loss.encode_actor(batch), loss.draw_samples(batch))
    torch.testing.assert_close(target, batch["next", "reward"][:, :-1].expand(3, 4, 5))


def test_n_step_targets_by_hand() -> None:
    """Rewards and entropies of the steps on the way, gamma^m for what comes then, and fewer steps at the end."""
    gamma, steps, n = 0.9, 4, 3
    batch = make_batch(steps=steps)
    batch["next", "terminated"][:] = False
    batch["next", "terminated"][0, 1] = True

    def target(**settings: Any) -> Tensor:
        loss.settings, loss.log_alpha.data = LossSettings(**settings), torch.tensor(math.log(alpha))
        loss.rng_state = torch.Generator().manual_seed(5).get_state()
        return loss.compute_target(batch, loss.encode_actor(batch), loss.draw_samples(batch))

    loss, never = make_loss(num_target_quantiles=2), batch["next", "terminated"].clone()
    alpha, reward = 1e-30, batch["next", "reward"][:, :-1]
    batch["next", "terminated"][:] = False
    value = (target(num_target_quantiles=2) - reward) / gamma  # of what each step leads to
    alpha = 0.2
    entropy = (target(num_target_quantiles=2) - reward) / gamma - value
    batch["next", "terminated"] = never
    found = target(num_target_quantiles=2, n_steps=n)

    for b in range(3):
        for t in range(steps):
            expected, discount = torch.zeros(2), 1.0
            for k in range(t, min(t + n, steps)):
                expected += discount * reward[b, k]
                discount *= gamma * (not never[b, k].item())
                expected += discount * entropy[b, k]
            expected += discount * value[b, k]
            torch.testing.assert_close(found[b, t], expected)


def test_a_constant_beta_collapses_to_the_same_losses() -> None:
    batch = make_batch(beta=-0.7)
    loss = make_loss(reduction="none")
    found = loss(batch)
    loss.rng_state = torch.Generator().manual_seed(3).get_state()
    loss._risk = lambda batch: batch["risk"][:, :-1]  # type: ignore[method-assign]
    for key, value in loss(batch).items():
        torch.testing.assert_close(value, found[key], rtol=1e-5, atol=1e-6)


def test_fractions_per_transition_and_per_sequence() -> None:
    shapes = {}
    for per in ("sequence", "transition"):
        loss = make_loss(fractions_per=per, num_quantiles=7)
        fractions = loss.draw_samples(make_batch()).tau
        assert fractions is not None
        shapes[per] = fractions.shape
        assert torch.isfinite(loss(make_batch())["loss_qvalue"])
    assert shapes == {"sequence": (3, 1, 7), "transition": (3, 4, 7)}


def test_stratified_fractions_fall_into_a_part_each_and_are_uniform_in_it() -> None:
    numbers = {"num_quantiles": 7, "num_target_quantiles": 4, "num_risk_samples": 2}
    loss = make_loss(fractions_per="sequence", fraction_sampling="stratified", **numbers)
    batch = make_batch().repeat(400, 1)
    samples = loss.draw_samples(batch)
    for fractions, number in ((samples.tau, 7), (samples.next_tau, 4), (samples.risk_tau, 2)):
        assert fractions is not None
        assert fractions.shape == (1200, 1, number)
        within = number * fractions - torch.arange(number)
        assert bool(((within >= -1e-6) & (within <= 1 + 1e-6)).all())
        # Of 1,200 uniform numbers the mean lies within 0.5 +- 6 x 0.289 / sqrt(1200), the variance near 1/12.
        assert (within.mean((0, 1)) - 0.5).abs().max() < 0.05
        assert (within.var((0, 1)) - 1 / 12).abs().max() < 0.015
    assert torch.isfinite(loss(batch)["loss_qvalue"])


def test_current_and_next_step_share_their_transitions_beta() -> None:
    """Beta of slot t must act on the transition from t to t+1 and on no other."""
    batch = make_batch(steps=4)
    loss = make_loss(reduction="none")
    found = loss(batch)
    other = batch.clone()
    other["risk"][:, 2] = -0.123
    loss.rng_state = torch.Generator().manual_seed(3).get_state()
    changed = loss(other)
    for key in ("loss_actor", "loss_qvalue"):
        same = torch.isclose(changed[key], found[key], rtol=1e-4).all(0).tolist()
        assert same == [True, True, False, True]


def test_neutral_measure_and_risk_free_networks_ignore_beta() -> None:
    batch = make_batch()
    loss = make_loss("dsac", reduction="none")
    loss.measure = Neutral()
    found = loss(batch)
    loss.rng_state = torch.Generator().manual_seed(3).get_state()
    torch.testing.assert_close(loss(batch.clone().set("risk", torch.zeros(3, 5, 1))), found)


def test_dsac_is_told_beta_by_the_measure_alone() -> None:
    batch = make_batch(beta=-2.0)
    loss = make_loss("dsac", reduction="none")
    averse = loss(batch)
    loss.rng_state = torch.Generator().manual_seed(3).get_state()
    neutral = loss(make_batch_like(batch, 0.0))
    torch.testing.assert_close(averse["loss_qvalue"], neutral["loss_qvalue"])
    assert not torch.allclose(averse["loss_actor"], neutral["loss_actor"])


def test_distortion_strength_tempers_beta_in_the_distortion_alone() -> None:
    """At strength 0 the actor's loss is that of the mean, though the networks are still told every beta."""
    loss, batch = make_loss(fractions_per="sequence"), make_batch()
    state = loss.rng_state

    def losses(strength: float, measure: RiskMeasure, batch: TensorDict) -> TensorDictBase:
        loss.rng_state, loss.distortion_strength, loss.measure = state, strength, measure
        return loss(batch)

    neutral = losses(0.0, PowerLaw(), batch)
    full = losses(1.0, PowerLaw(), batch)
    torch.testing.assert_close(neutral["loss_actor"], losses(1.0, Neutral(), batch)["loss_actor"])
    assert (neutral["loss_actor"] - full["loss_actor"]).abs() > 1e-4
    assert torch.equal(neutral["loss_qvalue"], full["loss_qvalue"])
    told_nothing = losses(0.0, PowerLaw(), make_batch_like(batch, 0.0))
    assert (neutral["loss_actor"] - told_nothing["loss_actor"]).abs() > 1e-4


def make_batch_like(batch: TensorDict, beta: float) -> TensorDict:
    return batch.clone().set("risk", torch.full_like(batch["risk"], beta))


# ------------------------------------------------------------------------------------------------ TorchRL's idiom
def test_nested_keys_and_set_keys() -> None:
    def network(factor: float, head: nn.Module, in_keys: list, out_keys: list) -> TensorDictSequential:
        return TensorDictSequential(
            TensorDictModule(Passes(factor), in_keys=[("agents", "observation")], out_keys=[("agents", "memory")]),
            TensorDictModule(head, in_keys=[("agents", "memory"), *in_keys], out_keys=out_keys),
        )

    keys = [("agents", "u"), ("agents", "fraction"), ("agents", "beta")]
    loss = DistributionalSACLoss(
        network(1.0, LinearActor(), [("agents", "beta")], [("agents", "mu"), ("agents", "sigma")]),
        [network(f, LinearCritic(s), keys, [("agents", "z")]) for f, s in ((0.5, 0.7), (0.8, -0.4))],
        LINEAR,
        measure=CVaR(),
        generator=torch.Generator().manual_seed(11),
    )
    loss.set_keys(action=("agents", "u"), risk=("agents", "beta"), tau=("agents", "fraction"))
    loss.make_value_estimator(gamma=0.9)
    loss.set_keys(reward=("agents", "r"), terminated=("agents", "over"))
    SoftUpdate(loss, eps=0.99)
    batch = linear_batch()
    moved = TensorDict(batch_size=batch.batch_size)
    for old, new in [("observation", "observation"), ("action", "u"), ("risk", "beta")]:
        moved["agents", new] = batch[old]
    moved["next", "agents", "r"] = batch["next", "reward"]
    moved["next", "agents", "over"] = batch["next", "terminated"]
    assert set(loss.in_keys) == set(moved.keys(True, True))
    expected = linear_loss()(batch)
    assert (loss(moved) == expected).all()
    with pytest.raises(ValueError, match="not an accepted tensordict key"):
        loss.set_keys(colour="red")


def test_only_td0() -> None:
    with pytest.raises(NotImplementedError):
        linear_loss().make_value_estimator(ValueEstimators.TDLambda)


@pytest.mark.parametrize("kind", [SoftUpdate, FusedSoftUpdate])
def test_soft_update_moves_the_targets(kind: type[SoftUpdate]) -> None:
    loss = make_loss()
    updater = kind(loss, eps=0.9)
    online, target = loss.critic_network_params, loss.target_critic_network_params
    with torch.no_grad():
        for parameter in online.parameters():
            parameter.add_(1.0)
    before = target.clone()
    updater.step()
    for key, parameter in online.items(True, True):
        moved = 0.1 if isinstance(parameter, nn.Parameter) else 0.0  # the cosines' frequencies are no parameter
        torch.testing.assert_close(target[key], before[key] + moved)
    out = loss(make_batch())
    assert torch.isfinite(out["loss_qvalue"])


def _same(loss: DistributionalSACLoss) -> DistributionalSACLoss:
    return loss


def _restored(loss: DistributionalSACLoss) -> DistributionalSACLoss:
    other = make_loss()
    other.load_state_dict(loss.state_dict())
    return other


@pytest.mark.parametrize("made", [_same, _restored, copy.deepcopy, lambda loss: loss.double().float()])
def test_targets_come_from_the_target_parameters(
    made: Callable[[DistributionalSACLoss], DistributionalSACLoss],
) -> None:
    """Whatever has become of a loss, its target critics hold its target parameters, and they alone make targets."""
    loss, batch = made(make_loss()), make_batch()

    def target() -> Tensor:
        loss.rng_state = torch.Generator().manual_seed(3).get_state()
        return loss.compute_target(batch, loss.encode_actor(batch), loss.draw_samples(batch))

    before = target()
    for parameter in loss.critic_network_params.parameters():
        parameter.data.mul_(1.5)
    assert torch.equal(target(), before)
    for key, parameter in loss.target_critic_network_params.items(True, True):
        if "output" in key:
            parameter.data.zero_()
    log_prob_alone = target()
    assert not torch.allclose(log_prob_alone, before)
    assert torch.equal(log_prob_alone, log_prob_alone[..., :1].expand_as(before))
    loss.actor_network_params["module", "1", "module", "output", "bias"].data.add_(1.0)
    assert not torch.allclose(target(), log_prob_alone)


def test_random_numbers_come_from_the_losses_generator() -> None:
    batch, before = make_batch(), torch.random.get_rng_state()
    loss = make_loss()
    after_init = torch.random.get_rng_state()
    first, second = loss(batch), loss(batch)
    assert torch.equal(torch.random.get_rng_state(), after_init)
    assert not torch.equal(before, after_init)  # weights are drawn from torch's global generator, nothing else is
    assert first["loss_qvalue"] != second["loss_qvalue"]
    state = loss.rng_state
    third = loss(batch)
    loss.rng_state = state
    assert (loss(batch) == third).all()


def test_state_dict_continues_bit_for_bit() -> None:
    batch = make_batch()
    loss, resumed = make_loss(), make_loss()
    optimizer = torch.optim.Adam(loss.parameters(), lr=1e-2)
    for _ in range(3):
        optimizer.zero_grad()
        sum(loss(batch)[key] for key in LOSSES).backward()
        optimizer.step()
    resumed.load_state_dict(loss.state_dict())
    copied = copy.deepcopy(loss)
    with torch.no_grad():
        for module in (loss, resumed, copied):
            for parameter in module.parameters():
                parameter.mul_(1.1)
    expected = loss(batch)
    assert (resumed(batch) == expected).all()
    assert (copied(batch) == expected).all()


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"number": 0}, "at least one critic"),
        ({"num_quantiles": 0}, "loss.num_quantiles=0 is not a number of at least 1"),
        ({"alpha_init": 0.0}, "loss.alpha_init=0.0 is not a positive number"),
        ({"n_steps": 0}, "loss.n_steps=0 is not a number of at least 1"),
        ({"kappa": -1.0}, "loss.kappa=-1.0 is not a positive number"),
        ({"kappa": math.inf}, "loss.kappa=inf is not a positive number"),
        ({"burn_in": -1}, "loss.burn_in=-1 is not a number of at least 0"),
        ({"fractions_per": "batch"}, "loss.fractions_per=batch is unknown: choose one of transition, sequence"),
        ({"fraction_sampling": "sobol"}, "choose one of uniform, stratified"),
        ({"target_over_critics": "maximum"}, "choose one of minimum, smaller, mean"),
        ({"reduction": "median"}, "'mean', 'sum' or 'none'"),
    ],
)
def test_wrong_arguments(settings: dict, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        make_loss(**settings)


def test_quantile_critics_need_a_measure() -> None:
    with pytest.raises(ValueError, match="need a risk measure"):
        DistributionalSACLoss(build_actor(), [build_critic()])


@pytest.mark.parametrize("shape", [(3, 1), (3,), (2, 3, 5)])
def test_wrong_batches(shape: tuple[int, ...]) -> None:
    batch = TensorDict({"range": torch.rand(*shape, 180)}, batch_size=shape)
    with pytest.raises(ValueError, match="expected a batch"):
        make_loss()(batch)


# ------------------------------------------------------------------------------------------------ TorchRL's SAC
class Columns(nn.Module):
    """A feed-forward network on concatenated columns, for both losses."""

    def __init__(self, size: int, outputs: int) -> None:
        super().__init__()
        self.layers = nn.Sequential(nn.Linear(size, 8), nn.Tanh(), nn.Linear(8, outputs))

    def forward(self, *columns: Tensor) -> Tensor:
        return self.layers(torch.cat(columns, dim=-1))


class Policy(nn.Module):
    def __init__(self) -> None:
        super().__init__()
        self.columns, self.split = Columns(3, 4), NormalParamExtractor()

    def forward(self, observation: Tensor) -> tuple[Tensor, Tensor]:
        return self.split(self.columns(observation))


def test_scalar_mode_equals_torchrls_sac() -> None:
    """Same weights, batch and noise: one-step sequences with an encoder that passes the observation on."""
    policy, critics = Policy(), [Columns(5, 1), Columns(5, 1)]
    their_policy = copy.deepcopy(policy)
    theirs = SACLoss(
        ProbabilisticActor(
            TensorDictModule(their_policy, in_keys=["observation"], out_keys=["loc", "scale"]),
            in_keys=["loc", "scale"],
            spec=Bounded(-1, 1, (2,)),
            distribution_class=TanhNormal,
        ),
        [ValueOperator(copy.deepcopy(c), in_keys=["observation", "action"]) for c in critics],
        alpha_init=0.3,
        target_entropy=-2.0,
        loss_function="l2",  # without the half
    )
    theirs.make_value_estimator(gamma=0.9)

    def network(head: nn.Module, in_keys: list[str], out_keys: list[str]) -> TensorDictSequential:
        return TensorDictSequential(
            TensorDictModule(nn.Identity(), in_keys=["observation"], out_keys=["memory"]),
            TensorDictModule(head, in_keys=["memory", *in_keys], out_keys=out_keys),
        )

    generator = torch.Generator().manual_seed(5)
    ours = DistributionalSACLoss(
        network(policy, [], ["loc", "scale"]),
        [network(critic, ["action"], ["state_action_value"]) for critic in critics],
        LossSettings(alpha_init=0.3),
        generator=generator,
    ).make_value_estimator(gamma=0.9)
    for loss in (theirs, ours):  # targets that differ from the online critics
        updater = SoftUpdate(loss, eps=0.5)
        params = loss.qvalue_network_params if loss is theirs else loss.critic_network_params
        with torch.no_grad():
            for value in params.values(True, True):
                value.mul_(1.5)
        updater.step()
    number = 40
    transition = TensorDict(
        {
            "observation": torch.randn(number, 3),
            "action": 2.0 * torch.rand(number, 2) - 1.0,
            "next": {
                "observation": torch.randn(number, 3),
                "reward": torch.randn(number, 1),
                "terminated": torch.rand(number, 1) < 0.2,
                "done": torch.zeros(number, 1, dtype=torch.bool),
            },
        },
        batch_size=[number],
    )
    sequence = TensorDict(batch_size=[number, 2])
    sequence["observation"] = torch.stack((transition["observation"], transition["next", "observation"]), dim=1)
    for key in ("action", ("next", "reward"), ("next", "terminated")):
        sequence[key] = torch.stack((transition[key], transition[key]), dim=1)
    torch.manual_seed(5)  # both draw the next action's noise first, then the action's
    expected, found = theirs(transition), ours(sequence)
    expected["loss_qvalue"] = 0.5 * expected["loss_qvalue"]
    for key in (*LOSSES, "alpha", "entropy"):
        torch.testing.assert_close(found[key], expected[key], rtol=1e-5, atol=1e-6)
    for losses in (expected, found):
        sum(losses[key] for key in LOSSES).backward()
    for mine, other in zip(policy.parameters(), their_policy.parameters(), strict=True):
        torch.testing.assert_close(mine.grad, other.grad)
    for k, critic in enumerate(critics):
        torch.testing.assert_close(
            critic.layers[0].weight.grad, theirs.qvalue_network_params["module", "layers", "0", "weight"].grad[k]
        )
    torch.testing.assert_close(ours.log_alpha.grad, theirs.log_alpha.grad)


def test_a_scalar_critic_learns_the_mean_of_a_rare_collision() -> None:
    """Of a target that is 0, and -10 in one case of twenty, the error is least at the mean, -0.5."""
    loss = make_loss("sac")
    target = torch.zeros(1, 20, 1)
    target[0, 0] = -10.0
    value = torch.zeros(1, 1, 1, requires_grad=True)
    samples = LossSamples(torch.empty(0), None, None, torch.empty(0), None)
    optimiser = torch.optim.SGD([value], lr=0.5)
    for _ in range(60):
        optimiser.zero_grad()
        loss.critic_error(value.expand_as(target), target, samples).mean().backward()
        optimiser.step()
    assert value.item() == pytest.approx(-0.5, abs=1e-4)
