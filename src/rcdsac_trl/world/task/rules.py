"""The task: its settings, what the robot is paid, and the noise of its sensors, as pure functions.

Everything here follows the paper's section "Reward"; nothing here holds state. Whoever steps the world calls these
functions and keeps the state. What the robot is told is in :mod:`rcdsac_trl.robot.observation`, what its actions mean
in :mod:`rcdsac_trl.robot.action`.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np
from numpy.typing import ArrayLike, NDArray

from rcdsac_trl.errors import UserInputError
from rcdsac_trl.robot.action import inside_dead_band
from rcdsac_trl.robot.robot_settings import PAPER, RobotSettings
from rcdsac_trl.system.checks import at_least, check_least, one_of, positive, within

# Reward (paper, section "Reward").
BASE_REWARD = -0.02
GOAL_REWARD = 10.0
COLLISION_REWARD = -10.0
MIN_WAYPOINT_REWARD = -0.1
STRAIGHT_FACTOR = 1.2
"""r_angular while the desired angular velocity is inside the dead band."""
MIN_TURN_FACTOR = 0.5
TURN_SCALE = math.radians(120.0)
"""The desired angular velocity at which 1 - `|omega_u|` / scale would reach 0, rad/s, of the paper's robot."""

RULES_VERSION = 2
"""Version of the rules: results of different versions do not compare.

1: a contact ended as soon as nothing was within 1 mm, so that a robot turning beside a wall began one after the other;
a waypoint gave way to the next wherever the robot was within its radius. 2: as described here.
"""
SURE_WAYPOINT_RADIUS_M = 0.15
"""A waypoint nearer than this gives way to the next whatever is in the way, so that nobody circles one for ever."""

CollisionPenaltyMode = Literal["onset", "per_step"]
"""When r_coll is paid: once as a contact begins, or in every agent step in contact."""

HowDisturbed = Literal["fixed", "drawn"]
"""Noise, delay and slowness of an episode: what the settings say, or a drawn share of each."""


@dataclass(frozen=True)
class TaskSettings:
    """What the task leaves to choose; every field is a key of ``conf/task/*.yaml``.

    Attributes:
        version: version of the rules, :data:`RULES_VERSION`.
        episode_steps: agent steps in an episode.
        collision_penalty_mode: ``"onset"`` pays -10 once, as a contact begins; ``"per_step"`` in every agent
            step in contact.
        waypoint_radius_m: a waypoint nearer than this gives way to the next once the straight way there is free of
            what the planner knows, or the waypoint is nearer than :data:`SURE_WAYPOINT_RADIUS_M`.
        goal_radius_m: a goal nearer than this is reached.
        min_path_m: shortest path from where the robot is to a new goal.
        motor_steps: numbers of motor steps, of 0.02 s on the paper's robot, in an agent step; an episode draws one of
            them.
        range_noise_std_m: standard deviation of the noise on a range.
        range_dropout: probability that a range is lost (reads as "nothing there"), per bin and step.
        odometry_noise_std: standard deviations of the noise on the measured velocities, (m/s, rad/s).
        action_delay_steps: agent steps an action waits before it acts.
        pose_noise_std: standard deviations of the error of the pose that waypoints are told from, (m, rad); see
            :class:`~rcdsac_trl.world.task.disturbances.PoseError`.
        motor_slowness: share by which the robot drives and turns slower than it is told.
        stop_zone_share: share of the episodes in which a stop zone stands between agent and wheels, as on a robot; see
            :class:`rcdsac_trl.robot.guard.Guard`. It sees what the sensor sees.
        stop_zone_margin_m: what that keeps free around the robot.
        disturbances: ``"fixed"``: noise, delay and slowness are what they say in every episode; ``"drawn"``: at most,
            every episode draws a share of each.

    Raises:
        UserInputError: a value is outside its limits.

    Example:
        >>> TaskSettings().motor_steps
        (6, 7, 8)
    """

    version: int = RULES_VERSION
    episode_steps: int = 1000
    collision_penalty_mode: CollisionPenaltyMode = "onset"
    waypoint_radius_m: float = 0.5
    goal_radius_m: float = 0.15
    min_path_m: float = 4.0
    motor_steps: tuple[int, ...] = (6, 7, 8)
    range_noise_std_m: float = 0.0
    range_dropout: float = 0.0
    odometry_noise_std: tuple[float, float] = (0.0, 0.0)
    action_delay_steps: int = 0
    pose_noise_std: tuple[float, float] = (0.0, 0.0)
    motor_slowness: float = 0.0
    stop_zone_share: float = 0.0
    stop_zone_margin_m: float = 0.05
    disturbances: HowDisturbed = "fixed"

    def __post_init__(self) -> None:
        """Refuse what is outside the limits."""
        for name in ("motor_steps", "odometry_noise_std", "pose_noise_std"):
            if not isinstance(getattr(self, name), Sequence):
                raise UserInputError(f"task.{name}={getattr(self, name)} must be a list of numbers, such as [6, 7, 8]")
        # Hydra hands lists over; a frozen value keeps tuples.
        object.__setattr__(self, "motor_steps", tuple(self.motor_steps))
        object.__setattr__(self, "odometry_noise_std", tuple(self.odometry_noise_std))
        object.__setattr__(self, "pose_noise_std", tuple(self.pose_noise_std))
        if self.version != RULES_VERSION:
            raise UserInputError(
                f"task.version={self.version!r} is not the version of the rules here: set it to {RULES_VERSION}"
            )
        check_least("task.episode_steps", self.episode_steps, 1)
        check_least("task.action_delay_steps", self.action_delay_steps, 0)
        one_of("task.collision_penalty_mode", self.collision_penalty_mode, CollisionPenaltyMode)
        one_of("task.disturbances", self.disturbances, HowDisturbed)
        positive("task", self, "waypoint_radius_m goal_radius_m min_path_m")
        at_least("task", self, 0, "range_noise_std_m")
        within("task", self, 0, 1, "range_dropout stop_zone_share stop_zone_margin_m")
        if not self.motor_steps or any(n != int(n) or n < 1 for n in self.motor_steps):
            raise UserInputError(
                f"task.motor_steps={list(self.motor_steps)} must be whole numbers of at least 1, such as [6, 7, 8]"
            )
        for name, units in (("odometry_noise_std", "m/s and rad/s"), ("pose_noise_std", "m and rad")):
            pair = getattr(self, name)
            if len(pair) != 2 or not all(0.0 <= s < math.inf for s in pair):
                raise UserInputError(f"task.{name}={list(pair)} must be two numbers of 0 or more: {units}")
        if not 0.0 <= self.motor_slowness < 1.0:
            raise UserInputError(
                f"task.motor_slowness={self.motor_slowness} is a share of the speed: give 0 to below 1"
            )


REWARD_COMPONENTS = ("base", "goal", "waypoint", "angular", "collision")
"""The parts of the reward, in the order of :func:`reward_components`; :func:`combined` puts them together."""


def reward_components(
    v_c: float,
    theta_1: float,
    omega_u: float,
    in_contact: bool,
    collided: bool,
    goal_reached: bool,
    robot: RobotSettings = PAPER,
) -> tuple[float, ...]:
    """Return the parts of the reward in the order of :data:`REWARD_COMPONENTS`.

    What hangs on speeds counts shares of the robot's own: at full speed every robot is paid what the paper's is, and a
    full turn costs as much.

    Args:
        v_c: linear velocity measured after the step, m/s.
        theta_1: bearing, after the step, of the waypoint that was next during the step, rad.
        omega_u: desired angular velocity after the dead band, rad/s.
        in_contact: whether the robot was in contact during the step; r_waypoint is 0 then.
        collided: whether r_coll is due; see :func:`collision_due`.
        goal_reached: whether the goal was reached in this step.
        robot: whose speeds they are.

    Example:
        >>> reward_components(0.5, 0.0, 0.0, False, False, False)
        (-0.02, 0.0, 0.5, 1.2, 0.0)
    """
    speed = max(0.0, robot.reward_per_speed * v_c)
    waypoint = 0.0 if in_contact else max(MIN_WAYPOINT_REWARD, speed * math.cos(theta_1))
    turning = max(MIN_TURN_FACTOR, 1.0 - robot.reward_per_turn * abs(omega_u) / TURN_SCALE)
    angular = STRAIGHT_FACTOR if inside_dead_band(omega_u, robot) else turning
    goal = GOAL_REWARD if goal_reached else 0.0
    collision = COLLISION_REWARD if collided else 0.0
    return BASE_REWARD, goal, waypoint, angular, collision


def combined(components: Any, collision_weight: Any = 1.0) -> Any:
    """Return r = r_base + r_goal + r_waypoint * r_angular + w_coll * r_coll, of whatever type the components have.

    Args:
        components: array or tensor [..., 5], in the order of :data:`REWARD_COMPONENTS`.
        collision_weight: w_coll; 1 unless a row says otherwise.
    """
    r = {name: components[..., i] for i, name in enumerate(REWARD_COMPONENTS)}
    return r["base"] + r["goal"] + r["waypoint"] * r["angular"] + collision_weight * r["collision"]


def total_reward(components: ArrayLike, collision_weight: float | NDArray[np.float32] = 1.0) -> NDArray[np.float32]:
    """Return the reward, float32 [...]; see :func:`combined`.

    Args:
        components: [..., 5], from :func:`reward_components`.
        collision_weight: w_coll; 1 unless a row says otherwise.

    Example:
        >>> float(total_reward([0.0, 10.0, 0.5, 0.5, -10.0], collision_weight=2.0))
        -9.75
    """
    return np.asarray(combined(np.asarray(components, dtype=np.float32), collision_weight), dtype=np.float32)


def collision_due(in_contact: bool, was_in_contact: bool, mode: CollisionPenaltyMode) -> bool:
    """Return whether r_coll is paid in this agent step.

    Args:
        in_contact: whether the robot was in contact in this agent step, see
            :class:`rcdsac_trl.world.sim.simulation.StepResult`.
        was_in_contact: the same of the agent step before; False in an episode's first.
        mode: ``"onset"`` pays the first step of a contact, ``"per_step"`` each.

    Example:
        >>> collision_due(True, True, "onset"), collision_due(True, True, "per_step")
        (False, True)
    """
    return in_contact and (mode == "per_step" or not was_in_contact)


def noisy_ranges(
    distances: NDArray[np.float64], noise_std_m: float, dropout: float, rng: np.random.Generator
) -> NDArray[np.float64]:
    """Return the distances a noisy sensor reports; with both options at 0 they are returned as they are.

    Args:
        distances: [180], m; ``inf`` where nothing is, and there it stays.
        noise_std_m: standard deviation of additive normal noise.
        dropout: probability that a bin reports nothing (``inf``).
        rng: the noise's own stream.
    """
    if noise_std_m > 0.0:
        # No sensor says less than nothing; what is inside of its body a robot would leave out.
        distances = np.maximum(distances + noise_std_m * rng.standard_normal(distances.shape), 0.0)
    if dropout > 0.0:
        distances = np.where(rng.random(distances.shape) < dropout, np.inf, distances)
    return distances


def noisy_velocities(
    v_c: float, omega_c: float, noise_std: tuple[float, float], rng: np.random.Generator
) -> tuple[float, float]:
    """Return the velocities noisy odometry reports, m/s and rad/s; with both deviations at 0 as they are.

    Args:
        v_c: measured linear velocity, m/s.
        omega_c: measured angular velocity, rad/s.
        noise_std: standard deviations of additive normal noise, (m/s, rad/s).
        rng: the noise's own stream.
    """
    if noise_std == (0.0, 0.0):
        return v_c, omega_c
    noise = rng.standard_normal(2)
    return v_c + noise_std[0] * float(noise[0]), omega_c + noise_std[1] * float(noise[1])
