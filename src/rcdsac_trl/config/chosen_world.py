"""Where an evaluation drives: as its agent was trained, with what was chosen in its place."""

import math
from collections.abc import Mapping
from dataclasses import asdict, replace
from typing import Any, NamedTuple, TypeVar

from rcdsac_trl.config.training_settings import SensorSettings, TrainingSettings, world_of
from rcdsac_trl.config.typed import read, section_class
from rcdsac_trl.errors import UserInputError
from rcdsac_trl.robot.robot_settings import RobotSettings
from rcdsac_trl.world.maps.files.barn import GOAL_RADIUS_M, TIME_LIMIT_S, BarnMapSettings
from rcdsac_trl.world.maps.files.file_map import FileMapSettings
from rcdsac_trl.world.maps.generator import MapSettings
from rcdsac_trl.world.maps.map_mixture import MapMixture
from rcdsac_trl.world.maps.map_source import MapSource, check_maps
from rcdsac_trl.world.task.rules import TaskSettings
from rcdsac_trl.world.task.world_settings import WorldSettings

Section = TypeVar("Section", SensorSettings, TaskSettings, RobotSettings)


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

    def world_for(self, num_agents: int) -> WorldSettings:
        """Return what so many agents drive in, side by side in one process.

        Raises:
            UserInputError: as :class:`~rcdsac_trl.world.task.world_settings.WorldSettings`.
        """
        return world_of(self.maps, self.task, self.sensor, self.robot, num_agents)

    def check_maps(self) -> None:
        """Refuse files that maps cannot be made from, before anything is driven; BARN's goals are given.

        Raises:
            UserInputError: as :func:`rcdsac_trl.world.maps.map_source.check_maps`.
        """
        shortest_m = self.task.min_path_m if self.barn is None else 0.0
        check_maps(self.maps, shortest_m, self.robot.circumradius_m)


def chosen_world(
    trained: TrainingSettings,
    run: str | None,
    *,
    maps: Mapping[str, Any] | None,
    sensor: Mapping[str, Any] | None,
    task: Mapping[str, Any] | None,
    robot: Mapping[str, Any] | None,
) -> ChosenWorld:
    """Return map set, sensor, task and robot: those of a training, with what was chosen in their place.

    Args:
        trained: the training.
        run: of the agent that drives; None: a baseline does.
        maps: changed keys of the maps; None: as trained.
        sensor: likewise.
        task: likewise.
        robot: likewise.

    Raises:
        UserInputError: for a key or a value that they do not have, worlds of BARN that are not there, and another
            sensor or robot than an agent was trained with.
    """
    chosen_maps, chosen_task = _changed_maps(trained.map, maps), _changed(trained.task, task, "task")
    chosen_sensor, chosen_robot = _sensor_of(trained, sensor, run), _robot_of(trained, robot, run)
    if not isinstance(chosen_maps, BarnMapSettings):
        return ChosenWorld(chosen_maps, chosen_sensor, chosen_task, chosen_robot)
    steps = math.ceil(TIME_LIMIT_S / (min(chosen_task.motor_steps) * chosen_robot.motor_period_s))
    barn_task = replace(chosen_task, goal_radius_m=GOAL_RADIUS_M, episode_steps=steps)
    return ChosenWorld(chosen_maps.files(), chosen_sensor, barn_task, chosen_robot, chosen_maps)


def _sensor_of(trained: TrainingSettings, values: Mapping[str, Any] | None, run: str | None) -> SensorSettings:
    """Return the sensor: that of a training, or for a baseline the one that was chosen."""
    sensor = _changed(trained.sensor, values, "sensor")
    if run is None:
        return replace(sensor, memory_s=0.0)  # baselines do not read what is remembered
    if sensor.name != trained.sensor.name:
        chosen, was = f"sensor={sensor.name}", trained.sensor.name
    # Who chooses the sensor's name alone chooses no memory.
    elif sensor.memory_s not in (0.0, trained.sensor.memory_s):
        chosen, was = f"sensor.memory_s={sensor.memory_s:g}", f"{trained.sensor.memory_s:g}"
    else:
        return trained.sensor
    raise UserInputError(f"{chosen} is not what {run} was trained with ({was}): leave it out, or take another agent")


def _robot_of(trained: TrainingSettings, values: Mapping[str, Any] | None, run: str | None) -> RobotSettings:
    """Return the robot: that of a training, or for a baseline the one that was chosen."""
    robot = _changed(trained.robot, values, "robot")
    if run is not None and robot != trained.robot:
        was = f"robot={trained.robot.name}"
        if robot.name == trained.robot.name:
            was = _told_apart(robot.plain(), trained.robot.plain(), "robot")
        raise UserInputError(f"robot={robot.name} is not what {run} drives: it was trained for {was}, leave robot out")
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
