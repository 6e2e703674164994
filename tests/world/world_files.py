"""Small maps of every format of others, for tests."""

from collections.abc import Sequence
from pathlib import Path

import numpy as np
import yaml
from numpy.typing import NDArray
from PIL import Image

OCCUPIED, UNKNOWN, FREE = 0, 205, 254
"""Values of the pixels that map_server's own saver writes."""


def room(height: int, width: int) -> NDArray[np.uint8]:
    """Return the pixels of an empty room with walls a cell thick."""
    cells = np.full((height, width), FREE, np.uint8)
    cells[[0, -1]] = OCCUPIED
    cells[:, [0, -1]] = OCCUPIED
    return cells


def write_map_server(
    path: Path, cells: NDArray, *, suffix: str = "pgm", resolution: object = 0.1, **changes: object
) -> Path:
    """Write a map of map_server, its first line of pixels at the top; return the path of its YAML file."""
    image = path.with_suffix(f".{suffix}")
    header = {
        "image": image.name,
        "resolution": resolution,
        "origin": [0.0, 0.0, 0.0],
        "negate": 0,
        "occupied_thresh": 0.65,
        "free_thresh": 0.25,
    }
    if "image" not in changes:
        Image.fromarray(cells.astype(np.uint8)).save(image)
    path.write_text(yaml.safe_dump({**header, **changes}))
    return path


def write_world(path: Path, cylinders: Sequence[tuple[float, float, float]], roll: float = 0.0) -> Path:
    """Write a world of Gazebo with cylinders (x, y, radius), a ground, and a saved state with other poses."""
    ground = "<model name='ground'><link><collision><geometry><plane/></geometry></collision></link></model>"
    models = [
        f"<model name='cylinder_{number}'><pose frame=''>{x} {y} 0.5 {roll} 0 0</pose><link name='link'><collision>"
        f"<geometry><cylinder><radius>{radius}</radius><length>1</length></cylinder></geometry></collision></link></model>"
        for number, (x, y, radius) in enumerate(cylinders)
    ]
    state = "<state><model name='cylinder_0'><pose>99 99 0 0 0 0</pose></model></state>"
    path.write_text(f"<sdf version='1.6'><world name='default'>{ground}{''.join(models)}{state}</world></sdf>")
    return path
