"""WorkerGroup on a Ray cluster: the episodes of one process, whatever becomes of the cluster's.

Ray takes long to start, and each of its processes to import: what needs a cluster is slow.
"""

import contextlib
import os
import signal
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from functools import partial
from pathlib import Path
from typing import Any

import pandas as pd
import pytest
import torch
from tensordict import TensorDictBase
from test_worker import collected

from killed_training import check_killed_run_is_continued
from rcdsac_trl.config.run_config import CHECKPOINTS
from rcdsac_trl.errors import FaultError, UserInputError
from rcdsac_trl.rollout.make_agent import make_actor, packed
from rcdsac_trl.rollout.make_collector import _worker
from rcdsac_trl.rollout.torchrl_worker import AT_REST, STEPS, WorkerCollector, beside, watch
from rcdsac_trl.rollout.worker import EpisodeBatch
from rcdsac_trl.rollout.worker_processes import Drive, LocalWorker, RolloutRequest
from rcdsac_trl.storage.checkpoint_record import newest
from rcdsac_trl.system import extras
from rcdsac_trl.training.setup import check_training
from tiny import AGENTS, tiny_cfg, tiny_settings, tiny_trainer
from tiny import STEPS as EPISODE_STEPS

RAY = ("collector=ray", "collector.num_processes=2")
pytestmark = pytest.mark.filterwarnings(
    "ignore::FutureWarning", "ignore::ResourceWarning", "ignore::DeprecationWarning"
)


# ------------------------------------------------------------------------------------------------ without a cluster
def test_a_worker_as_a_collector_drives_what_it_is_asked_for() -> None:
    settings = tiny_settings()
    make = partial(_worker, settings, [0, 1])
    requests = [RolloutRequest(number, 3 - number, packed(make_actor(settings))) for number in range(2)]
    worker, collector = LocalWorker(make), WorkerCollector([make], worker_idx=1, frames_per_batch=7)
    assert collector  # Ray asks it of what has raised
    assert collector.stats() == {STEPS: AT_REST}
    for request in requests:
        collector.prepare(request)
        assert collector.stats() == {STEPS: request.iteration * EPISODE_STEPS}
        found, expected = collector.next(), worker.ask(request)
        assert found.batch_size == (AGENTS, EPISODE_STEPS)
        for key in expected.keys(True, True):
            assert torch.equal(found[key], expected[key]), key
        assert collector.stats() == {STEPS: AT_REST}
    with pytest.raises(RuntimeError, match=r"^prepare\(\) says what to drive"):
        collector.next()
    worker.close()


def test_a_process_at_rest_does_not_count_as_hung_but_one_that_neither_steps_nor_answers_does() -> None:
    steps = iter(range(1000))

    def told(third: dict[int, float]) -> Callable[[], dict[int, float]]:
        return lambda: {0: AT_REST, 1: float(next(steps)), **third}

    done = threading.Event()
    waiting = beside(done.wait)
    assert watch(waiting, told({2: 5.0}), 3, timeout_s=0.5) == 2
    assert watch(waiting, told({}), 3, timeout_s=0.5) == 2
    threading.Timer(1.5, done.set).start()
    assert watch(waiting, told({2: AT_REST}), 3, timeout_s=0.5) is None
    assert watch(beside(lambda: 1 / 0), told({}), 3, timeout_s=None) is None


def test_without_ray_the_line_that_installs_it_is_told(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(extras.importlib.util, "find_spec", lambda name: None)
    with pytest.raises(UserInputError) as caught:
        check_training(tiny_cfg("sac", *RAY))
    assert str(caught.value) == (
        "collector=ray needs ray, which is not installed: pip install 'rcdsac-trl[ray]', or use collector=multi"
    )


# ------------------------------------------------------------------------------------------------ on a cluster
@pytest.fixture(scope="module")
def cluster() -> Iterator[Any]:
    """Two nodes with a core each, which share this machine; everything connects to them."""
    ray = pytest.importorskip("ray")
    from ray.cluster_utils import Cluster

    source = Path(__file__).parents[2] / "src"
    with pytest.MonkeyPatch.context() as given:
        given.setenv("PYTHONPATH", os.pathsep.join([str(source), os.environ.get("PYTHONPATH", "")]))
        given.setenv("RAY_worker_niceness", "0")  # else, beside other programs, its processes hardly start
        cluster = Cluster(initialize_head=True, head_node_args={"num_cpus": 1, "include_dashboard": False})
        cluster.add_node(num_cpus=1)
        ray.init(address=cluster.address, log_to_driver=False)
        yield cluster
        ray.shutdown()
        cluster.shutdown()


def training_rows(run: Path) -> pd.DataFrame:
    return pd.read_csv(run / "training_episodes.csv")


@pytest.mark.slow
def test_episodes_do_not_depend_on_what_collects_them(cluster: Any) -> None:
    given = ("world.num_agents=4", "schedule.pursuit_iterations=1")
    for one, other in zip(collected("rcwr", *RAY, *given), collected("rcwr", *given), strict=True):
        assert one.batch_size == other.batch_size == (4, 20)
        assert set(one.keys(True, True)) == set(other.keys(True, True))
        for key in other.keys(True, True):
            assert torch.equal(one[key], other[key]), key


def kill(cluster: Any, collectors: Sequence[Any], number: signal.Signals) -> int:
    """Send the second process a signal; return which one that is."""
    import ray

    os.kill(ray.get(collectors[1].__ray_call__.remote(lambda collector: os.getpid())), number)
    return 1


def remove_a_node(cluster: Any, collectors: Sequence[Any]) -> int:
    """Remove the node that is not the head, while another is there; return which process it held."""
    import ray

    ask = [each.__ray_call__.remote(lambda _: ray.get_runtime_context().get_node_id()) for each in collectors]
    (node,) = cluster.worker_nodes
    held = ray.get(ask).index(node.node_id)
    cluster.add_node(num_cpus=1)
    cluster.remove_node(node)
    return held


@pytest.mark.slow
@pytest.mark.parametrize(
    ("lose", "told"),
    [
        (partial(kill, number=signal.SIGKILL), "failed: The actor died unexpectedly before finishing this task."),
        (partial(kill, number=signal.SIGSTOP), "gave no answer within 5 s"),
        (remove_a_node, "failed: The actor died"),
    ],
    ids=["killed", "stopped", "node"],
)
def test_a_run_goes_on_after_a_process_was_lost(
    cluster: Any, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, lose: Callable[..., int], told: str
) -> None:
    from rcdsac_trl.rollout.ray_workers import RayWorkers

    ask, asked, lost = RayWorkers.ask, [], []

    def losing(self: RayWorkers, request: RolloutRequest) -> TensorDictBase:
        asked.append(request)
        if len(asked) == 2:
            lost.append(lose(cluster, self._collector.remote_collectors))
            self._timeout_s = 5.0 if "5 s" in told else None  # they have started
        return ask(self, request)

    monkeypatch.setattr(RayWorkers, "ask", losing)
    run, other = tmp_path / "run", tmp_path / "other"
    tiny_trainer(run, "rcdsac_pow", *RAY, "schedule.iterations=3", "world.worker_timeout_s=600").run()
    log = (run / "train.log").read_text()
    (agent,) = lost  # each process holds the agent of its number
    name = f"Ray process {agent + 1} of 2 (split train, seed 0, agents {agent})"
    assert f"iteration 2, training map 1: {name} {told}" in log
    assert "; restart 1 of at most 5\nthe episodes on map 1 are dropped" in log
    assert [(each.iteration, each.map_index) for each in asked] == [(0, 0), (1, 1), (1, 2), (2, 3)]
    # What agents are told follows from agent and map: every agent's episodes are there, once.
    tiny_trainer(other, "rcdsac_pow", "schedule.iterations=4").run()
    rows, others = training_rows(run), training_rows(other)
    assert rows["iteration"].tolist() == [0, 0, 1, 1, 2, 2]
    assert rows["beta"].tolist() == others["beta"].tolist()[:2] + others["beta"].tolist()[4:]
    progress = newest(run / CHECKPOINTS, replay=run / "replay")[0].progress
    assert (progress.iterations, progress.restarts, progress.skipped_maps) == (3, 1, 1)


@pytest.mark.slow
def test_a_cluster_without_room_is_told(cluster: Any) -> None:
    from rcdsac_trl.rollout.ray_workers import RayWorkers
    from rcdsac_trl.system.processes import WorkerError

    makes = {f"agents {number}": partial(_worker, tiny_settings(), [number]) for number in range(3)}
    with pytest.raises(WorkerError, match=r"^the Ray cluster had no room for 3 processes within 1 s$"):
        RayWorkers(lambda cores: makes, address=None, cores=1, timeout_s=1.0)


@pytest.mark.slow
def test_a_process_that_is_not_ready_in_time_is_told(cluster: Any) -> None:
    from rcdsac_trl.rollout.ray_workers import RayWorkers
    from rcdsac_trl.system.processes import WorkerError

    @contextlib.contextmanager
    def make() -> Iterator[Drive]:
        time.sleep(600)
        yield

    with pytest.raises(WorkerError, match=r"^the Ray processes \(1\) were not ready within 3 s$"):
        RayWorkers(lambda cores: {"agents 0": make}, address=None, cores=2, timeout_s=3)


def test_wrong_input_that_is_found_as_a_worker_is_made_is_told_with_the_first_batch() -> None:
    @contextlib.contextmanager
    def make() -> Iterator[Drive]:
        raise UserInputError("there are no such maps: give others")
        yield

    collector = WorkerCollector([make])
    collector.prepare(RolloutRequest(0, 0, b""))
    with pytest.raises(UserInputError, match="no such maps"):
        collector.next()


@pytest.mark.slow
@pytest.mark.parametrize("when", ["it is made", "it drives"])
def test_wrong_input_that_a_process_finds_is_told_as_such(cluster: Any, when: str) -> None:
    from rcdsac_trl.rollout.ray_workers import RayWorkers

    @contextlib.contextmanager
    def make() -> Iterator[Drive]:
        if when == "it is made":
            raise UserInputError("there is no map 7: give others")

        def drive(request: RolloutRequest, before_step: Callable[[], None]) -> EpisodeBatch:
            raise UserInputError(f"there is no map {request.map_index}: give others")

        yield drive

    workers = RayWorkers(lambda cores: {"agents 0": make}, address=None, cores=1, timeout_s=None)
    with contextlib.closing(workers), pytest.raises(UserInputError, match=r"^there is no map 7: give others$"):
        workers.ask(RolloutRequest(0, 7, b""))


@pytest.mark.slow
def test_a_killed_run_leaves_no_process_and_is_continued(cluster: Any, tmp_path: Path) -> None:
    check_killed_run_is_continued(tmp_path, *RAY)  # which made a cluster of its own


@pytest.mark.slow
def test_a_cluster_that_is_not_there_is_told(monkeypatch: pytest.MonkeyPatch) -> None:
    ray = pytest.importorskip("ray")
    from rcdsac_trl.rollout.ray_workers import RayWorkers

    def init(**given: Any) -> None:
        assert given["address"] == "nowhere:6379"
        raise ConnectionError("Could not find any running Ray instance.\nmore")

    monkeypatch.setattr(ray, "is_initialized", lambda: False)
    monkeypatch.setattr(ray, "init", init)
    with pytest.raises(FaultError, match=r"^collector\.address=nowhere:6379: Could not find any running Ray"):
        RayWorkers(lambda cores: {}, address="nowhere:6379", cores=1, timeout_s=1.0)
