"""A worker as one of TorchRL's collectors, so that TorchRL's distributed collectors can hold it on another machine.

Those collectors wait where Ctrl-C does not reach them, and for ever. So they wait in a thread (:func:`beside`), and the
main one looks on (:func:`watch`).
"""

import contextlib
import math
import threading
import time
from collections import OrderedDict
from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import Future, wait
from functools import partial
from typing import Any, NoReturn, TypeVar

import torch
from tensordict import TensorDictBase
from torchrl.collectors._base import BaseCollector

from rcdsac_trl.errors import UserInputError
from rcdsac_trl.rollout.worker_processes import Drive, MakeDrive, RolloutRequest
from rcdsac_trl.system.interrupts import interruption_point

T = TypeVar("T")

# How often one looks for Ctrl-C, and how often for the steps of processes.
_LOOK_S = 0.25
_ASK_EVERY_S = 2.0

STEPS = "steps"
"""Key of the number of steps in :meth:`WorkerCollector.stats`."""
AT_REST = math.inf
"""The number of steps of who has nothing to do."""


class WorkerCollector(BaseCollector):
    """Collects the episodes that it is asked for, with the weights that come with the request.

    TorchRL's own ``Collector`` decides by itself what comes next, and takes three times as long as a worker. What has
    happened leaves nothing behind: an episode follows from the request alone.

    Args:
        create_env_fn: what makes the worker's drive, alone in a list, as TorchRL passes it on.
        worker_idx: which of the collectors this is.
        settings: what TorchRL passes on to collectors that step an environment; there is none here.
    """

    def __init__(self, create_env_fn: Sequence[MakeDrive], *, worker_idx: int | None = None, **settings: Any) -> None:
        super().__init__()
        torch.set_num_threads(1)
        self.worker_idx = worker_idx
        self._stack = contextlib.ExitStack()
        try:
            self._drive: Drive = self._stack.enter_context(create_env_fn[0]())
        except UserInputError as error:  # Ray tells of a process that cannot be made only by its traceback
            self._drive = partial(_refuse, error)
        self._request: RolloutRequest | None = None
        self._steps = 0.0
        self._shown = AT_REST

    def prepare(self, request: RolloutRequest) -> None:
        """Say what the next batch is to be."""
        self._request = request
        self._shown = self._steps

    def iterator(self) -> Iterator[TensorDictBase]:
        """Yield what was asked for last, ``[N, T]``."""
        while True:
            if self._request is None:
                raise RuntimeError("prepare() says what to drive, before each batch")
            request, self._request = self._request, None
            driven = self._drive(request, self._count).tensordict()
            self._shown = AT_REST
            yield driven

    def _count(self) -> None:
        self._steps += 1
        self._shown = self._steps

    def stats(self) -> dict[str, int | float | bool]:
        """Tell how many steps were taken, or ``AT_REST``, from another thread than the one that drives."""
        return {STEPS: self._shown}

    def shutdown(self, timeout: float | None = None, close_env: bool = True, raise_on_error: bool = True) -> None:
        """Disconnect the simulations."""
        self._stack.close()

    def __bool__(self) -> bool:
        """Be true: Ray asks the truth of what has raised, and TorchRL would count batches to tell it."""
        return True

    def set_seed(self, seed: int, static_seed: bool = False) -> int:
        """Refuse: the seed is the run's."""
        raise NotImplementedError

    def state_dict(self) -> OrderedDict:
        """Return nothing: there is no state between two requests."""
        return OrderedDict()

    def load_state_dict(self, state_dict: OrderedDict) -> None:
        """Take nothing."""


def _refuse(error: UserInputError, request: RolloutRequest, before_step: Callable[[], None]) -> NoReturn:
    """Drive nothing, as asked of a worker that could not be made."""
    raise error


def beside(call: Callable[[], T]) -> Future[T]:
    """Call something in a thread that ends with the program, whatever it waits for."""
    future: Future[T] = Future()

    def run() -> None:
        try:
            future.set_result(call())
        except BaseException as error:
            future.set_exception(error)

    threading.Thread(target=run, daemon=True).start()
    return future


def watch(
    waiting: Future[Any], steps: Callable[[], Mapping[int, float]], number: int, timeout_s: float | None
) -> int | None:
    """Wait for some processes, such as for their episodes.

    Args:
        waiting: for what they do.
        steps: tells how many steps each process has taken, or ``AT_REST``, of those that answer; what it raises is
            passed on.
        number: of the processes.
        timeout_s: seconds in which a process must first answer, and then take a step; None: it has all the time.

    Returns:
        The process that has taken no step for so long; None if the result, or an error, is there.
    """
    asked_s = time.monotonic()
    taken: dict[int, float] = {}
    changed_s = dict.fromkeys(range(number), asked_s)
    while not waiting.done():
        wait([waiting], timeout=_LOOK_S)
        interruption_point()
        if time.monotonic() - asked_s < min(_ASK_EVERY_S, _ASK_EVERY_S if timeout_s is None else timeout_s / 4):
            continue
        told = steps()
        asked_s = time.monotonic()
        for process in range(number):
            if process in told and (told[process] != taken.get(process) or told[process] == AT_REST):
                taken[process], changed_s[process] = told[process], asked_s
            elif timeout_s is not None and asked_s - changed_s[process] > timeout_s and not waiting.done():
                return process
    return None
