"""The agents that are there to be loaded by name, what is known of each, and where it lies; without torch."""

import json
import shutil
import textwrap
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from omegaconf import DictConfig, OmegaConf

from rcdsac_trl.config.shipped_settings import AgentsSettings
from rcdsac_trl.config.typed import read
from rcdsac_trl.deploy.policy.agent_config import AgentConfig
from rcdsac_trl.deploy.policy.measured import Measured
from rcdsac_trl.deploy.policy.registry import find_weights, shipped_agents, table_names
from rcdsac_trl.deploy.policy.weights import checked_weights, measured_of_weights, read_agent_config
from rcdsac_trl.errors import UserInputError
from rcdsac_trl.system.invocation import from_here

_HEADINGS = ("agent", "row", "told", "sensor", "maps/rules", "collisions", "reward", "in")
_RIGHT = ("maps/rules", "collisions", "reward")


@dataclass(frozen=True)
class ListedAgent:
    """An agent of the list.

    Attributes:
        name: by which it is loaded.
        folder: where it lies.
        config: what it is.
        measured: what is known of how it drives; None where nothing is.
    """

    name: str
    folder: Path
    config: AgentConfig
    measured: Measured | None

    def cells(self) -> list[str]:
        """Return what is shown of it, below the headings."""
        measured = self.measured
        return [
            self.name,
            self.config.name if measured is None else measured.row,
            _told(self.config),
            self.config.sensor,
            "-" if measured is None else f"{measured.map_version}/{measured.rules_version}",
            *("-" if measured is None else _ends(measured, *of) for of in (("collisions", ".2f"), ("reward", ".0f"))),
            from_here(self.folder.parent),
        ]

    def values(self) -> dict[str, Any]:
        """Return all that is known of it, as plain values."""
        return {
            "name": self.name,
            "folder": str(self.folder),
            "config": asdict(self.config),
            "measured": None if self.measured is None else asdict(self.measured),
        }


@dataclass(frozen=True)
class AgentList:
    """Agents that are there.

    Attributes:
        agents: that can be read, in the order of their names.
        refused: sentences on those that cannot, by name.
        as_json: print values instead of a table.
        is_whole: whether these are all that are there.
    """

    agents: Sequence[ListedAgent]
    refused: Mapping[str, str]
    as_json: bool
    is_whole: bool

    def run(self) -> None:
        """Print them."""
        print(self.in_json() if self.as_json else self.in_words())

    def in_json(self) -> str:
        """Return all that is known of all of them; of one that cannot be read its name and why (`error`)."""
        refused = [{"name": name, "error": why} for name, why in self.refused.items()]
        return json.dumps([agent.values() for agent in self.agents] + refused, indent=2, ensure_ascii=False)

    def in_words(self) -> str:
        """Return a table, and what is missing from it."""
        rows = [agent.cells() for agent in self.agents]
        lines = _aligned([list(_HEADINGS), *rows]) if rows else ["no agent is here"]
        if rows:
            lines += [
                "",
                "collisions and reward: of the most averse / the least averse setting; rcdsac_trl.load(<agent>)",
            ]
        lines += [f"{name} cannot be read: {why}" for name, why in self.refused.items()]
        there = {agent.name for agent in self.agents} | set(self.refused)
        if missing := [name for name in table_names() if self.is_whole and name not in there]:
            told = f"not here, of the paper's table: {', '.join(missing)}; loading one says how to get it"
            width = shutil.get_terminal_size((120, 24)).columns
            lines += textwrap.wrap(told, width, subsequent_indent="  ", break_on_hyphens=False)
        return "\n".join(lines)


def make_agent_list(cfg: DictConfig) -> AgentList:
    """Make the list of the agents that are named, or of all that are there.

    Raises:
        UserInputError: for a name that is not there.
    """
    # As `run_config.read_config` does, which knows all of a training and takes as long to import as all else here.
    settings = read(AgentsSettings, OmegaConf.to_container(cfg, resolve=True))  # type: ignore[arg-type]
    found = {name: find_weights(name, takes_runs=False) for name in settings.agents} or shipped_agents()
    agents, refused = [], {}
    for name, folder in found.items():
        try:
            agents.append(_listed(name, folder))
        except UserInputError as error:  # one that is damaged hides no other
            refused[name] = str(error)
    return AgentList(agents, refused, settings.format == "json", is_whole=not settings.agents)


def _listed(name: str, folder: Path) -> ListedAgent:
    config, digest = read_agent_config(folder)
    checked_weights(folder, digest)
    return ListedAgent(name, folder, config, measured_of_weights(folder, digest))


def _told(config: AgentConfig) -> str:
    """Say what an agent is told besides observations."""
    if config.context is not None and config.context_range is not None:
        name = "beta" if config.context == "beta" else "w_coll"
        return f"{name} {config.context_range[0]:g} to {config.context_range[1]:g}"
    return "-" if config.fixed_beta is None else f"for beta {config.fixed_beta:g}"


def _ends(measured: Measured, metric: str, form: str) -> str:
    return " / ".join(format(value, form) for value in measured.ends(metric))


def _aligned(rows: Sequence[Sequence[str]]) -> list[str]:
    widths = [max(map(len, column)) for column in zip(*rows, strict=True)]
    forms = [f"{'>' if name in _RIGHT else '<'}{width}" for name, width in zip(_HEADINGS, widths, strict=True)]
    lines = ["  ".join(format(cell, form) for cell, form in zip(row, forms, strict=True)) for row in rows]
    return [line.rstrip() for line in lines]
