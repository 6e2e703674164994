"""Why robots collide, by hand: what was hit, where, and when it was last sensed."""

import math
from typing import Any

import numpy as np
import pandas as pd
import pytest

from rcdsac_trl.robot.range_sensor import sensor_mask
from rcdsac_trl.rollout.collisions import COLLISION_COLUMNS, COLLISIONS, collision_table, diagnose
from rcdsac_trl.world.maps.shapes import Box, Cylinder, Map, Mover
from rcdsac_trl.world.sim.contact import Touch

PERIOD_S = 0.14
NARROW = sensor_mask("narrow")
NO_MOVERS = np.zeros((5, 0, 2))

WALL = Box(5.0, 8.0, 4.0, 0.1, 0.0, mapped=True, wall=True)
BOX = Box(4.0, 2.0, 0.2, 0.2, 0.0, mapped=True)
PILLAR = Cylinder(8.0, 2.0, 0.3, mapped=False)


def found(touch: Touch, poses: list[tuple[float, float, float]], movers: Any = NO_MOVERS, **changes: Any) -> dict:
    """Diagnose in a place with a long wall, a box and a pillar, and with movers 0.3 m in radius."""
    parts = {"boxes": (WALL, BOX), "cylinders": (PILLAR,), "movers": (Mover(0.3, 0.6),) * movers.shape[1]} | changes
    map_ = Map(layout="clutter", size_m=10.0, **parts)
    row = diagnose(touch, map_, NARROW, np.array(poses), movers[: len(poses)], PERIOD_S)
    assert tuple(row) == COLLISION_COLUMNS
    return row


def at(x: float, y: float, pose: tuple[float, float, float], mover: int | None = None) -> Touch:
    return Touch(x, y, mover, pose, v=0.5, omega=-0.25, motor_step=3)


def test_what_was_hit_where_and_when() -> None:
    """Backwards into a pillar that was ahead before the robot turned about."""
    poses = [(6.0, 2.0, 0.0), (6.5, 2.0, 0.0), (7.0, 2.0, math.pi), (7.2, 2.0, math.pi)]
    row = found(at(7.7, 2.0, (7.46, 2.0, math.pi)), poses)
    assert (row["step"], row["thing"], row["bearing_sensed"]) == (3, "unmapped_clutter", 0)
    assert row["time_s"] == pytest.approx(3 * PERIOD_S + 0.06)
    assert row["unsensed_s"] == pytest.approx(2 * PERIOD_S + 0.06)  # at moment 1, from 1.2 m
    assert abs(row["bearing_rad"]) == pytest.approx(math.pi)
    assert (row["x_m"], row["y_m"]) == (7.7, 2.0)
    assert (row["robot_x_m"], row["robot_y_m"], row["robot_yaw_rad"]) == (7.46, 2.0, math.pi)
    assert (row["robot_v_m_per_s"], row["robot_omega_rad_per_s"]) == (0.5, -0.25)
    assert (row["thing_vx_m_per_s"], row["thing_vy_m_per_s"]) == (0.0, 0.0)


@pytest.mark.parametrize(("degrees", "sensed"), [(41.0, 1), (43.0, 0), (-43.0, 1), (-45.0, 0)])
def test_the_bearing_is_that_of_a_sector_the_sensor_has(degrees: float, sensed: int) -> None:
    pose = (7.46, 2.0, math.radians(-degrees))
    assert found(at(7.7, 2.0, pose), [(7.4, 2.0, 0.0)])["bearing_sensed"] == sensed


def test_what_was_never_ahead_or_in_reach_was_never_sensed() -> None:
    touch = at(7.7, 2.0, (7.46, 2.0, math.pi))
    assert math.isnan(found(touch, [(4.6, 2.0, 0.0), (7.4, 2.0, math.pi)])["unsensed_s"])  # 3.1 m away, then behind
    assert found(touch, [(4.8, 2.0, 0.0), (7.4, 2.0, math.pi)])["unsensed_s"] == pytest.approx(PERIOD_S + 0.06)


def test_what_hides_behind_another_is_not_sensed() -> None:
    """The pillar behind a board that is as wide as the sensor's view."""
    touch, poses = at(7.7, 2.0, (7.46, 2.0, math.pi)), [(6.8, 2.0, 0.0), (7.4, 2.0, math.pi)]
    board = Box(7.0, 2.0, 0.02, 0.6, 0.0, mapped=True)
    assert math.isnan(found(touch, poses, boxes=(WALL, board))["unsensed_s"])
    assert found(touch, poses)["unsensed_s"] == pytest.approx(PERIOD_S + 0.06)


def test_of_a_long_wall_the_part_that_was_hit_counts() -> None:
    """Its end at x = 1 is sensed all the time, the place at x = 8, ahead at first, is not."""
    touch = at(8.0, 7.9, (8.0, 7.66, math.pi))
    poses = [(8.0, 6.0, math.pi / 2), (8.0, 7.3, math.pi), (1.5, 7.0, math.pi / 2)]
    row = found(touch, poses)
    assert row["thing"] == "inner_wall"
    assert row["unsensed_s"] == pytest.approx(2 * PERIOD_S + 0.06)
    # The same wall turned by a right angle is the same wall.
    turned = Box(5.0, 8.0, 0.1, 4.0, math.pi / 2, mapped=True, wall=True)
    assert found(touch, poses, boxes=(turned, BOX)) == pytest.approx(row)


def test_outer_walls_and_the_nearest_of_two() -> None:
    outer = Box(5.0, 9.9, 5.0, 0.1, 0.0, mapped=True, wall=True)
    touching = at(6.0, 9.8, (6.0, 9.56, math.pi / 2))
    assert found(touching, [(6.0, 9.5, math.pi / 2)], boxes=(outer, WALL))["thing"] == "outer_wall"
    beside = at(4.2, 2.0, (4.44, 2.0, math.pi))
    close = Cylinder(4.2 + 0.35, 2.0, 0.3, mapped=False)  # its edge is 0.05 m from the contact, the box's is there
    assert found(beside, [(4.5, 2.0, 0.0)], cylinders=(close,))["thing"] == "mapped_clutter"


def test_a_mover_is_sensed_where_it_walks() -> None:
    """The second of two comes from the left, out of sight, in front of the robot at the first moment alone."""
    movers = np.array(
        [
            [[1.0, 1.0], [4.0, 5.0]],
            [[1.0, 1.0], [2.3, 5.9]],
            [[1.0, 1.0], [2.0, 5.8]],
        ]
    )
    poses = [(2.0, 5.0, 0.0)] * 3
    row = found(at(2.1, 5.24, (2.0, 5.0, 0.0), mover=1), poses, movers)
    assert (row["thing"], row["bearing_sensed"]) == ("mover", 0)
    assert row["unsensed_s"] == pytest.approx(2 * PERIOD_S + 0.06)
    assert row["thing_vx_m_per_s"] == pytest.approx(-0.3 / PERIOD_S)
    assert row["thing_vy_m_per_s"] == pytest.approx(-0.1 / PERIOD_S)
    # The first one, behind it, was never there to be sensed.
    assert math.isnan(found(at(1.9, 4.77, (2.0, 5.0, 0.0), mover=0), poses, movers)["unsensed_s"])


def test_the_table_names_the_condition_and_is_there_without_collisions() -> None:
    row = found(at(7.7, 2.0, (7.46, 2.0, 0.0)), [(7.4, 2.0, 0.0)])
    told = {"beta": [-2.0, -1.0], "collision_weight": [math.nan] * 2, "map": [3, 3], "episode": [0, 1]}
    table = collision_table(pd.DataFrame(told | {"reward": [1.0, 2.0], COLLISIONS: [[], [row, row]]}))
    assert list(table) == [*told, *COLLISION_COLUMNS]
    assert table[["beta", "map", "episode", "step"]].to_numpy().tolist() == [[-1.0, 3, 1, 0]] * 2
    assert list(collision_table(pd.DataFrame(told | {COLLISIONS: [[], []]}))) == list(table)
