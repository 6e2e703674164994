"""Films of runs over the course, seen from above."""

import importlib.util
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from rcdsac_trl.deploy.path import PathFollower
from rcdsac_trl.errors import UserInputError
from rcdsac_trl.interface import sensor_mask
from rcdsac_trl.pipeline.course.drive import PERIOD_S, Pilot, Trace
from rcdsac_trl.world.office import Office
from rcdsac_trl.world.render import Renderer, Scene

Frame = NDArray[np.uint8]

SPEED_UP = 3
"""How many times as fast as they were driven films show runs."""

_SIDE_PX = 480
_VIEW_M = 8.0
_TRAIL_STEPS = 400
# What keeps an animated GIF below about 10 MB: every so many frames, at half the size.
_GIF_EVERY = 6


def check_extra() -> None:
    """Refuse to record without what writes films.

    Raises:
        UserInputError: naming the extra to install.
    """
    if any(importlib.util.find_spec(name) is None for name in ("imageio", "imageio_ffmpeg")):
        raise UserInputError("record=true needs packages that are not installed: pip install 'rcdsac-trl[video]'")


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
    follower = PathFollower(course, pilot.config)
    mask = sensor_mask("narrow")
    radii = np.array([mover.radius for mover in office.map.movers])
    collisions = 0
    for step in range(len(trace.commands)):
        waypoints = follower.update(_pose(trace.estimates[step]))
        assert waypoints is not None  # else the run would have ended
        collisions += int(trace.in_contact[step] and not trace.in_contact[max(step - 1, 0)])
        scene = Scene(
            map=office.map,
            pose=_pose(trace.poses[step]),
            distances_m=trace.distances_m[step],
            sensor_mask=mask,
            waypoints=_in_map(waypoints, trace.estimates[step]),
            movers=np.column_stack([trace.people[step], radii]),
            trail=[(x, y) for x, y in trace.poses[max(0, step - _TRAIL_STEPS) : step + 1, :2].tolist()],
            in_contact=bool(trace.in_contact[step]),
        )
        v = trace.commands[step, 0]
        left = near.draw(scene, f"{v:.2f} m/s{'  (limited)' if trace.limited[step] else ''}")
        right = far.draw(scene, f"{title}   {step * PERIOD_S:.0f} s   collisions: {collisions}")
        yield np.concatenate([left, right], axis=1)


def write_film(pictures: Iterable[Frame], stem: Path) -> None:
    """Write pictures of every control period as ``<stem>.mp4`` and, fewer and smaller, as ``<stem>.gif``.

    Args:
        pictures: uint8 RGB, all of one size, sides divisible by 16.
        stem: the files' path without suffix; its folder must exist.
    """
    # Imported late: only recording needs the extra.
    import imageio.v2 as imageio

    small: list[Image.Image] = []
    fps = SPEED_UP / PERIOD_S
    film: Any = imageio.get_writer(f"{stem}.mp4", fps=fps, codec="libx264", macro_block_size=16)
    with film as writer:
        for number, picture in enumerate(pictures):
            writer.append_data(picture)
            if number % _GIF_EVERY == 0:
                image = Image.fromarray(picture)
                small.append(image.resize((image.width // 2, image.height // 2)).quantize(64))
    if small:
        milliseconds = round(1000.0 * _GIF_EVERY / fps)
        small[0].save(f"{stem}.gif", save_all=True, append_images=small[1:], duration=milliseconds, loop=0)


def _pose(row: NDArray[np.float64]) -> tuple[float, float, float]:
    x, y, yaw = row.tolist()
    return x, y, yaw


def _in_map(points: NDArray[np.float64], pose: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return points of the robot's frame in the map's, [n, 2]."""
    cos, sin = np.cos(pose[2]), np.sin(pose[2])
    return points @ np.array([[cos, sin], [-sin, cos]]) + pose[:2]
