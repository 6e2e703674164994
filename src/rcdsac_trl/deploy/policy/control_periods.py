"""When a robot's agent is asked: the time between two calls, measured by the periods of training."""

from rcdsac_trl.deploy.policy.input_checks import Stamps

# After so many calls without good input in a row, or so many of the longest periods of training without one, the memory
# is of another situation.
_FORGET_AFTER = 3


class ControlPeriods:
    """Says when an agent is asked again, and when what it remembers is of another situation.

    Args:
        period_s: shortest and longest time between two actions in training, s.

    Attributes:
        last: stamps of the last good input; None where it had none.
        time_s: of this call, s: when its odometry was measured, or counted in the middle of training's periods.
        age_s: of the older of ranges and odometry in this call, s; 0 without stamps.

    Example:
        >>> periods = ControlPeriods((0.12, 0.16))
        >>> periods.accept(Stamps(0.0, 0.0, 0.0, 0.0), asked=True)
        >>> [periods.is_due(Stamps(time_s, time_s, 0.0, 0.0)) for time_s in (0.05, 0.07)]
        [False, True]
    """

    def __init__(self, period_s: tuple[float, float]) -> None:
        self._period_s = period_s
        self._middle_s = sum(period_s) / 2.0
        self.reset()

    def reset(self) -> None:
        """Forget all calls before."""
        self.last: Stamps | None = None
        self._last_asked: Stamps | None = None
        self._refused = 0
        self.time_s = self.age_s = 0.0

    def memory_is_old(self, stamps: Stamps | None) -> bool:
        """Return whether the agent was asked so long ago that its memory is of another situation."""
        if stamps is None or self._last_asked is None:
            return False
        return stamps.now_s - self._last_asked.now_s > _FORGET_AFTER * self._period_s[1]

    def is_due(self, stamps: Stamps | None) -> bool:
        """Return whether the agent is asked; else the robot goes on as it was told last, guarded anew."""
        last = self._last_asked
        if stamps is None or last is None or self.memory_is_old(stamps):
            return True
        # The recurrent network counts time in steps: a second look at one scan, or one in half the time, is none.
        return stamps.scan_s > last.scan_s and stamps.now_s - last.now_s > self._period_s[0] / 2.0

    def elapsed_s(self, stamps: Stamps | None) -> float:
        """Return the time since the agent was asked; without stamps a call is the middle of training's periods."""
        if stamps is None or self._last_asked is None:
            return (1 + self._refused) * self._middle_s
        return stamps.scan_s - self._last_asked.scan_s

    def since_asked_s(self, stamps: Stamps | None) -> float:
        """Return how much later than in the call that asked the agent the odometry was measured, s."""
        if stamps is None or self._last_asked is None:
            return 0.0
        return stamps.velocity_s - self._last_asked.velocity_s

    def accept(self, stamps: Stamps | None, asked: bool) -> None:
        """Take down a call with good input, and whether the agent was asked in it."""
        self._refused = 0
        self.last = stamps
        self.time_s = self.time_s + self._middle_s if stamps is None else stamps.velocity_s
        self.age_s = 0.0 if stamps is None else max(0.0, stamps.now_s - min(stamps.scan_s, stamps.velocity_s))
        if asked:
            self._last_asked = stamps

    def refuse(self) -> bool:
        """Count a call with bad input, and return whether after so many the memory is of another situation."""
        self._refused += 1
        self.time_s += self._middle_s
        if self._refused < _FORGET_AFTER:
            return False
        self.last = self._last_asked = None  # a clock that was set back is a clock
        return True
