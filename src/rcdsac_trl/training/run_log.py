"""Everything that is written into a run folder while training."""

import contextlib
import os
import threading
from collections.abc import Mapping, Sequence
from pathlib import Path

import pandas as pd
from tensorboard.compat.proto.event_pb2 import Event, SessionLog
from torchrl.record.loggers import Logger
from torchrl.record.loggers.mlflow import MLFlowLogger
from torchrl.record.loggers.tensorboard import TensorboardLogger
from torchrl.record.loggers.utils import get_logger
from tqdm import tqdm

from rcdsac_trl.config.conditions import Condition
from rcdsac_trl.rollout.metrics import METRICS
from rcdsac_trl.training.run_folder import lengths

# Where the thread is defined that writes TensorBoard's files.
_TENSORBOARD_WRITER = "tensorboard.summary.writer.event_file_writer"


def _logger(backend: str, folder: Path) -> Logger:
    """Make a logger of TorchRL that writes into a run folder; to a server where the user's environment names one."""
    if backend == "wandb":
        return get_logger(backend, logger_name=str(folder), experiment_name=folder.name)
    if backend == "mlflow":
        # A database, since MLflow takes folders of files no longer.
        place = folder.resolve()
        server = os.environ.get("MLFLOW_TRACKING_URI")
        artifacts = None if server else (place / "mlartifacts").as_uri()
        uri = server or f"sqlite:///{place / 'mlflow.db'}"
        return MLFlowLogger(exp_name=folder.name, tracking_uri=uri, artifact_location=artifacts)
    return get_logger(backend, logger_name=str(folder), experiment_name=backend)


class RunLog:
    """Writes scalars through TorchRL's loggers, episodes into CSV tables, and tells the console.

    Args:
        folder: the run folder.
        backends: TorchRL loggers, checked by ``LoggerSettings.check_backends``.
        continued_at: agent steps at which a run is continued: TensorBoard then forgets what was logged after them.
    """

    def __init__(self, folder: Path, backends: Sequence[str], *, continued_at: int | None = None) -> None:
        self.folder = folder
        self._loggers: list[Logger] = [_logger(name, folder) for name in backends]
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
