"""A loss computed in parts, each on its own thread, against the same loss in one piece."""

from typing import Any

import pytest
import torch
from tensordict import TensorDict
from test_loss import LOSSES, make_batch, make_loss
from torch import Tensor

from rcdsac_trl.agent.loss import batch_parts
from rcdsac_trl.agent.loss.distributional_sac import DistributionalSACLoss

SEQUENCES, STEPS = 7, 4


@pytest.fixture(autouse=True)
def _small_parts(monkeypatch: pytest.MonkeyPatch) -> None:
    torch.manual_seed(0)
    monkeypatch.setattr(batch_parts, "_TRANSITIONS_PER_PART", STEPS)


def make_threaded(kind: str = "rcdsac", **settings: Any) -> DistributionalSACLoss:
    loss = make_loss(kind, **settings)
    loss.threads = 3
    return loss


def losses_and_gradients(loss: DistributionalSACLoss, batch: TensorDict) -> tuple[TensorDict, list[Tensor]]:
    """Call a loss with the same random numbers whenever it is called; its three losses count differently."""
    loss.rng_state = torch.Generator().manual_seed(3).get_state()
    loss.zero_grad()
    found = loss(batch)
    sum(number * found[key] for number, key in enumerate(LOSSES, start=2)).backward()
    return found.detach(), [p.grad for p in loss.parameters() if p.requires_grad]


def in_one_piece(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(batch_parts, "_TRANSITIONS_PER_PART", SEQUENCES * STEPS)


@pytest.mark.parametrize("settings", [{}, {"fractions_per": "sequence", "burn_in": 1}, {"reduction": "sum"}])
@pytest.mark.parametrize("kind", ["rcdsac", "sac"])
def test_parts_give_the_losses_and_gradients_of_the_whole(
    kind: str, settings: dict, monkeypatch: pytest.MonkeyPatch
) -> None:
    loss, batch = make_threaded(kind, **settings), make_batch(SEQUENCES, STEPS)
    found, gradients = losses_and_gradients(loss, batch)
    in_one_piece(monkeypatch)
    expected, expected_gradients = losses_and_gradients(loss, batch)
    assert not all(map(torch.equal, gradients, expected_gradients))  # else both were one piece
    torch.testing.assert_close(found.to_dict(), expected.to_dict())
    for gradient, whole in zip(gradients, expected_gradients, strict=True):
        torch.testing.assert_close(gradient, whole, rtol=0, atol=1e-4 * whole.abs().max().item())


def test_results_do_not_depend_on_timing() -> None:
    loss, batch = make_threaded(), make_batch(SEQUENCES, STEPS)
    expected, expected_gradients = losses_and_gradients(loss, batch)
    for _ in range(5):
        found, gradients = losses_and_gradients(loss, batch)
        assert (found == expected).all()
        assert all(map(torch.equal, gradients, expected_gradients))


def test_frozen_weights_are_left_alone_in_parts(monkeypatch: pytest.MonkeyPatch) -> None:
    loss, batch = make_threaded(), make_batch(SEQUENCES, STEPS)
    frozen = list(loss.critics[0][0].parameters())
    for parameter in frozen:
        parameter.requires_grad_(False)
    _, gradients = losses_and_gradients(loss, batch)
    in_one_piece(monkeypatch)
    _, expected = losses_and_gradients(loss, batch)
    torch.testing.assert_close(gradients, expected)
    assert all(parameter.grad is None for parameter in frozen)


def test_without_gradients_there_are_no_parts(monkeypatch: pytest.MonkeyPatch) -> None:
    loss, batch = make_threaded(), make_batch(SEQUENCES, STEPS)
    with torch.no_grad():
        found = loss(batch)
    loss.rng_state = torch.Generator().manual_seed(3).get_state()
    in_one_piece(monkeypatch)
    assert (found == loss(batch)).all()


def test_what_fails_in_a_part_fails_in_the_call() -> None:
    loss, batch = make_threaded(), make_batch(SEQUENCES, STEPS)
    with pytest.raises(TypeError):
        loss(batch.exclude("velocity"))
    assert losses_and_gradients(loss, batch)[0]["loss_qvalue"].isfinite()


def test_parts_are_even_and_not_small(monkeypatch: pytest.MonkeyPatch) -> None:
    assert batch_parts.split_batch(SEQUENCES, STEPS, 3) == [slice(0, 2), slice(2, 4), slice(4, 7)]
    assert batch_parts.split_batch(2, 100, 3) == [slice(0, 1), slice(1, 2)]
    in_one_piece(monkeypatch)
    assert batch_parts.split_batch(SEQUENCES, STEPS, 3) == [slice(0, SEQUENCES)]
    assert batch_parts.split_batch(2 * SEQUENCES, STEPS, 3) == [slice(0, SEQUENCES), slice(SEQUENCES, 2 * SEQUENCES)]
