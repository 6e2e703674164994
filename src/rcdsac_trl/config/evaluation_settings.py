"""What an evaluation, a calibration, an export or a publication may choose: the roots of their files in ``conf/``."""

import math
from collections.abc import Mapping
from dataclasses import asdict, dataclass, replace
from typing import Any, Literal, NamedTuple, TypeVar

from rcdsac_trl.config.acting_override import ActingOverride
from rcdsac_trl.config.baseline_name import own_class
from rcdsac_trl.config.conditions import Condition
from rcdsac_trl.config.navigation_settings import EvaluationNavigationSettings
from rcdsac_trl.config.training_settings import SensorSettings, Threads, TrainingSettings, Workers
from rcdsac_trl.config.typed import read, section_class
from rcdsac_trl.deploy.policy.acting import BY_MEAN, ActingSettings
from rcdsac_trl.errors import UserInputError
from rcdsac_trl.robot.latency import check_latency
from rcdsac_trl.robot.robot_settings import RobotSettings
from rcdsac_trl.system import runtime
from rcdsac_trl.system.checks import check_least
from rcdsac_trl.system.processes import resolve_processes
from rcdsac_trl.world.maps.files.barn import GOAL_RADIUS_M, TIME_LIMIT_S, BarnMapSettings
from rcdsac_trl.world.maps.files.file_map import FileMapSettings
from rcdsac_trl.world.maps.generator import MapSettings
from rcdsac_trl.world.maps.map_mixture import MapMixture
from rcdsac_trl.world.maps.map_source import MapSource
from rcdsac_trl.world.task.rules import TaskSettings

Name = Literal["best", "last"] | int
"""How users name a checkpoint; a number: by the iterations that were done."""


Section = TypeVar("Section", SensorSettings, TaskSettings, RobotSettings)

_MOST_FPS = 120
MOST_MISSING = 0.02
"""Share of a discounted return that may lie beyond the horizon of a calibration as driven."""


@dataclass(frozen=True)
class ControllerSettings:
    """How controllers turn beta (``controller`` in ``conf/evaluate.yaml``), see ``deploy.policy.beta_controllers``."""

    near_m: float
    far_m: float
    window_steps: int

    def __post_init__(self) -> None:
        """Refuse what the controllers would."""
        if not 0.0 < self.near_m < self.far_m:
            raise UserInputError(
                f"controller.near_m={self.near_m:g} must be above 0 and below controller.far_m={self.far_m:g}"
            )
        if self.window_steps < 2:
            raise UserInputError(f"controller.window_steps={self.window_steps} must be at least 2")


@dataclass(frozen=True)
class VideoSettings:
    """What an evaluation films (``video`` in ``conf/evaluate.yaml``)."""

    map: int
    episode: int
    fps: float

    def __post_init__(self) -> None:
        """Refuse what is below its limit."""
        for key in ("map", "episode"):
            if (number := getattr(self, key)) < 0:
                raise UserInputError(f"video.{key}={number} must be at least 0")
        if not 0 < self.fps <= _MOST_FPS:
            raise UserInputError(
                f"video.fps={self.fps:g} must be above 0 and at most {_MOST_FPS}: choose such a number"
            )


@dataclass(frozen=True)
class ExportSettings:
    """The root of ``conf/export.yaml``."""

    run: str | None
    checkpoint: Name | None
    out: str | None
    num_quantiles: int
    acting: ActingOverride

    def __post_init__(self) -> None:
        """Refuse an export of nothing."""
        if self.run is None:
            raise UserInputError("name what to export: run=<folder>, or a shipped agent")
        check_least("num_quantiles", self.num_quantiles, 1)


class ChosenWorld(NamedTuple):
    """Where an evaluation drives.

    Attributes:
        maps: what maps are made from.
        sensor: what the agents see.
        task: what they are to do.
        robot: which one drives.
        barn: the worlds of BARN's protocol, where that is driven; maps and task then follow from it.
    """

    maps: MapSource
    sensor: SensorSettings
    task: TaskSettings
    robot: RobotSettings
    barn: BarnMapSettings | None = None


@dataclass(frozen=True)
class EvaluationSettings:
    """The root of ``conf/evaluate.yaml``."""

    run: str | None
    beta: tuple[float, ...] | None
    collision_weight: tuple[float, ...] | None
    beta_controller: tuple[Literal["clearance", "tail_variance"], ...] | None
    controller: ControllerSettings
    navigation: EvaluationNavigationSettings
    latency_s: float
    checkpoint: Name | None
    half_precision: bool
    baseline: str | None
    split: Literal["evaluation", "validation"]
    seed: int
    num_maps: int
    num_episodes: int
    sampled: bool
    acting: ActingOverride
    out: str | None
    num_workers: Workers
    gui: bool
    record: bool
    video: VideoSettings
    device: str
    threads: Threads
    # What is not given here is as the agent was trained; see :meth:`world_of`.
    map: Mapping[str, Any] | None = None
    sensor: Mapping[str, Any] | None = None
    task: Mapping[str, Any] | None = None
    robot: Mapping[str, Any] | None = None

    def __post_init__(self) -> None:
        """Refuse what is below its limit, and neither or both of run and baseline."""
        if (self.run is None) == (self.baseline is None):
            raise UserInputError(
                "name what to evaluate: either run=<folder or shipped agent> or baseline=<name>, such as mppi"
            )
        if self.baseline is not None:
            self._check_baseline(self.baseline)
        asked = self.beta_controller or ()
        if self.latency_s and (self.record or "tail_variance" in asked):
            what = "record=true shows" if self.record else "beta_controller=[tail_variance] reads"
            raise UserInputError(
                f"{what} what critics expect of what is seen now, and with latency_s agents are told what will be: "
                "leave one out"
            )
        for name in asked:
            if asked.count(name) > 1:
                raise UserInputError(f"beta_controller={name} is given more than once: name every one once")
        check_least("seed", self.seed, 0)
        check_least("num_maps", self.num_maps, 1)
        check_least("num_episodes", self.num_episodes, 1)
        for key, number in (("map", self.num_maps), ("episode", self.num_episodes)):
            if self.record and (filmed := getattr(self.video, key)) >= number:
                raise UserInputError(
                    f"video.{key}={filmed} is not among the {number} evaluated: lower it, or raise num_{key}s"
                )
        resolve_processes(self.num_workers, self.num_maps)
        runtime.check_device_name(self.device)
        runtime.resolve_threads(self.threads)

    def _check_baseline(self, baseline: str) -> None:
        """Refuse a baseline that is no name, and what only agents have."""
        own_class(baseline)
        agents_alone = {
            "has neither beta nor collision weight: leave them out": (self.beta, self.collision_weight) != (None, None),
            "navigates by itself: leave navigation.replan and navigation.watchdog out": self.navigation.replan
            or self.navigation.watchdog,
            "does not allow for a latency: leave latency_s out": self.latency_s,
            "has no weights to be rounded: leave half_precision out": self.half_precision,
            "has no critics to choose by: leave acting out": self.acting.given,
            "has no beta to turn: leave beta_controller out": self.beta_controller,
        }
        for why, given in agents_alone.items():
            if given:
                raise UserInputError(f"baseline={baseline} {why}")

    def conditions_of(self, trained: TrainingSettings) -> list[Condition]:
        """Return what the episodes of a map are driven under: every value of beta or weight, then every controller.

        Raises:
            UserInputError: for values that the agent does not take, and controllers with nothing to turn beta between.
        """
        if self.run is None:
            return [Condition()]
        fixed = trained.algo.conditions(self.beta, self.collision_weight)
        asked = self.beta_controller or ()
        if asked and sum(condition.beta is not None for condition in fixed) < 2:
            raise UserInputError(
                f"beta_controller=[{','.join(asked)}] turns beta between the values of beta: give two or more of them"
            )
        return [*fixed, *(Condition(controller=name) for name in asked)]

    def acting_of(self, trained: TrainingSettings) -> ActingSettings:
        """Return how the agents act: as their run's config says, with what was chosen in its place.

        Raises:
            UserInputError: if actions are to be drawn and chosen, or the agent's heads read no margin.
        """
        if self.run is None:
            return BY_MEAN
        acting = self.acting.of(trained.acting)
        acting.check_heads(trained.network.look_ahead)
        if self.sampled and acting.chooses:
            raise UserInputError(
                f"sampled=true draws actions, and acting.num_candidates={acting.num_candidates} chooses among some: "
                "leave sampled out, or give acting.num_candidates=1"
            )
        return acting

    def latency_of(self, trained: TrainingSettings) -> float:
        """Return the latency that the agents allow for, s.

        Raises:
            UserInputError: if they cannot.
        """
        check_latency(self.latency_s, trained.sensor.memory_s)
        return self.latency_s

    def world_of(self, trained: TrainingSettings) -> ChosenWorld:
        """Return map set, sensor, task and robot: those of a training, with what was chosen in their place.

        Raises:
            UserInputError: for a key or a value that they do not have, worlds of BARN that are not there, and another
                sensor or robot than an agent was trained with.
        """
        maps = _changed_maps(trained.map, self.map)
        sensor, task = self._sensor_of(trained), _changed(trained.task, self.task, "task")
        robot = self._robot_of(trained)
        if not isinstance(maps, BarnMapSettings):
            return ChosenWorld(maps, sensor, task, robot)
        steps = math.ceil(TIME_LIMIT_S / (min(task.motor_steps) * robot.motor_period_s))
        task = replace(task, goal_radius_m=GOAL_RADIUS_M, episode_steps=steps)
        return ChosenWorld(maps.files(), sensor, task, robot, maps)

    def _sensor_of(self, trained: TrainingSettings) -> SensorSettings:
        """Return the sensor: that of a training, or for a baseline the one that was chosen."""
        sensor = _changed(trained.sensor, self.sensor, "sensor")
        if self.run is None:
            return replace(sensor, memory_s=0.0)  # baselines do not read what is remembered
        if sensor.name != trained.sensor.name:
            chosen, was = f"sensor={sensor.name}", trained.sensor.name
        # Who chooses the sensor's name alone chooses no memory.
        elif sensor.memory_s not in (0.0, trained.sensor.memory_s):
            chosen, was = f"sensor.memory_s={sensor.memory_s:g}", f"{trained.sensor.memory_s:g}"
        else:
            return trained.sensor
        raise UserInputError(
            f"{chosen} is not what {self.run} was trained with ({was}): leave it out, or take another agent"
        )

    def _robot_of(self, trained: TrainingSettings) -> RobotSettings:
        """Return the robot: that of a training, or for a baseline the one that was chosen."""
        robot = _changed(trained.robot, self.robot, "robot")
        if self.run is not None and robot != trained.robot:
            was = f"robot={trained.robot.name}"
            if robot.name == trained.robot.name:
                was = _told_apart(robot.plain(), trained.robot.plain(), "robot")
            raise UserInputError(
                f"robot={robot.name} is not what {self.run} drives: it was trained for {was}, leave robot out"
            )
        return robot


def _changed_maps(trained: MapSource, values: Mapping[str, Any] | None) -> MapSource | BarnMapSettings:
    if not values:
        return trained
    chosen = section_class((type(trained), MapSettings, FileMapSettings, BarnMapSettings, MapMixture), values)
    if chosen is not type(trained):  # a training's keys say nothing of maps of another kind
        return read(chosen, values, "map")
    if "path" in values:  # of other files nothing was noted
        values = {"sha256": None, **values}
    return read(chosen, {**vars(trained), **values}, "map")


def _changed(section: Section, values: Mapping[str, Any] | None, name: str) -> Section:
    if not values:
        return section
    return read(type(section), _merged(asdict(section), values), name)


def _told_apart(now: Mapping[str, Any], then: Mapping[str, Any], section: str) -> str:
    """Name the first value of a section that is another now, as it was."""
    key = next(key for key in then if now[key] != then[key])
    if isinstance(then[key], Mapping):
        return _told_apart(now[key], then[key], f"{section}.{key}")
    return f"{section}.{key}={then[key]}"


def _merged(into: Mapping[str, Any], values: Mapping[str, Any]) -> dict[str, Any]:
    """Return a section with changed values, of the sections in it too."""
    changed = {
        key: _merged(into[key], value) if isinstance(value, Mapping) and isinstance(into.get(key), Mapping) else value
        for key, value in values.items()
    }
    return {**into, **changed}


@dataclass(frozen=True)
class CalibrationSettings:
    """The root of ``conf/calibrate.yaml``."""

    run: str | None
    beta: tuple[float, ...] | None
    checkpoint: Name | None
    half_precision: bool
    split: Literal["evaluation", "validation"]
    seed: int
    num_maps: int
    num_states: int
    num_rollouts: int
    horizon_steps: int | None
    cross_evaluate: bool
    as_driven: bool
    num_episodes: int
    every_steps: int
    acting: ActingOverride
    out: str | None
    num_workers: Workers
    threads: Threads

    def __post_init__(self) -> None:
        """Refuse what is below its limit, what does not go together, and a cross-evaluation of nothing."""
        check_least("seed", self.seed, 0)
        for key in ("num_maps", "num_states", "num_rollouts", "num_episodes", "every_steps"):
            check_least(key, getattr(self, key), 1)
        if self.as_driven and self.cross_evaluate:
            raise UserInputError(
                "as_driven=true drives whole episodes, and cross_evaluate=true branches off from states: leave one out"
            )
        if self.acting.given and not self.as_driven:
            raise UserInputError(
                f"acting.{next(iter(self.acting.given))} says how an agent acts, and here its actions are drawn: give "
                "as_driven=true, too, or leave acting out"
            )
        if self.cross_evaluate and self.num_maps < 2:
            raise UserInputError(
                f"cross_evaluate=true gives intervals over maps, and num_maps={self.num_maps} has none: give at least 2"
            )
        resolve_processes(self.num_workers, self.num_maps)
        runtime.resolve_threads(self.threads)

    def conditions_of(self, trained: TrainingSettings) -> list[Condition]:
        """Return the conditions under which the critics of an agent are measured.

        Raises:
            UserInputError: for critics without quantiles, values of beta that the agent does not take, and a
                cross-evaluation of a single one.
        """
        if trained.algo.critic != "quantile":
            raise UserInputError(
                f"run={self.run} has {trained.algo.critic} critics, which predict no quantiles: name an agent of "
                "another row"
            )
        conditions = trained.algo.conditions(self.beta, None)
        if self.cross_evaluate and len(conditions) < 2:
            raise UserInputError(
                f"cross_evaluate=true holds values of beta against each other, and {self.run} is asked for one: give "
                "two or more to a risk-conditioned agent, such as beta=[0.25,1], or leave cross_evaluate out"
            )
        return conditions

    def horizon_in(self, episode_steps: int) -> int:
        """Return the steps of a roll-out in episodes of some length: half of one, unless a user says otherwise.

        Raises:
            UserInputError: if that leaves no step of an episode for states.
        """
        horizon = max(1, episode_steps // 2) if self.horizon_steps is None else self.horizon_steps
        if not 0 < horizon < episode_steps:
            raise UserInputError(
                f"horizon_steps={horizon} must be below the {episode_steps} steps of an episode, so that states can be "
                "met in it: shorten it, or leave it out for half of an episode"
            )
        return horizon

    def check_missing(self, gamma: float, episode_steps: int) -> None:
        """Refuse returns as driven of which the horizon cuts off too much: offsets fitted on them would be too low.

        Raises:
            UserInputError: if more than :data:`MOST_MISSING` is missing.
        """
        horizon = self.horizon_in(episode_steps)
        if self.as_driven and gamma**horizon > MOST_MISSING:
            enough = math.ceil(math.log(MOST_MISSING) / math.log(gamma)) if gamma < 1.0 else "more"
            raise UserInputError(
                f"horizon_steps={horizon} leaves out {gamma**horizon:.0%} of a return (gamma={gamma:g}), and "
                f"as_driven=true allows {MOST_MISSING:.0%}: that takes {enough} steps, and episodes that are longer"
            )

    def acting_of(self, trained: TrainingSettings) -> ActingSettings:
        """Return how the agent acts as driven: as its config says, with what was chosen in its place.

        Raises:
            UserInputError: if its heads read no margin.
        """
        acting = self.acting.of(trained.acting)
        acting.check_heads(trained.network.look_ahead)
        return acting


@dataclass(frozen=True)
class PublishSettings:
    """The root of ``conf/publish.yaml``."""

    runs: tuple[str, ...]
    checkpoint: Name
    acting: ActingOverride
    weights: str
    results: str

    def __post_init__(self) -> None:
        """Refuse a publication of nothing."""
        if not self.runs:
            raise UserInputError("name what to publish: runs=[<folder>,..]")
