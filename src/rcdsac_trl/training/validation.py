"""Validation of a snapshot of the agent, beside the training that goes on meanwhile."""

import math
from collections.abc import Callable
from contextlib import AbstractContextManager
from dataclasses import dataclass
from functools import partial

import pandas as pd

from rcdsac_trl.rollout.evaluation_pool import Drive, Drivers, Rows, drive_maps, prepare
from rcdsac_trl.rollout.measurement import table_of
from rcdsac_trl.rollout.metrics import METRICS, validation_score
from rcdsac_trl.storage.checkpoint_record import Progress
from rcdsac_trl.system.processes import WorkerError


@dataclass(frozen=True)
class Snapshot:
    """An agent as it was at one moment of a run.

    Attributes:
        progress: of the run at that moment.
        actor: the weights of the averaged actor, from :func:`packed`.
    """

    progress: Progress
    actor: bytes


class Validation:
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
        self._drivers: Drivers | None = None
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

    def _begin(self, snapshot: Snapshot) -> Drivers:
        self._maps = []
        processes = self._processes_alone if self._alone else self._processes
        make = partial(self._make, snapshot.actor)
        self._drivers = Drivers(make, self._num_maps, processes, timeout_s=self._timeout_s, at_once=True)
        return self._drivers

    def look(self) -> None:
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
            self._maps = list(drive_maps(partial(self._make, self.snapshot.actor), self._num_maps, processes=0))
        self.close()
        self.snapshot = None
        return table_of(self._maps)

    def _receive(self, snapshot: Snapshot, *, until_done: bool) -> None:
        try:
            drivers = self._drivers or self._begin(snapshot)
            self._maps.extend(drivers.receive(until_done=until_done))
        except WorkerError:
            self.close()
            raise

    def close(self) -> None:
        """End the processes."""
        if self._drivers is not None:
            self._drivers.close()
        self._drivers = None


def scores(rows: pd.DataFrame, steps: int) -> tuple[pd.DataFrame, dict[str, float]]:
    """Sum a validation up.

    Args:
        rows: one row an episode, from :meth:`Validation.finish`.
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
