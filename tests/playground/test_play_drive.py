"""The drive behind the page, without a page: who drives, what a visitor may do to them, and that it repeats."""

import contextlib
import math
from collections.abc import Iterator
from typing import Any

import numpy as np
import pytest
from scenes_to_play import drive, offers

from rcdsac_trl.config.play_settings import PlaySettings
from rcdsac_trl.deploy import Command
from rcdsac_trl.deploy.navigation.navigator import Advice, Navigator
from rcdsac_trl.deploy.policy.weights import packed
from rcdsac_trl.errors import UserInputError
from rcdsac_trl.playground.drivers import AgentDriver
from rcdsac_trl.playground.page_words import robot_words
from rcdsac_trl.playground.play_drive import Drive
from rcdsac_trl.playground.play_session import offers_of
from rcdsac_trl.playground.scene_choice import SceneChoice
from rcdsac_trl.playground.view_state import robot_view
from rcdsac_trl.rollout.planners.mppi import Mppi
from rcdsac_trl.world.maps.shapes import Box, Map
from rcdsac_trl.world.office.building import make_office
from robots import agent

STEPS = 25


@contextlib.contextmanager
def driven(steps: int = STEPS, **query: str) -> Iterator[Drive]:
    with contextlib.closing(drive(**query)) as scene:
        for _ in range(steps):
            scene.step()
        yield scene


def way(scene: Drive, number: int = 0) -> list[tuple[float, float, float]]:
    return list(scene.robots[number].trail)


# ------------------------------------------------------------------------------------------------ who drives
@pytest.mark.parametrize(
    ("agent", "low", "high"),
    [
        ("rcdsac_cvar-narrow", "careful", "neutral"),
        ("rcdsac_pow-narrow", "careful", "neutral"),
        ("rcwr-narrow", "bold", "careful"),
    ],
)
def test_a_dial_says_what_its_ends_make_of_who_drives(agent: str, low: str, high: str) -> None:
    dial = AgentDriver(offers().weights(agent)).dial
    assert dial is not None
    assert dial.words == (low, high)
    assert (dial.word(dial.low), dial.word(dial.default), dial.word(dial.high)) == (low, "", high)


@pytest.mark.parametrize("name", offers().drivers)
def test_everything_that_is_offered_drives(name: str) -> None:
    with driven(agent=name) as scene:
        (robot,) = scene.robots
        assert robot.steps == STEPS
        assert robot.reward is not None
        start, end = way(scene)[0], way(scene)[-1]
        assert math.dist(start[:2], end[:2]) > 0.5
        assert robot.time_s == pytest.approx(STEPS * scene.period_s)


def test_who_has_a_beta_to_be_turned_drives_unless_another_is_named() -> None:
    assert offers().weights(next(iter(offers().agents))).config.context == "beta"


@pytest.mark.parametrize("sensor", ["narrow", "sparse", "full"])
def test_an_agent_sees_with_the_sensor_that_is_chosen(sensor: str) -> None:
    with driven(3, sensor=sensor, second="dwa") as scene:
        bins = {"narrow": 43, "sparse": 18, "full": 180}[sensor]
        assert [robot.arena.scene().sensor_mask.sum() for robot in scene.robots] == [bins, bins]


def test_who_drives_reckons_with_the_control_period_of_its_world(monkeypatch: pytest.MonkeyPatch) -> None:
    elapsed_s: list[float] = []
    advise, reset = Navigator.advise, Mppi.reset

    def advised(self: Navigator, *given: Any) -> Advice:
        elapsed_s.append(given[4])
        return advise(self, *given)

    def begun(self: Mppi, sensed: Any, rng: Any, period_s: float) -> None:
        elapsed_s.append(period_s)
        reset(self, sensed, rng, period_s)

    monkeypatch.setattr(Navigator, "advise", advised)
    monkeypatch.setattr(Mppi, "reset", begun)
    periods = set()
    for seed in "012":
        elapsed_s.clear()
        with driven(3, agent="rcdsac_cvar-narrow", second="mppi", detours="on", seed=seed) as scene:
            assert elapsed_s == pytest.approx([scene.period_s, 0.0, scene.period_s, scene.period_s])
            periods.add(round(scene.period_s, 2))
    assert len(periods) > 1


def test_a_scene_repeats_and_a_seed_makes_another() -> None:
    with driven() as first, driven() as again, driven(seed="1") as other:
        assert way(first) == way(again) != way(other)


def test_two_robots_meet_the_same_map_and_movers_and_do_not_meet_each_other() -> None:
    with driven(second="rcdsac_pow-narrow", beta="-1", beta2="-1") as scene, driven(beta="-1") as alone:
        one, two = scene.robots
        assert one.arena.map == two.arena.map
        # Two equal agents do the same, bit by bit, as far as what they do is theirs alone.
        assert way(scene, 0) == way(scene, 1) == way(alone)
        assert one.driver is not two.driver
        movers = [robot.arena.simulation.mover_positions for robot in scene.robots]
        assert np.array_equal(*movers)


def test_two_betas_drive_two_ways() -> None:
    with driven(40, second="rcdsac_pow-narrow", beta="-2", beta2="0") as scene:
        assert way(scene, 0) != way(scene, 1)


def test_beta_is_turned_while_it_drives() -> None:
    with driven(15, beta="-2") as turned, driven(40, beta="-2") as kept:
        turned.set_beta(0, 0.0)
        assert turned.choice.beta == 0.0
        for _ in range(25):
            turned.step()
        assert way(turned)[:16] == way(kept)[:16]
        assert way(turned) != way(kept)


def test_who_is_asked_with_another_beta_reconsiders_what_it_wants_and_expects() -> None:
    with driven(beta="-2") as scene:
        (robot,) = scene.robots
        driver, before = robot.driver, robot.command
        assert isinstance(driver, AgentDriver)
        assert before is not None
        told = driver.policy.foresee(0.0)
        scene.set_beta(0, 0.0)
        assert robot.command is not None
        assert robot.command.wanted == told.wanted != before.wanted
        assert robot.command.value == told.value != before.value
        assert robot.command.v_m_per_s == before.v_m_per_s


def test_the_office_is_driven_by_cameras() -> None:
    with driven(6, agent="rcdsac_cvar-narrow", map="office", second="mppi") as scene:
        for robot in scene.robots:
            assert robot.reward is None
            assert robot.arena.scene().map.layout == "office"
            assert way(scene)[-1][0] > way(scene)[0][0]
        assert scene.robots[0].arena.situation().sectors.covered.sum() < 180


def test_the_office_shows_all_of_the_way_and_a_goal_where_it_was_clicked() -> None:
    with driven(1, agent="rcdsac_cvar-narrow", map="office") as scene:
        (robot,) = scene.robots
        office = make_office()
        shown = robot.arena.scene().waypoints
        assert shown[2:].tolist() == office.course[3:].tolist()  # the first two are where the robot takes them to be
        assert shown[:2] == pytest.approx(office.course[1:3], abs=0.5)
        scene.set_goal(12.7, 7.4)
        assert robot.arena.scene().waypoints[-1] == pytest.approx([12.7, 7.4], abs=0.2)
        assert {robot.arena.map.boxes.index(pane) for pane in robot.arena.glass}
        assert len(robot.arena.glass) == sum(piece.glass for piece in office.pieces)


def test_an_exported_agent_that_remembers_drives_by_the_name_of_its_folder(tmp_path: Any) -> None:

    folder = tmp_path / "mine"
    folder.mkdir()
    for name, data in packed(agent(memory_s=9.0)).items():
        (folder / name).write_bytes(data)
    settings = PlaySettings(str(folder), (), "localhost", 0, (), False, 1, "films")
    offered = offers_of(settings)
    assert next(iter(offered.agents)) == "mine"
    with contextlib.closing(Drive(SceneChoice("mine"), offered)) as scene:
        for _ in range(30):
            scene.step()
        assert len(scene.robots[0].arena.scene().remembered)


# ------------------------------------------------------------------------------------------------ what is done to it
def test_a_goal_is_set_for_all_and_reached() -> None:
    with driven(second="rcdsac_cvar-narrow") as scene:
        x, y, _ = scene.robots[0].arena.simulation.pose
        scene.set_goal(x, y)
        goals = [robot.arena.scene().waypoints[-1] for robot in scene.robots]
        assert np.array_equal(*goals)
        assert math.dist(goals[0], (x, y)) < 0.2
        scene.step()
        assert scene.robots[0].goals == 1


def test_obstacles_are_put_and_moved_in_both_worlds() -> None:
    with driven(second="rcdsac_pow-narrow") as scene:
        x, y, _ = scene.robots[0].arena.simulation.pose
        scene.put_obstacle(x + 1.0, y)
        scene.move_obstacle(0, x - 1.0, y)
        for robot in scene.robots:
            assert robot.arena.simulation.put_discs == pytest.approx(np.array([[x - 1.0, y, 0.3]]))


@pytest.mark.parametrize("map_", ["mixed", "office"])
def test_obstacles_cannot_stand_in_a_robot_or_outside_and_are_not_too_many(map_: str) -> None:
    with driven(1, agent="rcdsac_cvar-narrow", map=map_) as scene:
        x, y, _ = scene.robots[0].arena.simulation.pose
        with pytest.raises(UserInputError, match="cannot stand in the robot"):
            scene.put_obstacle(x + 0.4, y)
        with pytest.raises(UserInputError, match="cannot stand outside"):
            scene.put_obstacle(-1.0, y)
        with pytest.raises(UserInputError, match="there is no obstacle 0"):
            scene.move_obstacle(0, x + 1.0, y)
        away = [1.0 + 0.62 * number for number in range(4)]
        scene.put_obstacle(x + away[0], y)
        with pytest.raises(UserInputError, match="stands there already"):
            scene.put_obstacle(x + 1.5, y + 0.1)
        for shift in away[1:]:
            scene.put_obstacle(x + shift, y)
        with pytest.raises(UserInputError, match="4 obstacles are there already"):
            scene.put_obstacle(x, y + 1.0)
        with pytest.raises(UserInputError, match="cannot stand in the robot"):
            scene.move_obstacle(3, x, y)
        with pytest.raises(UserInputError, match="stands there already"):
            scene.move_obstacle(3, x + away[2], y)
        scene.move_obstacle(3, x + away[3] + 0.1, y)  # its own place is not taken
        scene.put_or_take_obstacle(x + away[1], y + 0.2)  # takes the second away
        with pytest.raises(UserInputError, match=r"no obstacle 1: those that stand are \[0, 2, 3\]"):
            scene.move_obstacle(1, x, y + 1.0)
        far = scene.robots[0].arena.simulation.put_discs[1]
        assert np.linalg.norm(far[:2]) > 1000.0
        scene.put_or_take_obstacle(x, y + 1.0)  # and puts it elsewhere
        places = [(x + away[0], y), (x, y + 1.0), (x + away[2], y), (x + away[3] + 0.1, y)]
        assert scene.robots[0].arena.simulation.put_discs[:, :2] == pytest.approx(np.array(places))


def test_a_push_moves_the_robot_aside_as_far_as_there_is_room() -> None:
    with driven(1) as scene:
        simulation = scene.robots[0].arena.simulation
        for side in (1.0, -1.0):
            x, y, yaw = simulation.pose
            scene.push(side)
            x_1, y_1, yaw_1 = simulation.pose
            assert yaw_1 == pytest.approx(yaw)
            ahead, left = _in_frame(x_1 - x, y_1 - y, yaw)
            assert ahead == pytest.approx(0.0, abs=1e-9)
            assert left == pytest.approx(side * 0.5)
        x, y, yaw = simulation.pose
        radius_m = scene.robots[0].driver.robot.circumradius_m
        away_m = radius_m + 0.3 + 0.2  # 0.2 m between both circles
        scene.put_obstacle(x - away_m * math.sin(yaw), y + away_m * math.cos(yaw))
        scene.push(1.0)
        assert math.dist(simulation.pose[:2], (x, y)) == pytest.approx(0.15)  # in steps of 5 cm, and 2 cm stay


def _in_frame(x: float, y: float, yaw: float) -> tuple[float, float]:
    return x * math.cos(yaw) + y * math.sin(yaw), y * math.cos(yaw) - x * math.sin(yaw)


@pytest.mark.parametrize("name", ["sac-narrow", "mppi"])
def test_the_stop_zone_stands_between_who_drives_and_the_wheels(name: str) -> None:
    with driven(30, agent=name, stop="on") as scene:
        (robot,) = scene.robots
        x, y, yaw = robot.arena.simulation.pose
        scene.put_obstacle(x + 0.65 * math.cos(yaw), y + 0.65 * math.sin(yaw))
        scene.step()
        assert robot.command is not None
        assert robot.command.reason is not None
        assert "stop zone" in robot.command.reason
        scene.set_stop_zone(False)
        scene.step()
        assert robot.command.reason is None


def held(scene: Drive) -> Drive:
    """Let the wheels stand, whatever they are told."""
    for robot in scene.robots:
        step = robot.arena.step
        robot.arena.step = lambda v, omega, step=step: step(0.0, 0.0)  # type: ignore[method-assign, misc]
    return scene


def test_an_agent_is_led_around_what_blocks_its_way_and_turned_bold_where_it_stands() -> None:
    with driven(0, beta="-2", second="mppi", detours="on") as scene:
        robot, planner = held(scene).robots
        x, y, yaw = robot.arena.simulation.pose
        scene.set_goal(x + 2.0 * math.cos(yaw), y + 2.0 * math.sin(yaw))  # where it looks
        x_1, y_1 = robot.arena.scene().waypoints[0]
        share = 0.8 / math.dist((x, y), (x_1, y_1))
        block = x + share * (x_1 - x), y + share * (y_1 - y)
        scene.put_obstacle(*block)
        for _ in range(55):  # 6.6 s
            scene.step()
        assert robot.driver.helped == "it stood still: turned to bold"
        assert (planner.detour, planner.driver.helped) == (None, None)
        assert robot.detour is not None
        assert math.dist(robot.detour, block) > 0.3  # beside it; of its far side the agent has seen nothing yet
        shown = robot_view(robot, robot.arena.scene(), None)
        assert shown.detour.tolist() == [[x, y], [*robot.detour]]
        assert robot_words(shown)["limited"] == "it stood still: turned to bold"
        assert robot.driver.beta(-2.0) == 0.0  # what figures weigh by, too
        command = robot.command
        scene.set_beta(0, -1.5)
        assert robot.command is command  # it is still driven as bold as it may be
        scene.set_detours(False)
        assert (robot.detour, robot.driver.helped, robot.driver.beta(-1.5)) == (None, None, -1.5)
        assert robot_words(robot_view(robot, robot.arena.scene(), None))["limited"] == ""
        scene.step()
        assert (robot.detour, robot.driver.helped) == (None, None)
        assert robot_view(robot, robot.arena.scene(), None).detour.shape == (0, 2)
        assert not scene.choice.detours


@pytest.mark.parametrize(("name", "beta"), [("rcwr-narrow", "1"), ("rcdsac_pow-narrow", "0"), ("sac-narrow", "")])
def test_nobody_says_that_beta_turned_where_it_did_not(name: str, beta: str) -> None:
    query = {"agent": name, "detours": "on"} | ({"beta": beta} if beta else {})
    with driven(0, **query) as scene:
        (robot,) = held(scene).robots
        for _ in range(55):
            scene.step()
        driver = robot.driver
        assert isinstance(driver, AgentDriver)
        assert driver.policy.advice is not None
        assert driver.policy.advice.boldness == 1.0
        assert driver.helped is None


def test_a_turn_too_slow_for_an_action_is_driven(monkeypatch: pytest.MonkeyPatch) -> None:
    slow = Command(0.1, 0.15, False, None, (0.1, 0.15), fresh=True)  # the dead band of actions ends at 0.26 rad/s
    with driven(0) as scene:
        monkeypatch.setattr(scene.robots[0].driver, "act", lambda *_: slow)
        for _ in range(5):
            scene.step()
        assert scene.robots[0].arena.situation().velocity == pytest.approx((0.1, 0.15), abs=1e-5)


def test_contacts_are_counted_when_they_begin_and_shown_where() -> None:
    with driven(10, agent="sac-narrow") as scene:
        (robot,) = scene.robots
        robot.driver.act = lambda *_: Command(0.6, 0.0, False, None, (0.6, 0.0))  # type: ignore[method-assign]
        x, y, yaw = robot.arena.simulation.pose
        scene.put_obstacle(x + 0.8 * math.cos(yaw), y + 0.8 * math.sin(yaw))
        for _ in range(15):
            scene.step()
        assert robot.collisions == len(robot.contacts) == 1
        assert robot.in_contact
        assert math.dist(robot.contacts[0], robot.arena.simulation.pose[:2]) < 0.1


# ------------------------------------------------------------------------------------------------ what is refused
@pytest.mark.parametrize(
    ("query", "sentence"),
    [
        ({"agent": "../weights"}, r"no agent \.\./weights is offered: choose one of"),
        ({"second": "/etc/passwd"}, "no agent /etc/passwd is offered"),
        ({"map": "conf/map/easy.yaml"}, "no map conf/map/easy.yaml is offered: choose one of mixed, "),
        ({"sensor": "sonar"}, "sensor=sonar does not exist: choose one of trained, full, narrow, sparse"),
        ({"beta": "1"}, r"beta=1 is outside \[-2, 0\]"),
        ({"second": "rcdsac_cvar-narrow", "beta2": "-1"}, r"beta2=-1 is outside \[0.01, 1\]"),
        ({"agent": "sac-narrow", "beta": "-1"}, "beta=-1 means nothing to who drives"),
        ({"agent": "mppi", "beta": "-1"}, "beta=-1 means nothing to who drives"),
        ({"map": "office", "sensor": "full"}, "leave most of sensor=full dark"),
    ],
)
def test_a_scene_that_cannot_be_had_ends_in_a_sentence(query: dict[str, str], sentence: str) -> None:
    with pytest.raises(UserInputError, match=sentence):
        drive(**query)


def test_beta_cannot_be_turned_where_there_is_none() -> None:
    with driven(1, agent="sac-narrow") as scene:
        with pytest.raises(UserInputError, match="sac-narrow has no beta"):
            scene.set_beta(0, -1.0)
        with pytest.raises(UserInputError, match="there is no second robot"):
            scene.set_beta(1, -1.0)


def test_maps_of_ones_own_are_offered_by_name_and_driven(tmp_path: Any) -> None:
    thick = 0.2
    middle = [(6.0, thick / 2), (6.0, 12.0 - thick / 2)]
    walls = [Box(x, y, 6.0, thick / 2, 0.0, mapped=True, wall=True) for x, y in middle]
    walls += [Box(y, x, thick / 2, 6.0, 0.0, mapped=True, wall=True) for x, y in middle]
    (tmp_path / "hall.json").write_text(Map("hall", 12.0, tuple(walls), (), ()).to_json())
    offered = offers_of(PlaySettings(None, (str(tmp_path / "hall.json"),), "localhost", 0, (), False, 1, "films"))
    assert offered.places[-2:] == ["hall", "office"]
    with contextlib.closing(Drive(SceneChoice("sac-narrow", map="hall"), offered)) as scene:
        scene.step()
        assert scene.robots[0].arena.map.size_m == 12.0
    (tmp_path / "more").mkdir()
    (tmp_path / "more" / "hall.json").write_text((tmp_path / "hall.json").read_text())
    both = (str(tmp_path / "hall.json"), str(tmp_path / "more" / "hall.json"))
    with pytest.raises(UserInputError, match="two maps are called hall: rename the file of one"):
        offers_of(PlaySettings(None, both, "localhost", 0, (), False, 1, "films"))
    (tmp_path / "mixed.json").write_text((tmp_path / "hall.json").read_text())
    with pytest.raises(UserInputError, match="a map set is called mixed: rename the file"):
        offers_of(PlaySettings(None, (str(tmp_path / "mixed.json"),), "localhost", 0, (), False, 1, "films"))
