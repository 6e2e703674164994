"""All that a training, an evaluation or a calibration may choose, checked as a whole.

The outermost classes are the roots of ``train.yaml``, ``evaluate.yaml``, ``calibrate.yaml``, ``export.yaml`` and
``search.yaml`` in ``conf/``; :class:`ExperimentSettings` is what a sweep (``sweep.yaml``) makes its runs of.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Literal

from rcdsac_trl.agent.networks import Widths
from rcdsac_trl.errors import UserInputError
from rcdsac_trl.pipeline import runtime
from rcdsac_trl.pipeline.adaptive import ControllerSettings
from rcdsac_trl.pipeline.collector_settings import SINGLE, CollectorSettings
from rcdsac_trl.pipeline.drivers import resolve_processes
from rcdsac_trl.pipeline.film import VideoSettings
from rcdsac_trl.pipeline.saved import Name
from rcdsac_trl.pipeline.settings import AlgoSettings, LearnerSettings, Schedule, WorldSettings
from rcdsac_trl.world.maps import MapSettings
from rcdsac_trl.world.task import TaskSettings

Threads = int | Literal["auto"]
Workers = int | Literal["auto"]


def _check_least(key: str, value: int, lowest: int) -> None:
    if value < lowest:
        raise UserInputError(f"{key}={value} must be at least {lowest}")


@dataclass(frozen=True)
class SensorSettings:
    """Which bins of the range sensor are seen (``conf/sensor``); :class:`WorldSettings` knows the names."""

    name: str


@dataclass(frozen=True)
class LoggerSettings:
    """Where scalars go (``conf/logger``); a training checks the names, an evaluation of it need not have them."""

    backends: tuple[str, ...]


@dataclass(frozen=True)
class TeamSettings:
    """The agents that drive side by side; :class:`WorldSettings` checks that the workers can share them."""

    num_agents: int
    num_workers: Workers
    worker_timeout_s: float | None
    max_restarts: int

    def __post_init__(self) -> None:
        """Refuse what is below 0."""
        _check_least("world.max_restarts", self.max_restarts, 0)


@dataclass(frozen=True)
class ReplaySettings:
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
        _check_least("validation.every_iterations", self.every_iterations, 1)
        _check_least("validation.num_maps", self.num_maps, 1)
        if self.processes != "auto":
            _check_least("validation.processes", self.processes, 0)


@dataclass(frozen=True)
class CheckpointSettings:
    """When training saves everything, and how much of that stays."""

    every_iterations: int
    keep: int

    def __post_init__(self) -> None:
        """Refuse what is below 1."""
        _check_least("checkpoint.every_iterations", self.every_iterations, 1)
        _check_least("checkpoint.keep", self.keep, 1)


@dataclass(frozen=True)
class TrainingSettings:
    """The root of ``conf/train.yaml``; every section is checked by its own class, here what spans several."""

    algo: AlgoSettings
    sensor: SensorSettings
    map: MapSettings
    task: TaskSettings
    logger: LoggerSettings
    resume: str | None
    seed: int
    device: str
    threads: Threads
    world: TeamSettings
    network: Widths
    learner: LearnerSettings
    replay: ReplaySettings
    schedule: Schedule
    validation: ValidationSettings
    checkpoint: CheckpointSettings
    # Runs of earlier versions name none: this is what they had.
    collector: CollectorSettings = SINGLE

    def __post_init__(self) -> None:
        """Refuse what does not fit together, or not this machine."""
        _check_least("seed", self.seed, 0)
        runtime.resolve_threads(self.threads)
        self.collector.check_agents(self.world.num_agents)
        if self.collector.name != "single" and self.world.num_workers != 0:
            raise UserInputError(
                f"world.num_workers={self.world.num_workers} does nothing with collector={self.collector.name}: give "
                "collector.num_processes, or take collector=single"
            )
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
        iteration_steps = self.training_world.num_agents * episode_steps
        if self.replay.capacity_steps < iteration_steps:
            raise UserInputError(
                f"replay.capacity_steps={self.replay.capacity_steps} does not hold the {iteration_steps} steps of one "
                "iteration (world.num_agents x task.episode_steps): raise it"
            )

    @property
    def training_world(self) -> WorldSettings:
        """What the training environment is made of."""
        return WorldSettings(
            map_settings=self.map,
            task=self.task,
            sensor=self.sensor.name,
            num_agents=self.world.num_agents,
            num_workers=self.world.num_workers,
            worker_timeout_s=self.world.worker_timeout_s,
        )

    @property
    def replay_steps(self) -> int:
        """Steps that the replay is made for: no more than the run can fill."""
        steps = self.schedule.iterations * self.world.num_agents * self.task.episode_steps
        return min(self.replay.capacity_steps, steps)


@dataclass(frozen=True)
class ExportSettings:
    """The root of ``conf/export.yaml``."""

    run: str | None
    checkpoint: Name
    out: str | None
    num_quantiles: int

    def __post_init__(self) -> None:
        """Refuse an export of nothing."""
        if self.run is None:
            raise UserInputError("name what to export: run=<folder>")
        _check_least("num_quantiles", self.num_quantiles, 1)


@dataclass(frozen=True)
class EvaluationSettings:
    """The root of ``conf/evaluate.yaml``."""

    run: str | None
    beta: tuple[float, ...] | None
    collision_weight: tuple[float, ...] | None
    beta_controller: tuple[Literal["clearance", "tail_variance", "bandit"], ...] | None
    controller: ControllerSettings
    checkpoint: Name
    baseline: str | None
    split: Literal["evaluation", "validation"]
    seed: int
    num_maps: int
    num_episodes: int
    sampled: bool
    out: str | None
    num_workers: Workers
    gui: bool
    record: bool
    video: VideoSettings
    device: str
    threads: Threads
    map: MapSettings | None = None
    sensor: SensorSettings | None = None
    task: TaskSettings | None = None

    def __post_init__(self) -> None:
        """Refuse what is below its limit, and neither or both of run and baseline."""
        if (self.run is None) == (self.baseline is None):
            raise UserInputError("name what to evaluate: either run=<folder> or baseline=<name>, such as mppi")
        if self.out == "":
            raise UserInputError("out names no folder: give it one, or leave it out")
        if self.baseline is not None and (self.beta is not None or self.collision_weight is not None):
            raise UserInputError(f"baseline={self.baseline} has neither beta nor collision weight: leave them out")
        asked = self.beta_controller or ()
        if asked and len(self.beta or ()) < 2:
            raise UserInputError(
                f"beta_controller=[{','.join(asked)}] turns beta between the values of beta: give two or more of them"
            )
        for name in asked:
            if asked.count(name) > 1:
                raise UserInputError(f"beta_controller={name} is given more than once: name every one once")
        _check_least("seed", self.seed, 0)
        _check_least("num_maps", self.num_maps, 1)
        _check_least("num_episodes", self.num_episodes, 1)
        for key, number in (("map", self.num_maps), ("episode", self.num_episodes)):
            if self.record and (filmed := getattr(self.video, key)) >= number:
                raise UserInputError(
                    f"video.{key}={filmed} is not among the {number} evaluated: lower it, or raise num_{key}s"
                )
        resolve_processes(self.num_workers, self.num_maps)
        runtime.resolve_threads(self.threads)


@dataclass(frozen=True)
class ExperimentSettings:
    """A set of trainings (``conf/experiment``); overrides are written as on the command line."""

    name: str
    every: tuple[str, ...]
    runs: Mapping[str, tuple[str, ...]]
    only: tuple[str, ...] | None
    evaluate: tuple[str, ...] | None


@dataclass(frozen=True)
class SearchSettings:
    """A search for better hyper-parameters (``conf/search.yaml``)."""

    name: str
    trials: int
    collision_cost: float
    averaged_validations: int
    startup_trials: int
    warmup_iterations: int
    seed: int
    storage: str | None

    def __post_init__(self) -> None:
        """Refuse what is below its limit."""
        for key in ("trials", "averaged_validations"):
            _check_least(f"search.{key}", getattr(self, key), 1)
        for key in ("startup_trials", "warmup_iterations", "seed"):
            _check_least(f"search.{key}", getattr(self, key), 0)
        if self.collision_cost < 0:
            raise UserInputError(f"search.collision_cost={self.collision_cost:g} must be at least 0")


@dataclass(frozen=True)
class CalibrationSettings:
    """The root of ``conf/calibrate.yaml``."""

    run: str | None
    beta: tuple[float, ...] | None
    checkpoint: Name
    split: Literal["evaluation", "validation"]
    seed: int
    num_maps: int
    num_states: int
    num_rollouts: int
    horizon_steps: int
    out: str | None
    num_workers: Workers
    threads: Threads

    def __post_init__(self) -> None:
        """Refuse what is below its limit."""
        _check_least("seed", self.seed, 0)
        for key in ("num_maps", "num_states", "num_rollouts"):
            _check_least(key, getattr(self, key), 1)
        resolve_processes(self.num_workers, self.num_maps)
        runtime.resolve_threads(self.threads)
