"""The root of ``conf/evaluate.yaml``: what an evaluation may choose."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, Literal

from rcdsac_trl.config.acting_override import ActingOverride
from rcdsac_trl.config.baseline_name import own_class
from rcdsac_trl.config.checkpoint_name import CheckpointName
from rcdsac_trl.config.chosen_world import ChosenWorld, chosen_world
from rcdsac_trl.config.conditions import Condition
from rcdsac_trl.config.navigation_settings import EvaluationNavigationSettings
from rcdsac_trl.config.training_settings import Threads, TrainingSettings, Workers
from rcdsac_trl.deploy.policy.acting import BY_MEAN, ActingSettings
from rcdsac_trl.errors import UserInputError
from rcdsac_trl.robot.latency import check_latency
from rcdsac_trl.system import runtime
from rcdsac_trl.system.checks import check_least
from rcdsac_trl.system.processes import resolve_processes

_MOST_FPS = 120


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

    def check_reach(self, reach_m: float) -> None:
        """Refuse a distance that range sensors of that reach, m, never tell.

        Raises:
            UserInputError: naming both.
        """
        if self.near_m > reach_m:
            raise UserInputError(
                f"controller.near_m={self.near_m:g} is beyond the {reach_m:g} m that agents see: lower it"
            )


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
class EvaluationSettings:
    """The root of ``conf/evaluate.yaml``."""

    run: str | None
    beta: tuple[float, ...] | None
    collision_weight: tuple[float, ...] | None
    beta_controller: tuple[Literal["clearance", "tail_variance"], ...] | None
    controller: ControllerSettings
    navigation: EvaluationNavigationSettings
    latency_s: float
    checkpoint: CheckpointName | None
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
        if "tail_variance" in asked and self.navigation.is_on:
            raise UserInputError(
                "beta_controller=[tail_variance] reads what critics expect of what is seen and of the action wanted, "
                "and with navigation.* agents are told, and driven, otherwise: leave one out"
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
            "has no checkpoints: leave checkpoint out": self.checkpoint,
            "has no actions to be drawn: leave sampled out": self.sampled,
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
            UserInputError: as :func:`~rcdsac_trl.config.chosen_world.chosen_world`, and if a controller reads
                distances that this robot's sensor does not tell.
        """
        chosen = chosen_world(trained, self.run, maps=self.map, sensor=self.sensor, task=self.task, robot=self.robot)
        if "clearance" in (self.beta_controller or ()):
            self.controller.check_reach(chosen.robot.lidar.max_range_m)
        return chosen
