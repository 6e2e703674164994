"""A top-down picture of one agent: map, robot, lidar, waypoints, movers and trail.

Everything is drawn at a multiple of the frame's size and averaged down, which is what smooths the edges. What
does not move is drawn once a map.
"""

import itertools
import math
from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np
from PIL import Image, ImageDraw, ImageFont

from rcdsac_trl.errors import UserInputError
from rcdsac_trl.robot.robot_settings import PAPER, RobotSettings
from rcdsac_trl.world.maps.shapes import Map

Color = tuple[int, ...]

OUTSIDE: Color = (222, 225, 230)
FLOOR: Color = (250, 250, 248)
GRID: Color = (238, 239, 238)
WALL: Color = (62, 68, 82)
MAPPED: Color = (132, 144, 164)
MAPPED_EDGE: Color = (98, 109, 130)
UNMAPPED: Color = (240, 196, 128)
UNMAPPED_EDGE: Color = (208, 146, 58)
MOVER: Color = (214, 92, 92)
MOVER_EDGE: Color = (160, 52, 56)
SEEN: Color = (64, 132, 214, 52)
HIT: Color = (28, 98, 190)
REMEMBERED: Color = (28, 98, 190, 150)
TRAIL: Color = (36, 122, 92)
PATH: Color = (150, 96, 190)
GOAL: Color = (126, 58, 176)
ROBOT: Color = (52, 168, 120)
ROBOT_EDGE: Color = (18, 92, 64)
TOUCHING: Color = (226, 74, 60)
TEXT: Color = (40, 44, 52)


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

    Example:
        >>> from rcdsac_trl.world.task.env import NavigationEnv
        >>> env = NavigationEnv(agent_ids=(0,))
        >>> _ = env.reset()
        >>> Renderer(size_px=256).draw(env.agents.scene(0)).shape
        (256, 256, 3)
    """

    def __init__(self, size_px: int = 512, view_m: float | None = None, oversampling: int = 2) -> None:
        if size_px < 16 or oversampling < 1 or (view_m is not None and view_m <= 0):
            raise UserInputError(
                f"size_px={size_px}, view_m={view_m}, oversampling={oversampling} cannot be drawn; give at "
                "least 16 pixels, a positive view and an oversampling of at least 1"
            )
        self._size_px = size_px
        self._view_m = view_m
        self._fine = oversampling
        self._font = font(size_px / 32 * oversampling)
        self._background: tuple[Map, Image.Image] | None = None

    def draw(self, scene: Scene, caption: str = "") -> np.ndarray:
        """Draw one frame.

        Args:
            scene: what to draw.
            caption: a line of text at the lower left.

        Returns:
            uint8 RGB, shape [size_px, size_px, 3].
        """
        canvas = self._canvas(scene.map, scene.pose)
        _draw_lidar(canvas, scene)
        _draw_trail(canvas, scene.trail)
        _draw_path(canvas, scene)
        for x, y, radius in scene.movers:
            canvas.disc(x, y, radius, MOVER, MOVER_EDGE, 0.04)
        for x, y in scene.remembered:
            canvas.disc(x, y, 0.05, REMEMBERED)
        for x, y, radius in scene.expected:
            canvas.disc(x, y, radius, None, REMEMBERED, 0.05)
        _draw_robot(canvas, scene)
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
        for number, (x, y) in enumerate(goals, start=1):
            canvas.disc(x, y, 0.42, (*GOAL, 60), GOAL, 0.06)
            canvas.text(x, y, str(number), self._font)
        _draw_trail(canvas, way)
        x, y = way[0]
        canvas.disc(x, y, 0.2, ROBOT, ROBOT_EDGE, 0.06)
        for x, y in touches:
            canvas.disc(x, y, 0.26, TOUCHING, (255, 255, 255), 0.05)
        return np.asarray(canvas.image.reduce(self._fine))

    def _canvas(self, map_: Map, centre: Sequence[float]) -> "_Canvas":
        margin = 0.02 * map_.size_m
        whole = map_.size_m + 2 * margin
        view = self._view_m or whole
        side = self._size_px * self._fine
        scale = side / view
        if self._background is None or self._background[0] is not map_:
            full = round(whole * scale)
            background = Image.new("RGB", (full, full), OUTSIDE)
            _draw_map(_Canvas(background, scale, -margin, map_.size_m + margin), map_)
            self._background = (map_, background)
        background = self._background[1]
        if self._view_m is None:
            return _Canvas(background.copy(), scale, -margin, map_.size_m + margin)
        # Snap the window to whole pixels of the background, and the frame's origin with it.
        column = round((centre[0] + margin) * scale - side / 2)
        line = round((map_.size_m + margin - centre[1]) * scale - side / 2)
        window = Image.new("RGB", (side, side), OUTSIDE)
        window.paste(background, (-column, -line))
        return _Canvas(window, scale, column / scale - margin, map_.size_m + margin - line / scale)

    def _write(self, image: Image.Image, caption: str) -> None:
        pad = 6 * self._fine
        draw = ImageDraw.Draw(image, "RGBA")
        position = (2 * pad, image.height - 2 * pad)
        left, top, right, bottom = draw.textbbox(position, caption, font=self._font, anchor="ld")
        draw.rounded_rectangle((left - pad, top - pad, right + pad, bottom + pad), pad, (255, 255, 255, 215))
        draw.text(position, caption, TEXT, font=self._font, anchor="ld")


def font(size: float) -> ImageFont.FreeTypeFont:
    """Return the font of all pictures, of a size in pixels."""
    # Imported late: Matplotlib is slow to import, and all that is wanted here is its font, which has the Greek
    # letters that Pillow's own lacks.
    import matplotlib

    return ImageFont.truetype(f"{matplotlib.get_data_path()}/fonts/ttf/DejaVuSans.ttf", size)


class _Canvas:
    """Draws in metres onto an image whose upper left corner is at (left_m, top_m) of the map frame."""

    def __init__(self, image: Image.Image, scale: float, left_m: float, top_m: float) -> None:
        self.image = image
        self._scale = scale
        self._left = left_m
        self._top = top_m
        self._draw = ImageDraw.Draw(image, "RGBA")  # blends colours that have an alpha

    def pixels(self, points: np.ndarray) -> list[tuple[float, float]]:
        columns = (points[:, 0] - self._left) * self._scale
        lines = (self._top - points[:, 1]) * self._scale
        return list(zip(columns.tolist(), lines.tolist(), strict=True))

    def polygon(self, points: np.ndarray, fill: Color, edge: Color | None = None, edge_m: float = 0.0) -> None:
        corners = self.pixels(points)
        self._draw.polygon(corners, fill)
        if edge is not None:
            width = max(1, round(edge_m * self._scale))
            self._draw.line([*corners, corners[0], corners[1]], edge, width, joint="curve")

    def disc(
        self,
        x: float,
        y: float,
        radius: float,
        fill: Color | None,
        edge: Color | None = None,
        edge_m: float = 0.0,
    ) -> None:
        column, line = (x - self._left) * self._scale, (self._top - y) * self._scale
        r = radius * self._scale
        box = (column - r, line - r, column + r, line + r)
        self._draw.ellipse(box, fill, edge, 0 if edge is None else max(1, round(edge_m * self._scale)))

    def text(self, x: float, y: float, text: str, font: ImageFont.FreeTypeFont) -> None:
        self._draw.text(self.pixels(np.array([[x, y]]))[0], text, TEXT, font=font, anchor="mm")

    def line(self, points: np.ndarray, color: Color, width_m: float) -> None:
        if len(points) > 1:
            self._draw.line(self.pixels(points), color, max(1, round(width_m * self._scale)), joint="curve")


def _draw_map(canvas: _Canvas, map_: Map) -> None:
    size = map_.size_m
    canvas.polygon(np.array([[0.0, 0.0], [size, 0.0], [size, size], [0.0, size]]), FLOOR)
    for metre in range(1, math.ceil(size)):
        canvas.line(np.array([[metre, 0.0], [metre, size]]), GRID, 0.02)
        canvas.line(np.array([[0.0, metre], [size, metre]]), GRID, 0.02)
    for cylinder in map_.cylinders:
        colors = (MAPPED, MAPPED_EDGE) if cylinder.mapped else (UNMAPPED, UNMAPPED_EDGE)
        canvas.disc(cylinder.x, cylinder.y, cylinder.radius, *colors, 0.04)
    for box in sorted(map_.boxes, key=lambda box: box.wall):
        if box.wall:
            canvas.polygon(box.corners(), WALL)
        else:
            colors = (MAPPED, MAPPED_EDGE) if box.mapped else (UNMAPPED, UNMAPPED_EDGE)
            canvas.polygon(box.corners(), *colors, 0.04)


def _draw_lidar(canvas: _Canvas, scene: Scene) -> None:
    """Fill what the agent sees, and mark each distance over the width of its sector."""
    x, y, yaw = scene.pose
    reach = np.minimum(scene.distances_m, scene.robot.lidar.max_range_m)
    width = 2 * math.pi / len(reach)
    first = yaw + width * np.arange(len(reach))
    ends = np.stack([first, first + width])  # [2, n]: both edges of each sector
    rim_x, rim_y = x + reach * np.cos(ends), y + reach * np.sin(ends)
    rim = np.stack([rim_x, rim_y], axis=-1).swapaxes(0, 1)  # [n, 2 edges, 2]
    for run in _runs(scene.sensor_mask):
        canvas.polygon(np.concatenate([[(x, y)], rim[run].reshape(-1, 2)]), SEEN)
    for index in np.flatnonzero(scene.sensor_mask & (scene.distances_m < scene.robot.lidar.max_range_m)):
        canvas.line(rim[index], HIT, 0.06)


def _runs(mask: np.ndarray) -> list[np.ndarray]:
    """Split the indices of the true entries into runs of neighbours."""
    indices = np.flatnonzero(mask)
    return np.split(indices, np.flatnonzero(np.diff(indices) > 1) + 1) if len(indices) else []


def _draw_trail(canvas: _Canvas, trail: Sequence[tuple[float, float]]) -> None:
    """Draw the trail, paler the older it is; opaque, as translucent pieces would show their overlaps."""
    points = np.asarray(trail, np.float64).reshape(-1, 2)
    pieces = 12
    edges = np.linspace(0, len(points) - 1, pieces + 1).astype(int)
    for piece, (first, last) in enumerate(itertools.pairwise(edges)):
        share = 0.25 + 0.65 * piece / pieces
        color = tuple(round(share * new + (1 - share) * old) for new, old in zip(TRAIL, FLOOR, strict=True))
        canvas.line(points[first : last + 1], color, 0.07)


def _draw_path(canvas: _Canvas, scene: Scene) -> None:
    points = np.concatenate([[scene.pose[:2]], scene.waypoints])
    for start, end in itertools.pairwise(points):
        dashes = max(1, round(float(np.hypot(*(end - start))) / 0.4))
        for dash in range(dashes):
            piece = np.array([[dash / dashes], [(dash + 0.55) / dashes]])
            canvas.line(start + piece * (end - start), (*PATH, 210), 0.05)
    for x, y in scene.waypoints[:-1]:
        canvas.disc(x, y, 0.11, (255, 255, 255), PATH, 0.05)
    goal_x, goal_y = scene.waypoints[-1]
    canvas.disc(goal_x, goal_y, 0.34, (*GOAL, 50), GOAL, 0.06)
    canvas.disc(goal_x, goal_y, 0.15, GOAL)


def _draw_robot(canvas: _Canvas, scene: Scene) -> None:
    x, y, yaw = scene.pose
    ahead, left = np.array([math.cos(yaw), math.sin(yaw)]), np.array([-math.sin(yaw), math.cos(yaw)])
    centre, corners = np.array([x, y]), scene.robot.outline
    outline = centre + corners[:, :1] * ahead + corners[:, 1:] * left
    # Of the paper's robot, whose size the arrow was drawn for.
    size = scene.robot.inradius_m / PAPER.inradius_m
    if scene.in_contact:
        canvas.disc(x, y, scene.robot.circumradius_m + 0.2, (*TOUCHING, 90))
    canvas.polygon(outline, TOUCHING if scene.in_contact else ROBOT, ROBOT_EDGE, 0.05 * size)
    arrow = [0.17 * ahead, -0.10 * ahead + 0.11 * left, -0.05 * ahead, -0.10 * ahead - 0.11 * left]
    canvas.polygon(centre + size * np.array(arrow), (255, 255, 255))
