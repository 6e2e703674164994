"""Tells a process that hangs from one that hardly gets a processor."""

import os
import time
from pathlib import Path

# Who has had a processor for so long, and for this share of the time since, is at work: it computes, or starts.
_WORK_S, _WORK_SHARE = 0.05, 0.02
# Between two looks at most so much passes for who is looked at: who looks may have been stopped itself.
_LONGEST_LOOK_S = 1.0


def processor_time_s(pid: int) -> float | None:
    """Return how long a process has had processors, all its threads together, s; None where the system does not say.

    Example:
        >>> processor_time_s(0) is None
        True
    """
    try:
        fields = Path(f"/proc/{pid}/stat").read_text("utf-8").rpartition(")")[2].split()
    except OSError:
        return None
    user, system = fields[11:13]
    return (int(user) + int(system)) / os.sysconf("SC_CLK_TCK")


class Liveness:
    """Watches one process for steps.

    It hangs if it does nothing for `timeout_s`, or computes for so long without a step. On a busy machine it may wait
    for a processor longer than that. Where the system does not say what a process computes, `timeout_s` without a step
    counts.

    Args:
        pid: of the process.
        timeout_s: likewise.
        steps: that it has made.
    """

    def __init__(self, pid: int, timeout_s: float, steps: int) -> None:
        self._pid, self._timeout_s = pid, timeout_s
        self.renew(steps)

    def renew(self, steps: int) -> None:
        """Begin anew: it has just made so many steps, or just been asked for more."""
        self._steps = steps
        self._looked_s, self._idle_s = time.monotonic(), 0.0
        self._worked_s = self._stepped_s = processor_time_s(self._pid)

    def hangs(self, steps: int) -> bool:
        """Look at it: return whether it hangs, given the steps that it has made."""
        if steps != self._steps:
            self.renew(steps)
            return False
        now_s, processor_s = time.monotonic(), processor_time_s(self._pid)
        self._idle_s += min(now_s - self._looked_s, _LONGEST_LOOK_S)
        self._looked_s = now_s
        if processor_s is None or self._worked_s is None or self._stepped_s is None:
            return self._idle_s > self._timeout_s
        if processor_s - self._worked_s > max(_WORK_S, _WORK_SHARE * self._idle_s):
            self._worked_s, self._idle_s = processor_s, 0.0
        return max(self._idle_s, processor_s - self._stepped_s) > self._timeout_s
