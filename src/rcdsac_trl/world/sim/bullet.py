"""PyBullet without the line that its import prints, and its clients, each with one owner that frees it."""

import ctypes
import importlib
import os
import sys
import weakref
from types import ModuleType
from typing import Any, NoReturn

from rcdsac_trl.errors import UserInputError


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


def check_display() -> None:
    """Refuse a window where there is no display: PyBullet would end the process without a word of ours.

    Raises:
        UserInputError: if no X server can be reached.
    """
    try:
        x11 = ctypes.CDLL("libX11.so.6")
    except OSError:
        display = None
    else:
        x11.XOpenDisplay.restype = ctypes.c_void_p
        display = x11.XOpenDisplay(None)
    if display is None:
        named = os.environ.get("DISPLAY")
        raise UserInputError(
            "PyBullet cannot open its window: gui=true needs a display, "
            + (f"and DISPLAY={named} cannot be reached" if named else "and DISPLAY is not set")
            + "; use gui=false"
        )
    x11.XCloseDisplay(ctypes.c_void_p(display))


class OfOneProcess:
    """What holds a simulation, or leads to one: it is neither copied nor pickled, since PyBullet's state would not be.

    A copy would know the original's client by its number, and move and close the original's world.
    """

    def __reduce_ex__(self, protocol: Any) -> NoReturn:
        """Refuse: ``copy.copy``, ``copy.deepcopy`` and ``pickle`` all come here.

        Raises:
            UserInputError: always.
        """
        raise UserInputError(
            f"a {type(self).__name__} cannot be copied or pickled, since its simulation lives in PyBullet: "
            "make another with the same arguments and seed; to a worker process, pass the function that makes it"
        )


class Client(OfOneProcess):
    """One connection to PyBullet, with a world of its own.

    It disconnects when it is closed or no longer referred to. A forked child has a copy of the world; it leaves the
    connection to the process that made it.

    Args:
        mode: ``pybullet.DIRECT``, or ``pybullet.GUI`` for a window.

    Attributes:
        number: what PyBullet calls it; -1 if it could not connect.
    """

    def __init__(self, mode: int) -> None:
        try:
            self.number: int = pybullet.connect(mode)
        except pybullet.error:
            self.number = -1
        if self.number >= 0:
            self._release = weakref.finalize(self, _disconnect, self.number, os.getpid())
            self._release.atexit = False  # the process's end frees all of them

    def close(self) -> None:
        """Disconnect; harmless when done before."""
        if self.number >= 0:
            self._release()
            self.number = -1


def _disconnect(number: int, process: int) -> None:
    if os.getpid() == process:
        pybullet.disconnect(physicsClientId=number)
