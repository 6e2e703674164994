"""Teams on a Ray cluster: the episodes of one process, whatever becomes of the cluster's.

Ray takes long to start, and each of its processes to import: what needs a cluster is slow.
"""

import os
import signal
from collections.abc import Iterator
from functools import partial
from pathlib import Path
from typing import Any

import pandas as pd
import pytest
import torch

from killed_training import check_killed_run_is_continued
from rcdsac_trl.errors import FaultError, UserInputError
from rcdsac_trl.pipeline import build, extras
from rcdsac_trl.pipeline.build.agent import make_actor
from rcdsac_trl.pipeline.build.collection import _team
from rcdsac_trl.pipeline.saved import CHECKPOINTS, newest
from rcdsac_trl.pipeline.team_collector import STEPS, TeamCollector
from rcdsac_trl.pipeline.team_processes import LocalTeam, Request
from rcdsac_trl.pipeline.validation import packed
from test_teams import collected
from tiny import AGENTS, tiny_cfg, tiny_settings, tiny_trainer
from tiny import STEPS as EPISODE_STEPS

RAY = ("collector=ray", "collector.num_processes=2")
pytestmark = pytest.mark.filterwarnings(
    "ignore::FutureWarning", "ignore::ResourceWarning", "ignore::DeprecationWarning"
)


# ------------------------------------------------------------------------------------------------ without a cluster
def test_a_team_as_a_collector_drives_what_it_is_asked_for() -> None:
    settings = tiny_settings()
    make = partial(_team, settings, [0, 1])
    requests = [Request(number, 3 - number, packed(make_actor(settings))) for number in range(2)]
    team, collector = LocalTeam(make), TeamCollector([make], worker_idx=1, frames_per_batch=7)
    assert collector.stats() == {STEPS: 0}
    for request in requests:
        collector.prepare(request)
        found, expected = collector.next(), team.ask(request)
        assert found.batch_size == (AGENTS, EPISODE_STEPS)
        for key in expected.keys(True, True):
            assert torch.equal(found[key], expected[key]), key
    assert collector.stats() == {STEPS: 2 * EPISODE_STEPS}
    with pytest.raises(RuntimeError, match=r"^prepare\(\) says what to drive"):
        collector.next()
    team.close()


def test_without_ray_the_line_that_installs_it_is_told(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(extras.importlib.util, "find_spec", lambda name: None)
    with pytest.raises(UserInputError) as caught:
        build.check_training(tiny_cfg("sac", *RAY))
    assert str(caught.value) == (
        "collector=ray needs ray, which is not installed: pip install 'rcdsac-trl[ray]', or use collector=multi"
    )


# ------------------------------------------------------------------------------------------------ on a cluster
@pytest.fixture(scope="module")
def ray() -> Iterator[Any]:
    """A cluster of this machine with two cores, whatever it has; everything connects to it."""
    ray = pytest.importorskip("ray")
    before = os.environ.get("PYTHONPATH")
    source = Path(__file__).parents[1] / "src"
    os.environ["PYTHONPATH"] = os.pathsep.join([str(source), before or ""])
    ray.init(address="local", num_cpus=2, include_dashboard=False, log_to_driver=False)
    yield ray
    ray.shutdown()
    os.environ.pop("PYTHONPATH")
    if before is not None:
        os.environ["PYTHONPATH"] = before


def training_rows(run: Path) -> pd.DataFrame:
    return pd.read_csv(run / "training_episodes.csv")


@pytest.mark.slow
def test_episodes_do_not_depend_on_what_collects_them(ray: Any) -> None:
    given = ("world.num_agents=4", "schedule.pursuit_iterations=1")
    for one, other in zip(collected("rcwr", *RAY, *given), collected("rcwr", *given), strict=True):
        assert one.batch_size == other.batch_size == (4, 20)
        assert set(one.keys(True, True)) == set(other.keys(True, True))
        for key in other.keys(True, True):
            assert torch.equal(one[key], other[key]), key


@pytest.mark.slow
@pytest.mark.parametrize(
    ("number", "told"),
    [
        (signal.SIGKILL, "failed: The actor died unexpectedly before finishing this task.; restart 1 of at most 5"),
        (signal.SIGSTOP, "gave no answer within 5 s; restart 1 of at most 5"),
    ],
)
def test_a_run_goes_on_after_a_process_was_lost(
    ray: Any, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, number: signal.Signals, told: str
) -> None:
    from rcdsac_trl.pipeline.ray_teams import RayTeams

    ask, asked = RayTeams.ask, []

    def losing(self: RayTeams, request: Request) -> Any:
        asked.append(request)
        if len(asked) == 2:
            second = self._collector.remote_collectors[1]
            os.kill(ray.get(second.__ray_call__.remote(lambda collector: os.getpid())), number)
            self._timeout_s = 5.0  # they have started
        return ask(self, request)

    monkeypatch.setattr(RayTeams, "ask", losing)
    run, other = tmp_path / "run", tmp_path / "other"
    tiny_trainer(run, "rcdsac_pow", *RAY, "schedule.iterations=3", "world.worker_timeout_s=600").run()
    log = (run / "train.log").read_text()
    assert f"iteration 1, training map 1: Ray process 2 of 2 (split train, seed 0, agents 1) {told}\n" in log
    assert [(each.iteration, each.map_index) for each in asked] == [(0, 0), (1, 1), (1, 2), (2, 3)]
    # What agents are told follows from agent and map: every agent's episodes are there, once.
    tiny_trainer(other, "rcdsac_pow", "schedule.iterations=4").run()
    rows, others = training_rows(run), training_rows(other)
    assert rows["iteration"].tolist() == [0, 0, 1, 1, 2, 2]
    assert rows["beta"].tolist() == others["beta"].tolist()[:2] + others["beta"].tolist()[4:]
    progress = newest(run / CHECKPOINTS, replay=run / "replay")[0].progress
    assert (progress.iterations, progress.restarts, progress.skipped_maps) == (3, 1, 1)


@pytest.mark.slow
def test_a_cluster_without_room_is_told(ray: Any) -> None:
    from rcdsac_trl.pipeline.ray_teams import RayTeams
    from rcdsac_trl.world.workers import WorkerError

    makes = {f"agents {number}": partial(_team, tiny_settings(), [number]) for number in range(3)}
    with pytest.raises(WorkerError, match=r"^the Ray cluster had no room for 3 processes within 1 s$"):
        RayTeams(lambda cores: makes, address=None, cores=1, timeout_s=1.0)


@pytest.mark.slow
def test_a_killed_run_leaves_no_process_and_is_continued(ray: Any, tmp_path: Path) -> None:
    check_killed_run_is_continued(tmp_path, *RAY)  # which made a cluster of its own


@pytest.mark.slow
def test_a_cluster_that_is_not_there_is_told(monkeypatch: pytest.MonkeyPatch) -> None:
    ray = pytest.importorskip("ray")
    from rcdsac_trl.pipeline.ray_teams import RayTeams

    def init(**given: Any) -> None:
        assert given["address"] == "nowhere:6379"
        raise ConnectionError("Could not find any running Ray instance.\nmore")

    monkeypatch.setattr(ray, "is_initialized", lambda: False)
    monkeypatch.setattr(ray, "init", init)
    with pytest.raises(FaultError, match=r"^collector\.address=nowhere:6379: Could not find any running Ray"):
        RayTeams(lambda cores: {}, address="nowhere:6379", cores=1, timeout_s=1.0)
