"""Beta that is turned at run time, in an evaluation: the same controllers as on a robot, for a whole worker."""

from collections.abc import Sequence

import numpy as np
import torch
from numpy.typing import NDArray
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModuleBase
from torch import Tensor

from rcdsac_trl.deploy.policy.beta_controllers import BetaController
from rcdsac_trl.robot.observation import range_distances
from rcdsac_trl.robot.range_sensor import MAX_RANGE_M
from rcdsac_trl.rollout.quantile_predictor import QuantilePredictor


class AdaptivePolicy(TensorDictModuleBase):
    """A policy whose agents are told beta by controllers, each by its own.

    Args:
        policy: acts on `risk`.
        controllers: one an agent.
        predictor: of the returns of the agents whose controllers read them; None: no controller does.
        max_range_m: reach of the range sensor.

    Attributes:
        told: the betas of each step since the last reset, ``[N]`` each.
    """

    def __init__(
        self,
        policy: TensorDictModuleBase,
        controllers: Sequence[BetaController],
        predictor: QuantilePredictor | None = None,
        max_range_m: float = MAX_RANGE_M,
    ) -> None:
        super().__init__()
        self.in_keys, self.out_keys = policy.in_keys, [*policy.out_keys, "risk"]
        self.policy = policy
        self.controllers = controllers
        self.predictor = predictor
        self._max_range_m = max_range_m
        self.told: list[Tensor] = []
        self._quantiles: dict[int, NDArray[np.float32]] = {}

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Write `risk`, and what the policy writes."""
        # A worker begins its episodes together.
        if tensordict["is_init"].all():
            self.told, self._quantiles = [], {}
            for controller in self.controllers:
                controller.reset()
        distances = range_distances(tensordict["range"].numpy(), self._max_range_m)
        betas = [
            controller(distances[row], self._quantiles.get(row)) for row, controller in enumerate(self.controllers)
        ]
        told = torch.tensor(betas, dtype=torch.float64, device="cpu")
        self.told.append(told)
        tensordict = self.policy(tensordict.set("risk", told.float().unsqueeze(1)))
        if self.predictor is not None:
            quantiles = self.predictor.step(tensordict).numpy()
            self._quantiles = dict(zip(self.predictor.rows.tolist(), quantiles, strict=True))
        return tensordict

    def mean_betas(self) -> Tensor:
        """Return the mean over the steps since the last reset, ``[N]``."""
        return torch.stack(self.told).mean(0)
