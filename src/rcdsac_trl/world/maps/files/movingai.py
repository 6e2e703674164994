"""Maps of MovingAI, text with a letter a cell (Sturtevant, 2012, "Benchmarks for Grid-Based Pathfinding")."""

from pathlib import Path

import numpy as np

from rcdsac_trl.errors import UserInputError
from rcdsac_trl.world.maps.files.floor_plan import FloorPlan, plan_of_cells

_FREE = b".GS"  # floor, floor, swamp
_OCCUPIED = b"@OTW"  # out of bounds, out of bounds, trees, water


def read_movingai(path: Path, cell_m: float, *, mapped: bool) -> FloorPlan:
    """Read a map of the MovingAI benchmarks.

    Args:
        path: of the file.
        cell_m: side of a cell, m, which the file does not say.
        mapped: whether the planner knows what stands there.

    Raises:
        UserInputError: the file is no such map.
    """
    lines = path.read_bytes().split(b"\n")
    lines = [line.rstrip(b"\r") for line in lines]
    header = {words[0]: words[-1] for line in lines[:4] if (words := line.split())}
    try:
        rows, columns = int(header[b"height"]), int(header[b"width"])
        first = lines.index(b"map") + 1
    except (KeyError, ValueError) as error:
        raise UserInputError(
            f"{path} is no map of MovingAI, which begins with the lines type, height, width and map"
        ) from error
    grid = [line for line in lines[first:] if line]
    lengths = {len(line) for line in grid}
    if len(grid) != rows or lengths != {columns}:
        found = f"{len(grid)} lines" + (f" of {' or '.join(map(str, sorted(lengths)))} cells" if grid else "")
        raise UserInputError(f"{path} says height {rows} and width {columns}, but holds {found}")
    cells = np.frombuffer(b"".join(grid), np.uint8).reshape(rows, columns)
    occupied = np.isin(cells, np.frombuffer(_OCCUPIED, np.uint8))
    strange = ~occupied & ~np.isin(cells, np.frombuffer(_FREE, np.uint8))
    if strange.any():
        letter = chr(cells[strange][0])
        raise UserInputError(
            f"{path} has {letter!r} in {strange.sum()} cells: it must be one of {(_FREE + _OCCUPIED).decode()}"
        )
    # The first line is the uppermost.
    return plan_of_cells(path.stem, occupied[::-1], cell_m, (0.0, 0.0, 0.0), mapped=mapped)
