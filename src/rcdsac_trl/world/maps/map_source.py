"""Where maps come from: the generator, several settings of it, or files, behind one function."""

from dataclasses import replace

from rcdsac_trl.world.maps.files.file_map import FileMapSettings, check_file_maps, file_map
from rcdsac_trl.world.maps.files.map_files import digests, map_files
from rcdsac_trl.world.maps.generator import MapSettings, Split, generate_map
from rcdsac_trl.world.maps.geometry import ROBOT_RADIUS_M
from rcdsac_trl.world.maps.map_mixture import MapMixture
from rcdsac_trl.world.maps.shapes import Map

MapSource = MapSettings | FileMapSettings | MapMixture
"""Settings that maps are made from."""


def make_map(source: MapSource, split: Split, seed: int, index: int, robot_radius_m: float = ROBOT_RADIUS_M) -> Map:
    """Return a map; equal arguments, and equal files, give equal maps.

    Args:
        source: what from.
        split: which of the disjoint families.
        seed: the root seed, at least 0.
        index: the map's number within the family, at least 0.
        robot_radius_m: circumradius of the robot that drives there.

    Raises:
        UserInputError: as :func:`~rcdsac_trl.world.maps.generator.generate_map` and
            :func:`~rcdsac_trl.world.maps.files.file_map.file_map`.
    """
    if isinstance(source, FileMapSettings):
        return file_map(source, split, seed, index, robot_radius_m)
    if isinstance(source, MapMixture):
        source = source.families[source.family_of(split, seed, index)]
    return generate_map(source, split, seed, index, robot_radius_m)


def sources_of(source: MapSource) -> list[MapSettings | FileMapSettings]:
    """List the settings that maps are made from; of a mixture, those of all its sets."""
    return list(source.families.values()) if isinstance(source, MapMixture) else [source]


def with_digests(source: MapSource) -> MapSource:
    """Return settings that hold what their files are, unless they do already; generated maps have none.

    Raises:
        UserInputError: a file cannot be read.
    """
    if isinstance(source, FileMapSettings) and source.sha256 is None:
        return replace(source, sha256=digests(map_files(source.path)))
    return source


def check_maps(source: MapSource, min_path_m: float, robot_radius_m: float = ROBOT_RADIUS_M) -> None:
    """Refuse files that maps cannot be made from, before anything is driven; generated maps always serve.

    Args:
        source: what maps are made from.
        min_path_m: shortest way from a start to its goal, m.
        robot_radius_m: circumradius of the robot that drives there.

    Raises:
        UserInputError: naming the file, and numbers.
    """
    if isinstance(source, FileMapSettings):
        check_file_maps(source, min_path_m, robot_radius_m)
