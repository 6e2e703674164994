"""Environments by the names of ``conf/``, for who uses them from Python."""

import difflib
from collections.abc import Sequence
from dataclasses import dataclass, fields
from inspect import Parameter, signature
from pathlib import Path
from typing import Any

from rcdsac_trl.config.compose import choices, compose
from rcdsac_trl.config.run_config import plain, training_settings
from rcdsac_trl.config.typed import read
from rcdsac_trl.errors import UserInputError
from rcdsac_trl.robot.robot_settings import RobotSettings
from rcdsac_trl.world.maps.files.file_map import FileMapSettings
from rcdsac_trl.world.maps.map_source import MapSource
from rcdsac_trl.world.task.gymnasium_env import NavigationGymEnv
from rcdsac_trl.world.task.world_settings import WorldSettings

# Of these map sets a path says which maps they are.
_OF_FILES = ("file", "barn")
_OF_WORLD = ("map", *(field.name for field in fields(WorldSettings)))
_OF_ENV = tuple(
    name
    for name, parameter in signature(NavigationGymEnv).parameters.items()
    if parameter.kind is Parameter.KEYWORD_ONLY
)


@dataclass(frozen=True)
class _Maps:
    """What a map set is read as: whichever kind of source it is."""

    map: MapSource


def named_world(**options: Any) -> WorldSettings:
    """Return what an environment is made of, see :func:`rcdsac_trl.world_settings`."""
    return WorldSettings(**_resolved(options, _OF_WORLD))


def gymnasium_env(world: WorldSettings | None = None, **options: Any) -> NavigationGymEnv:
    """Make what ``gymnasium.make("RCDSACNavigation-v0", ..)`` returns.

    Args:
        world: what it is made of; None: the defaults.
        options: of :class:`~rcdsac_trl.world.task.gymnasium_env.NavigationGymEnv`, and `map` and `robot` by name, see
            :func:`rcdsac_trl.world_settings`.
    """
    return NavigationGymEnv(world, **_resolved(options, (*_OF_WORLD, *_OF_ENV)))


def _resolved(options: dict[str, Any], known: Sequence[str]) -> dict[str, Any]:
    """Return options with settings in place of names.

    Args:
        options: what was given.
        known: names of all that may be.
    """
    if strange := next((name for name in options if name not in known), None):
        near = difflib.get_close_matches(strange, known, n=1)
        others = f"did you mean {near[0]}?" if near else f"choose among {', '.join(known)}"
        raise UserInputError(f"there is no option {strange}: {others}")
    resolved = dict(options)
    if (named := resolved.pop("map", None)) is not None:
        if "map_settings" in options:
            raise UserInputError("map and map_settings both say which maps: give one of them")
        resolved["map_settings"] = _maps(named)
    if isinstance(robot := options.get("robot"), str):
        resolved["robot"] = _robot(robot)
    return resolved


def generated_sets() -> list[str]:
    """List the map sets of ``conf/map`` whose maps are drawn, not read from files."""
    return [name for name in choices("map") if name not in _OF_FILES]


def map_set(name: str) -> MapSource:
    """Return what the maps of a set of ``conf/map`` are drawn from."""
    section = plain(compose("draw_maps", [f"map={name}"]))["map"]  # a root that has little else
    return read(_Maps, {"map": section}).map


def _maps(named: str | Path | MapSource) -> MapSource:
    if not isinstance(named, str | Path):
        return named
    generated = generated_sets()
    if str(named) in generated:
        return map_set(str(named))
    if Path(named).exists():
        return FileMapSettings(path=str(named))
    raise UserInputError(
        f"map={named} does not exist: choose one of {', '.join(generated)}, or a file that maps are read from"
    )


def _robot(name: str) -> RobotSettings:
    if name not in choices("robot"):
        raise UserInputError(
            f"robot={name} does not exist: choose one of {', '.join(choices('robot'))}, or give a RobotSettings"
        )
    return training_settings(_composed(f"robot={name}")).robot


def _composed(choice: str) -> Any:
    """Compose the config of a training that makes a choice; which row it trains does not matter."""
    return compose("train", ["+algo=sac", choice])
