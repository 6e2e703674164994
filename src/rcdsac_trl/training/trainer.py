"""The training loop: a new map and its episodes, then updates; look at the agent, save it, say how it goes."""

import contextlib
import time
from collections.abc import Callable
from dataclasses import replace
from typing import TypeVar

import pandas as pd
from tensordict import TensorDictBase
from tqdm import tqdm

from rcdsac_trl.config.schedule import Schedule
from rcdsac_trl.errors import TrainingError
from rcdsac_trl.rollout.episode_collectors import Episodes
from rcdsac_trl.rollout.metrics import METRICS, episode_metrics
from rcdsac_trl.storage.atomic import FolderLock
from rcdsac_trl.storage.checkpoint import Checkpoints
from rcdsac_trl.storage.checkpoint_record import Progress
from rcdsac_trl.system.processes import WorkerError
from rcdsac_trl.system.resources import fault_sentence
from rcdsac_trl.training.learner import Learner
from rcdsac_trl.training.nan_guard import FiniteGuard
from rcdsac_trl.training.run_log import RunLog
from rcdsac_trl.training.validation import Snapshot, Validation, scores

T = TypeVar("T")


class Trainer:
    """Runs a :class:`Schedule`, from its first iteration or from where a run was left.

    Args:
        schedule: the layout of the run.
        progress: what is done already.
        episodes: collects the episodes of one iteration after another; closed at the end.
        learner: does the updates.
        guard: looks for NaN and infinity.
        validate: measures snapshots of the averaged actor on validation maps; closed at the end.
        validate_every: iterations between validations.
        pending: the snapshot whose validation was under way when the run was left; None: there was none.
        checkpoints: where everything is saved.
        checkpoint_every: iterations between checkpoints.
        log: where everything is written.
        lock: keeps others out of the folder; let go at the end.
        max_restarts: how often in a run worker processes may die or hang before it ends.
        context_key: what tells episodes apart in the log: ``"risk"``, ``"collision_weight"`` or None.
    """

    def __init__(
        self,
        *,
        schedule: Schedule,
        progress: Progress,
        episodes: Episodes,
        learner: Learner,
        guard: FiniteGuard,
        validate: Validation,
        validate_every: int,
        pending: Snapshot | None,
        checkpoints: Checkpoints,
        checkpoint_every: int,
        log: RunLog,
        lock: FolderLock,
        max_restarts: int,
        context_key: str | None,
    ) -> None:
        self.schedule = schedule
        self.progress = progress
        self.episodes = episodes
        self.learner = learner
        self.guard = guard
        self.validate = validate
        self.validate_every = validate_every
        self.pending = pending
        self.checkpoints = checkpoints
        self.checkpoint_every = checkpoint_every
        self.log = log
        self.lock = lock
        self.max_restarts = max_restarts
        self.context_key = context_key

    def run(self) -> None:
        """Train to the end of the schedule; what is done after the last checkpoint is lost if it ends early.

        Raises:
            TrainingError: if a number is NaN or infinite, workers fail too often, or the disk or the memory fails.
        """
        try:
            self._run()
        except KeyboardInterrupt:
            self.log.message(f"interrupted in iteration {self.progress.iterations}; {self._saved_sentence()}")
            raise
        except TrainingError as error:
            self.log.message(str(error))
            raise
        except Exception as error:
            if (told := fault_sentence(error)) is None:
                raise
            told = f"{told}: training stops in iteration {self.progress.iterations}; {self._saved_sentence()}"
            with contextlib.suppress(OSError):  # the log may be on the same disk
                self.log.message(told)
            raise TrainingError(told) from error
        finally:
            self.episodes.close()
            self.validate.close()
            self.log.close()
            self.lock.close()

    def _run(self) -> None:
        total = self.schedule.iterations
        self.log.message(f"{total} iterations; write to {self.log.folder}")
        if self.checkpoints.saved_iterations is None:
            self._save()  # so that whatever is in the folder later can be told from what was never saved
        started = time.monotonic() - self.progress.elapsed_s
        if self.pending is not None:
            self._begin_validation(self.pending)
        with tqdm(total=total, initial=self.progress.iterations, unit="it", disable=None, smoothing=0.1) as bar:
            for iteration in range(self.progress.iterations, total):
                record = self._iterate(iteration)
                self.progress = replace(self.progress, iterations=iteration + 1)
                self._validate()
                record["time/elapsed_s"] = time.monotonic() - started
                self.progress = replace(self.progress, elapsed_s=record["time/elapsed_s"])
                self.log.scalars(record, self.progress.steps)
                self.log.progress(iteration, total, self.progress.updates, record, bar)
                # A validation that is under way can be begun again from the checkpoint of its agent alone.
                needed = (self.progress.best_iterations, self.progress.validating_iterations)
                if self._is_due(iteration, self.checkpoint_every) or iteration + 1 in needed:
                    self._save()

    def _iterate(self, iteration: int) -> dict[str, float]:
        self.guard.start_iteration(iteration)
        strength = self.schedule.distortion_strength(iteration)
        share = self.schedule.learning_rate_share(iteration)
        t0 = time.monotonic()
        batch = self._collect(iteration)
        t1 = time.monotonic()
        self.guard.check_episodes(batch)
        self.learner.replay.add_episodes(batch)
        self.progress = replace(self.progress, steps=self.progress.steps + batch.numel())
        # Before the updates: episodes are logged under the number of updates that they were driven with.
        record = self._training_record(iteration, batch)
        t2 = time.monotonic()
        number = self.schedule.updates_per_iteration
        diagnostics = self.learner.updates(number, strength, share)
        self.guard.end_iteration()
        self.progress = replace(self.progress, updates=self.progress.updates + number)
        t3 = time.monotonic()
        record |= {f"learn/{key}": value for key, value in diagnostics.items()}
        record |= {
            "learn/distortion_strength": strength,
            "learn/learning_rate_share": share,
            "learn/updates": float(self.progress.updates),
            "time/steps_per_s": batch.numel() / (t1 - t0),
            "time/updates_per_s": number / max(t3 - t2, 1e-9),
        }
        return record

    def _collect(self, iteration: int) -> TensorDictBase:
        """Drive an iteration's episodes; on the next map, if workers fail on its own, as often as may be."""
        while True:
            map_index = iteration + self.progress.skipped_maps
            try:
                return self.episodes.collect(iteration, map_index)
            except WorkerError as error:
                self._restart(f"iteration {iteration}, training map {map_index}", error)
                self.progress = replace(self.progress, skipped_maps=self.progress.skipped_maps + 1)
                self.log.message(
                    f"the episodes on map {map_index} are dropped: iteration {iteration} drives on the next"
                )

    def _restart(self, where: str, error: WorkerError) -> None:
        """Count a fault of the workers and tell it, or stop if there were too many."""
        if self.progress.restarts == self.max_restarts:
            raise TrainingError(
                f"{where}: {error}; world.max_restarts={self.max_restarts} allows no further restart: training stops; "
                f"{self._saved_sentence()}"
            ) from error
        self.progress = replace(self.progress, restarts=self.progress.restarts + 1)
        self.log.message(f"{where}: {error}; restart {self.progress.restarts} of at most {self.max_restarts}")

    def _saved_sentence(self) -> str:
        saved = self.checkpoints.saved_iterations or 0
        return f"{saved} iterations are saved, resume={self.log.folder} continues there"

    def _is_due(self, iteration: int, every: int) -> bool:
        """Say whether what is done every so many iterations, and after the last one, is done after this one."""
        return iteration + 1 == self.schedule.iterations or (iteration + 1) % every == 0

    def _training_record(self, iteration: int, batch: TensorDictBase) -> dict[str, float]:
        metrics = episode_metrics(batch)
        rows = pd.DataFrame({key: value.numpy() for key, value in metrics.items()})
        record = {f"train/{metric}": float(rows[metric].mean()) for metric in METRICS}
        if self.context_key is not None:
            told = "beta" if self.context_key == "risk" else self.context_key
            rows.insert(0, told, batch[self.context_key][:, 0, 0].cpu().numpy())
            # Each half by itself: the mean over all betas hides an averse half that stands still.
            in_order = rows.sort_values(told)
            halves = {"low": in_order[: len(rows) // 2], "high": in_order[len(rows) // 2 :]}
            for half, part in halves.items():
                if len(part):  # a single agent has no lower half
                    record |= {f"train/{metric}/{half}_{told}": float(part[metric].mean()) for metric in METRICS}
        rows.insert(0, "episode", range(len(rows)))
        rows.insert(0, "iteration", iteration)
        rows.insert(1, "updates", self.progress.updates)
        self.log.episodes("training", rows)
        return record

    def _validate(self) -> None:
        """Where validation is due, take in what the one before has found, and begin it beside what follows.

        What it finds changes nothing in what is learnt, and is taken in at a point that does not depend on when it
        was found: a run ends the same with any number of processes.
        """
        if not self._is_due(self.progress.iterations - 1, self.validate_every):
            self._surviving(self.validate.look)
            return
        self._take_in_validation()
        self._begin_validation(Snapshot(self.progress, self.learner.averaged_actor()))

    def _begin_validation(self, snapshot: Snapshot) -> None:
        at_end = self.progress.iterations == self.schedule.iterations
        self.progress = replace(self.progress, validating_iterations=snapshot.progress.iterations)
        self._surviving(lambda: self.validate.start(snapshot, alone=at_end))
        if at_end or not self.validate.beside:
            self._take_in_validation()

    def _take_in_validation(self) -> None:
        """Wait for the validation that is under way, if one is, and log it as of the agent it has looked at."""
        if (snapshot := self.validate.snapshot) is None:
            return
        rows = self._surviving(self.validate.finish)
        then = snapshot.progress
        rows.insert(0, "iteration", then.iterations - 1)
        rows.insert(1, "updates", then.updates)
        self.log.episodes("validation", rows)
        means, scalars = scores(rows, self.validate.steps)
        self.log.validation(then.iterations, means)
        self.log.scalars(scalars, then.steps)
        score, best = scalars["validation/score"], self.progress.best_score
        if best is None or score > best:
            self.progress = replace(self.progress, best_score=score, best_iterations=then.iterations)
        self.progress = replace(self.progress, validating_iterations=None)

    def _surviving(self, call: Callable[[], T]) -> T:
        """Ask something of the validation, which begins anew if its processes fail: its maps stay the same."""
        while True:
            try:
                return call()
            except WorkerError as error:
                self._restart(f"validation after {self.progress.validating_iterations} iterations", error)

    def _save(self) -> None:
        self.checkpoints.save(self.progress, self.log.lengths())
