"""The agent of a run as weights to deploy."""

import json
import sys
from collections.abc import Mapping
from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from rcdsac_trl.agent.risk import RiskMeasure
from rcdsac_trl.config.checkpoint_name import CheckpointName
from rcdsac_trl.config.run_config import CHECKPOINTS, AgentOfRun, agent_of_run
from rcdsac_trl.config.training_settings import TrainingSettings
from rcdsac_trl.deploy.policy.agent_config import AgentConfig, Context
from rcdsac_trl.deploy.policy.weights import Weights
from rcdsac_trl.errors import UserInputError
from rcdsac_trl.storage.checkpoint import load_states
from rcdsac_trl.storage.checkpoint_record import Progress

# Where the parts lie in a checkpoint: in the running average of the actor, and in the loss.
_ACTOR = "module.module.{}.module."
_CRITIC = "critic_network_params.{}.module.{}.module."
_LEARNING_ACTOR = "actor_network_params.module.{}.module."
_PARTS = ("encoder", "head")
TEMPERATURE = "temperature"
"""Key of an agent's provenance: what a nat of entropy was worth to its critics, as a reward."""


def weights_of_run(folder: Path, checkpoint: CheckpointName) -> Weights:
    """Read the agent of a run: the averaged actor, which is what evaluations drive, and the critics.

    Args:
        folder: of the run.
        checkpoint: ``"best"``, ``"last"``, or the iterations done.

    Raises:
        UserInputError: if there is no such run or checkpoint, its weights do not fit its config, or it has an encoder
            of its own.
    """
    agent = agent_of_run(folder)
    if agent.network.encoder is not None:
        raise UserInputError(
            f"{folder} has network.encoder={agent.network.encoder}, and weights folders hold our own encoder alone: "
            "export its actor from Python, as docs/agent.md shows"
        )
    saved, states, damaged = load_states(folder / CHECKPOINTS, checkpoint)
    for sentence in damaged:
        print(f"rcdsac_trl: {sentence}", file=sys.stderr)
    tensors: dict[str, Tensor] = {}
    for number, part in enumerate(_PARTS):
        tensors |= _below(states["average"], _ACTOR.format(number), f"actor.{part}.")
    num_critics = 0
    while head := _below(states["loss"], _CRITIC.format(num_critics, 1), f"critics.{num_critics}.head."):
        encoder = _below(states["loss"], _CRITIC.format(num_critics, 0), f"critics.{num_critics}.encoder.")
        tensors |= encoder | head
        num_critics += 1
    provenance = _provenance(folder, checkpoint, saved.progress)
    provenance[TEMPERATURE] = float(states["loss"]["log_alpha"].exp())
    if agent.algo.fixed_weight != 1.0:
        provenance["collision_weight"] = agent.algo.fixed_weight
    config = agent_config(agent, num_critics, provenance)
    return Weights(config, {name: np.ascontiguousarray(tensor.numpy()) for name, tensor in tensors.items()})


def _below(state: Mapping[str, Tensor], prefix: str, new: str) -> dict[str, Tensor]:
    """Return what lies below a prefix under another; what is computed, as cosines' frequencies, is no weight."""
    found = {name.removeprefix(prefix): value for name, value in state.items() if name.startswith(prefix)}
    return {new + name: value for name, value in found.items() if not name.startswith(("cosines.", "look_ahead."))}


def states_of_weights(weights: Weights) -> tuple[dict[str, Tensor], dict[str, Tensor]]:
    """Return an agent's tensors by their names in the states of a loss and of an averaged actor.

    The loss gets the critics, and the averaged actor in place of the learning one.
    """
    loss: dict[str, Tensor] = {}
    average: dict[str, Tensor] = {}
    for number, part in enumerate(_PARTS):
        for name, value in weights.part(f"actor.{part}").items():
            average[_ACTOR.format(number) + name] = loss[_LEARNING_ACTOR.format(number) + name] = _tensor(value)
        for critic in range(weights.config.num_critics):
            for name, value in weights.part(f"critics.{critic}.{part}").items():
                loss[_CRITIC.format(critic, number) + name] = _tensor(value)
    return loss, average


def _tensor(value: NDArray[np.float32]) -> Tensor:
    return torch.from_numpy(value.copy())


def agent_config(
    agent: AgentOfRun | TrainingSettings, num_critics: int, provenance: Mapping[str, str | int | float | None]
) -> AgentConfig:
    """Return what one has to know of an agent to drive with it.

    Args:
        agent: what it is, or all that it was trained with.
        num_critics: number of critics.
        provenance: where it comes from.
    """
    algo, task, motor_period_s = agent.algo, agent.task, agent.robot.motor_period_s
    context: Context | None = None
    context_range = None
    if (measure := algo.network_measure) is not None:
        context, context_range = "beta", (measure.low, measure.high)
    elif algo.told_weights is not None:
        context, context_range = "collision_weight", algo.told_weights
    return AgentConfig(
        name=algo.name,
        sensor=agent.sensor.name,
        critic=algo.critic,
        num_critics=num_critics,
        context=context,
        context_range=context_range,
        measure=algo.distortion.name,
        embedding=None if measure is None else _embedding(measure),
        fixed_beta=algo.beta,
        network=agent.network.widths,
        period_s=(min(task.motor_steps) * motor_period_s, max(task.motor_steps) * motor_period_s),
        waypoint_radius_m=task.waypoint_radius_m,
        goal_radius_m=task.goal_radius_m,
        provenance=provenance,
        padding=agent.network.padding,
        memory_s=agent.sensor.memory_s,
        range_code=agent.network.range_code,
        restart_steps=agent.network.restart_steps,
        look_ahead=agent.network.look_ahead,
        robot=agent.robot,
        acting=agent.acting,
    )


def _embedding(measure: RiskMeasure) -> tuple[float, float]:
    """Return slope and offset of a measure's embedding, which is linear for all of them."""
    offset = measure.embed(0.0)
    slope = measure.embed(1.0) - offset
    for beta in (measure.low, measure.high):
        if abs(slope * beta + offset - measure.embed(beta)) > 1e-12:
            raise NotImplementedError(f"the embedding of measure {measure.name!r} is not linear: weights hold a line")
    return slope, offset


def _provenance(folder: Path, checkpoint: CheckpointName, progress: Progress) -> dict[str, str | int | float | None]:
    manifest = {}
    if (path := folder / "manifest.json").is_file():
        manifest = json.loads(path.read_bytes())
    return {
        "commit": manifest.get("commit"),
        "seed": manifest.get("seed"),
        "checkpoint": checkpoint,
        "iterations": progress.iterations,
        "agent_steps": progress.steps,
        "updates": progress.updates,
        "validation_score": progress.best_score if checkpoint == "best" else None,
    }
