"""WorkerGroup on the machines of a Ray cluster, held by TorchRL's ``RayCollector``.

Import this module only where Ray is wanted: it takes seconds.
"""

import contextlib
import sys
import time
import warnings
from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import Future, wait
from typing import Any

import ray
from ray.exceptions import RayError, RayTaskError
from ray.util.placement_group import PlacementGroup, placement_group, remove_placement_group
from ray.util.scheduling_strategies import PlacementGroupSchedulingStrategy
from tensordict import TensorDictBase
from torchrl.collectors.distributed import RayCollector

from rcdsac_trl.errors import FaultError, UserInputError, first_line
from rcdsac_trl.rollout.torchrl_worker import STEPS, WorkerCollector, beside, watch
from rcdsac_trl.rollout.worker_processes import MakeDrive, RolloutRequest
from rcdsac_trl.system.interrupts import interruption_point
from rcdsac_trl.system.processes import WorkerError

# How often one looks for Ctrl-C.
_LOOK_S = 0.25
# How long processes may take to tell their steps.
_ANSWER_S = 2.0
# How long who waits for processes may take to notice that they were killed.
_NOTICE_S = 10.0


class RayWorkers:
    """A process of a Ray cluster for each worker. Nothing but :meth:`close` works after an error.

    Weights go through Ray's store of objects, once to each machine. TorchRL's ``RayWeightSyncScheme`` opens connections
    of its own beside Ray's, to the address that a machine's name has on that machine, which often is its own loopback.

    Args:
        group: makes, of the number of the cluster's cores, what makes each worker's drive, by what describes the worker
            in messages; workers are of one size, and what makes them must pickle.
        address: of the cluster, as ``ray.init`` takes it; None makes one of this machine alone, for these workers.
        cores: that a cluster of this machine alone has.
        timeout_s: seconds in which a process must find room in the cluster, be ready, and take a step, else it counts
            as lost; None: it never does.

    Raises:
        FaultError: if there is no such cluster, or it cannot be made.
        WorkerError: if the cluster has no room for the processes within that time, or they are not ready by then.
    """

    def __init__(
        self,
        group: Callable[[int], Mapping[str, MakeDrive]],
        *,
        address: str | None,
        cores: int,
        timeout_s: float | None,
    ) -> None:
        self._timeout_s = timeout_s
        self._waiting: Future[TensorDictBase] | None = None
        self._stack = contextlib.ExitStack()
        try:
            makes = group(self._stack.enter_context(_connected(address, cores)))
            self._described = list(makes)
            self._stack.callback(self._let_notice)
            room = placement_group([{"CPU": 1}] * len(makes), strategy="SPREAD")
            self._stack.callback(remove_placement_group, room)
            self._wait_for(room)
            self._collector = self._started(list(makes.values()), room)
            self._stack.callback(self._collector.shutdown)
        except BaseException:
            self.close()
            raise
        self._batches = iter(self._collector)

    def _wait_for(self, room: PlacementGroup) -> None:
        started_s = time.monotonic()
        while not room.wait(timeout_seconds=_LOOK_S):
            interruption_point()
            if self._timeout_s is not None and time.monotonic() - started_s > self._timeout_s:
                raise WorkerError(
                    f"the Ray cluster had no room for {len(self._described)} processes within {self._timeout_s:g} s"
                )

    def _started(self, makes: Sequence[MakeDrive], room: PlacementGroup) -> RayCollector:
        starting = beside(lambda: _collector(makes, room))
        if watch(starting, dict, len(makes), self._timeout_s) is not None:
            raise WorkerError(f"the Ray processes ({len(makes)}) were not ready within {self._timeout_s:g} s")
        return starting.result()

    def ask(self, request: RolloutRequest) -> TensorDictBase:
        """See :class:`~rcdsac_trl.rollout.worker_processes.WorkerGroup`.

        Raises:
            WorkerError: if a process dies or hangs, or its machine is lost.
            UserInputError: if a process finds that its input is wrong.
        """
        self._waiting = beside(lambda: self._collect(request))
        hung = watch(self._waiting, self._steps, len(self._described), self._timeout_s)
        if hung is not None:
            raise WorkerError(f"{self._name(hung)} gave no answer within {self._timeout_s:g} s")
        try:
            return self._waiting.result()
        except RayError as error:
            if isinstance(error, RayTaskError) and isinstance(error.cause, UserInputError):
                raise error.cause from None
            raise WorkerError(self._told(error)) from error

    def _collect(self, request: RolloutRequest) -> TensorDictBase:
        stored = ray.put(request)
        self._collector.map_fn("prepare", [(stored,)] * len(self._described))
        with warnings.catch_warnings():
            warnings.filterwarnings("ignore", "RayCollector iteration started before weight", UserWarning)
            batch = next(self._batches)
        return batch.flatten(0, 1)

    def _steps(self) -> dict[int, float]:
        """Return how many steps each process has taken, of those that answer."""
        told = self._collector.stats("per_worker", timeout=_ANSWER_S)
        keys = {process: f"worker_{process}/{STEPS}" for process in range(len(self._described))}
        return {process: told[key] for process, key in keys.items() if key in told}

    def _told(self, error: RayError) -> str:
        """Say which processes are gone, or what one of them said."""
        answering = self._steps()
        lost = [self._name(process) for process in range(len(self._described)) if process not in answering]
        cause = error.cause if isinstance(error, RayTaskError) else error
        return f"{' and '.join(lost) or 'a Ray process'} failed: {first_line(cause)}"

    def _name(self, process: int) -> str:
        return f"Ray process {process + 1} of {len(self._described)} ({self._described[process]})"

    def _let_notice(self) -> None:
        """Let the thread that waits for processes notice that they are gone, before the cluster is left."""
        if self._waiting is not None:
            wait([self._waiting], timeout=_NOTICE_S)

    def close(self) -> None:
        """See :class:`~rcdsac_trl.rollout.worker_processes.WorkerGroup`."""
        with contextlib.suppress(Exception):  # whatever the cluster is by now
            self._stack.close()


@contextlib.contextmanager
def _connected(address: str | None, cores: int) -> Iterator[int]:
    """Be connected to a cluster, and leave it unless the caller was already; yield the number of its cores."""
    connected = ray.is_initialized()
    if not connected:
        own: dict[str, Any] = {"num_cpus": cores, "include_dashboard": False} if address is None else {}
        try:
            ray.init(address=address or "local", log_to_driver=False, **own)
        except Exception as error:  # whatever Ray finds to say
            raise FaultError(f"collector.address={address}: {first_line(error)}") from error
    try:
        yield int(ray.cluster_resources().get("CPU", 0))
    finally:
        if not connected:
            ray.shutdown()


def _collector(makes: Sequence[MakeDrive], room: PlacementGroup) -> RayCollector:
    remotes: list[dict[str, Any]] = [
        {
            "num_cpus": 1,
            "max_concurrency": 2,  # one thread drives, one tells how far it is
            "scheduling_strategy": PlacementGroupSchedulingStrategy(room, placement_group_bundle_index=process),
        }
        for process in range(len(makes))
    ]
    with warnings.catch_warnings():
        warnings.filterwarnings("ignore", "The policy is not an nn.Module", UserWarning)  # weights come with a request
        return RayCollector(
            list(makes),
            collector_class=WorkerCollector,
            # WorkerGroup drive what they are asked for: nobody counts frames.
            frames_per_batch=len(makes),
            total_frames=sys.maxsize,
            remote_configs=remotes,
            weight_sync_schemes={},
            sync=True,
        )
