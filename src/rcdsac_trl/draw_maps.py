"""Draw maps: ``python -m rcdsac_trl.draw_maps out=maps.png count=12 map=mixed split=train seed=0``.

Each map of the contact sheet shows one start and goal, the waypoints that the planner gives the robot, and
the true shortest path, which knows the unmapped clutter as well.
"""

from dataclasses import dataclass
from pathlib import Path

from omegaconf import DictConfig

from rcdsac_trl.cli import Command
from rcdsac_trl.config.run_config import read_config
from rcdsac_trl.errors import UserInputError
from rcdsac_trl.storage import atomic
from rcdsac_trl.system.checks import check_least
from rcdsac_trl.system.progress import Work, counted
from rcdsac_trl.system.resources import check_picture, check_writable
from rcdsac_trl.world.maps.files.barn import BarnMapSettings
from rcdsac_trl.world.maps.files.file_map import FileMapSettings, described
from rcdsac_trl.world.maps.files.map_files import map_files
from rcdsac_trl.world.maps.generator import Split
from rcdsac_trl.world.maps.map_source import MapSource, check_maps, make_map
from rcdsac_trl.world.task.rules import TaskSettings

_MAX_COUNT = 100


@dataclass(frozen=True)
class Sheet:
    """The root of ``conf/draw_maps.yaml``, which explains the keys.

    Raises:
        UserInputError: a value is outside its limits.
    """

    out: str
    count: int
    split: Split
    seed: int
    map: MapSource | BarnMapSettings
    json: str | None = None

    def __post_init__(self) -> None:
        """Refuse what cannot be drawn."""
        check_picture(Path(self.out))
        if not 1 <= self.count <= _MAX_COUNT:
            raise UserInputError(f"count={self.count} is not a whole number from 1 to {_MAX_COUNT}: use one")
        check_least("seed", self.seed, 0)
        if self.json is not None:
            check_writable(Path(self.json))

    def run(self) -> None:
        """Write the picture, and the maps where that is wanted."""
        from rcdsac_trl.world.maps.contact_sheet import contact_sheet  # late: a mistake does not wait for Matplotlib

        source = self.map.files() if isinstance(self.map, BarnMapSettings) else self.map
        if isinstance(source, FileMapSettings):
            for file in map_files(source.path)[: self.count]:
                print(described(source, file))
        out = Path(self.out)
        out.parent.mkdir(parents=True, exist_ok=True)
        with Work(f"{counted(self.count, 'map')}, then their picture, {out}", self.count, "map") as work:
            maps = [make_map(source, self.split, self.seed, index) for index in range(self.count)]
            contact_sheet(maps, self.split, self.seed, drawn=work.end_unit).savefig(out, dpi=130)
        print(f"drew {counted(self.count, 'map')}: {out}")
        try:
            # BARN's goals are given.
            check_maps(source, 0.0 if isinstance(self.map, BarnMapSettings) else TaskSettings().min_path_m)
        except UserInputError as error:  # the picture shows why
            print(f"train and evaluate refuse this for the paper's robot: {error}")
        if self.json is not None:
            folder = Path(self.json)
            folder.mkdir(parents=True, exist_ok=True)
            for index, map_ in enumerate(maps):
                atomic.write(folder / f"{self.split}-{index}.json", map_.to_json().encode())
            print(f"wrote them as JSON: {folder}")


def make_sheet(cfg: DictConfig) -> Sheet:
    """Read what to draw."""
    return read_config(cfg, Sheet)


main = Command("draw_maps", make_sheet)

if __name__ == "__main__":
    main()
