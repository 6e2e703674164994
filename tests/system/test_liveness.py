"""Who hangs, and who only waits for a processor: by a clock that the test turns."""

import os
import time

import pytest

from rcdsac_trl.system import liveness
from rcdsac_trl.system.liveness import Liveness, processor_time_s

TIMEOUT_S = 120.0
LOOK_S = 0.2


class Machine:
    """Gives the process that is watched a share of a processor."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch, *, tells: bool = True) -> None:
        self.now_s, self.processor_s = 1000.0, 5.0
        monkeypatch.setattr(time, "monotonic", lambda: self.now_s)
        monkeypatch.setattr(liveness, "processor_time_s", lambda pid: self.processor_s if tells else None)
        self.watched = Liveness(1, TIMEOUT_S, 0)

    def hangs_after_s(self, share: float, at_most_s: float) -> float | None:
        """Let time pass; return when the process was found to hang, s; None: it was not."""
        begun_s = self.now_s
        while self.now_s < begun_s + at_most_s:
            self.now_s += LOOK_S
            self.processor_s += share * LOOK_S
            if self.watched.hangs(0):
                return self.now_s - begun_s
        return None


@pytest.mark.parametrize(
    ("share", "hangs_after_s"),
    [
        (0.0, TIMEOUT_S),  # it waits for something that never comes
        (0.01, TIMEOUT_S + 5.0),  # so it does, and a thread of it looks around
        (1.0, TIMEOUT_S),  # a loop without end
        (0.5, 2.0 * TIMEOUT_S),  # the same, beside another program
        (0.05, 20.0 * TIMEOUT_S),  # hardly any processor: it is given its time
    ],
)
def test_a_process_hangs_by_what_it_had_of_the_processor(
    monkeypatch: pytest.MonkeyPatch, share: float, hangs_after_s: float
) -> None:
    found_s = Machine(monkeypatch).hangs_after_s(share, 30.0 * TIMEOUT_S)
    assert found_s == pytest.approx(hangs_after_s, abs=6.0)


def test_steps_begin_it_anew(monkeypatch: pytest.MonkeyPatch) -> None:
    machine = Machine(monkeypatch)
    assert machine.hangs_after_s(0.0, TIMEOUT_S - 1.0) is None
    assert not machine.watched.hangs(1)
    machine.watched.renew(0)
    assert machine.hangs_after_s(0.0, TIMEOUT_S - 1.0) is None


def test_who_looks_after_a_long_pause_of_its_own_condemns_nobody(monkeypatch: pytest.MonkeyPatch) -> None:
    machine = Machine(monkeypatch)
    machine.now_s += 100.0 * TIMEOUT_S
    assert not machine.watched.hangs(0)


def test_where_the_system_says_nothing_of_processors_the_clock_counts(monkeypatch: pytest.MonkeyPatch) -> None:
    assert Machine(monkeypatch, tells=False).hangs_after_s(1.0, 200.0) == pytest.approx(TIMEOUT_S, abs=1.0)


def test_the_system_says_how_long_a_process_has_had_a_processor() -> None:
    end_s = time.process_time() + 0.1
    while time.process_time() < end_s:
        pass
    assert processor_time_s(os.getpid()) == pytest.approx(time.process_time(), abs=0.05)
    assert processor_time_s(0) is None
