"""What ``train init=<agent>`` chooses unless a user says otherwise: an agent goes on as what it is."""

import json
from collections.abc import Iterator, Sequence
from dataclasses import asdict
from typing import Any

from rcdsac_trl.config.command_line import as_text, key_of
from rcdsac_trl.config.named_folder import find_agent
from rcdsac_trl.config.training_settings import TrainingSettings
from rcdsac_trl.world.maps.files.file_map import FileMapSettings
from rcdsac_trl.world.maps.map_mixture import MapMixture

# It is driven by itself from the start, and already averse.
_NO_START = {"pursuit_iterations": 0, "neutral_iterations": 0, "ramp_iterations": 0}
# Maps that have other keys than the default's.
_GROUPS = {FileMapSettings: "file", MapMixture: "varied"}
_OF_RUN = ("map", "task", "world", "learner", "replay", "schedule", "validation", "acting")


def with_the_agents_own(named: str, overrides: Sequence[str]) -> list[str]:
    """Put before overrides what the agent that is named was trained with: row, sensor, robot and networks.

    A run goes on as a whole unless a preset is chosen: maps, task, hyper-parameters and schedule are its own, too.

    Args:
        named: a run folder, an exported folder or a shipped agent.
        overrides: of the command line; what they choose holds.

    Raises:
        UserInputError: if there is no such agent, or nothing says what it was trained with.
    """
    found = find_agent(named)
    settings, chosen = found.settings(), {key_of(override) for override in overrides}
    sections, groups = _of_agent(settings), []
    if found.is_run and "preset" not in chosen:
        sections |= _of_run(settings)
        if (group := _GROUPS.get(type(settings.map))) is not None and "map" not in chosen:
            groups = [f"map={group}"]
    # Who chooses another of a group takes that as a whole.
    own = [leaf for name, values in sections.items() if name not in chosen for leaf in _leaves(name, values)]
    return [*groups, *(f"++{key}={_written(value)}" for key, value in own), *overrides]


def _of_agent(settings: TrainingSettings) -> dict[str, dict[str, Any]]:
    """Return the sections that say what an agent is, and that it needs no help at the start."""
    return {
        "algo": asdict(settings.algo),
        "sensor": asdict(settings.sensor),
        "robot": settings.robot.plain(),
        "network": asdict(settings.network),
        "learner": {"num_critics": settings.learner.num_critics},
        "schedule": dict(_NO_START),
    }


def _of_run(settings: TrainingSettings) -> dict[str, dict[str, Any]]:
    """Return the sections that say how a run was trained, but for the help that it had at its start."""
    sections = {name: asdict(getattr(settings, name)) for name in _OF_RUN}
    sections["schedule"] |= _NO_START
    sections["map"].pop("sha256", None)  # noted anew: other files make it another world
    return sections


def _leaves(name: str, value: Any) -> Iterator[tuple[str, Any]]:
    if not isinstance(value, dict):
        yield name, value
        return
    for key, below in value.items():
        yield from _leaves(f"{name}.{key}", below)


def _written(value: Any) -> str:
    """Write a value as Hydra reads it: as JSON, but for texts."""
    if isinstance(value, list | tuple):
        return f"[{','.join(_written(each) for each in value)}]"
    return as_text(value) if isinstance(value, str) else json.dumps(value)
