"""Small problems with known answers, learned by the real loss and heads: does the method do what it says?"""

from collections.abc import Callable, Iterator

import pytest
import torch
from tensordict import TensorDict
from tensordict.nn import TensorDictModule, TensorDictSequential
from torch import Tensor, nn
from torchrl.objectives import SoftUpdate

from rcdsac_trl.agent.loss.distributional_sac import DistributionalSACLoss
from rcdsac_trl.agent.loss.loss_settings import LossSettings
from rcdsac_trl.agent.networks import ActorHead, NetworkSettings, QuantileHead
from rcdsac_trl.agent.risk import Neutral, PowerLaw, RiskMeasure

WIDTHS = NetworkSettings(memory=2, head=32, cosines=16)
LOSSES = ("loss_actor", "loss_qvalue", "loss_alpha")


@pytest.fixture(autouse=True)
def _one_thread() -> Iterator[None]:
    """Tensors this small gain nothing from threads, and lose much when the cores are busy."""
    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    yield
    torch.set_num_threads(threads)


def make_loss(measure: RiskMeasure, told: RiskMeasure | None, alpha: float, gamma: float) -> DistributionalSACLoss:
    """The real heads on an observation that needs no encoding; the temperature stays where it begins."""

    def network(head: nn.Module, in_keys: list[str], out_keys: list[str]) -> TensorDictSequential:
        return TensorDictSequential(
            TensorDictModule(nn.Identity(), in_keys=["state"], out_keys=["memory"]),
            TensorDictModule(head, in_keys=["memory", *in_keys], out_keys=out_keys),
        )

    risk = [] if told is None else ["risk"]
    torch.manual_seed(0)
    return DistributionalSACLoss(
        network(ActorHead(1, WIDTHS, told), risk, ["loc", "scale"]),
        [network(QuantileHead(1, WIDTHS, told), ["action", "tau", *risk], ["quantiles"])],
        LossSettings(fractions_per="transition", kappa=0.1, alpha_init=alpha),
        measure=measure,
        generator=torch.Generator().manual_seed(0),
    ).make_value_estimator(gamma=gamma)


def train(
    loss: DistributionalSACLoss,
    updates: int,
    make_batch: Callable[[], TensorDict],
    learning_rate: float,
    coefficient: float,
) -> None:
    updater = SoftUpdate(loss, tau=coefficient)
    networks = [p for name, p in loss.named_parameters() if name != "log_alpha"]
    optimizer = torch.optim.Adam(networks, lr=learning_rate)
    schedule = torch.optim.lr_scheduler.CosineAnnealingLR(optimizer, updates)
    for _ in range(updates):
        optimizer.zero_grad()
        losses = loss(make_batch())
        sum(losses[key] for key in LOSSES).backward()
        optimizer.step()
        schedule.step()
        updater.step()


def test_quantiles_of_a_markov_chain() -> None:
    """Two steps of reward U(-10, 10), discount 1/2: the return U(-10, 10) + U(-5, 5) has a trapezoid density."""
    generator = torch.Generator().manual_seed(1)
    sequences = 96

    def make_batch() -> TensorDict:
        content = {
            "state": torch.tensor([[1.0, 0.0], [0.0, 1.0], [0.0, 0.0]]).expand(sequences, 3, 2),
            "action": torch.zeros(sequences, 3, 1),
            "risk": torch.zeros(sequences, 3, 1),
            "next": {
                "reward": 20.0 * torch.rand(sequences, 3, 1, generator=generator) - 10.0,
                "terminated": torch.tensor([False, True, True]).view(1, 3, 1).expand(sequences, 3, 1),
            },
        }
        return TensorDict(content, batch_size=(sequences, 3))

    loss = make_loss(Neutral(), None, alpha=1e-6, gamma=0.5)
    train(loss, 400, make_batch, learning_rate=5e-3, coefficient=0.05)
    tau = torch.tensor([0.05, 0.125, 0.25, 0.5, 0.75, 0.875, 0.95])
    with torch.no_grad():
        head = loss.critic_network[0][1].module
        learned = head(torch.eye(2).unsqueeze(0), torch.zeros(1, 2, 1), tau.expand(1, 1, -1))[0]
    last = 20.0 * tau - 10.0
    # Density of the sum: 1/20 between -5 and 5, falling linearly to 0 at -15 and 15.
    tail = torch.minimum(tau, 1.0 - tau)
    first = torch.where(tail < 0.25, -15.0 + (400.0 * tail).sqrt(), -5.0 + 20.0 * (tail - 0.25))
    first = torch.where(tau > 0.5, -first, first)
    assert (learned[1] - last).abs().max() < 1.0, learned[1]
    assert (learned[0] - first).abs().max() < 1.2, learned[0]


def test_bandit_with_a_safe_and_a_risky_arm() -> None:
    """Arms of equal mean and different spread, one conditioned network: averse takes the safe one, neutral either."""
    generator = torch.Generator().manual_seed(2)
    measure, number = PowerLaw(), 192

    def make_batch() -> TensorDict:
        action = 2.0 * torch.rand(number, 2, 1, generator=generator) - 1.0
        # The risky arm is the right half: +-2 against +-0.2.
        spread = torch.where(action > 0.0, 2.0, 0.2)
        sign = 2.0 * torch.randint(0, 2, (number, 2, 1), generator=generator) - 1.0
        content = {
            "state": torch.ones(number, 2, 2),
            "action": action,
            "risk": measure.sample((number, 2, 1), generator),
            "next": {"reward": sign * spread, "terminated": torch.ones(number, 2, 1, dtype=torch.bool)},
        }
        return TensorDict(content, batch_size=(number, 2))

    loss = make_loss(measure, measure, alpha=0.2, gamma=0.9)
    train(loss, 300, make_batch, learning_rate=5e-3, coefficient=0.05)
    value = {beta: [arm_value(loss, beta, action) for action in (-0.5, 0.5)] for beta in (-2.0, -1.0, 0.0)}
    safe = {beta: probability_of_safe_arm(loss, beta) for beta in (-2.0, -1.0, 0.0)}
    # For +-s the power law weighs the loss by 1 - (1/2)^(1 - beta): -0.75 s at -2, -0.5 s at -1, 0 at 0.
    assert value[-2.0] == pytest.approx([-0.15, -1.5], abs=0.3)
    assert value[-1.0] == pytest.approx([-0.1, -1.0], abs=0.3)
    assert value[0.0] == pytest.approx([0.0, 0.0], abs=0.25)
    assert safe[-2.0] > 0.9
    assert safe[-1.0] > 0.8
    assert 0.15 < safe[0.0] < 0.85


def arm_value(loss: DistributionalSACLoss, beta: float, action: float) -> float:
    tau = (torch.arange(64.0) + 0.5) / 64
    risk = torch.full((1, 1, 1), beta)
    with torch.no_grad():
        quantiles = loss.critic_network[0][1].module(
            torch.ones(1, 1, 2), torch.full((1, 1, 1), action), loss.measure.psi(tau.view(1, 1, -1), risk), risk
        )
    return quantiles.mean().item()


def probability_of_safe_arm(loss: DistributionalSACLoss, beta: float) -> float:
    with torch.no_grad():
        loc, scale = loss.actor_network[1].module(torch.ones(1, 2), torch.full((1, 1), beta))
    safe: Tensor = torch.special.ndtr(-loc / scale)  # tanh keeps the sign
    return safe.item()
