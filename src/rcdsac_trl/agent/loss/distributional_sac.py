r"""Distributional soft actor-critic on sequences: critic, actor and temperature loss."""

import math
from collections.abc import Callable, Sequence
from typing import Literal

import torch
from tensordict import NestedKey, TensorDict, TensorDictBase, unravel_key
from tensordict.nn import TensorDictSequential
from torch import Tensor, nn
from torchrl.objectives.utils import _reduce
from torchrl.objectives.value.functional import td0_return_estimate

from rcdsac_trl.agent.kernels import dispatch
from rcdsac_trl.agent.loss.batch_parts import split_batch
from rcdsac_trl.agent.loss.batch_threads import parallel_backward
from rcdsac_trl.agent.loss.functional import call_module, mean, minimum, quantile_huber_loss, smaller, squash
from rcdsac_trl.agent.loss.linked_loss import LinkedLoss
from rcdsac_trl.agent.loss.loss_settings import LossSettings
from rcdsac_trl.agent.loss.network_tasks import backward_in_tasks
from rcdsac_trl.agent.loss.samples import LossSamples, draw_samples
from rcdsac_trl.agent.risk import Neutral, RiskMeasure

#: What a target can take of the target critics.
OVER_CRITICS: dict[str, Callable[[list[Tensor]], Tensor]] = {"minimum": minimum, "smaller": smaller, "mean": mean}


class DistributionalSACLoss(LinkedLoss):
    r"""Soft actor-critic whose critics are the quantile function of the return, or its mean.

    With quantile critics it is RC-DSAC (networks conditioned on ``risk``) or DSAC (networks not conditioned); with
    scalar critics it is soft actor-critic. For a transition with risk parameter :math:`\beta`:

    - critic: :func:`~rcdsac_trl.agent.loss.functional.quantile_huber_loss` at fractions
      :math:`\tau_i, \tau'_j \sim U(0,1)` between :math:`\hat Z_{\tau_i}(s_t, a_t; \beta)` and
      :math:`r_t + \gamma(\min_k \hat Z^{\prime k}_{\tau'_j}(s_{t+1}, a; \beta) - \alpha \log\pi(a|s_{t+1},\beta))`,
      with a policy action :math:`a` and the element-wise minimum (or what ``target_over_critics`` says) over the target
      critics; summed over the critics. With ``n_steps`` above 1 the rewards and entropies of the steps on the way come
      first. Of a scalar critic: half the squared difference (Haarnoja et al., 2018, equation 5);
    - actor: :math:`\alpha \log\pi - \min_k \frac1K \sum_j \hat Z^k_{\psi(\tau_j;\beta)}(s_t, a; \beta)`;
    - temperature: :math:`-\log\alpha \, (\log\pi + \bar H)`.

    Current and next step of a transition share one :math:`\beta`. Each network encodes the L+1 observations once
    and its heads reuse the result; gradients of each loss reach only its own parameters (the actor loss
    trains the actor's own encoder). Critics are looped over, not vmapped: a recurrent layer is faster that way.

    Input: a batch ``[B, L+1]`` of sequences inside one episode. Slot ``t+1`` holds the next observation of slot
    ``t``. Read are the observations the encoders name, and per slot ``action``, ``risk``, ``("next", "reward")``
    and ``("next", "terminated")``; those of the last slot are ignored. The recurrent state starts at zero.

    Args:
        actor: encoder and head, from :func:`rcdsac_trl.agent.actor.build_actor`; any ``TensorDictSequential`` of two
            modules will do whose first writes a memory ``[B, L+1, ..]`` and whose second writes mean and scale of the
            action before tanh.
        critics: one or two (or more) independent critics, from :func:`rcdsac_trl.agent.actor.build_critic`; the
            head that reads ``tau`` is a quantile head, else it is scalar.
        measure: distorts the fractions of the actor loss; required with quantile critics.
        settings: hyper-parameters; None for the defaults.
        reduction: ``"mean"``, ``"sum"`` or ``"none"``; over batch and time. ``"none"`` leaves every entry of the
            output ``[B, L - burn_in]``.
        generator: source of all random numbers; None for one seeded with 0. Its state is part of ``state_dict``.
        threads: that share a call on a CPU. They take a small batch's networks, step by step, which changes nothing of
            the result; of a larger batch each takes a part, whose sums are rounded elsewhere.

    Example:
        >>> from torchrl.objectives import SoftUpdate
        >>> from rcdsac_trl.agent.actor import build_actor, build_critic
        >>> from rcdsac_trl.agent.risk import PowerLaw
        >>> measure = PowerLaw()
        >>> critics = [build_critic(measure=measure) for _ in range(2)]
        >>> loss = DistributionalSACLoss(build_actor(measure=measure), critics, measure=measure)
        >>> loss = loss.make_value_estimator(gamma=0.99)
        >>> targets = SoftUpdate(loss, tau=0.005)
        >>> observations = {"range": torch.zeros(3, 9, 180), "waypoint": torch.zeros(3, 9, 6)}
        >>> observations["velocity"] = torch.zeros(3, 9, 4)
        >>> outcome = {"reward": torch.zeros(3, 9, 1), "terminated": torch.zeros(3, 9, 1, dtype=torch.bool)}
        >>> batch = TensorDict({**observations, "next": outcome}, batch_size=[3, 9])
        >>> batch["action"], batch["risk"] = torch.zeros(3, 9, 2), torch.full((3, 9, 1), -1.0)
        >>> losses = loss(batch)
        >>> (losses["loss_actor"] + losses["loss_qvalue"] + losses["loss_alpha"]).backward()
        >>> targets.step()
    """

    def __init__(
        self,
        actor: TensorDictSequential,
        critics: Sequence[TensorDictSequential],
        settings: LossSettings | None = None,
        *,
        measure: RiskMeasure | None = None,
        reduction: Literal["mean", "sum", "none"] = "mean",
        generator: torch.Generator | None = None,
        threads: int = 1,
    ) -> None:
        """Check the parts against each other, then make them functional."""
        super().__init__()
        if not critics:
            raise ValueError("give at least one critic")
        if reduction not in ("mean", "sum", "none"):
            raise ValueError(f"reduction = {reduction!r} must be 'mean', 'sum' or 'none'")
        self.settings = settings or LossSettings()
        self.log_alpha = nn.Parameter(
            torch.tensor(math.log(self.settings.alpha_init), dtype=torch.float32, device="cpu")
        )
        self._link_networks(actor, critics)
        if self._distributional and measure is None:
            raise ValueError("quantile critics need a risk measure: pass measure=Neutral() for the mean")
        self.measure = measure or Neutral()
        self.reduction = reduction
        self.threads = threads
        #: How much of beta counts in the actor's loss; the trainer lets it grow from 0 (as if neutral) to 1 (all).
        #: The networks are told the whole beta from the start, so that no value of it is ever new to them.
        self.distortion_strength = 1.0
        self._generator = generator or torch.Generator().manual_seed(0)

    # ------------------------------------------------------------------------------------------- the losses
    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Return the three losses and detached diagnostics of a batch ``[B, L+1]``.

        ``loss_*`` are to be summed and differentiated. ``alpha`` is the temperature, ``entropy`` the policy's in
        nats, ``td_error`` how far mean target and mean prediction are apart (most over the critics), ``q_value`` the
        mean prediction and ``quantile_spread`` the standard deviation over a prediction's sampled quantiles.
        """
        if tensordict.ndim != 2 or tensordict.shape[1] < self.settings.burn_in + 2:
            raise ValueError(
                f"expected a batch [sequences, steps + 1] with more than burn_in = {self.settings.burn_in} steps, "
                f"got {list(tensordict.shape)}"
            )
        samples = self.draw_samples(tensordict)
        if self.reduction == "none":
            losses, diagnostics = self._losses(tensordict, samples)
            diagnostics["alpha"] = self.alpha.expand_as(losses["loss_actor"])
            return TensorDict(losses | diagnostics, batch_size=losses["loss_actor"].shape)
        if self.threads > 1 and torch.is_grad_enabled() and samples.noise.device.type == "cpu":
            sequences, steps = samples.noise.shape[:2]
            parts = split_batch(sequences, steps, self.threads)
            if len(parts) > 1:
                return TensorDict(self._reduced_in_parts(tensordict, samples, parts))
            # Of another one's losses the tasks know nothing; networks of others may draw random numbers in turn.
            if type(self) is DistributionalSACLoss and self._has_own_networks():
                return TensorDict(backward_in_tasks(self, tensordict, samples))
        return TensorDict(self._reduced(tensordict, samples))

    def _losses(self, tensordict: TensorDictBase, samples: LossSamples) -> tuple[dict[str, Tensor], dict[str, Tensor]]:
        """Return the losses and detached diagnostics, ``[B, L - burn_in]`` but for ``alpha``."""
        actor_memory = self.encode_actor(tensordict)
        loss_qvalue, critic_memories, diagnostics = self.qvalue_loss(tensordict, actor_memory, samples)
        loss_actor, log_prob = self.actor_loss(tensordict, actor_memory, critic_memories, samples)
        losses = {"loss_actor": loss_actor, "loss_qvalue": loss_qvalue, "loss_alpha": self.alpha_objective(log_prob)}
        return losses, diagnostics | {"alpha": self.alpha, "entropy": -log_prob}

    def _reduced(self, tensordict: TensorDictBase, samples: LossSamples) -> dict[str, Tensor]:
        """Return the reduced losses and the diagnostics' means of a batch."""
        return self.reduce_all(*self._losses(tensordict, samples))

    def reduce_all(self, losses: dict[str, Tensor], diagnostics: dict[str, Tensor]) -> dict[str, Tensor]:
        """Return the reduced losses and the diagnostics' means, of entries ``[B, L - burn_in]``."""
        reduced = {key: _reduce(value, self.reduction) for key, value in losses.items()}
        return reduced | {key: value.mean() for key, value in diagnostics.items()}

    def _reduced_in_parts(
        self, tensordict: TensorDictBase, samples: LossSamples, parts: list[slice]
    ) -> dict[str, Tensor]:
        """Return the same with gradients, from parts of the batch on a thread each."""

        def compute(part: slice) -> dict[str, Tensor]:
            share = (part.stop - part.start) / len(tensordict)
            summed = self.trained if self.reduction == "sum" else {}
            reduced = self._reduced(tensordict[part], samples.rows(part))
            return {key: value if key in summed else share * value for key, value in reduced.items()}

        return parallel_backward(compute, self.trained, parts, self.threads)

    def draw_samples(self, tensordict: TensorDictBase) -> LossSamples:
        """Draw all random numbers that a batch ``[B, L+1]`` needs."""
        numbers = (self.settings.num_target_quantiles, self.settings.num_quantiles, self.settings.num_risk_samples)
        action = tensordict.get(self.tensor_keys.action)[:, self.settings.burn_in : -1]
        sampling = self.settings.fractions_per, self.settings.fraction_sampling
        return draw_samples(action, numbers if self._distributional else None, *sampling, self._generator)

    def encode_actor(self, tensordict: TensorDictBase) -> Tensor:
        """Return the actor's memory of every observation, ``[B, L + 1 - burn_in, memory]``."""
        return self._encode(self.actor_network, tensordict)

    def compute_target(self, tensordict: TensorDictBase, actor_memory: Tensor, samples: LossSamples) -> Tensor:
        """Return the target samples ``[B, L - burn_in, N']`` (scalar critics: N' = 1), without gradient."""
        action, log_prob = self.next_action(tensordict, actor_memory, samples)
        _ = self.target_critic_network_params  # TorchRL warns here where nothing updates them
        values = [self.next_value(critic, tensordict, action, samples) for critic in self.target_critics]
        return self.combine_target(tensordict, values, log_prob)

    @torch.no_grad()
    def next_action(
        self, tensordict: TensorDictBase, actor_memory: Tensor, samples: LossSamples
    ) -> tuple[Tensor, Tensor]:
        """Return a policy action at every next observation, and its log density, without gradient."""
        return self._act(actor_memory[:, 1:], self._risk(tensordict), samples.next_noise)

    @torch.no_grad()
    def next_value(
        self, critic: TensorDictSequential, tensordict: TensorDictBase, action: Tensor, samples: LossSamples
    ) -> Tensor:
        """Return what a target critic says of next actions, ``[B, L - burn_in, N']``, without gradient."""
        memory = self._encode(critic, tensordict)[:, 1:]
        return self._evaluate(critic, memory, action, samples.next_tau, self._risk(tensordict))

    @torch.no_grad()
    def combine_target(self, tensordict: TensorDictBase, values: list[Tensor], log_prob: Tensor) -> Tensor:
        """Return the target samples from what every target critic says of the next actions, and their log density."""
        next_value = OVER_CRITICS[self.settings.target_over_critics](values)
        entropy_bonus = -self.alpha * log_prob.unsqueeze(-1)
        # What TorchRL's estimator calls, with its shapes: every target fraction gets its own entry.
        reward = self._transitions(tensordict, ("next", self.tensor_keys.reward)).expand_as(next_value)
        terminated = self._transitions(tensordict, ("next", self.tensor_keys.terminated)).expand_as(next_value)
        gamma = self.value_estimator.gamma
        target = td0_return_estimate(gamma, next_value + entropy_bonus, reward, terminated)
        for _ in range(self.settings.n_steps - 1):
            # What a step leads to is worth the target of the next step, one step shorter; at the sequence's end
            # there is none.
            next_value = torch.cat((target[:, 1:], next_value[:, -1:]), dim=1)
            target = td0_return_estimate(gamma, next_value + entropy_bonus, reward, terminated)
        return target

    def qvalue_loss(
        self, tensordict: TensorDictBase, actor_memory: Tensor, samples: LossSamples
    ) -> tuple[Tensor, list[Tensor], dict[str, Tensor]]:
        """Return the critic loss, the critics' memories for :meth:`actor_loss`, and detached diagnostics.

        The loss ``[B, L - burn_in]`` is summed over the critics; a memory is ``[B, L - burn_in, memory]``.
        """
        target = self.compute_target(tensordict, actor_memory, samples)
        memories = [self.encode_critic(critic, tensordict) for critic in self.critics]
        values = [
            self.predict(critic, tensordict, memory, samples)
            for critic, memory in zip(self.critics, memories, strict=True)
        ]
        errors = [self.critic_error(value, target, samples) for value in values]
        return torch.stack(errors).sum(0), memories, self.diagnose(values, target)

    def encode_critic(self, critic: TensorDictSequential, tensordict: TensorDictBase) -> Tensor:
        """Return a critic's memory ``[B, L - burn_in, memory]``: no transition starts at the last observation."""
        return self._encode(critic, tensordict, stop=-1)

    def predict(
        self, critic: TensorDictSequential, tensordict: TensorDictBase, memory: Tensor, samples: LossSamples
    ) -> Tensor:
        """Return what a critic says of the actions taken, ``[B, L - burn_in, N]``."""
        action = self._transitions(tensordict, self.tensor_keys.action)
        return self._evaluate(critic, memory, action, samples.tau, self._risk(tensordict))

    def critic_error(self, value: Tensor, target: Tensor, samples: LossSamples) -> Tensor:
        """Return a critic's share of the critic loss, ``[B, L - burn_in]``."""
        if samples.tau is None:
            # Squares alone lead to the mean: a Huber loss would hardly mind a collision that is not certain.
            return 0.5 * (value - target).square().squeeze(-1)
        return quantile_huber_loss(value, target, samples.tau, self.settings.kappa)

    def actor_loss(
        self, tensordict: TensorDictBase, actor_memory: Tensor, critic_memories: list[Tensor], samples: LossSamples
    ) -> tuple[Tensor, Tensor]:
        """Return the actor loss and the detached log density of its action, both ``[B, L - burn_in]``."""
        action, log_prob = self.policy_action(tensordict, actor_memory, samples)
        values = [
            self.policy_value(critic, tensordict, memory, action, samples)
            for critic, memory in zip(self.frozen_critics, critic_memories, strict=True)
        ]
        return self.actor_objective(values, log_prob), log_prob.detach()

    def policy_action(
        self, tensordict: TensorDictBase, actor_memory: Tensor, samples: LossSamples
    ) -> tuple[Tensor, Tensor]:
        """Return a policy action at every observation that a transition starts at, and its log density."""
        return self._act(actor_memory[:, :-1], self._risk(tensordict), samples.noise)

    def policy_value(
        self,
        critic: TensorDictSequential,
        tensordict: TensorDictBase,
        memory: Tensor,
        action: Tensor,
        samples: LossSamples,
    ) -> Tensor:
        """Return the risk-adjusted value ``[B, L - burn_in]`` that a frozen critic gives to actions."""
        risk, tau = self._risk(tensordict), samples.risk_tau
        if tau is not None and risk is not None:
            tau = self.measure.psi(tau, self.measure.temper(risk, self.distortion_strength))
        return self._evaluate(critic, memory.detach(), action, tau, risk).mean(-1)

    def actor_objective(self, values: list[Tensor], log_prob: Tensor) -> Tensor:
        """Return the actor loss ``[B, L - burn_in]`` from every critic's value of an action, and its log density."""
        return self.alpha * log_prob - minimum(values)

    def alpha_objective(self, log_prob: Tensor) -> Tensor:
        """Return the temperature loss ``[B, L - burn_in]``; no gradient reaches the log density."""
        return -self.log_alpha * (log_prob.detach() + self.settings.target_entropy)

    # ------------------------------------------------------------------------------------------- parts of them
    def _has_own_networks(self) -> bool:
        """Return whether all networks are of this package, layers included."""
        (actor_encoder, actor_head), *critics = (
            [getattr(part, "module", part) for part in network] for network in (self.actor_network, *self.critics)
        )
        return dispatch.has_compiled_actor(actor_encoder, actor_head) and all(
            dispatch.is_plain_encoder(encoder) and dispatch.has_compiled_values(head) for encoder, head in critics
        )

    def _encode(self, network: TensorDictSequential, tensordict: TensorDictBase, stop: int | None = None) -> Tensor:
        encoder = network[0]
        (memory,) = call_module(encoder, {key: tensordict.get(key)[:, :stop] for key in encoder.in_keys})
        return memory[:, self.settings.burn_in :]

    def _transitions(self, tensordict: TensorDictBase, key: NestedKey | tuple) -> Tensor:
        return tensordict.get(unravel_key(key))[:, self.settings.burn_in : -1]

    def _risk(self, tensordict: TensorDictBase) -> Tensor | None:
        """Return beta per transition, a time dimension of 1 where it is one value expanded; None for scalar critics.

        The stride says so without reading a value, which on an accelerator would make the program wait.
        """
        if not self._distributional:
            return None
        risk = self._transitions(tensordict, self.tensor_keys.risk)
        return risk[:, :1] if risk.stride(1) == 0 else risk

    def _act(self, memory: Tensor, risk: Tensor | None, noise: Tensor) -> tuple[Tensor, Tensor]:
        entries = {self.actor_network[0].out_keys[0]: memory, self.tensor_keys.risk: risk}
        loc, scale = call_module(self.actor_network[1], entries)
        return squash(loc, scale, noise)

    def _evaluate(
        self, critic: TensorDictSequential, memory: Tensor, action: Tensor, tau: Tensor | None, risk: Tensor | None
    ) -> Tensor:
        entries = {
            critic[0].out_keys[0]: memory,
            self.tensor_keys.action: action,
            self.tensor_keys.tau: tau,
            self.tensor_keys.risk: risk,
        }
        return call_module(critic[1], entries)[0]

    def diagnose(self, values: list[Tensor], target: Tensor) -> dict[str, Tensor]:
        """Return detached diagnostics ``[B, L - burn_in]`` of the critics' predictions."""
        with torch.no_grad():
            stacked = torch.stack(values)  # [critics, B, L, N]
            difference = (target.mean(-1) - stacked.mean(-1)).abs().amax(0)
            diagnostics = {"td_error": difference, "q_value": stacked.mean((0, -1))}
            if self._distributional:
                diagnostics["quantile_spread"] = stacked.std(-1, correction=0).mean(0)
            return diagnostics
