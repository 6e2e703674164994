"""Environments by the names of conf/: the same settings as the command line takes."""

from pathlib import Path
from typing import Any

import gymnasium
import pytest

import rcdsac_trl
from rcdsac_trl.config.compose import compose
from rcdsac_trl.config.run_config import training_settings
from rcdsac_trl.errors import UserInputError
from rcdsac_trl.world.maps.files.file_map import FileMapSettings
from rcdsac_trl.world.maps.generator import MapSettings
from rcdsac_trl.world.task.gymnasium_env import NavigationGymEnv
from rcdsac_trl.world.task.world_settings import WorldSettings

ENV_ID = "RCDSACNavigation-v0"


def test_names_are_those_of_the_command_line() -> None:
    trained = training_settings(compose("train", ["+algo=sac", "map=static", "robot=turtlebot4"]))
    world = rcdsac_trl.world_settings(map="static", robot="turtlebot4", sensor="sparse", num_agents=3)
    assert world == WorldSettings(trained.map, robot=trained.robot, sensor="sparse", num_agents=3)
    assert rcdsac_trl.world_settings() == WorldSettings()


def test_gymnasium_makes_what_is_named(monkeypatch: pytest.MonkeyPatch) -> None:
    given: dict[str, Any] = {}

    class Watched(NavigationGymEnv):
        def __init__(self, world: WorldSettings | None = None, **options: Any) -> None:
            given.update(options)
            super().__init__(world, **options)

    monkeypatch.setattr("rcdsac_trl.config.named_world.NavigationGymEnv", Watched)
    env = gymnasium.make(ENV_ID, map="easy", robot="turtlebot3_burger", sensor="full")
    named = rcdsac_trl.world_settings(map="easy", robot="turtlebot3_burger")
    assert (given["map_settings"], given["robot"]) == (named.map_settings, named.robot)
    assert (named.robot.name, given["sensor"]) == ("turtlebot3_burger", "full")
    assert env.spec is not None
    again = gymnasium.make(env.spec)  # as vector environments do
    assert again.reset(seed=1)[0].keys() == env.reset(seed=1)[0].keys()
    env.close()
    again.close()


def test_a_path_is_a_map_of_a_file(tmp_path: Path) -> None:
    path = tmp_path / "building.json"
    path.touch()
    for named in (path, str(path)):
        assert rcdsac_trl.world_settings(map=named).map_settings == FileMapSettings(path=str(path))
    own = MapSettings(size_m=12.0)
    assert rcdsac_trl.world_settings(map=own).map_settings == own


@pytest.mark.parametrize(
    ("options", "told"),
    [
        (
            {"map": "moon"},
            "^map=moon does not exist: choose one of crowded, easy, furnished, .*, varied, or a file that maps are",
        ),
        ({"map": "file"}, "^map=file does not exist"),
        ({"map": "easy", "map_settings": MapSettings()}, "^map and map_settings both say which maps"),
        ({"robot": "r2d2"}, "^robot=r2d2 does not exist: choose one of jackal, paper, .*, or give a RobotSettings$"),
        ({"mapp": "easy"}, r"^there is no option mapp: did you mean map\?$"),
        ({"wheels": 4}, "^there is no option wheels: choose among map, map_settings, task, "),
        ({"sensor": "wide"}, r"^sensor\.name=wide is unknown"),
    ],
)
def test_what_does_not_exist_is_refused_by_name(options: dict[str, object], told: str) -> None:
    with pytest.raises(UserInputError, match=told):
        rcdsac_trl.world_settings(**options)
    with pytest.raises(UserInputError, match=told):
        gymnasium.make(ENV_ID, **options)
