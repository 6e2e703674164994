"""All that a training may choose, checked as a whole."""

import importlib
import importlib.util
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from rcdsac_trl.agent.loss.batch_parts import useful_threads
from rcdsac_trl.agent.network_settings import NetworkSettings
from rcdsac_trl.config.algo_settings import AlgoSettings
from rcdsac_trl.config.collector_settings import SINGLE, CollectorSettings
from rcdsac_trl.config.learner_settings import LearnerSettings
from rcdsac_trl.config.schedule import Schedule
from rcdsac_trl.deploy.policy.acting import BY_MEAN, ActingSettings
from rcdsac_trl.errors import UserInputError, first_line
from rcdsac_trl.robot.robot_settings import PAPER, RobotSettings
from rcdsac_trl.system import runtime
from rcdsac_trl.system.checks import check_least
from rcdsac_trl.world.maps.map_source import MapSource
from rcdsac_trl.world.task.rules import TaskSettings
from rcdsac_trl.world.task.world_settings import WorldSettings

# Loggers whose package and extra are called as they are.
_EXTRAS = ("wandb", "mlflow")

Threads = int | Literal["auto"]
Workers = int | Literal["auto"]


@dataclass(frozen=True)
class SensorSettings:
    """Which bins of the range sensor are seen, and remembered for how long (``conf/sensor``).

    :class:`WorldSettings` knows the names.
    """

    name: str
    # Runs of earlier versions name none: they remembered nothing.
    memory_s: float = 0.0


@dataclass(frozen=True)
class LoggerSettings:
    """Where scalars go (``conf/logger``)."""

    backends: tuple[str, ...]

    def check_backends(self) -> None:
        """Refuse an unknown logger, one whose package is missing, or one without a login, in a training.

        An evaluation of it needs none.

        Raises:
            UserInputError: naming the logger.
        """
        for backend in self.backends:
            if backend not in (known := ("csv", "tensorboard", *_EXTRAS)):
                raise UserInputError(f"logger.backends holds {backend!r}: choose among {', '.join(known)}")
            if backend in _EXTRAS and importlib.util.find_spec(backend) is None:
                raise UserInputError(
                    f"logger {backend} is not installed: pip install 'rcdsac-trl[{backend}]', or use logger=default"
                )
        if "wandb" in self.backends:
            _log_in_to_wandb()


def _log_in_to_wandb() -> None:
    """Log in where W&B is not offline: it would ask, or fail, once the run has begun."""
    wandb = importlib.import_module("wandb")
    try:
        wandb.login()
    except wandb.errors.Error as error:
        raise UserInputError(
            f"logger wandb cannot log in ({first_line(error)}): call `wandb login`, or set WANDB_MODE=offline, which "
            "keeps everything in the run folder"
        ) from error


@dataclass(frozen=True)
class TeamSettings:
    """The agents that drive side by side; :class:`WorldSettings` checks that the workers can share them."""

    num_agents: int
    num_workers: Workers
    worker_timeout_s: float | None
    max_restarts: int

    def __post_init__(self) -> None:
        """Refuse what is below 0."""
        check_least("world.max_restarts", self.max_restarts, 0)


@dataclass(frozen=True)
class ReplayBufferSettings:
    """The replay's size."""

    capacity_steps: int


@dataclass(frozen=True)
class ValidationSettings:
    """When and how long training looks at its agent."""

    every_iterations: int
    num_maps: int
    processes: Workers

    def __post_init__(self) -> None:
        """Refuse what is below its limit."""
        check_least("validation.every_iterations", self.every_iterations, 1)
        check_least("validation.num_maps", self.num_maps, 1)
        if self.processes != "auto":
            check_least("validation.processes", self.processes, 0)


@dataclass(frozen=True)
class CheckpointSettings:
    """When training saves everything, and how much of that stays."""

    every_iterations: int
    keep: int

    def __post_init__(self) -> None:
        """Refuse what is below 1."""
        check_least("checkpoint.every_iterations", self.every_iterations, 1)
        check_least("checkpoint.keep", self.keep, 1)


def world_of(
    maps: MapSource, task: TaskSettings, sensor: SensorSettings, robot: RobotSettings, num_agents: int
) -> WorldSettings:
    """Return what so many agents drive in, side by side in one process."""
    return WorldSettings(
        map_settings=maps,
        task=task,
        sensor=sensor.name,
        memory_s=sensor.memory_s,
        num_agents=num_agents,
        num_workers=0,
        robot=robot,
    )


@dataclass(frozen=True)
class TrainingSettings:
    """The root of ``conf/train.yaml``; every section is checked by its own class, here what spans several."""

    algo: AlgoSettings
    sensor: SensorSettings
    map: MapSource
    task: TaskSettings
    logger: LoggerSettings
    resume: str | None
    seed: int
    device: str
    threads: Threads
    world: TeamSettings
    network: NetworkSettings
    learner: LearnerSettings
    replay: ReplayBufferSettings
    schedule: Schedule
    validation: ValidationSettings
    checkpoint: CheckpointSettings
    # Runs of earlier versions name none: this is what they had.
    collector: CollectorSettings = SINGLE
    robot: RobotSettings = PAPER
    # Those began with random weights.
    init: str | None = None
    # Those acted by tanh(mean).
    acting: ActingSettings = BY_MEAN

    def __post_init__(self) -> None:
        """Refuse what does not fit together, or not this machine."""
        check_least("seed", self.seed, 0)
        if self.init is not None and not self.init.strip():
            raise UserInputError("init names no agent: give a run folder, an exported folder or a shipped agent")
        runtime.check_device_name(self.device)
        runtime.resolve_threads(self.threads)
        self.collector.check_agents(self.world.num_agents)
        self.collector.check_workers(self.world.num_workers)
        if self.schedule.distortion_strength(0) < 1:
            self.algo.distortion.measure.temper(0.0, 0.0)  # refuses a measure without a neutral beta
        if not self.algo.default_conditions:
            raise UserInputError(
                "algo.distortion.evaluation_betas=[] leaves nothing to validate: give one beta or more"
            )
        episode_steps, sequence_length = self.task.episode_steps, self.learner.sequence_length
        if sequence_length > episode_steps:
            raise UserInputError(
                f"learner.sequence_length={sequence_length} is longer than an episode of "
                f"task.episode_steps={episode_steps} transitions: shorten it"
            )
        if self.network.look_ahead and self.sensor.memory_s == 0.0:
            raise UserInputError(
                "network.look_ahead=true reads what is remembered: set sensor.memory_s above 0, or "
                + (
                    "network.look_ahead=false acting.margin_m=0"
                    if self.init is None
                    else f"leave sensor out, which init={self.init} brings along"
                )
            )
        self.acting.check_heads(self.network.look_ahead)
        if self.learner.n_steps > 1 and self.algo.relabel == "resample" and self.learner.resample_per == "transition":
            raise UserInputError(
                f"learner.n_steps={self.learner.n_steps} sums rewards over transitions of one beta, and with "
                "learner.resample_per=transition each has its own: choose learner.resample_per=sequence"
            )
        iteration_steps = self.training_world.num_agents * episode_steps
        if self.replay.capacity_steps < iteration_steps:
            raise UserInputError(
                f"replay.capacity_steps={self.replay.capacity_steps} does not hold the {iteration_steps} steps of one "
                "iteration (world.num_agents x task.episode_steps): raise it"
            )

    @property
    def update_threads(self) -> int:
        """How many threads share an update on a CPU: those of ``threads`` that find work in it."""
        steps = self.learner.sequence_length - self.learner.burn_in
        threads = runtime.resolve_threads(self.threads)
        return useful_threads(self.learner.batch_size, steps, self.learner.num_critics, threads)

    @property
    def training_world(self) -> WorldSettings:
        """What the training environment is made of."""
        team = self.world
        return replace(
            self.world_for(team.num_agents), num_workers=team.num_workers, worker_timeout_s=team.worker_timeout_s
        )

    @property
    def sensor_mask(self) -> NDArray[np.bool_]:
        """Which of the 180 range bins the agent is told, bool [180]."""
        return self.robot.sensor_mask(self.sensor.name)

    def world_for(self, num_agents: int) -> WorldSettings:
        """Return what so many agents drive in as in training, side by side in one process."""
        return world_of(self.map, self.task, self.sensor, self.robot, num_agents)

    def replay_steps(self, inherited_steps: int = 0) -> int:
        """Return the steps that the replay is made for: no more than the run can fill.

        Args:
            inherited_steps: those it begins with.
        """
        steps = self.schedule.iterations * self.world.num_agents * self.task.episode_steps
        return min(self.replay.capacity_steps, inherited_steps + steps)
