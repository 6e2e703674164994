"""What an environment is made of."""

from dataclasses import dataclass, field
from typing import Literal

from rcdsac_trl.errors import UserInputError
from rcdsac_trl.robot.range_sensor import SENSORS, check_memory
from rcdsac_trl.robot.robot_settings import PAPER, RobotSettings
from rcdsac_trl.system.checks import positive
from rcdsac_trl.system.processes import resolve_num_workers
from rcdsac_trl.world.maps.generator import MapSettings, check_robot_fits
from rcdsac_trl.world.maps.map_source import MapSource, sources_of
from rcdsac_trl.world.maps.planner import check_margin
from rcdsac_trl.world.task.rules import TaskSettings


@dataclass(frozen=True)
class WorldSettings:
    """What an environment is made of.

    Attributes:
        map_settings: what maps are made from, the generator's settings or those of files.
        task: rules of the task.
        sensor: ``"narrow"``, ``"sparse"`` or ``"full"``.
        memory_s: for how long an agent is told of points that it saw and no longer sees, s; 0: not at all, as in the
            paper. See :class:`~rcdsac_trl.robot.remembered_ranges.RememberedRanges`.
        num_agents: agents side by side on each map.
        num_workers: processes of :func:`~rcdsac_trl.world.task.env.make_env`: 0 for none, W >= 1 for a ``ParallelEnv``
            of W with ``num_agents / W`` agents each; ``"auto"`` takes for W the largest divisor of ``num_agents`` that
            is not above the number of cores this process may use.
        worker_timeout_s: seconds without an answer after which a worker process counts as hung; None: it never does.
        gui: show PyBullet's window for the first agent.
        robot: which one it is; its sensor limits what `sensor` names.

    Raises:
        UserInputError: for an unknown sensor, one that this robot sees nothing of, a robot that does not fit through
            the maps' passages, and agents that the workers cannot share evenly.

    Example:
        >>> WorldSettings(sensor="sparse").num_agents
        10
    """

    map_settings: MapSource = field(default_factory=MapSettings)
    task: TaskSettings = field(default_factory=TaskSettings)
    sensor: str = "narrow"
    memory_s: float = 0.0
    num_agents: int = 10
    num_workers: int | Literal["auto"] = "auto"
    worker_timeout_s: float | None = None
    gui: bool = False
    robot: RobotSettings = PAPER

    def __post_init__(self) -> None:
        """Refuse an unknown sensor, a robot that cannot drive here, and agents that the workers cannot share."""
        if self.sensor not in SENSORS:
            raise UserInputError(f"sensor.name={self.sensor} is unknown: choose one of {', '.join(sorted(SENSORS))}")
        check_memory(self.memory_s)
        if not isinstance(self.robot, RobotSettings):
            raise UserInputError(f"robot={self.robot!r} is no robot: give a RobotSettings (docs/your-robot.md)")
        if not isinstance(self.map_settings, MapSource):
            raise UserInputError(
                f"map_settings={self.map_settings!r} are none: give a MapSettings, a MapMixture of them, or "
                "FileMapSettings(path=..)"
            )
        self.robot.sensor_mask(self.sensor)
        for source in sources_of(self.map_settings):
            if isinstance(source, MapSettings):
                check_robot_fits(source, self.robot.circumradius_m, self.robot.name)
            check_margin(source.clearance_margin_m, self.robot.circumradius_m)
        if self.num_agents < 1:
            raise UserInputError(f"world.num_agents={self.num_agents} is below 1: raise it")
        resolve_num_workers(self.num_workers, self.num_agents)
        if self.worker_timeout_s is not None:
            positive("world", self, "worker_timeout_s")
