"""Every program of benchmarks/ still runs: its smallest form, in this process."""

import importlib
import json
import os
import shutil
import subprocess
import sys
from pathlib import Path
from types import ModuleType
from typing import Any

import pytest

from tiny import TINY

BENCHMARKS = Path(__file__).parents[1] / "benchmarks"
NAMES = {path.stem for path in BENCHMARKS.glob("*.py")}
CHROMIUM = shutil.which("chromium") or shutil.which("chromium-browser") or shutil.which("google-chrome")
SMALL = [*TINY, "world.num_agents=2"]


@pytest.fixture
def load(monkeypatch: pytest.MonkeyPatch) -> Any:
    """Import a program by its plain name, as they import each other; forget all of them afterwards."""
    monkeypatch.setenv("MALLOC_MMAP_MAX_", "0")  # else this process would start again
    monkeypatch.syspath_prepend(str(BENCHMARKS))
    before = {name: sys.modules.pop(name, None) for name in NAMES}
    yield importlib.import_module
    for name, module in before.items():
        sys.modules.pop(name, None)
        if module is not None:
            sys.modules[name] = module


def run(program: ModuleType, monkeypatch: pytest.MonkeyPatch, *arguments: str) -> None:
    monkeypatch.setattr(sys, "argv", [str(program.__file__), *arguments])
    program.main()


def printed(capsys: pytest.CaptureFixture[str]) -> dict[str, Any]:
    found: dict[str, Any] = json.loads(capsys.readouterr().out)
    return found


def test_collection(load: Any, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    program, naive = load("collection"), load("naive")
    monkeypatch.setattr(load("bench_world"), "NUM_AGENTS", 2)
    env = naive.naive_env  # its workers take longer than all else together: here it is driven in this process
    monkeypatch.setattr(naive, "steps_per_second", lambda steps: 1.0)
    run(program, monkeypatch, "--json", "--maps=1", "--repeats=1", "--steps=2", *SMALL)
    found = printed(capsys)
    keys = ("env_steps_per_second", "bullet_fraction", "collector_steps_per_second", "naive_steps_per_second")
    assert all(found[key] > 0 for key in keys)
    bodies, simulation = (sys.modules[f"rcdsac_trl.world.sim.{name}"] for name in ("bodies", "simulation"))
    with monkeypatch.context() as own:  # what it changes in the world is put back
        own.setattr(bodies, "SHAPES_PER_BODY", bodies.SHAPES_PER_BODY)  # type: ignore[attr-defined]
        own.setattr(simulation.Simulation, "scan", simulation.Simulation.scan)  # type: ignore[attr-defined]
        driven = env(0)
        assert driven.rand_step(driven.reset())["next", "range"].shape == (1, 180)
        driven.close()


def test_evaluation(load: Any, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    run(load("evaluation"), monkeypatch, "--json", "--maps=1", "--num-workers=0", *SMALL)
    found = printed(capsys)
    assert found["extrapolated"]
    assert found["seconds_for_500_episodes"] > 0
    assert found["times_as_long_by_choice_among_32"] > 0


def test_deploy(load: Any, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    program = load("deploy")
    monkeypatch.setattr(program, "CALLS", 10)
    monkeypatch.setattr(program, "imported", lambda weights: [1.0, 100, False])
    run(program, monkeypatch, "--json")
    found = printed(capsys)
    drivers = ("act", "act_without_guard", "act_choosing", "act_choosing_without_guard", "torch_networks_alone")
    assert all(found[f"{name}_median_ms"] > 0 for name in drivers)


def test_planners(load: Any, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    run(load("planners"), monkeypatch, "--json", "--steps=10")
    found = printed(capsys)
    assert all(found[f"{name}_ms_per_decision"] > 0 for name in ("dwa", "mppi"))


def test_file_maps(load: Any, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    program = load("file_maps")
    monkeypatch.setattr(load("bench_world"), "NUM_AGENTS", 2)
    run(program, monkeypatch, "--json", "--side-m=20", "--repeats=1", "--steps=5")
    found = printed(capsys)
    assert found["boxes"] > 100
    assert found["step_rate_of_default"] > 0
    assert found["floor_m2"] > 100  # the rooms have doors


def test_learner(load: Any) -> None:
    common, program = load("bench_common"), load("learner")
    learner = common.make_learner("rcdsac_pow", SMALL)
    assert program.count_flops(learner.update) > 0
    parts = program.time_parts(learner, 1)
    assert "encoders" in parts
    assert set(program.TURNS) < set(program.PLAYERS)


def test_products_of_compiled_passes_are_counted() -> None:
    # In a process that has loaded no pass yet.
    code = """
import numpy as np
from learner import count_products
counted = count_products()
from rcdsac_trl.agent.kernels.matmul import matmul
for size in (4, 8):
    out = np.zeros((3, 5), np.float32)
    matmul(np.ones((3, size), np.float32), np.ones((size, 5), np.float32), out, False)
    print(counted(), out.min(), out.max())
"""
    found = subprocess.run([sys.executable, "-c", code], cwd=BENCHMARKS, capture_output=True, text=True, check=True)
    assert found.stdout.split() == ["120", "4.0", "4.0", "360", "8.0", "8.0"]


def test_accelerator(
    load: Any, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], tmp_path: Path
) -> None:
    """Its small form on a CPU, whose layers are held against the kernels as a GPU's are."""
    program = load("accelerator")
    found = {
        name: {key: value for line in measure("cpu") for key, value in line.items()}
        for name, (measure, _) in program.PARTS.items()
    }
    assert found["correctness"]["agrees"]
    assert 0.0 < found["correctness"]["full_precision_largest_relative_difference"] < program.LARGEST_DIFFERENCE
    assert all(found[name]["plain_updates_per_second"] > 0 for name in ("laptop", "paper"))
    assert found["collection"]["policy_on_cpu_agent_steps_per_second"] > 0
    assert found["iteration"]["updates_seconds"] > 0
    assert sum(seconds for _, seconds in program.PARTS.values()) <= 300
    # A part is a process, which is ended when its time is.
    assert program.measured("facts", "cpu", 0.01) == {"ended": "took longer than its 0.01 s"}
    monkeypatch.setattr("torch.cuda.device_count", lambda: 0)
    with pytest.raises(SystemExit) as left:
        run(program, monkeypatch, "--device=cuda", f"--out={tmp_path / 'out.json'}")
    assert left.value.code == 2
    assert "torch does not see it here" in capsys.readouterr().err
    assert not list(tmp_path.iterdir())


def test_a_graph_s_batch_is_filled_again_where_it_lies(load: Any) -> None:
    program = load("accelerator")
    learner = load("bench_common").make_learner("rcdsac_pow", [*SMALL, "learner.resample_per=sequence"])
    first, second = program.prepared(learner), program.prepared(learner)
    static = first.apply(program.held)
    assert first["risk"].stride(1) == static["risk"].stride(1) == 0
    places = {key: value.data_ptr() for key, value in static.items(True, True)}
    assert (static == first).all()
    assert not (first == second).all()
    program.refill(static, second)
    assert (static == second).all()
    assert {key: value.data_ptr() for key, value in static.items(True, True)} == places


def test_a_wrong_gradient_is_told(load: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    program = load("accelerator")
    total = program.total
    calls: list[int] = []

    def a_percent_more_there(losses: Any) -> Any:
        calls.append(1)
        return total(losses) * (1.01 if len(calls) == 2 else 1.0)

    monkeypatch.setattr(program, "total", a_percent_more_there)
    assert program.largest_difference("cpu") == pytest.approx(0.01, rel=0.01)


def test_scaling(
    load: Any, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], tmp_path: Path
) -> None:
    learner, world = load("scaling_learner"), load("scaling_world")
    monkeypatch.setattr(learner, "LEARNER", {"quantiles": [2]})
    monkeypatch.setattr(learner, "TURNS", 1)
    run(learner, monkeypatch, "--json", f"--out={tmp_path / 'learner.json'}")
    assert printed(capsys)["quantiles"]["2"] > 0
    for name, values in {"AGENTS": (1,), "WORKERS": (0,), "CLUTTER_PER_M2": (0.0,), "REPLAY_STEPS": (1000,)}.items():
        monkeypatch.setattr(world, name, values)
    monkeypatch.setattr(world, "_STEPS", 1)
    monkeypatch.setattr(world, "_TURNS", 1)
    run(world, monkeypatch, "--json", f"--out={tmp_path / 'world.json'}")
    curves = printed(capsys)
    assert (curves.pop("cores"), curves.pop("num_agents")) == (len(load("bench_world").cores()), 10)
    assert {name: len(curve) for name, curve in curves.items()} == dict.fromkeys(curves, 1)
    assert json.loads((tmp_path / "world.json").read_text())["agents"] == curves["agents"]


def test_whole_job(load: Any, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    few = [given for given in SMALL if not given.startswith("schedule.iterations")]
    run(load("whole_job"), monkeypatch, "--json", "--iterations=1", *few)
    assert printed(capsys)["wall_seconds"] > 0


@pytest.mark.slow
@pytest.mark.skipif(CHROMIUM is None, reason="there is no Chromium to open the page in")
def test_play_page(load: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    program = load("play_page")
    monkeypatch.setattr(program, "SCENES", {"one": "agent=sac-narrow", "two": "agent=sac-narrow&second=sac-narrow"})
    found = program.measured(CHROMIUM, os.sched_getaffinity(0), 2.0)
    assert 0.0 < found["page_sent_s"] < found["robot_moves_s"]
    assert 0.0 < found["one: driven a second"] < found["two: driven a second"]
    assert all(found[f"{name}: shown a second"] > 0.0 for name in ("one", "two"))


def test_soak(load: Any) -> None:
    """Its training is the one above; what it says of one is its own."""
    program = load("soak")
    steady = [dict.fromkeys(program.TOLERANCES, 1.0) for _ in range(10)]
    growing = [{name: float(number + 1) for name in program.TOLERANCES} for number in range(10)]
    assert all(found["flat"] for found in program.verdicts(steady).values())
    assert not any(found["flat"] for found in program.verdicts(growing).values())
