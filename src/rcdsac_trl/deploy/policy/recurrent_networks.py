"""The networks of an agent with what they remember: what it does where it stands, and what it expects of that."""

from collections.abc import Sequence

import numpy as np

from rcdsac_trl.deploy.policy.acting import ActingSettings
from rcdsac_trl.deploy.policy.action_choice import ActionChoice
from rcdsac_trl.deploy.policy.command import Outlook
from rcdsac_trl.deploy.policy.inference import Actor, Array, Critics, Encoders
from rcdsac_trl.deploy.policy.weights import Weights
from rcdsac_trl.errors import UserInputError
from rcdsac_trl.robot.action import desired_velocities


class RecurrentNetworks:
    """An agent's actor and critics, and their recurrent states.

    A copy, ``copy.copy(networks)``, has states of its own and shares what never changes.

    Args:
        weights: of the agent.
        fractions: at which the return's distribution is told, float32 [N].
        acting: by the actor's mean or by the critics' choice among some actions.

    Attributes:
        empty: whether nothing was seen since :meth:`forget`.

    Raises:
        UserInputError: if the critics are to choose by a risk measure that is known to torch alone.
    """

    def __init__(self, weights: Weights, fractions: Array, acting: ActingSettings) -> None:
        config = weights.config
        self._config, self._fractions = config, fractions
        parts = ["actor", *(f"critics.{number}" for number in range(config.num_critics))]
        self._encoders = Encoders(
            [weights.part(f"{part}.encoder") for part in parts],
            config.sensor_mask,
            config.padding,
            config.range_code,
            config.restart_steps,
            config.foreseen,
        )
        self._actor = Actor(weights)
        self._critics = Critics(weights, fractions)
        self.acting = acting
        self._states: Array
        self._read: Array
        self.forget()

    @property
    def acting(self) -> ActingSettings:
        """How the agent acts; it may be changed."""
        return self._acting

    @acting.setter
    def acting(self, acting: ActingSettings) -> None:
        if not isinstance(acting, ActingSettings):
            raise UserInputError(f"acting={acting!r} is none: give ActingSettings(..)")
        self._choice = ActionChoice(acting, self._config, self._actor, self._critics) if acting.chooses else None
        self._acting = acting
        # Offsets were fitted while it acted as its config says: acting otherwise it earns something else.
        fitted = self._config.recalibration if acting == self._config.acting else None
        self._recalibration = None if fitted is None else fitted.at(self._fractions)

    @property
    def recalibrated(self) -> bool:
        """Whether the quantiles that are told are what the critics say, shifted by the config's recalibration."""
        return self._recalibration is not None

    def forget(self) -> None:
        """Forget everything that was seen."""
        self._states = np.zeros((self._encoders.number, self._encoders.state_size), dtype=np.float32)
        self.empty = True

    def see(self, bins: Array, vectors: Sequence[float] | Array, context: float | None) -> Outlook:
        """Take a step, and return what the agent does then and expects of that.

        Args:
            bins: range observation, float32 [180].
            vectors: the vector observations, one behind the other, [k].
            context: what it is told besides, see :func:`~rcdsac_trl.deploy.policy.context.context_of`.
        """
        weight = (context,) if self._config.context == "collision_weight" and context is not None else ()
        told = np.array((*vectors, *weight), dtype=np.float32)
        self._states = self._encoders.step(bins, told, self._states)
        self._read = self._encoders.heads_read(self._states, told)
        self.empty = False
        return self.outlook(context)

    def outlook(self, context: float | None, action: Array | None = None) -> Outlook:
        """Return what the agent does where it stands, or an action [2] in its stead, and what it expects of that."""
        embedded = self._embedded(context)
        if action is None:
            action = self._chosen(context, embedded)
        lower = self._critics.values(self._read[1:], action, embedded)
        told = self._tell(lower, context)
        raw, quantiles = (lower, told) if self._config.critic == "quantile" else (None, None)
        values = told.tolist()  # of so few, Python's sum is the fastest mean
        velocities = desired_velocities(action.tolist(), self._config.robot)
        return Outlook(action, velocities, quantiles, sum(values) / len(values), raw)

    def outlooks(self, actions: Array, context: float | None) -> Array:
        """Return what is told of the return of many actions [K, 2]: quantiles, [K, N], or its mean alone, [K, 1]."""
        return self._tell(self._critics.of_actions(self._read[1:], actions, self._embedded(context)), context)

    def _chosen(self, context: float | None, embedded: float | None) -> Array:
        """Return what the agent does where it stands, [2]."""
        if self._choice is None:
            return self._actor.action(self._read[0], embedded)
        return self._choice.best(self._read, self._beta(context), embedded)

    def _tell(self, lower: Array, context: float | None) -> Array:
        """Return what is told where the critics say this, [.., N]."""
        if self._recalibration is None:
            return lower
        return self._recalibration.tell(lower, self._beta(context))

    def _beta(self, context: float | None) -> float | None:
        """Return the beta that the agent is told; None where that is nothing, or a collision weight."""
        return context if self._config.context == "beta" else None

    def _embedded(self, context: float | None) -> float | None:
        """Return what the heads are told; None where they are told nothing."""
        if self._config.embedding is None or context is None:
            return None
        return self._config.embedding[0] * context + self._config.embedding[1]
