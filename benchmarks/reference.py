"""The learner as one writes it plainly with TorchRL: what the fast path is measured against, and tested against.

The same networks and losses as :mod:`rcdsac_trl.agent`, from ordinary layers: ``Conv1d``, TorchRL's ``GRUModule``, a
risk gate that is one linear layer over both embeddings for every transition and fraction. Every network is called on
the observations whenever its output is needed, so encoders run again for current and next step, for data and policy
action. It draws its random numbers in the product's order: the same generator gives the same losses.
"""

import copy
import math

import torch
from tensordict import TensorDict, TensorDictBase
from tensordict.nn import TensorDictModule, TensorDictParams, TensorDictSequential
from torch import Tensor, nn
from torch.nn import functional as F
from torch.optim.swa_utils import AveragedModel
from torchrl.modules import GRUModule, TanhNormal
from torchrl.objectives import LossModule, SoftUpdate

from rcdsac_trl.agent.loss.distributional_sac import DistributionalSACLoss
from rcdsac_trl.agent.networks import Encoder, QuantileHead
from rcdsac_trl.agent.risk import RiskMeasure
from rcdsac_trl.robot.action import LOG_STD_RANGE
from rcdsac_trl.training.learner import Learner


class Features(nn.Module):
    """Convolutions over the range bins and a linear layer for every vector, concatenated: ``[B, T, ..]``."""

    def __init__(self, encoder: Encoder) -> None:
        super().__init__()
        self.circular = encoder.range.padding == "circular"
        self.conv_1 = copy.deepcopy(encoder.range.conv_1)
        self.conv_2 = copy.deepcopy(encoder.range.conv_2)
        self.linear = copy.deepcopy(encoder.range.linear)
        self.vectors = copy.deepcopy(encoder.vectors)

    def forward(self, range_: Tensor, *vectors: Tensor) -> Tensor:
        positions = range_.flatten(0, 1).unsqueeze(1)
        for convolution, ends in ((self.conv_1, (1, 2)), (self.conv_2, (0, 1))):
            padded = F.pad(positions, ends, mode="circular") if self.circular else positions
            positions = F.relu(convolution(padded))
        ranges = F.relu(self.linear(positions.transpose(1, 2).flatten(1))).unflatten(0, range_.shape[:2])
        return torch.cat([ranges, *(F.relu(f(x)) for f, x in zip(self.vectors, vectors, strict=True))], dim=-1)


class Gate(nn.Module):
    """``relu(linear([cos(pi i x) for x in the given numbers]))``: ``[.., k]`` numbers to ``[.., head]``."""

    def __init__(self, weights: list[Tensor], bias: Tensor) -> None:
        super().__init__()
        self.cosines = weights[0].shape[1]
        self.linear = nn.Linear(len(weights) * self.cosines, len(bias))
        with torch.no_grad():
            self.linear.weight.copy_(torch.cat(weights, dim=1))
            self.linear.bias.copy_(bias)

    def forward(self, numbers: Tensor) -> Tensor:
        frequencies = math.pi * torch.arange(1, self.cosines + 1, device=numbers.device)
        angles = numbers.unsqueeze(-1) * frequencies.to(self.linear.weight)
        return F.relu(self.linear(torch.cos(angles).flatten(-2)))


class Actor(nn.Module):
    """Memory and beta to mean and standard deviation before tanh."""

    def __init__(self, head: nn.Module) -> None:
        super().__init__()
        self.measure: RiskMeasure | None = head.measure
        self.gate = None if self.measure is None else Gate([head.gate.weight], head.gate.bias)
        self.input, self.hidden, self.output = (copy.deepcopy(x) for x in (head.input, head.hidden, head.output))

    def forward(self, memory: Tensor, risk: Tensor | None = None) -> tuple[Tensor, Tensor]:
        x = F.relu(self.input(memory))
        if self.measure is not None and risk is not None:
            x = x * self.gate(self.measure.embed(risk))
        loc, log_std = self.output(F.relu(self.hidden(x))).chunk(2, dim=-1)
        return loc, log_std.clamp(*LOG_STD_RANGE).exp()


class Critic(nn.Module):
    """Memory and action, with ``tau [B, L, N]`` (and beta) a quantile critic, to ``[B, L, N]``, or ``[B, L, 1]``."""

    def __init__(self, head: nn.Module) -> None:
        super().__init__()
        self.input, self.hidden, self.output = (copy.deepcopy(x) for x in (head.input, head.hidden, head.output))
        if isinstance(head, QuantileHead):
            self.measure: RiskMeasure | None = head.measure
            weights = [head.gate_tau.weight] if self.measure is None else [head.gate_beta.weight, head.gate_tau.weight]
            self.gate = Gate(weights, head.gate_tau.bias)

    def forward(self, memory: Tensor, action: Tensor, tau: Tensor | None = None, risk: Tensor | None = None) -> Tensor:
        x = F.relu(self.input(torch.cat((memory, action), dim=-1)))
        if tau is None:
            return self.output(F.relu(self.hidden(x)))
        numbers = tau.unsqueeze(-1)
        if self.measure is not None and risk is not None:
            numbers = torch.cat((self.measure.embed(risk).unsqueeze(2).expand_as(numbers), numbers), dim=-1)
        x = x.unsqueeze(2) * self.gate(numbers)
        return self.output(F.relu(self.hidden(x))).squeeze(-1)


def network(product: TensorDictSequential) -> TensorDictSequential:
    """Return the plain network with the weights of one of the product's, an encoder and a head."""
    encoder, head = product[0].module, product[1].module
    memory = GRUModule(
        input_size=encoder.gru.input_size,
        hidden_size=encoder.gru.hidden_size,
        in_keys=["features", "state", "is_init"],
        out_keys=["memory", ("next", "state")],
        default_recurrent_mode=True,
    )
    memory.gru.load_state_dict(encoder.gru.state_dict())
    plain = Actor(head) if "loc" in product.out_keys else Critic(head)
    return TensorDictSequential(
        TensorDictModule(Features(encoder), in_keys=product[0].in_keys, out_keys=["features"]),
        memory,
        TensorDictModule(plain, in_keys=product[1].in_keys, out_keys=product[1].out_keys),
    )


class ReferenceLoss(LossModule):
    """The three losses with whole networks called for every use; ``tau`` and beta repeated for every transition.

    Args:
        product: gives the networks' weights and every setting.
        generator: source of all random numbers.
    """

    actor_network: TensorDictSequential
    critic_network: nn.ModuleList
    actor_network_params: TensorDictParams
    critic_network_params: TensorDictParams
    target_actor_network_params: TensorDictParams
    target_critic_network_params: TensorDictParams

    def __init__(self, product: DistributionalSACLoss, generator: torch.Generator) -> None:
        super().__init__()
        self.product, self.settings = product, product.settings
        self.convert_to_functional(network(product.actor_network), "actor_network")
        critics = nn.ModuleList(network(critic) for critic in product.critic_network)
        self.convert_to_functional(critics, "critic_network", create_target_params=True)
        self.log_alpha = nn.Parameter(product.log_alpha.detach().clone())
        self.generator = generator
        self.distributional = "tau" in critics[0].in_keys

    def __setattr__(self, name: str, value: object) -> None:
        # The product lends its settings only: its parameters are not this module's.
        object.__setattr__(self, name, value) if name == "product" else super().__setattr__(name, value)

    def forward(self, batch: TensorDictBase) -> TensorDict:
        """Return ``loss_qvalue``, ``loss_actor`` and ``loss_alpha`` of a batch ``[B, L+1]``."""
        alpha, product, settings = self.log_alpha.detach().exp(), self.product, self.settings
        current = batch[:, :-1].clone(False)
        target = self._target(batch, current, alpha)

        tau = self._fractions(current, settings.num_quantiles)
        loss_qvalue = torch.zeros((), device=batch.device)
        with self.critic_network_params.to_module(self.critic_network):
            for critic in self.critic_network:
                value = self._value(critic, current, current["action"], tau)
                loss_qvalue = loss_qvalue + self._error(value, target, tau).mean()

        action, log_prob = self._act(current)
        tau = self._fractions(current, settings.num_risk_samples)
        if tau is not None:
            told = product.measure.temper(current["risk"], product.distortion_strength)
            tau = product.measure.psi(tau, told)
        with self.critic_network_params.detach().to_module(self.critic_network):
            values = [self._value(critic, current, action, tau).mean(-1) for critic in self.critic_network]
        loss_actor = (alpha * log_prob - torch.stack(values).amin(0)).mean()
        loss_alpha = (-self.log_alpha * (log_prob.detach() + settings.target_entropy)).mean()
        return TensorDict({"loss_qvalue": loss_qvalue, "loss_actor": loss_actor, "loss_alpha": loss_alpha})

    @torch.no_grad()
    def _target(self, batch: TensorDictBase, current: TensorDictBase, alpha: Tensor) -> Tensor:
        """Return the target samples ``[B, L, N']``; a transition's next step is told the transition's beta."""
        following = batch.clone(False)
        if self.distributional:
            # The networks read whole sequences: the first slot only warms the memory up.
            following["risk"] = torch.cat((current["risk"][:, :1], current["risk"]), dim=1)
        action, log_prob = self._act(following, skip=1)
        tau = self._fractions(current, self.settings.num_target_quantiles)
        if tau is not None:
            tau = torch.cat((tau[:, :1], tau), dim=1)
        padded = torch.cat((action[:, :1], action), dim=1)
        with self.target_critic_network_params.to_module(self.critic_network):
            values = [self._value(critic, following, padded, tau)[:, 1:] for critic in self.critic_network]
        both = torch.stack(values)
        if self.settings.target_over_critics == "minimum":
            value = both.amin(0)
        elif self.settings.target_over_critics == "mean":
            value = both.mean(0)
        else:
            chosen = both.mean(-1, keepdim=True).argmin(0, keepdim=True)
            value = both.take_along_dim(chosen, 0).squeeze(0)
        value = value - alpha * log_prob.unsqueeze(-1)
        alive = 1.0 - current["next", "terminated"].to(value.dtype)
        return current["next", "reward"] + self.product.value_estimator.gamma * alive * value

    def _act(self, batch: TensorDictBase, skip: int = 0) -> tuple[Tensor, Tensor]:
        with self.actor_network_params.to_module(self.actor_network):
            policy = self.actor_network(self._inputs(batch))
        loc, scale = policy["loc"][:, skip:], policy["scale"][:, skip:]
        raw = loc + scale * torch.randn(loc.shape, generator=self.generator)
        distribution = TanhNormal(loc, scale)
        slope = distribution._t.log_abs_det_jacobian(raw, raw.tanh()).sum(-1)
        return raw.tanh(), distribution.base_dist.log_prob(raw) - slope

    def _value(self, critic: nn.Module, batch: TensorDictBase, action: Tensor, tau: Tensor | None) -> Tensor:
        inputs = self._inputs(batch).set("action", action)
        if tau is not None:
            inputs.set("tau", tau)
        return critic(inputs)[critic.out_keys[-1]]

    @staticmethod
    def _inputs(batch: TensorDictBase) -> TensorDictBase:
        inputs = batch.exclude("next")
        inputs["is_init"] = torch.zeros(*batch.shape, 1, dtype=torch.bool, device=batch.device)
        inputs["is_init"][:, 0] = True
        return inputs

    def _fractions(self, current: TensorDictBase, number: int) -> Tensor | None:
        if not self.distributional:
            return None
        steps = 1 if self.settings.fractions_per == "sequence" else current.shape[1]
        drawn = torch.rand((current.shape[0], steps, number), generator=self.generator)
        if self.settings.fraction_sampling == "stratified":
            drawn = (drawn + torch.arange(number)) / number
        return drawn.expand(*current.shape, number)

    def _error(self, value: Tensor, target: Tensor, tau: Tensor | None) -> Tensor:
        if tau is None:
            return 0.5 * (value - target).square()
        kappa = self.settings.kappa
        difference = target.unsqueeze(-2) - value.unsqueeze(-1)
        size = difference.abs()
        huber = torch.where(size <= kappa, 0.5 * size**2, kappa * (size - 0.5 * kappa))
        weight = (tau.unsqueeze(-1) - (difference.detach() < 0).to(tau.dtype)).abs()
        return (weight * huber / kappa).mean(-1).sum(-1)


class ReferenceLearner:
    """One plain update: sample, mirror, relabel, three losses, an Adam for each, target critics, the actor's average.

    Args:
        learner: the product's; lends its replay, its mirror, its relabelling, its weights and its settings.
    """

    def __init__(self, learner: Learner) -> None:
        self.replay, self.mirror, self.relabel = learner.replay, learner.mirror, learner.relabel
        self.loss = ReferenceLoss(learner.loss, torch.Generator().manual_seed(0))
        groups = [list(self.loss.actor_network_params.parameters()), list(self.loss.critic_network_params.parameters())]
        rates = [group["lr"] for group in learner.optimizer.param_groups]
        self.optimizers = [
            torch.optim.Adam(parameters, lr=rate)
            for parameters, rate in zip([*groups, [self.loss.log_alpha]], rates, strict=True)
        ]
        self.targets = SoftUpdate(self.loss, eps=learner.targets.eps)
        self.average = AveragedModel(self.loss.actor_network, multi_avg_fn=learner.average.multi_avg_fn)

    def update(self) -> None:
        """Do one update."""
        batch = self.replay.sample()
        if self.mirror is not None:
            batch = self.mirror(batch)
        if self.relabel is not None:
            batch = self.relabel(batch)
        losses = self.loss(batch)
        for optimizer in self.optimizers:
            optimizer.zero_grad()
        sum(losses.values()).backward()
        for optimizer in self.optimizers:
            optimizer.step()
        self.targets.step()
        self.average.update_parameters(self.loss.actor_network)
