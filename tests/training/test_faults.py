"""Worker processes die and hang, disks are full, memory ends: one sentence, and the last checkpoint is whole."""

import errno
import multiprocessing
import os
import re
import resource
import shutil
import signal
import sys
import tempfile
import warnings
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pytest
import torch
from tensordict import TensorDictBase
from torchrl.envs import ParallelEnv

from forked import Forked
from rcdsac_trl import train
from rcdsac_trl.cli import fail
from rcdsac_trl.config.compose import compose
from rcdsac_trl.config.run_config import CHECKPOINTS
from rcdsac_trl.errors import TrainingError, UserInputError
from rcdsac_trl.evaluation.evaluation import make_evaluation
from rcdsac_trl.rollout.policies import CollectionPolicy
from rcdsac_trl.rollout.worker_processes import RolloutRequest, WorkerProcesses
from rcdsac_trl.storage.checkpoint_record import Progress, newest
from rcdsac_trl.system import resources
from rcdsac_trl.system.invocation import program
from rcdsac_trl.training.setup import resume_training
from rcdsac_trl.world.maps.generator import MapSettings
from rcdsac_trl.world.task.agent_group import AgentGroup
from tiny import STEPS, TINY, tiny_trainer

WORKERS = ["collector=parallel_env", "world.num_workers=2", "schedule.iterations=3", "validation.every_iterations=3"]
SMALL = MapSettings(size_m=10.0, layouts=("clutter",), num_movers=0)


# ------------------------------------------------------------------------------------------------ worker processes
@pytest.fixture
def signalled(monkeypatch: pytest.MonkeyPatch) -> Callable[..., None]:
    """Send the second worker of a split a signal before some of its steps, counted over all environments."""

    def arrange(split: str, at: list[int], number: signal.Signals = signal.SIGKILL) -> None:
        step = ParallelEnv._step
        counted = [0]

        def counting(self: ParallelEnv, tensordict: TensorDictBase) -> TensorDictBase:
            if self.create_env_kwargs[0]["split"] == split:
                if counted[0] in at:
                    os.kill(self._workers[1].pid, number)
                counted[0] += 1
            return step(self, tensordict)

        monkeypatch.setattr(ParallelEnv, "_step", counting)

    return arrange


def training_rows(run: Path) -> pd.DataFrame:
    return pd.read_csv(run / "training_episodes.csv")


def test_a_run_goes_on_after_a_worker_was_killed(tmp_path: Path, signalled: Callable[..., None]) -> None:
    run = tmp_path / "run"
    signalled("train", [STEPS + 7])  # in the middle of the second iteration
    tiny_trainer(run, "rcdsac_pow", *WORKERS).run()
    told = (run / "train.log").read_text()
    assert (
        "iteration 2, training map 1: worker process 2 of 2 (split train, seed 0, agents 1) was killed by SIGKILL; "
        "restart 1 of at most 5\nthe episodes on map 1 are dropped: iteration 2 drives on the next\n"
    ) in told
    rows = training_rows(run)
    assert rows["iteration"].tolist() == [0, 0, 1, 1, 2, 2]
    assert np.isfinite(rows.to_numpy()).all()
    saved, damaged = newest(run / CHECKPOINTS, replay=run / "replay")
    assert not damaged
    progress = saved.progress
    assert (progress.iterations, progress.steps, progress.restarts, progress.skipped_maps) == (3, 3 * 2 * STEPS, 1, 1)
    # Iterations 1 and 2 are those that a run without workers drives on maps 2 and 3: what is told follows the map.
    other = tmp_path / "other"
    tiny_trainer(other, "rcdsac_pow", "schedule.iterations=4", "validation.every_iterations=4").run()
    assert (
        rows["beta"].tolist() == training_rows(other)["beta"].tolist()[:2] + training_rows(other)["beta"].tolist()[4:]
    )


def test_a_run_goes_on_after_a_collecting_process_was_killed(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("rcdsac_trl.system.process_pool.START_METHOD", "fork")  # starts at once
    ask, asked = WorkerProcesses.ask, [0]

    def killing(self: WorkerProcesses, request: RolloutRequest) -> TensorDictBase:
        asked[0] += 1
        if asked[0] == 2:
            os.kill(self.pool.processes[1].pid, signal.SIGKILL)
        return ask(self, request)

    monkeypatch.setattr(WorkerProcesses, "ask", killing)
    run = tmp_path / "run"
    tiny_trainer(run, "rcdsac_pow", "collector.num_processes=2", "schedule.iterations=3").run()
    told = "iteration 2, training map 1: worker process 2 of 2 (split train, seed 0, agents 1) was killed by SIGKILL"
    assert told in (run / "train.log").read_text()
    assert training_rows(run)["iteration"].tolist() == [0, 0, 1, 1, 2, 2]
    progress = newest(run / CHECKPOINTS, replay=run / "replay")[0].progress
    assert (progress.iterations, progress.restarts, progress.skipped_maps) == (3, 1, 1)
    assert not multiprocessing.active_children()


@pytest.mark.parametrize(
    "collected",
    [
        ["collector.num_processes=0"],
        ["collector.num_processes=2"],
        ["collector=single"],
        ["collector=parallel_env", "world.num_workers=2"],
    ],
    ids=lambda collected: collected[0],
)
def test_wrong_input_that_shows_as_agents_drive_ends_a_run_in_one_sentence(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, collected: list[str]
) -> None:
    monkeypatch.setattr("rcdsac_trl.system.process_pool.START_METHOD", "fork")  # starts at once
    run = tmp_path / "run"
    trainer = tiny_trainer(run, "sac", *collected, "task.min_path_m=200")
    told = (
        "no goal lies 200 m of path away; lower min_path_m or choose a larger map: training stops in iteration 1; "
        f"0 iterations are saved, continue: {program()} train resume={run}"
    )
    with pytest.raises(UserInputError, match=f"^{re.escape(told)}$"):
        trainer.run()
    log = (run / "train.log").read_text()
    assert log.endswith(f"\n{told}\n")
    assert "restart" not in log
    assert not multiprocessing.active_children()


def test_a_validation_after_a_fault_is_what_it_would_have_been(
    tmp_path: Path, tiny_run: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("rcdsac_trl.system.process_pool.START_METHOD", "fork")  # starts at once
    step = AgentGroup.step
    left = iter(tmp_path / f"killed{number}" for number in range(2))
    main = os.getpid()

    def dying(self: AgentGroup, *arguments: Any) -> None:
        if os.getpid() != main and (at := next(left, None)) is not None and not at.exists():
            at.touch()
            os.kill(os.getpid(), signal.SIGKILL)
        step(self, *arguments)

    monkeypatch.setattr(AgentGroup, "step", dying)
    run = tmp_path / "run"
    tiny_trainer(run, "rcdsac_pow", "validation.processes=1").run()
    for table in ("training_episodes.csv", "validation_episodes.csv"):
        assert (run / table).read_bytes() == (tiny_run / table).read_bytes()
    told = (run / "train.log").read_text()
    for number in (1, 2):
        killed = "validation after 1 iterations: driving process 1 of 1 was killed by SIGKILL; restart"
        assert f"{killed} {number} of at most 5\n" in told
    assert "dropped" not in told
    assert newest(run / CHECKPOINTS)[0].progress.restarts == 2
    assert not multiprocessing.active_children()


@pytest.mark.slow
def test_a_worker_that_hangs_counts_as_dead_and_too_many_faults_end_the_run(
    tmp_path: Path, signalled: Callable[..., None]
) -> None:
    run = tmp_path / "run"
    signalled("train", [STEPS + 2, STEPS + 4], signal.SIGSTOP)
    # Making a map takes a moment too, and other work may take the core meanwhile.
    trainer = tiny_trainer(run, "rcdsac_pow", *WORKERS, "world.worker_timeout_s=6", "world.max_restarts=1")
    told = (
        "iteration 2, training map 2: one of 2 worker processes (split train, seed 0, agents 0; split train, seed 0, "
        "agents 1) gave no answer within 6 s; "
        f"world.max_restarts=1 allows no further restart: training stops; 1 iterations are saved, "
        f"continue: {program()} train resume={run}"
    )
    with pytest.raises(TrainingError, match=re.escape(told)):
        trainer.run()
    assert (run / "train.log").read_text().endswith(told + "\n")
    saved, damaged = newest(run / CHECKPOINTS, replay=run / "replay")
    assert (saved.progress.iterations, saved.progress.skipped_maps, damaged) == (1, 0, [])
    resumed = resume_training(run)
    assert resumed is not None
    resumed.run()
    assert training_rows(run)["iteration"].tolist() == [0, 0, 1, 1, 2, 2]


def test_a_worker_that_fails_by_itself_is_named_with_its_exit_code(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(
        CollectionPolicy, "forward", lambda self, td: td.set("action", torch.full((*td.batch_size, 2), 5.0))
    )
    trainer = tiny_trainer(tmp_path / "run", "rcdsac_pow", *WORKERS, "world.max_restarts=0")
    told = r"worker process [12] of 2 \(split train, seed 0, agents [01]\) ended with exit code 1"
    with pytest.raises(TrainingError, match=told):
        trainer.run()
    assert not multiprocessing.active_children()


# ------------------------------------------------------------------------------------------------ the disk
START = ["+algo=rcdsac_pow", *TINY, "schedule.iterations=4", "logger=none"]


@pytest.fixture
def command(monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]) -> Callable[..., tuple[int, str]]:
    """Call `train` as the command line does, in this process; return its exit code and what it said on stderr."""
    monkeypatch.setenv("MALLOC_MMAP_MAX_", "0")  # else the process would start again

    def call(*arguments: str) -> tuple[int, str]:
        monkeypatch.setattr(sys, "argv", ["prog", *arguments])
        capfd.readouterr()
        with pytest.raises(SystemExit) as left:
            train.main()
        return int(str(left.value.code)), capfd.readouterr().err

    return call


@pytest.mark.parametrize(
    "code", [errno.ENOSPC, *(pytest.param(n, marks=pytest.mark.slow) for n in (errno.EROFS, errno.EDQUOT, errno.EIO))]
)
def test_a_disk_that_fails_ends_a_run_in_one_sentence_with_its_checkpoint_whole(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, code: int
) -> None:
    run = tmp_path / "run"
    trainer = tiny_trainer(run, "rcdsac_pow", "schedule.iterations=3")
    save = trainer.checkpoints.save

    def failing(progress: Progress, logs: Any) -> Path:
        if progress.iterations == 2:
            fsync = os.fsync
            left = iter(range(3))  # some of it is written, then nothing more

            def full(descriptor: int) -> None:
                if next(left, None) is None:
                    raise OSError(code, os.strerror(code))
                fsync(descriptor)

            monkeypatch.setattr(os, "fsync", full)
        return save(progress, logs)

    monkeypatch.setattr(trainer.checkpoints, "save", failing)
    with pytest.raises(TrainingError, match=rf"\({os.strerror(code)}\): training stops in iteration 2; 1 iterations"):
        trainer.run()
    monkeypatch.undo()
    saved, damaged = newest(run / CHECKPOINTS, replay=run / "replay")
    assert (saved.progress.iterations, damaged) == (1, [])
    resumed = resume_training(run)
    assert resumed is not None
    resumed.run()
    assert training_rows(run)["iteration"].tolist() == [0, 0, 1, 1, 2, 2]


def test_no_checkpoint_is_begun_that_the_disk_cannot_hold(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """TorchRL writes through memory, where a full disk would kill the process."""
    asked: list[int] = []

    def full(descriptor: int, offset: int, length: int) -> None:
        asked.append(length)
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    trainer = tiny_trainer(tmp_path / "run")
    tensors = trainer.learner.loss.state_dict().values()
    monkeypatch.setattr(os, "posix_fallocate", full)
    with pytest.raises(TrainingError, match="the disk is full") as caught:
        trainer.run()
    assert "0 iterations are saved" in str(caught.value)
    assert asked[0] > sum(tensor.nbytes for tensor in tensors)
    assert list((tmp_path / "run" / "checkpoints").iterdir()) == []


@pytest.mark.parametrize(("backends", "limit_bytes"), [("", 3000), ("tensorboard", 1000)])
def test_a_real_limit_on_files_ends_a_run_in_one_sentence(tmp_path: Path, backends: str, limit_bytes: int) -> None:
    """In a process of its own: the limit on a file's size is less than what the replay, or TensorBoard's thread, needs.

    TensorBoard's thread cannot end the run itself.
    """
    run = tmp_path / "run"

    def training() -> None:
        warnings.simplefilter("ignore")
        trainer = tiny_trainer(run, "rcdsac_pow", "checkpoint.every_iterations=1", f"logger.backends=[{backends}]")
        save = trainer.checkpoints.save

        def limited(progress: Progress, logs: Any) -> Path:
            path = save(progress, logs)
            resource.setrlimit(resource.RLIMIT_FSIZE, (limit_bytes,) * 2)
            return path

        trainer.checkpoints.save = limited  # type: ignore[method-assign]
        try:
            trainer.run()
        except TrainingError as error:
            fail(error)

    ended = Forked(training, tmp_path / "said")
    assert ended.code() == 1, ended.said
    told = (
        r"rcdsac_trl: a file became larger than this system or its limits allow \(.*File too large\): training stops "
        rf"in iteration 1; 0 iterations are saved, continue: {re.escape(program())} train resume={run}\n"
    )
    assert re.fullmatch(told, ended.said), ended.said
    saved, damaged = newest(run / CHECKPOINTS, replay=run / "replay")
    assert (saved.progress.iterations, damaged) == (0, [])


def test_a_folder_that_takes_nothing_is_refused_before_anything_is_written(
    tmp_path: Path, command: Callable[..., tuple[int, str]], monkeypatch: pytest.MonkeyPatch
) -> None:
    file = tmp_path / "file"
    file.write_text("")
    code, err = command(*START, f"hydra.run.dir={file}/run")
    assert (code, err) == (
        2,
        f"rcdsac_trl: {file}/run cannot be a folder: {file} is a file, choose another\n",
    )

    def read_only(**_: object) -> None:
        raise OSError(errno.EROFS, os.strerror(errno.EROFS))

    monkeypatch.setattr("rcdsac_trl.system.resources.tempfile.TemporaryFile", read_only)
    code, err = command(*START, f"hydra.run.dir={tmp_path}/a/run")
    assert (code, err) == (
        2,
        f"rcdsac_trl: nothing can be written into {tmp_path} (Read-only file system): choose a folder elsewhere than "
        f"{tmp_path}/a/run\n",
    )
    assert list(tmp_path.iterdir()) == [file]


def test_too_small_a_disk_is_told_at_the_start(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    usage = shutil.disk_usage(tmp_path)
    monkeypatch.setattr(shutil, "disk_usage", lambda _: usage._replace(free=1_000_000))
    tiny_trainer(tmp_path / "run").run()
    log = (tmp_path / "run" / "train.log").read_text()
    assert re.match(r"WARNING: the run needs up to [\d.]+ MB in .*/run, whose disk has 1\.0 MB free: make room", log)


# ------------------------------------------------------------------------------------------------ memory
def test_a_replay_larger_than_the_memory_is_refused_before_anything_is_written(
    tmp_path: Path, command: Callable[..., tuple[int, str]], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("rcdsac_trl.system.resources.available_memory_bytes", lambda: 500_000_000)
    given = ["+algo=rcdsac_pow", "preset=paper", "sensor=narrow", f"hydra.run.dir={tmp_path}/run"]
    code, err = command(*given)
    # 5,000 episodes of 1,001 slots, each of 43 bins of 2 bytes and 6 + 4 + 2 + 1 + 1 + 1 numbers of 4: 0.73 GB
    assert (code, err) == (
        2,
        "rcdsac_trl: the replay: 0.7 GB of memory needed, 0.5 GB available: lower replay.capacity_steps, or end "
        "other programs\n",
    )
    assert list(tmp_path.iterdir()) == []


def test_a_mini_batch_larger_than_any_memory_is_refused(
    tmp_path: Path, command: Callable[..., tuple[int, str]]
) -> None:
    code, err = command("+algo=sac", "preset=smoke", "learner.batch_size=1000000000", f"hydra.run.dir={tmp_path}/run")
    assert code == 2
    assert err.startswith("rcdsac_trl: a mini-batch: 6480.0 GB of memory needed, ")  # (8 + 1) * 180 * 4 bytes each
    assert err.endswith(" GB available: lower learner.batch_size, or end other programs\n")
    assert list(tmp_path.iterdir()) == []


def test_more_simulations_than_the_memory_holds_are_refused(
    tmp_path: Path, command: Callable[..., tuple[int, str]], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("rcdsac_trl.system.resources.available_memory_bytes", lambda: 4_000_000_000)
    code, err = command("+algo=sac", "preset=smoke", "world.num_agents=100", f"hydra.run.dir={tmp_path}/run")
    assert code == 2  # 100 that train and 100 that validate, 28 MB each
    assert err == (
        "rcdsac_trl: 200 simulations: 5.6 GB of memory needed, 4.0 GB available: lower world.num_agents, or end other "
        "programs\n"
    )
    with pytest.raises(UserInputError, match=r"^3000 simulations: 84\.0 GB of memory needed, 4\.0 GB available: lower"):
        make_evaluation(compose("evaluate", ["baseline=pursuit", "num_episodes=1000", "num_workers=3"]))
    assert list(tmp_path.iterdir()) == []


def test_networks_that_do_not_fit_leave_nothing_behind(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def too_large(*_: object) -> None:
        raise RuntimeError("DefaultCPUAllocator: can't allocate memory: you tried to allocate 51200000000 bytes.")

    monkeypatch.setattr("rcdsac_trl.training.make_learner.make_loss", too_large)
    with pytest.raises(RuntimeError, match="can't allocate"):
        tiny_trainer(tmp_path / "run")
    assert list(tmp_path.iterdir()) == []


def test_available_memory_is_the_least_of_what_the_machine_and_the_container_leave(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    proc, group = tmp_path / "proc", tmp_path / "sys" / "fs" / "cgroup"
    proc.mkdir()
    group.mkdir(parents=True)
    assert resources.available_memory_bytes(tmp_path) is None
    (proc / "meminfo").write_text("MemTotal: 9000 kB\nMemAvailable:    5000 kB\nSwapFree: 1000 kB\n")
    assert resources.available_memory_bytes(tmp_path) == 6000 * 1024
    (group / "memory.current").write_text("3000000\n")
    (group / "memory.stat").write_text("anon 5\ninactive_file 500000\n")
    (group / "memory.max").write_text("max\n")
    assert resources.available_memory_bytes(tmp_path) == 6000 * 1024
    (group / "memory.max").write_text("4000000\n")
    assert resources.available_memory_bytes(tmp_path) == 1_500_000
    for known, refused in ((None, 10**18), (10**6, 999_999)):
        monkeypatch.setattr(resources, "available_memory_bytes", lambda known=known: known)
        resources.check_memory("it", refused, "give up")  # it fits, or nothing is known
    with pytest.raises(UserInputError, match=r"^it: 1.0 MB of memory needed, 1.0 MB available: give up$"):
        resources.check_memory("it", 10**6 + 1, "give up")


@pytest.mark.parametrize(
    ("error", "sentence"),
    [
        (
            FileNotFoundError(errno.ENOENT, "No usable temporary directory found in ['/tmp', '/var/tmp']"),
            "there is no folder for temporary files: set TMPDIR to one that can be written",
        ),
        (
            OSError("AF_UNIX path too long"),
            "the folder for temporary files has too long a path (/a/long/one): set TMPDIR to another",
        ),
        (FileNotFoundError(errno.ENOENT, "No such file or directory", "runs/a"), None),
    ],
)
def test_folders_for_temporary_files_that_do_not_serve_are_named(
    monkeypatch: pytest.MonkeyPatch, error: OSError, sentence: str | None
) -> None:
    monkeypatch.setattr(tempfile, "tempdir", "/a/long/one")
    assert resources.fault_sentence(error) == sentence


def torch_allocates_too_much() -> None:
    torch.empty(1 << 60, dtype=torch.uint8)


def python_allocates_too_much() -> None:
    bytearray(1 << 60)


@pytest.mark.parametrize("allocate", [torch_allocates_too_much, python_allocates_too_much])
def test_memory_that_ends_stops_a_run_in_one_sentence(tmp_path: Path, allocate: Callable[[], None]) -> None:
    run = tmp_path / "run"
    trainer = tiny_trainer(run)
    trainer.learner.replay.add_episodes = lambda _: allocate()  # type: ignore[method-assign]
    with pytest.raises(
        TrainingError, match=r"^there is not enough memory.*training stops in iteration 1; 0 iterations"
    ):
        trainer.run()
    assert newest(run / CHECKPOINTS)[0].progress.iterations == 0


def test_what_is_neither_disk_nor_memory_keeps_its_traceback(tmp_path: Path) -> None:
    trainer = tiny_trainer(tmp_path / "run")

    def mistaken(_: object) -> None:
        raise FileNotFoundError(errno.ENOENT, "No such file", "x")

    trainer.learner.replay.add_episodes = mistaken  # type: ignore[method-assign]
    with pytest.raises(FileNotFoundError):
        trainer.run()
