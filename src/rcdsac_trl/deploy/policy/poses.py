"""Whether a pose can follow the one before: no robot is as fast as one whose millimetres are read as metres."""

import math

from rcdsac_trl.deploy.policy.input_checks import BadInputError

# A localisation may correct itself by this much at once, and a robot moves this fast.
_LARGEST_CORRECTION_M = 10.0
_FASTEST_M_PER_S = 2.0


class PoseWatch:
    """Compares each pose with the one before.

    Example:
        >>> watch = PoseWatch()
        >>> watch.check((0.0, 0.0), 10.0)
        >>> try:
        ...     watch.check((42.0, 0.0), 10.14)
        ... except BadInputError as error:
        ...     print(error)
        the pose moved by 42 m in 0.14 s, more than 10.3 m: give metres
    """

    def __init__(self) -> None:
        self._last: tuple[tuple[float, float], float] | None = None

    def check(self, position: tuple[float, float], stamp_s: float) -> None:
        """Refuse a pose that is farther from the one before than a robot gets; the next is compared with this one.

        Args:
            position: x and y, m.
            stamp_s: when the robot was there.

        Raises:
            BadInputError: with how far it moved.
        """
        last, self._last = self._last, (position, stamp_s)
        if last is None:
            return
        moved_m, took_s = math.dist(position, last[0]), abs(stamp_s - last[1])
        most_m = _LARGEST_CORRECTION_M + _FASTEST_M_PER_S * took_s
        if moved_m > most_m:
            raise BadInputError(
                f"the pose moved by {moved_m:g} m in {took_s:.2f} s, more than {most_m:.1f} m: give metres"
            )
