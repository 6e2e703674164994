"""What critics say of an agent that drives as it acts, and what it earns from there on.

Returns of whole episodes need no branches: from each state one return follows, and of many states they are many.
"""

import contextlib
from collections.abc import Callable, Iterator, Sequence

import numpy as np
import pandas as pd
from numpy.typing import NDArray
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModuleBase

from rcdsac_trl.deploy.policy.distortion import NUM_REPORTED_QUANTILES, fractions_of
from rcdsac_trl.deploy.policy.recalibration import Recalibration
from rcdsac_trl.evaluation.measured_run import Findings
from rcdsac_trl.rollout.evaluation_pool import Drive, Rows
from rcdsac_trl.rollout.make_agent import unpacked_loss
from rcdsac_trl.rollout.map_evaluator import Agent, EvaluationSpec, map_evaluator
from rcdsac_trl.rollout.quantile_predictor import QuantilePredictor
from rcdsac_trl.rollout.worker import RolloutWorker
from rcdsac_trl.world.task.agent_group import AgentGroup


def discounted_returns(
    rewards: NDArray[np.float64], steps: Sequence[int], horizon_steps: int, gamma: float
) -> NDArray[np.float64]:
    """Return the discounted sums of the rewards from some steps on, [N, K].

    Args:
        rewards: of each step, [N, T].
        steps: K of them, each with a horizon behind it.
        horizon_steps: so many rewards count.
        gamma: discount.

    Example:
        >>> discounted_returns(np.array([[1.0, 2.0, 4.0]]), [0, 1], 2, 0.5).tolist()
        [[2.0, 4.0]]
    """
    discounts = gamma ** np.arange(horizon_steps)
    return np.stack([rewards[:, step : step + horizon_steps] @ discounts for step in steps], axis=1)


class ReturnRecorder(TensorDictModuleBase):
    """A policy that is watched: what the critics expect of each of its actions, and what that earned.

    Args:
        policy: acts.
        agents: those that it acts for.
        predictor: of the returns of all of them.
    """

    def __init__(self, policy: TensorDictModuleBase, agents: AgentGroup, predictor: QuantilePredictor) -> None:
        super().__init__()
        self.in_keys, self.out_keys = policy.in_keys, policy.out_keys
        self.policy = policy
        self._agents = agents
        self._predictor = predictor
        self._quantiles: list[NDArray[np.float32]] = []
        self._rewards: list[NDArray[np.float64]] = []

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Act, and take down."""
        if tensordict["is_init"].all():  # a worker begins its episodes together
            self._quantiles, self._rewards = [], []
        else:
            self._rewards.append(self._agents.buffers.reward[:, 0].astype(np.float64))
        tensordict = self.policy(tensordict)
        self._quantiles.append(self._predictor.step(tensordict).numpy())
        return tensordict

    def quantiles(self) -> NDArray[np.float32]:
        """Return what was expected at each step of the episodes, [N, T, quantiles]."""
        return np.stack(self._quantiles, axis=1)

    def rewards(self) -> NDArray[np.float64]:
        """Return what all steps earned but the last, which nobody acts after, [N, T - 1]."""
        return np.stack(self._rewards, axis=1)


@contextlib.contextmanager
def driven_returns(spec: EvaluationSpec, agent: Agent, *, every_steps: int, horizon_steps: int) -> Iterator[Drive]:
    """Make what drives one map after another and returns a row a state, in this process.

    Args:
        spec: what is driven, and how it acts.
        agent: that drives, with quantile critics.
        every_steps: states lie so many steps apart, from an episode's first one on.
        horizon_steps: rewards of a return, fewer than an episode has.
    """
    recorders: list[ReturnRecorder] = []
    number = spec.num_episodes * len(spec.conditions)
    predictor = QuantilePredictor(unpacked_loss(spec.trained, agent.loss).critics, range(number))

    def watch(worker: RolloutWorker, policy: TensorDictModuleBase) -> ReturnRecorder:
        recorders.append(ReturnRecorder(policy, worker.env.agents, predictor))
        return recorders[0]

    steps = range(0, spec.world.task.episode_steps - horizon_steps, every_steps)
    gamma = spec.trained.learner.gamma
    with map_evaluator(spec, *agent, wrap=watch) as evaluated:

        def drive(map_index: int, before_step: Callable[[], None]) -> Rows:
            evaluated(map_index, before_step)
            (recorder,) = recorders
            earned = discounted_returns(recorder.rewards(), steps, horizon_steps, gamma)
            return _rows(spec, map_index, steps, recorder.quantiles()[:, list(steps)], earned)

        yield drive


def _rows(
    spec: EvaluationSpec,
    map_index: int,
    steps: Sequence[int],
    quantiles: NDArray[np.float32],
    earned: NDArray[np.float64],
) -> Rows:
    """Return one row a state: `quantiles` [N, K, n] and returns [N, K] by their condition, episode and step."""
    return [
        {
            "beta": spec.conditions[agent // spec.num_episodes].beta,
            "map": map_index,
            "state": agent % spec.num_episodes * len(steps) + number,
            "episode": agent % spec.num_episodes,
            "step": step,
            "quantiles": quantiles[agent, number],
            "discounted_reward": earned[agent, number],
        }
        for agent in range(len(earned))
        for number, step in enumerate(steps)
    ]


_STATE = ("beta", "map", "state", "episode", "step")


def driven_findings(recalibration: Recalibration | None, rows: Rows) -> Findings:
    """Return the tables of a calibration as driven: what was expected in each state, and what it earned.

    Args:
        recalibration: by which the agent tells what its critics say; it is in the table then, too.
        rows: of all maps.
    """
    rows = sorted(rows, key=lambda row: (row["beta"] or 0.0, row["map"], row["state"]))
    states = pd.DataFrame({key: row[key] for key in _STATE} for row in rows)
    said = np.stack([row["quantiles"] for row in rows])
    columns = {f"q{number}": said[:, number] for number in range(NUM_REPORTED_QUANTILES)}
    if recalibration is not None:
        telling = recalibration.at(fractions_of(NUM_REPORTED_QUANTILES))
        told = np.stack([telling.tell(row["quantiles"], row["beta"]) for row in rows])
        columns |= {f"told{number}": told[:, number] for number in range(NUM_REPORTED_QUANTILES)}
    earned = states.assign(rollout=0, discounted_reward=[row["discounted_reward"] for row in rows])
    predictions = pd.concat([states, pd.DataFrame(columns)], axis=1)
    return Findings(
        {
            "predictions.csv": predictions.to_csv(index=False, float_format="%.6g"),
            "returns.csv": earned.to_csv(index=False, float_format="%.6g"),
        }
    )
