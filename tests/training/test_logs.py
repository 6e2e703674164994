"""The run folder: what a run was made of, and all that it says while it trains."""

import importlib.util
import json
import os
import subprocess
import sys
from importlib.machinery import ModuleSpec
from importlib.metadata import version
from pathlib import Path
from types import ModuleType, SimpleNamespace
from typing import Any

import pandas as pd
import pytest
import yaml
from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

from rcdsac_trl.config.training_settings import LoggerSettings
from rcdsac_trl.errors import UserInputError
from rcdsac_trl.rollout.metrics import METRICS
from rcdsac_trl.system import provenance
from rcdsac_trl.training.run_folder import start_run_folder
from rcdsac_trl.training.run_log import RunLog
from tiny import AGENTS, ITERATIONS, STEPS, UPDATES, tiny_cfg


def manifest(run: Path) -> dict:
    values: dict = json.loads((run / "manifest.json").read_text())
    return values


def test_the_manifest_says_what_the_run_is_made_of(tiny_run: Path) -> None:
    made_of = manifest(tiny_run)
    assert made_of["seed"] == 0
    assert made_of["command"] == [Path(sys.argv[0]).stem, *sys.argv[1:]]
    assert made_of["commit"] == provenance.commit()
    assert made_of["python"] == ".".join(map(str, sys.version_info[:3]))
    assert (made_of["device"], made_of["threads"]) == ("cpu", 1)
    assert made_of["allocator"]
    for package in ("torch", "torchrl", "tensordict", "pybullet", "numpy", "numba", "hydra-core", "rcdsac-trl"):
        assert made_of["packages"][package] == version(package)


def test_the_resolved_config_is_kept(tiny_run: Path) -> None:
    config = yaml.safe_load((tiny_run / "config.yaml").read_text())
    assert config["algo"]["distortion"]["name"] == "pow"
    assert config["task"]["episode_steps"] == STEPS
    assert "${" not in (tiny_run / "config.yaml").read_text()
    assert "hydra" not in config


def test_commit_is_that_of_the_checkout_or_none(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def git(*arguments: str) -> str:
        identity = ["-c", "user.name=t", "-c", "user.email=t@t", "-c", "commit.gpgsign=false"]
        done = subprocess.run(["git", *identity, *arguments], cwd=tmp_path, capture_output=True, text=True, check=True)
        return done.stdout.strip()

    module = tmp_path / "provenance.py"
    module.write_text("first")
    monkeypatch.setattr(provenance, "__file__", str(module))
    assert provenance.commit() == "none", "no checkout at all"
    git("init", "-q")
    assert provenance.commit() == "none", "no commit yet"
    (tmp_path / "other").write_text("")
    git("add", "other")
    git("commit", "-qm", "without the module")
    assert provenance.commit() == "none", "installed into somebody else's checkout"
    git("add", "provenance.py")
    git("commit", "-qm", "with it")
    head = git("rev-parse", "HEAD")
    assert provenance.commit() == head
    module.write_text("changed")
    assert provenance.commit() == head + "+"


def test_a_folder_holds_one_run(tmp_path: Path) -> None:
    folder = tmp_path / "deep" / "run"
    start_run_folder(folder, tiny_cfg(), {"device": "cpu"})
    assert manifest(folder)["device"] == "cpu"
    written = (folder / "config.yaml").read_bytes()
    with pytest.raises(UserInputError, match=r"already holds a run: choose another hydra\.run\.dir"):
        start_run_folder(folder, tiny_cfg("sac"), {})
    assert (folder / "config.yaml").read_bytes() == written


def test_unknown_backends_are_refused() -> None:
    LoggerSettings(()).check_backends()
    LoggerSettings(("csv", "tensorboard")).check_backends()
    with pytest.raises(UserInputError, match=r"logger\.backends holds 'excel': choose among csv, tensorboard, wandb"):
        LoggerSettings(("csv", "excel")).check_backends()


def test_wandb_without_a_login_is_refused_before_the_run_begins(monkeypatch: pytest.MonkeyPatch) -> None:
    class Error(Exception):
        pass

    def login() -> None:
        raise Error("No API key configured.")

    wandb = ModuleType("wandb")
    wandb.__spec__ = ModuleSpec("wandb", None)
    wandb.login, wandb.errors = login, SimpleNamespace(Error=Error)  # type: ignore[attr-defined]
    monkeypatch.setitem(sys.modules, "wandb", wandb)
    with pytest.raises(UserInputError, match=r"cannot log in \(No API key .*set WANDB_MODE=offline"):
        LoggerSettings(("csv", "wandb")).check_backends()


EXPECTED_SCALARS = {
    *(f"train/{metric}{half}" for metric in METRICS for half in ("", "/low_beta", "/high_beta")),
    *(f"validation/{metric}/{beta}" for metric in METRICS for beta in ("-2", "-1.5", "-1", "-0.5")),
    "validation/score",
    *(f"learn/loss_{name}" for name in ("qvalue", "actor", "alpha")),
    *(f"learn/{name}" for name in ("alpha", "entropy", "td_error", "q_value", "quantile_spread")),
    "learn/distortion_strength",
    "learn/learning_rate_share",
    "learn/updates",
    "time/elapsed_s",
    "time/steps_per_s",
    "time/updates_per_s",
}


def test_csv_and_tensorboard_take_every_scalar_of_every_iteration(tiny_run: Path) -> None:
    steps = [(iteration + 1) * AGENTS * STEPS for iteration in range(ITERATIONS)]

    scalars = tiny_run / "csv" / "scalars"
    assert {path.relative_to(scalars).with_suffix("").as_posix() for path in scalars.rglob("*.csv")} == EXPECTED_SCALARS
    for name in EXPECTED_SCALARS:
        rows = (scalars / f"{name}.csv").read_text().split()
        assert [int(row.split(",")[0]) for row in rows] == steps, name

    events = EventAccumulator(str(tiny_run / "tensorboard"))
    events.Reload()
    assert set(events.Tags()["scalars"]) == EXPECTED_SCALARS
    for name in EXPECTED_SCALARS:
        assert [event.step for event in events.Scalars(name)] == steps, name
    updates = [event.value for event in events.Scalars("learn/updates")]
    assert updates == [UPDATES * (i + 1) for i in range(ITERATIONS)]


def test_the_log_agrees_with_the_tables(tiny_run: Path) -> None:
    events = EventAccumulator(str(tiny_run / "tensorboard"))
    events.Reload()
    training = pd.read_csv(tiny_run / "training_episodes.csv")
    validation = pd.read_csv(tiny_run / "validation_episodes.csv")
    for metric in METRICS:
        expected = training.groupby("iteration")[metric].mean()
        assert [e.value for e in events.Scalars(f"train/{metric}")] == pytest.approx(expected.tolist(), abs=1e-4)
        of_beta = validation[validation["beta"] == -1.5].groupby("iteration")[metric].mean()
        logged = [e.value for e in events.Scalars(f"validation/{metric}/-1.5")]
        assert logged == pytest.approx(of_beta.tolist(), abs=1e-4)
    means = validation.groupby("iteration")[["reward", "collisions", "contact_fraction"]].mean()
    score = means["reward"] - 10.0 * means["collisions"] - STEPS * means["contact_fraction"]
    assert [e.value for e in events.Scalars("validation/score")] == pytest.approx(score.tolist(), abs=1e-4)


def test_the_console_log_shows_rates_and_every_condition(tiny_run: Path) -> None:
    text = (tiny_run / "train.log").read_text()
    for beta in ("-2", "-1.5", "-1", "-0.5"):
        assert text.count(f" beta={beta} ") == ITERATIONS
    iterations = [line for line in text.splitlines() if line.lstrip().startswith(tuple("12")) and "reward" in line]
    assert len(iterations) == ITERATIONS
    for line in iterations:
        for word in ("updates", "collisions", "goals", "speed", "contact", "steps/s", "updates/s"):
            assert word in line


def test_tables_grow_under_one_header(tmp_path: Path) -> None:
    log = RunLog(tmp_path, [])
    rows = pd.DataFrame({"iteration": [0, 0], "reward": [1 / 3, 2.0]})
    (tmp_path / "training_episodes.csv").touch()  # all that a full disk left of a table
    log.episodes("training", rows)
    log.episodes("training", rows.assign(iteration=1))
    log.message("hello")
    log.close()
    assert (tmp_path / "training_episodes.csv").read_text() == ("iteration,reward\n0,0.333333\n0,2\n1,0.333333\n1,2\n")
    assert (tmp_path / "train.log").read_text() == "hello\n"


# ------------------------------------------------------------------------------------------------ other records
def test_mlflow_writes_into_the_run_folder_or_to_the_users_server(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """On a stand-in: MLflow is large. It refuses folders of files, so it is given a database."""
    called: list[tuple[str, Any]] = []
    stand_in = ModuleType("mlflow")
    stand_in.__dict__.update(
        set_tracking_uri=lambda uri: called.append(("uri", uri)),
        get_experiment_by_name=lambda name: None,
        create_experiment=lambda **given: called.append(("experiment", given)) or "7",
        start_run=lambda **given: called.append(("run", given)),
        set_experiment=lambda experiment_id: None,
        log_metric=lambda **given: called.append(("metric", given)),
    )
    monkeypatch.setitem(sys.modules, "mlflow", stand_in)
    monkeypatch.setattr("torchrl.record.loggers.mlflow._has_mlflow", True)
    monkeypatch.delenv("MLFLOW_TRACKING_URI", raising=False)
    folder = tmp_path / "my-run"
    folder.mkdir()
    log = RunLog(folder, ["mlflow"])
    log.scalars({"train/reward": 1.5}, 40)
    log.close()
    told = dict(called)
    assert told["uri"] == f"sqlite:///{folder}/mlflow.db"
    assert told["experiment"]["name"] == "my-run"
    assert told["experiment"]["artifact_location"] == (folder / "mlartifacts").as_uri()
    assert told["run"] == {"experiment_id": "7"}
    assert told["metric"] == {"key": "train/reward", "value": 1.5, "step": 40}

    monkeypatch.setenv("MLFLOW_TRACKING_URI", "http://server:5000")
    RunLog(folder, ["mlflow"]).close()
    assert dict(called)["uri"] == "http://server:5000"
    assert dict(called)["experiment"]["artifact_location"] is None  # the server's own


def test_wandb_writes_into_the_run_folder_under_its_name(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """On a stand-in; without a network, the user's WANDB_MODE=offline is left to decide."""
    called: dict[str, Any] = {}
    experiment = SimpleNamespace(
        config=SimpleNamespace(update=lambda *_, **__: None),
        log=lambda values, **_: called.update(values),
        define_metric=lambda *_, **__: None,
    )
    stand_in = ModuleType("wandb")
    stand_in.__dict__["init"] = lambda **given: called.update(given) or experiment
    monkeypatch.setitem(sys.modules, "wandb", stand_in)
    monkeypatch.setattr("torchrl.record.loggers.wandb._has_wandb", True)
    monkeypatch.setenv("WANDB_MODE", "offline")
    folder = tmp_path / "my-run"
    folder.mkdir()
    log = RunLog(folder, ["wandb"])
    log.scalars({"train/reward": 1.5}, 40)
    log.close()
    assert (called["name"], called["dir"]) == ("my-run", str(folder))
    assert called["train/reward"] == 1.5
    assert os.environ["WANDB_MODE"] == "offline"


@pytest.mark.slow
@pytest.mark.skipif(importlib.util.find_spec("wandb") is None, reason="wandb is not installed")
def test_wandb_offline_leaves_a_record(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("WANDB_MODE", "offline")
    folder = tmp_path / "my-run"
    folder.mkdir()
    log = RunLog(folder, ["wandb"])
    log.scalars({"train/reward": 1.5}, 40)
    log.close()
    importlib.import_module("wandb").finish()
    (record,) = folder.glob("wandb/offline-run-*/*.wandb")
    assert record.stat().st_size > 0
