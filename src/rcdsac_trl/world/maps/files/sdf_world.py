"""Worlds of Gazebo (SDF) in which upright cylinders stand, as those of BARN do (Perille et al., 2020)."""

import math
from collections.abc import Sequence
from pathlib import Path
from xml.etree import ElementTree

from rcdsac_trl.errors import UserInputError
from rcdsac_trl.world.maps.files.floor_plan import BORDER_M, FloorPlan, enclosed
from rcdsac_trl.world.maps.shapes import MAX_SIZE_M, Cylinder

AROUND_CYLINDERS_M = 0.5
"""Floor around the outermost cylinders: less than a robot needs to drive around them."""
AROUND_PLACES_M = 2.0
"""Floor around a start and a goal."""

_UPRIGHT_RAD = 1e-3
# Models of Gazebo's own that nearly every world includes.
_NO_OBSTACLES = ("ground_plane", "sun")


def read_sdf_world(path: Path, places: Sequence[tuple[float, float]], *, mapped: bool) -> FloorPlan:
    """Read the cylinders of a world; the ground is left out, and so is the state that a simulation was saved in.

    Args:
        path: of the file.
        places: start and goal, in the world's frame, m; the floor is made large enough for them.
        mapped: whether the planner knows the cylinders.

    Raises:
        UserInputError: the file is no world, or something else stands in it.
    """
    try:
        world = ElementTree.parse(path).getroot().find("world")
    except ElementTree.ParseError as error:
        raise UserInputError(f"{path} cannot be read as SDF ({error})") from error
    if world is None:
        raise UserInputError(f"{path} holds no <world>")
    _refuse_includes(path, world)
    circles = [circle for model in world.findall("model") for circle in _circles(path, model)]
    if not circles:
        raise UserInputError(f"{path}: no upright cylinder stands in it, and only those can be read")
    spans = [
        (x - r - AROUND_CYLINDERS_M, y - r - AROUND_CYLINDERS_M, x + r + AROUND_CYLINDERS_M, y + r + AROUND_CYLINDERS_M)
        for x, y, r in circles
    ]
    spans += [(x - AROUND_PLACES_M, y - AROUND_PLACES_M, x + AROUND_PLACES_M, y + AROUND_PLACES_M) for x, y in places]
    low_x, low_y = (min(span[axis] for span in spans) for axis in (0, 1))
    high_x, high_y = (max(span[axis] for span in spans) for axis in (2, 3))
    extent_m = high_x - low_x, high_y - low_y
    if max(extent_m) + 2 * BORDER_M > MAX_SIZE_M:
        raise UserInputError(
            f"{path} is {extent_m[0]:.1f} x {extent_m[1]:.1f} m, and maps have at most {MAX_SIZE_M:g} m"
        )
    corner_x, corner_y = low_x - BORDER_M, low_y - BORDER_M
    cylinders = [Cylinder(x - corner_x, y - corner_y, radius, mapped) for x, y, radius in circles]
    return enclosed(path.stem, extent_m, [], cylinders, (corner_x, corner_y, 0.0))


def _refuse_includes(path: Path, world: ElementTree.Element) -> None:
    """Refuse what lies in other files, but for what nobody collides with."""
    for include in world.iter("include"):
        uri = include.findtext("uri", "").strip()
        if uri.rstrip("/").rpartition("/")[2] not in _NO_OBSTACLES:
            raise UserInputError(f"{path} includes {uri!r}, which is not read: put its cylinders here, or take it out")


def _circles(path: Path, model: ElementTree.Element) -> list[tuple[float, float, float]]:
    """Return x, y and radius of a model's cylinders, m."""
    found = []
    if model.find("model") is not None:
        raise UserInputError(f"{path}: the model {model.get('name')} holds another one, which is not read: take it out")
    x, y, *turn = _pose(path, model)
    for collision in model.iter("collision"):
        shapes = [shape.tag for geometry in collision.findall("geometry") for shape in geometry]
        if shapes == ["plane"]:
            continue
        inner = [_pose(path, element) for link in model.findall("link") for element in (link, collision)]
        if shapes != ["cylinder"] or max(map(abs, turn[:2])) > _UPRIGHT_RAD or any(any(pose) for pose in inner):
            raise UserInputError(
                f"{path}: of the model {model.get('name')} only an upright cylinder at the model's own pose can be "
                f"read, and it has {' and '.join(shapes) or 'nothing'}: take it out"
            )
        radius = collision.findtext("geometry/cylinder/radius", "")
        radius_m = _numbers(path, radius, 1)[0]
        if not radius_m > 0.0:
            raise UserInputError(f"{path}: the radius of {model.get('name')} is {radius_m:g}, and must be above 0")
        found.append((x, y, radius_m))
    return found


def _pose(path: Path, element: ElementTree.Element) -> list[float]:
    """Return x, y, z, roll, pitch and yaw without z."""
    pose = element.find("pose")
    if pose is None:
        return [0.0] * 5
    if beside := {pose.get(key) for key in ("relative_to", "frame")} - {None, "", "world"}:
        raise UserInputError(f"{path}: a pose is relative to {beside.pop()!r}, which is not read: give it in the world")
    x, y, _, *turn = _numbers(path, pose.text or "", 6)
    return [x, y, *turn]


def _numbers(path: Path, text: str, count: int) -> list[float]:
    try:
        values = [float(word) for word in text.split()]
    except ValueError:
        values = []
    if len(values) != count or not all(map(math.isfinite, values)):
        raise UserInputError(f"{path}: {text!r} must be {count} numbers")
    return values
