"""Why robots still collide: of each collision what was hit, and when the agent last sensed it.

Taken down while an evaluation drives, and worked out when the map is done. The simulation says where it touched what;
all else follows from the map and from where robot and movers were at each step.
"""

import math
from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np
import pandas as pd
from numpy.typing import NDArray

from rcdsac_trl.robot.range_sensor import BIN_RAD, NUM_BINS
from rcdsac_trl.robot.robot_settings import PAPER, RobotSettings
from rcdsac_trl.rollout.evaluation_pool import Rows
from rcdsac_trl.rollout.measurement import CONDITION_COLUMNS
from rcdsac_trl.world.maps.geometry import segment_clearance
from rcdsac_trl.world.maps.shapes import Box, Cylinder, Map, solid_arrays
from rcdsac_trl.world.sim.contact import Touch
from rcdsac_trl.world.sim.lidar import sector_distances
from rcdsac_trl.world.task.agent_group import AgentGroup

COLLISIONS = "collision_rows"
"""Key of an episode's row for its collisions, one row each."""
COLLISION_COLUMNS = (
    "step",
    "time_s",
    "thing",
    "bearing_rad",
    "bearing_sensed",
    "unsensed_s",
    "x_m",
    "y_m",
    "robot_x_m",
    "robot_y_m",
    "robot_yaw_rad",
    "robot_v_m_per_s",
    "robot_omega_rad_per_s",
    "thing_vx_m_per_s",
    "thing_vy_m_per_s",
)
"""What is said of a collision."""
PART_M = 0.5
"""Of a box, what lies within this of the contact along its sides must be sensed, m: who sees the far end of a long wall
does not see where it hits it."""

# Distances to a part of a wall differ by rounding from those to all of it.
_ROUNDING_M = 1e-9


class CollisionRecorder:
    """Takes down what the collisions of a group's episode are worked out from.

    Args:
        agents: those that drive.
    """

    def __init__(self, agents: AgentGroup) -> None:
        self._agents = agents
        self._poses: list[NDArray[np.float32]] = []
        self._movers: list[NDArray[np.float64]] = []
        self._contact = np.zeros(len(agents), np.bool_)
        self._began: list[tuple[int, int, Touch]] = []  # agent, step, and how

    def note(self) -> None:
        """Take down a moment: once after the reset, and once after each step."""
        buffers, rows = self._agents.buffers, range(len(self._agents))
        contact = buffers.contact[:, 0].astype(np.bool_)
        for row in np.flatnonzero(contact & ~self._contact).tolist():
            touch = self._agents.simulation(row).touch
            assert touch is not None  # nothing else begins a contact
            self._began.append((row, len(self._poses) - 1, touch))
        self._contact = contact
        self._poses.append(buffers.pose.copy())
        self._movers.append(np.stack([self._agents.simulation(row).mover_positions for row in rows]))

    def collisions(
        self, map_: Map, mask: NDArray[np.bool_], periods_s: Sequence[float], robot: RobotSettings = PAPER
    ) -> list[Rows]:
        """Return what is said of each agent's collisions, in their order; see :func:`diagnose`.

        Args:
            map_: that they drove on.
            mask: bins that the sensor has, bool [180].
            periods_s: length of each agent's steps, s.
            robot: which one they are.
        """
        poses, movers = np.stack(self._poses, 1), np.stack(self._movers, 1)
        found: list[Rows] = [[] for _ in periods_s]
        for row, step, touch in self._began:
            until = slice(step + 1)
            moments = poses[row, until], movers[row, until]
            found[row].append(diagnose(touch, map_, mask, *moments, periods_s[row], robot))
        return found


def diagnose(
    touch: Touch,
    map_: Map,
    mask: NDArray[np.bool_],
    poses: NDArray[np.floating],
    movers: NDArray[np.float64],
    period_s: float,
    robot: RobotSettings = PAPER,
) -> dict[str, Any]:
    """Say what was hit in a collision, and when it was last sensed.

    A thing is sensed at a moment if the smallest distance in a sector of the sensor is the one to it. Noise and
    drop-outs of ranges are left out.

    Args:
        touch: how the contact began.
        map_: where.
        mask: bins that the sensor has, bool [180].
        poses: the robot's, from the episode's start to the moment before the step that collided, [T, 3].
        movers: where they were at the same moments, [T, k, 2], m.
        period_s: length of an agent step, s.
        robot: which one it is.

    Returns:
        :data:`COLLISION_COLUMNS`: number of the step, from 0; time since the start; `thing`, a
        :data:`~rcdsac_trl.world.maps.shapes.Kind` or ``mover``; bearing of the contact in the robot's frame, and 1 if
        the sensor has the sector there, else 0; `unsensed_s`, how long ago the thing was last sensed, NaN: never; the
        contact's place; the robot's pose, and its velocities before contact took any of them away; the thing's
        velocity, a mean over the agent step before. Places and the thing's velocity are in the map frame.
    """
    step = len(poses) - 1
    time_s = step * period_s + touch.motor_step * robot.motor_period_s
    told = touch_columns(touch)
    discs = _discs(movers, [mover.radius for mover in map_.movers])
    if touch.mover is None:
        piece = _nearest(map_, touch.x, touch.y)
        thing: str = map_.kind(piece)
        velocity = np.zeros(2)
        segments, hit_discs = _standing(_around(piece, touch.x, touch.y), len(poses))
    else:
        thing = "mover"
        velocity = (movers[step, touch.mover] - movers[max(step - 1, 0), touch.mover]) / period_s
        segments, hit_discs = np.empty((0, 4)), discs[:, [touch.mover]]
    sensed = _last_sensed(segments, hit_discs, map_, discs, mask, poses, robot.lidar.max_range_m)
    row = told | {
        "step": step,
        "time_s": time_s,
        "thing": thing,
        "bearing_sensed": int(mask[math.floor(told["bearing_rad"] / BIN_RAD) % NUM_BINS]),
        "unsensed_s": math.nan if sensed is None else time_s - sensed * period_s,
        "thing_vx_m_per_s": float(velocity[0]),
        "thing_vy_m_per_s": float(velocity[1]),
    }
    return {name: row[name] for name in COLLISION_COLUMNS}


def touch_columns(touch: Touch) -> dict[str, float]:
    """Return what is said of a collision wherever it was: the bearing, the place, the robot's pose and velocities."""
    x, y, yaw = touch.pose
    return {
        "bearing_rad": math.remainder(math.atan2(touch.y - y, touch.x - x) - yaw, 2.0 * math.pi),
        "x_m": touch.x,
        "y_m": touch.y,
        "robot_x_m": x,
        "robot_y_m": y,
        "robot_yaw_rad": yaw,
        "robot_v_m_per_s": touch.v,
        "robot_omega_rad_per_s": touch.omega,
    }


def collision_table(episodes: pd.DataFrame) -> pd.DataFrame:
    """Return one row a collision: what names its episode, and :data:`COLLISION_COLUMNS`.

    Args:
        episodes: one row an episode, with :data:`COLLISIONS`.
    """
    names = [*(key for key in CONDITION_COLUMNS if key in episodes), "map", "episode"]
    rows = [
        dict(zip(names, values, strict=True)) | collision
        for *values, collisions in episodes[[*names, COLLISIONS]].itertuples(index=False)
        for collision in collisions
    ]
    return pd.DataFrame(rows, columns=[*names, *COLLISION_COLUMNS])


def _nearest(map_: Map, x: float, y: float) -> Box | Cylinder:
    """Return what stands nearest to a point."""
    pieces: list[Box | Cylinder] = [*map_.boxes, *map_.cylinders]
    gaps_m = [segment_clearance(x, y, x, y, *solid_arrays([piece]), math.inf) for piece in pieces]
    return pieces[int(np.argmin(gaps_m))]


def _around(piece: Box | Cylinder, x: float, y: float) -> Box | Cylinder:
    """Return the part of a box within :data:`PART_M` of a point along its sides; a cylinder as it is."""
    if isinstance(piece, Cylinder):
        return piece
    cos, sin = math.cos(piece.yaw), math.sin(piece.yaw)
    dx, dy = x - piece.x, y - piece.y
    middle_x, half_x = _cut(cos * dx + sin * dy, piece.half_x)
    middle_y, half_y = _cut(cos * dy - sin * dx, piece.half_y)
    return replace(
        piece,
        x=piece.x + cos * middle_x - sin * middle_y,
        y=piece.y + sin * middle_x + cos * middle_y,
        half_x=half_x,
        half_y=half_y,
    )


def _cut(at: float, half: float) -> tuple[float, float]:
    """Return middle and half length of what lies within :data:`PART_M` of a place on a side."""
    low, high = max(at - PART_M, -half), min(at + PART_M, half)
    return (low + high) / 2.0, (high - low) / 2.0


def _discs(centres: NDArray[np.float64], radii: Sequence[float]) -> NDArray[np.float64]:
    """Put radii [k] beside the centres [T, k, 2] of some moments; float64 [T, k, 3], m."""
    return np.concatenate([centres, np.broadcast_to(np.array(radii)[:, None], (*centres.shape[:2], 1))], axis=2)


def _standing(piece: Box | Cylinder, moments: int) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return the segments [n, 4] of something that stands, and its discs [T, m, 3] at so many moments."""
    boxes = (piece,) if isinstance(piece, Box) else ()
    cylinders = (piece,) if isinstance(piece, Cylinder) else ()
    alone = Map(layout="", size_m=0.0, boxes=boxes, cylinders=cylinders, movers=())
    return alone.segments(), np.broadcast_to(alone.circles(), (moments, len(cylinders), 3))


def _last_sensed(
    hit_segments: NDArray[np.float64],
    hit_discs: NDArray[np.float64],
    map_: Map,
    movers: NDArray[np.float64],
    mask: NDArray[np.bool_],
    poses: NDArray[np.floating],
    max_range_m: float,
) -> int | None:
    """Return the last moment at which a thing was sensed; None: never.

    Args:
        hit_segments: of the thing, [n, 4], m.
        hit_discs: likewise, at each moment, [T, m, 3], m.
        map_: everything that stands.
        movers: the discs of all movers at each moment, [T, k, 3], m.
        mask: bins that the sensor has, bool [180].
        poses: the robot's, [T, 3].
        max_range_m: reach of the sensor.
    """
    segments, circles = map_.segments(), map_.circles()
    for moment in range(len(poses) - 1, -1, -1):
        x, y, yaw = poses[moment].tolist()
        hit_m = sector_distances(x, y, yaw, hit_segments, hit_discs[moment], max_range_m)
        within = mask & np.isfinite(hit_m)
        if not within.any():
            continue
        nearest_m = sector_distances(x, y, yaw, segments, np.concatenate([circles, movers[moment]]), max_range_m)
        if (within & (hit_m <= nearest_m + _ROUNDING_M)).any():
            return moment
    return None
