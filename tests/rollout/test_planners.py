"""DWA and MPPI: what they remember, what they foresee, how they drive in hand-made scenes, and that they repeat."""

import itertools
import json
import math
import re
from collections.abc import Callable
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any, ClassVar

import numpy as np
import pytest
import torch
from numpy.typing import NDArray
from tensordict import TensorDict

from rcdsac_trl.deploy.navigation.cost_to_go import cost_to_go
from rcdsac_trl.deploy.navigation.local_map import LocalMap, LocalMapSettings
from rcdsac_trl.errors import UserInputError
from rcdsac_trl.robot.action import clip_command
from rcdsac_trl.robot.limits import MAX_LINEAR_VELOCITY, MEAN_PERIOD_S, MOTOR_PERIOD_S
from rcdsac_trl.robot.mover_tracks import MoverTracks, TrackSettings
from rcdsac_trl.robot.observation import range_observation, waypoint_observation
from rcdsac_trl.robot.range_sensor import sensor_mask
from rcdsac_trl.robot.robot_settings import PAPER
from rcdsac_trl.rollout.planners.baselines import baseline_policy, check_baseline
from rcdsac_trl.rollout.planners.controller import Controller, ControllerPolicy
from rcdsac_trl.rollout.planners.dwa import Dwa, DwaSettings
from rcdsac_trl.rollout.planners.mppi import Mppi, MppiSettings
from rcdsac_trl.rollout.planners.trajectory_costs import (
    CostSettings,
    PlannerSettings,
    TrajectoryCosts,
    next_velocities,
)
from rcdsac_trl.world.sim.lidar import sector_distances
from rcdsac_trl.world.task.episode import draw_motor_steps
from rcdsac_trl.world.task.rules import TaskSettings
from scenes import Scene
from tiny import evaluate

NARROW = sensor_mask("narrow")
NOTHING = np.full(180, np.inf)
PLANNERS = [Dwa, Mppi]
DISC = (1.2, 0.0, 0.2)
"""Ahead of the robot; its face is 1 m away."""
CELL_M = LocalMapSettings().cell_m
WITHIN_A_CELL_M = CELL_M + 1e-6


# ------------------------------------------------------------------------------------------------ the local map
def turned(local_map: LocalMap, scene: Scene, turn: float, steps: int) -> None:
    """Turn the robot on the spot, while its map watches."""
    local_map.observe(scene.observation()[0])
    for _ in range(steps):
        scene.move(0.0, math.copysign(PAPER.max_angular_velocity, turn))
        local_map.move(*scene.velocity[:2], MEAN_PERIOD_S)
        local_map.observe(scene.observation()[0])


def test_what_was_seen_is_remembered_out_of_view() -> None:
    scene = Scene(circles=[DISC])
    local_map = LocalMap(LocalMapSettings(), NARROW)
    turned(local_map, scene, 1.0, steps=10)
    assert scene.pose[2] > math.radians(80)
    assert np.isinf(scene.observation()[0]).all()
    assert local_map.distance_m(1.0, 0.0) <= WITHIN_A_CELL_M
    assert local_map.distance_m(-1.0, 0.0) == pytest.approx(LocalMapSettings().reach_m)


def test_a_turn_on_the_spot_keeps_places_within_a_cell() -> None:
    scene = Scene(circles=[DISC, (-1.0, 1.0, 0.2)], sensor="full")
    local_map = LocalMap(LocalMapSettings(), sensor_mask("full"))
    turned(local_map, scene, -1.0, steps=32)  # once around
    assert abs(scene.pose[2]) > 2 * math.pi
    assert np.abs(np.hypot(*local_map.pose[:2])) < 1e-6
    for x, y, radius in scene.circles:
        near_x, near_y = (along * (1 - radius / math.hypot(x, y)) for along in (x, y))
        assert local_map.distance_m(near_x, near_y) <= WITHIN_A_CELL_M
    seen = local_map.points[local_map.points[..., 2] > 0.0]
    gaps = np.min([abs(np.hypot(seen[:, 0] - x, seen[:, 1] - y) - radius) for x, y, radius in scene.circles], axis=0)
    assert gaps.max() < CELL_M


def test_odometry_is_the_integral_of_measured_velocities() -> None:
    scene, local_map = Scene(), LocalMap(LocalMapSettings(), NARROW)
    for step in range(60):
        scene.move(0.5, 0.9 if step % 20 < 10 else -0.4)
        local_map.move(*scene.velocity[:2], MEAN_PERIOD_S)
    assert math.dist(local_map.pose[:2], scene.pose[:2]) < 0.05
    assert abs(math.remainder(local_map.pose[2] - scene.pose[2], 2 * math.pi)) < 0.05


def test_rays_clear_what_is_gone() -> None:
    local_map = LocalMap(LocalMapSettings(), NARROW)
    local_map.observe(Scene(circles=[DISC]).observation()[0])
    assert local_map.distance_m(1.0, 0.0) <= WITHIN_A_CELL_M
    local_map.observe(Scene(circles=[(2.5, 0.0, 0.3)]).observation()[0])
    assert local_map.distance_m(1.0, 0.0) > 0.5
    assert local_map.distance_m(2.2, 0.0) <= WITHIN_A_CELL_M


def test_rays_that_end_before_it_clear_nothing() -> None:
    local_map = LocalMap(LocalMapSettings(), NARROW)
    local_map.observe(Scene(circles=[(2.2, 0.0, 0.2)]).observation()[0])
    local_map.observe(Scene(circles=[DISC]).observation()[0])
    assert local_map.distance_m(2.0, 0.0) <= WITHIN_A_CELL_M


@pytest.mark.parametrize(("steps", "known"), [(57, True), (58, False)])
def test_it_forgets_after_its_time(steps: int, known: bool) -> None:
    local_map = LocalMap(LocalMapSettings(memory_s=8.0), np.zeros(180, np.bool_))
    local_map.sensed[0] = True
    seen = NOTHING.copy()
    seen[0] = 1.0
    local_map.observe(seen)
    local_map.sensed[0] = False  # looks away for good
    for _ in range(steps):
        local_map.move(0.0, 0.0, MEAN_PERIOD_S)
        local_map.observe(NOTHING)
    assert (local_map.distance_m(1.0, 0.0) <= WITHIN_A_CELL_M) == known


def test_the_map_rolls_with_the_robot() -> None:
    scene, local_map = Scene(circles=[DISC]), LocalMap(replace(LocalMapSettings(), memory_s=100.0), NARROW)
    local_map.observe(scene.observation()[0])
    for _ in range(10):  # backwards out of the square, and in again
        local_map.move(-2.0, 0.0, 0.2)
    assert local_map.distance_m(*local_map.pose[:2]) == pytest.approx(0.8)
    local_map.observe(NOTHING)
    local_map.pose[:] = 0.0
    local_map.observe(np.where(NARROW, 2.9, np.inf))  # sees nothing at the disc, which was forgotten anyway
    assert local_map.distance_m(1.0, 0.0) == pytest.approx(0.8)


def test_the_field_is_the_distance_to_the_nearest_cell() -> None:
    rng = np.random.default_rng(0)
    local_map = LocalMap(LocalMapSettings(), sensor_mask("full"))
    local_map.pose[:] = 7.3, -4.2, 1.0
    local_map.observe(rng.uniform(0.3, 3.5, 180))
    x0, y0 = local_map.corner
    seen = local_map.points[local_map.points[..., 2] >= 0.0]
    cells = np.floor((seen[:, :2] - (x0, y0)) / CELL_M)
    assert len(cells) > 100
    n = LocalMapSettings().num_cells
    for row, column in itertools.product(range(0, n, 7), repeat=2):
        nearest = CELL_M * np.hypot(cells[:, 0] - column, cells[:, 1] - row).min()
        assert local_map.field_m[row, column] == pytest.approx(min(nearest, 0.8), abs=1e-5)


def test_a_contact_that_is_not_seen_is_felt() -> None:
    scene = Scene()
    known = TrajectoryCosts(PlannerSettings(), NARROW, 20)
    known.observe(*scene.observation())
    back = np.full((1, 20, 2), (-0.2, 0.0))
    free = known.of(back)[0]
    scene.velocity = (-0.19, 0.0, -0.2, 0.0)  # as it should be
    known.observe(*scene.observation())
    assert known.of(back)[0] == pytest.approx(free, abs=0.1)
    scene.velocity = (0.0, 0.0, -0.2, 0.0)  # something stops it
    known.observe(*scene.observation())
    assert known.of(back)[0] > free + 10 * CostSettings().collision_m
    assert known.local_map.distance_m(known.local_map.pose[0] - 0.25, 0.0) <= WITHIN_A_CELL_M


# ------------------------------------------------------------------------------------------------ what moves
def tracked(velocity: tuple[float, float], steps: int, sensor: NDArray[np.bool_] = NARROW) -> MoverTracks:
    tracks = MoverTracks(TrackSettings(), sensor)
    for step in range(steps):
        x, y = (start + speed * MEAN_PERIOD_S * step for start, speed in zip((1.8, -0.5), velocity, strict=True))
        scene = Scene(circles=[(x, y, 0.25)], segments=[(2.9, -3.0, 2.9, 3.0)])
        tracks.observe(scene.observation()[0], np.zeros(3), MEAN_PERIOD_S)
    return tracks


def test_a_disc_that_walks_is_tracked_with_its_velocity() -> None:
    (x, y, vx, vy, radius, unseen_s), *others = tracked((0.0, 0.4), steps=15).moving
    assert not others
    assert (x, y) == pytest.approx((1.8, -0.5 + 0.4 * MEAN_PERIOD_S * 14), abs=0.1)
    assert (vx, vy) == pytest.approx((0.0, 0.4), abs=0.12)
    assert radius == TrackSettings().radius_m
    assert unseen_s == 0.0


def test_what_stands_does_not_move() -> None:
    assert len(tracked((0.0, 0.0), steps=30).moving) == 0


def test_what_stands_behind_a_robot_that_sees_all_around_and_turns_does_not_move() -> None:
    full = sensor_mask("full")
    tracks = MoverTracks(TrackSettings(), full)
    pillar = np.array([(-1.3, 0.0, 0.3)])
    for step in range(100):
        pose = np.array([0.0, 0.0, 0.4 * math.sin(0.6 * MEAN_PERIOD_S * step)])
        tracks.observe(sector_distances(*pose, np.empty((0, 4)), pillar), pose, MEAN_PERIOD_S, full)
        assert len(tracks.moving) == 0


def test_a_sparse_sensor_tracks_nothing() -> None:
    assert len(tracked((0.0, 0.4), 15, sensor_mask("sparse")).moving) == 0


def test_a_track_goes_on_unseen_for_its_time() -> None:
    tracks = tracked((0.0, 0.4), steps=15)
    before = tracks.moving[0]
    for _ in range(14):  # 1.96 s
        tracks.observe(NOTHING, np.zeros(3), MEAN_PERIOD_S)
    assert tracks.moving[0, :2] == pytest.approx(before[:2] + 14 * MEAN_PERIOD_S * before[2:4])
    tracks.observe(NOTHING, np.zeros(3), MEAN_PERIOD_S)
    assert len(tracks.moving) == 0


def test_the_map_leaves_out_what_moves() -> None:
    seen = Scene(circles=[DISC]).observation()[0]
    local_map = LocalMap(LocalMapSettings(), NARROW)
    local_map.observe(seen, np.array([(1.2, 0.0, 0.0, 0.3, 0.25, 0.0)]))
    assert local_map.distance_m(1.0, 0.0) == pytest.approx(0.8)


def test_what_is_seen_now_stays_where_a_track_only_guesses() -> None:
    guess = np.array([(1.2, 0.0, 0.0, 0.3, 0.25, 0.14)])
    local_map = LocalMap(LocalMapSettings(), NARROW)
    local_map.observe(Scene(circles=[DISC]).observation()[0], guess)
    assert local_map.distance_m(1.0, 0.0) <= WITHIN_A_CELL_M
    local_map.move(0.0, 0.0, MEAN_PERIOD_S)
    local_map.observe(np.full(180, 0.5), guess)  # looks at something nearer
    assert local_map.distance_m(1.0, 0.0) > 0.4


# ------------------------------------------------------------------------------------------------ cost to go
def test_in_open_space_the_cost_to_go_is_the_distance() -> None:
    cells, cell_m = 48, 0.1
    middles = (np.arange(cells) + 0.5) * cell_m
    for target in ((2.0, 1.0), (9.0, 3.0), (-4.0, -5.0)):
        values = cost_to_go(np.ones((cells, cells)), (0.0, 0.0), cell_m, target)
        straight = np.hypot(middles[None, :] - target[0], middles[:, None] - target[1])
        assert np.abs(values - straight).max() < 0.25
        assert (values >= straight - 1e-9).all()


def test_the_cost_to_go_leads_around_a_wall_through_its_door() -> None:
    prices = np.ones((48, 48))
    prices[24, :40] = 1000.0  # a wall along x, its door to the right
    values = cost_to_go(prices, (0.0, 0.0), 0.1, (2.0, 3.5))
    row, column = 10, 20
    way = math.dist((2.05, 1.05), (4.05, 2.45)) + math.dist((4.05, 2.45), (2.0, 3.5))
    assert values[row, column] == pytest.approx(way, rel=0.08)
    for _ in range(40):  # downhill is through the door
        around = [(row + i, column + j) for i, j in itertools.product((-1, 0, 1), repeat=2)]
        row, column = min(around, key=lambda cell: values[cell])
        assert prices[row, column] == 1.0
    assert values[row, column] < 0.2


# ------------------------------------------------------------------------------------------------ trajectories
@pytest.mark.parametrize("period_s", [MOTOR_PERIOD_S, MEAN_PERIOD_S])
def test_the_motion_model_is_the_motor_controllers(period_s: float) -> None:
    velocities = list(itertools.product((-0.2, 0.0, 0.1, 0.6), (-1.5, -0.3, 0.0, 0.9)))
    for (v_u, omega_u), (v, omega) in itertools.product(velocities, repeat=2):
        expected = clip_command(v_u, omega_u, v, omega, period_s)
        assert next_velocities(v_u, omega_u, v, omega, period_s) == expected


def costs_of(scene: Scene, *controls: tuple[float, float], settings: PlannerSettings | None = None) -> NDArray:
    """Return what it costs to hold pairs of velocities for 2.8 s."""
    costs = TrajectoryCosts(settings or PlannerSettings(), scene.sensed, 20)
    costs.observe(*scene.observation())
    return costs.of(np.repeat(np.array(controls, np.float64)[:, None], 20, axis=1))


def test_in_open_space_a_trajectory_gains_its_way_straight_on() -> None:
    stand, drive = costs_of(Scene(), (0.0, 0.0), (0.6, 0.0))
    # To speed takes 0.4 s, so the way is 0.6 * (2.8 - 0.2) m; looking at the goal is as good from everywhere.
    assert stand - drive == pytest.approx(1.2 * 0.6 * 2.6, rel=0.02)


def test_inside_the_dead_band_a_trajectory_is_straight() -> None:
    straight, inside, outside = costs_of(Scene(), (0.6, 0.0), (0.6, 0.25), (0.6, 0.27))
    assert straight == inside
    assert straight < outside


def test_contact_stops_and_costs_every_step() -> None:
    wall = Scene(segments=[(1.0, -3.0, 1.0, 3.0)])
    stand, drive = costs_of(wall, (0.0, 0.0), (0.6, 0.0))
    # 0.75 m at up to 0.6 m/s take 1.45 s, to the cell more or less 9 to 11 steps, and in the others the robot pushes.
    pushing = (drive - stand) / CostSettings().collision_m
    assert 8.7 < pushing < 11.3


def test_what_was_seen_and_is_out_of_view_still_costs() -> None:
    costs = {}
    for memory_s in (0.5, 8.0):
        settings = PlannerSettings(local_map=LocalMapSettings(memory_s=memory_s))
        scene = Scene(circles=[(0.9, 0.0, 0.2)], waypoints=((0.0, -3.0), (0.0, -3.0)))
        known = TrajectoryCosts(settings, NARROW, 20)
        known.observe(*scene.observation())
        for _ in range(10):
            scene.move(0.0, PAPER.max_angular_velocity)
            known.observe(*scene.observation())
        while abs(scene.velocity[1]) > 0:
            scene.move(0.0, 0.0)
            known.observe(*scene.observation())
        assert np.isinf(scene.observation()[0]).all()
        back_to_it = np.full((1, 20, 2), (0.6, 0.0))
        turn = round(scene.pose[2] / PAPER.max_angular_velocity / MEAN_PERIOD_S)
        back_to_it[0, :turn] = 0.0, -PAPER.max_angular_velocity
        costs[memory_s] = known.of(back_to_it)[0]
    assert costs[8.0] > costs[0.5] + CostSettings().collision_m


@pytest.mark.parametrize("period_s", [0.12, 0.16])
def test_what_was_seen_is_where_the_episodes_own_period_leads(period_s: float) -> None:
    known = TrajectoryCosts(PlannerSettings(), NARROW, 20, period_s=period_s)
    for _ in range(11):
        known.observe(NOTHING, np.full((2, 2), 3.0), np.array([0.5, 0.0, 0.5, 0.0]))
    assert known.local_map.place[0] == pytest.approx(0.5 * 10 * period_s)


def test_who_walks_into_the_way_costs_and_who_has_walked_out_does_not() -> None:
    # Where the robot is in 2.8 s, a mover is then, or is now.
    drive = np.full((1, 20, 2), (0.6, 0.0))
    costs = {}
    for start, speed in ((-1.0, 0.4), (0.0, 0.4)):
        known = TrajectoryCosts(PlannerSettings(), NARROW, 20)
        for step in range(12):
            y = start + speed * MEAN_PERIOD_S * (step - 11)
            known.observe(*Scene(circles=[(1.8, y, 0.25)], waypoints=((5.0, 0.0), (5.0, 0.0))).observation())
        assert len(known.tracks.moving) == 1
        costs[start] = known.of(drive)[0]
    assert costs[-1.0] > costs[0.0] + CostSettings().collision_m


# ------------------------------------------------------------------------------------------------ driving
@pytest.mark.parametrize("make", PLANNERS)
@pytest.mark.parametrize("sensor", ["narrow", "sparse", "full"])
def test_open_space_is_driven_straight(make: Callable[[], Controller], sensor: str) -> None:
    scene = Scene(sensor=sensor)  # type: ignore[arg-type]
    controller = make()
    controller.reset(scene.sensed, np.random.default_rng(0), MEAN_PERIOD_S)
    beside = []
    for _ in range(60):
        scene.move(*controller.act(*scene.observation()))
        beside.append(abs(scene.pose[1]))
        if scene.distance_to_goal_m() < 0.15:
            break
    assert scene.distance_to_goal_m() < 0.15
    assert max(beside) < 0.1
    # 3.85 m at 0.6 m/s, to which it speeds up in 0.4 s.
    assert len(beside) * MEAN_PERIOD_S < 1.15 * (3.85 / MAX_LINEAR_VELOCITY + 0.2)


@pytest.mark.parametrize("make", PLANNERS)
def test_a_goal_behind_is_turned_to(make: Callable[[], Controller]) -> None:
    scene = Scene(waypoints=((-2.0, 0.3), (-2.0, 0.3))).drive(make(), steps=80)
    assert scene.distance_to_goal_m() < 0.15


@pytest.mark.parametrize("make", PLANNERS)
@pytest.mark.parametrize("aside_m", [0.0, 0.3, -0.3])
def test_a_wall_in_the_way_is_driven_around(make: Callable[[], Controller], aside_m: float) -> None:
    wall = (1.5, -0.8 + aside_m, 1.5, 0.8 + aside_m)
    scene = Scene(segments=[wall]).drive(make(), steps=120)
    assert scene.distance_to_goal_m() < 0.15
    assert scene.smallest_gap_m > 0.02


@pytest.mark.parametrize("make", PLANNERS)
def test_a_door_is_driven_through(make: Callable[[], Controller]) -> None:
    scene = Scene(segments=[(1.5, -3.0, 1.5, -0.1), (1.5, 0.8, 1.5, 3.0)]).drive(make(), steps=120)
    assert scene.distance_to_goal_m() < 0.15
    assert scene.smallest_gap_m > 0.02


@pytest.mark.parametrize("make", PLANNERS)
def test_it_stops_before_a_wall_that_it_cannot_pass(make: Callable[[], Controller]) -> None:
    cell = [(1.5, -1.0, 1.5, 1.0), (-1.0, -1.0, 1.5, -1.0), (-1.0, 1.0, 1.5, 1.0), (-1.0, -1.0, -1.0, 1.0)]
    scene = Scene(segments=cell, sensor="full").drive(make(), steps=150)
    assert scene.smallest_gap_m > 0.02


# ------------------------------------------------------------------------------------------------ batches
def observations(scenes: list[Scene], is_init: bool) -> TensorDict:
    ranges, waypoints, velocities = zip(*(scene.observation() for scene in scenes), strict=True)
    told = [waypoint_observation((0.0, 0.0, 0.0), *points.tolist()) for points in waypoints]
    return TensorDict(
        {
            "range": torch.from_numpy(np.stack([range_observation(each, NARROW) for each in ranges])),
            "waypoint": torch.tensor(told),
            "velocity": torch.tensor(np.array(velocities), dtype=torch.float32),
            "is_init": torch.full((len(scenes), 1), is_init),
        },
        batch_size=[len(scenes)],
    )


def scenes_of(agent_ids: list[int]) -> list[Scene]:
    return [Scene(circles=[(1.0 + 0.2 * agent, 0.1, 0.2)]) for agent in agent_ids]


def told(name: str, agent_ids: list[int], seed: int = 0) -> ControllerPolicy:
    """Return the policy of a planner that is told how long a step takes."""
    policy = baseline_policy(name, sensor="narrow", agent_ids=agent_ids, seed=seed)
    assert isinstance(policy, ControllerPolicy)
    policy.set_periods([MEAN_PERIOD_S] * len(agent_ids))
    return policy


def actions(name: str, agent_ids: list[int], *, seed: int = 0, map_index: int = 0, steps: int = 4) -> NDArray:
    """Return what a baseline does with some agents, [steps, agents, 2]."""
    policy = told(name, agent_ids, seed)
    policy.set_map(map_index)
    scenes = scenes_of(agent_ids)
    return np.stack([policy(observations(scenes, step == 0))["action"].numpy() for step in range(steps)])


@pytest.mark.parametrize("name", ["dwa", "mppi"])
def test_the_same_seed_gives_the_same_actions_whoever_else_there_is(name: str) -> None:
    together = actions(name, [0, 1, 2])
    assert together.dtype == np.float32
    assert np.abs(together).max() <= 1.0
    assert np.array_equal(together, actions(name, [0, 1, 2]))
    assert np.array_equal(together[:, 1:], actions(name, [1, 2]))
    assert np.array_equal(together[:, [2]], actions(name, [2]))


def test_noise_derives_from_seed_map_and_agent() -> None:
    policy = told("mppi", [0, 1])
    same = scenes_of([0, 0])
    first = policy(observations(same, True))["action"]
    assert not torch.equal(first[0], first[1])
    plain = actions("mppi", [0])
    assert not np.array_equal(plain, actions("mppi", [0], seed=1))
    assert not np.array_equal(plain, actions("mppi", [0], map_index=1))


@pytest.mark.parametrize("name", ["dwa", "mppi"])
def test_an_agent_that_begins_forgets_and_the_others_do_not(name: str) -> None:
    policy = told(name, [0, 1])
    scenes = scenes_of([0, 1])
    first = policy(observations(scenes, True))["action"].clone()
    second = policy(observations(scenes, False))["action"].clone()
    again = observations(scenes, False)
    again["is_init"][0] = True
    third = policy(again)["action"]
    assert torch.equal(third[0], first[0])
    if name == "mppi":  # whose noise goes on
        assert not torch.equal(third[1], first[1])
        assert not torch.equal(third[1], second[1])


# ------------------------------------------------------------------------------------------------ one's own
class Creep:
    """A controller as a user writes one."""

    def reset(self, sensed: NDArray[np.bool_], rng: np.random.Generator, period_s: float) -> None:
        assert sensed.sum() == 43
        self.rng = rng

    def act(self, ranges_m: NDArray, waypoints_m: NDArray, velocity: NDArray) -> tuple[float, float]:
        assert ranges_m.shape == (180,)
        assert waypoints_m.shape == (2, 2)
        assert velocity.shape == (4,)
        x, y = waypoints_m[0]
        return 0.2, math.atan2(y, x) + 0.1 * self.rng.standard_normal()


class Noting(Creep):
    """Notes the periods of its episodes."""

    periods_s: ClassVar[list[float]] = []

    def reset(self, sensed: NDArray[np.bool_], rng: np.random.Generator, period_s: float) -> None:
        super().reset(sensed, rng, period_s)
        self.periods_s.append(period_s)


class Fast(Creep):
    def act(self, *_: NDArray) -> tuple[float, float]:
        return 3.0, -7.0


class Silent(Creep):
    def act(self, *_: NDArray) -> None:  # type: ignore[override]
        return None


class NotANumber(Creep):
    def act(self, *_: NDArray) -> tuple[float, float]:
        return 0.1, math.nan


class Three(Creep):
    def act(self, *_: NDArray) -> tuple[float, ...]:  # type: ignore[override]
        return 0.1, 0.2, 0.3


class Broken(Creep):
    def act(self, *_: NDArray) -> tuple[float, float]:
        raise ZeroDivisionError("no range")


class NoAct:
    def reset(self, sensed: NDArray[np.bool_], rng: np.random.Generator, period_s: float) -> None: ...


class Asks(Creep):
    def __init__(self, gain: float) -> None: ...


HERE = __name__


def test_desired_velocities_become_actions_and_are_clipped() -> None:
    assert actions(f"{HERE}:Fast", [0], steps=1).tolist() == [[[1.0, -1.0]]]
    slow = actions(f"{HERE}:Creep", [0], steps=1)[0, 0]
    assert slow[0] == pytest.approx(0.0)  # 0.2 m/s is the middle of -0.2 to 0.6


def test_a_controller_is_told_the_period_of_its_episode(tmp_path: Path) -> None:
    Noting.periods_s.clear()
    evaluate(
        f"baseline={HERE}:Noting", "num_maps=2", "num_episodes=6", "task.episode_steps=3", f"out={tmp_path / 'out'}"
    )
    steps = [draw_motor_steps(TaskSettings(), "evaluation", 0, map_, agent) for map_ in range(2) for agent in range(6)]
    assert Noting.periods_s[-12:] == pytest.approx([MOTOR_PERIOD_S * each for each in steps])
    assert len(set(steps)) == 3


@pytest.mark.parametrize(
    ("name", "sentence"),
    [
        ("random", "baseline=random is unknown: choose one of pursuit, dwa, mppi, or <module>:<class>"),
        ("a b:C", "baseline=a b:C is unknown: choose one of pursuit, dwa, mppi, or <module>:<class>"),
        (":C", "baseline=:C is unknown: choose one of pursuit, dwa, mppi, or <module>:<class>"),
        ("nowhere.at_all:C", "baseline=nowhere.at_all:C: cannot import nowhere.at_all: ModuleNotFoundError: "),
        (f"{HERE}:Nobody", f"baseline={HERE}:Nobody: module {HERE} has no Nobody"),
        (f"{HERE}:Asks", f"baseline={HERE}:Asks: cannot call Asks() without arguments: TypeError: "),
        (f"{HERE}:NoAct", f"baseline={HERE}:NoAct has no act(): a controller has reset(sensed, rng, period_s) and"),
        (f"{HERE}:Silent", f"baseline={HERE}:Silent answered None: act() must return the desired velocities, two"),
        (f"{HERE}:NotANumber", f"baseline={HERE}:NotANumber answered (0.1, nan): act() must return"),
        (f"{HERE}:Three", f"baseline={HERE}:Three answered (0.1, 0.2, 0.3): act() must return"),
        (f"{HERE}:Broken", f"baseline={HERE}:Broken: cannot drive a first step: ZeroDivisionError: no range"),
    ],
)
def test_it_refuses_what_cannot_drive(name: str, sentence: str) -> None:
    with pytest.raises(UserInputError) as refused:
        check_baseline(name, "narrow")
    assert str(refused.value).startswith(sentence)


@pytest.mark.parametrize(
    ("settings", "sentence"),
    [
        (lambda: LocalMapSettings(memory_s=0.0), "memory_s=0.0 must be a positive number"),
        (lambda: LocalMapSettings(size_m=1.0), "size_m=1 must be above twice reach_m=0.8 and a cell"),
        (lambda: TrackSettings(coast_s=math.inf), "coast_s=inf must be a positive number"),
        (lambda: CostSettings(margin_m=0.0), "margin_m=0.0 must be a positive number"),
        (lambda: CostSettings(collision_m=-1.0), "collision_m=-1.0 must be a positive number"),
        (lambda: MppiSettings(samples=6), "samples=6 must be above 6: those are not random"),
        (lambda: MppiSettings(temperature_m=0.0), "temperature_m=0.0 must be above 0"),
        (lambda: DwaSettings(angular=2), "angular=2 must be at least 3"),
    ],
)
def test_settings_refuse(settings: Callable[[], object], sentence: str) -> None:
    with pytest.raises(UserInputError) as refused:
        settings()
    assert str(refused.value) == sentence


# ------------------------------------------------------------------------------------------------ documents
@pytest.mark.parametrize("settings", [MppiSettings, DwaSettings, CostSettings, LocalMapSettings, TrackSettings])
def test_the_page_tells_every_parameter(settings: Callable[[], Any]) -> None:
    page = (Path(__file__).parents[2] / "docs" / "planners.md").read_text()
    table = page.split(f"**`{settings.__name__}`**")[1].split("\n**")[0].split("\n## ")[0]
    told = {name: float(value) for name, value in re.findall(r"^\| `(\w+)` \| (\S+) \|", table, re.M)}
    assert told == {name: value for name, value in asdict(settings()).items() if name != "common"}


# ------------------------------------------------------------------------------------------------ evaluation
SHORT = ("map=easy", "sensor=narrow", "task=default", "task.episode_steps=20", "num_maps=3")


@pytest.mark.parametrize("name", ["mppi", f"{HERE}:Creep"])
def test_processes_do_not_change_a_baselines_evaluation(name: str, tmp_path: Path) -> None:
    alone = evaluate(f"baseline={name}", *SHORT, f"out={tmp_path / 'a'}")
    shared = evaluate(f"baseline={name}", *SHORT, f"out={tmp_path / 'b'}", "num_workers=2")
    for file in ("episodes.csv", "summary.csv", "evaluation.json"):
        assert (alone / file).read_bytes() == (shared / file).read_bytes()


def test_the_description_names_the_baseline_and_its_parameters(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    described = json.loads((evaluate("baseline=dwa", *SHORT[:-1]) / "evaluation.json").read_text())
    assert described["agent"] == "dwa"
    assert described["baseline"]["common"]["local_map"]["memory_s"] == LocalMapSettings().memory_s
    assert (tmp_path / "evaluation" / "dwa-narrow-evaluation-seed0-1x2" / "episodes.csv").exists()
    own = evaluate(f"baseline={HERE}:Creep", *SHORT[:-1])
    assert own.resolve() == tmp_path / "evaluation" / f"{HERE}-Creep-narrow-evaluation-seed0-1x2"
