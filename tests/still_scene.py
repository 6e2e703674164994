"""A scene with one of everything, for the tests of pictures and films."""

import dataclasses

import numpy as np

from rcdsac_trl.robot.range_sensor import sensor_mask
from rcdsac_trl.world.maps.shapes import Box, Cylinder, Map
from rcdsac_trl.world.render import Scene
from rcdsac_trl.world.sim.lidar import sector_distances

SIZE_M = 20.0
MAP = Map(
    layout="clutter",
    size_m=SIZE_M,
    boxes=(
        Box(10.0, 15.0, 4.0, 0.3, 0.0, mapped=True, wall=True),
        Box(5.0, 5.0, 0.6, 0.6, 0.5, mapped=True),
        Box(16.0, 5.0, 0.6, 0.6, 0.0, mapped=False),
    ),
    cylinders=(Cylinder(17.0, 12.0, 0.5, mapped=False),),
    movers=(),
)


def scene(**changes: object) -> Scene:
    pose = (10.0, 8.0, 0.0)
    standing = Scene(
        map=MAP,
        pose=pose,
        distances_m=sector_distances(*pose, MAP.segments(), MAP.circles()),
        sensor_mask=sensor_mask("narrow"),
        waypoints=np.array([[10.0, 4.0], [3.0, 2.0]]),
        movers=np.array([[2.0, 17.0, 0.5]]),
        trail=[(10.0 - 0.1 * k, 8.0) for k in range(30, -1, -1)],
        in_contact=False,
    )
    return dataclasses.replace(standing, **changes)
