"""Placement of an update's tensors, on the `meta` device: it computes nothing, but refuses what lies elsewhere."""

import pytest
import torch
from tensordict import TensorDict
from torch import nn

from rcdsac_trl.agent.actor import build_actor, build_critic
from rcdsac_trl.agent.loss.distributional_sac import DistributionalSACLoss
from rcdsac_trl.agent.risk import PowerLaw
from rcdsac_trl.agent.transforms import Relabel
from rcdsac_trl.robot.observation import VECTOR_OBSERVATIONS
from rcdsac_trl.rollout.make_agent import make_loss
from rcdsac_trl.training.make_learner import make_replay
from tiny import tiny_settings


def meta_batch(row: str) -> TensorDict:
    """Sample a batch to the meta device from a replay that holds one episode of zeros."""
    settings = tiny_settings(row)
    replay = make_replay(settings, "meta")
    steps = settings.task.episode_steps
    sizes = {"range": 180, "waypoint": 6, "velocity": 4, "risk": 1, "collision_weight": 1, "action": 2}
    content: dict = {key: torch.zeros(1, steps, size) for key, size in sizes.items()}
    content["next"] = dict(content) | {"reward_components": torch.zeros(1, steps, 5)}
    replay.add_episodes(TensorDict(content, batch_size=[1, steps]))
    return replay.sample()


def meta_loss(row: str) -> DistributionalSACLoss:
    """Make the loss of a row on the meta device."""
    algo = tiny_settings(row).algo
    vectors = VECTOR_OBSERVATIONS | ({} if algo.told_weights is None else {"collision_weight": 1})
    actor = build_actor(2, vectors, algo.network_measure).to("meta")
    critics = [build_critic(2, vectors, algo.critic, algo.network_measure).to("meta") for _ in range(2)]
    # There is no generator on meta: drawn on the CPU, its numbers are moved.
    generator = torch.Generator("cpu")
    loss = DistributionalSACLoss(actor, critics, measure=algo.distortion.measure, generator=generator)
    loss.log_alpha = nn.Parameter(loss.log_alpha.detach().to("meta"))
    loss.make_value_estimator(gamma=0.99)
    return loss


def test_random_numbers_come_from_the_cpu_wherever_networks_are() -> None:
    """Else a run of a GPU could neither go on nor be evaluated where there is none."""
    settings = tiny_settings("rcdsac_pow")
    there, here = (make_loss(settings, device) for device in ("meta", "cpu"))
    assert torch.equal(there.rng_state, here.rng_state)


@pytest.mark.filterwarnings("ignore:No target network updater")  # TorchRL's does not get through meta parameters
@pytest.mark.parametrize(
    ("row", "mode"),
    [
        ("rcdsac_pow", "resample"),
        ("rcdsac_pow", "stored"),
        ("rcdsac_pow", "fixed"),
        ("dsac_cvar", "fixed"),
        ("sac", None),
        ("rcwr", None),
    ],
)
def test_an_update_makes_no_tensor_elsewhere(row: str, mode: str | None) -> None:
    batch = meta_batch(row)
    if mode is not None:
        relabel = Relabel(PowerLaw(), mode=mode, beta=-1.0, generator=torch.Generator())  # type: ignore[arg-type]
        batch = relabel(batch)
    assert all(value.device.type == "meta" for value in batch.values(True, True))
    losses = (loss := meta_loss(row))(batch)
    assert all(value.device.type == "meta" for value in losses.values())
    (losses["loss_actor"] + losses["loss_qvalue"] + losses["loss_alpha"]).backward()
    assert all(p.grad is not None and p.grad.is_meta for p in loss.parameters() if p.requires_grad)
