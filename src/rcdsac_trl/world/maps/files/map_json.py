"""Our own maps as JSON: what ``Map.to_json`` writes, or what someone wrote by hand."""

import difflib
import json
import math
from dataclasses import fields
from pathlib import Path
from typing import Any

from rcdsac_trl.errors import UserInputError
from rcdsac_trl.world.maps.files.floor_plan import FloorPlan
from rcdsac_trl.world.maps.shapes import FORMAT_VERSION, Map, map_of_values

# What a file by hand may leave out.
_DEFAULTS: dict[str, Any] = {"format": FORMAT_VERSION, "boxes": [], "cylinders": [], "movers": []}
_KEYS = ("format", "walls", "wall_thickness_m", *(field.name for field in fields(Map)))
_BOX = {"yaw": 0.0, "mapped": True}
_CYLINDER = {"mapped": True}
_WALL_M = 0.1


def read_map_json(path: Path, *, mapped: bool) -> FloorPlan:
    """Read one of our own maps.

    Beside the keys of :class:`~rcdsac_trl.world.maps.shapes.Map` it may have ``walls``, a list of segments [x0, y0, x1,
    y1], and ``wall_thickness_m``; only ``size_m`` must be there, a number or [width, height].
    docs/your-building.md has an example.

    Args:
        path: of the file.
        mapped: false: the planner knows nothing of it, whatever it says.

    Raises:
        UserInputError: the file is no such map.
    """
    try:
        values = json.loads(path.read_text(encoding="utf-8-sig"))
        if not isinstance(values, dict):
            raise ValueError("it holds no keys")
        _check_keys(values)
        extent_m = _extent_m(values["size_m"])
        map_ = map_of_values(_completed(values, path.stem, extent_m, mapped))
    except KeyError as error:
        raise UserInputError(f"{path} is no map: {error} is missing") from error
    except (ValueError, TypeError, AttributeError, RecursionError) as error:
        raise UserInputError(f"{path} is no map: {error}") from error
    return FloorPlan(
        map_.layout,
        map_.size_m,
        map_.boxes,
        map_.cylinders,
        map_.movers,
        (0.0, 0.0, 0.0),
        extent_m,
        map_.start,
        map_.goal,
    )


def _check_keys(values: dict[str, Any]) -> None:
    if strange := next((key for key in values if key not in _KEYS), None):
        near = difflib.get_close_matches(strange, _KEYS, n=1)
        raise ValueError(
            f"there is no key {strange}" + (f": did you mean {near[0]}?" if near else f", a map has {', '.join(_KEYS)}")
        )


def _extent_m(size_m: Any) -> tuple[float, float]:
    width_m, height_m = size_m if isinstance(size_m, list) else (size_m, size_m)
    return float(width_m), float(height_m)


def _completed(values: dict[str, Any], name: str, extent_m: tuple[float, float], mapped: bool) -> dict[str, Any]:
    """Return what :func:`~rcdsac_trl.world.maps.shapes.map_of_values` takes: a square, every value given."""
    thickness_m = values.pop("wall_thickness_m", _WALL_M)
    walls = [_wall(ends, thickness_m) for ends in values.pop("walls", [])]
    values = {"layout": name} | _DEFAULTS | values | {"size_m": max(extent_m)}
    values["boxes"] = [*_beside(*extent_m), *walls, *_filled(_BOX, values["boxes"])]
    values["cylinders"] = _filled(_CYLINDER, values["cylinders"])
    if not mapped:
        values["boxes"] = [box | {"mapped": False, "wall": False} for box in values["boxes"]]
        values["cylinders"] = [cylinder | {"mapped": False} for cylinder in values["cylinders"]]
    return values


def _filled(defaults: dict[str, Any], parts: Any) -> list[Any]:
    """Return parts with what they leave out; what is no part is left to whoever reads it."""
    return [defaults | part if isinstance(part, dict) else part for part in parts]


def _beside(width_m: float, height_m: float) -> list[dict[str, Any]]:
    """Return the box that fills what a square has beside a rectangle, if it has anything."""
    gap_m = 0.5 * abs(width_m - height_m)
    if gap_m == 0.0:
        return []
    half_m, middle_m = 0.5 * max(width_m, height_m), min(width_m, height_m) + gap_m
    across, along = {"x": middle_m, "half_x": gap_m}, {"y": half_m, "half_y": half_m}
    if width_m > height_m:
        across, along = {"y": middle_m, "half_y": gap_m}, {"x": half_m, "half_x": half_m}
    return [across | along | {"yaw": 0.0, "mapped": True, "wall": True}]


def _wall(ends: Any, thickness_m: float) -> dict[str, Any]:
    """Return the box of a wall; it is longer by half its thickness at both ends, so that corners close."""
    if not isinstance(ends, list) or len(ends) != 4:
        raise ValueError(f"the wall {ends} is not four numbers [x0, y0, x1, y1]")
    x0, y0, x1, y1 = map(float, ends)
    half = 0.5 * thickness_m
    return {
        "x": 0.5 * (x0 + x1),
        "y": 0.5 * (y0 + y1),
        "half_x": 0.5 * math.hypot(x1 - x0, y1 - y0) + half,
        "half_y": half,
        "yaw": math.atan2(y1 - y0, x1 - x0),
        "mapped": True,
        "wall": True,
    }
