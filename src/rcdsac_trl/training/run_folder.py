"""The run folder: what makes a folder one, and how it begins; without torch, so that a taken one is told at once."""

import json
import os
import platform
import sys
from collections.abc import Mapping
from importlib.metadata import version
from pathlib import Path

from omegaconf import DictConfig, OmegaConf

from rcdsac_trl.config.run_config import CHECKPOINTS, CONFIG_NAME
from rcdsac_trl.errors import UserInputError
from rcdsac_trl.storage import atomic
from rcdsac_trl.system.provenance import commit
from rcdsac_trl.system.resources import check_writable

MANIFEST_NAME = "manifest.json"
TRAINING_TABLE = "training_episodes.csv"
_PACKAGES = ("torch", "torchrl", "tensordict", "pybullet", "gymnasium", "hydra-core", "numpy", "numba", "rcdsac-trl")


def check_folder(folder: Path) -> None:
    """Refuse a folder that already holds a run, or that nothing can be written into."""
    check_writable(folder)
    # A run whose config was lost is one too.
    if any((folder / name).exists() for name in (CONFIG_NAME, CHECKPOINTS, TRAINING_TABLE)):
        raise UserInputError(f"{folder} already holds a run: choose another hydra.run.dir")


def start_run_folder(folder: Path, cfg: DictConfig, facts: Mapping[str, object]) -> None:
    """Write what a run is made of: the resolved config, versions, commit and command.

    Raises:
        UserInputError: if the folder already holds a run.
    """
    check_folder(folder)
    folder.mkdir(parents=True, exist_ok=True)
    for name in (MANIFEST_NAME, CONFIG_NAME):  # of a process that died as it began
        atomic.clear_leftovers(folder, name)
    manifest = {
        "command": [Path(sys.argv[0]).stem, *sys.argv[1:]],
        "seed": cfg.seed,
        "commit": commit(),
        "python": platform.python_version(),
        "machine": f"{platform.system()} {platform.machine()}",
        "packages": {name: version(name) for name in _PACKAGES},
        **facts,
    }
    atomic.write(folder / MANIFEST_NAME, (json.dumps(manifest, indent=2) + "\n").encode())
    # Last: a folder that has a config is a run.
    atomic.write(folder / CONFIG_NAME, OmegaConf.to_yaml(cfg, resolve=True).encode())


def lengths(folder: Path) -> dict[str, int]:
    """Bring the tables and the CSV scalars of a run to the disk and return how long each file is, in bytes."""
    files = _tables(folder)
    for path in files:
        atomic.sync(path)
    return {path.relative_to(folder).as_posix(): path.stat().st_size for path in files}


def cut(folder: Path, recorded: Mapping[str, int]) -> list[str]:
    """Shorten the tables and the CSV scalars of a run to what they were when :func:`lengths` was called.

    Returns:
        One sentence for each file that is shorter than that.
    """
    for path in _tables(folder):
        length = recorded.get(path.relative_to(folder).as_posix(), 0)
        if length == 0:
            path.unlink()
        elif path.stat().st_size > length:
            os.truncate(path, length)
            atomic.sync(path)
    found = {name: (folder / name).stat().st_size if (folder / name).exists() else 0 for name in recorded}
    return [
        f"{folder / name} has lost rows: it holds {found[name]} bytes of {length}"
        for name, length in recorded.items()
        if found[name] < length
    ]


def _tables(folder: Path) -> list[Path]:
    return sorted([*folder.glob("*_episodes.csv"), *folder.glob("csv/scalars/**/*.csv")])


def has_begun(folder: Path) -> bool:
    """Whether a run has saved or driven anything; one that has not can only be begun."""
    return (folder / TRAINING_TABLE).exists() or any((folder / CHECKPOINTS).glob("[!.]*"))
