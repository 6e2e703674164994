"""Maps of ROS's ``map_server``: a YAML file that says what the cells of an image mean (nav2_map_server, ``map_io``)."""

import contextlib
from collections.abc import Mapping
from pathlib import Path
from typing import Any, Literal

import numpy as np
import yaml
from numpy.typing import NDArray
from PIL import Image, UnidentifiedImageError

from rcdsac_trl.errors import UserInputError
from rcdsac_trl.robot.planar import MOST_YAW_RAD
from rcdsac_trl.world.maps.files.floor_plan import FloorPlan, plan_of_cells

Unknown = Literal["occupied", "free"]

_MODES = ("trinary", "scale", "raw")
# Smaller cells are no map of a building, larger ones leave no passage for a robot.
_CELL_LIMITS_M = 0.005, 1.0
# A value of `mode: raw` above this many percent is unknown.
_RAW_FULL = 100.0
_MOST_PIXELS = 100_000_000


def image_of(path: Path) -> Path:
    """Return the image that a map's YAML file names, which lies relative to it.

    Raises:
        UserInputError: the file cannot be read, or names none.
    """
    name = _header(path).get("image")
    if not isinstance(name, str) or not name:
        raise UserInputError(f"{path}: image is {name!r}, not the name of a PGM or PNG file")
    image = path.parent / name
    if not image.is_file():
        raise UserInputError(f"{path}: its image {image} does not exist: bring it there, or correct image")
    return image


def read_map_server(path: Path, unknown: Unknown, *, mapped: bool) -> FloorPlan:
    """Read a map of ``map_server``.

    A cell's occupancy is its darkness, from 0 to 1, its lightness with ``negate``. Above ``occupied_thresh`` it is
    occupied, below ``free_thresh`` free. In between it is unknown in the mode ``trinary``; in ``scale`` and ``raw`` it
    is occupied from the middle of the two thresholds on, and unknown where the image is transparent (``scale``) or the
    value is above 100 (``raw``, whose values are percent).

    Args:
        path: of the YAML file.
        unknown: what unknown cells count as.
        mapped: whether the planner knows what stands there.

    Raises:
        UserInputError: a file is missing or damaged, or a value is outside its limits.
    """
    header = _header(path)
    occupied_at = _number(path, header, "occupied_thresh", 0.65, 0.0, 1.0)
    free_at = _number(path, header, "free_thresh", 0.25, 0.0, 1.0)
    if free_at > occupied_at:
        raise UserInputError(f"{path}: free_thresh={free_at:g} is above occupied_thresh={occupied_at:g}: swap them")
    mode = header.get("mode", "trinary")
    if mode not in _MODES:
        raise UserInputError(f"{path}: mode={mode} is unknown: it must be one of {', '.join(_MODES)}")
    negate = bool(_number(path, header, "negate", 0, 0, 1))
    cell_m = _number(path, header, "resolution", None, *_CELL_LIMITS_M)
    origin = header.get("origin")
    if not isinstance(origin, list) or len(origin) != 3:
        raise UserInputError(f"{path}: origin is {origin!r}, not three numbers [x, y, yaw]")
    x, y, yaw = (_number(path, {"origin": value}, "origin", None, -1e6, 1e6) for value in origin)
    if abs(yaw) > MOST_YAW_RAD:
        raise UserInputError(f"{path}: the yaw of origin, {yaw:g}, is more than two turns: give radians")
    occupancy = _occupancy(image_of(path), mode, negate)
    between = np.isnan(occupancy) if mode != "trinary" else np.isnan(occupancy) | (occupancy >= free_at)
    occupied = occupancy > occupied_at if mode == "trinary" else occupancy > 0.5 * (free_at + occupied_at)
    if unknown == "occupied":
        occupied |= between
    # An image begins with its upper line, a map with its lowest.
    return plan_of_cells(path.stem, occupied[::-1], cell_m, (x, y, yaw), mapped=mapped)


def _header(path: Path) -> Mapping[str, Any]:
    try:
        header = yaml.safe_load(path.read_text(encoding="utf-8"))
    except (OSError, UnicodeDecodeError, RecursionError, yaml.YAMLError) as error:
        raise UserInputError(f"{path} cannot be read as YAML ({' '.join(str(error).split())})") from error
    if not isinstance(header, Mapping):
        raise UserInputError(f"{path} holds no keys: a map's YAML file has image, resolution and origin")
    return header


def _number(path: Path, header: Mapping[str, Any], key: str, default: float | None, low: float, high: float) -> float:
    value = header.get(key, default)
    if isinstance(value, str):  # as map_server does; PyYAML takes 5e-2 for text
        with contextlib.suppress(ValueError):
            value = float(value)
    # The comparison is false for NaN too.
    if not isinstance(value, int | float) or not low <= value <= high:
        raise UserInputError(f"{path}: {key}={value} must be a number from {low:g} to {high:g}")
    return float(value)


def _occupancy(path: Path, mode: str, negate: bool) -> NDArray[np.float64]:
    """Return the occupancy of each pixel, float64 [lines, columns]; NaN where an image says that nothing is known."""
    try:
        with Image.open(path) as image:
            if image.width * image.height > _MOST_PIXELS:
                raise UserInputError(f"{path} has {image.width} x {image.height} pixels, {_MOST_PIXELS:,} are the most")
            depth = 65535.0 if image.mode.startswith("I") else 255.0
            simple = image if image.mode in ("L", "LA", "RGB", "RGBA", "I", "I;16") else image.convert(_plain(image))
            pixels = np.asarray(simple, dtype=np.float64) * (255.0 / depth)
    except (OSError, UnidentifiedImageError, ValueError, Image.DecompressionBombError) as error:
        raise UserInputError(f"{path} cannot be read as an image ({error})") from error
    if pixels.ndim == 2:
        pixels = pixels[..., None]
    alpha = pixels[..., -1] if pixels.shape[-1] in (2, 4) else None
    # As map_server does, which has always averaged alpha in with the colours where the mode is trinary.
    value = (pixels if alpha is None or mode == "trinary" else pixels[..., :-1]).mean(axis=-1)
    if mode == "raw":
        value = 255.0 - value if negate else value
        return np.where(value > _RAW_FULL, np.nan, value / _RAW_FULL)
    occupancy = (value if negate else 255.0 - value) / 255.0
    return occupancy if alpha is None or mode == "trinary" else np.where(alpha < 1.0, np.nan, occupancy)


def _plain(image: Image.Image) -> str:
    """Name the mode that an image of few colours is turned into."""
    return "RGBA" if "transparency" in image.info or image.mode == "PA" else "RGB" if image.mode == "P" else "L"
