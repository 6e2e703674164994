"""An update of the agent: a batch, the losses, the optimisers, the target critics, the averaged actor."""

import torch
from tensordict import TensorDictBase
from torch import Tensor, nn
from torch.optim.swa_utils import AveragedModel
from torchrl.objectives import LossModule, SoftUpdate

from rcdsac_trl.agent.transforms import Mirror, Relabel
from rcdsac_trl.rollout.make_agent import packed
from rcdsac_trl.storage.sequence_replay import SequenceReplay
from rcdsac_trl.system.interrupts import interruption_point

LOSS_KEYS = ("loss_qvalue", "loss_actor", "loss_alpha")


class Learner:
    """One update: a batch, a beta for it, one backward pass, every optimiser, the target critics, the average.

    Args:
        replay: gives batches of sequences.
        mirror: exchanges left and right in half of a batch; None: it does not.
        loss: returns ``loss_qvalue``, ``loss_actor``, ``loss_alpha`` with isolated gradients, and diagnostics.
        relabel: sets the `risk` of a batch; None: the loss reads none.
        optimizer: holds the parameters of all three losses.
        targets: moves the target critics.
        clipped: groups of parameters whose gradient norm is clipped together.
        max_grad_norm: the limit of that norm; None: no clipping.
        average: running average of the actor's weights.
    """

    def __init__(
        self,
        *,
        replay: SequenceReplay,
        mirror: Mirror | None,
        loss: LossModule,
        relabel: Relabel | None,
        optimizer: torch.optim.Optimizer,
        targets: SoftUpdate,
        clipped: list[list[nn.Parameter]],
        max_grad_norm: float | None,
        average: AveragedModel,
    ) -> None:
        self.replay = replay
        self.mirror = mirror
        self.loss = loss
        self.relabel = relabel
        self.optimizer = optimizer
        self.targets = targets
        self.clipped = clipped
        self.max_grad_norm = max_grad_norm
        self.average = average
        self._learning_rates = [group["lr"] for group in optimizer.param_groups]

    def update(self) -> dict[str, Tensor]:
        """Do one update and return the losses and diagnostics, detached and still on the device."""
        batch: TensorDictBase = self.replay.sample()
        if self.mirror is not None:
            batch = self.mirror(batch)
        if self.relabel is not None:
            batch = self.relabel(batch)
        losses = self.loss(batch)
        # One backward pass serves all three: the loss isolates their gradients.
        torch.stack([losses[key] for key in LOSS_KEYS]).sum().backward()
        if self.max_grad_norm is not None:
            for parameters in self.clipped:
                nn.utils.clip_grad_norm_(parameters, self.max_grad_norm)
        self.optimizer.step()
        self.optimizer.zero_grad(set_to_none=True)
        self.targets.step()
        self.average.update_parameters(self.loss.actor_network)
        return {key: value.detach() for key, value in losses.items()}

    def updates(self, number: int, distortion_strength: float, learning_rate_share: float) -> dict[str, float]:
        """Do many updates; return the mean of everything :meth:`update` returns.

        Args:
            number: of updates.
            distortion_strength: how much of beta counts in the actor's loss, in [0, 1].
            learning_rate_share: share of every learning rate that is used, in (0, 1].
        """
        self.loss.distortion_strength = distortion_strength
        for group, learning_rate in zip(self.optimizer.param_groups, self._learning_rates, strict=True):
            group["lr"] = learning_rate_share * learning_rate
        sums: dict[str, Tensor] = {}
        for _ in range(number):
            interruption_point()
            for key, value in self.update().items():
                sums[key] = sums[key] + value if key in sums else value.clone()
        return {key: (value / number).item() for key, value in sums.items()}

    def averaged_actor(self) -> bytes:
        """Return the weights of the averaged actor as they are now, see :func:`packed`."""
        return packed(self.average.module)
