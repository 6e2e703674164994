"""Ctrl-C where it can be served: between two updates or two steps, not inside compiled code.

Python raises ``KeyboardInterrupt`` wherever it happens to be. Inside a callback of compiled code it is lost, or comes
out as a ``SystemError``: about one training in ten then ended with a traceback, or did not end.
"""

import signal
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from types import FrameType

_pressed = threading.Event()


@contextmanager
def at_safe_points() -> Iterator[None]:
    """Keep the first Ctrl-C for the next :func:`interruption_point`; a second one is raised at once.

    Outside the main thread, which alone may handle signals, nothing changes.
    """
    if threading.current_thread() is not threading.main_thread():
        yield
        return
    _pressed.clear()
    before = signal.signal(signal.SIGINT, _press)
    try:
        yield
    finally:
        signal.signal(signal.SIGINT, before)
        _pressed.clear()


def interruption_point() -> None:
    """Raise ``KeyboardInterrupt`` if Ctrl-C was pressed."""
    if _pressed.is_set():
        raise KeyboardInterrupt


def _press(signal_number: int, frame: FrameType | None) -> None:
    if _pressed.is_set():
        raise KeyboardInterrupt
    _pressed.set()
