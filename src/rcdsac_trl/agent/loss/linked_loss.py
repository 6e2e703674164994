r"""A loss whose networks hold its parameters, and whose random numbers come from one generator."""

import copy
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any, Self

import torch
from tensordict import NestedKey
from tensordict.nn import TensorDictParams, TensorDictSequential
from torch import Tensor, nn
from torchrl.objectives.common import LossModule
from torchrl.objectives.utils import ValueEstimators, dispatch_value_estimator

from rcdsac_trl.agent.float32 import float32_on_cpu


class LinkedLoss(LossModule):
    """Parameters in TorchRL's idiom, ``actor_network_params`` and so on, that the networks hold for good.

    TorchRL lends a module its parameters for every call; with recurrent networks of small batches, that costs more than
    some of their layers.
    """

    @dataclass
    class _AcceptedKeys:
        """Default keys of the input.

        Attributes:
            action: the action taken, ``[B, L+1, A]``.
            risk: the risk-measure parameter beta, ``[B, L+1, 1]``.
            tau: under which quantile critics read their fractions.
            reward: below ``"next"``, ``[B, L+1, 1]``.
            terminated: below ``"next"``, ``[B, L+1, 1]`` bool.
        """

        action: NestedKey = "action"
        risk: NestedKey = "risk"
        tau: NestedKey = "tau"
        reward: NestedKey = "reward"
        terminated: NestedKey = "terminated"

    default_keys = _AcceptedKeys
    tensor_keys: _AcceptedKeys
    default_value_estimator = ValueEstimators.TD0
    SUPPORTED_VALUE_ESTIMATORS = (ValueEstimators.TD0,)

    actor_network: TensorDictSequential
    critic_network: nn.ModuleList
    actor_network_params: TensorDictParams
    critic_network_params: TensorDictParams
    target_actor_network_params: TensorDictParams
    target_critic_network_params: TensorDictParams

    log_alpha: nn.Parameter

    #: The critics, each an encoder and a head that hold the loss's parameters; their targets; and the critics once
    #: more, but no gradient reaches their weights.
    critics: tuple[TensorDictSequential, ...]
    target_critics: tuple[TensorDictSequential, ...]
    frozen_critics: tuple[TensorDictSequential, ...]

    _generator: torch.Generator

    #: The parameters that each loss trains.
    trained: dict[str, list[nn.Parameter]]

    def _link_networks(self, actor: TensorDictSequential, critics: Sequence[TensorDictSequential]) -> None:
        """Make the networks functional, with target critics, and link them."""
        self.convert_to_functional(actor, "actor_network")
        # One functional module for all critics: their parameters keep apart (a list given to TorchRL's own
        # conversion is stacked, which a recurrent layer without vmap cannot use).
        self.convert_to_functional(nn.ModuleList(critics), "critic_network", create_target_params=True)
        # In tuples, so that their parameters are not listed as this module's own a second time.
        self.critics = tuple(critics)
        self.target_critics = tuple(copy.deepcopy(critic) for critic in critics)
        self.frozen_critics = tuple(copy.deepcopy(critic) for critic in critics)
        self._link()

    def make_value_estimator(self, value_type: ValueEstimators | None = None, **hyperparams: Any) -> Self:
        """Set the target's estimator: one-step bootstrapping (TD0) only; ``gamma`` is given here."""
        value_type, hyperparams = self._prepare_value_estimator_kwargs(value_type, **hyperparams)
        if value_type is not None:
            with float32_on_cpu():  # it keeps gamma as a tensor
                dispatch_value_estimator(
                    self,
                    value_type,
                    supported=self.SUPPORTED_VALUE_ESTIMATORS,
                    tensor_keys={"reward": self.tensor_keys.reward, "terminated": self.tensor_keys.terminated},
                    **hyperparams,
                )
        return self

    @property
    def in_keys(self) -> list[NestedKey]:
        """Every key the loss reads from a batch."""
        keys: dict[NestedKey, None] = dict.fromkeys(self.actor_network[0].in_keys)
        for critic in self.critics:
            keys.update(dict.fromkeys(critic[0].in_keys))
        keys[self.tensor_keys.action] = None
        if self._distributional:
            keys[self.tensor_keys.risk] = None
        for key in (self.tensor_keys.reward, self.tensor_keys.terminated):
            keys[("next", *key) if isinstance(key, tuple) else ("next", key)] = None
        return list(keys)

    @property
    def out_keys(self) -> list[NestedKey]:
        """Every key of the output."""
        keys = ["loss_actor", "loss_qvalue", "loss_alpha", "alpha", "entropy", "td_error", "q_value"]
        return [*keys, "quantile_spread"] if self._distributional else keys

    @property
    def _distributional(self) -> bool:
        return self.tensor_keys.tau in self.critics[0][1].in_keys

    @property
    def alpha(self) -> Tensor:
        """The temperature, detached."""
        return self.log_alpha.detach().exp()

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

        The frozen critics hold the critics' own, but no gradient flows to them.

        Whatever makes new tensors calls this again.
        """
        self.actor_network_params.to_module(self.actor_network)
        self.critic_network_params.to_module(self.critic_network)
        params = self._modules["target_critic_network_params"]  # the attribute warns before there is an updater
        params.to_module(nn.ModuleList(self.target_critics))
        self.critic_network_params.data.to_module(nn.ModuleList(self.frozen_critics))
        for critic in self.frozen_critics:
            critic.requires_grad_(False)  # lent tensors become parameters, which would take gradients again
        of_actor, of_critics = self.actor_network.parameters(), self.critic_network.parameters()
        self.trained = {"loss_actor": list(of_actor), "loss_qvalue": list(of_critics), "loss_alpha": [self.log_alpha]}

    def _apply(self, fn: Callable[[Tensor], Tensor], recurse: bool = True) -> Self:
        """Move or cast the parameters, as :meth:`torch.nn.Module.to` does."""
        super()._apply(fn)
        self._link()
        return self

    def __setstate__(self, state: dict[str, Any]) -> None:
        """Take the state of a copied or pickled loss."""
        super().__setstate__(state)
        self._link()
