"""A run that dies at any moment and is continued ends as if nothing had happened, bit for bit."""

import json
import os
import shutil
import signal
import sys
from collections.abc import Callable, Iterator
from itertools import count
from pathlib import Path
from pkgutil import resolve_name
from types import SimpleNamespace
from typing import Any

import numpy as np
import pandas as pd
import pytest
import torch
from omegaconf import OmegaConf
from tensorboard.backend.event_processing.event_accumulator import EventAccumulator
from test_checkpoint import DAMAGE
from torchrl.checkpoint import Checkpoint

import killable
from forked import Forked
from rcdsac_trl import train
from rcdsac_trl.errors import UserInputError
from rcdsac_trl.storage.atomic import FolderLock
from rcdsac_trl.storage.checkpoint_record import Progress, folders, newest
from rcdsac_trl.system.invocation import program
from rcdsac_trl.training.resume import run_to_continue
from rcdsac_trl.training.run_folder import cut, lengths
from rcdsac_trl.training.setup import resume_training
from tiny import TINY, tiny_trainer

# Ten episodes pass through a replay of seven: it wraps in the middle of an iteration.
RUN = [
    "schedule.iterations=5",
    "network={conv: 4, range: 8, vector: 4, memory: 8, head: 8, cosines: 4}",
    "schedule.ramp_iterations=2",
    "schedule.decay_iterations=3",
    "schedule.pursuit_iterations=2",
    "replay.capacity_steps=140",
    "validation.every_iterations=2",
    "validation.processes=1",
    "learner.actor_average_decay=0.9",
    "learner.resample_per=transition",
    "algo.distortion.evaluation_betas=[-1]",
    "logger=default",
]
Counted = dict[str, int]


class Server:
    """Trainings in processes of their own, see killable.py."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self.numbers = count()
        (jobs, self.jobs), (self.answers, answers) = (map(os.fdopen, os.pipe(), "rw") for _ in range(2))

        def program() -> None:
            self.jobs.close()  # else its jobs would never end
            killable.serve(jobs, answers, RUN)

        self.process = Forked(program, folder / "said")
        jobs.close()
        answers.close()

    def call(self, do: str, run: Path, *, kill_at: tuple[str, int] | None = None, **changes: Any) -> Counted | None:
        """Train or resume; return how many events of each kind happened, or None if it was killed."""
        job = {"row": "rcdsac_pow", "overrides": RUN, "evaluate": [], "told": ["beta=[-1]"]} | changes
        out = self.folder / f"job{next(self.numbers)}"
        job |= {"do": do, "folder": str(run), "kill_at": kill_at, "out": str(out)}
        print(json.dumps(job), file=self.jobs, flush=True)
        answer = self.answers.readline()
        assert answer, self.process.said
        status = int(answer)
        if kill_at is not None and status == -signal.SIGKILL:
            return None
        assert status == 0, out.with_suffix(".log").read_text()
        return json.loads(out.read_text())  # type: ignore[no-any-return]

    def close(self) -> None:
        self.jobs.close()
        assert self.process.code() == 0, self.process.said
        self.answers.close()


@pytest.fixture(scope="module")
def server(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Server]:
    server = Server(tmp_path_factory.mktemp("jobs"))
    yield server
    server.close()


@pytest.fixture(scope="module")
def whole(server: Server, tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Counted]:
    """A run that nobody disturbed, and how many events of each kind happened in it."""
    run = tmp_path_factory.mktemp("whole") / "run"
    events = server.call("train", run, evaluate=["best", "last"])
    assert events is not None
    return run, events


def contents(run: Path) -> dict[str, bytes]:
    """Everything a run leaves that does not depend on the clock."""
    patterns = ("*_episodes.csv", "config.yaml", "csv/scalars/**/*.csv", "replay/*", "evaluation/**/*")
    files = {path for pattern in patterns for path in run.glob(pattern) if path.is_file()}
    names = {path.relative_to(run).as_posix(): path for path in files}
    return {name: path.read_bytes() for name, path in sorted(names.items()) if "scalars/time/" not in name}


class Loaded:
    """Takes whatever state a checkpoint holds."""

    def state_dict(self) -> dict[str, Any]:
        return {}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        self.state = state


def states(checkpoint: Path) -> dict[str, torch.Tensor]:
    """Every tensor and number of a checkpoint."""
    components = {name: Loaded() for name in ("loss", "average", "optimizer", "generators")}
    Checkpoint(**components).load(checkpoint)
    found: dict[str, torch.Tensor] = {}

    def walk(value: Any, name: str) -> None:
        if isinstance(value, dict):
            for key, below in value.items():
                walk(below, f"{name}/{key}")
        elif isinstance(value, list | tuple):
            walk(dict(enumerate(value)), name)
        elif value is not None and not isinstance(value, str):
            found[name] = torch.as_tensor(value)

    for name, component in components.items():
        walk(component.state, name)
    return found


def scalars_shown(run: Path) -> dict[str, list[tuple[int, float]]]:
    """What TensorBoard shows, without what depends on the clock, and each point once.

    A validation's points are as old as its agent: a run that is killed after they were written, but before that was
    saved, writes them again.
    """
    shown = EventAccumulator(str(run / "tensorboard"), size_guidance={"scalars": 0})
    shown.Reload()
    tags = [tag for tag in shown.Tags()["scalars"] if not tag.startswith("time/")]
    return {tag: sorted({(event.step, event.value) for event in shown.Scalars(tag)}) for tag in tags}


def assert_equal_runs(run: Path, whole: Path) -> None:
    assert [path.name for path in folders(run / "checkpoints")] == [
        path.name for path in folders(whole / "checkpoints")
    ]
    for mine, other in zip(folders(run / "checkpoints"), folders(whole / "checkpoints"), strict=True):
        a, b = states(mine), states(other)
        assert a.keys() == b.keys()
        assert [name for name in a if not torch.equal(a[name], b[name])] == []
    a, b = contents(run), contents(whole)
    assert a.keys() == b.keys()
    assert [name for name in a if a[name] != b[name]] == []
    assert not list(run.rglob(".unfinished*"))
    assert not list(run.rglob(".removed*"))


def kill_and_resume(server: Server, run: Path, kills: list[tuple[str, int]]) -> None:
    """Start a run, kill it again and again wherever it is, and let it come to its end."""
    for kill_at in kills:
        server.call("resume" if (run / "config.yaml").exists() else "train", run, kill_at=kill_at)
    server.call("resume" if (run / "config.yaml").exists() else "train", run, evaluate=["best", "last"])


def kill_points(counted: Counted, number: int, share: float, seed: int) -> list[tuple[str, int]]:
    """Draw moments within a share of a run's events, every other one while something is saved."""
    rng = np.random.default_rng(seed)
    kinds = ["saving", "training"] * number
    return [(kind, int(rng.integers(share * counted[kind]))) for kind in kinds[:number]]


@pytest.mark.parametrize("seed", range(3))
def test_a_run_killed_again_and_again_ends_as_if_nothing_had_happened(
    server: Server, whole: tuple[Path, Counted], tmp_path: Path, seed: int
) -> None:
    kill_and_resume(server, tmp_path / "run", kill_points(whole[1], 4, 0.5, seed))
    assert_equal_runs(tmp_path / "run", whole[0])
    assert scalars_shown(tmp_path / "run") == scalars_shown(whole[0])


def test_a_run_that_validates_in_place_is_the_same(server: Server, whole: tuple[Path, Counted], tmp_path: Path) -> None:
    run = tmp_path / "run"
    server.call("train", run, overrides=[*RUN, "validation.processes=0"], evaluate=["best", "last"])
    config = run / "config.yaml"
    config.write_text(config.read_text().replace("  processes: 0", "  processes: 1"))
    assert_equal_runs(run, whole[0])
    assert scalars_shown(run) == scalars_shown(whole[0])


@pytest.fixture(scope="module")
def under_way(server: Server, whole: tuple[Path, Counted], tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A run that was killed when it had saved three iterations; the agent after two was being validated."""
    run = tmp_path_factory.mktemp("under way") / "run"
    events, step = whole[1]["training"], 13  # in the fourth of five iterations
    while not (run / "checkpoints" / "iteration-000003").exists():
        shutil.rmtree(run, ignore_errors=True)
        assert server.call("train", run, kill_at=("training", events * step // 20)) is None
        step += 1
    return run


def test_the_agent_under_validation_stays_until_its_result_is_in(
    server: Server, whole: tuple[Path, Counted], under_way: Path, tmp_path: Path
) -> None:
    run = Path(shutil.copytree(under_way, tmp_path / "run"))
    assert [path.name[-1] for path in folders(run / "checkpoints")] == ["2", "3"]
    assert newest(run / "checkpoints")[0].progress.validating_iterations == 2
    assert not (run / "validation_episodes.csv").exists()
    server.call("resume", run, evaluate=["best", "last"])
    assert_equal_runs(run, whole[0])


def test_a_validation_whose_agent_is_damaged_is_left_out(server: Server, under_way: Path, tmp_path: Path) -> None:
    run = Path(shutil.copytree(under_way, tmp_path / "run"))
    damaged = run / "checkpoints" / "iteration-000002"
    (damaged / "manifest.json").unlink()
    server.call("resume", run)
    told = f"checkpoint {damaged} is damaged: manifest.json is missing; its validation was under way and is left out\n"
    assert told in (run / "train.log").read_text()
    assert pd.read_csv(run / "validation_episodes.csv")["iteration"].unique().tolist() == [3, 4]


@pytest.mark.slow
@pytest.mark.parametrize("row", ["sac", "rcwr", "rcdsac_cvar_stored", "dsac_pow"])
def test_every_kind_of_row_goes_on(server: Server, tmp_path: Path, row: str) -> None:
    changes: dict[str, Any] = {"row": row, "overrides": [key for key in RUN if "evaluation_betas" not in key]}
    counted = server.call("train", tmp_path / "whole", **changes)
    assert counted is not None
    run = tmp_path / "run"
    server.call("train", run, kill_at=("training", counted["training"] * 2 // 3), **changes)
    server.call("resume", run)
    assert_equal_runs(run, tmp_path / "whole")


@pytest.mark.slow
@pytest.mark.parametrize("number", range(60))
def test_a_run_killed_once_ends_as_if_nothing_had_happened(
    server: Server, whole: tuple[Path, Counted], tmp_path: Path, number: int
) -> None:
    kill_and_resume(server, tmp_path / "run", kill_points(whole[1], 60, 1.0, 99)[number : number + 1])
    assert_equal_runs(tmp_path / "run", whole[0])
    assert scalars_shown(tmp_path / "run") == scalars_shown(whole[0])


# ------------------------------------------------------------------------------------------------ damage, in a real run
QUICK = [
    *RUN,
    "schedule.iterations=3",
    "validation.every_iterations=1",
    "validation.processes=0",
    "logger.backends=[csv]",
]


@pytest.fixture(scope="module")
def short(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A finished run of three iterations; tests copy it."""
    run = tmp_path_factory.mktemp("short") / "run"
    tiny_trainer(run, "rcdsac_pow", *QUICK).run()
    return run


@pytest.fixture
def copied(short: Path, tmp_path: Path) -> Path:
    return Path(shutil.copytree(short, tmp_path / "copied"))


def files_of(run: Path) -> dict[str, bytes]:
    return {path.relative_to(run).as_posix(): path.read_bytes() for path in run.rglob("*") if path.is_file()}


@pytest.mark.parametrize("kind", ["flipped byte", "record truncated", "empty folder", "segment missing"])
def test_a_run_goes_on_from_the_last_good_checkpoint_and_ends_the_same(short: Path, copied: Path, kind: str) -> None:
    where, damage, reason = DAMAGE[kind]
    where = where.replace("0000-number", "0002-loss").replace("00000002", "00000004")
    damage(copied / "checkpoints" / where)
    trainer = resume_training(copied)
    assert trainer is not None
    assert trainer.progress.iterations == 2
    trainer.run()
    assert_equal_runs(copied, short)
    log = (copied / "train.log").read_text()
    assert log.count("is damaged") == 1
    assert reason.replace("0000-number", "0002-loss") in log
    assert f"continue after 2 of 3 iterations, from {copied / 'checkpoints' / 'iteration-000002'}" in log


def test_a_run_without_a_good_checkpoint_is_not_begun_anew(refusal: Any, copied: Path) -> None:
    for checkpoint in folders(copied / "checkpoints"):
        (checkpoint / "manifest.json").unlink()
    before = files_of(copied)
    told = refusal([f"resume={copied}"])
    assert told.startswith(f"no checkpoint in {copied / 'checkpoints'} is whole: ")
    shutil.rmtree(copied / "checkpoints")
    told = refusal([f"resume={copied}"])
    assert told == f"there is no checkpoint in {copied / 'checkpoints'}: has this run saved one yet?"
    assert files_of(copied).items() <= before.items()


def test_a_damaged_best_checkpoint_is_said_and_found_anew(copied: Path) -> None:
    last = folders(copied / "checkpoints")[-1]
    (last / "checkpoint.json").unlink()
    saved, _ = newest(copied / "checkpoints")
    best = copied / "checkpoints" / f"iteration-{saved.progress.best_iterations:06d}"
    if best == saved.path:
        pytest.skip("the best one is the last good one, so its damage makes it no good")
    (best / "manifest.json").unlink()
    trainer = resume_training(copied)
    assert trainer is not None
    trainer.run()
    assert "the next validation finds a new best one" in (copied / "train.log").read_text()
    assert newest(copied / "checkpoints")[0].progress.best_iterations == 3


def test_a_run_that_died_before_it_removed_what_is_too_old_does_so_when_continued(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Its last checkpoint is there, so it is finished: it died before, or in the middle of, removing the oldest."""
    run, died = tmp_path / "run", {name: tmp_path / name for name in ("rotate", "durable.shutil.rmtree")}
    trainer = tiny_trainer(run, "rcdsac_pow", *QUICK, "checkpoint.keep=1")
    save = trainer.checkpoints.save

    def as_a_kill_leaves_it(do: Callable[..., None], copy: Path) -> Callable[..., None]:
        def call(*args: Any, **kwargs: Any) -> None:
            shutil.copytree(run, copy)
            do(*args, **kwargs)

        return call

    def last_save(progress: Progress, logs: Any) -> Path:
        if progress.iterations == 3:
            for name, copy in died.items():
                name = f"rcdsac_trl.storage.checkpoint.{name}"
                monkeypatch.setattr(name, as_a_kill_leaves_it(resolve_name(name), copy))
        return save(progress, logs)

    monkeypatch.setattr(trainer.checkpoints, "save", last_save)
    trainer.run()
    monkeypatch.undo()
    left = {path.name for path in (run / "checkpoints").iterdir()}
    for copy in died.values():
        assert {path.name for path in (copy / "checkpoints").iterdir()} > left
        assert resume_training(copy) is None
        assert_equal_runs(copy, run)
        FolderLock(copy).close()


# ------------------------------------------------------------------------------------------------ logs
def test_logs_are_cut_to_what_they_were(tmp_path: Path) -> None:
    scalars = tmp_path / "csv" / "scalars" / "train"
    scalars.mkdir(parents=True)
    table, scalar, note = tmp_path / "training_episodes.csv", scalars / "reward.csv", tmp_path / "notes.csv"
    for path in (table, scalar, note):
        path.write_text("a\nb\n")
    recorded = lengths(tmp_path)
    assert recorded == {"training_episodes.csv": 4, "csv/scalars/train/reward.csv": 4}
    table.write_text("a\nb\nc\nd")
    (tmp_path / "validation_episodes.csv").write_text("later\n")
    scalar.write_text("a\n")
    assert cut(tmp_path, recorded) == [f"{scalar} has lost rows: it holds 2 bytes of 4"]
    assert table.read_text() == "a\nb\n"
    assert not (tmp_path / "validation_episodes.csv").exists()
    assert note.read_text() == "a\nb\n", "what a user put there stays"


# ------------------------------------------------------------------------------------------------ the command line
@pytest.fixture
def command(monkeypatch: pytest.MonkeyPatch) -> Any:
    """Call `train` as the command line does, in this process."""
    monkeypatch.setenv("MALLOC_MMAP_MAX_", "0")  # else the process would start again

    def call(arguments: list[str]) -> None:
        monkeypatch.setattr(sys, "argv", ["prog", *arguments])
        train.main()

    return call


@pytest.fixture
def refusal(command: Any, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]) -> Any:
    """Call `train`, which must refuse and write nothing; return the sentence."""
    monkeypatch.setattr("rcdsac_trl.training.setup.make_trainer", lambda *_: pytest.fail("it was not refused"))

    def call(arguments: list[str]) -> str:
        before = files_of(tmp_path)
        capfd.readouterr()
        with pytest.raises(SystemExit) as left:
            command(arguments)
        assert left.value.code == 2
        assert {name for name in files_of(tmp_path) if not name.endswith("lock")} == {
            name for name in before if not name.endswith("lock")
        }
        err = capfd.readouterr().err
        assert err.count("\n") == 1
        return err.removeprefix("rcdsac_trl: ").strip()

    return call


START = ["+algo=rcdsac_pow", *TINY, *QUICK]


def unfinished(run: Path) -> Path:
    """Take a finished run back by an iteration."""
    shutil.rmtree(folders(run / "checkpoints")[-1])
    return run


def test_a_finished_run_says_so_and_changes_nothing(command: Any, short: Path, capsys: Any) -> None:
    before = files_of(short)
    command([f"resume={short}"])
    told, evaluating, plotting = capsys.readouterr().out.splitlines()
    assert told == f"{short} is finished: nothing is left to do"
    assert evaluating == f"next: {program()} evaluate run={short}"
    assert plotting.strip() == f"{program()} plot_training run={short}"
    assert files_of(short) == before


def test_a_run_goes_on_only_where_its_logger_is_installed(
    command: Any, refusal: Any, copied: Path, monkeypatch: pytest.MonkeyPatch, capfd: Any
) -> None:
    config = OmegaConf.load(copied / "config.yaml")
    config.logger.backends = ["wandb"]
    OmegaConf.save(config, copied / "config.yaml")
    monkeypatch.setitem(sys.modules, "wandb", None)  # as where it is missing
    command([f"resume={copied}"])
    assert capfd.readouterr().out.startswith(f"{copied} is finished: nothing is left to do\n")
    told = "logger wandb is not installed: pip install 'rcdsac-trl[wandb]', or use logger=default"
    assert refusal([f"resume={unfinished(copied)}"]) == told
    FolderLock(copied).close()


def noted_overrides(run: Path, overrides: list[str]) -> None:
    """Write down that a run was started with these, as the command line does."""
    manifest = run / "manifest.json"
    manifest.write_text(json.dumps(json.loads(manifest.read_text()) | {"overrides": overrides}))


def test_a_folder_is_continued_as_it_was_started(command: Any, copied: Path, short: Path, tmp_path: Path) -> None:
    noted_overrides(copied, START)
    before = set(tmp_path.iterdir())
    # What the run was started with, and what changes nothing, may be repeated.
    command([*START, "seed=0", f"resume={unfinished(copied)}", f"hydra.run.dir={copied}"])
    assert_equal_runs(copied, short)
    assert set(tmp_path.iterdir()) == before
    assert len(pd.read_csv(copied / "training_episodes.csv")) == 6


def test_a_run_of_a_robot_in_a_folder_of_ones_own_goes_on(
    command: Any, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "mine" / "robot").mkdir(parents=True)
    (tmp_path / "mine" / "robot" / "cart.yaml").write_text("defaults: [paper, _self_]\nname: cart\nradius_m: 0.3\n")
    own = [f"hydra.searchpath=[{tmp_path / 'mine'}]", "+algo=sac", "robot=cart"]
    begun = []
    monkeypatch.setattr("rcdsac_trl.training.setup.make_trainer", lambda *given: begun.append(given) or sys.exit(7))
    with pytest.raises(SystemExit, match="7"):
        command([*own, f"hydra.run.dir={tmp_path / 'run'}"])
    ((cfg, _, noted),) = begun
    assert noted == own
    run = tmp_path / "run"
    run.mkdir(exist_ok=True)
    OmegaConf.save(cfg, run / "config.yaml")
    (run / "manifest.json").write_text(json.dumps({"overrides": noted}))
    for more in ([], own, own[:1], ["robot=cart"], ["seed=0"]):
        assert run_to_continue([f"resume={run}", *more]) == run
    with pytest.raises(UserInputError, match=r"^robot\.max_turn_deg_per_s=60 is not what .* was started with"):
        run_to_continue([f"resume={run}", "robot.max_turn_deg_per_s=60"])


@pytest.mark.parametrize(
    "override", ["learner.gamma=0.5", "schedule.iterations=9", "sensor=sparse", "+algo=sac", "hydra.run.dir=other"]
)
def test_what_contradicts_a_run_is_refused_by_name(refusal: Any, copied: Path, override: str) -> None:
    noted_overrides(copied, START)
    told = refusal([f"resume={unfinished(copied)}", override])
    new = "start a new run without resume"
    if override.startswith("schedule.iterations"):
        again = f"{program()} train init={copied} schedule.iterations=<how many more>"
        new = f"for more iterations begin a new run with its agent: {again}"
    assert told == (
        f"{override} is not what {copied} was started with, and resume continues a run as it was: leave it out, or "
        f"{new}"
    )


def test_wrong_folders_and_several_runs_are_refused(refusal: Any, tmp_path: Path) -> None:
    told = refusal(["resume=nowhere"])
    assert told == "resume=nowhere holds no config.yaml: name a folder that training wrote"
    assert refusal(["-m", "resume=auto", "+algo=sac,rcwr"]) == (
        "resume=auto continues one run: leave -m out; a sweep goes on when its call is repeated with its "
        "hydra.sweep.dir"
    )
    assert refusal(["resume=auto"]).startswith("no algorithm chosen")
    assert refusal(["resume=auto", "+algo=sac", "seed=-1"]) == "seed=-1 must be at least 0"


def test_two_processes_never_train_in_one_folder(refusal: Any, copied: Path) -> None:
    lock = FolderLock(unfinished(copied))
    told = f"{copied} is being trained in by another process: wait for it, or stop it"
    assert refusal([f"resume={copied}"]) == told
    lock.close()
    trainer = resume_training(copied)
    assert trainer is not None
    assert refusal([f"resume={copied}"]) == told
    trainer.run()
    FolderLock(copied).close()


def test_auto_finds_the_newest_unfinished_run_of_this_config_else_begins_one(
    command: Any, short: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: Any
) -> None:
    monkeypatch.chdir(tmp_path)
    runs = tmp_path / "runs"
    for age, name in enumerate(("finished", "older", "newer", "other")):
        run = Path(shutil.copytree(short, runs / name))
        if name != "finished":
            unfinished(run)
        os.utime(run / "config.yaml", (1000 + age, 1000 + age))
    config = runs / "other" / "config.yaml"
    config.write_text(config.read_text().replace("seed: 0", "seed: 7"))
    os.utime(config, (2000, 2000))
    (runs / "no run").mkdir()
    there = len(list(runs.iterdir()))
    for name in ("newer", "older"):
        command([*START, "resume=auto"])
        assert f"resume=auto: continue runs/{name}\n" in capsys.readouterr().out
        assert_equal_runs(runs / name, short)
    assert len(list(runs.iterdir())) == there

    begun: list[Path] = []
    monkeypatch.setattr(
        "rcdsac_trl.training.setup.make_trainer",
        lambda cfg, folder, overrides: SimpleNamespace(
            run=lambda: begun.append(Path(folder).relative_to(tmp_path)), is_finished=False
        ),
    )
    command([*START, "resume=auto", "hydra.run.dir=runs/new"])
    assert "resume=auto: no unfinished run of this config in runs, so a new one\n" in capsys.readouterr().out
    assert begun == [Path("runs/new")]


def test_auto_with_a_named_folder_means_that_one(
    command: Any, refusal: Any, short: Path, copied: Path, capfd: Any
) -> None:
    command([*START, "resume=auto", f"hydra.run.dir={unfinished(copied)}"])
    assert_equal_runs(copied, short)
    command([*START, "resume=auto", f"hydra.run.dir={copied}"])
    assert f"{copied} is finished: nothing is left to do\n" in capfd.readouterr().out
    told = refusal([*START, "seed=7", "resume=auto", f"hydra.run.dir={copied}"])
    assert told == f"{copied} holds a run of another config: choose another hydra.run.dir"
