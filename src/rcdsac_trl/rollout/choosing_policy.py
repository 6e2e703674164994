"""A policy whose critics choose among actions around its mean, for a whole worker."""

from collections.abc import Sequence

import torch
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModuleBase, TensorDictSequential
from torch import Tensor

from rcdsac_trl.agent.kernels import dispatch
from rcdsac_trl.agent.loss.distributional_sac import OVER_CRITICS
from rcdsac_trl.agent.risk import RiskMeasure
from rcdsac_trl.deploy.policy.acting import NUM_FRACTIONS, ActingSettings
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
        self.measure = measure
        self._critics = critics
        self._steps = [dispatch.one_by_one(critic[0].module) for critic in critics]
        self._noise = torch.from_numpy(settings.noise())
        self._margin_m = settings.margin_m
        self._over = OVER_CRITICS[settings.over_critics]
        self._tau = torch.from_numpy(fractions_of(NUM_FRACTIONS)).view(1, 1, -1)
        self._beta = self._tau.new_full((num_agents, 1), beta or 0.0)
        self._states = [self._tau.new_zeros(num_agents, critic[0].module.state_size) for critic in critics]

    @torch.no_grad()
    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Write what the policy writes, and another `action` where the critics prefer one."""
        tensordict = self.policy(tensordict)
        loc, scale = tensordict["loc"].unsqueeze(1), tensordict["scale"].unsqueeze(1)
        candidates = torch.tanh(loc + scale * self._noise)
        candidates[:, 0] = tensordict["action"]
        memories = self._remember(tensordict)
        betas = tensordict["risk"] if "risk" in self.policy.in_keys else self._beta
        best = [
            self._values([memory[agent] for memory in memories], candidates[agent], betas[agent]).argmax()
            for agent in range(len(candidates))
        ]
        return tensordict.set("action", candidates[torch.arange(len(best)), torch.stack(best)])

    def _remember(self, tensordict: TensorDictBase) -> list[Tensor]:
        """Advance the critics by one observation, and return what their heads read, ``[N, n]`` each."""
        memories = []
        for number, (encoder, _) in enumerate(self._critics):
            seen = [tensordict[key] for key in (*encoder.in_keys, "is_init")]
            memory, self._states[number] = self._steps[number](*seen, self._states[number])
            memories.append(torch.from_numpy(nearer(memory.numpy(), self._margin_m)))
        return memories

    def _values(self, memories: Sequence[Tensor], candidates: Tensor, beta: Tensor) -> Tensor:
        """Return what the critics together say of an agent's candidates ``[K, 2]``, ``[K]``."""
        risk = beta.view(1, 1, 1)
        tau = self.measure.psi(self._tau, risk)
        values = []
        for (_, head), memory in zip(self._critics, memories, strict=True):
            # As one sequence, whose gates are computed once. At this size its plain layers are faster than their twin.
            entries = {
                head.in_keys[0]: memory.expand(1, len(candidates), -1),
                "action": candidates.unsqueeze(0),
                "tau": tau,
                "risk": risk,
            }
            values.append(head.module(*[entries[key] for key in head.in_keys])[0].mean(-1))
        return self._over(values)
