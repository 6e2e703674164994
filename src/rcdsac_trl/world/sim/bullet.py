"""PyBullet without the line that its import prints: what reads our output should find our output."""

import importlib
import os
import sys
from types import ModuleType


def _import_quietly() -> ModuleType:
    sys.stderr.flush()
    kept = os.dup(2)
    sink = os.open(os.devnull, os.O_WRONLY)
    try:
        # The line is written by C code, which knows file descriptor 2 and not sys.stderr.
        os.dup2(sink, 2)
        return importlib.import_module("pybullet")
    finally:
        os.dup2(kept, 2)
        os.close(kept)
        os.close(sink)


pybullet = _import_quietly()
