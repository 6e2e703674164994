"""What ``train init=<agent>`` chooses unless a user says otherwise: an agent goes on as what it is."""

import json
from collections.abc import Iterator, Sequence
from dataclasses import asdict
from typing import Any

from rcdsac_trl.config.command_line import key_of
from rcdsac_trl.config.named_folder import find_agent

# It is driven by itself from the start, and already averse.
_SCHEDULE = ("pursuit_iterations", "neutral_iterations", "ramp_iterations")


def with_the_agents_own(named: str, overrides: Sequence[str]) -> list[str]:
    """Put before overrides what the agent that is named was trained with: row, sensor, robot and networks.

    Args:
        named: a run folder, an exported folder or a shipped agent.
        overrides: of the command line; what they choose holds.

    Raises:
        UserInputError: if there is no such agent, or nothing says what it was trained with.
    """
    settings = find_agent(named).settings()
    sections = {
        "algo": asdict(settings.algo),
        "sensor": asdict(settings.sensor),
        "robot": settings.robot.plain(),
        "network": asdict(settings.network),
        "learner": {"num_critics": settings.learner.num_critics},
        "schedule": dict.fromkeys(_SCHEDULE, 0),
    }
    # Who chooses another of a group takes that as a whole.
    chosen = {key_of(override) for override in overrides}
    own = [leaf for name, values in sections.items() if name not in chosen for leaf in _leaves(name, values)]
    return [*(f"++{key}={json.dumps(value)}" for key, value in own), *overrides]


def _leaves(name: str, value: Any) -> Iterator[tuple[str, Any]]:
    if not isinstance(value, dict):
        yield name, value
        return
    for key, below in value.items():
        yield from _leaves(f"{name}.{key}", below)
