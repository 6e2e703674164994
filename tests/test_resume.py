"""A run that dies at any moment and is continued ends as if nothing had happened, bit for bit."""

import json
import logging
import os
import shutil
import signal
import subprocess
import sys
from collections.abc import Iterator
from itertools import count
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from tensorboard.backend.event_processing.event_accumulator import EventAccumulator
from torchrl.checkpoint import Checkpoint

from rcdsac_trl.pipeline.saved import folders
from tiny import evaluation_betas

# Ten episodes pass through a replay of seven: it wraps in the middle of an iteration.
RUN = [
    "schedule.iterations=5",
    "network={conv: 4, range: 8, vector: 4, memory: 8, head: 8, cosines: 4}",
    "schedule.ramp_iterations=2",
    "schedule.decay_iterations=3",
    "schedule.pursuit_iterations=2",
    "replay.capacity_steps=140",
    "validation.every_iterations=2",
    "learner.actor_average_decay=0.9",
    "learner.resample_per=transition",
    "algo.distortion.evaluation_betas=[-1]",
    "logger=default",
]
Counted = dict[str, int]


class Server:
    """Trainings in processes of their own, see killable.py."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self.numbers = count()
        path = os.pathsep.join([str(Path(__file__).parent), *sys.path])
        self.process = subprocess.Popen(
            [sys.executable, str(Path(__file__).with_name("killable.py")), json.dumps(RUN)],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            text=True,
            env=os.environ | {"PYTHONPATH": path, "OMP_NUM_THREADS": "1", "RL_LOGGING_LEVEL": "WARNING"},
        )

    def call(self, do: str, run: Path, *, kill_at: tuple[str, int] | None = None, **changes: Any) -> Counted | None:
        """Train or resume; return how many events of each kind happened, or None if it was killed."""
        job = {"row": "rcdsac_pow", "overrides": RUN, "evaluate": [], "told": ["beta=[-1]"]} | changes
        out = self.folder / f"job{next(self.numbers)}"
        job |= {"do": do, "folder": str(run), "kill_at": kill_at, "out": str(out)}
        assert self.process.stdin is not None
        assert self.process.stdout is not None
        print(json.dumps(job), file=self.process.stdin, flush=True)
        status = int(self.process.stdout.readline())
        if kill_at is not None and status == -signal.SIGKILL:
            return None
        assert status == 0, out.with_suffix(".log").read_text()
        return json.loads(out.read_text())  # type: ignore[no-any-return]

    def close(self) -> None:
        self.process.communicate()


@pytest.fixture(scope="module")
def server(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Server]:
    server = Server(tmp_path_factory.mktemp("jobs"))
    yield server
    server.close()


@pytest.fixture(scope="module")
def whole(server: Server, tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Counted]:
    """A run that nobody disturbed, and how many events of each kind happened in it."""
    run = tmp_path_factory.mktemp("whole") / "run"
    events = server.call("train", run, evaluate=["best", "last"])
    assert events is not None
    return run, events


def contents(run: Path) -> dict[str, bytes]:
    """Everything a run leaves that does not depend on the clock."""
    patterns = ("*_episodes.csv", "config.yaml", "csv/scalars/**/*.csv", "replay/*", "evaluation/**/*")
    files = {path for pattern in patterns for path in run.glob(pattern) if path.is_file()}
    names = {path.relative_to(run).as_posix(): path for path in files}
    return {name: path.read_bytes() for name, path in sorted(names.items()) if "scalars/time/" not in name}


class Loaded:
    """Takes whatever state a checkpoint holds."""

    def state_dict(self) -> dict[str, Any]:
        return {}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        self.state = state


def states(checkpoint: Path) -> dict[str, torch.Tensor]:
    """Every tensor and number of a checkpoint."""
    components = {name: Loaded() for name in ("loss", "average", "optimizer", "generators")}
    Checkpoint(**components).load(checkpoint)
    found: dict[str, torch.Tensor] = {}

    def walk(value: Any, name: str) -> None:
        if isinstance(value, dict):
            for key, below in value.items():
                walk(below, f"{name}/{key}")
        elif isinstance(value, list | tuple):
            walk(dict(enumerate(value)), name)
        elif value is not None and not isinstance(value, str):
            found[name] = torch.as_tensor(value)

    for name, component in components.items():
        walk(component.state, name)
    return found


def scalars_shown(run: Path) -> dict[str, list[tuple[int, float]]]:
    """What TensorBoard shows, without what depends on the clock."""
    shown = EventAccumulator(str(run / "tensorboard"), size_guidance={"scalars": 0})
    shown.Reload()
    tags = [tag for tag in shown.Tags()["scalars"] if not tag.startswith("time/")]
    return {tag: [(event.step, event.value) for event in shown.Scalars(tag)] for tag in tags}


def assert_equal_runs(run: Path, whole: Path) -> None:
    assert [path.name for path in folders(run / "checkpoints")] == [
        path.name for path in folders(whole / "checkpoints")
    ]
    for mine, other in zip(folders(run / "checkpoints"), folders(whole / "checkpoints"), strict=True):
        a, b = states(mine), states(other)
        assert a.keys() == b.keys()
        assert [name for name in a if not torch.equal(a[name], b[name])] == []
    a, b = contents(run), contents(whole)
    assert a.keys() == b.keys()
    assert [name for name in a if a[name] != b[name]] == []
    assert not list(run.rglob(".unfinished*"))
    assert not list(run.rglob(".removed*"))


def kill_and_resume(server: Server, run: Path, kills: list[tuple[str, int]]) -> None:
    """Start a run, kill it again and again wherever it is, and let it come to its end."""
    for kill_at in kills:
        server.call("resume" if (run / "config.yaml").exists() else "train", run, kill_at=kill_at)
    server.call("resume" if (run / "config.yaml").exists() else "train", run, evaluate=["best", "last"])


def kill_points(counted: Counted, number: int, share: float, seed: int) -> list[tuple[str, int]]:
    """Draw moments within a share of a run's events, every other one while something is saved."""
    rng = np.random.default_rng(seed)
    kinds = ["saving", "training"] * number
    return [(kind, int(rng.integers(share * counted[kind]))) for kind in kinds[:number]]


@pytest.mark.parametrize("seed", range(3))
def test_a_run_killed_again_and_again_ends_as_if_nothing_had_happened(
    server: Server, whole: tuple[Path, Counted], tmp_path: Path, seed: int
) -> None:
    kill_and_resume(server, tmp_path / "run", kill_points(whole[1], 4, 0.5, seed))
    assert_equal_runs(tmp_path / "run", whole[0])
    assert scalars_shown(tmp_path / "run") == scalars_shown(whole[0])


@pytest.mark.slow
@pytest.mark.parametrize("number", range(60))
def test_a_run_killed_once_ends_as_if_nothing_had_happened(
    server: Server, whole: tuple[Path, Counted], tmp_path: Path, number: int
) -> None:
    kill_and_resume(server, tmp_path / "run", kill_points(whole[1], 60, 1.0, 99)[number : number + 1])
    assert_equal_runs(tmp_path / "run", whole[0])
    assert scalars_shown(tmp_path / "run") == scalars_shown(whole[0])
