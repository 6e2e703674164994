"""BARN's protocol: fifty worlds of cylinders, one start, one goal, a time limit, and a score.

Source: Perille et al., 2020, "Benchmarking Metric Ground Navigation", and Xiao et al., 2022, "Autonomous Ground
Navigation in Highly Constrained Spaces: Lessons learned from The BARN Challenge".
"""

import re
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import numpy as np

from rcdsac_trl.errors import UserInputError
from rcdsac_trl.world.maps.files.file_map import FileMapSettings
from rcdsac_trl.world.maps.shapes import CLEARANCE_MARGIN_M, WAYPOINT_CLEARANCE_M

WORLDS = tuple(range(0, 300, 6))
"""Numbers of the worlds that are driven."""
START = (-2.25, 3.0, np.pi / 2)
"""Where robots start, facing the goal: x, y in m and yaw in rad, in a world's own frame."""
GOAL = (-2.25, 13.0)
"""Where they go, m, likewise."""
GOAL_RADIUS_M = 1.0
TIME_LIMIT_S = 100.0
OPTIMAL_SPEED_M_PER_S = 2.0
"""That of the robot for which the optimal time is reckoned."""

_SOURCE = (
    "get them from github.com/Daffan/the-barn-challenge, the folder jackal_helper/worlds/BARN, with the path_*.npy "
    "of its path_files"
)
# A cell of a path in a world's frame.
_PATH_CELL_M = 0.15
_PATH_CORNER = -4.575, 5.075


@dataclass(frozen=True)
class BarnMapSettings:
    """The worlds of the protocol; every field is a key of ``conf/map/barn.yaml``.

    Attributes:
        protocol: ``"barn"``.
        path: the folder of the worlds, those of other numbers may lie there as well.
        mapped: whether the planner knows the cylinders; the protocol gives nobody a map.
        clearance_margin_m: what is kept free beyond the robot's radius, m.
        waypoint_clearance_m: clearance that waypoints keep where that costs little, m.

    Raises:
        UserInputError: no folder is named.
    """

    protocol: Literal["barn"]
    path: str | None = None
    mapped: bool = False
    clearance_margin_m: float = CLEARANCE_MARGIN_M
    waypoint_clearance_m: float = WAYPOINT_CLEARANCE_M

    def __post_init__(self) -> None:
        """Refuse worlds that nobody has named."""
        if not self.path:
            raise UserInputError(f"map=barn needs map.path=<folder of BARN's worlds>: {_SOURCE}")

    def worlds(self) -> list[Path]:
        """Return the protocol's worlds that are in the folder, in the order of their numbers.

        Raises:
            UserInputError: there is none, or the folder does not exist.
        """
        folder = Path(self.path or "")
        if not folder.is_dir():
            raise UserInputError(f"map.path={folder} is no folder of BARN's worlds: {_SOURCE}")
        found = [path for number in WORLDS if (path := folder / f"world_{number}.world").is_file()]
        if not found:
            raise UserInputError(
                f"map.path={folder} holds none of the {len(WORLDS)} worlds world_0.world, world_6.world, .., "
                f"world_{WORLDS[-1]}.world: {_SOURCE}"
            )
        return found

    def files(self) -> FileMapSettings:
        """Return the same worlds as maps of files, with the protocol's start and goal.

        Raises:
            UserInputError: as :meth:`worlds`.
        """
        return FileMapSettings(
            path=tuple(path.as_posix() for path in self.worlds()),
            mapped=self.mapped,
            start=START,
            goal=GOAL,
            clearance_margin_m=self.clearance_margin_m,
            waypoint_clearance_m=self.waypoint_clearance_m,
        )


def world_number(world: Path) -> int:
    """Return the number of a world from its file's name.

    Example:
        >>> world_number(Path("worlds/world_120.world"))
        120
    """
    found = re.fullmatch(r"world_(\d+)", world.stem)
    if found is None:
        raise UserInputError(f"{world} is not called world_<number>.world, as BARN's worlds are")
    return int(found[1])


def optimal_time_s(world: Path) -> float:
    """Return the time in which the protocol's robot would drive a world's own path, from start to goal.

    Args:
        world: its file; ``path_<number>.npy`` lies beside it, or in ``path_files/`` there.

    Raises:
        UserInputError: there is no such path.
    """
    name = f"path_{world_number(world)}.npy"
    files = [folder / name for folder in (world.parent, world.parent / "path_files")]
    try:
        cells = np.load(next(file for file in files if file.is_file())).astype(np.float64)
        if cells.ndim != 2 or cells.shape[1] != 2 or not np.isfinite(cells).all():
            raise ValueError(f"its shape is {list(cells.shape)}, and a path has two finite numbers a cell")
    except StopIteration:
        raise UserInputError(f"{files[0]} is missing, and BARN's score needs it: {_SOURCE}") from None
    except (OSError, ValueError) as error:
        raise UserInputError(f"{name} beside {world} cannot be read ({error}): {_SOURCE}") from error
    points = np.vstack([START[:2], _PATH_CORNER + _PATH_CELL_M * cells, GOAL])
    return float(np.hypot(*np.diff(points, axis=0).T).sum()) / OPTIMAL_SPEED_M_PER_S


def score(success: bool, time_s: float, optimal_s: float, fastest: float = 4.0) -> float:
    """Return the score of a run: 0 without success, else optimal time by time, at least 1/8.

    Args:
        success: whether the goal was reached.
        time_s: in which it was.
        optimal_s: :func:`optimal_time_s`.
        fastest: multiple of the optimal time below which being faster earns nothing: 4 as the challenge began, 2 in its
            later years.

    Example:
        >>> score(True, 30.0, 5.0), score(True, 4.0, 5.0), score(True, 4.0, 5.0, 2.0), score(False, 4.0, 5.0)
        (0.16666666666666666, 0.25, 0.5, 0.0)
    """
    return optimal_s / min(max(time_s, fastest * optimal_s), 8.0 * optimal_s) if success else 0.0
