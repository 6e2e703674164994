"""The fast learner against the plain one of benchmarks/: the same losses, the same gradients."""

import importlib.util
from pathlib import Path
from types import ModuleType

import pytest
import torch
from tensordict import TensorDict
from torch import Tensor, nn
from torchrl.objectives import SoftUpdate

from rcdsac_trl.agent.actor import build_actor, build_critic
from rcdsac_trl.agent.loss.distributional_sac import DistributionalSACLoss
from rcdsac_trl.agent.loss.loss_settings import LossSettings
from rcdsac_trl.agent.networks import NetworkSettings
from rcdsac_trl.agent.risk import PowerLaw
from rcdsac_trl.robot.observation import VECTOR_OBSERVATIONS

SMALL = NetworkSettings(conv=4, range=8, vector=4, memory=6, head=5, cosines=7)
LOSSES = ("loss_actor", "loss_qvalue", "loss_alpha")


def load_reference() -> ModuleType:
    """Import by path: TorchRL installs a package called `benchmarks`."""
    path = Path(__file__).parents[2] / "benchmarks" / "reference.py"
    spec = importlib.util.spec_from_file_location("plain_reference", path)
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def make_loss(kind: str, per: str) -> DistributionalSACLoss:
    told = PowerLaw() if kind == "rcdsac" else None
    critic = "scalar" if kind == "sac" else "quantile"
    over_critics = {"dsac": "mean", "sac": "smaller"}.get(kind, "smaller" if per == "sequence" else "minimum")
    loss = DistributionalSACLoss(
        build_actor(2, VECTOR_OBSERVATIONS, told, SMALL),
        [build_critic(2, VECTOR_OBSERVATIONS, critic, told, SMALL) for _ in range(2)],
        LossSettings(
            num_quantiles=5,
            num_target_quantiles=4,
            num_risk_samples=3,
            fractions_per=per,  # type: ignore[arg-type]
            fraction_sampling="stratified" if per == "sequence" else "uniform",
            alpha_init=0.2,
            target_over_critics=over_critics,  # type: ignore[arg-type]
        ),
        measure=PowerLaw(),
        generator=torch.Generator().manual_seed(3),
    )
    loss.make_value_estimator(gamma=0.9)
    SoftUpdate(loss, eps=0.99)
    return loss.double()


def make_batch(per: str, kept: slice) -> TensorDict:
    shape = (6, 9)
    ranges = torch.zeros(*shape, 180, dtype=torch.float64)
    ranges[..., kept] = torch.rand(*shape, 180, dtype=torch.float64)[..., kept]
    content: dict = {"range": ranges}
    content |= {key: torch.randn(*shape, size, dtype=torch.float64) for key, size in VECTOR_OBSERVATIONS.items()}
    content["action"] = 2.0 * torch.rand(*shape, 2, dtype=torch.float64) - 1.0
    risk = -2.0 * torch.rand(6, 1 if per == "sequence" else 9, 1, dtype=torch.float64)
    content["risk"] = risk.expand(*shape, 1)
    content["next"] = {
        "reward": torch.randn(*shape, 1, dtype=torch.float64),
        "terminated": torch.rand(*shape, 1) < 0.3,
    }
    return TensorDict(content, batch_size=shape)


def plain_name(name: str) -> str:
    """Return where the plain network keeps a parameter of the product's."""
    for mine, theirs in (
        ("module.0.module.range", "module.0.module"),
        ("module.0.module.gru", "module.1.gru"),
        ("module.1.module.gate_tau", "module.2.module.gate.linear"),
        ("module.1.module.gate.", "module.2.module.gate.linear."),
        ("module.1.module", "module.2.module"),
    ):
        if mine in name:
            return name.replace(mine, theirs)
    return name


def gradients_side_by_side(fast: nn.Module, plain: nn.Module) -> list[tuple[Tensor, Tensor]]:
    """Pair the gradients of both losses; the product keeps a critic's gate as two halves of one layer."""
    mine = {name: p.grad for name, p in fast.named_parameters() if p.requires_grad}
    theirs = {name: p.grad for name, p in plain.named_parameters()}
    for name in [name for name in mine if "gate_beta" in name]:
        whole = name.replace("gate_beta", "gate_tau")
        mine[whole] = torch.cat((mine.pop(name), mine[whole]), dim=1)
    return [(gradient, theirs[plain_name(name)]) for name, gradient in mine.items()]


@pytest.mark.parametrize("kept", [slice(0, 180), slice(0, 21)])
@pytest.mark.parametrize(
    ("kind", "per"), [("rcdsac", "sequence"), ("rcdsac", "transition"), ("dsac", "transition"), ("sac", "sequence")]
)
def test_losses_and_gradients_equal_the_plain_ones(kind: str, per: str, kept: slice) -> None:
    torch.manual_seed(0)
    fast, batch = make_loss(kind, per), make_batch(per, kept)
    # The plain losses draw float32 noise as the product does; the generators start equal.
    plain = load_reference().ReferenceLoss(fast, torch.Generator().manual_seed(3)).double()
    SoftUpdate(plain, eps=0.99)
    found, expected = fast(batch), plain(batch)
    for key in LOSSES:
        torch.testing.assert_close(found[key], expected[key])
    sum(found[key] for key in LOSSES).backward()
    sum(expected[key] for key in LOSSES).backward()
    pairs = gradients_side_by_side(fast, plain)
    for mine, theirs in pairs:
        torch.testing.assert_close(mine, theirs)
    trained = [p for p in plain.parameters() if p.requires_grad]
    assert len(pairs) == len(trained)  # and every gradient was there: None is close to nothing
