"""Shared by all tests."""

import gc
import os
import sys
import traceback
from contextlib import redirect_stderr, redirect_stdout
from importlib import import_module
from pathlib import Path

# Small tensors: a second thread costs more than it brings, and far more while tests run side by side. What tests start
# inherits it, NumPy reads it as it is imported.
os.environ["OMP_NUM_THREADS"] = "1"
# What is imported is compiled once, whatever the environment asks for: torch and what comes with it takes a process
# 20 s where it compiles all of that for itself, else 5 s, and tests start dozens of processes.
if sys.dont_write_bytecode:
    os.environ.pop("PYTHONDONTWRITEBYTECODE", None)
    sys.dont_write_bytecode = False

import pytest
import torch

from composed_once import remember_compositions
from rcdsac_trl.system.cores import usable_cores

torch.set_num_threads(1)
remember_compositions()

# Side by side, whole files are given out in this order: those that take longest first, so that no worker is left with
# one of them when there is nothing else to do. But in a fresh checkout the first has numba compile most of what there
# is, and another worker that needs it meanwhile would compile it, too: the next files only compose configs.
LONGEST = (
    "test_trainer",
    "test_command_line",
    "test_verbs",
    "test_config",
    "test_play_browser",
    "test_cli",
    "test_sweep",
    "test_docs",
    "test_resume",
    "test_evaluation",
    "test_notebooks",
    "test_faults",
    "test_bad_input",
    "test_env",
    "test_wheel",
    "test_worker",
    "test_publish",
    "test_optuna_search",
    "test_benchmarks",
    "test_dead_keys",
    "test_play_server",
    "test_evaluation_pool",
    "test_nav2_stack",
)


@pytest.hookimpl(optionalhook=True)  # where tests run side by side, pytest-xdist counts by it
def pytest_xdist_auto_num_workers() -> int:
    return usable_cores()


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    places = {name: place for place, name in enumerate(LONGEST)}
    items.sort(key=lambda item: places.get(item.path.stem, len(LONGEST)))


def pytest_collection_finish() -> None:
    """Leave what was imported out of every later collection of garbage: going through it takes half a second."""
    gc.collect()
    gc.freeze()


@pytest.fixture(scope="session")
def tiny_run(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The folder of one finished tiny training of rcdsac_pow; tests only read it, but for its evaluations."""
    from tiny import tiny_trainer  # the other tests need not wait for the whole pipeline

    folder = tmp_path_factory.mktemp("tiny") / "run"
    tiny_trainer(folder, "rcdsac_pow", "logger=default").run()
    return folder


@pytest.fixture
def calls(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> list[tuple[str, str]]:
    """Run the jobs of sweeps and searches in this process, as the programs they are, and list them."""
    from rcdsac_trl.experiments import sweep

    made: list[tuple[str, str]] = []
    monkeypatch.setenv("MALLOC_MMAP_MAX_", "0")  # else they start this process again
    monkeypatch.chdir(tmp_path)

    def call(command: list[str], output: Path, variables: dict[str, str], should_stop: object) -> int:
        assert command[:2] == [sys.executable, "-m"]
        made.append((command[2].removeprefix("rcdsac_trl."), output.parent.name))
        monkeypatch.setattr(sys, "argv", command[2:])
        with output.open("a") as file, redirect_stdout(file), redirect_stderr(file):
            try:
                import_module(command[2]).main()
            except SystemExit as left:
                return int(left.code or 0)
            except Exception:
                traceback.print_exc()
                return 1
        return 0

    monkeypatch.setattr(sweep, "call", call)
    return made
