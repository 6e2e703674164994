"""What a replay of a recording may choose, checked."""

from dataclasses import dataclass
from typing import Literal

from rcdsac_trl.config.checkpoint_name import CheckpointName
from rcdsac_trl.deploy import Mount
from rcdsac_trl.deploy.sensors.scan import Meaning
from rcdsac_trl.errors import UserInputError


@dataclass(frozen=True)
class ReplaySettings:
    """The root of ``conf/replay.yaml``."""

    recording: str | None
    run: str
    checkpoint: CheckpointName | None
    beta: float | None
    waypoints: Literal["auto", "plan", "goal", "trajectory"]
    zero_means: Meaning | None
    nan_means: Meaning | None
    laser: tuple[float, float, float] | None
    scan: str | None
    odom: str | None
    plan: str | None
    goal: str | None
    command: str | None
    record: bool
    out: str | None

    def __post_init__(self) -> None:
        """Refuse a replay of nothing, and a scanner that sits nowhere."""
        if not self.recording:
            raise UserInputError("name what was recorded: recording=<ROS bag or CARMEN log>")
        _ = self.mount

    @property
    def mount(self) -> Mount | None:
        """Where the scanner is said to sit.

        Raises:
            UserInputError: if it cannot sit there.
        """
        return None if self.laser is None else Mount(*self.laser)
