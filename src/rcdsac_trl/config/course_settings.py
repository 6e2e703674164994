"""All that a drive over the course may choose, checked."""

from dataclasses import dataclass
from typing import Literal

from rcdsac_trl.config.acting_override import ActingOverride
from rcdsac_trl.config.navigation_settings import CourseNavigationSettings
from rcdsac_trl.errors import UserInputError
from rcdsac_trl.system.checks import check_least, within
from rcdsac_trl.system.processes import resolve_processes
from rcdsac_trl.world.office.depth_cameras import Lens

Ranges = Literal["cameras", "exact"]

PERIOD_S = 0.15
"""Time between two commands, as on the paper's robot."""


@dataclass(frozen=True)
class OdometrySettings:
    """How wrong odometry and localisation are; every field is a key of ``odometry`` in ``conf/course.yaml``.

    All errors are normal, with these standard deviations, and cut off at twice them.

    Attributes:
        scale_std: relative error of travelled distances, and another one of turns, drawn once a run.
        travel_noise: error of a distance travelled, m for one metre; it grows with the root of the distance.
        turn_noise: error of a turn, rad for one radian; it grows with the root of the turn.
        fix_period_s: time between two corrections by the localisation.
        fix_std_m: error of a correction, along x and along y.
        fix_std_rad: error of a correction's heading.
        fix_weight: share of the way to a correction that the estimate goes, in (0, 1].
        velocity_std: error of the measured velocities, (m/s, rad/s).

    Raises:
        UserInputError: a value is outside its limits.
    """

    scale_std: float = 0.02
    travel_noise: float = 0.02
    turn_noise: float = 0.02
    fix_period_s: float = 1.0
    fix_std_m: float = 0.04
    fix_std_rad: float = 0.015
    fix_weight: float = 0.5
    velocity_std: tuple[float, float] = (0.01, 0.02)

    def __post_init__(self) -> None:
        """Refuse what would leave the robot lost."""
        within("odometry", self, 0.0, 0.2, "scale_std travel_noise turn_noise")
        within("odometry", self, 0.1, 60.0, "fix_period_s")
        within("odometry", self, 0.0, 1.0, "fix_std_m fix_std_rad")
        if not 0.0 < self.fix_weight <= 1.0:
            raise UserInputError(f"odometry.fix_weight={self.fix_weight:g} must be above 0 and at most 1")
        if not all(0.0 <= std <= 0.5 for std in self.velocity_std):
            raise UserInputError(f"odometry.velocity_std={list(self.velocity_std)} must be two numbers from 0 to 0.5")


@dataclass(frozen=True)
class CourseSettings:
    """The root of ``conf/course.yaml``."""

    run: str | tuple[str, ...] | None
    beta: tuple[float, ...] | None
    baseline: Literal["pursuit"] | None
    guard_margin_m: float | None
    acting: ActingOverride
    navigation: CourseNavigationSettings
    repetitions: int
    seed: int
    time_limit_s: float
    people: bool
    hollow: bool
    ranges: Ranges
    record: bool
    out: str | None
    num_workers: int | Literal["auto"]
    camera: Lens
    odometry: OdometrySettings

    def __post_init__(self) -> None:
        """Refuse what is below its limit, and what is there twice."""
        check_least("repetitions", self.repetitions, 1)
        check_least("seed", self.seed, 0)
        if not PERIOD_S <= self.time_limit_s <= 3600.0:
            raise UserInputError(f"time_limit_s={self.time_limit_s:g} must be from {PERIOD_S:g} to 3600 seconds")
        for key, values in (("run", self.runs), ("beta", self.beta or ())):
            for value in values:
                if values.count(value) > 1:
                    raise UserInputError(f"{key}={value} is given more than once: name every value once")
        resolve_processes(self.num_workers, 1)
        if self.navigation.static_layer and self.guard_margin_m is None and not self.navigation.replan:
            raise UserInputError(
                "navigation.static_layer=true changes nothing with guard_margin_m=null and navigation.replan=false: "
                "detours and the stop zone read it"
            )

    @property
    def runs(self) -> tuple[str, ...]:
        """The runs that are named, none or several."""
        return () if self.run is None else (self.run,) if isinstance(self.run, str) else self.run
