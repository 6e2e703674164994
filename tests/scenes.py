"""Hand-made scenes for controllers: exact ranges, and the robot's own motor controller without contact."""

import math
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from rcdsac_trl.robot.action import clip_command, desired_velocities
from rcdsac_trl.robot.limits import MAX_LINEAR_VELOCITY, MEAN_PERIOD_S, MOTOR_PERIOD_S
from rcdsac_trl.robot.range_sensor import Sensor, sensor_mask
from rcdsac_trl.robot.robot_settings import PAPER
from rcdsac_trl.rollout.planners.controller import Controller
from rcdsac_trl.world.maps.geometry import ROBOT_RADIUS_M
from rcdsac_trl.world.sim.lidar import sector_distances

MOTOR_STEPS = 7


@dataclass
class Scene:
    """A robot at the origin, and what stands around it.

    Attributes:
        segments: walls, (x0, y0, x1, y1), m.
        circles: discs, (x, y, radius), m.
        waypoints: the next two, m.
        pose: x, y in m and yaw in rad.
    """

    segments: list[tuple[float, float, float, float]] = field(default_factory=list)
    circles: list[tuple[float, float, float]] = field(default_factory=list)
    waypoints: tuple[tuple[float, float], tuple[float, float]] = ((4.0, 0.0), (4.0, 0.0))
    pose: tuple[float, float, float] = (0.0, 0.0, 0.0)
    sensor: Sensor = "narrow"
    velocity: tuple[float, float, float, float] = (0.0, 0.0, 0.0, 0.0)
    smallest_gap_m: float = math.inf

    @property
    def sensed(self) -> NDArray[np.bool_]:
        return sensor_mask(self.sensor)

    def observation(self) -> tuple[NDArray, NDArray, NDArray]:
        """Return ranges, waypoints and velocities as a controller gets them."""
        ranges_m = np.where(self.sensed, self._distances(), np.inf)
        x, y, yaw = self.pose
        offset = np.array(self.waypoints) - (x, y)
        turn = np.array([[math.cos(yaw), math.sin(yaw)], [-math.sin(yaw), math.cos(yaw)]])
        return ranges_m, offset @ turn.T, np.array(self.velocity)

    def move(self, v: float, omega: float) -> None:
        """Hold two desired velocities for an agent step."""
        action = (2.0 * (v + 0.2) / (MAX_LINEAR_VELOCITY + 0.2) - 1.0, omega / PAPER.max_angular_velocity)
        v_u, omega_u = desired_velocities(action)
        v_c, omega_c = self.velocity[:2]
        x, y, yaw = self.pose
        for _ in range(MOTOR_STEPS):
            v_c, omega_c = clip_command(v_u, omega_u, v_c, omega_c)
            yaw += omega_c * MOTOR_PERIOD_S
            x += v_c * math.cos(yaw) * MOTOR_PERIOD_S
            y += v_c * math.sin(yaw) * MOTOR_PERIOD_S
        self.pose, self.velocity = (x, y, yaw), (v_c, omega_c, v_u, omega_u)
        self.smallest_gap_m = min(self.smallest_gap_m, self._distances().min() - ROBOT_RADIUS_M)

    def _distances(self) -> NDArray:
        segments = np.array(self.segments, np.float64).reshape(-1, 4)
        circles = np.array(self.circles, np.float64).reshape(-1, 3)
        return sector_distances(*self.pose, segments, circles)

    def distance_to_goal_m(self) -> float:
        return math.dist(self.pose[:2], self.waypoints[1])

    def drive(self, controller: Controller, steps: int, seed: int = 0) -> "Scene":
        """Let a controller drive from rest, until it is at the goal or the steps are over."""
        controller.reset(self.sensed, np.random.default_rng(seed), MEAN_PERIOD_S)
        for _ in range(steps):
            self.move(*controller.act(*self.observation()))
            if self.distance_to_goal_m() < 0.15:
                break
        return self
