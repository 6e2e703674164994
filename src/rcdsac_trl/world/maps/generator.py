"""Maps from a seed: the settings they are drawn from, and the generator.

A map is built piece by piece and checked after each, so its guarantee holds by construction: the places the
robot can take with its margin are one connected component, and around every piece that the planner does not
know there is a way past it nearby.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal, get_args

import numpy as np

from rcdsac_trl.errors import UserInputError
from rcdsac_trl.seeding import stream
from rcdsac_trl.world.maps.clutter import ClutterSite
from rcdsac_trl.world.maps.geometry import CELL_M, ROBOT_RADIUS_M
from rcdsac_trl.world.maps.grid_search import label_components
from rcdsac_trl.world.maps.layouts import build_walls
from rcdsac_trl.world.maps.map_additions import check_additions, draw_movers
from rcdsac_trl.world.maps.map_checks import check_number, check_range
from rcdsac_trl.world.maps.shapes import CLEARANCE_MARGIN_M, WAYPOINT_CLEARANCE_M, Box, Cylinder, Map, Mover

__all__ = ["LAYOUTS", "SPLITS", "Box", "Cylinder", "Map", "MapSettings", "Mover", "Split", "generate_map"]

Split = Literal["train", "validation", "evaluation"]
"""Which of the three disjoint families of maps is meant."""

SPLITS: tuple[str, ...] = get_args(Split)
LAYOUTS = ("rooms", "clutter", "mixed")
GENERATOR_VERSION = 1
"""Version of the generator: within one version, equal settings, split, seed and index give equal maps."""

_OPEN_CROWDING = 1.5  # without walls in the way, it takes more clutter to make driving as hard
_MAX_BUILDINGS = 100


@dataclass(frozen=True)
class MapSettings:
    """What maps are drawn from; every field is a key of ``conf/map/*.yaml``.

    Attributes:
        version: the generator's version, :data:`GENERATOR_VERSION`.
        size_m: side of the square map, m.
        layouts: kinds of places, drawn with equal probability; of :data:`LAYOUTS`.
        corridor_width_m: smallest and largest width of a corridor between its walls, m.
        door_width_m: smallest and largest width of a door, m.
        clutter_per_m2: pieces of clutter per square metre of the map, and half as many again in open places
            (layout ``"clutter"``); pieces that would cut the free space are left out.
        mapped_fraction: share of the clutter that the planner knows, in [0, 1].
        num_movers: how many obstacles walk.
        mover_radius_m: smallest and largest radius of a mover, m.
        mover_speed_m_per_s: smallest and largest top speed of a mover, m/s.
        clearance_margin_m: what is kept free beyond the robot's radius, m.
        waypoint_clearance_m: clearance that waypoints keep where that costs little, m; the less, the closer
            they lead around corners.
        detour_m: how far around the places that an unmapped piece takes a way past it may lead, m; the less,
            the shorter the detours.
        yielding_fraction: share of the movers that stop for a robot in their way, in [0, 1].
        furniture_per_m2: tables and chairs per square metre, thin legs all of them; the planner knows none.

    Raises:
        UserInputError: a value is outside its limits.
    """

    version: int = GENERATOR_VERSION
    size_m: float = 20.0
    layouts: tuple[str, ...] = LAYOUTS
    corridor_width_m: tuple[float, float] = (1.2, 2.4)
    door_width_m: tuple[float, float] = (0.9, 1.6)
    clutter_per_m2: float = 0.07
    mapped_fraction: float = 0.5
    num_movers: int = 4
    mover_radius_m: tuple[float, float] = (0.2, 0.3)
    mover_speed_m_per_s: tuple[float, float] = (0.2, 0.6)
    clearance_margin_m: float = CLEARANCE_MARGIN_M
    waypoint_clearance_m: float = WAYPOINT_CLEARANCE_M
    detour_m: float = 0.5
    yielding_fraction: float = 1.0
    furniture_per_m2: float = 0.0

    def __post_init__(self) -> None:
        """Turn the lists of a YAML file into tuples and refuse what no map can be made from."""
        for name in ("layouts", "corridor_width_m", "door_width_m", "mover_radius_m", "mover_speed_m_per_s"):
            value = getattr(self, name)
            if isinstance(value, str) or not isinstance(value, Sequence):
                raise UserInputError(f"{name} is {value!r} but must be a list; write it in brackets")
            object.__setattr__(self, name, tuple(value))
        if self.version != GENERATOR_VERSION:
            raise UserInputError(
                f"map version is {self.version!r} but this is version {GENERATOR_VERSION} of the generator; "
                f"set version to {GENERATOR_VERSION}"
            )
        unknown = [name for name in self.layouts if name not in LAYOUTS]
        if unknown or not self.layouts:
            raise UserInputError(f"layouts is {list(self.layouts)} but must name at least one of {', '.join(LAYOUTS)}")
        check_additions(self)
        check_number("size_m", self.size_m, 10.0, 60.0)
        check_number("clutter_per_m2", self.clutter_per_m2, 0.0, 1.0)
        check_number("mapped_fraction", self.mapped_fraction, 0.0, 1.0)
        check_number("furniture_per_m2", self.furniture_per_m2, 0.0, 0.5)
        passage_m = _passage_m(ROBOT_RADIUS_M, self.clearance_margin_m)
        check_range("corridor_width_m", self.corridor_width_m, passage_m, 5.0)
        check_range("door_width_m", self.door_width_m, passage_m, 2.0)


def _passage_m(robot_radius_m: float, margin_m: float) -> float:
    """Return how wide a passage must be: narrower, and the grid might have no row of cells through it."""
    return 2 * (robot_radius_m + margin_m) + CELL_M


def check_robot_fits(settings: MapSettings, robot_radius_m: float, robot: str) -> None:
    """Refuse a robot that is too large for the passages of some maps.

    Args:
        settings: of the maps.
        robot_radius_m: circumradius of the robot.
        robot: its name.

    Raises:
        UserInputError: naming the narrowest passage.
    """
    passage_m = _passage_m(robot_radius_m, settings.clearance_margin_m)
    for name in ("door_width_m", "corridor_width_m"):
        if (narrowest := getattr(settings, name)[0]) < passage_m:
            raise UserInputError(
                f"robot={robot} reaches {robot_radius_m:.3g} m from its centre and needs passages of {passage_m:.3g} "
                f"m, map.{name} begins at {narrowest:g} m: raise it, or choose a smaller robot"
            )


def generate_map(
    settings: MapSettings, split: Split, seed: int, index: int, robot_radius_m: float = ROBOT_RADIUS_M
) -> Map:
    """Generate one map.

    The free space for the robot's radius plus ``settings.clearance_margin_m`` is one connected component on
    the planner's grid, so every start reaches every goal; and near every piece that the planner does not
    know, what was connected without the piece is connected with it.

    Args:
        settings: what to draw from.
        split: which family; it is a part of the random stream's purpose, so the families share no map.
        seed: the root seed, at least 0.
        index: the map's number within the family, at least 0.
        robot_radius_m: circumradius of the robot that is to get about.

    Raises:
        UserInputError: the split is unknown, or no connected building was found.

    Example:
        >>> map = generate_map(MapSettings(num_movers=2), "validation", seed=0, index=3)
        >>> map == generate_map(MapSettings(num_movers=2), "validation", seed=0, index=3)
        True
        >>> map == generate_map(MapSettings(num_movers=2), "train", seed=0, index=3)
        False
    """
    if split not in SPLITS:
        raise UserInputError(f"split is {split!r} but must be one of {', '.join(SPLITS)}")
    rng = stream(seed, f"map/{split}", index)
    layout = settings.layouts[rng.integers(len(settings.layouts))]
    walls, site = _connected_building(settings, layout, robot_radius_m, rng)
    crowding = _OPEN_CROWDING if layout == "clutter" else 1.0
    count = round(settings.clutter_per_m2 * crowding * settings.size_m**2)
    num_mapped = round(count * settings.mapped_fraction)
    site.fill(num_mapped, True, rng)
    site.fill(count - num_mapped, False, rng)
    site.furnish(round(settings.furniture_per_m2 * settings.size_m**2), rng)
    movers = draw_movers(settings, rng)
    return Map(
        layout=layout,
        size_m=float(settings.size_m),
        boxes=(*walls, *(piece for piece in site.pieces if isinstance(piece, Box))),
        cylinders=tuple(piece for piece in site.pieces if isinstance(piece, Cylinder)),
        movers=movers,
        clearance_margin_m=float(settings.clearance_margin_m),
        waypoint_clearance_m=float(settings.waypoint_clearance_m),
    )


def _connected_building(
    settings: MapSettings, layout: str, robot_radius_m: float, rng: np.random.Generator
) -> tuple[list[Box], ClutterSite]:
    """Draw buildings until one is connected; a wall too short for its only door is rare."""
    for _ in range(_MAX_BUILDINGS):
        walls = build_walls(layout, settings.size_m, settings.corridor_width_m, settings.door_width_m, rng)
        clearance_m = robot_radius_m + settings.clearance_margin_m
        site = ClutterSite(walls, settings.size_m, clearance_m, settings.detour_m)
        if label_components(site.free)[1] == 1:
            return walls, site
    raise UserInputError(
        f"no connected building of layout {layout!r} was found in {_MAX_BUILDINGS} tries; "
        "lower door_width_m or raise size_m"
    )
