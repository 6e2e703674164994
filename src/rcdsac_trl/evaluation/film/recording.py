"""What a film shows of episodes, taken down while they are driven."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModuleBase
from torch import Tensor

from rcdsac_trl.deploy.policy.distortion import fractions_of
from rcdsac_trl.deploy.policy.recalibration import Recalibration
from rcdsac_trl.rollout.quantile_predictor import QuantilePredictor
from rcdsac_trl.world.render import Scene
from rcdsac_trl.world.task.agent_group import AgentGroup


@dataclass(frozen=True)
class Moment:
    """One agent at one step, as it acts.

    Attributes:
        scene: what there is around it.
        beta: its context; None for an agent that has none.
        speed_m_per_s: measured linear velocity, backwards below 0.
        collisions: contacts begun so far.
        goals: reached so far.
        quantiles: of the return from here on, as the agent tells them, ``[N]``; None without critics that know them.
    """

    scene: Scene
    beta: float | None
    speed_m_per_s: float
    collisions: int
    goals: int
    quantiles: NDArray[np.floating] | None


class Recorder(TensorDictModuleBase):
    """A policy that is watched: before each step it takes down one moment of some agents.

    Args:
        policy: acts.
        agents: those that it acts for.
        rows: the agents that are watched.
        predictor: of the same agents' returns; None takes none down.
        recalibration: by which they tell what it predicts; None: as it is.

    Attributes:
        tracks: the moments of each watched agent, the earliest first.
    """

    def __init__(
        self,
        policy: TensorDictModuleBase,
        agents: AgentGroup,
        rows: Sequence[int],
        predictor: QuantilePredictor | None = None,
        recalibration: Recalibration | None = None,
    ) -> None:
        super().__init__()
        self.in_keys, self.out_keys = policy.in_keys, policy.out_keys
        self.policy = policy
        self.tracks: list[list[Moment]] = [[] for _ in rows]
        self._agents = agents
        self._rows = rows
        self._predictor = predictor
        self._recalibration = recalibration

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Act, and take down."""
        tensordict = self.policy(tensordict)
        quantiles = self._quantiles(tensordict)
        betas = _betas(tensordict)
        buffers = self._agents.buffers
        for number, row in enumerate(self._rows):
            scene, track = self._agents.scene(row), self.tracks[number]
            before = track[-1] if track else None
            collided = scene.in_contact and (before is None or not before.scene.in_contact)
            moment = Moment(
                scene=scene,
                beta=None if betas is None else float(betas[row, 0]),
                speed_m_per_s=float(buffers.velocity[row, 0]),
                collisions=(0 if before is None else before.collisions) + collided,
                goals=(0 if before is None else before.goals) + int(buffers.goal_reached[row, 0]),
                quantiles=quantiles[number],
            )
            track.append(moment)
        return tensordict

    def _quantiles(self, tensordict: TensorDictBase) -> Sequence[NDArray[np.floating] | None]:
        """Return what each watched agent tells of its return, ``[N]``."""
        if self._predictor is None:
            return [None] * len(self._rows)
        said = self._predictor.step(tensordict).numpy()
        if self._recalibration is None:
            return list(said.copy())
        telling = self._recalibration.at(fractions_of(said.shape[1]))
        betas = _betas(tensordict)
        told = [None if betas is None else float(betas[row, 0]) for row in self._rows]
        return [telling.tell(quantiles, beta) for quantiles, beta in zip(said, told, strict=True)]


def _betas(tensordict: TensorDictBase) -> Tensor | None:
    """Return what agents are told, ``[N, 1]``."""
    return tensordict["risk"] if "risk" in tensordict.keys() else None  # noqa: SIM118 (a tensordict's keys)
