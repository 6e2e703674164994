"""Films of replays: what a recorded robot saw from above, and what an agent would have done there."""

from collections.abc import Iterator, Sequence

import numpy as np

from rcdsac_trl.evaluation.film.video import Frame
from rcdsac_trl.evaluation.recorded_drive import RecordedPeriod
from rcdsac_trl.robot.planar import placed
from rcdsac_trl.robot.range_sensor import NUM_BINS
from rcdsac_trl.robot.sectors import Sectors
from rcdsac_trl.world.maps.shapes import Map
from rcdsac_trl.world.render import Renderer, Scene

FPS = 2.0
"""Frames a control period: films show replays twice as fast as they were recorded."""

_SIDE_PX, _VIEW_M = 640, 8.0
_TRAIL_PERIODS = 400


def frames(periods: Sequence[RecordedPeriod]) -> Iterator[Frame]:
    """Yield a picture of each period, uint8 RGB, [640, 640, 3].

    Where the agent was not asked, the picture is that of before, with the reason.
    """
    poses = np.array([period.situation.pose for period in periods if period.situation is not None] or [(0.0, 0.0, 0.0)])
    # The floor is a square that begins at 0 and holds the whole way and what is seen beside it.
    shift = _VIEW_M - poses[:, :2].min(axis=0)
    floor = Map("clutter", float(np.ptp(poses[:, :2], axis=0).max()) + 2.0 * _VIEW_M, (), (), ())
    renderer = Renderer(_SIDE_PX, _VIEW_M)
    trail: list[tuple[float, float]] = []
    pose, waypoints = tuple(poses[0]), np.empty((0, 2))
    sectors = Sectors(np.full(NUM_BINS, np.inf), np.zeros(NUM_BINS, dtype=np.bool_))
    for period in periods:
        if period.situation is not None and period.sectors is not None:
            pose, sectors = period.situation.pose, period.sectors
            waypoints = placed(period.situation.waypoints, pose) + shift
        here = (pose[0] + shift[0], pose[1] + shift[1])
        trail = [*trail[-_TRAIL_PERIODS:], here]
        scene = Scene(
            map=floor,
            pose=(*here, pose[2]),
            distances_m=sectors.distances_m,
            sensor_mask=sectors.covered,
            waypoints=waypoints,
            movers=np.empty((0, 3)),
            trail=trail,
            in_contact=period.command.stopped,
        )
        yield renderer.draw(scene, _caption(period))


def _caption(period: RecordedPeriod) -> str:
    command = period.command
    if command.stopped and command.reason is not None:
        return f"{period.time_s:.0f} s  {command.reason.split(';')[0][:70]}"
    return f"{period.time_s:.0f} s  {command.v_m_per_s:.2f} m/s (measured {period.measured[0]:.2f})"
