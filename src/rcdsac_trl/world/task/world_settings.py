"""What an environment is made of."""

from dataclasses import dataclass
from typing import Literal

from rcdsac_trl.errors import UserInputError
from rcdsac_trl.robot.range_sensor import SENSORS
from rcdsac_trl.system.checks import positive
from rcdsac_trl.system.processes import resolve_num_workers
from rcdsac_trl.world.maps.generator import MapSettings
from rcdsac_trl.world.task.rules import TaskSettings


@dataclass(frozen=True)
class WorldSettings:
    """What an environment is made of."""

    map_settings: MapSettings
    task: TaskSettings
    sensor: str
    num_agents: int
    num_workers: int | Literal["auto"]
    worker_timeout_s: float | None = None
    gui: bool = False

    def __post_init__(self) -> None:
        """Refuse an unknown sensor and agents that the workers cannot share."""
        if self.sensor not in SENSORS:
            raise UserInputError(f"sensor.name={self.sensor} is unknown: choose one of {', '.join(sorted(SENSORS))}")
        if self.num_agents < 1:
            raise UserInputError(f"world.num_agents={self.num_agents} is below 1: raise it")
        resolve_num_workers(self.num_workers, self.num_agents)
        if self.worker_timeout_s is not None:
            positive("world", self, "worker_timeout_s")
