"""The wheel alone, outside the checkout: it carries the configuration, trains, and leaves a complete run folder."""

import json
import os
import re
import shutil
import subprocess
import sys
import zipfile
from email import message_from_string
from email.message import Message
from importlib.metadata import packages_distributions
from pathlib import Path

import pandas as pd
import pytest
import yaml

import rcdsac_trl
from rcdsac_trl.deploy.policy.registry import HANDFUL

ROOT = Path(__file__).resolve().parents[1]
TINY = (
    "preset=smoke",
    "schedule.iterations=1",
    "schedule.updates_per_iteration=1",
    "task.episode_steps=20",
    "world.num_agents=2",
    "world.num_workers=0",
    "learner.sequence_length=4",
    "validation.num_maps=1",
    "threads=1",
)


@pytest.fixture(scope="module")
def installed(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Build the wheel and unpack it, as an installer does."""
    folder = tmp_path_factory.mktemp("wheel")
    build = [sys.executable, "-m", "build", "--wheel", "--no-isolation", "--outdir", str(folder), str(ROOT)]
    subprocess.run(build, cwd=folder, check=True, capture_output=True)
    (wheel,) = folder.glob("*.whl")
    with zipfile.ZipFile(wheel) as archive:
        archive.extractall(folder / "site")
    return folder / "site"


@pytest.fixture(scope="module")
def lent(installed: Path) -> Path:
    """Give the wheel what was compiled of the same files in the checkout: compiling is not what is tested here.

    A cache belongs to a file of that size and time of change; without any, the wheel's program compiles for itself.
    """
    source = ROOT / "src"
    modules: set[Path] = set()
    for suffix in ("pyc", "nbi", "nbc"):  # of numba's, what lists, then what is listed
        for cache in source.rglob(f"*.{suffix}"):
            module = cache.parents[1] / f"{cache.name.split('.')[0]}.py"
            if module.exists():  # it has not been moved since it was compiled
                target = installed / cache.relative_to(source)
                target.parent.mkdir(exist_ok=True)
                shutil.copyfile(cache, target)
                modules.add(module)
    for module in modules:
        times = module.stat()
        os.utime(installed / module.relative_to(source), ns=(times.st_atime_ns, times.st_mtime_ns))
    return installed


def python(installed: Path, folder: Path, *arguments: str) -> subprocess.CompletedProcess[str]:
    """Run Python in a folder; what is installed comes before an editable checkout."""
    environment = os.environ | {"PYTHONPATH": str(installed)}
    command = [sys.executable, *arguments]
    return subprocess.run(command, cwd=folder, env=environment, capture_output=True, text=True, check=False)


def files_below(folder: Path) -> dict[str, bytes]:
    return {p.relative_to(folder).as_posix(): p.read_bytes() for p in sorted(folder.rglob("*")) if p.is_file()}


def test_the_wheel_holds_the_configuration_and_no_leftovers(installed: Path) -> None:
    assert not installed.is_relative_to(ROOT)
    assert files_below(installed / "rcdsac_trl" / "conf") == files_below(ROOT / "conf")
    names = list(files_below(installed))
    assert {name.split("/")[0] for name in names if ".dist-info" not in name} == {"rcdsac_trl"}
    kinds = {".py", ".yaml", ".typed", ".csv", ".json", ".safetensors", ".md", ".html", ".css", ".js"}
    assert {Path(name).suffix for name in names if name.startswith("rcdsac_trl/")} == kinds
    assert "rcdsac_trl/report/paper.csv" in names


def test_the_wheel_carries_a_handful_of_agents(installed: Path) -> None:
    """And stays small: all others are in the repository alone."""
    for name in HANDFUL:
        assert files_below(installed / "rcdsac_trl" / "weights" / name) == files_below(ROOT / "weights" / name)
    assert {path.name for path in (installed / "rcdsac_trl" / "weights").iterdir()} == set(HANDFUL)
    (wheel,) = installed.parent.glob("*.whl")
    assert wheel.stat().st_size < 20e6


# What drives a robot: all else of the package's dependencies is kept from it.
BARE = ("numpy", "safetensors", "numba", "llvmlite")
DRIVE = """
import sys

class Missing:
    def find_spec(self, name, path=None, target=None):
        top = name.partition(".")[0]
        if top in KEPT_AWAY:
            raise ModuleNotFoundError(f"No module named {name!r}", name=name)

KEPT_AWAY = set(sys.argv[1:])
sys.meta_path.insert(0, Missing())
import rcdsac_trl
policy = rcdsac_trl.load("rcdsac_pow-narrow")
for step in range(20):
    command = policy.act([2.5] * 180, [[2.0, 0.0], [4.0, 1.0]], [0.3, 0.0], beta=-1.0)
assert command.reason is None and command.v_m_per_s > 0.0, command
print(rcdsac_trl.__version__, rcdsac_trl.__file__)
"""


def metadata(installed: Path) -> Message:
    (path,) = installed.glob("*.dist-info/METADATA")
    return message_from_string(path.read_text())


def modules_of_dependencies(installed: Path) -> list[str]:
    """Name the modules of every package that the wheel asks for, but those that driving needs."""
    lines = metadata(installed).get_all("Requires-Dist") or []
    asked = {re.split(r"[^\w-]", line)[0].lower() for line in lines if "extra ==" not in line}
    names = packages_distributions()
    owned = {name for name, owners in names.items() if asked.intersection(owner.lower() for owner in owners)}
    return sorted(owned - {*BARE})


def test_the_wheel_drives_with_numpy_numba_and_safetensors_alone(lent: Path, tmp_path: Path) -> None:
    kept_away = modules_of_dependencies(lent)
    assert {"torch", "torchrl", "hydra", "pybullet", "gymnasium", "pandas", "yaml"} <= set(kept_away)
    driven = python(lent, tmp_path, "-c", DRIVE, *kept_away)
    assert driven.returncode == 0, driven.stderr
    version, file = driven.stdout.split()
    assert version == rcdsac_trl.__version__
    assert Path(file) == lent / "rcdsac_trl" / "__init__.py"
    assert metadata(lent)["Version"] == version
    (scripts,) = lent.glob("*.dist-info/entry_points.txt")
    assert scripts.read_text().splitlines()[1].startswith("rcdsac-trl = ")


@pytest.mark.slow
def test_the_wheel_in_an_environment_of_its_own_drives(installed: Path, tmp_path: Path) -> None:
    """With nothing but what driving needs, as an installer puts it there; takes it from a package index."""
    (wheel,) = installed.parent.glob("*.whl")
    subprocess.run([sys.executable, "-m", "venv", str(tmp_path / "bare")], check=True)
    bare = str(tmp_path / "bare" / "bin" / "python")
    pip = [bare, "-m", "pip", "install", "--quiet", "-c", str(ROOT / "constraints.txt")]
    subprocess.run([*pip, *BARE], check=True)
    subprocess.run([*pip, "--no-deps", str(wheel)], check=True)
    environment = {name: value for name, value in os.environ.items() if name != "PYTHONPATH"}
    driven = subprocess.run(
        [bare, "-c", DRIVE],
        cwd=tmp_path,
        env=environment,
        capture_output=True,
        text=True,
        check=False,
    )
    assert driven.returncode == 0, driven.stderr
    assert str(tmp_path / "bare") in driven.stdout


def test_the_wheel_trains_outside_the_checkout(lent: Path, tmp_path: Path) -> None:
    found = python(lent, tmp_path, "-c", "import rcdsac_trl; print(rcdsac_trl.__file__)")
    assert Path(found.stdout.strip()) == lent / "rcdsac_trl" / "__init__.py"
    run = tmp_path / "run"
    trained = python(lent, tmp_path, "-m", "rcdsac_trl.train", "+algo=sac", *TINY, f"hydra.run.dir={run}")
    assert trained.returncode == 0, trained.stderr
    assert {path.name for path in run.iterdir()} == {
        "checkpoints",
        "config.yaml",
        "csv",
        "lock",
        "manifest.json",
        "replay",
        "tensorboard",
        "train.log",
        "training_episodes.csv",
        "validation_episodes.csv",
    }
    assert {path.name for path in (run / "checkpoints").iterdir()} == {"iteration-000000", "iteration-000001"}
    assert yaml.safe_load((run / "config.yaml").read_text())["algo"]["name"] == "sac"
    assert json.loads((run / "manifest.json").read_text())["commit"] == "none"
    assert len(pd.read_csv(run / "training_episodes.csv")) == 2
    assert len(pd.read_csv(run / "validation_episodes.csv")) == 2
    assert list(tmp_path.iterdir()) == [run]
