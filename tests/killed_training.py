"""Kills a training that has processes of its own, and continues it."""

import subprocess
import sys
import time
from pathlib import Path

from rcdsac_trl.config.run_config import CHECKPOINTS
from rcdsac_trl.storage.checkpoint_record import folder_name
from rcdsac_trl.training.setup import resume_training
from tiny import TINY, tiny_trainer

GIVEN = ["schedule.iterations=4", "task.episode_steps=200"]
PATIENCE_S = 120.0


def check_killed_run_is_continued(folder: Path, *collector: str) -> None:
    """Kill a training with a collector after its first iteration: nothing of it is left, and it goes on bit for bit."""
    run, other = folder / "run", folder / "other"
    overrides = ["+algo=rcdsac_pow", *TINY, *collector, *GIVEN, f"hydra.run.dir={run}"]
    training = subprocess.Popen([sys.executable, "-m", "rcdsac_trl.train", *overrides], stdout=subprocess.DEVNULL)
    while training.poll() is None and not (run / CHECKPOINTS / folder_name(1)).exists():
        time.sleep(0.02)
    assert training.poll() is None
    started = descendants(training.pid)
    training.kill()
    training.wait()
    assert len(started) > 2
    deadline = time.monotonic() + PATIENCE_S
    while any(map(is_alive, started)) and time.monotonic() < deadline:
        time.sleep(0.1)
    assert not any(map(is_alive, started))
    resumed = resume_training(run)
    assert resumed is not None
    assert resumed.progress.iterations >= 1
    resumed.run()
    tiny_trainer(other, "rcdsac_pow", *GIVEN).run()
    assert (run / "training_episodes.csv").read_bytes() == (other / "training_episodes.csv").read_bytes()


def descendants(pid: int) -> set[int]:
    """Return the processes that a process has started, and those that they have."""
    found = {int(child) for task in Path(f"/proc/{pid}/task").glob("*/children") for child in task.read_text().split()}
    return found.union(*(descendants(child) for child in found))


def is_alive(pid: int) -> bool:
    """Whether a process runs."""
    try:
        return Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[0] != "Z"
    except OSError:
        return False
