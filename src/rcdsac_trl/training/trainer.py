"""The training loop: a new map and its episodes, then updates; look at the agent, save it, say how it goes."""

import contextlib
import time
from collections.abc import Callable, Mapping
from dataclasses import replace

from tensordict import TensorDictBase
from tqdm import tqdm

from rcdsac_trl.config.command_line import assigned
from rcdsac_trl.config.schedule import Schedule
from rcdsac_trl.errors import TrainingError, UserInputError
from rcdsac_trl.rollout.episode_collectors import EpisodeCollector
from rcdsac_trl.storage.atomic import FolderLock
from rcdsac_trl.storage.checkpoint import Checkpoints
from rcdsac_trl.storage.checkpoint_record import Progress
from rcdsac_trl.system.invocation import program
from rcdsac_trl.system.processes import WorkerError
from rcdsac_trl.system.resources import fault_sentence
from rcdsac_trl.training.learner import Learner
from rcdsac_trl.training.nan_guard import FiniteGuard
from rcdsac_trl.training.records import training_rows
from rcdsac_trl.training.restart_budget import RestartBudget
from rcdsac_trl.training.run_log import RunLog
from rcdsac_trl.training.validation import Validation

IterationHook = Callable[["Trainer", Mapping[str, float]], None]
"""Called with the trainer and the iteration's scalars when an iteration is logged, before it is saved.

So a run that is killed and continued misses no iteration; one that is done again is told again.
"""


class StopTraining(Exception):
    """Raised by a hook: the iteration is saved, and the run ends here without an error; it can be continued."""


class Trainer:
    """Runs a :class:`~rcdsac_trl.config.schedule.Schedule`, from its first iteration or from where a run was left.

    Args:
        schedule: the layout of the run.
        progress: what is done already.
        episodes: collects the episodes of one iteration after another; closed at the end.
        learner: does the updates.
        guard: looks for NaN and infinity.
        validation: measures the averaged actor on validation maps; closed at the end.
        checkpoints: where everything is saved.
        checkpoint_every: iterations between checkpoints.
        restarts: counts the faults of worker processes.
        log: where everything is written.
        lock: keeps others out of the folder; let go at the end.
        context_key: what tells episodes apart in the log: ``"risk"``, ``"collision_weight"`` or None.
        on_iteration_end: called after every iteration; may raise :class:`StopTraining`.
    """

    def __init__(
        self,
        *,
        schedule: Schedule,
        progress: Progress,
        episodes: EpisodeCollector,
        learner: Learner,
        guard: FiniteGuard,
        validation: Validation,
        checkpoints: Checkpoints,
        checkpoint_every: int,
        restarts: RestartBudget,
        log: RunLog,
        lock: FolderLock,
        context_key: str | None,
        on_iteration_end: IterationHook | None = None,
    ) -> None:
        self.schedule = schedule
        self.progress = progress
        self.episodes = episodes
        self.learner = learner
        self.guard = guard
        self.validation = validation
        self.checkpoints = checkpoints
        self.checkpoint_every = checkpoint_every
        self.restarts = restarts
        self.log = log
        self.lock = lock
        self.context_key = context_key
        self.on_iteration_end = on_iteration_end
        self._iteration = progress.iterations  # under way, from 0

    @property
    def is_finished(self) -> bool:
        """Whether every iteration of the schedule is done."""
        return self.progress.iterations == self.schedule.iterations

    def run(self) -> None:
        """Train to the end of the schedule; what is done after the last checkpoint is lost if it ends early.

        Raises:
            TrainingError: if a number is NaN or infinite, workers fail too often, or the disk or the memory fails.
            UserInputError: if wrong input shows only now, such as maps without a way as long as the task asks for.
        """
        try:
            self._run()
        except StopTraining as stop:
            self._save()
            reason = f" ({stop})" if str(stop) else ""
            self.log.message(f"stopped after {self.progress.iterations} iterations{reason}; {self._saved_sentence()}")
        except KeyboardInterrupt:
            self.log.message(f"interrupted {self._where()}; {self._saved_sentence()}")
            raise
        except TrainingError as error:
            self.log.message(str(error))
            raise
        except UserInputError as error:
            raise UserInputError(self._stopped(str(error))) from error
        except Exception as error:
            if (sentence := fault_sentence(error)) is None:
                raise
            raise TrainingError(self._stopped(sentence)) from error
        finally:
            self.episodes.close()
            self.validation.close()
            self.log.close()
            self.lock.close()

    def _stopped(self, why: str) -> str:
        """Log that the run ends here, why, and what is saved of it; return the sentence."""
        sentence = f"{why}: training stops {self._where()}; {self._saved_sentence()}"
        with contextlib.suppress(OSError):  # the log may be on a disk that failed
            self.log.message(sentence)
        return sentence

    def _run(self) -> None:
        total = self.schedule.iterations
        self.log.message(f"{total} iterations; write to {self.log.folder}")
        if self.checkpoints.saved_iterations is None:
            self._save()  # so that whatever is in the folder later can be told from what was never saved
        started = time.monotonic() - self.progress.elapsed_s
        self.progress = self.validation.go_on(self.progress)
        with tqdm(total=total, initial=self.progress.iterations, unit="it", disable=None, smoothing=0.1) as bar:
            for iteration in range(self.progress.iterations, total):
                self._iteration = iteration
                record = self._iterate(iteration)
                self.progress = replace(self.progress, iterations=iteration + 1)
                self.progress = self.validation.after_iteration(self.progress, self.learner.averaged_actor)
                record["time/elapsed_s"] = time.monotonic() - started
                self.progress = replace(self.progress, elapsed_s=record["time/elapsed_s"])
                self.log.scalars(record, self.progress.steps)
                self.log.progress(iteration, total, self.progress.updates, record, bar)
                self._tell(record)
                if self._is_saved_now():
                    self._save()

    def _tell(self, record: Mapping[str, float]) -> None:
        """Call the hook; a mistake in it ends the run with its traceback, and the log says what is saved."""
        if self.on_iteration_end is None:
            return
        try:
            self.on_iteration_end(self, record)
        except (StopTraining, UserInputError):
            raise
        except Exception as error:
            what = " ".join(f"{type(error).__name__}: {error}".split())
            self.log.message(f"on_iteration_end failed {self._where()} ({what}); {self._saved_sentence()}")
            raise

    def _iterate(self, iteration: int) -> dict[str, float]:
        """Drive an iteration's episodes, then learn; return its scalars."""
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
        rows, record = training_rows(batch, self.context_key, iteration=iteration, updates=self.progress.updates)
        self.log.episodes("training", rows)
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
                self.restarts.spend(f"iteration {iteration + 1}, training map {map_index}", error)
                self.progress = replace(self.progress, skipped_maps=self.progress.skipped_maps + 1)
                self.log.message(
                    f"the episodes on map {map_index} are dropped: iteration {iteration + 1} drives on the next"
                )

    def _is_saved_now(self) -> bool:
        """Say whether a checkpoint is due, or needed: it holds the best agent, or one whose validation is under way."""
        done = self.progress.iterations
        due = done == self.schedule.iterations or done % self.checkpoint_every == 0
        # A validation that is under way can be begun again from the checkpoint of its agent alone.
        return due or done in (self.progress.best_iterations, self.progress.validating_iterations)

    def _save(self) -> None:
        self.progress = replace(self.progress, restarts=self.restarts.used)
        self.checkpoints.save(self.progress, self.log.lengths())

    def _where(self) -> str:
        """Name the iteration that is under way as the log's lines do, from 1."""
        return f"in iteration {self._iteration + 1}"

    def _saved_sentence(self) -> str:
        return saved_sentence(self.checkpoints, self.log)


def saved_sentence(checkpoints: Checkpoints, log: RunLog) -> str:
    """Say what is saved of a run, and how to go on from there."""
    saved = checkpoints.saved_iterations or 0
    return f"{saved} iterations are saved, continue: {program()} train {assigned('resume', str(log.folder))}"
