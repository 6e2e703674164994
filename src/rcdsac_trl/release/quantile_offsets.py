"""Offsets by which an agent tells true quantiles, fitted on how it drove: what leaves the machine has them.

``calibrate as_driven=true split=validation`` of a run is what they are fitted on, and ``split=evaluation`` what they
are checked on: offsets are never fitted on the maps that they are judged by.
"""

import json
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
from numpy.typing import NDArray

from rcdsac_trl.config.checkpoint_name import CheckpointName
from rcdsac_trl.config.command_line import assigned
from rcdsac_trl.deploy.policy.acting import ActingSettings
from rcdsac_trl.deploy.policy.agent_config import AgentConfig
from rcdsac_trl.deploy.policy.distortion import fractions_of
from rcdsac_trl.deploy.policy.recalibration import Recalibration
from rcdsac_trl.deploy.policy.registry import agent_name
from rcdsac_trl.deploy.policy.weights import Weights, digest_of, halved
from rcdsac_trl.errors import UserInputError
from rcdsac_trl.robot.robot_settings import PAPER

Array = NDArray[np.float64]

# Of an offset, as files have it: returns differ by tens.
_DIGITS = 3


def fitted_offsets(quantiles: Array, returns: Array, fractions: Array) -> Array:
    r"""Return what quantiles have to be shifted by, [N]: for each the empirical quantile of what it falls short by.

    With R states, the smallest offset at which at least :math:`\tau_i R` of the returns lie at or below the shifted
    quantile, so that exactly :math:`\lceil \tau_i R \rceil` do where no two fall short by the same.

    Args:
        quantiles: as critics say them, one row a state, [R, N].
        returns: that were earned from there, [R].
        fractions: of the quantiles, [N].

    Example:
        >>> fitted_offsets(np.zeros((4, 2)), np.array([1.0, 2.0, 3.0, 4.0]), np.array([0.25, 0.75])).tolist()
        [1.0, 3.0]
    """
    short = returns[:, None] - quantiles
    pairs = zip(short.T, fractions, strict=True)
    return np.array([np.quantile(column, tau, method="inverted_cdf") for column, tau in pairs])


def fit_recalibration(folder: Path, agent: str) -> Recalibration:
    """Return the offsets that a folder which ``calibrate as_driven=true`` wrote asks for.

    Each beta gets its own: where an agent is averse, critics know less of the worst that comes of it.

    Args:
        folder: that was written.
        agent: name by which the command that is noted calls it.

    Raises:
        UserInputError: if it holds another calibration, or one on other maps than validation's, or cannot be read.
    """
    described = _described(folder)
    if not described.get("as_driven", False):
        raise UserInputError(
            f"{folder} holds returns of drawn actions: offsets are fitted on those of an agent as it acts, calibrate "
            "with as_driven=true split=validation"
        )
    if described["split"] != "validation":
        raise UserInputError(
            f"{folder} was driven on {described['split']} maps, which offsets are checked on: calibrate with "
            "split=validation to fit them"
        )
    try:
        predictions, returns = (pd.read_csv(folder / name) for name in ("predictions.csv", "returns.csv"))
        states = predictions.merge(returns, on=["beta", "map", "state"], validate="one_to_one")
        said = states.filter(regex=r"^q\d+$").to_numpy(np.float64)
        earned = states["discounted_reward"].to_numpy(np.float64)
    except (OSError, ValueError, KeyError) as error:
        raise UserInputError(f"{folder} cannot be read ({error}): calibrate again into another folder") from error
    fractions = fractions_of(said.shape[1]).astype(np.float64)
    betas = sorted(beta for beta in described["betas"] if beta is not None)
    told = [np.isclose(states["beta"], beta) for beta in betas] or [np.ones(len(states), np.bool_)]
    offsets = [fitted_offsets(said[met], earned[met], fractions).round(_DIGITS).tolist() for met in told]
    return Recalibration(
        fractions=tuple(fractions.tolist()),
        betas=tuple(betas),
        offsets=tuple(map(tuple, offsets)),
        split=described["split"],
        seed=described["seed"],
        num_maps=described["num_maps"],
        num_episodes=described["num_episodes"],
        num_states=len(states),
        horizon_steps=described["horizon_steps"],
        command=_command(agent, described, betas),
    )


def _command(agent: str, described: Mapping[str, Any], betas: Sequence[float]) -> str:
    keys = ("split", "seed", "num_maps", "num_episodes", "every_steps", "horizon_steps")
    given = [assigned("run", agent), "as_driven=true", *(f"{key}={described[key]}" for key in keys)]
    told = [f"beta=[{','.join(f'{beta:g}' for beta in betas)}]"] if betas else []
    return " ".join(["python -m rcdsac_trl.calibrate", *given, *told])


def driven_calibration(run: Path, checkpoint: CheckpointName, weights: Weights, split: str) -> Path | None:
    """Return where a run's agent was calibrated as it drives, with most states; None where it was not.

    It is of that checkpoint and these weights, and acted as they say. One of the weights as they ship, in half
    precision, comes before one of those that were trained.

    Args:
        run: its folder.
        checkpoint: of the agent.
        weights: of the agent, in single precision.
        split: of the maps that were driven.
    """
    shipped, digests = _digests(weights)
    found = {}
    for path in sorted(run.glob("calibration/*/calibration.json")):
        described = _described(path.parent)
        if described["split"] != split or not _is_of(described, checkpoint, weights, digests):
            continue
        number = described["num_maps"] * described["num_episodes"] * len(described["conditions"])
        found[path.parent] = (described.get("weights_sha256") == shipped, number)
    return max(found, key=lambda folder: found[folder]) if found else None


def _digests(weights: Weights) -> tuple[str, frozenset[str | None]]:
    """Return the digest of the weights as they ship, and all that a calibration of them may name.

    One of a run's checkpoint as it was trained does not say which weights drove: None.
    """
    shipped = digest_of(halved(weights), half=True)
    return shipped, frozenset({shipped, digest_of(weights), None})


def _is_of(described: Mapping[str, Any], checkpoint: object, weights: Weights, digests: frozenset[str | None]) -> bool:
    """Tell whether a calibration is one as driven, of that checkpoint and these weights, which acted as they say."""
    if not described.get("as_driven", False) or described["checkpoint"] != checkpoint:
        return False
    known = described.get("weights_sha256") in digests
    return known and ActingSettings(**described["acting"]) == weights.config.acting


def with_offsets(weights: Weights, run: Path, checkpoint: CheckpointName) -> Weights:
    """Return a run's agent with the offsets that its calibration on validation maps asks for; as it is without one.

    Args:
        weights: of the agent, in single precision.
        run: its folder.
        checkpoint: of the agent.
    """
    folder = driven_calibration(run, checkpoint, weights, "validation")
    return weights if folder is None else _fitted(weights, folder)


def with_calibration(weights: Weights, checkpoint: object, folder: Path) -> Weights:
    """Return an agent with the offsets that a calibration asks for, wherever it lies; they replace those it has.

    Args:
        weights: of the agent.
        checkpoint: of the training that they are of, as descriptions have it.
        folder: that ``calibrate as_driven=true split=validation`` of this agent wrote.

    Raises:
        UserInputError: if it holds no such calibration.
    """
    _check_driven(folder, weights, checkpoint)
    return _fitted(weights, folder)


def check_checked(folder: Path, weights: Weights, checkpoint: object) -> None:
    """Refuse a folder on which an agent's offsets cannot be checked.

    Args:
        folder: that ``calibrate as_driven=true split=evaluation`` of this agent wrote.
        weights: of the agent.
        checkpoint: of the training that they are of, as descriptions have it.

    Raises:
        UserInputError: if it holds no such calibration.
    """
    _check_driven(folder, weights, checkpoint)
    if (split := _described(folder)["split"]) != "evaluation":
        raise UserInputError(
            f"{folder} was driven on {split} maps, which offsets are fitted on: calibrate with split=evaluation to "
            "check them"
        )


def _check_driven(folder: Path, weights: Weights, checkpoint: object) -> None:
    """Refuse a folder that holds no calibration as driven of an agent."""
    if not (folder / "calibration.json").is_file():
        raise UserInputError(f"{folder} holds no calibration: name a folder that calibrate wrote")
    if not _is_of(_described(folder), checkpoint, weights, _digests(weights)[1]):
        raise UserInputError(
            f"{folder} holds no calibration of {name_of(weights.config)} as it drives now ({weights.config.acting}): "
            "calibrate it with as_driven=true, the same checkpoint and acting"
        )


def _fitted(weights: Weights, folder: Path) -> Weights:
    recalibration = fit_recalibration(folder, name_of(weights.config))
    return replace(weights, config=replace(weights.config, recalibration=recalibration))


def name_of(config: AgentConfig) -> str:
    """Return what an agent is called that is published."""
    robot = None if config.robot == PAPER else config.robot.name
    return agent_name(config.name, config.fixed_beta, config.sensor, robot)


def _described(folder: Path) -> dict[str, Any]:
    described: dict[str, Any] = json.loads((folder / "calibration.json").read_bytes())
    return described
