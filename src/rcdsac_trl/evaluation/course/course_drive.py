"""One run over the course: all that the pilot learns comes from four depth cameras and odometry."""

import contextlib
import itertools
import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any, Literal, Protocol

import numpy as np
from numpy.typing import NDArray

from rcdsac_trl.config.course_settings import PERIOD_S, OdometrySettings, Ranges
from rcdsac_trl.deploy.policy.command import Command
from rcdsac_trl.deploy.policy.input_checks import Stamps
from rcdsac_trl.deploy.policy.path import PathFollower
from rcdsac_trl.errors import UserInputError
from rcdsac_trl.evaluation.course.camera_rig import camera_poses, covered, mounted, sectors_of_clouds
from rcdsac_trl.evaluation.course.odometry import Odometry, Pose
from rcdsac_trl.robot.sectors import Sectors
from rcdsac_trl.seeding import stream
from rcdsac_trl.world.office.building import PERSON_HEIGHT_M, Office
from rcdsac_trl.world.office.depth_cameras import DepthCameras, Lens
from rcdsac_trl.world.sim.contact import Touch
from rcdsac_trl.world.sim.simulation import Simulation, StepResult
from rcdsac_trl.world.task.rules import collision_due

Direction = Literal["forward", "reverse"]
DIRECTIONS: tuple[Direction, ...] = ("forward", "reverse")

# In motor steps of 0.02 s it is 7.5: a command takes effect at the next one, so it lasts 7 or 8 of them.
_MOTOR_STEPS_OF_TWO = 15
# Outside of everything: there are the cylinders that nobody has put anywhere yet.
_NOWHERE_M = -100.0
STANDS_M_PER_S = 0.05
"""A robot that is slower stands."""
STILL_M = 0.3
"""A robot that stays so near to where it was gets nowhere."""


class Pilot(Protocol):
    """Who drives: a :class:`rcdsac_trl.deploy.Policy`, or what behaves like one."""

    config: Any
    """Has ``waypoint_radius_m`` and ``goal_radius_m``."""

    def reset(self) -> None:
        """Forget everything before."""
        ...

    def act(
        self, ranges: Any, waypoints: Any, velocity: Any, beta: float | None, *, stamps: Stamps | None, pose: Pose
    ) -> Command:
        """Return the command for this control period."""
        ...


@dataclass(frozen=True)
class Conditions:
    """What all runs of a course have in common."""

    camera: Lens
    odometry: OdometrySettings
    time_limit_s: float
    seed: int
    ranges: Ranges = "cameras"


@dataclass(frozen=True)
class Trace:
    """What happened in a run; row 0 is the start, row k the state after k commands.

    Attributes:
        finished: whether the robot came to where it took the goal to be.
        poses: the robot's true x, y and yaw, m and rad, float64 [n + 1, 3].
        estimates: where it took itself to be, float64 [n + 1, 3].
        people: where people were, m, float64 [n + 1, k, 2].
        in_contact: whether the robot was in contact since the row before, bool [n + 1].
        nearest_m: true distance from the robot's centre to whatever was nearest, float64 [n + 1].
        distances_m: what the cameras said of each sector before the command, float64 [n, 180].
        velocities: measured velocities before the command, m/s and rad/s, float64 [n, 2].
        commands: what was commanded, m/s and rad/s, float64 [n, 2].
        stopped: whether the pilot refused to drive, bool [n].
        limited: whether speed limit, stop zone or watchdog changed what the pilot wanted, bool [n].
        reached_m: how far along the course it took itself to be at the end, m.
        touches: how contacts began, each with the number of its row.
    """

    finished: bool
    poses: NDArray[np.float64]
    estimates: NDArray[np.float64]
    people: NDArray[np.float64]
    in_contact: NDArray[np.bool_]
    nearest_m: NDArray[np.float64]
    distances_m: NDArray[np.float64]
    velocities: NDArray[np.float64]
    commands: NDArray[np.float64]
    stopped: NDArray[np.bool_]
    limited: NDArray[np.bool_]
    reached_m: float = 0.0
    touches: tuple[tuple[int, Touch], ...] = ()


def course_of(office: Office, direction: Direction) -> NDArray[np.float64]:
    """Return the course's corner points in the order in which they are driven, [k, 2], m."""
    return office.course if direction == "forward" else office.course[::-1]


def start_pose(course: NDArray[np.float64]) -> Pose:
    """Return the pose at a course's beginning: the robot looks along its first leg."""
    (x, y), (x_1, y_1) = course[:2].tolist()
    return x, y, math.atan2(y_1 - y, x_1 - x)


def motor_steps(step: int) -> int:
    """Return how many motor steps a command lasts: 7 and 8 in turns, 0.15 s on average.

    Example:
        >>> [motor_steps(step) for step in range(4)]
        [7, 8, 7, 8]
    """
    return (step + 1) * _MOTOR_STEPS_OF_TWO // 2 - step * _MOTOR_STEPS_OF_TWO // 2


class CourseWorld:
    """The office and a robot in it at the beginning of the course, to be driven step by step.

    Args:
        office: where.
        config: of who drives: its waypoint and goal radii.
        direction: forward or in reverse.
        repetition: number of the run.
        conditions: of all runs.
        spare_discs: radius and height, m, of cylinders that can be put somewhere later; see :meth:`put_disc`.

    Attributes:
        simulation: the physics.
        odometry: where the robot takes itself to be.
        follower: of the path, the course unless somebody sets another one.
        velocity: measured last, m/s and rad/s.
        steps: taken so far.
    """

    def __init__(
        self,
        office: Office,
        config: Any,
        direction: Direction,
        repetition: int,
        conditions: Conditions,
        spare_discs: Sequence[tuple[float, float]] = (),
    ) -> None:
        index = (DIRECTIONS.index(direction), repetition)
        course = course_of(office, direction)
        pose = start_pose(course)
        self.odometry = Odometry(conditions.odometry, pose, stream(conditions.seed, "course/odometry", *index))
        self.follower = PathFollower(course, config)
        self._poses = camera_poses(conditions.camera.view_deg)
        self._in_view = covered(self._poses) if conditions.ranges == "exact" else None
        self._spare_discs = tuple(spare_discs)
        self.simulation = Simulation()
        self._cameras = DepthCameras(
            conditions.camera,
            [mounted(camera) for camera in self._poses],
            office.solids,
            [*((mover.radius, PERSON_HEIGHT_M) for mover in office.map.movers), *self._spare_discs],
            stream(conditions.seed, "course/cameras", *index),
        )
        self.simulation.load(office.map, office.planner, pose, stream(conditions.seed, "course/people", *index))
        self.velocity = self.odometry.velocity(0.0, 0.0)
        self.steps = 0

    def waypoints(self) -> NDArray[np.float64] | None:
        """Return the next two waypoints, m, in the frame of where the robot takes itself to be; None at the goal."""
        return self.follower.update(self.odometry.pose)

    def seen(self) -> Sectors:
        """Return what the pilot is told now: what the cameras say, or what is truly there."""
        if self._in_view is not None:
            return Sectors(np.where(self._in_view, self.simulation.scan(), np.inf), self._in_view)
        put_xy = np.full((len(self._spare_discs), 2), _NOWHERE_M)
        put = self.simulation.put_discs
        put_xy[: len(put)] = put[:, :2]
        moving = np.concatenate([self.simulation.mover_positions, put_xy])
        return sectors_of_clouds(self._cameras.clouds(self.simulation.pose, moving), self._poses)

    def step(self, v: float, omega: float) -> StepResult:
        """Let the robot do what it is told, m/s and rad/s, for a control period."""
        moved = self.simulation.step(v, omega, motor_steps(self.steps))
        self.steps += 1
        self.odometry.move(moved.pose, PERIOD_S)
        self.velocity = self.odometry.velocity(moved.v_c, moved.omega_c)
        return moved

    def put_disc(self, x: float, y: float) -> int:
        """Put the next spare cylinder somewhere, m; return its number, from 0, for ``simulation.move_disc``.

        Raises:
            UserInputError: if there is none left.
        """
        put = len(self.simulation.put_discs)
        if put == len(self._spare_discs):
            raise UserInputError(f"all {put} spare obstacles of the office are in use: move one of them")
        return self.simulation.put_disc(x, y, self._spare_discs[put][0])

    def close(self) -> None:
        """Disconnect from PyBullet; harmless when done before."""
        self._cameras.close()
        self.simulation.close()


def drive_course(
    office: Office,
    pilot: Pilot,
    beta: float | None,
    direction: Direction,
    repetition: int,
    conditions: Conditions,
    before_step: Callable[[], None],
) -> Trace:
    """Drive the course once.

    People, odometry's errors and the cameras' noise derive from seed, direction and repetition: all pilots meet the
    same, as far as they do the same.

    Args:
        office: where.
        pilot: who.
        beta: how much risk it takes; None for its default, or for none.
        direction: forward or in reverse.
        repetition: number of the run.
        conditions: of all runs.
        before_step: called before each command.
    """
    with contextlib.closing(CourseWorld(office, pilot.config, direction, repetition, conditions)) as world:
        pilot.reset()
        states = [_state(world, False)]
        steps: list[dict[str, Any]] = []
        touches: list[tuple[int, Touch]] = []
        while (waypoints := world.waypoints()) is not None:
            now_s = len(steps) * PERIOD_S
            if now_s + PERIOD_S > conditions.time_limit_s:
                break
            before_step()
            seen, velocity = world.seen(), world.velocity
            stamps = Stamps(now_s, now_s, now_s, now_s)
            command = pilot.act(seen, waypoints, velocity, beta, stamps=stamps, pose=world.odometry.pose)
            commanded = (command.v_m_per_s, command.omega_rad_per_s)
            moved = world.step(*commanded)
            step = {"distances_m": seen.distances_m, "velocities": velocity, "commands": commanded}
            limited = not command.stopped and commanded != command.wanted
            steps.append(step | {"stopped": command.stopped, "limited": limited})
            touch = world.simulation.touch
            if touch is not None and moved.in_contact and not states[-1]["in_contact"]:
                touches.append((len(states), touch))
            states.append(_state(world, moved.in_contact))
        columns = _columns(states) | _columns(steps)
        return Trace(bool(world.follower.reached), **columns, reached_m=world.follower.along_m, touches=tuple(touches))


def measures(trace: Trace, course: NDArray[np.float64]) -> dict[str, float | int | bool]:
    """Return what a run amounts to.

    Args:
        trace: of the run.
        course: as it was driven, [k, 2].

    Returns:
        `finished`; `time_s` until the end or the time limit; `reached_m`, how far along the course it came;
        `longest_still_s`, the longest time in which it stayed within 0.3 m of a place; `collisions`, contacts that
        began; `own_collisions`, those without people who walked into a standing robot; `contact_fraction` of
        the steps; `driven_m`; `nearest_m`, smallest true distance from the robot's centre to anything; `stopped_steps`
        and `limited_steps`, in which the pilot refused to drive, or its limits changed its wish; `goal_error_m`, true
        distance to the goal at the end; `estimate_error_m`, the largest error of the estimated position.
    """
    contacts = trace.in_contact.tolist()
    onsets = (collision_due(now, before, "onset") for before, now in itertools.pairwise(contacts))
    return {
        "finished": trace.finished,
        "time_s": len(trace.commands) * PERIOD_S,
        "reached_m": trace.reached_m,
        "longest_still_s": longest_still_steps(trace.poses[:, :2]) * PERIOD_S,
        "collisions": sum(onsets),
        "own_collisions": sum(is_own(touch) for _, touch in trace.touches),
        "contact_fraction": float(trace.in_contact[1:].mean()),
        "driven_m": float(np.hypot(*np.diff(trace.poses[:, :2], axis=0).T).sum()),
        "nearest_m": float(trace.nearest_m.min()),
        "stopped_steps": int(trace.stopped.sum()),
        "limited_steps": int(trace.limited.sum()),
        "goal_error_m": float(np.hypot(*(trace.poses[-1, :2] - course[-1]))),
        "estimate_error_m": float(np.hypot(*(trace.estimates - trace.poses)[:, :2].T).max()),
    }


def is_own(touch: Touch) -> bool:
    """Return whether the robot drove into what it touched: not if a person walked into it while it stood."""
    return touch.mover is None or abs(touch.v) >= STANDS_M_PER_S


def longest_still_steps(places: NDArray[np.float64]) -> int:
    """Return the most steps in which the robot stayed within 0.3 m of where it was before them.

    Args:
        places: its x and y after each step, [n, 2], m.

    Example:
        >>> longest_still_steps(np.array([(0.0, 0.0), (0.1, 0.0), (0.2, 0.0), (0.4, 0.0), (0.9, 0.0)]))
        2
    """
    longest, first = 0, 0
    for step in range(len(places)):
        while math.dist(places[first], places[step]) > STILL_M:
            first += 1
        longest = max(longest, step - first)
    return longest


def _state(world: CourseWorld, in_contact: bool) -> dict[str, Any]:
    return {
        "poses": world.simulation.pose,
        "estimates": world.odometry.pose,
        "people": world.simulation.mover_positions,
        "in_contact": in_contact,
        "nearest_m": world.simulation.scan().min(),
    }


def _columns(rows: list[dict[str, Any]]) -> dict[str, Any]:
    """Stack rows that have the same keys."""
    return {key: np.array([row[key] for row in rows]) for key in rows[0]}
