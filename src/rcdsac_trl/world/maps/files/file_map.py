"""Maps from files: the settings they are drawn from, and the map of an index: the building, and what is put into it."""

import math
import os
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import lru_cache
from numbers import Real
from pathlib import Path
from typing import Any, get_args

import numpy as np

from rcdsac_trl.errors import UserInputError
from rcdsac_trl.seeding import stream
from rcdsac_trl.world.maps.clutter import ClutterSite
from rcdsac_trl.world.maps.files.floor_plan import FloorPlan, FreeFloor, free_cells, free_floor
from rcdsac_trl.world.maps.files.map_files import check_digests, map_files
from rcdsac_trl.world.maps.files.map_json import read_map_json
from rcdsac_trl.world.maps.files.map_server import Unknown, read_map_server
from rcdsac_trl.world.maps.files.movingai import read_movingai
from rcdsac_trl.world.maps.files.sdf_world import read_sdf_world
from rcdsac_trl.world.maps.geometry import CELL_M, ROBOT_RADIUS_M, segment_clearance
from rcdsac_trl.world.maps.grid_search import farthest_cell
from rcdsac_trl.world.maps.map_additions import check_additions, draw_movers
from rcdsac_trl.world.maps.map_checks import check_number
from rcdsac_trl.world.maps.shapes import CLEARANCE_MARGIN_M, WAYPOINT_CLEARANCE_M, Box, Cylinder, Map

_PLANS_KEPT = 64
# Steps over cells are up to this much longer than the way pulled tight.
_OCTILE_EXCESS = 1.09


@dataclass(frozen=True)
class FileMapSettings:
    """Which files maps are read from, and what is added; every field is a key of ``conf/map/file.yaml``.

    The map of index i is file i, and begins anew behind the last one; clutter and movers are another draw for each
    index and split.

    Attributes:
        path: a file, a folder of files, or several of either: YAML of ``map_server``, ``.map`` of MovingAI, ``.world``
            of Gazebo, ``.json`` of ours.
        sha256: what the files were when this was written, a line each as ``sha256sum`` prints it; None: whatever they
            are.
        unknown: what the unknown cells of a ``map_server`` map count as.
        cell_m: side of a cell of a MovingAI map, m.
        mapped: whether the planner knows what the files hold; else only the sensor shows it.
        start: where robots start, x, y in m and yaw in rad, in the file's own frame; None: drawn.
        goal: their first goal, likewise; None: drawn, as all that follow.
        unmapped_clutter_per_m2: pieces that the planner does not know, for each square metre of the floor that the
            robot can use; pieces that would cut it are left out.
        num_movers: how many obstacles walk, beside those that a map of ours has.
        mover_radius_m: smallest and largest radius of a mover, m.
        mover_speed_m_per_s: smallest and largest top speed of a mover, m/s.
        clearance_margin_m: what is kept free beyond the robot's radius, m.
        waypoint_clearance_m: clearance that waypoints keep where that costs little, m.
        detour_m: how far around the places that a piece of clutter takes a way past it may lead, m.
        yielding_fraction: share of the movers that stop for a robot in their way, in [0, 1].
        connected_share: of all the floor where the robot fits, the share that must be one connected part, in which
            starts and goals lie; less is refused.

    Raises:
        UserInputError: a value is outside its limits. The files are looked at when they are read, not here.
    """

    path: str | tuple[str, ...] | None = None
    sha256: tuple[str, ...] | None = None
    unknown: Unknown = "occupied"
    cell_m: float = 1.0
    mapped: bool = True
    start: tuple[float, float, float] | None = None
    goal: tuple[float, float] | None = None
    unmapped_clutter_per_m2: float = 0.0
    num_movers: int = 0
    mover_radius_m: tuple[float, float] = (0.2, 0.3)
    mover_speed_m_per_s: tuple[float, float] = (0.2, 0.6)
    clearance_margin_m: float = CLEARANCE_MARGIN_M
    waypoint_clearance_m: float = WAYPOINT_CLEARANCE_M
    detour_m: float = 0.5
    yielding_fraction: float = 1.0
    connected_share: float = 0.5

    def __post_init__(self) -> None:
        """Turn lists into tuples and refuse what is outside its limits."""
        for name in ("path", "sha256", "start", "goal", "mover_radius_m", "mover_speed_m_per_s"):
            if isinstance(value := getattr(self, name), Sequence) and not isinstance(value, str):
                object.__setattr__(self, name, tuple(value))
        object.__setattr__(self, "path", _as_text(self.path))
        paths = self.path if isinstance(self.path, tuple) else (self.path,)
        if not paths or not all(isinstance(path, str) and path for path in paths):
            raise UserInputError(
                "map.path names no map: give it a file (.yaml of map_server, .map, .world, .json), a folder, or a list"
            )
        if self.unknown not in get_args(Unknown):
            raise UserInputError(f"map.unknown={self.unknown} must be one of {', '.join(get_args(Unknown))}")
        check_number("map.cell_m", self.cell_m, 0.01, 10.0)
        for name, numbers in (("start", 3), ("goal", 2)):
            value = getattr(self, name)
            if value is not None and not _are_numbers(value, numbers):
                given = list(value) if isinstance(value, tuple) else value
                raise UserInputError(f"map.{name}={given} must be {numbers} numbers")
        check_number("map.unmapped_clutter_per_m2", self.unmapped_clutter_per_m2, 0.0, 1.0)
        check_additions(self, "map.")
        check_number("map.connected_share", self.connected_share, 0.0, 1.0)

    def clearance_m(self, robot_radius_m: float) -> float:
        """Return what a place must be clear of everything to be free for a robot, m."""
        return robot_radius_m + self.clearance_margin_m


def _as_text(path: object) -> Any:
    """Return paths as text, one or several; what is none stays as it is."""
    if isinstance(path, tuple):
        return tuple(_as_text(each) for each in path)
    return os.fspath(path) if isinstance(path, os.PathLike) else path


def _are_numbers(value: object, count: int) -> bool:
    return (
        isinstance(value, tuple)
        and len(value) == count
        and all(isinstance(number, Real) and math.isfinite(number) for number in value)
    )


def file_map(
    settings: FileMapSettings, split: str, seed: int, index: int, robot_radius_m: float = ROBOT_RADIUS_M
) -> Map:
    """Return the map of an index: a file's building, with the clutter and the movers of that index.

    Args:
        settings: which files, and what is added.
        split: a part of the random stream's purpose.
        seed: the root seed, at least 0.
        index: the map's number within the split, at least 0.
        robot_radius_m: circumradius of the robot that drives there.

    Raises:
        UserInputError: a file cannot be read, has changed, or cannot serve this robot.
    """
    files = map_files(settings.path)
    building, floor = read_building(settings, files[index % len(files)], robot_radius_m)
    rng = stream(seed, f"file map/{split}", index)
    pieces = _clutter(settings, building, floor, robot_radius_m, rng)
    movers = draw_movers(settings, rng)
    return replace(
        building,
        boxes=(*building.boxes, *(piece for piece in pieces if isinstance(piece, Box))),
        cylinders=(*building.cylinders, *(piece for piece in pieces if isinstance(piece, Cylinder))),
        movers=(*building.movers, *movers),
    )


def _clutter(
    settings: FileMapSettings, building: Map, floor: FreeFloor, robot_radius_m: float, rng: np.random.Generator
) -> list[Box | Cylinder]:
    count = round(settings.unmapped_clutter_per_m2 * floor.area_m2)
    if not count:
        return []
    site = ClutterSite(
        list(building.boxes),
        building.size_m,
        settings.clearance_m(robot_radius_m),
        settings.detour_m,
        standing=building.cylinders,
        floor=floor.connected,
        kept_free=[place[:2] for place in (building.start, building.goal) if place is not None],
    )
    site.fill(count, False, rng)
    return site.pieces


@lru_cache(maxsize=_PLANS_KEPT)
def read_building(
    settings: FileMapSettings, file: Path, robot_radius_m: float = ROBOT_RADIUS_M
) -> tuple[Map, FreeFloor]:
    """Read a file as a map without anything added, and see where the robot fits.

    Args:
        settings: how it is read.
        file: one of :func:`~rcdsac_trl.world.maps.files.map_files.map_files`.
        robot_radius_m: circumradius of the robot that drives there.

    Raises:
        UserInputError: as :func:`file_map`.
    """
    check_digests(settings.sha256, [file])
    plan = _plan(settings, file)
    start, goal = plan.start, plan.goal
    if settings.start is not None:
        start = *plan.to_map_frame(*settings.start[:2]), math.remainder(settings.start[2] - plan.frame[2], math.tau)
    if settings.goal is not None:
        goal = plan.to_map_frame(*settings.goal)
    building = Map(
        layout=plan.name,
        size_m=plan.size_m,
        boxes=plan.boxes,
        cylinders=plan.cylinders,
        movers=plan.movers,
        clearance_margin_m=settings.clearance_margin_m,
        waypoint_clearance_m=settings.waypoint_clearance_m,
        start=start,
        goal=goal,
    )
    clearance_m = settings.clearance_m(robot_radius_m)
    floor = free_floor(building, clearance_m)
    _check_floor(settings, file, building, floor, clearance_m)
    return building, floor


def _plan(settings: FileMapSettings, file: Path) -> FloorPlan:
    """Read a file by the format that its name says."""
    match file.suffix.lower():
        case ".yaml" | ".yml":
            return read_map_server(file, settings.unknown, mapped=settings.mapped)
        case ".map":
            return read_movingai(file, settings.cell_m, mapped=settings.mapped)
        case ".world" | ".sdf":
            places = [place[:2] for place in (settings.start, settings.goal) if place is not None]
            return read_sdf_world(file, places, mapped=settings.mapped)
        case _:
            return read_map_json(file, mapped=settings.mapped)


def _check_floor(settings: FileMapSettings, file: Path, building: Map, floor: FreeFloor, need_m: float) -> None:
    """Refuse islands, a map that is open at its edge, and a start or goal where the robot does not fit."""
    if floor.share < settings.connected_share:
        raise UserInputError(
            f"{file}: the floor where this robot fits, {floor.area_m2 / floor.share:.0f} m², is {floor.parts} parts "
            f"that no way connects, and the largest is {100 * floor.share:.0f} % of it, below map.connected_share="
            f"{settings.connected_share:g}: close what is no part of the building, open its doors, or lower that key"
        )
    edge = floor.connected.copy()
    edge[1:-1, 1:-1] = False
    if edge.any():
        row, column = np.argwhere(edge)[0]
        raise UserInputError(
            f"{file} is open at its edge, as at x={CELL_M * column:.1f}, y={CELL_M * row:.1f} m: put walls around it"
        )
    for name in ("start", "goal"):
        if (place := getattr(building, name)) is not None:
            _check_place(settings, file, name, place, building, floor, need_m)


def _check_place(
    settings: FileMapSettings,
    file: Path,
    name: str,
    place: Sequence[float],
    building: Map,
    floor: FreeFloor,
    need_m: float,
) -> None:
    x, y = place[:2]
    row, column = int(y / CELL_M), int(x / CELL_M)
    side = len(floor.connected)
    given = list(getattr(settings, name) or place)
    if not (0 <= row < side and 0 <= column < side):
        raise UserInputError(f"{file}: map.{name}={given} lies outside of the map: give a place on its floor")
    clearance_m = float(segment_clearance(x, y, x, y, *building.solids(), need_m))
    if clearance_m < need_m:
        raise UserInputError(
            f"{file}: map.{name}={given} is {clearance_m:.2f} m from what stands there, "
            f"and this robot needs {need_m:g} m"
        )
    if not floor.connected[max(row - 1, 0) : row + 2, max(column - 1, 0) : column + 2].any():
        raise UserInputError(
            f"{file}: map.{name}={given} is not on the largest connected floor, {floor.area_m2:.0f} m² "
            "large: move it there, or drive a smaller robot"
        )


def check_file_maps(settings: FileMapSettings, min_path_m: float, robot_radius_m: float = ROBOT_RADIUS_M) -> None:
    """Read all files and refuse those in which goals cannot be drawn, the first or the next.

    Args:
        settings: which files.
        min_path_m: shortest way from a start to its goal, m.
        robot_radius_m: circumradius of the robot that drives there.

    Raises:
        UserInputError: as :func:`file_map`, or a floor is too small.
    """
    files = map_files(settings.path)
    check_digests(settings.sha256, files, all_of_them=True)
    for file in files:
        building, floor = read_building(settings, file, robot_radius_m)
        _check_movers(settings, file, building)
        # The ends of the longest way: from any place one of them is at least half of it away.
        end, _ = farthest_cell(floor.connected, int(np.flatnonzero(floor.connected)[0]))
        _, length = farthest_cell(floor.connected, end)
        surely_m = 0.5 * length * CELL_M / _OCTILE_EXCESS
        if surely_m < min_path_m:
            raise UserInputError(
                f"{file}: the connected floor where this robot fits is {floor.area_m2:.1f} m² large and "
                f"{length * CELL_M:.1f} m long, so from its middle goals may be only {surely_m:.1f} m away, and "
                f"task.min_path_m={min_path_m:g}: is the side of a cell right? Else lower that key to "
                f"{0.1 * int(10 * surely_m):.1f}"
            )


def _check_movers(settings: FileMapSettings, file: Path, building: Map) -> None:
    """Refuse movers that fit nowhere."""
    radii_m = [mover.radius for mover in building.movers] + [settings.mover_radius_m[1]] * (settings.num_movers > 0)
    if not radii_m:
        return
    need_m = max(radii_m) + settings.clearance_margin_m
    if not free_cells(building, need_m).any():
        raise UserInputError(
            f"{file}: no place is {need_m:g} m clear of everything, which movers of {max(radii_m):g} m need: make them "
            "smaller (map.mover_radius_m), or leave them out"
        )


def described(settings: FileMapSettings, file: Path) -> str:
    """Put a file's map, and what the paper's robot can use of it, into a sentence."""
    building, floor = read_building(settings, file)
    pieces = f"{len(building.boxes)} boxes and {len(building.cylinders)} cylinders"
    return (
        f"{file}: a square of {building.size_m:.1f} m with {pieces}; the paper's robot fits on "
        f"{floor.area_m2:.0f} m², {100 * floor.share:.1f} % of its floor, connected"
    )
