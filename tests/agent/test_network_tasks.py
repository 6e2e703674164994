"""A loss whose networks take turns on threads, against the same loss on one thread."""

from typing import Any

import pytest
import torch
from tensordict import TensorDict
from test_loss import LOSSES, make_batch, make_loss
from torch import Tensor, nn

from rcdsac_trl.agent.loss import distributional_sac
from rcdsac_trl.agent.loss.distributional_sac import DistributionalSACLoss


class Unknown(nn.Module):
    """A recurrent layer that the package does not know."""

    def __init__(self, gru: nn.GRU) -> None:
        super().__init__()
        self.gru, self.hidden_size = gru, gru.hidden_size

    def forward(self, features: Tensor) -> tuple[Tensor, Tensor]:
        return self.gru(features)


VARIANTS: list[dict[str, Any]] = [
    {},
    {"number": 1},
    {"number": 3, "target_over_critics": "smaller"},
    {"reduction": "sum", "n_steps": 3},
    {"burn_in": 1, "fractions_per": "sequence", "target_over_critics": "mean"},
]


@pytest.fixture(autouse=True)
def _weights() -> None:
    torch.manual_seed(0)


def on_threads(loss: DistributionalSACLoss, batch: TensorDict, threads: int) -> tuple[TensorDict, list[Tensor]]:
    """Call a loss with the same random numbers whenever it is called; powers of two do not round gradients."""
    loss.threads = threads
    loss.rng_state = torch.Generator().manual_seed(3).get_state()
    loss.zero_grad()
    found = loss(batch)
    sum(2**number * found[key] for number, key in enumerate(LOSSES)).backward()
    return found.detach(), [p.grad for p in loss.parameters() if p.requires_grad]


@pytest.mark.parametrize("settings", VARIANTS, ids=str)
@pytest.mark.parametrize("kind", ["rcdsac", "dsac", "sac"])
def test_they_give_to_the_last_bit_what_one_thread_gives(
    kind: str, settings: dict[str, Any], monkeypatch: pytest.MonkeyPatch
) -> None:
    loss, batch = make_loss(kind, **settings), make_batch(7, 5)
    expected, expected_gradients = on_threads(loss, batch, threads=1)

    def never(*_: Any) -> None:
        raise AssertionError("several threads compute what one does")

    monkeypatch.setattr(loss, "_reduced", never)
    for threads in (2, 3, 5, 2, 3):
        found, gradients = on_threads(loss, batch, threads)
        assert found.keys() == expected.keys()
        assert (found == expected).all()
        assert len(gradients) == len(expected_gradients)
        assert all(map(torch.equal, gradients, expected_gradients))


def test_frozen_weights_are_left_alone() -> None:
    loss, batch = make_loss(), make_batch(7, 5)
    frozen = [*loss.critics[0][0].parameters(), next(loss.actor_network[1].parameters())]
    for parameter in frozen:
        parameter.requires_grad_(False)
    _, expected = on_threads(loss, batch, threads=1)
    _, gradients = on_threads(loss, batch, threads=2)
    assert all(map(torch.equal, gradients, expected))
    assert all(parameter.grad is None for parameter in frozen)


def test_a_loss_alone_leaves_no_gradients_of_the_others() -> None:
    loss, batch = make_loss(), make_batch(7, 5)
    loss.threads = 2
    loss(batch)["loss_actor"].backward()
    assert all(parameter.grad is None for parameter in loss.trained["loss_qvalue"])
    assert all(parameter.grad is not None for parameter in loss.trained["loss_actor"])


def test_networks_of_others_draw_their_numbers_in_turn(monkeypatch: pytest.MonkeyPatch) -> None:
    loss, batch = make_loss(), make_batch(7, 5)
    loss.critics[0][0].module.gru = Unknown(loss.critics[0][0].module.gru)
    monkeypatch.setattr(distributional_sac, "backward_in_tasks", None)
    assert on_threads(loss, batch, threads=2)[0]["loss_qvalue"].isfinite()


def test_a_loss_that_is_derived_from_it_computes_its_own() -> None:
    class Halved(DistributionalSACLoss):
        def critic_error(self, *inputs: Any) -> Tensor:
            return 0.5 * super().critic_error(*inputs)

        def actor_loss(self, *inputs: Any) -> tuple[Tensor, Tensor]:
            actor_loss, log_prob = super().actor_loss(*inputs)
            return 0.5 * actor_loss, log_prob

    loss, batch = make_loss(), make_batch(7, 5)
    expected, _ = on_threads(loss, batch, threads=2)
    loss.__class__ = Halved
    found, _ = on_threads(loss, batch, threads=2)
    for key in ("loss_actor", "loss_qvalue"):
        torch.testing.assert_close(found[key], 0.5 * expected[key])


def test_what_fails_in_a_task_fails_in_the_call() -> None:
    loss, batch = make_loss(), make_batch(7, 5)
    loss.threads = 2
    with pytest.raises(TypeError):
        loss(batch.exclude("velocity"))
    assert on_threads(loss, batch, threads=2)[0]["loss_qvalue"].isfinite()


def test_without_gradients_one_thread_computes(monkeypatch: pytest.MonkeyPatch) -> None:
    loss, batch = make_loss(), make_batch(7, 5)
    loss.threads = 2
    monkeypatch.setattr(distributional_sac, "backward_in_tasks", None)
    with torch.no_grad():
        assert loss(batch)["loss_qvalue"].isfinite()
