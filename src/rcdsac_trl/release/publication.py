"""Agents that are shipped: small weights with a card, and the tables that say how they learnt and drive."""

import json
from collections.abc import Callable, Mapping
from dataclasses import asdict, dataclass
from pathlib import Path

from omegaconf import DictConfig

from rcdsac_trl.config.command_line import assigned
from rcdsac_trl.config.evaluation_settings import Name, PublishSettings
from rcdsac_trl.config.run_config import TRAINING_NAME, read_config
from rcdsac_trl.deploy import Policy
from rcdsac_trl.deploy.policy.acting import BY_MEAN, ActingSettings
from rcdsac_trl.deploy.policy.weights import Weights, halved, packed
from rcdsac_trl.errors import UserInputError
from rcdsac_trl.release.named_agent import RunAgent, named_agent
from rcdsac_trl.release.run_weights import weights_of_run
from rcdsac_trl.robot.range_sensor import NUM_BINS
from rcdsac_trl.robot.robot_settings import PAPER
from rcdsac_trl.seeding import stream
from rcdsac_trl.storage import atomic
from rcdsac_trl.system.invocation import program
from rcdsac_trl.system.resources import check_writable

# What stays of a run, where it has it: enough for every table and figure of a report.
_TABLES = ("config.yaml", "training_episodes.csv", "validation_episodes.csv", "csv/scalars/time/elapsed_s.csv")
_EVALUATION = ("evaluation.json", "episodes.csv", "collisions.csv")
# Steps over which half precision is compared with single.
_STEPS = 200


@dataclass(frozen=True)
class Published:
    """An agent that is about to be shipped.

    Attributes:
        run: folder of its run.
        weights: of its agent.
        training: the config of its training, as a file.
        evaluation: folder of the evaluation that its card quotes.
    """

    run: Path
    weights: Weights
    training: bytes
    evaluation: Path


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

    def run(self, describe: Callable[[Path], str]) -> None:
        """Write all of them, and print a sentence on each.

        Args:
            describe: returns what a card says of an evaluation, whose folder it is given.
        """
        for name, agent in self.agents.items():
            small = halved(agent.weights)
            differs = _largest_difference(agent.weights, small)
            stored = (
                f"Stored in half precision, which changed its speeds by at most {differs:.1e} m/s in {_STEPS} steps.\n"
            )
            # The tables come first: who finds weights finds what is said of them.
            evaluation = agent.evaluation.relative_to(agent.run)
            for path in (*map(Path, _TABLES), *(evaluation / file for file in _EVALUATION)):
                if (agent.run / path).is_file():
                    target = self.results / name / path
                    target.parent.mkdir(parents=True, exist_ok=True)
                    atomic.write(target, (agent.run / path).read_bytes())
            # The config comes last here, too: a folder that has one is complete.
            files = {TRAINING_NAME: agent.training} | packed(
                small, half=True, results=f"{describe(agent.evaluation).strip()}\n\n{stored}"
            )
            (self.weights / name).mkdir(parents=True, exist_ok=True)
            for file, content in files.items():
                atomic.write(self.weights / name / file, content)
            size = sum(map(len, files.values()))
            print(f"{name}: {size / 1e6:.1f} MB; half precision changes its speeds by at most {differs:.1e} m/s")


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
        config = weights.config
        name = f"{config.name}-{config.sensor}" + ("" if config.robot == PAPER else f"-{config.robot.name}")
        if name in agents:
            raise UserInputError(f"{agents[name].run} and {run} are both {name}: publish one of them")
        agents[name] = Published(run, weights, agent.training, _evaluation_of(run, settings.checkpoint, config.acting))
    for folder in (Path(settings.weights), Path(settings.results)):
        check_writable(folder)
        for name in agents:
            if (folder / name).exists():
                raise UserInputError(f"{folder / name} exists: remove it, or publish into another folder")
    return Publication(agents, Path(settings.weights), Path(settings.results))


def _evaluation_of(run: Path, checkpoint: Name, acting: ActingSettings) -> Path:
    """Return the evaluation of a run that is published: of that checkpoint, on evaluation maps, with most episodes.

    The agent acted in it as the one that is published does.

    Raises:
        UserInputError: if there is none.
    """
    found = {}
    for path in sorted(run.glob("evaluation/*/evaluation.json")):
        described = json.loads(path.read_bytes())
        measured = described["checkpoint"], described["split"]
        # Evaluations of earlier versions do not say it: they took tanh(mean).
        acted = ActingSettings(**(described.get("acting") or {}))
        is_so = not acted.chooses if not acting.chooses else acted == acting
        if measured == (checkpoint, "evaluation") and is_so and not described.get("controller"):
            found[path.parent] = described["num_maps"] * described["num_episodes"]
    if not found:
        raise UserInputError(
            f"{run} has no evaluation of its checkpoint {checkpoint} that acts by {acting}: "
            f"{program()} evaluate {assigned('run', run.as_posix())} checkpoint={checkpoint} "
            + " ".join(f"acting.{name}={value}" for name, value in asdict(acting).items())
        )
    return max(found, key=lambda folder: found[folder])


def _largest_difference(one: Weights, other: Weights) -> float:
    """Return how far the speeds differ at most, m/s, that two agents want where they see the same."""
    rng = stream(0, "publish")
    # Of the mean: a choice among actions may fall otherwise where two are worth the same.
    policies = [Policy(weights, guard=None, acting=BY_MEAN) for weights in (one, other)]
    largest = 0.0
    for _ in range(_STEPS):
        ranges = rng.uniform(0.3, 6.0, NUM_BINS)
        waypoints = rng.uniform(-3.0, 3.0, (2, 2))
        velocity = rng.uniform((-0.2, -1.5), (0.6, 1.5))
        wanted = [policy.act(ranges, waypoints, velocity).wanted for policy in policies]
        assert wanted[0] is not None
        assert wanted[1] is not None
        largest = max(largest, abs(wanted[0][0] - wanted[1][0]))
    return largest
