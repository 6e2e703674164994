"""A top-down picture of one agent: map, robot, lidar, waypoints, movers and trail.

Everything is drawn at a multiple of the frame's size and averaged down, which is what smooths the edges. What
does not move is drawn once a map.
"""

import itertools
import math
from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np
from PIL import Image, ImageDraw

from rcdsac_trl.colors import LIGHT, faded, mixed
from rcdsac_trl.errors import UserInputError
from rcdsac_trl.robot.robot_settings import PAPER, RobotSettings
from rcdsac_trl.world.canvas import Canvas, font
from rcdsac_trl.world.maps.shapes import Map

SEEN_OPACITY = 0.2
"""Of what the sensor sees: the floor and what stands there show through."""
GOAL_OPACITY = 0.24
"""Of the inside of a goal's ring."""
# The whole of a map is kept up to this side; of a larger one each frame draws what it shows.
_LARGEST_BACKGROUND_PX = 8192
# Around a map that is shown as a whole, as a share of its side.
_MARGIN = 0.02


@dataclass(frozen=True)
class Scene:
    """What there is to draw, in the map frame, m and rad.

    Attributes:
        map: what stands.
        pose: the robot's x, y and yaw.
        distances_m: nearest obstacle in each sector, float [180], inf for none.
        sensor_mask: the sectors that the agent sees, bool [180].
        waypoints: waypoints ahead, [k, 2]; the last one is the goal.
        movers: x, y and radius of each mover, [m, 3].
        trail: positions since the episode began, oldest first.
        in_contact: whether the robot is in contact.
        remembered: points that the agent is told of because it saw them, [n, 2].
        expected: where it expects what moves, x, y and radius, [k, 3].
        robot: which one it is.
    """

    map: Map
    pose: tuple[float, float, float]
    distances_m: np.ndarray
    sensor_mask: np.ndarray
    waypoints: np.ndarray
    movers: np.ndarray
    trail: Sequence[tuple[float, float]]
    in_contact: bool
    remembered: np.ndarray = field(default_factory=lambda: np.empty((0, 2)))
    expected: np.ndarray = field(default_factory=lambda: np.empty((0, 3)))
    robot: RobotSettings = PAPER


class Renderer:
    """Draws scenes as square RGB frames.

    Args:
        size_px: width and height of a frame.
        view_m: side of the square around the robot that is shown; None shows the whole map.
        oversampling: how many times finer than the frame everything is drawn.
        scale_bar: whether one lies on the map, at the lower right; else it belongs beside the picture.

    Example:
        >>> from rcdsac_trl.world.task.env import NavigationEnv
        >>> env = NavigationEnv(agent_ids=(0,))
        >>> _ = env.reset()
        >>> Renderer(size_px=256).draw(env.agents.scene(0)).shape
        (256, 256, 3)
    """

    def __init__(
        self, size_px: int = 512, view_m: float | None = None, oversampling: int = 2, scale_bar: bool = True
    ) -> None:
        if size_px < 16 or oversampling < 1 or (view_m is not None and view_m <= 0):
            raise UserInputError(
                f"size_px={size_px}, view_m={view_m}, oversampling={oversampling} cannot be drawn; give at "
                "least 16 pixels, a positive view and an oversampling of at least 1"
            )
        self._size_px = size_px
        self._view_m = view_m
        self._fine = oversampling
        self._scale_bar = scale_bar
        self._font = font(size_px / 32 * oversampling)
        self._background: tuple[Map, Image.Image] | None = None

    def draw(self, scene: Scene, caption: str = "") -> np.ndarray:
        """Draw one frame.

        Args:
            scene: what to draw.
            caption: a line of text at the upper left.

        Returns:
            uint8 RGB, shape [size_px, size_px, 3].
        """
        canvas = self._canvas(scene.map, scene.pose)
        _draw_lidar(canvas, scene)
        _draw_trail(canvas, scene.trail, 0.07)
        _draw_path(canvas, scene)
        for x, y, radius in scene.movers:
            canvas.disc(x, y, radius, LIGHT.mover, LIGHT.mover_edge, 0.04)
        for x, y in scene.remembered:
            canvas.disc(x, y, 0.05, LIGHT.remembered)
        for x, y, radius in scene.expected:
            canvas.disc(x, y, radius, None, LIGHT.remembered, 0.05)
        _draw_robot(canvas, scene)
        if self._scale_bar:
            canvas.scale_bar()
        if caption:
            self._write(canvas.image, caption)
        return np.asarray(canvas.image.reduce(self._fine))

    def draw_way(
        self,
        map_: Map,
        way: Sequence[tuple[float, float]],
        goals: Sequence[tuple[float, float]],
        touches: Sequence[tuple[float, float]],
    ) -> np.ndarray:
        """Draw where a robot has driven on a map, which a view of None shows as a whole.

        Args:
            map_: what stands.
            way: its positions, oldest first, m.
            goals: those it reached, numbered in this order.
            touches: where it was when it began to touch something.

        Returns:
            uint8 RGB, shape [size_px, size_px, 3].
        """
        canvas = self._canvas(map_, way[-1])
        _draw_trail(canvas, way, 0.12)
        for number, (x, y) in enumerate(goals, start=1):
            canvas.disc(x, y, 0.42, mixed(LIGHT.floor, LIGHT.goal, GOAL_OPACITY), LIGHT.goal, 0.06)
            canvas.text(x, y, str(number), self._font)
        x, y = way[0]
        canvas.disc(x, y, 0.2, LIGHT.robot, LIGHT.robot_edge, 0.06)
        for x, y in touches:
            # A ring, so that a goal's number inside stays legible.
            canvas.disc(x, y, 0.56, None, LIGHT.touching, 0.16)
        if self._scale_bar:
            canvas.scale_bar()
        return np.asarray(canvas.image.reduce(self._fine))

    def shown_m(self, map_: Map) -> float:
        """Return the side of what a frame shows of a map."""
        return self._view_m or (1.0 + 2.0 * _MARGIN) * map_.size_m

    def _canvas(self, map_: Map, centre: Sequence[float]) -> Canvas:
        margin = _MARGIN * map_.size_m
        whole = map_.size_m + 2 * margin
        view = self.shown_m(map_)
        side = self._size_px * self._fine
        scale = side / view
        full = round(whole * scale)
        if self._view_m is None:
            return Canvas(self._drawn(map_, full, scale, margin).copy(), scale, -margin, map_.size_m + margin)
        # Snap the window to whole pixels of the background, and the frame's origin with it.
        column = round((centre[0] + margin) * scale - side / 2)
        line = round((map_.size_m + margin - centre[1]) * scale - side / 2)
        window = Image.new("RGB", (side, side), LIGHT.outside)
        canvas = Canvas(window, scale, column / scale - margin, map_.size_m + margin - line / scale)
        if full > _LARGEST_BACKGROUND_PX:
            _draw_map(canvas, map_)
        else:
            window.paste(self._drawn(map_, full, scale, margin), (-column, -line))
        return canvas

    def _drawn(self, map_: Map, full: int, scale: float, margin: float) -> Image.Image:
        """Return the picture of a whole map, which is drawn once."""
        if self._background is None or self._background[0] is not map_:
            background = Image.new("RGB", (full, full), LIGHT.outside)
            _draw_map(Canvas(background, scale, -margin, map_.size_m + margin), map_)
            self._background = (map_, background)
        return self._background[1]

    def _write(self, image: Image.Image, caption: str) -> None:
        pad = 6 * self._fine
        draw = ImageDraw.Draw(image, "RGBA")
        position = (2 * pad, 2 * pad)
        left, top, right, bottom = draw.textbbox(position, caption, font=self._font, anchor="la")
        draw.rounded_rectangle((left - pad, top - pad, right + pad, bottom + pad), pad, faded(LIGHT.card, 0.84))
        draw.text(position, caption, LIGHT.ink, font=self._font, anchor="la")


def _draw_map(canvas: Canvas, map_: Map) -> None:
    size = map_.size_m
    canvas.polygon(np.array([[0.0, 0.0], [size, 0.0], [size, size], [0.0, size]]), LIGHT.floor)
    for metre in range(1, math.ceil(size)):
        canvas.line(np.array([[metre, 0.0], [metre, size]]), LIGHT.grid, 0.02)
        canvas.line(np.array([[0.0, metre], [size, metre]]), LIGHT.grid, 0.02)
    for cylinder in map_.cylinders:
        colors = (LIGHT.mapped, LIGHT.mapped_edge) if cylinder.mapped else (LIGHT.unmapped, LIGHT.unmapped_edge)
        canvas.disc(cylinder.x, cylinder.y, cylinder.radius, *colors, 0.04)
    for box in sorted(map_.boxes, key=lambda box: box.wall):
        if box.wall:
            canvas.polygon(box.corners(), LIGHT.wall)
        else:
            colors = (LIGHT.mapped, LIGHT.mapped_edge) if box.mapped else (LIGHT.unmapped, LIGHT.unmapped_edge)
            canvas.polygon(box.corners(), *colors, 0.04)


def _draw_lidar(canvas: Canvas, scene: Scene) -> None:
    """Fill what the agent sees, and mark each distance over the width of its sector."""
    x, y, yaw = scene.pose
    reach = np.minimum(scene.distances_m, scene.robot.lidar.max_range_m)
    width = 2 * math.pi / len(reach)
    first = yaw + width * np.arange(len(reach))
    ends = np.stack([first, first + width])  # [2, n]: both edges of each sector
    rim_x, rim_y = x + reach * np.cos(ends), y + reach * np.sin(ends)
    rim = np.stack([rim_x, rim_y], axis=-1).swapaxes(0, 1)  # [n, 2 edges, 2]
    for run in _runs(scene.sensor_mask):
        canvas.polygon(np.concatenate([[(x, y)], rim[run].reshape(-1, 2)]), faded(LIGHT.seen, SEEN_OPACITY))
    for index in np.flatnonzero(scene.sensor_mask & (scene.distances_m < scene.robot.lidar.max_range_m)):
        canvas.line(rim[index], LIGHT.hit, 0.06)


def _runs(mask: np.ndarray) -> list[np.ndarray]:
    """Split the indices of the true entries of a ring into runs of neighbours."""
    indices = np.flatnonzero(mask)
    if not len(indices):
        return []
    runs = np.split(indices, np.flatnonzero(np.diff(indices) > 1) + 1)
    if len(runs) > 1 and mask[0] and mask[-1]:
        runs = [np.concatenate([runs[-1], runs[0]]), *runs[1:-1]]
    return runs


def _draw_trail(canvas: Canvas, trail: Sequence[tuple[float, float]], width_m: float) -> None:
    """Draw the trail, paler the older it is; opaque, as translucent pieces would show their overlaps."""
    points = np.asarray(trail, np.float64).reshape(-1, 2)
    pieces = 12
    edges = np.linspace(0, len(points) - 1, pieces + 1).astype(int)
    for piece, (first, last) in enumerate(itertools.pairwise(edges)):
        share = 0.25 + 0.65 * piece / pieces
        canvas.line(points[first : last + 1], mixed(LIGHT.floor, LIGHT.trail, share), width_m)


def _draw_path(canvas: Canvas, scene: Scene) -> None:
    points = np.concatenate([[scene.pose[:2]], scene.waypoints])
    for start, end in itertools.pairwise(points):
        dashes = max(1, round(float(np.hypot(*(end - start))) / 0.4))
        for dash in range(dashes):
            piece = np.array([[dash / dashes], [(dash + 0.55) / dashes]])
            canvas.line(start + piece * (end - start), LIGHT.way, 0.05)
    for x, y in scene.waypoints[:-1]:
        canvas.disc(x, y, 0.11, LIGHT.card, LIGHT.way, 0.05)
    goal_x, goal_y = scene.waypoints[-1]
    canvas.disc(goal_x, goal_y, 0.34, mixed(LIGHT.floor, LIGHT.goal, GOAL_OPACITY), LIGHT.goal, 0.06)
    canvas.disc(goal_x, goal_y, 0.15, LIGHT.goal)


def _draw_robot(canvas: Canvas, scene: Scene) -> None:
    x, y, yaw = scene.pose
    ahead, left = np.array([math.cos(yaw), math.sin(yaw)]), np.array([-math.sin(yaw), math.cos(yaw)])
    centre, corners = np.array([x, y]), scene.robot.outline
    outline = centre + corners[:, :1] * ahead + corners[:, 1:] * left
    # Of the paper's robot, whose size the arrow was drawn for.
    size = scene.robot.inradius_m / PAPER.inradius_m
    if scene.in_contact:
        canvas.disc(x, y, scene.robot.circumradius_m + 0.2, faded(LIGHT.touching, 0.35))
    canvas.polygon(outline, LIGHT.touching if scene.in_contact else LIGHT.robot, LIGHT.robot_edge, 0.05 * size)
    arrow = [0.17 * ahead, -0.10 * ahead + 0.11 * left, -0.05 * ahead, -0.10 * ahead - 0.11 * left]
    canvas.polygon(centre + size * np.array(arrow), LIGHT.arrow)
