"""Validation: when the agent is measured, by which processes, and what is made of the result.

:class:`SnapshotEvaluator` measures one snapshot beside the training that goes on meanwhile; :class:`Validation` knows
when that is due and takes the results in.
"""

import math
from collections.abc import Callable
from contextlib import AbstractContextManager
from dataclasses import dataclass, replace
from functools import partial
from typing import TypeVar

import pandas as pd

from rcdsac_trl.rollout.evaluation_pool import Drive, EvaluationPool, Rows, evaluate_maps, prepare
from rcdsac_trl.rollout.measurement import table_of
from rcdsac_trl.rollout.metrics import METRICS, validation_score
from rcdsac_trl.storage.checkpoint_record import Progress
from rcdsac_trl.system.processes import WorkerError
from rcdsac_trl.training.restart_budget import RestartBudget
from rcdsac_trl.training.run_log import RunLog

T = TypeVar("T")


@dataclass(frozen=True)
class Snapshot:
    """An agent as it was at one moment of a run.

    Attributes:
        progress: of the run at that moment.
        actor: the weights of the averaged actor, from :func:`packed`.
    """

    progress: Progress
    actor: bytes


class SnapshotEvaluator:
    """Measures one snapshot after another, each on the same maps.

    What is found follows from the snapshot alone, however many processes drive and whenever they do.

    Args:
        make: makes what drives a packed actor; called in every process that drives.
        num_maps: maps to drive on.
        steps: length of an episode.
        processes: that drive while training goes on; 0: training waits and drives by itself.
        processes_alone: that drive where training waits anyway; 0 where `processes` is.
        timeout_s: seconds without a step after which a process counts as hung, while training waits for it; None:
            it may take as long as it likes.

    Attributes:
        snapshot: what is being measured, if anything.
    """

    def __init__(
        self,
        make: Callable[[bytes], AbstractContextManager[Drive]],
        *,
        num_maps: int,
        steps: int,
        processes: int,
        processes_alone: int,
        timeout_s: float | None,
    ) -> None:
        self.steps = steps
        self.snapshot: Snapshot | None = None
        self._make = make
        self._num_maps = num_maps
        self._processes = processes
        self._processes_alone = processes_alone
        self._timeout_s = timeout_s
        self._alone = False
        self._pool: EvaluationPool | None = None
        self._maps: list[Rows] = []
        if self.beside:
            prepare()

    @property
    def beside(self) -> bool:
        """Whether training can go on while a snapshot is measured."""
        return self._processes > 0

    def start(self, snapshot: Snapshot, *, alone: bool) -> None:
        """Begin to measure; the snapshot before must be finished.

        Args:
            snapshot: what to measure.
            alone: training waits for it.

        Raises:
            WorkerError: if a process cannot be started.
        """
        self.snapshot = snapshot
        self._alone = alone
        if self.beside:
            self._begin(snapshot)

    def _begin(self, snapshot: Snapshot) -> EvaluationPool:
        self._maps = []
        processes = self._processes_alone if self._alone else self._processes
        make = partial(self._make, snapshot.actor)
        self._pool = EvaluationPool(make, self._num_maps, processes, timeout_s=self._timeout_s, at_once=True)
        return self._pool

    def poll(self) -> None:
        """Take what is measured so far, without waiting.

        Raises:
            WorkerError: if a process died; the next call begins the snapshot anew.
        """
        if self.snapshot is not None and self.beside:
            self._receive(self.snapshot, until_done=False)

    def finish(self) -> pd.DataFrame:
        """Wait, and return one row an episode; see :func:`rcdsac_trl.rollout.measurement.measure_map`.

        Raises:
            WorkerError: if a process died or hung; the next call begins the snapshot anew.
        """
        assert self.snapshot is not None
        if self.beside:
            self._receive(self.snapshot, until_done=True)
        else:
            self._maps = list(evaluate_maps(partial(self._make, self.snapshot.actor), self._num_maps, processes=0))
        self.close()
        self.snapshot = None
        return table_of(self._maps)

    def _receive(self, snapshot: Snapshot, *, until_done: bool) -> None:
        try:
            pool = self._pool or self._begin(snapshot)
            self._maps.extend(pool.receive(until_done=until_done))
        except WorkerError:
            self.close()
            raise

    def close(self) -> None:
        """End the processes."""
        if self._pool is not None:
            self._pool.close()
        self._pool = None


class Validation:
    """Measures the averaged actor every so many iterations and after the last one, and says which was the best.

    A result is taken in when the next validation is due. So nothing that is learnt or logged depends on when it was
    found: a run ends the same with any number of processes.

    Args:
        evaluator: measures snapshots.
        iterations: of the run.
        every_iterations: iterations between two validations.
        restarts: counts the faults of its processes; a validation begins anew after one, on the same maps.
        log: where results are written.
        pending: the snapshot whose validation was under way when the run was left; None: there was none.
    """

    def __init__(
        self,
        evaluator: SnapshotEvaluator,
        *,
        iterations: int,
        every_iterations: int,
        restarts: RestartBudget,
        log: RunLog,
        pending: Snapshot | None = None,
    ) -> None:
        self.evaluator = evaluator
        self.iterations = iterations
        self.every_iterations = every_iterations
        self._restarts = restarts
        self._log = log
        self._pending = pending

    def go_on(self, progress: Progress) -> Progress:
        """Begin the validation again that was under way when the run was left."""
        return progress if self._pending is None else self._begin(self._pending, progress)

    def after_iteration(self, progress: Progress, actor: Callable[[], bytes]) -> Progress:
        """Where validation is due, take in what the one before has found, and begin it beside what follows.

        Args:
            progress: of the run.
            actor: packs the averaged actor as it is now.

        Returns:
            The progress, with what is known of the best agent and of the validation that is under way.

        Raises:
            TrainingError: if its processes fail too often.
        """
        if progress.iterations != self.iterations and progress.iterations % self.every_iterations:
            self._surviving(self.evaluator.poll)
            return progress
        progress = self._take_in(progress)
        return self._begin(Snapshot(progress, actor()), progress)

    def _begin(self, snapshot: Snapshot, progress: Progress) -> Progress:
        at_end = progress.iterations == self.iterations
        progress = replace(progress, validating_iterations=snapshot.progress.iterations)
        self._surviving(lambda: self.evaluator.start(snapshot, alone=at_end))
        return self._take_in(progress) if at_end or not self.evaluator.beside else progress

    def _take_in(self, progress: Progress) -> Progress:
        """Wait for the validation that is under way, if one is, and log it as of the agent it has looked at."""
        if (snapshot := self.evaluator.snapshot) is None:
            return progress
        rows = self._surviving(self.evaluator.finish)
        then = snapshot.progress
        rows.insert(0, "iteration", then.iterations - 1)
        rows.insert(1, "updates", then.updates)
        self._log.episodes("validation", rows)
        means, scalars = scores(rows, self.evaluator.steps)
        self._log.validation(then.iterations, means)
        self._log.scalars(scalars, then.steps)
        score, best = scalars["validation/score"], progress.best_score
        if best is None or score > best:
            progress = replace(progress, best_score=score, best_iterations=then.iterations)
        return replace(progress, validating_iterations=None)

    def _surviving(self, call: Callable[[], T]) -> T:
        while True:
            try:
                return call()
            except WorkerError as error:
                assert self.evaluator.snapshot is not None  # nothing else has processes
                done = self.evaluator.snapshot.progress.iterations
                self._restarts.spend(f"validation after {done} iterations", error)

    def close(self) -> None:
        """End its processes."""
        self.evaluator.close()


def scores(rows: pd.DataFrame, steps: int) -> tuple[pd.DataFrame, dict[str, float]]:
    """Sum a validation up.

    Args:
        rows: one row an episode, from :meth:`SnapshotEvaluator.finish`.
        steps: length of an episode.

    Returns:
        The mean of every metric, one row a condition, and the scalars to log.
    """
    conditions = ["beta", "collision_weight"]
    means = rows.groupby(conditions, dropna=False)[list(METRICS)].mean().reset_index()
    scalars = {"validation/score": validation_score(means, steps)}
    for values in means.to_dict("records"):
        label = next((f"{values[key]:g}" for key in conditions if not math.isnan(values[key])), "all")
        scalars |= {f"validation/{metric}/{label}": float(values[metric]) for metric in METRICS}
    return means, scalars
