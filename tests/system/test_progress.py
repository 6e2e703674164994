"""Whoever waits is told how far work is."""

import threading
import time
from collections.abc import Callable

import pytest

from rcdsac_trl.system import progress
from rcdsac_trl.system.progress import Work, duration, never_silent


@pytest.fixture
def clock(monkeypatch: pytest.MonkeyPatch) -> Callable[[float], None]:
    """Time that passes when it is told to."""
    now_s = 100.0
    monkeypatch.setattr(progress.time, "monotonic", lambda: now_s)

    def wait(seconds: float) -> None:
        nonlocal now_s
        now_s += seconds

    return wait


def test_the_rest_is_guessed_by_the_pace_since_the_first_share(
    clock: Callable[[float], None], capsys: pytest.CaptureFixture[str]
) -> None:
    with Work("12 runs", 12, "run") as work:
        assert capsys.readouterr().err == "rcdsac_trl: 12 runs\n"
        assert (work.left_s(), str(work)) == (None, "0 of 12 runs")
        clock(60.0)  # processes start
        work.reach(0.5)
        assert work.left_s() is None
        assert capsys.readouterr().err == ""
        clock(10.0)
        work.reach(1.0)  # half a run in 10 s, 11 runs are left
        assert work.left_s() == pytest.approx(220.0)
        assert capsys.readouterr().err == "rcdsac_trl: 0 of 12 runs, about 4 min left\n"
        work.end_unit()
        work.reach(0.2)  # what is done stays done
        assert str(work) == "1 of 12 runs, about 4 min left"
        assert capsys.readouterr().err == ""
        work.tell("at work for 70 s")
        assert capsys.readouterr().err == "rcdsac_trl: 1 of 12 runs, about 4 min left (at work for 70 s)\n"


def test_nothing_is_guessed_from_the_first_steps(
    clock: Callable[[float], None], capsys: pytest.CaptureFixture[str]
) -> None:
    with Work("50 maps", 50, "map") as work:
        work.reach(0.001)
        clock(30.0)  # something is compiled
        work.reach(0.5)
        clock(4.0)
        work.reach(2.4)
        assert (work.left_s(), str(work)) == (None, "0 of 50 maps")
        clock(0.2)
        work.reach(2.6)  # 2.1 maps in 4.2 s
        assert work.left_s() == pytest.approx(2.0 * (50 - 2.6))
    assert capsys.readouterr().err == "rcdsac_trl: 50 maps\nrcdsac_trl: 0 of 50 maps, about 95 s left\n"


def test_one_unit_is_told_by_its_share(clock: Callable[[float], None]) -> None:
    with Work("a film", 1, "film") as work:
        told = [str(work) for _ in work.within((clock(1.0) for _ in range(4)), 4)]
    assert told == ["0%", "25%", "50%, about 2 s left", "75%, about 1 s left"]


def test_durations() -> None:
    assert [duration(s) for s in (0.4, 99.0, 100.0, 590.0, 7200.0)] == ["0 s", "99 s", "2 min", "10 min", "2.0 h"]


def test_nothing_is_silent_for_long(monkeypatch: pytest.MonkeyPatch) -> None:
    told: list[str] = []
    enough = threading.Event()

    def note(text: str, **_: object) -> None:
        told.append(text)
        if len(told) == 3:
            enough.set()

    monkeypatch.setattr(progress, "print", note, raising=False)
    with never_silent(silence_s=0.001):
        assert enough.wait(timeout=60)
        assert told[0].endswith(" s: it imports and reads, and the first call after an installation compiles")
        assert told[1].endswith(" s")  # said once
        enough.clear()
        told.clear()
        with Work("two maps", 2, "map") as work:
            work.end_unit()
            assert enough.wait(timeout=60)
    assert told[-1].startswith("rcdsac_trl: 1 of 2 maps")
    number = len(told)
    time.sleep(0.01)
    assert len(told) == number, "it tells on after the end"
