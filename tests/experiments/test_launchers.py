"""Launchers: jobs end up where they should run, with their share of the cores; what fails there is told."""

import importlib.util
import os
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
from omegaconf import OmegaConf

from rcdsac_trl.config.compose import choices, compose
from rcdsac_trl.errors import FaultError, UserInputError
from rcdsac_trl.experiments.launchers import LAUNCHERS, read_launcher
from rcdsac_trl.experiments.sweep import Job, Launcher, Sweep
from rcdsac_trl.experiments.sweep_jobs import make_sweep
from rcdsac_trl.system import cgroups
from rcdsac_trl.system.cores import SHARE, usable_cores
from rcdsac_trl.system.processes import resolve_num_workers

# A job whose console says how many cores it was given, and one that fails at once; neither imports torch.
TELLS = ("--cfg", "job", "--resolve", f"+share=${{oc.env:{SHARE},all}}")
FAILS = ("--ppo",)  # no option


def launcher(name: str, *overrides: str) -> Launcher:
    cfg = compose("sweep", [f"launcher={name}", *overrides])
    return read_launcher(OmegaConf.to_container(cfg.launcher))  # type: ignore[arg-type]


def job(folder: Path, name: str, overrides: tuple[str, ...]) -> Job:
    return Job(name, None, "sac", "narrow", 0, overrides, evaluate=None, folder=folder / name)


def share_told(folder: Path) -> str:
    (line,) = [line for line in (folder / "console.log").read_text().splitlines() if line.startswith("share: ")]
    return line.removeprefix("share: ").strip("'")


def check_two_jobs(folder: Path, launcher: Launcher, share: str) -> None:
    jobs = [job(folder, "fails", FAILS), job(folder, "tells", TELLS)]
    with pytest.raises(FaultError) as caught:
        Sweep(folder, "two", jobs, launcher).run()
    told = str(caught.value)
    assert told.startswith("1 of 2 runs failed, the same call continues them: fails: exit code 2: there is no option ")
    assert [job.state.name for job in jobs] == ["failed", "finished"]
    assert share_told(jobs[1].folder) == share


@pytest.fixture
def importable(monkeypatch: pytest.MonkeyPatch) -> None:
    """Let processes that an engine starts find the package where this one does."""
    source = Path(__file__).parents[2] / "src"
    monkeypatch.setenv("PYTHONPATH", os.pathsep.join([str(source), os.environ.get("PYTHONPATH", "")]))


def test_local(tmp_path: Path, importable: None) -> None:
    check_two_jobs(tmp_path, launcher("local"), "all")


def test_joblib(tmp_path: Path, importable: None) -> None:
    pytest.importorskip("joblib")
    check_two_jobs(tmp_path, launcher("joblib", "launcher.cores_per_run=3", "launcher.runs_at_once=2"), "3")


@pytest.mark.slow
def test_slurm_by_submitits_local_executor(tmp_path: Path, importable: None) -> None:
    pytest.importorskip("submitit")
    check_two_jobs(tmp_path, launcher("slurm", "launcher.cluster=local", "launcher.cores_per_run=2"), "2")


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore::FutureWarning", "ignore::ResourceWarning")
def test_ray_on_a_cluster_of_this_machine(tmp_path: Path, importable: None) -> None:
    pytest.importorskip("ray")
    check_two_jobs(tmp_path, launcher("ray"), "1")


def program(folder: Path, name: str, text: str) -> None:
    path = folder / name
    path.write_text(f"#!/bin/sh\n{text}\n")
    path.chmod(0o755)


def test_slurm_is_asked_for_what_was_chosen_and_its_refusal_is_told(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    pytest.importorskip("submitit")
    programs = tmp_path / "bin"
    programs.mkdir()
    program(programs, "srun", "")
    program(programs, "sbatch", f'cp "$1" {tmp_path}/asked.sh; echo "invalid partition" >&2; exit 1')
    monkeypatch.setenv("PATH", f"{programs}{os.pathsep}{os.environ['PATH']}")
    chosen = ["partition=long", "cores_per_run=3", "gpus_per_run=1", "timeout_min=90", "runs_at_once=1"]
    extra = ["slurm_setup=['module load python']", "slurm_additional_parameters={constraint: a100}"]
    extra += ["slurm_account=lab", "mem_gb=5"]
    jobs = [job(tmp_path / "all", name, FAILS) for name in ("a", "b")]
    slurm = launcher("slurm", *(f"launcher.{each}" for each in chosen), *(f"++launcher.extra.{each}" for each in extra))
    with pytest.raises(FaultError, match=r"^launcher=slurm: .*"):
        Sweep(tmp_path / "all", "two", jobs, slurm).run()
    asked = (tmp_path / "asked.sh").read_text().splitlines()
    for line in (
        "#SBATCH --partition=long",
        "#SBATCH --account=lab",
        "#SBATCH --cpus-per-task=3",
        "#SBATCH --gpus-per-node=1",
        "#SBATCH --mem=5GB",
        "#SBATCH --time=90",
        "#SBATCH --array=0-1%1",
        "#SBATCH --constraint=a100",
        "module load python",
    ):
        assert line in asked, line


@pytest.mark.parametrize(
    ("name", "overrides", "sentence"),
    [
        ("joblib", ["cores_per_run=0"], "launcher.cores_per_run=0 must be at least 1"),
        ("joblib", ["runs_at_once=0"], "launcher.runs_at_once=0 must be at least 1"),
        ("joblib", ["runs_at_once=all"], "launcher.runs_at_once=all must be a whole number or auto"),
        ("slurm", ["runs_at_once=0"], "launcher.runs_at_once=0 must be at least 1"),
        ("slurm", ["cluster=pbs"], "launcher.cluster=pbs must be one of slurm, local"),
        ("slurm", ["extra.mem_gb=much"], 'launcher.extra is not what submitit takes: Parameter "mem_gb" expected type'),
        (
            "slurm",
            ["extra.queue=lab"],
            "launcher.extra is not what submitit takes: Parameter 'queue' need to be pr",
        ),
        ("ray", ["gpus_per_run=-1"], "launcher.gpus_per_run=-1 must be at least 0"),
        ("local", ["name=cloud"], "launcher.name=cloud is unknown: choose one of local, joblib, slurm, ray"),
        ("local", ["cores=1"], "there is no key launcher.cores"),
    ],
)
def test_what_no_launcher_can_do_is_refused(name: str, overrides: list[str], sentence: str) -> None:
    given = [f"++launcher.{each}" for each in overrides]
    with pytest.raises(UserInputError) as caught:
        launcher(name, *given)
    assert str(caught.value).startswith(sentence)


@pytest.mark.parametrize(("name", "package"), [("joblib", "joblib"), ("slurm", "submitit"), ("ray", "ray")])
def test_a_missing_engine_is_named_with_what_installs_it(
    monkeypatch: pytest.MonkeyPatch, name: str, package: str
) -> None:
    found: Callable[..., Any] = importlib.util.find_spec
    monkeypatch.setattr("importlib.util.find_spec", lambda asked: None if asked == package else found(asked))
    with pytest.raises(UserInputError) as caught:
        make_sweep(["+algo=sac", f"launcher={name}"])
    assert str(caught.value) == (
        f"launcher={name} needs {package}, which is not installed: pip install 'rcdsac-trl[{name}]', or "
        "use launcher=local"
    )


def test_every_launcher_has_its_file() -> None:
    assert set(choices("launcher")) == set(LAUNCHERS)


def test_a_share_of_the_cores_is_what_every_auto_finds(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(os, "sched_getaffinity", lambda _: set(range(8)), raising=False)
    monkeypatch.setattr(cgroups, "processor_quota", lambda: None)
    monkeypatch.delenv(SHARE, raising=False)
    assert usable_cores() == 8
    monkeypatch.setenv(SHARE, "5")
    assert usable_cores() == 5
    assert resolve_num_workers("auto", 10) == 5
    monkeypatch.setenv(SHARE, "99")
    assert usable_cores() == 8
    for wrong in ("0", "two", "-1"):
        monkeypatch.setenv(SHARE, wrong)
        with pytest.raises(UserInputError, match=f"RCDSAC_TRL_CORES={wrong} is not a whole number of at least 1"):
            usable_cores()
