"""Sweeps: which runs a call makes, and that killed, failing and repeated ones end as they should."""

import json
import os
import shutil
import signal
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from forked import Forked
from rcdsac_trl import train
from rcdsac_trl.config.compose import choices
from rcdsac_trl.errors import FaultError, UserInputError
from rcdsac_trl.experiments import sweep
from rcdsac_trl.experiments.sweep import Job, State, runs_of
from rcdsac_trl.experiments.sweep_jobs import check_single, make_sweep
from rcdsac_trl.storage.atomic import FolderLock
from rcdsac_trl.system import subprocess_job
from tiny import SMALL, Calls, first_combinations_only, load_progress, yaml_of


# ------------------------------------------------------------------------------------------------ which runs
def jobs(*overrides: str) -> dict[str, Job]:
    return {job.name: job for job in make_sweep(list(overrides)).jobs}


def test_a_grid_is_every_combination_named_by_what_tells_it_apart(tmp_path: Path) -> None:
    made = jobs("+algo=rcdsac_pow,sac", "seed=0,1", "learner.gamma=0.9,0.99", f"hydra.sweep.dir={tmp_path}/all")
    assert list(made)[:3] == [
        "rcdsac_pow-narrow-gamma_0.9-s0",
        "rcdsac_pow-narrow-gamma_0.99-s0",
        "sac-narrow-gamma_0.9-s0",
    ]
    assert len(made) == 8
    job = made["sac-narrow-gamma_0.9-s1"]
    assert (job.algo, job.sensor, job.seed, job.run, job.evaluate) == ("sac", "narrow", 1, None, None)
    assert job.overrides == ("+algo=sac", "seed=1", "learner.gamma=0.9")
    assert job.folder == tmp_path / "all" / job.name
    assert list(tmp_path.iterdir()) == []


def test_without_a_name_a_sweep_is_named_by_the_time(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.chdir(tmp_path)
    made = make_sweep(["+algo=sac"])
    assert made.folder == tmp_path / "multirun" / made.experiment
    assert made.experiment[:2] == "20"
    assert {job.folder.parent for job in made.jobs} == {made.folder}


def test_the_table_is_the_papers_twenty_runs(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.chdir(tmp_path)
    made = jobs("+experiment=table")
    assert len(made) == 20
    assert {job.folder.parent for job in made.values()} == {tmp_path / "multirun" / "table"}
    assert {job.sensor for job in made.values()} == {"narrow", "sparse"}
    assert all("preset=paper" in job.overrides for job in made.values())
    narrow = [(job.algo, *(o for o in job.overrides if "beta" in o)) for job in made.values() if "narrow" in job.name]
    assert sorted(narrow) == [
        ("dsac_cvar", "algo.beta=0.25"),
        ("dsac_cvar", "algo.beta=0.75"),
        ("dsac_pow", "algo.beta=-1"),
        ("dsac_pow", "algo.beta=-2"),
        ("rcdsac_cvar",),
        ("rcdsac_cvar_stored",),
        ("rcdsac_pow",),
        ("rcdsac_pow_stored",),
        ("rcwr",),
        ("sac",),
    ]
    asked = ("checkpoint=last", "half_precision=true", "split=evaluation", "num_maps=50", "num_episodes=10")
    assert made["rcdsac_cvar-narrow-s0"].evaluate == ("beta=[0.25,0.5,0.75,1]", *asked)
    assert made["dsac_pow_-2-sparse-s0"].evaluate == asked


def test_the_command_line_wins_over_the_table_which_begins_with_one_seed_of_everything() -> None:
    made = jobs("+experiment=table", "preset=laptop", "seed=0,1,2", "experiment.only=[sac,dsac_pow_-2]")
    kinds = ["dsac_pow_-2-narrow", "dsac_pow_-2-sparse", "sac-narrow", "sac-sparse"]
    assert list(made) == [f"{kind}-s{seed}" for seed in (0, 1, 2) for kind in kinds]
    for job in made.values():
        assert [override for override in job.overrides if "preset" in override] == ["preset=laptop"]
        assert [override for override in job.overrides if "seed" in override] == [f"seed={job.seed}"]


@pytest.mark.parametrize("experiment", sorted(set(choices("experiment")) - {"grid", "table"}))
def test_every_run_of_every_experiment_is_accepted(experiment: str, monkeypatch: pytest.MonkeyPatch) -> None:
    # make_sweep checks as `train` would; of each named run its first combination stands for all.
    first_combinations_only(monkeypatch)
    assert len(jobs(f"+experiment={experiment}")) == max(
        1, len(yaml_of(f"experiment/{experiment}.yaml").get("runs", ()))
    )


def test_the_command_line_narrows_an_experiment() -> None:
    made = jobs("experiment=study", "experiment.only=[baseline,batch-64]", "+algo=sac", "seed=3", "map=easy")
    assert list(made) == ["baseline-sac-narrow-s3", "batch-64-sac-narrow-s3"]
    assert made["batch-64-sac-narrow-s3"].run == "batch-64"
    assert made["batch-64-sac-narrow-s3"].overrides == (
        "preset=laptop",
        "+algo=sac",
        "seed=3",
        "learner.batch_size=64",
        "map=easy",
    )


@pytest.mark.parametrize(
    ("overrides", "sentence"),
    [
        (["+experiment=tabel"], "experiment=tabel does not exist: choose one of grid, study, table"),
        (["+algo=sac", "launcher=cloud"], "launcher=cloud does not exist: choose one of "),
        (["+experiment=table", "experiment.only=[ppo]"], "experiment.only=ppo is no run of the experiment: choose am"),
        (["+algo=sac", "experiment.only=[ppo]"], "experiment.only=ppo is no run of the experiment: choose among none"),
        (["+experiment=table", "+algo=sac"], "+algo=sac contradicts +algo=rcdsac_cvar, which makes the run rcdsac_cv"),
        (["+algo=sac", "seed=0,0"], "two runs would share the folder sac-narrow-s0 (+algo=sac seed=0 and +algo=sac "),
        (["+algo=sac", "hydra.run.dir=x"], "hydra.run.dir=x has no effect on a sweep: leave it out, and choose launc"),
        (["+algo=sac", "hydra/launcher=joblib"], "hydra/launcher=joblib has no effect on a sweep"),
        (["+algo=sac", "experiment.evaluate=3"], "experiment.evaluate=3 must be a list of words in brackets or null"),
        (["+algo=sac", "+experiment.runs.a=3"], "experiment.runs.a=3 must be a list of words in brackets"),
        (["+experiment=study", "seed=0,x"], "seed=x must be a whole number"),
        (["resume=auto", "+algo=sac"], "resume=auto continues one run: leave -m out; a sweep goes on when its call i"),
        (["seed=0,1"], "no algorithm chosen"),
    ],
)
def test_what_no_sweep_can_be_is_refused(overrides: list[str], sentence: str) -> None:
    with pytest.raises(UserInputError) as caught:
        make_sweep(overrides)
    assert str(caught.value).startswith(sentence)


def test_a_single_run_refuses_what_only_a_sweep_understands() -> None:
    check_single(["+algo=sac", "seed=0"])
    for override in ("+experiment=table", "launcher=local", "hydra.sweep.dir=x"):
        with pytest.raises(UserInputError, match=f"{override.lstrip('+')} is about several runs: add -m"):
            check_single(["+algo=sac", override])


# ------------------------------------------------------------------------------------------------ running them
def tables(folder: Path) -> dict[str, bytes]:
    return {path.relative_to(folder).as_posix(): path.read_bytes() for path in folder.rglob("*_episodes.csv")}


def states(folder: Path) -> dict[str, str]:
    return {job.name: state.name for job, state in runs_of(folder)}


def test_two_rows_and_two_seeds_and_the_same_call_again(calls: Calls, tmp_path: Path, capsys: Callable) -> None:
    asked = ["+algo=rcdsac_pow,sac", "seed=0,1", *SMALL, "hydra.sweep.dir=all"]
    make_sweep(asked).run()
    names = ["rcdsac_pow-narrow-s0", "sac-narrow-s0", "rcdsac_pow-narrow-s1", "sac-narrow-s1"]
    assert calls == [("train", name) for name in names]
    all_runs = tmp_path / "all"
    assert states(all_runs) == dict.fromkeys(names, "finished")
    for name in names:
        assert load_progress(all_runs / name / "checkpoints", "last").iterations == 1
    out = capsys.readouterr().out.splitlines()  # type: ignore[attr-defined]
    assert out == [f"4 runs in {all_runs}, 0 of them finished before"] + [
        f"{n}/4 finished {name}" for n, name in enumerate(names, 1)
    ]

    calls.clear()
    make_sweep(asked).run()
    assert calls == []

    # The folder may be moved, and a wider call adds to it.
    all_runs.rename(tmp_path / "moved")
    make_sweep(["+algo=sac", "seed=1,2", *SMALL, "hydra.sweep.dir=moved"]).run()
    assert calls == [("train", "sac-narrow-s2")]
    assert list(states(tmp_path / "moved")) == [*names, "sac-narrow-s2"]
    assert {job.folder.parent for job, _ in runs_of(tmp_path / "moved")} == {tmp_path / "moved"}

    with pytest.raises(UserInputError, match=r"sac-narrow-s1 holds a run of another config \(learner.gamma\): choose"):
        make_sweep(["+algo=sac", "seed=1", *SMALL, "learner.gamma=0.5", "hydra.sweep.dir=moved"])


def test_runs_that_come_from_another_machine_are_taken_up(calls: Calls, tmp_path: Path) -> None:
    asked = ["+experiment=table", "experiment.only=[sac]", *SMALL, "schedule.iterations=2", "experiment.evaluate=null"]
    elsewhere, table = tmp_path / "elsewhere", tmp_path / "multirun" / "table"
    make_sweep([*asked, "sensor=narrow", f"hydra.sweep.dir={elsewhere}"]).run()
    whole = tables(elsewhere)
    # One that is half done, as a machine that went down leaves it, and of which no sweep knows here.
    shutil.copytree(elsewhere / "sac-narrow-s0", table / "sac-narrow-s0")
    shutil.rmtree(table / "sac-narrow-s0" / "checkpoints" / "iteration-000002")
    (table / "sac-narrow-s0" / "state.json").unlink()
    calls.clear()
    make_sweep(asked).run()
    assert calls == [("train", "sac-narrow-s0"), ("train", "sac-sparse-s0")]
    assert states(table) == dict.fromkeys(("sac-narrow-s0", "sac-sparse-s0"), "finished")
    assert load_progress(table / "sac-narrow-s0" / "checkpoints", "last").iterations == 2
    assert tables(table).items() >= whole.items()
    # One that has finished, too, and nothing is trained again.
    shutil.rmtree(table / "sac-narrow-s0")
    shutil.copytree(elsewhere / "sac-narrow-s0", table / "sac-narrow-s0")
    calls.clear()
    make_sweep(asked).run()
    assert calls == []


def test_a_failing_run_sinks_no_other_and_is_named_at_the_end(calls: Calls, tmp_path: Path) -> None:
    asked = ["+algo=sac", "learner.actor_lr=1e30,1e-3", *SMALL, "hydra.sweep.dir=all"]
    asked += ["schedule.iterations=2", "schedule.pursuit_iterations=0"]
    with pytest.raises(FaultError) as caught:
        make_sweep(asked).run()
    bad, good = "sac-narrow-actor_lr_1e+30-s0", "sac-narrow-actor_lr_0.001-s0"
    told = str(caught.value)
    assert told.startswith(f"1 of 2 runs failed, the same call continues them: {bad}: exit code 1: ")
    assert told.endswith(f", see {tmp_path / 'all' / bad / 'console.log'}")
    assert "loss_actor = nan" in told
    assert states(tmp_path / "all") == {bad: "failed", good: "finished"}
    calls.clear()
    with pytest.raises(FaultError):
        make_sweep(asked).run()
    assert calls == [("train", bad)]


def test_a_failed_evaluation_is_done_again_without_training(
    calls: Calls, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    asked = ["+algo=sac", *SMALL, "hydra.sweep.dir=all"]
    make_sweep(asked).run()
    before = tables(tmp_path / "all")
    with pytest.raises(FaultError, match="exit code 2: there is no key num_mpas: did you mean num_maps"):
        make_sweep([*asked, "experiment.evaluate=['num_mpas=1']"]).run()
    make_sweep([*asked, "experiment.evaluate=['num_maps=1','num_episodes=1','num_workers=0']"]).run()
    assert len(list(tmp_path.glob("all/sac-narrow-s0/evaluation/best-evaluation-seed0-1x1-all/summary.csv"))) == 1
    assert tables(tmp_path / "all").items() >= before.items()
    assert [state.evaluated for _, state in runs_of(tmp_path / "all")] == [
        ("num_maps=1", "num_episodes=1", "num_workers=0")
    ]


def test_a_run_that_someone_else_trains_is_left_alone(calls: Calls, tmp_path: Path) -> None:
    made = make_sweep(["+algo=sac", *SMALL, "hydra.sweep.dir=all"])
    folder = made.jobs[0].folder
    made.jobs[0].note(State("started"))
    lock = FolderLock(folder)
    with pytest.raises(FaultError, match="is being trained in by another process"):
        made.run()
    assert calls == []
    assert states(tmp_path / "all") == {"sac-narrow-s0": "started"}
    lock.close()
    lock = FolderLock(tmp_path / "all")
    with pytest.raises(UserInputError, match="all is being trained in by another process"):
        made.run()
    lock.close()


def test_who_comes_second_where_two_found_a_folder_free_says_nothing_of_the_run(
    calls: Calls, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    made = make_sweep(["+algo=sac", *SMALL, "hydra.sweep.dir=all"])
    call_here = sweep.call
    locks: list[FolderLock] = []

    def late(command: list[str], output: Path, *rest: Any) -> int:
        """Begin to train when another launcher's training has just locked the folder."""
        made.jobs[0].note(State("started"))
        locks.append(FolderLock(output.parent))
        return call_here(command, output, *rest)

    monkeypatch.setattr(sweep, "call", late)
    with pytest.raises(FaultError, match="is being trained in by another process"):
        made.run()
    for lock in locks:
        lock.close()
    assert calls == [("train", "sac-narrow-s0")]
    assert "is being trained in by another process" in (made.jobs[0].folder / "console.log").read_text()
    assert states(tmp_path / "all") == {"sac-narrow-s0": "started"}


def test_a_folder_without_an_index_is_no_sweep(tmp_path: Path) -> None:
    with pytest.raises(UserInputError, match=r"holds no sweep.json: name a folder that a sweep wrote"):
        runs_of(tmp_path)
    (tmp_path / "sweep.json").write_text("[]")
    with pytest.raises(UserInputError, match=r"sweep.json cannot be read"):
        runs_of(tmp_path)


# ------------------------------------------------------------------------------------------------ killed
def ended(pid: int) -> bool:
    try:
        os.kill(pid, 0)
    except ProcessLookupError:
        return True
    return Path(f"/proc/{pid}/stat").read_text().rsplit(")", 1)[1].split()[0] == "Z"


def test_a_killed_sweep_goes_on_with_what_is_not_finished(calls: Calls, tmp_path: Path) -> None:
    asked = ["+algo=sac", *SMALL, "schedule.iterations=1,4", "checkpoint.keep=9", "hydra.sweep.dir=all"]
    first, second = (tmp_path / "all" / f"sac-narrow-iterations_{n}-s0" for n in (1, 4))
    call_here = sweep.call

    def call(command: list[str], output: Path, *rest: Any) -> int:
        """Train what is killed in a process, as sweeps do."""
        return (subprocess_job.call if output.parent == second else call_here)(command, output, *rest)

    def program() -> None:
        sweep.call = call  # type: ignore[assignment]
        sys.argv = ["train", "-m", *asked]
        train.main()

    process = Forked(program, tmp_path / "said")
    deadline = time.monotonic() + 600
    while not (second / "checkpoints" / "iteration-000001").exists():
        assert process.code(wait=False) is None, process.said
        assert time.monotonic() < deadline
        time.sleep(0.02)
    training = [
        int(path.parent.name)
        for path in Path("/proc").glob("[0-9]*/stat")
        if path.read_text().rsplit(")", 1)[1].split()[1] == str(process.pid)
    ]
    os.kill(process.pid, signal.SIGKILL)
    assert process.code() == -signal.SIGKILL
    assert len(training) == 1
    deadline = time.monotonic() + 60
    while not ended(training[0]) and time.monotonic() < deadline:
        time.sleep(0.05)
    assert ended(training[0])  # it does not outlive the sweep, which would find its folder taken

    assert states(tmp_path / "all") == {first.name: "finished", second.name: "started"}
    before = {path: path.stat().st_mtime_ns for path in first.rglob("*")}
    saved = load_progress(second / "checkpoints", "last").iterations
    assert 1 <= saved < 4
    make_sweep(asked).run()
    assert calls == [("train", second.name)]
    assert {path: path.stat().st_mtime_ns for path in first.rglob("*")} == before
    assert f"continue after {saved} of 4 iterations" in (second / "console.log").read_text()
    assert states(tmp_path / "all") == {first.name: "finished", second.name: "finished"}
    assert json.loads((tmp_path / "all" / "sweep.json").read_text())["runs"][1]["folder"] == second.name
