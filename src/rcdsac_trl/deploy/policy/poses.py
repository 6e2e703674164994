"""Whether an odometry can follow the ones before: its pose is no jump, and its velocities say that it moves."""

import math

from rcdsac_trl.deploy.policy.input_checks import BadInputError

# A localisation may correct itself by this much at once, and a robot moves this fast.
_LARGEST_CORRECTION_M = 10.0
_FASTEST_M_PER_S = 2.0
# A pose that moves farther within this time, while the velocities are 0, is of a driver that leaves them empty.
_MOVED_M, _MOVED_S = 0.15, 2.0

Place = tuple[float, float]
"""x and y, m."""


class PoseWatch:
    """Compares each odometry with those before.

    Example:
        >>> watch = PoseWatch()
        >>> watch.check((0.0, 0.0), 10.0, (0.5, 0.0))
        >>> try:
        ...     watch.check((42.0, 0.0), 10.14, (0.5, 0.0))
        ... except BadInputError as error:
        ...     print(error)
        the pose moved by 42 m in 0.14 s, more than 10.3 m: give metres
    """

    def __init__(self) -> None:
        self._last: tuple[Place, float] | None = None
        self._stood: tuple[Place, float] | None = None

    def check(self, position: Place, stamp_s: float, velocity: tuple[float, float]) -> None:
        """Refuse an odometry that no robot can have; the next is compared with this one.

        Args:
            position: x and y, m.
            stamp_s: when the robot was there.
            velocity: measured then, m/s and rad/s.

        Raises:
            BadInputError: with how far it moved: farther than a robot gets, or at velocities of 0.
        """
        last, self._last = self._last, (position, stamp_s)
        if last is not None:
            moved_m, took_s = math.dist(position, last[0]), abs(stamp_s - last[1])
            most_m = _LARGEST_CORRECTION_M + _FASTEST_M_PER_S * took_s
            if moved_m > most_m:
                raise BadInputError(
                    f"the pose moved by {moved_m:g} m in {took_s:.2f} s, more than {most_m:.1f} m: give metres"
                )
        self._check_velocity(position, stamp_s, velocity)

    def _check_velocity(self, position: Place, stamp_s: float, velocity: tuple[float, float]) -> None:
        if velocity != (0.0, 0.0):
            self._stood = None
            return
        if self._stood is None or not 0.0 <= stamp_s - self._stood[1] <= _MOVED_S:
            self._stood = position, stamp_s
        since, since_s = self._stood
        if (moved_m := math.dist(position, since)) > _MOVED_M:
            raise BadInputError(
                f"the pose moved by {moved_m:.2f} m in {stamp_s - since_s:.2f} s, and the odometry's twist is 0: its "
                "driver must fill in the measured velocities"
            )
