"""All that a drive over the course may choose, checked."""

from dataclasses import dataclass
from typing import Literal

from rcdsac_trl.errors import UserInputError
from rcdsac_trl.pipeline.course.drive import PERIOD_S
from rcdsac_trl.pipeline.course.odometry import OdometrySettings
from rcdsac_trl.pipeline.drivers import resolve_processes
from rcdsac_trl.world.depth import Lens


@dataclass(frozen=True)
class CourseSettings:
    """The root of ``conf/course.yaml``."""

    run: str | tuple[str, ...] | None
    beta: tuple[float, ...] | None
    baseline: Literal["pursuit"] | None
    guard_margin_m: float | None
    repetitions: int
    seed: int
    time_limit_s: float
    record: bool
    out: str | None
    num_workers: int | Literal["auto"]
    camera: Lens
    odometry: OdometrySettings

    def __post_init__(self) -> None:
        """Refuse what is below its limit, and what is there twice."""
        if self.out == "":
            raise UserInputError("out names no folder: give it one, or leave it out")
        if self.repetitions < 1:
            raise UserInputError(f"repetitions={self.repetitions} must be at least 1")
        if self.seed < 0:
            raise UserInputError(f"seed={self.seed} must be at least 0")
        if not PERIOD_S <= self.time_limit_s <= 3600.0:
            raise UserInputError(f"time_limit_s={self.time_limit_s:g} must be from {PERIOD_S:g} to 3600 seconds")
        for key, values in (("run", self.runs), ("beta", self.beta or ())):
            for value in values:
                if values.count(value) > 1:
                    raise UserInputError(f"{key}={value} is given more than once: name every value once")
        resolve_processes(self.num_workers, 1)

    @property
    def runs(self) -> tuple[str, ...]:
        """The runs that are named, none or several."""
        return () if self.run is None else (self.run,) if isinstance(self.run, str) else self.run
