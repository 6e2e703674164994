"""Policies that reckon with how long a step takes."""

from collections.abc import Sequence


class Timed:
    """A policy that is told how long a step takes before its agents' episodes begin, and refuses to guess.

    Example:
        >>> policy = Timed()
        >>> policy.set_periods([0.12, 0.16])
        >>> policy.periods_s
        [0.12, 0.16]
    """

    _told_s: Sequence[float] | None = None

    def set_periods(self, periods_s: Sequence[float]) -> None:
        """Say how long a step of each agent's next episode takes, s."""
        self._told_s = list(periods_s)

    @property
    def periods_s(self) -> Sequence[float]:
        """How long a step of each agent's episode takes, s.

        Raises:
            RuntimeError: if nobody has said it.
        """
        if self._told_s is None:
            raise RuntimeError(f"{type(self).__name__} does not know how long a step takes: call set_periods() first")
        return self._told_s
