"""Films of runs over the course, seen from above."""

from collections.abc import Iterator

import numpy as np
from numpy.typing import NDArray

from rcdsac_trl.config.course_settings import PERIOD_S
from rcdsac_trl.deploy.policy.path import PathFollower
from rcdsac_trl.evaluation.course.course_drive import Pilot, Trace
from rcdsac_trl.evaluation.film.video import Frame
from rcdsac_trl.robot.planar import placed
from rcdsac_trl.robot.range_sensor import sensor_mask
from rcdsac_trl.world.office.building import Office
from rcdsac_trl.world.render import Renderer, Scene
from rcdsac_trl.world.task.rules import collision_due

FPS = 3 / PERIOD_S
"""Frames a second: films show runs three times as fast as they were driven."""

_SIDE_PX = 480
_VIEW_M = 8.0
_TRAIL_STEPS = 400


def frames(office: Office, pilot: Pilot, trace: Trace, course: NDArray[np.float64], title: str) -> Iterator[Frame]:
    """Yield a picture of each step of a run: what is around the robot at the left, the whole office at the right.

    Args:
        office: where it was driven.
        pilot: who drove.
        trace: of the run.
        course: as it was driven, [k, 2].
        title: what is driven, for the caption.

    Yields:
        uint8 RGB, [480, 960, 3].
    """
    near, far = Renderer(_SIDE_PX, _VIEW_M), Renderer(_SIDE_PX)
    for step, (scene, collisions) in enumerate(scenes(office, pilot, trace, course)):
        v = trace.commands[step, 0]
        left = near.draw(scene, f"{v:.2f} m/s{'  (limited)' if trace.limited[step] else ''}")
        right = far.draw(scene, f"{title}   {step * PERIOD_S:.0f} s   collisions: {collisions}")
        yield np.concatenate([left, right], axis=1)


def scenes(
    office: Office, pilot: Pilot, trace: Trace, course: NDArray[np.float64], trail_steps: int = _TRAIL_STEPS
) -> Iterator[tuple[Scene, int]]:
    """Yield what there is to draw of each step of a run, and how many collisions there were until then.

    Args:
        office: where it was driven.
        pilot: who drove.
        trace: of the run.
        course: as it was driven, [k, 2].
        trail_steps: of how many steps the way driven is shown.
    """
    follower = PathFollower(course, pilot.config)
    mask = sensor_mask("narrow")
    radii = np.array([mover.radius for mover in office.map.movers])
    contacts = trace.in_contact.tolist()
    collisions = 0
    for step in range(len(trace.commands)):
        waypoints = follower.update(_pose(trace.estimates[step]))
        assert waypoints is not None  # else the run would have ended
        collisions += collision_due(contacts[step], contacts[max(step - 1, 0)], "onset")
        scene = Scene(
            map=office.map,
            pose=_pose(trace.poses[step]),
            distances_m=trace.distances_m[step],
            sensor_mask=mask,
            waypoints=placed(waypoints, trace.estimates[step]),
            movers=np.column_stack([trace.people[step], radii]),
            trail=[(x, y) for x, y in trace.poses[max(0, step - trail_steps) : step + 1, :2].tolist()],
            in_contact=bool(trace.in_contact[step]),
        )
        yield scene, collisions


def _pose(row: NDArray[np.float64]) -> tuple[float, float, float]:
    x, y, yaw = row.tolist()
    return x, y, yaw
