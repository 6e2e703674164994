"""Robots as settings: the paper's stays what it was, closed forms of shapes and sensors, a sentence for each fault."""

import math
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from rcdsac_trl.config.compose import choices, compose
from rcdsac_trl.config.first_look import look_at_evaluation
from rcdsac_trl.config.run_config import CONFIG_NAME, agent_of_run, settings_of_run, training_settings
from rcdsac_trl.errors import UserInputError
from rcdsac_trl.robot import limits
from rcdsac_trl.robot.action import action_of, clip_command, desired_velocities, inside_dead_band
from rcdsac_trl.robot.observation import range_distances, range_observation
from rcdsac_trl.robot.range_sensor import LidarSettings, sensor_mask
from rcdsac_trl.robot.robot_settings import PAPER, RobotSettings
from rcdsac_trl.training.resume import differing_keys
from rcdsac_trl.world.task.rules import reward_components
from tiny import tiny_cfg, yaml_of

BOX: dict[str, Any] = {"name": "box", "shape": "rectangle", "radius_m": None, "corners": None}


def robot(name: str) -> RobotSettings:
    return training_settings(compose("train", ["+algo=sac", f"robot={name}"])).robot


def as_lists(value: Any) -> Any:
    if isinstance(value, dict):
        return {key: as_lists(each) for key, each in value.items()}
    return [as_lists(each) for each in value] if isinstance(value, tuple) else value


# ------------------------------------------------------------------------------------------------ the paper's robot
def test_the_paper_robot_has_the_papers_numbers() -> None:
    assert yaml_of("robot/paper.yaml") == as_lists(asdict(PAPER))
    assert training_settings(tiny_cfg("sac")).robot == PAPER
    assert (PAPER.min_linear_velocity, PAPER.max_speed_m_per_s) == (-0.2, 0.6)
    assert PAPER.max_angular_velocity == math.radians(90.0)
    assert PAPER.max_acceleration_m_per_s2 == limits.MAX_LINEAR_ACCELERATION == 1.5
    assert PAPER.max_angular_acceleration == math.radians(120.0)
    assert PAPER.dead_band == math.radians(15.0)
    assert (PAPER.motor_period_s, PAPER.circumradius_m, PAPER.body_radius_m) == (0.02, 0.25, 0.2)
    # Nothing is scaled: 1.0 times a number is that number.
    assert (PAPER.reward_per_speed, PAPER.reward_per_turn) == (1.0, 1.0)
    assert PAPER.is_round
    assert PAPER.lidar.mask.all()


def test_a_run_of_before_there_were_robots_drives_the_papers(tiny_run: Path, tmp_path: Path) -> None:
    text = (tiny_run / CONFIG_NAME).read_text()
    before, _, rest = text.partition("\nrobot:\n")
    after = rest.split("\n")
    kept = [
        line for number, line in enumerate(after) if any(not other.startswith(" ") for other in after[: number + 1])
    ]
    (tmp_path / CONFIG_NAME).write_text(before + "\n" + "\n".join(kept))
    assert "robot:" not in (tmp_path / CONFIG_NAME).read_text()
    assert settings_of_run(tmp_path) == settings_of_run(tiny_run)
    assert agent_of_run(tmp_path).robot == PAPER
    # Nor is it another run for who continues it, or a sweep that looks for what it has done.
    assert differing_keys(tmp_path, tiny_cfg("rcdsac_pow")) == ["logger.backends"]
    assert "robot.radius_m" in differing_keys(tmp_path, tiny_cfg("rcdsac_pow", "robot=turtlebot4"))


def test_an_agent_is_evaluated_with_its_own_robot_alone(tiny_run: Path) -> None:
    def spoken(*overrides: str) -> str:
        cfg = compose("evaluate", [f"run={tiny_run}", "beta=[-1]", *overrides])
        with pytest.raises(UserInputError) as raised:
            look_at_evaluation(cfg)
        return str(raised.value)

    told = f"is not what {tiny_run} drives: it was trained for"
    assert spoken("robot=jackal") == f"robot=jackal {told} robot=paper, leave robot out"
    assert spoken("robot.max_speed_m_per_s=1") == f"robot=paper {told} robot.max_speed_m_per_s=0.6, leave robot out"
    assert spoken("robot.lidar.max_range_m=4") == f"robot=paper {told} robot.lidar.max_range_m=3.0, leave robot out"
    look_at_evaluation(compose("evaluate", [f"run={tiny_run}", "beta=[-1]", "robot=paper"]))
    look_at_evaluation(compose("evaluate", ["baseline=dwa", "robot=jackal", "robot.lidar.x_m=0.1"]))


@pytest.mark.parametrize("name", choices("robot"))
def test_every_robot_there_is_can_drive_the_default_maps(name: str) -> None:
    settings = training_settings(compose("train", ["+algo=sac", f"robot={name}"]))
    assert settings.robot.name == name
    assert settings.training_world.robot == settings.robot
    assert RobotSettings.from_mapping(as_lists(asdict(settings.robot))) == settings.robot


def test_a_robot_of_ones_own_lies_in_a_folder_of_ones_own(tmp_path: Path) -> None:
    """As docs/your-robot.md says, for who has installed the package."""
    (tmp_path / "robot").mkdir()
    (tmp_path / "robot" / "mine.yaml").write_text("defaults: [paper, _self_]\nname: mine\nmax_speed_m_per_s: 0.4\n")
    chosen = [f"hydra.searchpath=[{tmp_path}]", "robot=mine", "robot.max_turn_deg_per_s=60"]
    settings = training_settings(compose("train", ["+algo=sac", *chosen]))
    mine = replace(PAPER, name="mine", max_speed_m_per_s=0.4, max_turn_deg_per_s=60)
    assert settings.robot == mine
    assert compose("evaluate", ["baseline=dwa", *chosen]).robot.name == "mine"


# ------------------------------------------------------------------------------------------------ shapes
def test_radii_by_hand() -> None:
    assert pytest.approx(0.25 * math.cos(math.pi / 8)) == PAPER.inradius_m
    box = RobotSettings(**BOX, length_m=0.6, width_m=0.8)
    assert (box.circumradius_m, box.inradius_m, box.is_round) == (pytest.approx(0.5), pytest.approx(0.3), False)
    # The point it turns about lies 0.1 m behind the middle: corners at (0.4, 0.4), the rear side 0.2 m away.
    ahead = RobotSettings(**BOX, length_m=0.6, width_m=0.8, middle_x_m=0.1)
    assert (ahead.circumradius_m, ahead.inradius_m) == (pytest.approx(0.4 * math.sqrt(2)), pytest.approx(0.2))
    disc = RobotSettings("disc", "disc", 0.2, None, middle_x_m=-0.05)
    assert (disc.circumradius_m, disc.inradius_m, disc.is_round) == (pytest.approx(0.25), pytest.approx(0.15), True)
    square = RobotSettings("square", "polygon", 0.2, 4)
    assert (square.circumradius_m, square.inradius_m) == (0.2, pytest.approx(0.2 / math.sqrt(2)))
    assert not square.is_round
    burger = robot("turtlebot3_burger")
    assert burger.circumradius_m == pytest.approx(math.hypot(0.032 + 0.069, 0.089))
    assert burger.inradius_m == pytest.approx(0.069 - 0.032)


def test_the_way_to_a_stop_by_hand() -> None:
    assert PAPER.stopping_distance_m(0.6) == pytest.approx(0.36 / 3.0)
    assert robot("jackal").stopping_distance_m(2.0) == pytest.approx(4.0 / 5.0)


# ------------------------------------------------------------------------------------------------ motion
@pytest.mark.parametrize("name", choices("robot"))
def test_actions_span_the_robots_own_range(name: str) -> None:
    own = robot(name)
    fastest = own.max_speed_m_per_s, own.max_angular_velocity
    assert desired_velocities([1.0, 1.0], own) == pytest.approx(fastest)
    assert desired_velocities([-1.0, -1.0], own) == pytest.approx((-own.max_reverse_m_per_s, -fastest[1]))
    for v, omega in ((0.05, 1.2), (0.0, 0.0), (own.max_speed_m_per_s, -1.5)):
        assert desired_velocities(action_of(v, omega, own), own) == pytest.approx((v, omega))
    assert inside_dead_band(0.99 * own.dead_band, own)
    assert not inside_dead_band(own.dead_band, own)
    v, omega = clip_command(*fastest, 0.0, 0.0, robot=own)
    assert v == pytest.approx(own.max_acceleration_m_per_s2 * own.motor_period_s)
    assert omega == pytest.approx(own.max_angular_acceleration * own.motor_period_s)


@pytest.mark.parametrize("name", choices("robot"))
def test_full_speed_and_full_turns_count_alike_for_all_robots(name: str) -> None:
    own = robot(name)
    _, _, waypoint, angular, _ = reward_components(
        own.max_speed_m_per_s, 0.0, own.max_angular_velocity, False, False, False, own
    )
    assert waypoint == pytest.approx(0.6)
    assert angular == pytest.approx(0.5)  # 1 - 90 / 120 is below the least
    _, _, waypoint, angular, _ = reward_components(
        own.max_speed_m_per_s / 2, math.pi / 3, 0.4 * own.max_angular_velocity, False, False, False, own
    )
    assert (waypoint, angular) == (pytest.approx(0.15), pytest.approx(1.0 - 0.4 * 90.0 / 120.0))


# ------------------------------------------------------------------------------------------------ sensors
def test_names_of_sensors_are_fields_of_view() -> None:
    assert np.array_equal(sensor_mask("narrow"), LidarSettings(field_of_view_deg=((-44.0, 42.0),)).mask)
    assert np.array_equal(sensor_mask("sparse"), LidarSettings(every_bins=10).mask)


def test_sectors_in_view_by_hand() -> None:
    # 270 degrees ahead: whole sectors of 2 degrees up to 134 on either side.
    mask = LidarSettings(field_of_view_deg=((-135.0, 135.0),)).mask
    assert np.array_equal(np.flatnonzero(~mask), np.arange(67, 113))
    behind = LidarSettings(field_of_view_deg=((-90.0, 90.0),), yaw_deg=180.0).mask
    assert np.array_equal(np.flatnonzero(behind), np.arange(45, 135))
    two = LidarSettings(field_of_view_deg=((-10.0, 10.0), (80.0, 100.0))).mask
    assert np.array_equal(np.flatnonzero(two), [0, 1, 2, 3, 4, *range(40, 50), 175, 176, 177, 178, 179])
    # 0.3 m behind the centre it sees, 3 m away, as far as arccos(-0.1) = 95.7 degrees around the centre.
    mounted = LidarSettings(field_of_view_deg=((-90.0, 90.0),), x_m=-0.3).mask
    assert np.array_equal(np.flatnonzero(~mounted), np.arange(47, 133))


def test_an_agent_is_told_what_its_robot_has_in_view() -> None:
    jackal = robot("jackal")
    assert np.array_equal(jackal.sensor_mask("full"), jackal.lidar.mask)
    assert np.array_equal(jackal.sensor_mask("narrow"), sensor_mask("narrow"))
    assert (
        training_settings(tiny_cfg("sac", "robot=jackal", "sensor=full")).sensor_mask.sum() == jackal.lidar.mask.sum()
    )


def test_observations_hold_shares_of_the_reach() -> None:
    mask = np.ones(4, dtype=bool)
    seen = range_observation([2.0, 5.99, 6.0, 0.2], mask, 6.0)
    assert np.array_equal(seen, range_observation([1.0, 2.995, 3.0, 0.1], mask))
    assert seen[:3].tolist() == [2.5, pytest.approx(2.5 + math.log10(2.995)), 0.0]
    assert range_distances(seen, 6.0) == pytest.approx([2.0, 5.99, np.inf, 0.2])


# ------------------------------------------------------------------------------------------------ refusals
@pytest.mark.parametrize(
    ("changes", "told"),
    [
        ({"radius_m": 0.0}, "robot.radius_m=0.0 of a polygon must be a positive number"),
        ({"radius_m": -0.2}, "robot.radius_m=-0.2 of a polygon must be a positive number"),
        ({"radius_m": math.nan}, "robot.radius_m=nan of a polygon must be a positive number"),
        ({"radius_m": 250.0}, "reaches 250 m from its centre"),
        ({"corners": 2}, "robot.corners=2 makes no polygon: give a whole number from 3"),
        ({"corners": 4.5}, "robot.corners=4.5 makes no polygon"),
        ({"shape": "star"}, "robot.shape='star' does not exist: choose one of disc, polygon, rectangle"),
        ({"shape": "disc"}, "robot.corners=8 means nothing to a disc: set it to null"),
        ({"shape": "rectangle"}, "robot.radius_m=0.25 means nothing to a rectangle: set it to null"),
        (BOX | {"length_m": 0.5}, "robot.width_m=None of a rectangle must be a positive number"),
        (
            BOX | {"length_m": 0.5, "width_m": 0.4, "middle_x_m": 0.3},
            "puts the point that the robot turns about outside",
        ),
        ({"max_speed_m_per_s": 0.0}, "robot.max_speed_m_per_s=0.0 must be above 0 and at most 2"),
        ({"max_speed_m_per_s": 600.0}, "robot.max_speed_m_per_s=600.0 must be above 0 and at most 2"),
        ({"max_turn_deg_per_s": -90.0}, "robot.max_turn_deg_per_s=-90.0 must be above 0"),
        ({"max_acceleration_m_per_s2": math.inf}, "robot.max_acceleration_m_per_s2=inf must be above 0"),
        ({"max_reverse_m_per_s": -0.2}, "robot.max_reverse_m_per_s=-0.2 must be from 0 to 2: give a positive number"),
        ({"dead_band_deg_per_s": 90.0}, "robot.dead_band_deg_per_s=90.0 must be from 0 to less than"),
        ({"motor_period_s": 20.0}, "robot.motor_period_s=20.0 must be above 0 and at most 0.1"),
        ({"name": "my robot"}, "robot.name='my robot' is no name"),
    ],
)
def test_what_is_no_robot_is_refused_in_one_sentence(changes: dict[str, Any], told: str) -> None:
    with pytest.raises(UserInputError) as raised:
        replace(PAPER, **changes)
    assert told in str(raised.value)
    assert "\n" not in str(raised.value)


@pytest.mark.parametrize(
    ("changes", "told"),
    [
        ({"field_of_view_deg": ()}, "is empty, so the sensor sees nothing"),
        ({"field_of_view_deg": ((0.5, 1.5),)}, "has no whole sector of 2 degrees in view: widen it"),
        ({"field_of_view_deg": ((42.0, -44.0),)}, "holds [42, -44]: give intervals from right to left"),
        ({"field_of_view_deg": (90.0,)}, "is no list of pairs"),
        ({"every_bins": 0}, "robot.lidar.every_bins=0 is no whole number from 1 to 90"),
        ({"max_range_m": 3500.0}, "robot.lidar.max_range_m=3500 is outside [1, 30]: give metres"),
        ({"x_m": 120.0}, "are more than 0.3 m from the robot's centre"),
        ({"yaw_deg": math.nan}, "robot.lidar.yaw_deg=nan is no finite number"),
    ],
)
def test_what_is_no_sensor_is_refused_in_one_sentence(changes: dict[str, Any], told: str) -> None:
    with pytest.raises(UserInputError) as raised:
        LidarSettings(**changes)
    assert told in str(raised.value)


@pytest.mark.parametrize(
    ("overrides", "told"),
    [
        (
            ["robot.radius_m=0.4"],
            "robot=paper reaches 0.4 m from its centre and needs passages of 1 m, map.door_width_m",
        ),
        (["robot=jackal", "robot.width_m=0.6"], "robot=jackal reaches 0.393 m"),
        (["robot.lidar.field_of_view_deg=[[90,270]]"], "sensor=narrow has no sector that robot=paper has in view"),
        (["robot.lidar.field_of_view_deg=90"], "robot.lidar.field_of_view_deg=90 must be a list of lists in brackets"),
        (["robot.lidar.bins=360"], "robot.lidar"),
        (["robot.radius_m=wide"], "robot.radius_m=wide must be a number or null"),
        (["robot=waffle"], "robot=waffle does not exist: choose one of jackal, paper, turtlebot3_burger, turtlebot4"),
    ],
)
def test_a_training_that_cannot_be_is_refused_before_it_begins(overrides: list[str], told: str) -> None:
    with pytest.raises(UserInputError) as raised:
        training_settings(compose("train", ["+algo=sac", *overrides]))
    assert told in str(raised.value)
