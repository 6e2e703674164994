"""The run folder and everything written into it while training."""

import contextlib
import importlib.util
import json
import os
import platform
import sys
import threading
from collections.abc import Mapping, Sequence
from importlib.metadata import version
from pathlib import Path

import pandas as pd
from omegaconf import DictConfig, OmegaConf
from tensorboard.compat.proto.event_pb2 import Event, SessionLog
from torchrl.record.loggers import Logger
from torchrl.record.loggers.tensorboard import TensorboardLogger
from torchrl.record.loggers.utils import get_logger
from tqdm import tqdm

from rcdsac_trl.config.conditions import Condition
from rcdsac_trl.config.run_config import CHECKPOINTS, CONFIG_NAME
from rcdsac_trl.errors import UserInputError
from rcdsac_trl.rollout.metrics import METRICS
from rcdsac_trl.storage import atomic
from rcdsac_trl.system.provenance import commit
from rcdsac_trl.system.resources import check_writable

MANIFEST_NAME = "manifest.json"
TRAINING_TABLE = "training_episodes.csv"
# Where the thread is defined that writes TensorBoard's files.
_TENSORBOARD_WRITER = "tensorboard.summary.writer.event_file_writer"
_EXTRAS = {"wandb": "wandb", "mlflow": "mlflow"}
_PACKAGES = ("torch", "torchrl", "tensordict", "pybullet", "gymnasium", "hydra-core", "numpy", "numba", "rcdsac-trl")


def check_backends(backends: Sequence[str]) -> None:
    """Refuse an unknown logger, or one whose package is not installed."""
    known = ("csv", "tensorboard", *_EXTRAS)
    for backend in backends:
        if backend not in known:
            raise UserInputError(f"logger.backends holds {backend!r}: choose among {', '.join(known)}")
        if backend in _EXTRAS and importlib.util.find_spec(_EXTRAS[backend]) is None:
            raise UserInputError(
                f"logger {backend} is not installed: pip install 'rcdsac-trl[{backend}]', or use logger=default"
            )


def check_folder(folder: Path) -> None:
    """Refuse a folder that already holds a run, or that nothing can be written into."""
    check_writable(folder)
    # A run whose config was lost is one too.
    if any((folder / name).exists() for name in (CONFIG_NAME, CHECKPOINTS, TRAINING_TABLE)):
        raise UserInputError(f"{folder} already holds a run: choose another hydra.run.dir")


def start_run_folder(folder: Path, cfg: DictConfig, facts: Mapping[str, object]) -> None:
    """Write what a run is made of: the resolved config, versions, commit and command.

    Raises:
        UserInputError: if the folder already holds a run.
    """
    check_folder(folder)
    folder.mkdir(parents=True, exist_ok=True)
    manifest = {
        "command": [Path(sys.argv[0]).stem, *sys.argv[1:]],
        "seed": cfg.seed,
        "commit": commit(),
        "python": platform.python_version(),
        "machine": f"{platform.system()} {platform.machine()}",
        "packages": {name: version(name) for name in _PACKAGES},
        **facts,
    }
    atomic.write(folder / MANIFEST_NAME, (json.dumps(manifest, indent=2) + "\n").encode())
    # Last: a folder that has a config is a run.
    atomic.write(folder / CONFIG_NAME, OmegaConf.to_yaml(cfg, resolve=True).encode())


def lengths(folder: Path) -> dict[str, int]:
    """Bring the tables and the CSV scalars of a run to the disk and return how long each file is, in bytes."""
    files = _tables(folder)
    for path in files:
        atomic.sync(path)
    return {path.relative_to(folder).as_posix(): path.stat().st_size for path in files}


def cut(folder: Path, recorded: Mapping[str, int]) -> list[str]:
    """Shorten the tables and the CSV scalars of a run to what they were when :func:`lengths` was called.

    Returns:
        One sentence for each file that is shorter than that.
    """
    for path in _tables(folder):
        length = recorded.get(path.relative_to(folder).as_posix(), 0)
        if length == 0:
            path.unlink()
        elif path.stat().st_size > length:
            os.truncate(path, length)
            atomic.sync(path)
    found = {name: (folder / name).stat().st_size if (folder / name).exists() else 0 for name in recorded}
    return [
        f"{folder / name} has lost rows: it holds {found[name]} bytes of {length}"
        for name, length in recorded.items()
        if found[name] < length
    ]


def _tables(folder: Path) -> list[Path]:
    return sorted([*folder.glob("*_episodes.csv"), *folder.glob("csv/scalars/**/*.csv")])


class RunLog:
    """Writes scalars through TorchRL's loggers, episodes into CSV tables, and tells the console.

    Args:
        folder: the run folder.
        backends: TorchRL loggers, checked by :func:`check_backends`.
        continued_at: agent steps at which a run is continued: TensorBoard then forgets what was logged after them.
    """

    def __init__(self, folder: Path, backends: Sequence[str], *, continued_at: int | None = None) -> None:
        self.folder = folder
        self._loggers: list[Logger] = [
            get_logger(name, logger_name=str(folder), experiment_name=name) for name in backends
        ]
        self._file = (folder / "train.log").open("a", buffering=1, encoding="utf-8")
        self._excepthook = threading.excepthook
        threading.excepthook = self._thread_failed
        for logger in self._loggers:
            if isinstance(logger, TensorboardLogger) and continued_at is not None:
                start = SessionLog(status=SessionLog.START)
                logger.experiment.file_writer.add_event(Event(step=continued_at + 1, session_log=start))

    def scalars(self, values: Mapping[str, float], step: int) -> None:
        """Log scalars at an agent step."""
        for logger in self._loggers:
            for name, value in values.items():
                logger.log_scalar(name, value, step=step)

    def episodes(self, name: str, rows: pd.DataFrame) -> None:
        """Append one row an episode to ``<name>_episodes.csv``."""
        with (self.folder / f"{name}_episodes.csv").open("ab") as file:
            is_new = file.tell() == 0
            written = rows.to_csv(header=is_new, index=False, float_format="%.6g").encode()
            # At once, so that whoever reads meanwhile finds all of them or none.
            file.write(written)

    def lengths(self) -> dict[str, int]:
        """Bring everything to the disk; see :func:`lengths`."""
        for logger in self._loggers:
            if isinstance(logger, TensorboardLogger):
                logger.experiment.flush()
        return lengths(self.folder)

    def message(self, text: str) -> None:
        """Say something on the console (without breaking the progress bar) and in ``train.log``."""
        tqdm.write(text)
        self._file.write(text + "\n")

    def progress(self, iteration: int, iterations: int, updates: int, record: Mapping[str, float], bar: tqdm) -> None:
        """Say how an iteration went."""
        rates = f"{record['time/steps_per_s']:.0f} steps/s {record['time/updates_per_s']:.1f} updates/s"
        text = (
            f"{iteration + 1:4d}/{iterations} {record['time/elapsed_s']:6.0f} s {updates:6d} updates  "
            f"reward {record['train/reward']:6.1f}  collisions {record['train/collisions']:5.2f}  "
            f"goals {record['train/goals']:4.2f}  speed {record['train/mean_speed_m_per_s']:.2f} m/s  "
            f"contact {record['train/contact_fraction']:6.1%}  {rates}"
        )
        self.message(text)
        bar.set_postfix_str(rates, refresh=False)
        bar.update()

    def validation(self, iterations: int, means: pd.DataFrame) -> None:
        """Show the validation of the agent after some iterations, one line a condition."""
        for row in means.to_dict("records"):
            beta, weight = (None if row[k] != row[k] else row[k] for k in ("beta", "collision_weight"))
            values = "  ".join(f"{metric} {row[metric]:.3g}" for metric in METRICS)
            self.message(f"     validation after {iterations} iterations {Condition(beta, weight)!s:>10}  {values}")

    def _thread_failed(self, args: threading.ExceptHookArgs) -> None:
        """Print no traceback of TensorBoard's writer: its next call raises the same error where it can be served."""
        if type(args.thread).__module__ != _TENSORBOARD_WRITER or not isinstance(args.exc_value, OSError):
            self._excepthook(args)

    def close(self) -> None:
        """Close what is open, on a full disk too."""
        threading.excepthook = self._excepthook
        with contextlib.suppress(OSError):
            self._file.close()
