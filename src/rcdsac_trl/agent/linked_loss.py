r"""A loss whose networks hold its parameters, and whose random numbers come from one generator.

Public names::

    LinkedLoss                     LossModule with an actor, critics, target critics and a generator
        ._link_networks(actor, critics)      makes them functional; the subclass calls it once
        .rng_state                           get and set; also in state_dict
    frozen(parameters)             context: no gradient flows to them
"""

import copy
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from typing import Any, Self

import torch
from tensordict.nn import TensorDictParams, TensorDictSequential
from torch import Tensor, nn
from torchrl.objectives.common import LossModule


class LinkedLoss(LossModule):
    """Parameters in TorchRL's idiom, ``actor_network_params`` and so on, that the networks hold for good.

    TorchRL lends a module its parameters for every call; with recurrent networks of small batches, that costs more than
    some of their layers.
    """

    actor_network: TensorDictSequential
    critic_network: nn.ModuleList
    actor_network_params: TensorDictParams
    critic_network_params: TensorDictParams
    target_actor_network_params: TensorDictParams
    target_critic_network_params: TensorDictParams

    _critics: tuple[TensorDictSequential, ...]
    _generator: torch.Generator

    def _link_networks(self, actor: TensorDictSequential, critics: Sequence[TensorDictSequential]) -> None:
        """Make the networks functional, with target critics, and link them; ``_critics`` holds the critics already."""
        self.convert_to_functional(actor, "actor_network")
        # One functional module for all critics: their parameters keep apart (a list given to TorchRL's own
        # conversion is stacked, which a recurrent layer without vmap cannot use).
        self.convert_to_functional(nn.ModuleList(critics), "critic_network", create_target_params=True)
        # In a tuple, so that their parameters are not listed as this module's own a second time.
        self._target_critics = tuple(copy.deepcopy(critic) for critic in critics)
        self._link()

    @property
    def rng_state(self) -> Tensor:
        """State of the generator that all random numbers of the loss come from."""
        return self._generator.get_state()

    @rng_state.setter
    def rng_state(self, state: Tensor) -> None:
        self._generator.set_state(state)

    def get_extra_state(self) -> Tensor:
        """Put the generator's state into ``state_dict``."""
        return self.rng_state

    def set_extra_state(self, state: Tensor) -> None:
        """Take the generator's state from ``state_dict``."""
        self.rng_state = state

    def _link(self) -> None:
        """Let the modules hold the loss's parameters for good, the target critics those of the targets.

        Whatever makes new tensors calls this again.
        """
        self.actor_network_params.to_module(self.actor_network)
        self.critic_network_params.to_module(self.critic_network)
        params = self._modules["target_critic_network_params"]  # the attribute warns before there is an updater
        params.to_module(nn.ModuleList(self._target_critics))
        self._head_parameters = tuple(p for critic in self._critics for p in critic[1].parameters() if p.requires_grad)

    def _apply(self, fn: Callable[[Tensor], Tensor], recurse: bool = True) -> Self:
        """Move or cast the parameters, as :meth:`torch.nn.Module.to` does."""
        super()._apply(fn)
        self._link()
        return self

    def __setstate__(self, state: dict[str, Any]) -> None:
        """Take the state of a copied or pickled loss."""
        super().__setstate__(state)
        self._link()


@contextmanager
def frozen(parameters: tuple[nn.Parameter, ...]) -> Iterator[None]:
    """Let no gradient flow to the parameters from what is computed within a block."""
    for parameter in parameters:
        parameter.requires_grad_(False)
    try:
        yield
    finally:
        for parameter in parameters:
            parameter.requires_grad_(True)
