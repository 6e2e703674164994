"""Processes that each hold a part of the agents and drive whole episodes when asked; they talk once an episode.

TorchRL's ``MultiSyncCollector`` would do as much, but runs TorchRL's loop in each process, which costs five agents
more than driving them, and neither tells which process died or hung, nor how, nor can be closed then.
"""

import contextlib
from collections.abc import Callable, Iterator, Sequence
from contextlib import AbstractContextManager
from functools import partial
from typing import NamedTuple, Protocol

import torch
from tensordict import TensorDictBase

from rcdsac_trl.rollout.worker import EpisodeBatch, side_by_side
from rcdsac_trl.system.interrupts import interruption_point
from rcdsac_trl.system.process_pool import ProcessPool

_PRELOADED = "rcdsac_trl.rollout.make_collector"


class RolloutRequest(NamedTuple):
    """What is to be driven: an iteration's episodes, on a map, with an actor's weights (packed)."""

    iteration: int
    map_index: int
    weights: bytes


Drive = Callable[[RolloutRequest, Callable[[], None]], EpisodeBatch]
"""Drives what is asked for; calls its second argument before every step."""
MakeDrive = Callable[[], AbstractContextManager[Drive]]


class WorkerGroup(Protocol):
    """Workers that together hold all agents."""

    def ask(self, request: RolloutRequest) -> TensorDictBase:
        """Return the episodes of all agents, ``[N, T]``, worker after worker."""

    def close(self) -> None:
        """End the group."""


class LocalWorker:
    """One worker, in this process.

    Args:
        make: makes what drives.
    """

    def __init__(self, make: MakeDrive) -> None:
        self._stack = contextlib.ExitStack()
        self._drive = self._stack.enter_context(make())

    def ask(self, request: RolloutRequest) -> TensorDictBase:
        """See :class:`WorkerGroup`."""
        return self._drive(request, interruption_point).tensordict()

    def close(self) -> None:
        """See :class:`WorkerGroup`."""
        self._stack.close()


class WorkerProcesses:
    """A process for each worker. Nothing but :meth:`close` works after an error.

    Args:
        makes: what makes each worker's drive, in its process; must pickle.
        described: what describes each worker, for messages.
        timeout_s: seconds in which a process must take a step, else it counts as hung; None: it never does.
    """

    def __init__(self, makes: Sequence[MakeDrive], described: Sequence[str], timeout_s: float | None) -> None:
        names = [f"worker process {n} of {len(makes)} ({each})" for n, each in enumerate(described, 1)]
        single = [partial(_single_threaded, make) for make in makes]
        self.pool = ProcessPool(single, names, module=_PRELOADED, timeout_s=timeout_s)

    def ask(self, request: RolloutRequest) -> TensorDictBase:
        """See :class:`WorkerGroup`.

        Raises:
            WorkerError: if a process dies or hangs.
            UserInputError: if a process finds that its input is wrong.
        """
        for number in range(len(self.pool)):
            self.pool.send(number, request)
        answers: dict[int, EpisodeBatch] = dict(self.pool.answers(until_done=True))
        return side_by_side([answers[number] for number in sorted(answers)]).tensordict()

    def close(self) -> None:
        """See :class:`WorkerGroup`."""
        self.pool.close()


@contextlib.contextmanager
def _single_threaded(make: MakeDrive) -> Iterator[Drive]:
    """Make what drives in a process of its own: a few agents' rows gain nothing from a second thread."""
    torch.set_num_threads(1)
    with make() as drive:
        yield drive
