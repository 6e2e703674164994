"""How this program is called, for what it tells its user to do next."""

import os
import shutil
import sys
from pathlib import Path

_SCRIPT = "rcdsac-trl"


def program() -> str:
    """Return what to write before a verb so that it runs with this Python: ``rcdsac-trl`` where the shell finds it."""
    beside = Path(sys.executable).with_name(_SCRIPT)
    if not beside.is_file():
        return f"{from_here(sys.executable)} -m rcdsac_trl"
    found = shutil.which(_SCRIPT)
    return _SCRIPT if found is not None and Path(found) == beside else from_here(str(beside))


def from_here(path: str | Path) -> str:
    """Write a path from the folder one is in, where it lies below that, else as it is."""
    here = os.getcwd()
    return os.path.relpath(path, here) if Path(path).is_relative_to(here) else str(path)
