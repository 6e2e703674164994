"""Real trainings that take about a second, for the tests of the pipeline."""

import json
import shutil
from functools import cache
from importlib import import_module
from pathlib import Path

import pytest
import torch
import yaml
from omegaconf import DictConfig, OmegaConf
from tensordict import TensorDict
from torch.optim.swa_utils import AveragedModel
from torchrl.objectives import LossModule

from rcdsac_trl.config.checkpoint_name import CheckpointName
from rcdsac_trl.config.compose import combinations, compose
from rcdsac_trl.config.paths import CONF_DIR
from rcdsac_trl.config.run_config import training_settings
from rcdsac_trl.config.training_settings import TrainingSettings
from rcdsac_trl.deploy.policy.registry import find_weights
from rcdsac_trl.deploy.policy.weights import packed
from rcdsac_trl.evaluation.evaluation import make_evaluation
from rcdsac_trl.release.named_agent import named_agent
from rcdsac_trl.robot.observation import vector_observations
from rcdsac_trl.rollout.make_agent import make_average, make_loss
from rcdsac_trl.seeding import torch_stream
from rcdsac_trl.storage.checkpoint import Checkpoints
from rcdsac_trl.storage.checkpoint_record import Progress, find
from rcdsac_trl.training.learner import Learner
from rcdsac_trl.training.make_learner import make_learner
from rcdsac_trl.training.run_folder import start_run_folder
from rcdsac_trl.training.setup import check_training, make_trainer
from rcdsac_trl.training.trainer import Trainer
from rcdsac_trl.world.task.rules import REWARD_COMPONENTS

ROWS = sorted(path.stem for path in (CONF_DIR / "algo").glob("*.yaml"))
"""Every row of the registry."""

AGENTS = 2
STEPS = 20
ITERATIONS = 2
UPDATES = 2

TINY = [
    "preset=smoke",
    "map=easy",
    "map.size_m=10",
    "map.layouts=[clutter]",
    "collector.num_processes=0",
    f"world.num_agents={AGENTS}",
    f"task.episode_steps={STEPS}",
    f"schedule.iterations={ITERATIONS}",
    f"schedule.updates_per_iteration={UPDATES}",
    "learner.sequence_length=4",
    "learner.batch_size=2",
    "validation.num_maps=1",
    "validation.processes=0",
    "threads=1",
    "logger=none",
]

NARROW = "network={conv: 4, range: 8, vector: 4, memory: 8, head: 8, cosines: 4}"
"""Networks of a few thousand weights."""

SMALL = [*TINY, NARROW, "schedule.iterations=1"]
"""As small as a training gets."""

Calls = list[tuple[str, str]]
"""Verb and run folder of the programs that a sweep has called."""


@cache
def _tiny_cfg(overrides: tuple[str, ...]) -> DictConfig:
    return compose("train", list(overrides))


def tiny_cfg(row: str = "rcdsac_pow", *overrides: str) -> DictConfig:
    """Compose the config of a tiny training."""
    return _tiny_cfg((f"+algo={row}", *TINY, *overrides))


def tiny_settings(row: str = "rcdsac_pow", *overrides: str) -> TrainingSettings:
    """Read the settings of a tiny training."""
    return training_settings(tiny_cfg(row, *overrides))


def tiny_trainer(folder: Path, row: str = "rcdsac_pow", *overrides: str) -> Trainer:
    """Make a tiny training, as the command line does."""
    cfg = tiny_cfg(row, *overrides)
    check_training(cfg)
    return make_trainer(cfg, folder)


def filled_learner(row: str, *overrides: str) -> Learner:
    """Make the learner of a tiny training, its replay filled with episodes of noise."""
    settings = tiny_settings(row, *overrides)
    learner, algo = make_learner(settings, "cpu"), settings.algo
    generator = torch_stream(0, "episodes of noise")

    def uniform(size: int) -> torch.Tensor:
        return torch.rand(ITERATIONS * AGENTS, STEPS, size, generator=generator)

    def observations() -> dict[str, torch.Tensor]:
        vectors = vector_observations(settings.sensor.memory_s)
        return {"range": uniform(180)} | {key: uniform(size) for key, size in vectors.items()}

    content: dict = observations() | {"action": 2.0 * uniform(2) - 1.0}
    if algo.context_key is not None:
        low, high = algo.told_weights or (algo.distortion.low, algo.distortion.high)
        content[algo.context_key] = low + (high - low) * uniform(1)[:, :1].expand(-1, STEPS, -1)
    content["next"] = observations() | {"reward_components": -uniform(len(REWARD_COMPONENTS))}
    learner.replay.add_episodes(TensorDict(content, batch_size=[ITERATIONS * AGENTS, STEPS]))
    return learner


def untrained_run(folder: Path, row: str, *overrides: str) -> tuple[Path, LossModule, AveragedModel]:
    """Write a run folder whose agent has its first weights, the average moved a little so that one can tell."""
    cfg = tiny_cfg(row, *overrides)
    trained = training_settings(cfg)
    loss = make_loss(trained, "cpu")
    average = make_average(loss, trained.learner)
    with torch.no_grad():
        for parameter in average.parameters():
            parameter += 0.01
    start_run_folder(folder, cfg, {})
    components = {"loss": loss, "average": average}
    Checkpoints(folder / "checkpoints", components, replay=None, keep=1).save(Progress(updates=7), {})
    return folder, loss, average


def load_progress(checkpoints: Path, name: CheckpointName) -> Progress:
    """Read how far a run was at a checkpoint."""
    return find(checkpoints, name)[0].progress


def evaluate(*overrides: str) -> Path:
    """Evaluate two episodes on one map, as the command line does; return where it wrote."""
    given = ["num_maps=1", "num_episodes=2", "num_workers=0", "threads=1", *overrides]
    evaluation = make_evaluation(compose("evaluate", given))
    evaluation.run()
    return evaluation.results.path


def exported(run: Path, folder: Path) -> Path:
    """Write what an export of a run's best checkpoint is measured by, which takes less time than its programs."""
    agent = named_agent(run)
    folder.mkdir()
    assert agent.training is not None
    for name, content in (packed(agent.weights()) | {"training.yaml": agent.training}).items():
        (folder / name).write_bytes(content)
    return folder


def evaluation_betas(row: str) -> list[float]:
    """Return what an evaluation of a row must be told: some betas where it is risk-conditioned."""
    if not row.startswith("rcdsac"):
        return []
    return [0.25, 1.0] if "cvar" in row else [-2.0, -1.0]


def yaml_of(path: str) -> dict:
    """Read one file of conf/."""
    values: dict = yaml.safe_load((CONF_DIR / path).read_text())
    return values


@cache
def _composed_once(config_name: str, overrides: tuple[str, ...]) -> DictConfig:
    cfg = compose(config_name, list(overrides))
    OmegaConf.set_readonly(cfg, True)  # what one sweep changed, the next would be given
    return cfg


def first_combinations_only(monkeypatch: pytest.MonkeyPatch) -> None:
    """Let the first combination of each run of a sweep stand for the others, composed once for all sweeps."""
    module = import_module("rcdsac_trl.experiments.sweep_jobs")
    monkeypatch.setattr(module, "combinations", lambda overrides: combinations(overrides)[:1])
    monkeypatch.setattr(module, "compose", lambda name, overrides: _composed_once(name, tuple(overrides)))


def agent_of_before(folder: Path) -> Path:
    """Write a shipped agent as earlier versions exported theirs: it says no temperature, and restarts otherwise."""
    shutil.copytree(find_weights("dsac_pow_-1-narrow"), folder)
    config = json.loads((folder / "config.json").read_bytes())
    del config["provenance"]["temperature"]
    config["restart_steps"] = 2
    (folder / "config.json").write_text(json.dumps(config))
    trained = OmegaConf.load(folder / "training.yaml")
    trained.network.restart_steps = 2
    OmegaConf.save(trained, folder / "training.yaml")
    return folder
