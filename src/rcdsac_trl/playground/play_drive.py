"""The drive that a page shows: one robot or two, each in a world of its own of the same map and seed.

Nothing here knows of a browser: it is stepped, and told what to do.
"""

import math
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass, field, replace

import numpy as np

from rcdsac_trl.deploy import Command
from rcdsac_trl.errors import UserInputError
from rcdsac_trl.playground.arenas import MOST_OBSTACLES, OBSTACLE_RADIUS_M, Arena, CourseArena, MapArena
from rcdsac_trl.playground.cast import cast
from rcdsac_trl.playground.drivers import AgentDriver, Driver
from rcdsac_trl.playground.offers import OFFICE, Offers
from rcdsac_trl.playground.scene_choice import SceneChoice
from rcdsac_trl.robot.planar import placed
from rcdsac_trl.world.office.building import make_office
from rcdsac_trl.world.task.rules import TaskSettings

TRAIL_STEPS = 400
"""So many steps of its way are kept of a robot."""

# An obstacle that was taken away waits here to be put again, far from all that senses or touches.
_AWAY_M = (-1000.0, -1000.0)


@dataclass
class Robot:
    """One robot: its world, who drives it, and what came of it.

    Attributes:
        name: who drives.
        driver: likewise.
        arena: its world.
        dialled: beta, or the collision weight; None where there is neither.
        command: the last one; None before the first step.
        steps: taken so far.
        reward: so far; None where nothing is paid.
        collisions: contacts begun so far.
        goals: reached so far.
        contacts: where contacts began, x and y, m.
        in_contact: whether it touches something.
        trail: where it was and how fast, x and y in m and m/s, the latest steps.
        detour: the corner that it was sent to instead of its next waypoint, x and y, m; None: it was not.
    """

    name: str
    driver: Driver
    arena: Arena
    dialled: float | None
    command: Command | None = None
    steps: int = 0
    reward: float | None = None
    collisions: int = 0
    goals: int = 0
    contacts: list[tuple[float, float]] = field(default_factory=list)
    in_contact: bool = False
    trail: deque[tuple[float, float, float]] = field(default_factory=lambda: deque(maxlen=TRAIL_STEPS))
    detour: tuple[float, float] | None = None

    def __post_init__(self) -> None:
        """Begin the drive, and the trail where the robot starts."""
        self.driver.begin(self.arena.period_s)
        x, y, _ = self.arena.simulation.pose
        self.trail.append((x, y, 0.0))

    @property
    def time_s(self) -> float:
        """How long it has driven."""
        return self.steps * self.arena.period_s

    def step(self) -> None:
        """Take one agent step."""
        command = self.driver.act(self.arena.situation(), self.dialled)
        self.detour = self._on_map(self.driver.detour)
        outcome = self.arena.step(command.v_m_per_s, command.omega_rad_per_s)
        self.command = command
        self.steps += 1
        x, y, _ = self.arena.simulation.pose
        self.trail.append((x, y, outcome.speed_m_per_s))
        if outcome.reward is not None:
            self.reward = outcome.reward + (self.reward or 0.0)
        if outcome.in_contact and not self.in_contact:
            self.collisions += 1
            self.contacts.append((x, y))
        self.in_contact = outcome.in_contact
        self.goals += outcome.goal_reached

    def _on_map(self, place: tuple[float, float] | None) -> tuple[float, float] | None:
        """Return a place in the robot's frame in that of the map, m."""
        if place is None:
            return None
        ((x, y),) = placed(np.array([place]), self.arena.simulation.pose).tolist()
        return x, y


class Drive:
    """All robots of a scene, stepped together.

    Args:
        choice: the scene.
        offers: what there is to choose from.

    Attributes:
        choice: the scene, with the betas that are dialled now.
        robots: one or two.

    Raises:
        UserInputError: if :func:`~rcdsac_trl.playground.cast.cast` refuses the scene, or its map cannot be made.
    """

    def __init__(self, choice: SceneChoice, offers: Offers) -> None:
        self.choice = choice
        # Where each that was put stands, by its number; None: it was taken away.
        self._obstacles: list[tuple[float, float] | None] = []
        parts = cast(choice, offers)
        self.robots: list[Robot] = []
        try:
            for part in parts:
                arena = _arena(choice, part.driver, offers)
                self.robots.append(Robot(part.name, part.driver, arena, part.dialled))
            self.choice = choice.with_betas([part.dialled for part in parts])
        except BaseException:
            self.close()
            raise

    @property
    def period_s(self) -> float:
        """Duration of a step."""
        return self.robots[0].arena.period_s

    def step(self) -> None:
        """Take one agent step with every robot."""
        for robot in self.robots:
            robot.step()

    def set_beta(self, number: int, value: float) -> None:
        """Turn a robot's beta, or collision weight.

        Raises:
            UserInputError: if it is outside the trained range, or that robot has none.
        """
        if number >= len(self.robots):
            raise UserInputError("there is no second robot: choose who drives it")
        robot = self.robots[number]
        if robot.driver.dial is None:
            raise UserInputError(f"{robot.name} has no beta: choose an agent that is risk-conditioned")
        robot.dialled = robot.driver.dial.check("beta" if number == 0 else "beta2", value)
        if robot.command is not None:
            robot.command = robot.driver.reconsidered(robot.command, robot.dialled)
        self.choice = self.choice.with_betas([robot.dialled for robot in self.robots])

    def set_stop_zone(self, on: bool) -> None:
        """Put a stop zone between all drivers and their wheels, or take it away."""
        for robot in self.robots:
            robot.driver.guarded = on
        self.choice = replace(self.choice, stop=on)

    def set_detours(self, on: bool) -> None:
        """Put detours and a watchdog around all agents, or take them away; planners navigate by themselves."""
        for robot in self.robots:
            robot.driver.set_detours(on)
        self._forget_detours()
        self.choice = replace(self.choice, detours=on)

    def _forget_detours(self) -> None:
        """Show none until the next step says where it leads now."""
        for robot in self.robots:
            robot.detour = None

    def set_goal(self, x: float, y: float) -> None:
        """Send all robots to the place nearest to a point, m, that they can get to."""
        self._each(lambda arena: arena.set_goal(x, y))
        self._forget_detours()

    def put_obstacle(self, x: float, y: float) -> None:
        """Put an obstacle into every world.

        Raises:
            UserInputError: if there are too many, or it cannot stand there.
        """
        if len(self._obstacles) - self._obstacles.count(None) == MOST_OBSTACLES:
            raise UserInputError(f"{MOST_OBSTACLES} obstacles are there already: drag one of them")
        self._check_room(x, y)
        if None in self._obstacles:
            self._move(self._obstacles.index(None), (x, y))
        else:
            self._each(lambda arena: arena.put_obstacle(x, y))
            self._obstacles.append((x, y))

    def move_obstacle(self, number: int, x: float, y: float) -> None:
        """Move an obstacle in every world.

        Raises:
            UserInputError: if there is none of that number, or it cannot stand there.
        """
        if number not in self._standing():
            raise UserInputError(f"there is no obstacle {number}: those that stand are {sorted(self._standing())}")
        self._check_room(x, y, number)
        self._move(number, (x, y))

    def put_or_take_obstacle(self, x: float, y: float) -> None:
        """Take away the obstacle that stands at a place, m; where none does, put one.

        Raises:
            UserInputError: if there are too many, or it cannot stand there.
        """
        for number, place in self._standing().items():
            if math.dist(place, (x, y)) < OBSTACLE_RADIUS_M:
                self._move(number, _AWAY_M)
                self._obstacles[number] = None
                return
        self.put_obstacle(x, y)

    def _move(self, number: int, place: tuple[float, float]) -> None:
        self._each(lambda arena: arena.move_obstacle(number, *place))
        self._obstacles[number] = place

    def _standing(self) -> dict[int, tuple[float, float]]:
        """Return where the obstacles stand that were not taken away, by their numbers."""
        return {number: place for number, place in enumerate(self._obstacles) if place is not None}

    def _check_room(self, x: float, y: float, moved: int | None = None) -> None:
        """Refuse a place for an obstacle, new or moved, that is taken or outside."""
        for robot in self.robots:
            robot.arena.check_room(x, y)
        for number, place in self._standing().items():
            if number != moved and math.dist(place, (x, y)) < 2.0 * OBSTACLE_RADIUS_M:
                raise UserInputError("an obstacle stands there already: put it beside that one, or drag it")

    def push(self, side: float) -> None:
        """Push all robots to their left (1.0) or to their right (-1.0)."""
        self._each(lambda arena: arena.push(side))
        self._forget_detours()

    def close(self) -> None:
        """Free the physics."""
        self._each(lambda arena: arena.close())

    def _each(self, act: Callable[[Arena], None]) -> None:
        for robot in self.robots:
            act(robot.arena)


def _arena(choice: SceneChoice, driver: Driver, offers: Offers) -> Arena:
    if choice.map != OFFICE:
        return MapArena(offers.source(choice.map), choice.seed, driver.robot, driver.sensor, driver.memory_s)
    config = driver.policy.config if isinstance(driver, AgentDriver) else TaskSettings()
    return CourseArena(make_office(), config, choice.seed)
