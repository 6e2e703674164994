"""The core of the environment, on a scripted world: what is paid when, and what is told."""

import math
from collections.abc import Sequence

import numpy as np
import pytest

from rcdsac_trl.errors import UserInputError
from rcdsac_trl.robot.range_sensor import sensor_mask
from rcdsac_trl.world.maps.generator import Map, MapSettings
from rcdsac_trl.world.sim.simulation import StepResult
from rcdsac_trl.world.task import episode as core
from rcdsac_trl.world.task.agent_group import AgentGroup
from rcdsac_trl.world.task.rules import TaskSettings

EMPTY = Map(layout="clutter", size_m=20.0, boxes=(), cylinders=(), movers=())
STRAIGHT_ON = np.array([[1.0, 0.0]])


class ScriptedPlanner:
    """Starts at (1, 1); goal g is at (1 + 4 (g + 1), 1); the way there bends at given points."""

    def __init__(self, corners: Sequence[tuple[float, float]] = ()) -> None:
        self.corners = list(corners)
        self.planned_from: list[tuple[float, float]] = []
        self.wall_x_m: float | None = None

    def sample_free(self, rng: np.random.Generator) -> np.ndarray:
        return np.array([1.0, 1.0])

    def sample_goal(self, rng: np.random.Generator, start: np.ndarray, min_path_m: float) -> np.ndarray:
        return np.asarray(start) + np.array([4.0, 0.0])

    def waypoints(self, start: tuple[float, float], goal: np.ndarray) -> np.ndarray:
        self.planned_from.append(tuple(start))
        return np.array([*self.corners, goal])

    def leg_is_free(self, from_xy: tuple[float, float], to_xy: tuple[float, float]) -> bool:
        """Nothing is in the way but a wall, from which what lies beyond cannot be driven to."""
        return self.wall_x_m is None or from_xy[0] >= self.wall_x_m


class ScriptedSimulation:
    """Does what it is told to have done."""

    mover_positions = np.empty((0, 2))
    mover_radii = np.empty(0)

    script: list[StepResult]
    commands: list[tuple[float, float, int]]

    def load(self, map: Map, planner: ScriptedPlanner, pose: tuple, rng: np.random.Generator) -> None:
        self.commands = []

    def step(self, v_u: float, omega_u: float, motor_steps: int) -> StepResult:
        self.commands.append((v_u, omega_u, motor_steps))
        return self.script[len(self.commands) - 1]

    def scan(self) -> np.ndarray:
        return np.full(180, 1.0)

    def close(self) -> None:
        pass


def moved(x: float, y: float = 1.0, yaw: float = 0.0, v: float = 0.5, contact: bool = False) -> StepResult:
    return StepResult((x, y, yaw), v, 0.0, contact)


@pytest.fixture
def scripted(monkeypatch: pytest.MonkeyPatch):
    def make(
        script: list[StepResult],
        corners: Sequence[tuple[float, float]] = (),
        task: TaskSettings | None = None,
    ) -> tuple[AgentGroup, ScriptedPlanner, ScriptedSimulation]:
        planner, simulation = ScriptedPlanner(corners), ScriptedSimulation()
        simulation.script = script
        monkeypatch.setattr(core, "load_map", lambda *_: (EMPTY, planner))
        monkeypatch.setattr(core, "Simulation", lambda gui, robot: simulation)
        group = AgentGroup(
            MapSettings(),
            task,
            sensor="full",
            split="train",
            seed=0,
            agent_ids=(0,),
            first_episode=0,
            memory_s=0.0,
            gui=False,
        )
        group.reset((0,))
        return group, planner, simulation

    return make


def test_the_reward_of_one_step_is_the_papers(scripted) -> None:
    group, _, _ = scripted([moved(1.1, v=0.5)])
    group.step(STRAIGHT_ON)
    assert group.buffers.reward_components[0] == pytest.approx([-0.02, 0.0, 0.5, 1.2, 0.0])
    assert group.buffers.reward[0, 0] == pytest.approx(0.58)


def test_a_collision_is_paid_at_the_onset_of_each_contact(scripted) -> None:
    contacts = [True, True, False, True, False, False, True, True]
    group, _, _ = scripted([moved(1.1, contact=contact) for contact in contacts])
    paid, touching = [], []
    for _ in contacts:
        group.step(STRAIGHT_ON)
        paid.append(group.buffers.reward_components[0, 4])
        touching.append(bool(group.buffers.contact[0, 0]))
    assert touching == contacts
    assert paid == [-10.0, 0.0, 0.0, -10.0, 0.0, 0.0, -10.0, 0.0]


def test_a_collision_is_paid_in_every_step_of_contact_when_asked(scripted) -> None:
    contacts = [True, True, False, True]
    task = TaskSettings(collision_penalty_mode="per_step")
    group, _, _ = scripted([moved(1.1, contact=contact) for contact in contacts], task=task)
    paid = []
    for _ in contacts:
        group.step(STRAIGHT_ON)
        paid.append(group.buffers.reward_components[0, 4])
    assert paid == [-10.0, -10.0, 0.0, -10.0]


def test_an_episode_begins_without_contact(scripted) -> None:
    group, _, simulation = scripted([moved(1.1, contact=True)] * 2)
    group.step(STRAIGHT_ON)
    group.reset((0,))
    assert not group.buffers.contact[0, 0]
    assert not simulation.commands
    group.step(STRAIGHT_ON)
    assert group.buffers.reward_components[0, 4] == -10.0


def test_collision_weights_scale_the_reward_and_not_the_components(scripted) -> None:
    group, _, _ = scripted([moved(1.1, contact=True)])
    group.step(STRAIGHT_ON, np.array([1.5]))
    assert group.buffers.reward[0, 0] == pytest.approx(-0.02 - 15.0)
    assert group.buffers.reward_components[0] == pytest.approx([-0.02, 0.0, 0.0, 1.2, -10.0])


def test_waypoints_are_taken_within_half_a_metre_and_several_at_once(scripted) -> None:
    group, _, _ = scripted([moved(2.4), moved(2.51), moved(4.0)], corners=[(3.0, 1.0), (3.0, 1.3), (4.2, 3.0)])
    ahead = []
    for _ in range(3):
        group.step(STRAIGHT_ON)
        ahead.append(len(group.scene(0).waypoints))
    # (3, 1.3) is 0.57 m from (2.51, 1): the second step takes the first corner only.
    assert ahead == [4, 3, 3]
    group, _, _ = scripted([moved(2.8)], corners=[(3.0, 1.0), (3.0, 1.3), (4.2, 3.0)])
    group.step(STRAIGHT_ON)
    assert group.scene(0).waypoints.tolist() == [[4.2, 3.0], [5.0, 1.0]]


def test_a_waypoint_stays_until_the_way_to_the_one_after_it_is_free(scripted) -> None:
    group, planner, _ = scripted([moved(2.6), moved(2.7), moved(2.8)], corners=[(3.0, 1.0), (3.0, 3.0)])
    planner.wall_x_m = 2.75
    ahead = []
    for _ in range(3):
        group.step(STRAIGHT_ON)
        ahead.append(len(group.scene(0).waypoints))
    assert ahead == [3, 3, 2]


def test_a_waypoint_that_is_reached_gives_way_whatever_is_in_the_way(scripted) -> None:
    group, planner, _ = scripted([moved(2.8), moved(2.86)], corners=[(3.0, 1.0), (3.0, 3.0)])
    planner.wall_x_m = 9.0
    group.step(STRAIGHT_ON)
    assert len(group.scene(0).waypoints) == 3
    group.step(STRAIGHT_ON)
    assert len(group.scene(0).waypoints) == 2


def test_a_step_is_paid_for_the_waypoint_that_was_next_while_it_was_taken(scripted) -> None:
    # The step ends 0.4 m short of the corner, which lies straight ahead; the next point lies straight to the left.
    group, _, _ = scripted([moved(2.6, v=0.5)], corners=[(3.0, 1.0), (2.6, 3.0)])
    group.step(STRAIGHT_ON)
    assert group.buffers.reward_components[0, 2] == pytest.approx(0.5)
    cosine, sine = group.buffers.waypoint[0, 1:3]
    assert (cosine, sine) == pytest.approx((0.0, 1.0), abs=1e-6)


def test_on_the_last_leg_the_goal_stands_in_both_slots(scripted) -> None:
    group, _, _ = scripted([moved(2.6)], corners=[(3.0, 1.0)])
    first, second = group.buffers.waypoint[0, :3].copy(), group.buffers.waypoint[0, 3:].copy()
    assert first[0] == pytest.approx(math.log10(2.0))
    assert second[0] == pytest.approx(math.log10(4.0))
    group.step(STRAIGHT_ON)
    assert group.buffers.waypoint[0, :3].tolist() == group.buffers.waypoint[0, 3:].tolist()
    assert group.buffers.waypoint[0, 0] == pytest.approx(math.log10(2.4))


def test_reaching_the_goal_pays_and_brings_a_goal_drawn_from_the_last_one(scripted) -> None:
    group, planner, _ = scripted([moved(4.84), moved(4.9, y=1.05), moved(5.0)])
    group.step(STRAIGHT_ON)
    assert not group.buffers.goal_reached[0, 0]
    group.step(STRAIGHT_ON)
    assert group.buffers.goal_reached[0, 0]
    assert group.buffers.reward_components[0, 1] == 10.0
    # The way is planned from where the robot is, but the goal is 4 m from the last goal, not from the robot.
    assert planner.planned_from == [(1.0, 1.0), (4.9, 1.05)]
    assert group.scene(0).waypoints.tolist() == [[9.0, 1.0]]
    group.step(STRAIGHT_ON)
    assert not group.buffers.goal_reached[0, 0]


def test_the_velocity_observation_holds_what_was_measured_and_what_was_asked(scripted) -> None:
    group, _, _ = scripted([StepResult((1.1, 1.0, 0.0), v, -0.2, False) for v in (0.3, 99.0)])
    group.step(np.array([[0.5, -0.5]]))
    assert group.buffers.velocity[0] == pytest.approx([0.3, -0.2, 0.4, -math.pi / 4])
    group.step(np.array([[0.5, -0.5]]))
    assert group.buffers.velocity[0, 0] == 10.0  # the spec's limit


def test_a_delayed_action_acts_later_but_is_observed_and_paid_at_once(scripted) -> None:
    group, _, simulation = scripted([moved(1.0, v=0.0)] * 4, task=TaskSettings(action_delay_steps=2))
    for turn in (1.0, 0.5, 0.0, 0.0):
        group.step(np.array([[1.0, turn]]))
    sent = np.array([(v, omega) for v, omega, _ in simulation.commands])
    assert sent == pytest.approx(np.array([(0, 0), (0, 0), (0.6, math.pi / 2), (0.6, math.pi / 4)]))
    assert group.buffers.velocity[0, 3] == 0.0
    assert group.buffers.reward_components[0, 3] == pytest.approx(1.2)


def test_one_number_of_motor_steps_holds_for_an_episode_and_all_occur(scripted) -> None:
    group, _, simulation = scripted([moved(1.0)] * 3)
    seen = set()
    for _ in range(30):
        group.reset((0,))
        for _ in range(3):
            group.step(STRAIGHT_ON)
        (number,) = {motor_steps for _, _, motor_steps in simulation.commands}
        seen.add(number)
    assert seen == {6, 7, 8}


def test_noise_is_seen_but_not_paid_and_repeats_with_the_seed(scripted) -> None:
    task = TaskSettings(range_noise_std_m=0.05, range_dropout=0.5, odometry_noise_std=(0.1, 0.1))
    runs = []
    for settings in (task, task, TaskSettings()):
        group, _, _ = scripted([moved(1.1)], task=settings)
        group.step(STRAIGHT_ON)
        runs.append({key: array.copy() for key, array in group.buffers.items()})
    noisy, again, exact = runs
    assert all(np.array_equal(noisy[key], again[key]) for key in noisy)
    assert np.array_equal(noisy["reward_components"], exact["reward_components"])
    lost = noisy["range"] == 0.0
    assert 0.3 < lost.mean() < 0.7
    assert np.ptp(noisy["range"][~lost]) > 0.01
    assert (exact["range"] == 2.5).all()
    assert not np.array_equal(noisy["velocity"][0, :2], exact["velocity"][0, :2])
    assert np.array_equal(noisy["velocity"][0, 2:], exact["velocity"][0, 2:])


@pytest.mark.parametrize(
    "action",
    [
        np.array([[np.nan, 0.0]]),
        np.array([[0.0, np.inf]]),
        np.array([[1.001, 0.0]]),
        np.array([0.0, 0.0]),
        np.zeros((2, 2)),
        np.zeros((1, 3)),
        np.array([["a", "b"]]),
        np.array([[0.0, 1.0j]]),
        np.array([[None, 0.0]]),
        np.array([[True, False]]),
    ],
)
def test_actions_that_are_none_are_refused(scripted, action: np.ndarray) -> None:
    group, _, _ = scripted([moved(1.0)])
    with pytest.raises(UserInputError, match=r"in \[-1, 1\]"):
        group.step(action)


@pytest.mark.parametrize(
    ("name", "value"),
    [
        ("seed", -1),
        ("first_episode", -1),
        ("split", "test"),
        ("sensor", "wide"),
        ("agent_ids", ()),
        ("agent_ids", (0, -1)),
        ("agent_ids", (1.5,)),
        ("agent_ids", ("0",)),
    ],
)
def test_wrong_settings_are_refused_by_name(name: str, value: object) -> None:
    good: dict[str, object] = {"sensor": "full", "split": "train", "seed": 0, "agent_ids": (0,)}
    with pytest.raises(UserInputError, match=name):
        AgentGroup(None, None, **({"first_episode": 0, "memory_s": 0.0, "gui": False} | good | {name: value}))


def test_an_agent_that_was_never_reset_says_so() -> None:
    group = AgentGroup(
        None, None, sensor="full", split="train", seed=0, agent_ids=(0,), first_episode=0, memory_s=0.0, gui=False
    )
    with pytest.raises(UserInputError, match="reset"):
        group.scene(0)
    group.close()


def test_rows_may_be_named_in_any_order_and_twice() -> None:
    group = AgentGroup(
        None, None, sensor="full", split="train", seed=0, agent_ids=(0, 1), first_episode=0, memory_s=0.0, gui=False
    )
    group.reset((0, 1), 0)
    first, second = group.buffers.pose.copy()
    assert not np.array_equal(first, second)
    group.reset((1, 0), 0)
    assert np.array_equal(group.buffers.pose, (first, second))
    group.reset((0, 0))
    assert [group.episode(row) for row in (0, 1)] == [1, 0]
    assert np.array_equal(group.buffers.pose[1], second)
    group.close()


def agent_on_a_map() -> core.NavigationAgent:
    agent = core.NavigationAgent(MapSettings(), TaskSettings(), sensor_mask("full"), "evaluation", 0)
    agent.reset(0, 0)
    return agent


def test_a_goal_that_is_set_is_planned_to_and_the_next_is_drawn_from_there() -> None:
    agent = agent_on_a_map()
    drawn = agent.scene().waypoints[-1]
    x, y = agent.set_goal(-3.0, 25.0)  # outside of the map: the nearest place at its edge counts
    assert 0.0 < x < 20.0
    assert 0.0 < y < 20.0
    assert agent.simulation.room_at(x, y, 1.0) >= 0.3 - 1e-9  # the robot, and the planner's margin
    assert agent.scene().waypoints[-1].tolist() == [x, y] != drawn.tolist()
    agent.place((x, y, 0.0))
    agent.step((0.0, 0.0))
    assert agent.goal_reached
    assert agent.scene().waypoints[-1].tolist() != [x, y]
    agent.close()


def test_who_is_placed_elsewhere_sees_from_there_and_plans_anew_to_its_goal() -> None:
    agent = agent_on_a_map()
    goal, seen = agent.scene().waypoints[-1], agent.distances_m
    near = goal + np.array([0.3, 0.0])
    agent.place((*near.tolist(), 1.0))
    assert agent.pose == pytest.approx((*near, 1.0))
    assert agent.velocities == (0.0, 0.0, 0.0, 0.0)
    assert agent.scene().waypoints.tolist() == [goal.tolist()]
    assert not np.array_equal(agent.distances_m, seen)
    agent.close()


def test_a_disc_that_is_put_is_seen_before_the_next_step() -> None:
    agent = agent_on_a_map()
    x, y, yaw = agent.pose
    number = agent.put_disc(x + 0.8 * math.cos(yaw), y + 0.8 * math.sin(yaw), 0.3)
    assert agent.distances_m[0] == pytest.approx(0.5, abs=1e-3)
    agent.move_disc(number, x + 0.9 * math.cos(yaw), y + 0.9 * math.sin(yaw))
    assert agent.distances_m[0] == pytest.approx(0.6, abs=1e-3)
    agent.close()
