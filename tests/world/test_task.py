"""The task's pure functions against numbers worked out by hand from the paper's formulas."""

import math

import numpy as np
import pytest

from rcdsac_trl.errors import UserInputError
from rcdsac_trl.robot.action import clip_command, desired_velocities
from rcdsac_trl.robot.observation import (
    MAX_RANGE_OBSERVATION,
    distance_and_bearing,
    range_observation,
    waypoint_observation,
)
from rcdsac_trl.robot.range_sensor import NUM_BINS, sensor_mask
from rcdsac_trl.seeding import stream
from rcdsac_trl.world.task.rules import (
    TaskSettings,
    collision_due,
    noisy_ranges,
    noisy_velocities,
    reward_components,
    total_reward,
)


def deg(angle):
    return math.radians(angle)


def components(v_c=0.0, theta_1=0.0, omega_u=0.0, in_contact=False, collided=False, goal_reached=False):
    return reward_components(v_c, theta_1, omega_u, in_contact, collided, goal_reached)


# Actions


@pytest.mark.parametrize(("u0", "v_u"), [(-1.0, -0.2), (-0.5, 0.0), (0.0, 0.2), (0.5, 0.4), (1.0, 0.6)])
def test_desired_linear_velocity(u0, v_u):
    assert desired_velocities([u0, 0.0])[0] == pytest.approx(v_u, abs=1e-15)


@pytest.mark.parametrize(
    ("u1", "omega_u_deg"),
    [
        (0.0, 0.0),
        (0.1, 0.0),  # 9 deg/s
        (-0.16, 0.0),  # 14.4 deg/s
        (0.1666, 0.0),  # 14.994 deg/s
        (0.1667, 15.003),
        (-0.2, -18.0),
        (0.5, 45.0),
        (1.0, 90.0),
        (-1.0, -90.0),
    ],
)
def test_desired_angular_velocity_has_a_dead_band(u1, omega_u_deg):
    assert desired_velocities([0.0, u1])[1] == pytest.approx(deg(omega_u_deg), abs=1e-12)


@pytest.mark.parametrize("dtype", [np.float64, np.float32])
@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_exactly_15_degrees_a_second_are_kept(dtype, sign):
    omega_u = desired_velocities(np.array([0.0, sign * 15.0 / 90.0], dtype=dtype))[1]
    assert omega_u == pytest.approx(sign * deg(15.0), rel=1e-6)
    # ... and are not "straight" for the reward: 1 - 15/120.
    assert components(omega_u=omega_u)[3] == pytest.approx(0.875)


def test_actions_outside_the_limits_are_clipped():
    assert desired_velocities([7.0, -7.0]) == desired_velocities([1.0, -1.0])


def test_motor_controller_keeps_the_acceleration_limits():
    # 1.5 m/s^2 and 120 deg/s^2 over 0.02 s: 0.03 m/s and 2.4 deg/s.
    assert clip_command(0.6, deg(90), 0.1, deg(10)) == pytest.approx((0.13, deg(12.4)))
    assert clip_command(-0.2, deg(-90), 0.1, deg(10)) == pytest.approx((0.07, deg(7.6)))
    assert clip_command(0.11, deg(11), 0.1, deg(10)) == (0.11, deg(11))
    assert clip_command(0.6, 0.0, 0.0, 0.0, period_s=0.1) == pytest.approx((0.15, 0.0))


# Observations


def test_range_observation():
    distances = [0.005, 0.01, 0.0101, 0.1, 1.0, 2.0, 2.9999, 3.0, np.inf]
    expected = [0.0, 0.0, 2.5 + math.log10(0.0101), 1.5, 2.5, 2.5 + math.log10(2.0), 2.5 + math.log10(2.9999), 0, 0]
    observed = range_observation(distances, np.ones(9, dtype=bool))
    assert observed.dtype == np.float32
    np.testing.assert_allclose(observed, expected, rtol=1e-6)
    assert observed.max() < MAX_RANGE_OBSERVATION == pytest.approx(2.9771212547)


def test_range_observation_is_zero_where_the_sensor_has_no_bin():
    for name in ("narrow", "sparse", "full"):
        mask = sensor_mask(name)
        observed = range_observation(np.ones((2, NUM_BINS)), mask)
        assert (observed == np.where(mask, np.float32(2.5), np.float32(0.0))).all()


def test_waypoint_observation():
    # At (1, 2) facing +y: (1, 12) is 10 m ahead, (1.5, 2) is 0.5 m to the right.
    observed = waypoint_observation((1.0, 2.0, deg(90)), (1.0, 12.0), (1.5, 2.0))
    np.testing.assert_allclose(observed, [1.0, 1.0, 0.0, math.log10(0.5), 0.0, -1.0], atol=1e-7)


@pytest.mark.parametrize(
    ("distance", "logarithm"), [(1e-9, -2.0), (0.0, -2.0), (0.01, -2.0), (0.02, math.log10(0.02)), (1e4, 2.0)]
)
def test_waypoint_distance_is_clipped_before_the_logarithm(distance, logarithm):
    observed = waypoint_observation((0.0, 0.0, 0.0), (distance, 0.0), (100.0, 0.0))
    np.testing.assert_allclose((observed[0], observed[3]), [logarithm, 2.0], rtol=1e-12)


def test_distance_and_bearing():
    distance, bearing = distance_and_bearing((1.0, 1.0, deg(30)), (1.0 + math.sqrt(3.0), 0.0))
    assert distance == pytest.approx(2.0)
    assert bearing == pytest.approx(deg(-60))


# Reward


def test_straight_drive_to_the_waypoint():
    # -0.02 + 0.5 cos(60 deg) * 1.2 = 0.28
    parts = components(v_c=0.5, theta_1=deg(60))
    np.testing.assert_allclose(parts, [-0.02, 0.0, 0.25, 1.2, 0.0], rtol=1e-6)
    assert total_reward(parts) == pytest.approx(0.28, rel=1e-6)


def test_best_reward_of_a_step_without_a_goal():
    assert total_reward(components(v_c=0.6)) == pytest.approx(0.7, rel=1e-6)


@pytest.mark.parametrize(
    ("v_c", "theta_deg", "waypoint"),
    [
        (0.4, 0.0, 0.4),
        (0.4, 90.0, 0.0),
        (0.15, 120.0, -0.075),
        (0.6, 180.0, -0.1),  # -0.6, cut
        (-0.2, 180.0, 0.0),  # driving backwards pays nothing, even towards the waypoint
        (-0.2, 0.0, 0.0),
    ],
)
def test_waypoint_reward(v_c, theta_deg, waypoint):
    assert components(v_c=v_c, theta_1=deg(theta_deg))[2] == pytest.approx(waypoint, abs=1e-7)


@pytest.mark.parametrize(
    ("omega_deg", "factor"),
    [
        (0.0, 1.2),
        (14.9, 1.2),
        (-14.9, 1.2),
        (15.0, 0.875),
        (-30.0, 0.75),
        (45.0, 0.625),
        (60.0, 0.5),
        (90.0, 0.5),  # 0.25, raised
    ],
)
def test_angular_factor(omega_deg, factor):
    assert components(omega_u=deg(omega_deg))[3] == pytest.approx(factor, rel=1e-6)


def test_contact_takes_the_waypoint_reward():
    np.testing.assert_allclose(components(v_c=0.5, in_contact=True), [-0.02, 0.0, 0.0, 1.2, 0.0], rtol=1e-6)
    # ... and the penalty for driving away from it.
    assert components(v_c=0.5, theta_1=math.pi, in_contact=True)[2] == 0.0


def test_collision_costs_ten():
    parts = components(v_c=0.5, in_contact=True, collided=True)
    assert parts[4] == -10.0
    assert total_reward(parts) == pytest.approx(-10.02, rel=1e-6)


def test_collision_weight_scales_the_collision_alone():
    parts = components(v_c=0.5, in_contact=True, collided=True, goal_reached=True)
    assert total_reward(parts, 0.1) == pytest.approx(-0.02 + 10.0 - 1.0, rel=1e-6)
    assert total_reward(parts, 2.0) == pytest.approx(-0.02 + 10.0 - 20.0, rel=1e-6)
    batch = np.stack([parts, components(v_c=0.5)])
    np.testing.assert_allclose(total_reward(batch, np.array([0.1, 2.0], dtype=np.float32)), [8.98, 0.58], rtol=1e-6)


def test_goal_pays_ten():
    parts = components(v_c=0.5, omega_u=deg(45), goal_reached=True)
    assert parts[1] == 10.0
    assert total_reward(parts) == pytest.approx(-0.02 + 10.0 + 0.5 * 0.625, rel=1e-6)


@pytest.mark.parametrize(
    ("in_contact", "was_in_contact", "onset", "per_step"),
    [(False, False, False, False), (False, True, False, False), (True, False, True, True), (True, True, False, True)],
)
def test_when_a_collision_is_due(in_contact, was_in_contact, onset, per_step):
    assert collision_due(in_contact, was_in_contact, "onset") is onset
    assert collision_due(in_contact, was_in_contact, "per_step") is per_step


# Noise


def test_no_noise_is_the_identity_and_draws_nothing():
    rng = stream(0, "test_task")
    before = rng.bit_generator.state
    distances = np.array([0.5, np.inf])
    assert noisy_ranges(distances, 0.0, 0.0, rng) is distances
    assert noisy_velocities(0.5, -0.1, (0.0, 0.0), rng) == (0.5, -0.1)
    assert rng.bit_generator.state == before


def test_range_noise_has_the_given_spread():
    distances = np.where(np.arange(100_000) % 2, 2.0, np.inf)
    noisy = noisy_ranges(distances, 0.05, 0.0, stream(0, "test_task"))
    assert (np.isinf(noisy) == np.isinf(distances)).all()
    error = noisy[1::2] - 2.0
    assert abs(error.mean()) < 1e-3
    assert error.std() == pytest.approx(0.05, rel=0.02)


def test_range_dropout_loses_the_given_share():
    assert noisy_ranges(np.full(1000, 0.1), 0.2, 0.0, stream(0, "test_task")).min() == 0.0  # nothing is behind itself
    noisy = noisy_ranges(np.ones(100_000), 0.0, 0.2, stream(0, "test_task"))
    assert np.isinf(noisy).mean() == pytest.approx(0.2, abs=0.005)
    assert (noisy[np.isfinite(noisy)] == 1.0).all()
    assert (range_observation(noisy_ranges(np.ones(9), 0.0, 1.0, stream(0, "x")), np.ones(9, bool)) == 0).all()


def test_odometry_noise_has_the_given_spreads():
    rng = stream(0, "test_task")
    noisy = np.array([noisy_velocities(0.3, -0.5, (0.02, 0.1), rng) for _ in range(20_000)])
    np.testing.assert_allclose(noisy.mean(axis=0), [0.3, -0.5], atol=3e-3)
    np.testing.assert_allclose(noisy.std(axis=0), [0.02, 0.1], rtol=0.03)


# Settings


def test_default_settings_are_the_papers():
    settings = TaskSettings()
    assert (settings.episode_steps, settings.goal_radius_m, settings.motor_steps) == (1000, 0.15, (6, 7, 8))
    assert settings.collision_penalty_mode == "onset"
    noise = (settings.range_noise_std_m, settings.range_dropout, *settings.odometry_noise_std)
    assert (*noise, settings.action_delay_steps) == (0.0, 0.0, 0.0, 0.0, 0)
    assert (settings.pose_noise_std, settings.motor_slowness, settings.disturbances) == ((0.0, 0.0), 0.0, "fixed")


def test_settings_turn_lists_into_tuples():
    settings = TaskSettings(motor_steps=[7], odometry_noise_std=[0.1, 0.2])
    assert settings == TaskSettings(motor_steps=(7,), odometry_noise_std=(0.1, 0.2))
    assert hash(settings) == hash(TaskSettings(motor_steps=(7,), odometry_noise_std=(0.1, 0.2)))


@pytest.mark.parametrize(
    ("name", "value"),
    [
        ("version", 1),
        ("episode_steps", 0),
        ("collision_penalty_mode", "never"),
        ("waypoint_radius_m", 0.0),
        ("goal_radius_m", -0.1),
        ("min_path_m", math.inf),
        ("motor_steps", 7),
        ("motor_steps", ()),
        ("motor_steps", (0,)),
        ("motor_steps", (6.5,)),
        ("range_noise_std_m", -0.1),
        ("range_noise_std_m", math.inf),
        ("range_dropout", 1.5),
        ("range_dropout", math.nan),
        ("odometry_noise_std", 0.1),
        ("odometry_noise_std", (0.1,)),
        ("odometry_noise_std", (0.1, -0.1)),
        ("action_delay_steps", -1),
        ("pose_noise_std", (0.1,)),
        ("pose_noise_std", (0.1, -0.1)),
        ("motor_slowness", 1.0),
        ("disturbances", "random"),
        ("stop_zone_share", 1.1),
        ("stop_zone_margin_m", -0.1),
    ],
)
def test_settings_outside_their_limits_are_refused(name, value):
    with pytest.raises(UserInputError, match=rf"^task\.{name}="):
        TaskSettings(**{name: value})
