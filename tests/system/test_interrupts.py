"""Ctrl-C is kept until a point where it can be served."""

import signal
import threading

import pytest

from rcdsac_trl.system.interrupts import at_safe_points, interruption_point


def press() -> None:
    signal.raise_signal(signal.SIGINT)


def test_the_first_press_waits_for_a_safe_point() -> None:
    with at_safe_points():
        interruption_point()
        press()
        with pytest.raises(KeyboardInterrupt):
            interruption_point()


def test_the_second_press_does_not_wait() -> None:
    with at_safe_points():
        press()
        with pytest.raises(KeyboardInterrupt):
            press()


def test_afterwards_everything_is_as_before() -> None:
    before = signal.getsignal(signal.SIGINT)
    with at_safe_points():
        assert signal.getsignal(signal.SIGINT) is not before
        press()
    assert signal.getsignal(signal.SIGINT) is before
    interruption_point()  # a press that nobody served is not kept for the next run
    with at_safe_points():
        interruption_point()


def test_another_thread_may_train() -> None:
    done = []

    def train() -> None:
        with at_safe_points():
            interruption_point()
            done.append(True)

    thread = threading.Thread(target=train)
    thread.start()
    thread.join()
    assert done == [True]
