"""What the page shows of a robot, computed of its drive as plain arrays: the page only copies them."""

import math
from dataclasses import dataclass
from functools import lru_cache

import numpy as np
import torch
from numpy.typing import NDArray
from scipy.ndimage import zoom

from rcdsac_trl.agent.risk import RiskMeasure
from rcdsac_trl.deploy import Command
from rcdsac_trl.playground.drivers import AgentDriver, Dial
from rcdsac_trl.playground.play_drive import Robot
from rcdsac_trl.robot.action import desired_velocities
from rcdsac_trl.robot.planar import placed
from rcdsac_trl.robot.range_sensor import BIN_RAD, NUM_BINS
from rcdsac_trl.world.render import Scene

Array = NDArray[np.float64]

VALUES_A_SIDE = 11
"""The critics are asked for so many speeds, and for as many turning rates."""
FINE = 6
"""Between two of them the picture has so many pixels; they are interpolated."""

_FARTHEST_M = 3.0
# So a command begins to say that the stop zone limits it; behind a semicolon stands how that ends.
_LIMITED_BY = "limited by "
_ARROW = np.array([[0.17, 0.0], [-0.10, 0.11], [-0.05, 0.0], [-0.10, -0.11]])


@dataclass(frozen=True)
class SensorView:
    """What a robot's sensor says, in the map frame, m.

    Attributes:
        near: outlines of what it sees up to the nearest thing in each sector, one [n, 2] for neighbouring sectors.
        silent: outlines of sectors that it has and in which nothing is within reach.
        hits: the nearest thing over the width of its sector, x0, y0, x1, y1, [k, 4].
    """

    near: list[Array]
    silent: list[Array]
    hits: Array


@dataclass(frozen=True)
class ReturnView:
    """What the critics expect of the action that was chosen.

    Attributes:
        fractions: midpoints of equal parts of [0, 1], [N].
        quantiles: of the return there, [N].
        weights: that beta puts on each, [N]; their mean is 1.
        mean: of the return.
        value: its risk-adjusted value, the weighted mean.
        recalibrated: whether the quantiles are more than what the critics say.
    """

    fractions: Array
    quantiles: Array
    weights: Array
    mean: float
    value: float
    recalibrated: bool


@dataclass(frozen=True)
class ValueView:
    """The risk-adjusted value of every action.

    Attributes:
        values: by turning rate and speed, [n, n].
        speeds_m_per_s: smallest and largest.
        turns_deg_per_s: smallest and largest.
    """

    values: Array
    speeds_m_per_s: tuple[float, float]
    turns_deg_per_s: tuple[float, float]


@dataclass(frozen=True)
class RobotView:
    """One robot at one moment; places in the map frame, m.

    Attributes:
        name: who drives.
        dial: what turns it; None for nothing.
        dialled: where it stands.
        pose: x, y in m and yaw in rad.
        body: its outline, [n, 2].
        arrow: outline of the arrow on it, [4, 2].
        sensor: what it sees.
        way: where it is, then the waypoints ahead, the last one the goal, [k, 2].
        detour: where it is, then the corner that it was sent to instead of its next waypoint, [2, 2]; [0, 2]: none.
        movers: x, y and radius, [k, 3].
        remembered: points that the agent is told of because it saw them, [k, 2].
        expected: where it expects what moves, x, y and radius, [k, 3].
        obstacles: those that were put, x, y and radius, [k, 3].
        trail: x, y in m and speed in m/s, the latest steps, [k, 3].
        contacts: where contacts began, [k, 2].
        in_contact: whether it touches something.
        steps: taken so far.
        time_s: driven so far.
        speed_m_per_s: linear velocity.
        wanted: speed in m/s and turning rate in degrees/s that the driver wanted; None before the first step.
        told: those that the wheels were told, with the stop zone between.
        limited: the cause why they differ; None if they do not, or the watchdog helps.
        helped: how the watchdog helps it; None if it does not.
        clearance_m: between the robot's circle and the nearest thing, seen or not.
        reward: so far; None where nothing is paid.
        collisions: so far.
        goals: so far.
        returns: what the critics expect; None where they know no distribution.
        values: of every action; None where nobody was asked.
    """

    name: str
    dial: Dial | None
    dialled: float | None
    pose: tuple[float, float, float]
    body: Array
    arrow: Array
    sensor: SensorView
    way: Array
    detour: Array
    movers: Array
    remembered: Array
    expected: Array
    obstacles: Array
    trail: Array
    contacts: Array
    in_contact: bool
    steps: int
    time_s: float
    speed_m_per_s: float
    wanted: tuple[float, float] | None
    told: tuple[float, float] | None
    limited: str | None
    helped: str | None
    clearance_m: float
    reward: float | None
    collisions: int
    goals: int
    returns: ReturnView | None
    values: ValueView | None


def robot_view(robot: Robot, scene: Scene, values: ValueView | None) -> RobotView:
    """Return what the page shows of a robot.

    Args:
        robot: that drives.
        scene: around it, now.
        values: of its actions, from :func:`value_view`.
    """
    x, y, _ = scene.pose
    simulation, command = robot.arena.simulation, robot.command
    body, size = scene.robot.outline, scene.robot.inradius_m / 0.23
    return RobotView(
        name=robot.name,
        dial=robot.driver.dial,
        dialled=robot.dialled,
        pose=scene.pose,
        body=placed(body, scene.pose),
        arrow=placed(size * _ARROW, scene.pose),
        sensor=sensor_view(scene),
        way=np.concatenate([[(x, y)], scene.waypoints]),
        detour=np.empty((0, 2)) if robot.detour is None else np.array([(x, y), robot.detour]),
        movers=scene.movers,
        remembered=scene.remembered,
        expected=scene.expected,
        obstacles=simulation.put_discs,
        trail=np.array(robot.trail),
        contacts=np.array(robot.contacts).reshape(-1, 2),
        in_contact=robot.in_contact,
        steps=robot.steps,
        time_s=robot.time_s,
        speed_m_per_s=robot.trail[-1][2],
        wanted=None if command is None or command.wanted is None else _in_degrees(*command.wanted),
        told=None if command is None else _in_degrees(command.v_m_per_s, command.omega_rad_per_s),
        limited=_limits(command),
        helped=robot.driver.helped,
        clearance_m=max(0.0, simulation.room_at(x, y, _FARTHEST_M) - scene.robot.circumradius_m),
        reward=robot.reward,
        collisions=robot.collisions,
        goals=robot.goals,
        returns=return_view(robot),
        values=values,
    )


def _limits(command: Command | None) -> str | None:
    """Return the cause why the wheels are not told what the driver wanted, but for the watchdog's help."""
    if command is None or command.reason is None or not (command.stopped or command.reason.startswith(_LIMITED_BY)):
        return None
    return command.reason.removeprefix(_LIMITED_BY).split(";")[0]


def sensor_view(scene: Scene) -> SensorView:
    """Return what a scene's sensor says, sector by sector; neighbours of a kind are one outline."""
    x, y, yaw = scene.pose
    reach_m = scene.robot.lidar.max_range_m
    first = yaw + BIN_RAD * np.arange(NUM_BINS)
    ends = np.stack([first, first + BIN_RAD], axis=1)
    distances_m = np.minimum(scene.distances_m, reach_m)[:, None]
    rim = np.stack([x + distances_m * np.cos(ends), y + distances_m * np.sin(ends)], axis=-1)  # [bins, 2 borders, 2]
    hit = scene.sensor_mask & (scene.distances_m < reach_m)
    return SensorView(
        near=_fans(rim, hit, (x, y)),
        silent=_fans(rim, scene.sensor_mask & ~hit, (x, y)),
        hits=rim[hit].reshape(-1, 4),
    )


def _fans(rim: Array, chosen: NDArray[np.bool_], centre: tuple[float, float]) -> list[Array]:
    """Return outlines of runs of neighbouring sectors, each from the centre along its rim."""
    indices = np.flatnonzero(chosen)
    if not len(indices):
        return []
    runs = np.split(indices, np.flatnonzero(np.diff(indices) > 1) + 1)
    return [np.concatenate([[centre], rim[run].reshape(-1, 2)]) for run in runs]


@lru_cache(maxsize=256)
def weights_of(measure: RiskMeasure, beta: float, num_quantiles: int) -> Array:
    """Return the weights that a beta puts on equal parts of the return's distribution, [N]; their mean is 1.

    Example:
        >>> from rcdsac_trl.agent.risk import CVaR
        >>> weights_of(CVaR(), 0.5, 4).tolist()
        [2.0, 2.0, 0.0, 0.0]
    """
    borders = torch.arange(num_quantiles + 1, dtype=torch.float64, device="cpu") / num_quantiles
    shares = measure.inverse_psi(borders, torch.tensor(beta, device="cpu")).diff()
    weights: Array = (shares * num_quantiles).numpy()
    return weights


def return_view(robot: Robot) -> ReturnView | None:
    """Return what the critics expect of what a robot's driver chose last."""
    driver, command = robot.driver, robot.command
    beta = driver.beta(robot.dialled)
    if not isinstance(driver, AgentDriver) or driver.measure is None or beta is None:
        return None
    if command is None or command.quantiles is None:
        return None
    quantiles = command.quantiles.astype(np.float64)
    weights = weights_of(driver.measure, beta, len(quantiles))
    fractions = driver.policy.fractions.astype(np.float64)
    mean, value = float(quantiles.mean()), float((quantiles * weights).mean())
    return ReturnView(fractions, quantiles, weights, mean, value, driver.policy.recalibrated)


def value_view(robot: Robot) -> ValueView | None:
    """Ask a robot's critics for the value of every action where it stands; this takes some milliseconds."""
    driver = robot.driver
    if not isinstance(driver, AgentDriver) or robot.command is None:
        return None
    beta = driver.beta(robot.dialled)
    told = beta if driver.policy.config.context == "beta" else None
    expected = driver.policy.outlooks(_actions(), told).astype(np.float64)
    if driver.measure is not None and beta is not None:
        expected = expected * weights_of(driver.measure, beta, expected.shape[1])
    coarse = expected.mean(axis=1).reshape(VALUES_A_SIDE, VALUES_A_SIDE)
    low, high = (desired_velocities((end, end), driver.robot) for end in (-1.0, 1.0))
    turns = math.degrees(low[1]), math.degrees(high[1])
    fine = (FINE * (VALUES_A_SIDE - 1) + 1) / VALUES_A_SIDE
    return ValueView(zoom(coarse, fine, order=3), (low[0], high[0]), turns)


@lru_cache(maxsize=1)
def _actions() -> NDArray[np.float32]:
    """Return the actions that are asked about, by turn and then by speed, [n * n, 2]."""
    along = np.linspace(-1.0, 1.0, VALUES_A_SIDE, dtype=np.float32)
    turn, speed = np.meshgrid(along, along, indexing="ij")
    return np.stack([speed, turn], axis=-1).reshape(-1, 2)


def _in_degrees(v: float, omega: float) -> tuple[float, float]:
    return v, math.degrees(omega)
