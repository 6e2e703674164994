"""The steps of the target critics and of the averaged actor."""

from typing import Any

import torch
from torch import nn
from torch.optim.swa_utils import AveragedModel, get_ema_multi_avg_fn
from torchrl.objectives import LossModule, SoftUpdate


class FusedSoftUpdate(SoftUpdate):
    r"""TorchRL's ``SoftUpdate``, :math:`\theta' \leftarrow \theta' + (1 - \epsilon)(\theta - \theta')`, in one call.

    TorchRL's goes through nested TensorDicts at every step, which takes six times as long as the arithmetic. Make it
    once the loss is on its device; loading a state into the loss is fine at any time.

    Args:
        loss_module: has target parameters.
        settings: ``eps`` or ``tau`` = 1 - eps, as TorchRL's.

    Raises:
        RuntimeError, ValueError: as TorchRL's.
    """

    def __init__(self, loss_module: LossModule, **settings: Any) -> None:
        """Set the targets to their sources, and remember the tensors of both."""
        super().__init__(loss_module, **settings)
        sources = dict(self._sources.items(True, True))
        named = {(f"target_{key[0]}", *key[1:]): value for key, value in sources.items()}
        self._pairs = [(self._targets.get(key).data, value.data) for key, value in named.items()]

    def step(self) -> None:
        """Move every target towards its source."""
        targets, sources = zip(*self._pairs, strict=True)
        torch._foreach_lerp_(targets, sources, 1.0 - self.eps)


class FusedAverage(AveragedModel):
    r"""torch's ``AveragedModel``, :math:`\bar\theta \leftarrow d\,\bar\theta + (1 - d)\,\theta`, in one call.

    The original lists and groups the parameters of both at every step, which takes longer than the arithmetic. Make it
    once the model is on its device; loading a state into either is fine at any time. Buffers stay what they are.

    Args:
        model: whose parameters are averaged; the first step copies them.
        decay: d, in [0, 1).
    """

    def __init__(self, model: nn.Module, decay: float) -> None:
        """Copy the model."""
        with torch.device("cpu"):  # its count of updates, which it asks for its number at every step
            super().__init__(model, multi_avg_fn=get_ema_multi_avg_fn(decay))
        # Detached, not `.data`: the compiled actor sees by PyTorch's count of changes that its weights have moved.
        self._averaged = tuple(parameter.detach() for parameter in self.module.parameters())
        self._followed = tuple(parameter.detach() for parameter in model.parameters())
        self._weight = 1.0 - decay

    def update_parameters(self, model: nn.Module) -> None:
        """Move the averages towards the model's parameters; it must be the model this was made of."""
        if self.n_averaged == 0:
            super().update_parameters(model)
            return
        torch._foreach_lerp_(self._averaged, self._followed, self._weight)
        self.n_averaged += 1
