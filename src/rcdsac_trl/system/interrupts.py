"""Ctrl-C where it can be served: between two updates or two steps, not inside compiled code.

SIGTERM, by which supervisors and clusters end a program, and SIGHUP, by which a terminal that closes does, are served
in the same way.

Python raises ``KeyboardInterrupt`` wherever it happens to be. Inside a callback of compiled code it is lost, or comes
out as a ``SystemError``: about one training in ten then ended with a traceback, or did not end.
"""

import signal
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from types import FrameType

_pressed = threading.Event()
_ENDINGS = (signal.SIGTERM, signal.SIGHUP)
_last: signal.Signals = signal.SIGINT


@contextmanager
def endings_as_interrupts() -> Iterator[None]:
    """Let SIGTERM and SIGHUP do what Ctrl-C does; one that is ignored, or served by somebody, stays so.

    Outside the main thread nothing changes.
    """
    global _last
    _last = signal.SIGINT
    served = []
    if threading.current_thread() is threading.main_thread():
        served = [number for number in _ENDINGS if signal.getsignal(number) is signal.SIG_DFL]
    for number in served:
        signal.signal(number, _interrupt)
    try:
        yield
    finally:
        for number in served:
            signal.signal(number, signal.SIG_DFL)


def ended_by() -> signal.Signals:
    """Return the signal of the latest interrupt: SIGINT, unless another was served as one."""
    return _last


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


def _interrupt(signal_number: int, frame: FrameType | None) -> None:
    global _last
    _last = signal.Signals(signal_number)
    serve = signal.getsignal(signal.SIGINT)
    if callable(serve):
        serve(signal_number, frame)
    else:  # a shell lets what it starts in the background ignore Ctrl-C
        raise KeyboardInterrupt


def _press(signal_number: int, frame: FrameType | None) -> None:
    if _pressed.is_set():
        raise KeyboardInterrupt
    _pressed.set()
