"""A policy whose critics choose among actions around its mean, for a whole worker."""

from collections.abc import Sequence

import torch
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModule, TensorDictModuleBase, TensorDictSequential
from torch import Tensor

from rcdsac_trl.agent.kernels import dispatch
from rcdsac_trl.agent.kernels.compiled_values import CompiledValues
from rcdsac_trl.agent.loss.distributional_sac import OVER_CRITICS
from rcdsac_trl.agent.risk import RiskMeasure
from rcdsac_trl.deploy.policy.acting import NUM_CHOICE_FRACTIONS, ActingSettings
from rcdsac_trl.deploy.policy.distortion import fractions_of
from rcdsac_trl.robot.look_ahead import nearer


class ChoosingPolicy(TensorDictModuleBase):
    r"""Acts by the action whose risk-adjusted value is largest, among tanh(mean) and others around it.

    The value is :math:`\frac1K \sum_j Z_{\psi(\tau_j; \beta)}` at the midpoints of K equal parts of [0, 1], as in the
    actor's loss; scalar critics say the mean. A robot's twin of it is
    :class:`~rcdsac_trl.deploy.policy.action_choice.ActionChoice`.

    Agents go through the critics one by one, so that what one does depends, to the last bit, on no other. Critics run
    on the CPU, wherever the policy does.

    Args:
        policy: writes `loc`, `scale` and `action`, the latter tanh(mean).
        critics: an encoder and a head each, from :func:`rcdsac_trl.agent.actor.build_critic`, on the CPU.
        settings: with more than one candidate.
        measure: distorts the fractions of quantile critics.
        beta: of the measure, where agents are told none.
        num_agents: that drive side by side.
    """

    def __init__(
        self,
        policy: TensorDictModuleBase,
        critics: Sequence[TensorDictSequential],
        settings: ActingSettings,
        *,
        measure: RiskMeasure,
        beta: float | None,
        num_agents: int,
    ) -> None:
        super().__init__()
        self.in_keys, self.out_keys = policy.in_keys, policy.out_keys
        self.policy = policy
        self._critics = critics
        self._steps = [dispatch.one_by_one(critic[0].module) for critic in critics]
        tau = torch.from_numpy(fractions_of(NUM_CHOICE_FRACTIONS))
        self._values = [_values_by(critic[1], tau, measure) for critic in critics]
        self._noise = torch.from_numpy(settings.noise())
        self._margin_m = settings.margin_m
        self._over = OVER_CRITICS[settings.over_critics]
        self._beta = tau.new_full((num_agents, 1), beta or 0.0)
        self._states = [tau.new_zeros(num_agents, critic[0].module.state_size) for critic in critics]

    @torch.no_grad()
    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Write what the policy writes, and another `action` where the critics prefer one."""
        tensordict = self.policy(tensordict)
        loc, scale = tensordict["loc"].unsqueeze(1), tensordict["scale"].unsqueeze(1)
        candidates = torch.tanh(loc + scale * self._noise)
        candidates[:, 0] = tensordict["action"]
        memories = self._remember(tensordict)
        betas = tensordict["risk"] if "risk" in self.policy.in_keys else self._beta
        begins = bool(tensordict["is_init"].any())
        values = [
            of_actions(memory, candidates, betas, begins=begins)
            for of_actions, memory in zip(self._values, memories, strict=True)
        ]
        best = self._over(values).argmax(-1)
        return tensordict.set("action", candidates[torch.arange(len(best)), best])

    def _remember(self, tensordict: TensorDictBase) -> list[Tensor]:
        """Advance the critics by one observation, and return what their heads read, ``[N, n]`` each."""
        memories = []
        for number, (encoder, _) in enumerate(self._critics):
            seen = [tensordict[key] for key in (*encoder.in_keys, "is_init")]
            memory, self._states[number] = self._steps[number](*seen, self._states[number])
            memories.append(torch.from_numpy(nearer(memory.numpy(), self._margin_m)))
        return memories


class LayerValues:
    """What any critic's head says of many actions of each agent, by its own layers; see :class:`.CompiledValues`.

    Args:
        head: reads `memory`, `action` and what it needs of `tau` and `risk`, all with a batch and a time dimension.
        tau: the fractions, ``[F]``.
        measure: distorts them.
    """

    def __init__(self, head: TensorDictModule, tau: Tensor, measure: RiskMeasure) -> None:
        self._head, self._tau, self._measure = head, tau.view(1, 1, -1), measure

    def __call__(self, memory: Tensor, actions: Tensor, risk: Tensor, *, begins: bool) -> Tensor:
        """Return the values, ``[N, K]``; the layers' weights are always those of now, whatever begins."""
        return torch.stack([self._of_agent(*row) for row in zip(memory, actions, risk, strict=True)])

    def _of_agent(self, memory: Tensor, actions: Tensor, risk: Tensor) -> Tensor:
        beta = risk.view(1, 1, 1)
        # As one sequence, whose gates are computed once.
        entries = {
            self._head.in_keys[0]: memory.expand(1, len(actions), -1),
            "action": actions.unsqueeze(0),
            "tau": self._measure.psi(self._tau, beta),
            "risk": beta,
        }
        of_agent: Tensor = self._head.module(*[entries[key] for key in self._head.in_keys])[0].mean(-1)
        return of_agent


def _values_by(head: TensorDictModule, tau: Tensor, measure: RiskMeasure) -> CompiledValues | LayerValues:
    if dispatch.has_compiled_values(head.module):
        return CompiledValues(head.module, tau, measure)
    return LayerValues(head, tau, measure)
