"""What a server offers: agents and maps by name. A browser chooses among the names, and never says a path."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cache
from pathlib import Path

from rcdsac_trl.config.named_folder import find_agent
from rcdsac_trl.deploy import Weights, shipped_names
from rcdsac_trl.errors import UserInputError
from rcdsac_trl.playground.scene_choice import NOBODY, shortened
from rcdsac_trl.release.named_agent import named_agent
from rcdsac_trl.world.maps.files.file_map import FileMapSettings
from rcdsac_trl.world.maps.map_source import MapSource, check_maps, with_digests
from rcdsac_trl.world.task.rules import TaskSettings

OFFICE = "office"
"""The map that is no map set: the office and its course."""
PLANNERS = ("mppi", "dwa")
"""Classical planners that drive as well."""


@dataclass(frozen=True)
class Offers:
    """What can be chosen.

    Attributes:
        agents: what ``run=`` names, by the name on the page; the first is the default.
        maps: what maps are made from, by name.
    """

    agents: Mapping[str, str]
    maps: Mapping[str, MapSource]

    @classmethod
    def of(
        cls, runs: Sequence[str], map_sets: Mapping[str, MapSource], files: Mapping[str, FileMapSettings]
    ) -> "Offers":
        """Collect what there is.

        Args:
            runs: run folders and exported folders that are offered before the shipped agents.
            map_sets: by name.
            files: maps of one's own, by name.

        Raises:
            UserInputError: for an agent or a file that cannot be read, and a name that stands for two.
        """
        agents: dict[str, str] = {}
        # Who has no beta to be turned comes last.
        shipped = sorted(shipped_names(), key=lambda name: _read(name).config.context != "beta")
        for run in (*runs, *shipped):
            find_agent(run)
            name = Path(run).resolve().name if Path(run).is_dir() else run
            if name in agents or name in PLANNERS:
                raise UserInputError(f"two agents are called {name}: rename the folder of one of them")
            if name == NOBODY:
                raise UserInputError(f"no agent can be called {NOBODY}, which means no second robot: rename its folder")
            agents[name] = run
        if not agents:
            raise UserInputError("no agent is shipped with this version: name who drives with run=<folder>")
        for name, source in files.items():
            if name in map_sets or name == OFFICE:
                raise UserInputError(f"a map set is called {name}: rename the file of that name")
            check_maps(source, TaskSettings().min_path_m)
        own = {name: with_digests(source) for name, source in files.items()}
        return cls(agents, {**map_sets, **own})

    @property
    def drivers(self) -> list[str]:
        """Everything that drives: agents, then planners."""
        return [*self.agents, *PLANNERS]

    @property
    def places(self) -> list[str]:
        """Everywhere that can be driven."""
        return [*self.maps, OFFICE]

    def weights(self, name: str) -> Weights:
        """Return an agent; what was read once is kept.

        Raises:
            UserInputError: if none of that name is offered, or it cannot be read.
        """
        if name not in self.agents:
            raise UserInputError(f"no agent {shortened(name)} is offered: choose one of {', '.join(self.drivers)}")
        return _read(self.agents[name])

    def source(self, name: str) -> MapSource:
        """Return what the maps of a name are made from.

        Raises:
            UserInputError: if none of that name is offered.
        """
        if name not in self.maps:
            raise UserInputError(f"no map {shortened(name)} is offered: choose one of {', '.join(self.places)}")
        return self.maps[name]


@cache
def _read(run: str) -> Weights:
    return named_agent(run).weights()
