"""Teams in a torch.distributed group: the episodes of one process, whatever becomes of the group's.

Each of its processes takes long to import: what needs a group is slow.
"""

import multiprocessing
import os
import signal
from pathlib import Path

import pandas as pd
import pytest
import torch
from tensordict import TensorDictBase
from test_worker import collected

from killed_training import check_killed_run_is_continued
from rcdsac_trl.config.run_config import CHECKPOINTS
from rcdsac_trl.errors import UserInputError
from rcdsac_trl.rollout.distributed_workers import DistributedTeams, _packed, _unpacked
from rcdsac_trl.rollout.make_agent import make_actor, packed
from rcdsac_trl.rollout.make_collector import _example, _team
from rcdsac_trl.rollout.worker_processes import LocalTeam, Request
from rcdsac_trl.storage.checkpoint_record import newest
from rcdsac_trl.system import extras
from rcdsac_trl.training.setup import check_training
from tiny import tiny_cfg, tiny_settings, tiny_trainer

GROUP = ("collector=distributed", "collector.num_processes=2")


# ------------------------------------------------------------------------------------------------ without a group
@pytest.mark.parametrize("row", ["rcdsac_pow", "rcwr", "sac"])
def test_the_example_is_what_a_team_returns_but_for_its_numbers(row: str) -> None:
    settings = tiny_settings(row)
    team = LocalTeam(lambda: _team(settings, [0, 1]))
    driven, example = team.ask(Request(0, 0, packed(make_actor(settings)))), _example(settings, 2)
    assert driven.batch_size == example.batch_size
    assert set(driven.keys(True, True)) == set(example.keys(True, True))
    for key in example.keys(True, True):
        assert (driven[key].shape, driven[key].dtype) == (example[key].shape, example[key].dtype), key
        assert example[key].is_contiguous(), key
    team.close()


def test_a_request_comes_out_of_the_store_as_it_went_in() -> None:
    store = torch.distributed.TCPStore("localhost", 0, is_master=True, wait_for_workers=False)
    request = Request(3, 17, b" \0\xff 1 2 ")
    store.set("request", _packed(request))  # type: ignore[arg-type]
    assert _unpacked(store.get("request")) == request


def test_without_submitit_the_line_that_installs_it_is_told(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(extras.importlib.util, "find_spec", lambda name: None)
    slurm = "collector.slurm={partition: long, timeout_min: 10}"
    with pytest.raises(UserInputError, match=r"^collector\.slurm needs submitit, which is not installed: pip install"):
        check_training(tiny_cfg("sac", *GROUP, slurm))


# ------------------------------------------------------------------------------------------------ in a group
def training_rows(run: Path) -> pd.DataFrame:
    return pd.read_csv(run / "training_episodes.csv")


@pytest.mark.slow
def test_episodes_do_not_depend_on_what_collects_them() -> None:
    given = ("world.num_agents=4", "schedule.pursuit_iterations=1")
    for one, other in zip(collected("rcwr", *GROUP, *given), collected("rcwr", *given), strict=True):
        assert one.batch_size == other.batch_size == (4, 20)
        assert set(one.keys(True, True)) == set(other.keys(True, True))
        for key in other.keys(True, True):
            assert torch.equal(one[key], other[key]), key
    assert not multiprocessing.active_children()


@pytest.mark.slow
@pytest.mark.parametrize(
    ("number", "told"),
    [(signal.SIGKILL, "was killed by SIGKILL"), (signal.SIGSTOP, "gave no answer within 5 s")],
)
def test_a_run_goes_on_after_a_process_was_lost(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, number: signal.Signals, told: str
) -> None:
    ask, asked = DistributedTeams.ask, []

    def losing(self: DistributedTeams, request: Request) -> TensorDictBase:
        asked.append(request)
        if len(asked) == 2:
            os.kill(self._collector.jobs[1].pid, number)
            self._timeout_s = 5.0  # they have started
        return ask(self, request)

    monkeypatch.setattr(DistributedTeams, "ask", losing)
    run, other = tmp_path / "run", tmp_path / "other"
    tiny_trainer(run, "rcdsac_pow", *GROUP, "schedule.iterations=3", "world.worker_timeout_s=600").run()
    log = (run / "train.log").read_text()
    assert (
        f"iteration 1, training map 1: distributed process 2 of 2 (split train, seed 0, agents 1) {told}; "
        "restart 1 of at most 5\n"
    ) in log
    assert [(each.iteration, each.map_index) for each in asked] == [(0, 0), (1, 1), (1, 2), (2, 3)]
    tiny_trainer(other, "rcdsac_pow", "schedule.iterations=4").run()
    rows, others = training_rows(run), training_rows(other)
    assert rows["iteration"].tolist() == [0, 0, 1, 1, 2, 2]
    assert rows["beta"].tolist() == others["beta"].tolist()[:2] + others["beta"].tolist()[4:]
    progress = newest(run / CHECKPOINTS, replay=run / "replay")[0].progress
    assert (progress.iterations, progress.restarts, progress.skipped_maps) == (3, 1, 1)
    assert not multiprocessing.active_children()


@pytest.mark.slow
def test_a_killed_run_leaves_no_process_and_is_continued(tmp_path: Path) -> None:
    check_killed_run_is_continued(tmp_path, *GROUP)


# submitit lets go of the programs that it has started before they have ended.
@pytest.mark.filterwarnings("ignore::pytest.PytestUnraisableExceptionWarning")
@pytest.mark.slow
def test_by_submitit(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    pytest.importorskip("submitit")
    monkeypatch.chdir(tmp_path)  # where TorchRL has submitit write its logs
    source = Path(__file__).parents[2] / "src"
    monkeypatch.setenv("PYTHONPATH", os.pathsep.join([str(source), os.environ.get("PYTHONPATH", "")]))
    slurm = "collector.slurm={partition: null, timeout_min: 10}"  # without SLURM here, submitit starts processes
    given = ("world.num_agents=4", "world.worker_timeout_s=600")
    for one, other in zip(collected("rcdsac_pow", *GROUP, *given, slurm), collected("rcdsac_pow", *given), strict=True):
        for key in other.keys(True, True):
            assert torch.equal(one[key], other[key]), key
