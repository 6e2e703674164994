"""Ctrl-C is kept until a point where it can be served."""

import signal
import threading

import pytest

from rcdsac_trl.system.interrupts import at_safe_points, ended_by, endings_as_interrupts, interruption_point


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


@pytest.mark.parametrize("ending", [signal.SIGTERM, signal.SIGHUP])
def test_what_ends_a_program_is_served_as_ctrl_c(ending: signal.Signals) -> None:
    before = signal.signal(ending, signal.SIG_DFL)  # these tests may themselves run under nohup
    try:
        with endings_as_interrupts():
            assert ended_by() is signal.SIGINT
            with pytest.raises(KeyboardInterrupt):
                signal.raise_signal(ending)
            assert ended_by() is ending
            with at_safe_points():
                signal.raise_signal(ending)  # waits
                with pytest.raises(KeyboardInterrupt):
                    interruption_point()
        assert signal.getsignal(ending) is signal.SIG_DFL
    finally:
        signal.signal(ending, before)


def test_it_is_served_where_ctrl_c_is_ignored() -> None:
    before = signal.signal(signal.SIGINT, signal.SIG_IGN)  # as of what a shell starts in the background
    try:
        with endings_as_interrupts(), pytest.raises(KeyboardInterrupt):
            signal.raise_signal(signal.SIGTERM)
    finally:
        signal.signal(signal.SIGINT, before)


def test_an_ending_that_is_ignored_stays_ignored() -> None:
    before = signal.signal(signal.SIGHUP, signal.SIG_IGN)  # by nohup
    try:
        with endings_as_interrupts():
            signal.raise_signal(signal.SIGHUP)
        assert signal.getsignal(signal.SIGHUP) is signal.SIG_IGN
    finally:
        signal.signal(signal.SIGHUP, before)


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
