"""Which run `resume` means; the run's own config holds, so nothing else may be asked of it."""

import json
from pathlib import Path
from typing import Any

import yaml
from omegaconf import DictConfig, OmegaConf
from omegaconf.errors import OmegaConfBaseException

from rcdsac_trl.config.command_line import SEARCHPATH, assigned, folder_of, key_of
from rcdsac_trl.config.compose import compose, output_folder
from rcdsac_trl.config.paths import CONF_DIR
from rcdsac_trl.config.run_config import CHECKPOINTS, CONFIG_NAME, settings_of_new_run, settings_of_run
from rcdsac_trl.errors import UserInputError
from rcdsac_trl.storage.checkpoint_record import newest
from rcdsac_trl.system.invocation import program
from rcdsac_trl.training.run_folder import MANIFEST_NAME, has_begun

AUTO = "auto"
_ABSENT = object()


def run_to_continue(overrides: list[str]) -> Path | None:
    """Find the run that a call of `train` continues.

    Args:
        overrides: of the command line.

    Returns:
        The run's folder; None if the call starts a new one.

    Raises:
        UserInputError: for a folder that holds no run, overrides that contradict the run, and runs that cannot be told
            apart from others.
    """
    if not any(key_of(override) == "resume" for override in overrides):
        return None
    # By itself: what else is given may need what the run was started with, such as folders of robots.
    resume = compose("train", [override for override in overrides if key_of(override) == "resume"]).resume
    if resume is None:
        return None
    if resume == "":
        raise UserInputError("resume names no folder: give it one, or auto, or leave it out")
    if resume == AUTO:
        settings_of_new_run(compose("train", overrides))
        return _newest_unfinished(overrides)
    folder = Path(str(resume))
    settings_of_run(folder, key="resume")
    _check_overrides(folder, overrides)
    return folder


def _newest_unfinished(overrides: list[str]) -> Path | None:
    wanted = _comparable(compose("train", overrides))
    there = output_folder("train", overrides)
    if (there / CONFIG_NAME).exists():  # the call names its folder: that run or none
        if _config(there) != wanted:
            raise UserInputError(f"{there} holds a run of another config: choose another hydra.run.dir")
        return there
    started = {path.parent: path.stat().st_mtime_ns for path in there.parent.glob(f"*/{CONFIG_NAME}")}
    for folder in sorted(started, key=lambda folder: started[folder], reverse=True):
        if _config(folder) == wanted and not _is_finished(folder):
            print(f"resume=auto: continue {folder}")
            return folder
    print(f"resume=auto: no unfinished run of this config in {there.parent}, so a new one")
    return None


def differing_keys(folder: Path, cfg: DictConfig) -> list[str]:
    """Name the keys in which a run's config is another one; empty if it is the same, or the folder holds no run."""
    if not (folder / CONFIG_NAME).exists():
        return []
    there, wanted = _leaves(_config(folder) or {}), _leaves(_comparable(cfg))
    return sorted(key for key in there.keys() | wanted.keys() if there.get(key, _ABSENT) != wanted.get(key, _ABSENT))


def _leaves(node: dict[str, Any], prefix: str = "") -> dict[str, Any]:
    found: dict[str, Any] = {}
    for key, value in node.items():
        found |= _leaves(value, f"{prefix}{key}.") if isinstance(value, dict) else {f"{prefix}{key}": value}
    return found


def _is_finished(folder: Path) -> bool:
    if not has_begun(folder):
        return False
    saved, _ = newest(folder / CHECKPOINTS)
    return saved.progress.iterations == settings_of_run(folder).schedule.iterations


def _check_overrides(folder: Path, overrides: list[str]) -> None:
    """Refuse what would make the run another one; what it was started with, and what changes nothing, may stand."""
    own = _own_overrides(folder)
    for override in overrides:
        key = key_of(override)
        if override in own or key in ("resume", SEARCHPATH):  # the run's config holds, wherever others may lie
            continue
        if key == "hydra.run.dir" and folder_of(override).resolve() == folder.resolve():
            continue
        if key.startswith("hydra") or _changes(own, override):
            new = "start a new run without resume"
            if key == "schedule.iterations":
                more = f"{program()} train {assigned('init', str(folder))} schedule.iterations=<how many more>"
                new = f"for more iterations begin a new run with its agent: {more}"
            raise UserInputError(
                f"{override} is not what {folder} was started with, and resume continues a run as it was: leave it "
                f"out, or {new}"
            )


def _own_overrides(folder: Path) -> list[str]:
    """Read the overrides of the call that started a run; none if they cannot be read any more."""
    try:
        noted = json.loads((folder / MANIFEST_NAME).read_bytes())["overrides"]
        return [override for override in noted if key_of(override) != "resume"]
    except (OSError, ValueError, KeyError, TypeError, AttributeError, RecursionError):
        return []


def _changes(own: list[str], override: str) -> bool:
    # What `init` chose stands among them, and the agent it names may be gone.
    own = [other for other in own if key_of(other) != "init"]
    others = [other for other in own if key_of(other) != key_of(override)]
    return _comparable(compose("train", own)) != _comparable(compose("train", [*others, override]))


def _config(folder: Path) -> dict[str, Any] | None:
    """Read a run's config; None if there is nothing to compare."""
    try:
        cfg = OmegaConf.load(folder / CONFIG_NAME)
        return _comparable(cfg) if isinstance(cfg, DictConfig) else None
    except (OSError, ValueError, TypeError, yaml.YAMLError, OmegaConfBaseException):
        return None


def _comparable(cfg: DictConfig) -> dict[str, Any]:
    values: dict[str, Any] = OmegaConf.to_container(cfg, resolve=True)  # type: ignore[assignment]
    values.pop("resume", None)
    # Runs of earlier versions name none.
    values.setdefault("robot", OmegaConf.to_container(OmegaConf.load(CONF_DIR / "robot" / "paper.yaml")))
    if isinstance(maps := values.get("map"), dict):
        maps.pop("sha256", None)  # noted as the run began; whether the files are still those is asked when it goes on
    return values
