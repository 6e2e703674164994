"""A robot's choice among actions: around the actor's mean, by what the critics expect of each."""

from collections.abc import Mapping

import numpy as np

from rcdsac_trl.deploy.policy.acting import NUM_CHOICE_FRACTIONS, ActingSettings
from rcdsac_trl.deploy.policy.agent_config import AgentConfig
from rcdsac_trl.deploy.policy.distortion import PSI, distorted, fractions_of
from rcdsac_trl.deploy.policy.inference import Actor, Array, Critics
from rcdsac_trl.errors import UserInputError
from rcdsac_trl.robot.look_ahead import nearer

# The largest sum over the critics is where the largest mean is.
_OVER: Mapping[str, np.ufunc] = {"minimum": np.minimum, "mean": np.add}


class ActionChoice:
    r"""Chooses the action whose risk-adjusted value is largest, among tanh(mean) and others around it.

    What the critics say of an action is :math:`\frac1K \sum_j Z_{\psi(\tau_j; \beta)}` at the midpoints :math:`\tau_j`
    of K equal parts of [0, 1], as in the actor's loss; scalar critics say the mean. See docs/agent.md.

    Args:
        settings: with more than one candidate.
        config: of the agent.
        actor: of the agent.
        critics: of the agent.

    Raises:
        UserInputError: if the agent's risk measure is none that is known without torch, or its heads read no margin.
    """

    def __init__(self, settings: ActingSettings, config: AgentConfig, actor: Actor, critics: Critics) -> None:
        if config.critic == "quantile" and config.measure not in PSI:
            raise UserInputError(
                f"acting.num_candidates={settings.num_candidates} needs the risk measure {config.measure!r} in NumPy, "
                f"which knows {', '.join(PSI)}: add it to rcdsac_trl.deploy.policy.distortion.PSI, or act by "
                "acting.num_candidates=1"
            )
        settings.check_heads(config.look_ahead)  # a policy may be told to act otherwise than its config says
        self._margin_m = settings.margin_m
        self._config, self._actor, self._critics = config, actor, critics
        self._noise = settings.noise()
        self._over = _OVER[settings.over_critics]
        # Of the last beta: the fractions' half of the critics' gates takes as long as some actions.
        self._gate: tuple[float | None, Array | None] | None = None

    def best(self, read: Array, beta: float | None, embedded: float | None) -> Array:
        """Return the chosen action, [2].

        Args:
            read: what actor and critics read, [1 + C, n], see :meth:`Encoders.heads_read`.
            beta: that the agent is told; None where that is nothing.
            embedded: the same in [0, 1].
        """
        candidates = self._actor.action(read[0], embedded, self._noise)
        values = self._critics.means(nearer(read[1:], self._margin_m), candidates, self._gate_at(beta, embedded))
        best: Array = candidates[np.argmax(self._over.reduce(values))]
        return best

    def _gate_at(self, beta: float | None, embedded: float | None) -> Array | None:
        """Return the critics' gates at the fractions as a beta distorts them; None of scalar critics."""
        if self._gate is None or self._gate[0] != beta:
            gate = None
            if self._config.critic == "quantile":
                told = self._config.fixed_beta if beta is None else beta
                fractions = distorted(self._config.measure, fractions_of(NUM_CHOICE_FRACTIONS), told or 0.0)
                gate = self._critics.gate(self._critics.of_fractions(fractions), embedded)
            self._gate = beta, gate
        return self._gate[1]
