"""What was hit on the course, and whether the cameras had seen it."""

import math
from typing import Any

import numpy as np
import pandas as pd
from numpy.typing import NDArray

from rcdsac_trl.config.course_settings import PERIOD_S
from rcdsac_trl.evaluation.course.course_drive import Trace, is_own
from rcdsac_trl.robot.range_sensor import BIN_RAD, NUM_BINS
from rcdsac_trl.rollout.collisions import PART_M, touch_columns
from rcdsac_trl.world.maps.geometry import segment_clearance
from rcdsac_trl.world.maps.shapes import solid_arrays
from rcdsac_trl.world.office.building import Office
from rcdsac_trl.world.office.furniture import Piece
from rcdsac_trl.world.sim.contact import Touch

COLLISION_COLUMNS = (
    "time_s",
    "thing",
    "own",
    "bearing_rad",
    "unseen_s",
    "x_m",
    "y_m",
    "robot_x_m",
    "robot_y_m",
    "robot_yaw_rad",
    "robot_v_m_per_s",
    "robot_omega_rad_per_s",
)
"""What is said of a collision."""

# What is this near to where a sector says that something is was seen: a sector's half width at 2.5 m, and noise.
_SEEN_M = 0.1
_MIDDLES = (np.arange(NUM_BINS) + 0.5) * BIN_RAD


def collisions_of(office: Office, trace: Trace) -> pd.DataFrame:
    """Return one row a collision.

    Returns:
        :data:`COLLISION_COLUMNS`: time since the start; `thing`, the piece's name, or ``person``; `own`, 0 if a person
        walked into the standing robot; bearing in the robot's frame; `unseen_s`, how long ago a sector had told a
        distance at which the thing was, NaN: never; place, robot's pose, and its velocities before the contact.
    """
    return pd.DataFrame([_row(office, trace, *touched) for touched in trace.touches], columns=COLLISION_COLUMNS)


def _row(office: Office, trace: Trace, step: int, touch: Touch) -> dict[str, Any]:
    piece = _nearest(office, touch) if touch.mover is None else None
    seen = _last_seen(office, trace, step, touch, piece)
    return touch_columns(touch) | {
        "time_s": step * PERIOD_S,
        "thing": "person" if piece is None else piece.name,
        "own": int(is_own(touch)),
        "unseen_s": math.nan if seen is None else (step - 1 - seen) * PERIOD_S,
    }


def _nearest(office: Office, touch: Touch) -> Piece:
    """Return the piece that was touched."""
    return min(office.pieces, key=lambda piece: _gap_m(piece, touch.x, touch.y))


def _gap_m(piece: Piece, x: float, y: float) -> float:
    return float(segment_clearance(x, y, x, y, *solid_arrays([piece.footprint]), math.inf))


def _last_seen(office: Office, trace: Trace, step: int, touch: Touch, piece: Piece | None) -> int | None:
    """Return the last command before which a sector told a distance at which the thing was; None: none did."""
    for moment in range(step - 1, -1, -1):
        points = _points(trace.distances_m[moment], trace.poses[moment])
        if piece is None:
            assert touch.mover is not None
            radius_m = office.map.movers[touch.mover].radius
            gaps = np.hypot(*(points - trace.people[moment, touch.mover]).T) - radius_m
            seen = bool((np.abs(gaps) < _SEEN_M).any())
        else:
            near = points[np.hypot(*(points - (touch.x, touch.y)).T) < PART_M]
            seen = any(_gap_m(piece, x, y) < _SEEN_M for x, y in near.tolist())
        if seen:
            return moment
    return None


def _points(distances_m: NDArray[np.float64], pose: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return where sectors say that something is, map frame, [k, 2], m."""
    there = np.isfinite(distances_m)
    angles = _MIDDLES[there] + pose[2]
    points: NDArray[np.float64] = pose[:2] + distances_m[there, None] * np.stack((np.cos(angles), np.sin(angles)), 1)
    return points
