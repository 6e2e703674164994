"""Agents that are shipped: small weights, what was measured of them, a card, and the tables behind it."""

import json
from collections.abc import Callable, Mapping
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from omegaconf import DictConfig

from rcdsac_trl.config.checkpoint_name import CheckpointName
from rcdsac_trl.config.command_line import assigned
from rcdsac_trl.config.release_settings import PublishSettings
from rcdsac_trl.config.run_config import TRAINING_NAME, read_config
from rcdsac_trl.deploy.policy.acting import ActingSettings
from rcdsac_trl.deploy.policy.agent_config import AgentConfig
from rcdsac_trl.deploy.policy.measured import Measured, measured_of
from rcdsac_trl.deploy.policy.model_card import limits_of
from rcdsac_trl.deploy.policy.weights import Weights, digest_of, halved, packed
from rcdsac_trl.errors import UserInputError
from rcdsac_trl.release.named_agent import RunAgent, named_agent
from rcdsac_trl.release.quantile_offsets import driven_calibration, name_of, with_offsets
from rcdsac_trl.release.rounding import check_rounding, largest_differences
from rcdsac_trl.release.run_weights import weights_of_run
from rcdsac_trl.storage import atomic
from rcdsac_trl.system.invocation import program
from rcdsac_trl.system.resources import check_writable
from rcdsac_trl.world.maps.generator import MapSettings
from rcdsac_trl.world.task.rules import TaskSettings

# What stays of a run, where it has it: enough for every table and figure of a report.
_TABLES = ("config.yaml", "training_episodes.csv", "validation_episodes.csv", "csv/scalars/time/elapsed_s.csv")
_EVALUATION = ("evaluation.json", "episodes.csv", "collisions.csv")

Tell = Callable[[NDArray[np.floating], float | None], NDArray[np.floating]]
"""Returns what an agent tells where its critics say some quantiles at a beta."""
Describe = Callable[[Path, Path | None, Path | None, Tell | None], dict[str, Any]]
"""Returns what an evaluation, a calibration and one as driven, if there are such, say of an agent that tells so."""


@dataclass(frozen=True)
class Published:
    """An agent that is about to be shipped.

    Attributes:
        run: folder of its run.
        weights: of its agent, as it was trained.
        small: these in half precision, as they ship.
        training: the config of its training, as a file.
        evaluation: folder of the evaluation that its card quotes.
        as_shipped: whether that drove the weights that ship.
        calibration: folder of the calibration that its card quotes; None where there is none.
        driven: likewise, of a calibration as driven.
    """

    run: Path
    weights: Weights
    small: Weights
    training: bytes
    evaluation: Path
    as_shipped: bool
    calibration: Path | None
    driven: Path | None

    def measured(self, name: str, precision: Mapping[str, float], describe: Describe) -> Measured:
        """Return what is known of it.

        Args:
            name: that it gets.
            precision: what rounding changed.
            describe: returns what the folders say.
        """
        recalibration = self.small.config.recalibration
        values = describe(
            self.evaluation, self.calibration, self.driven, None if recalibration is None else recalibration.tell
        )
        told = values["protocol"]
        again = f"seed={told['seed']} num_maps={told['num_maps']} num_episodes={told['num_episodes']}"
        return measured_of(
            values
            | {
                "weights_sha256": digest_of(self.small, half=True),
                "as_shipped": self.as_shipped,
                "command": f"python -m rcdsac_trl.verify {name} {again}",
                "precision": precision,
                "limits": limits_of(self.weights.config),
            }
        )


@dataclass(frozen=True)
class Publication:
    """Agents by the names they get, and where they go.

    Attributes:
        agents: by name.
        weights: folder that takes a folder of each.
        results: likewise, of the tables.
    """

    agents: Mapping[str, Published]
    weights: Path
    results: Path

    def run(self, describe: Describe) -> None:
        """Write all of them, and print a sentence on each.

        Args:
            describe: returns the measured numbers of folders.

        Raises:
            FaultError: if half precision changes one too much; nothing is written then.
        """
        differences = {name: largest_differences(agent.weights, agent.small) for name, agent in self.agents.items()}
        for name, changed in differences.items():
            check_rounding(name, changed)
        for name, agent in self.agents.items():
            measured = agent.measured(name, differences[name], describe)
            # The tables come first: who finds weights finds what is said of them.
            evaluation = agent.evaluation.relative_to(agent.run)
            for path in (*map(Path, _TABLES), *(evaluation / file for file in _EVALUATION)):
                if (agent.run / path).is_file():
                    target = self.results / name / path
                    target.parent.mkdir(parents=True, exist_ok=True)
                    atomic.write(target, (agent.run / path).read_bytes())
            # The config comes last here, too: a folder that has one is complete.
            files = {TRAINING_NAME: agent.training} | packed(agent.small, half=True, measured=measured)
            (self.weights / name).mkdir(parents=True, exist_ok=True)
            for file, content in files.items():
                atomic.write(self.weights / name / file, content)
            size = sum(map(len, files.values())) / 1e6
            print(f"{name}: {size:.1f} MB, {_said(measured)}{_told(agent.small.config)}")


def _told(config: AgentConfig) -> str:
    """Say what an agent tells of its return."""
    if config.critic == "scalar":
        return ""
    if config.recalibration is None:
        return "; it tells raw quantiles, for it has no calibration as driven on validation maps"
    return f"; its quantiles are {config.recalibration}"


def _said(measured: Measured) -> str:
    """Say in a line what is quoted of an agent."""
    of = "as it ships" if measured.as_shipped else "in single precision, of which it differs by rounding"
    calibrated = "" if measured.calibration else "; no calibration is quoted"
    return f"measured {of}, {measured.num_episodes} episodes under {len(measured.conditions)} conditions{calibrated}"


def make_publication(cfg: DictConfig) -> Publication:
    """Make a publication; refuses before anything is written.

    Raises:
        UserInputError: for a run that is missing or not evaluated, two of one name, or a name that is taken.
    """
    settings = read_config(cfg, PublishSettings)
    agents: dict[str, Published] = {}
    for run in map(Path, settings.runs):
        agent = named_agent(run)
        if not isinstance(agent, RunAgent):
            raise UserInputError(
                f"{run} is an agent that was exported, and what is published are the tables of its run, too: name the "
                "run folder"
            )
        weights = settings.acting.in_weights(weights_of_run(run, settings.checkpoint))
        weights = with_offsets(weights, run, settings.checkpoint)
        config = weights.config
        name = name_of(config)
        if name in agents:
            raise UserInputError(f"{agents[name].run} and {run} are both {name}: publish one of them")
        small = halved(weights)
        evaluation, as_shipped = _evaluation_of(run, settings.checkpoint, digest_of(small, half=True), config.acting)
        calibration = _calibration_of(run, settings.checkpoint)
        driven = driven_calibration(run, settings.checkpoint, weights, "evaluation")
        agents[name] = Published(run, weights, small, agent.training, evaluation, as_shipped, calibration, driven)
    for folder in (Path(settings.weights), Path(settings.results)):
        check_writable(folder)
        for name in agents:
            if (folder / name).exists():
                raise UserInputError(f"{folder / name} exists: remove it, or publish into another folder")
    return Publication(agents, Path(settings.weights), Path(settings.results))


def _evaluation_of(run: Path, checkpoint: CheckpointName, digest: str, acting: ActingSettings) -> tuple[Path, bool]:
    """Return the evaluation of a run that is published, and whether it drove the weights that ship.

    It is of that checkpoint, on evaluation maps, of the agent alone, which acted as the one that is published does. One
    on the default maps and task comes before others, for they are what agents compare on; then one of the weights as
    they ship, then that with most episodes.

    Args:
        run: its folder.
        checkpoint: of the agent.
        digest: SHA-256 of the weights that ship.
        acting: of the agent that ships.

    Raises:
        UserInputError: if there is none.
    """
    found = {}
    others = 0
    default = _plain(asdict(MapSettings())), _plain(asdict(TaskSettings()))
    for path in sorted(run.glob("evaluation/*/evaluation.json")):
        described = json.loads(path.read_bytes())
        measured = described["checkpoint"], described["split"]
        if measured != (checkpoint, "evaluation") or _is_helped(described) or not _acted(described, acting):
            continue
        driven = described.get("weights_sha256")
        if driven not in (None, digest):
            others += 1
            continue
        number = described["num_maps"] * described["num_episodes"] * len(described["conditions"])
        found[path.parent] = ((described["map"], described["task"]) == default, driven == digest, number)
    if not found:
        called = f"{program()} evaluate {assigned('run', run.as_posix())} checkpoint={checkpoint} half_precision=true"
        if acting.chooses:
            called += "".join(f" acting.{name}={value}" for name, value in asdict(acting).items())
        stale = f" ({others} are of other weights: it was trained on)" if others else ""
        raise UserInputError(
            f"{run} has no evaluation of its checkpoint {checkpoint} that acts by {acting}{stale}: {called}"
        )
    best = max(found, key=lambda folder: found[folder])
    return best, found[best][1]


def _acted(described: Mapping[str, Any], acting: ActingSettings) -> bool:
    """Tell whether an evaluation was driven so; those of earlier versions do not say it: they took tanh(mean)."""
    acted = ActingSettings(**(described.get("acting") or {}))
    return acted == acting if acting.chooses else not acted.chooses


def _is_helped(described: Mapping[str, Any]) -> bool:
    """Tell whether an evaluation says more, or less, than how an agent drives by itself."""
    navigated = (described.get("navigation") or {}).values()
    return any([*navigated, described.get("latency_s"), described.get("controller"), described["sampled"]])


def _plain(values: Mapping[str, Any]) -> dict[str, Any]:
    """Return values as JSON has them, which knows no tuples."""
    read: dict[str, Any] = json.loads(json.dumps(values))
    return read


def _calibration_of(run: Path, checkpoint: CheckpointName) -> Path | None:
    """Return the calibration that is quoted: of that checkpoint, on evaluation maps, with most roll-outs."""
    found = {}
    for path in sorted(run.glob("calibration/*/calibration.json")):
        described = json.loads(path.read_bytes())
        if described.get("as_driven", False):
            continue
        if (described["checkpoint"], described["split"]) == (checkpoint, "evaluation"):
            found[path.parent] = described["num_maps"] * described["num_states"] * described["num_rollouts"]
    return max(found, key=lambda folder: found[folder]) if found else None
