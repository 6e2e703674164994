"""What an agent remembers: carried along, cleared, forgotten, tracked; and only what its sensor has is read."""

import math

import numpy as np
import pytest
from numpy.typing import NDArray

from rcdsac_trl.robot.dead_reckoning import DeadReckoning
from rcdsac_trl.robot.foreseen_clearance import ForeseenClearance
from rcdsac_trl.robot.observation import NUM_REMEMBERED_SECTORS, REMEMBERED_SIZE
from rcdsac_trl.robot.range_sensor import LidarSettings, sensor_mask
from rcdsac_trl.robot.remembered_ranges import RememberedRanges
from rcdsac_trl.robot.robot_settings import RobotSettings
from rcdsac_trl.world.sim.lidar import sector_distances

PERIOD_S = 0.14
NARROW = sensor_mask("narrow")
FULL = sensor_mask("full")
NOTHING = np.full(180, np.inf)
Told = NDArray[np.float32]


def ranges(pose: tuple[float, float, float], *discs: tuple[float, float, float]) -> NDArray[np.float64]:
    return sector_distances(*pose, np.empty((0, 4)), np.array(discs, np.float64).reshape(-1, 3))


def nearness(distance_m: float) -> float:
    return math.log10(2.8 / (distance_m - 0.2))


def at_bin(bin_: int, distance_m: float) -> NDArray[np.float64]:
    seen = NOTHING.copy()
    seen[bin_] = distance_m
    return seen


#: What looks as bin 2 at 1.5 m does: 5 degrees to the left.
PIN = 1.52 * math.cos(math.radians(5.0)), 1.52 * math.sin(math.radians(5.0)), 0.02


def turn_away(remembered: RememberedRanges) -> Told:
    """See the pin, and turn left by 90 degrees: the first step speeds up, so it turns by half of what another does."""
    steps = 50
    told = remembered.observe(ranges((0.0, 0.0, 0.0), PIN), 0.0, 0.0, 0.0)
    for step in range(steps):
        yaw = 0.5 * math.pi * (step + 0.5) / (steps - 0.5)
        omega = 0.5 * math.pi / ((steps - 0.5) * PERIOD_S)
        told = remembered.observe(ranges((0.0, 0.0, yaw), PIN), 0.0, omega, PERIOD_S)
    return told


def sectors(told: Told) -> dict[int, float]:
    """Return the nearness of the sectors that hold something."""
    return {i: round(float(told[i]), 3) for i in range(NUM_REMEMBERED_SECTORS) if told[i] > 0.0}


def test_what_is_seen_is_told_in_its_sector_with_its_nearness() -> None:
    remembered = RememberedRanges(NARROW, memory_s=12.0)
    # Bin 2 covers 4 to 6 degrees, the middle of sector 0; in 1.5 m a point is 5 degrees wide.
    told = remembered.observe(at_bin(2, 1.5), 0.0, 0.0, 0.0)
    assert told.shape == (REMEMBERED_SIZE,)
    assert sectors(told) == {0: pytest.approx(nearness(1.5), abs=1e-3)}


def test_near_points_cover_what_lies_between_them() -> None:
    """Beside a wall 0.35 m away, cells of 0.1 m are 16 degrees apart, and sectors have 10."""
    remembered = RememberedRanges(FULL, memory_s=12.0)
    wall = np.array([[-2.0, 0.35, 2.0, 0.35]])
    told = remembered.observe(sector_distances(0.0, 0.0, 0.0, wall, np.empty((0, 3))), 0.0, 0.0, 0.0)
    assert all(sector in sectors(told) for sector in range(1, 17))
    assert sectors(told)[9] == pytest.approx(nearness(0.35), abs=0.05)


def test_what_went_out_of_view_is_carried_along() -> None:
    remembered = RememberedRanges(NARROW, memory_s=12.0)
    told = turn_away(remembered)
    assert sectors(told) == {27: pytest.approx(nearness(1.5), abs=0.01)}  # 5 - 90 = 275 degrees
    # One metre on, past it: it was (1.5, 0) turned by -85 degrees, (0.131, -1.494) m, and is at (-0.869, -1.494) now.
    for _ in range(11):
        told = remembered.observe(NOTHING, 1.0 / (10.5 * PERIOD_S), 0.0, PERIOD_S)
    distance_m, bearing = math.hypot(0.869, 1.494), math.degrees(math.atan2(-1.494, -0.869)) % 360.0
    assert told[int(bearing // 10)] == pytest.approx(nearness(distance_m), abs=0.03)
    assert len(sectors(told)) <= 2  # it is near the border of two sectors


@pytest.mark.parametrize(("seen_m", "remains"), [(np.inf, False), (2.0, False), (1.55, True), (0.8, True)])
def test_what_is_seen_through_is_cleared(seen_m: float, remains: bool) -> None:
    remembered = RememberedRanges(NARROW, memory_s=12.0)
    remembered.observe(at_bin(2, 1.5), 0.0, 0.0, 0.0)
    told = remembered.observe(at_bin(2, seen_m), 0.0, 0.0, PERIOD_S)
    nearest_m = min(seen_m, 1.5) if remains else seen_m
    assert told[0] == pytest.approx(0.0 if nearest_m == np.inf else nearness(nearest_m), abs=1e-3)


def test_a_sector_that_was_not_measured_is_not_seen_through() -> None:
    remembered = RememberedRanges(NARROW, memory_s=12.0)
    remembered.observe(at_bin(2, 1.5), 0.0, 0.0, 0.0)
    measured = np.arange(180) != 2
    assert remembered.observe(NOTHING, 0.0, 0.0, PERIOD_S, measured)[0] == pytest.approx(nearness(1.5), abs=1e-3)
    assert not remembered.observe(NOTHING, 0.0, 0.0, PERIOD_S, measured | True)[0]


def test_the_gap_beside_a_sector_that_was_not_measured_is_no_edge_of_a_thing() -> None:
    """A thing that is not seen whole has no middle: its track waits."""
    tracked, waits = (RememberedRanges(NARROW, memory_s=12.0) for _ in range(2))
    disc = ranges((0.0, 0.0, 0.0), (1.5, 0.0, 0.25))
    hidden = disc.copy()
    hidden[:5] = np.inf
    for remembered, measured in ((tracked, None), (waits, np.arange(180) >= 5)):
        remembered._tracks.observe(disc, np.zeros(3), 0.0)
        remembered._tracks.observe(hidden, np.zeros(3), PERIOD_S, None if measured is None else NARROW & measured)
    assert tracked._tracks._tracks[:, 5].max() == 2.0
    assert waits._tracks._tracks[:, 5].max() == 1.0


def test_points_are_forgotten_after_their_time() -> None:
    remembered = RememberedRanges(NARROW, memory_s=9.0)
    turn_away(remembered)  # 7 s, of which it is seen for half
    assert sectors(remembered.observe(NOTHING, 0.0, 0.0, 5.0))
    assert not sectors(remembered.observe(NOTHING, 0.0, 0.0, 2.0))


def test_a_reset_forgets_everything() -> None:
    remembered = RememberedRanges(NARROW, memory_s=9.0)
    first = remembered.observe(at_bin(2, 1.5), 0.3, 0.1, 0.0)
    remembered.observe(at_bin(170, 0.5), 0.3, 0.1, PERIOD_S)
    remembered.reset()
    np.testing.assert_array_equal(remembered.observe(at_bin(2, 1.5), 0.3, 0.1, 0.0), first)


def test_sectors_that_the_sensor_lacks_are_not_read() -> None:
    rng = np.random.default_rng(0)
    one, other = RememberedRanges(NARROW, 12.0), RememberedRanges(NARROW, 12.0)
    for _ in range(50):
        seen = rng.uniform(0.3, 4.0, 180)
        unsensed = np.where(NARROW, seen, rng.uniform(0.3, 4.0, 180))
        v, omega = rng.uniform(-0.5, 0.5, 2).tolist()
        told = [each.observe(scan, v, omega, PERIOD_S) for each, scan in ((one, seen), (other, unsensed))]
        np.testing.assert_array_equal(*told)


def walk_past(remembered: RememberedRanges, steps: int, mirrored: bool = False) -> list[Told]:
    """Let a disc of 0.25 m walk from the left to the right, 1.5 m ahead, at 0.5 m/s."""
    side = -1.0 if mirrored else 1.0
    told = []
    for step in range(steps):
        disc = 1.5, side * (2.0 - 0.5 * PERIOD_S * step), 0.25
        told.append(remembered.observe(ranges((0.0, 0.0, 0.0), disc), 0.0, 0.0, PERIOD_S if step else 0.0))
    return told


def test_what_walks_is_told_with_its_velocity_and_leaves_no_trail() -> None:
    # After 50 steps it is at y = -1.5 m, at a bearing of -45 degrees, out of view since 2 steps.
    told = walk_past(RememberedRanges(NARROW, memory_s=12.0), 51)[-1]
    near = nearness(math.hypot(1.5, 1.5) - 0.25)
    assert told[36] == pytest.approx(near, abs=0.03)
    assert told[37:39] == pytest.approx([near * math.sqrt(0.5), -near * math.sqrt(0.5)], abs=0.05)
    assert told[39:41] == pytest.approx([0.0, -0.5], abs=0.08)
    assert not told[41:46].any()
    # It covers about 13 degrees around 315, and nothing is left of where it was seen before.
    assert set(sectors(told)) <= {30, 31, 32}
    assert sectors(told)[31] == pytest.approx(near, abs=0.03)


def test_what_walked_out_of_view_may_have_stopped_there() -> None:
    """It is expected where its velocity takes it, and where it was seen last, until its track ends."""
    remembered = RememberedRanges(NARROW, memory_s=12.0)
    walk_past(remembered, 30)  # it is 1.5 m ahead, and walks to the right at 0.5 m/s
    blind = np.zeros(180, np.bool_)
    for _ in range(8):  # a turn to the left by 94.5 degrees
        told = remembered.observe(NOTHING, 0.0, math.pi / 2, PERIOD_S, blind)
    # Seen last at -94 degrees; its track is at (1.5, -0.59) m where it began, at -115 degrees.
    assert told[26] == pytest.approx(nearness(1.25), abs=0.05)
    assert told[24] == pytest.approx(nearness(math.hypot(1.5, 0.59) - 0.25), abs=0.1)
    for _ in range(7):  # 2.1 s after it was seen
        told = remembered.observe(NOTHING, 0.0, 0.0, PERIOD_S, blind)
    assert not sectors(told)


def test_foreseen_clearances_are_told_of_what_is_remembered() -> None:
    remembered = RememberedRanges(NARROW, memory_s=12.0)
    told = remembered.observe(at_bin(0, 0.84 + 0.3), 0.6, 0.0, 0.0)
    points, _ = remembered.places((0.0, 0.0, 0.0))
    expected = ForeseenClearance().nearness(points, np.empty((0, 6)), np.zeros(3), 0.6, 0.0)
    assert expected.any()
    np.testing.assert_array_equal(told[46:], expected)


def test_left_and_right_are_alike() -> None:
    # The full sensor: the narrow one has one sector more on the right.
    one, other = (walk_past(RememberedRanges(FULL, 12.0), 45, mirrored) for mirrored in (False, True))
    for told, mirrored in zip(one, other, strict=True):
        # Of the points in a cell the last one stays, in the order of the sectors: an edge may lie a sector further.
        assert (np.abs(told[:36] - mirrored[35::-1]) > 0.02).sum() <= 1
        np.testing.assert_allclose(told[36:41] * [1, 1, -1, 1, -1], mirrored[36:41], atol=0.06)


def test_dead_reckoning_follows_arcs() -> None:
    robot = DeadReckoning()
    robot.move(0.5, 1.0, 0.0)
    for _ in range(100):
        robot.move(0.5, 1.0, 0.01 * math.pi / 2)
    # A quarter of a circle of radius 0.5 m.
    assert robot.pose.tolist() == pytest.approx([0.5, 0.5, math.pi / 2], abs=1e-6)
    assert robot.time_s == pytest.approx(math.pi / 2)
    for _ in range(100):
        robot.move(0.0, 1.0, 0.05)
    assert -math.pi <= robot.pose[2] < math.pi


def test_places_are_where_things_are() -> None:
    """Seen from a pose of another frame than the dead reckoning's."""
    remembered = RememberedRanges(NARROW, memory_s=12.0)
    turn_away(remembered)
    # In the frame in which the robot began, the pin is where it was, and the robot looks to the left of it.
    points, moving = remembered.places((0.0, 0.0, math.pi / 2))
    assert moving.shape == (0, 3)
    np.testing.assert_allclose(
        points.mean(0), [1.5 * math.cos(math.radians(5)), 1.5 * math.sin(math.radians(5))], atol=0.05
    )
    # Three metres farther up and turned back by 90 degrees, all turns with it: (x, y) becomes (y, -x).
    turned, _ = remembered.places((0.0, 3.0, 0.0))
    np.testing.assert_allclose(turned, np.column_stack([points[:, 1], 3.0 - points[:, 0]]), atol=1e-9)
    walking = RememberedRanges(NARROW, memory_s=12.0)
    walk_past(walking, 30)
    assert walking.places((0.0, 0.0, 0.0))[1] == pytest.approx(np.array([[1.5, 2.0 - 0.07 * 29, 0.25]]), abs=0.1)


def test_another_robot_remembers_as_far_as_it_sees_from_its_own_inside() -> None:
    cart = RobotSettings("cart", "disc", 0.3, None, lidar=LidarSettings(max_range_m=5.0))
    remembered = RememberedRanges(NARROW, 12.0, cart)
    told = remembered.observe(at_bin(2, 4.5), 0.0, 0.0, 0.0)
    assert sectors(told) == {0: pytest.approx(math.log10(4.76 / (4.5 - 0.24)), abs=1e-3)}
    # Backwards at 0.5 m/s with a blind sensor: within 5 m it stays known, beyond it is forgotten.
    blind = np.zeros(180, np.bool_)
    remembered.observe(NOTHING, -0.5, 0.0, PERIOD_S, blind)
    told = [remembered.observe(NOTHING, -0.5, 0.0, PERIOD_S, blind) for _ in range(10)]
    known = [bool(each[0]) for each in told]
    assert known == [4.5 + (0.5 + at) * 0.07 < 5.0 for at in range(1, 11)]
    assert not all(known)
