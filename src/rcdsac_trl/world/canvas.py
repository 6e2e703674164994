"""Drawing in metres onto a picture, and the font and the scale bar of all pictures."""

import math

import numpy as np
from PIL import Image, ImageDraw, ImageFont

from rcdsac_trl.colors import LIGHT

# Widest scale bar, as a share of what is shown.
_WIDEST_BAR = 0.3
_BAR_FONT_SHARE = 26


def scale_bar_m(view_m: float) -> float:
    """Return how long a scale bar is: the largest of .., 1, 2, 5, 10, .. m within three tenths of what is shown.

    Example:
        >>> scale_bar_m(8.0), scale_bar_m(20.8), scale_bar_m(2.0)
        (2.0, 5.0, 0.5)
    """
    power = 10.0 ** math.floor(math.log10(_WIDEST_BAR * view_m))
    return power * max(digit for digit in (1, 2, 5) if digit * power <= _WIDEST_BAR * view_m)


def font(size: float) -> ImageFont.FreeTypeFont:
    """Return the font of all pictures, of a size in pixels."""
    # Imported late: Matplotlib is slow to import, and all that is wanted here is its font, which has the Greek
    # letters that Pillow's own lacks.
    import matplotlib

    return ImageFont.truetype(f"{matplotlib.get_data_path()}/fonts/ttf/DejaVuSans.ttf", size)


def draw_scale_bar(
    draw: ImageDraw.ImageDraw, corner: tuple[float, float], length_m: float, scale: float, size: float, behind: str
) -> None:
    """Draw a scale bar with its length above it, and a margin around both.

    Args:
        draw: of the picture.
        corner: its lower right, px.
        length_m: how long it is.
        scale: pixels a metre.
        size: of its letters, px.
        behind: colour of the margin.
    """
    right, line = corner
    thick = max(1, round(size / 5))
    left, halo = right - length_m * scale, thick
    draw.rectangle((left - halo, line - thick - halo, right + halo, line + halo), behind)
    draw.rectangle((left, line - thick, right, line), LIGHT.ink)
    draw.text(
        ((left + right) / 2, line - 2 * thick),
        f"{length_m:g} m",
        LIGHT.ink,
        font=font(size),
        anchor="md",
        stroke_width=2 * halo,
        stroke_fill=behind,
    )


class Canvas:
    """Draws in metres of the map frame onto an image.

    Args:
        image: RGB.
        scale: pixels a metre.
        left_m: x of its upper left corner.
        top_m: y of that corner.
    """

    def __init__(self, image: Image.Image, scale: float, left_m: float, top_m: float) -> None:
        self.image = image
        self._scale = scale
        self._left = left_m
        self._top = top_m
        self._draw = ImageDraw.Draw(image, "RGBA")  # blends colours that have an alpha

    def pixels(self, points: np.ndarray) -> list[tuple[float, float]]:
        """Return where points are in the image, column and line."""
        columns = (points[:, 0] - self._left) * self._scale
        lines = (self._top - points[:, 1]) * self._scale
        return list(zip(columns.tolist(), lines.tolist(), strict=True))

    def polygon(self, points: np.ndarray, fill: str, edge: str | None = None, edge_m: float = 0.0) -> None:
        """Draw an area with a line around it."""
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
        fill: str | None,
        edge: str | None = None,
        edge_m: float = 0.0,
    ) -> None:
        """Draw a disc; without a fill it is a ring."""
        column, line = (x - self._left) * self._scale, (self._top - y) * self._scale
        r = radius * self._scale
        box = (column - r, line - r, column + r, line + r)
        self._draw.ellipse(box, fill, edge, 0 if edge is None else max(1, round(edge_m * self._scale)))

    def text(self, x: float, y: float, text: str, font: ImageFont.FreeTypeFont) -> None:
        """Write a text around a point."""
        self._draw.text(self.pixels(np.array([[x, y]]))[0], text, LIGHT.ink, font=font, anchor="mm")

    def line(self, points: np.ndarray, color: str, width_m: float) -> None:
        """Draw a line through points."""
        if len(points) > 1:
            self._draw.line(self.pixels(points), color, max(1, round(width_m * self._scale)), joint="curve")

    def scale_bar(self) -> None:
        """Draw a scale bar at the lower right, with a margin of floor around it, as it may lie on anything."""
        length_m, pad = scale_bar_m(self.image.width / self._scale), self.image.width / _BAR_FONT_SHARE
        corner = (self.image.width - pad, self.image.height - pad)
        draw_scale_bar(self._draw, corner, length_m, self._scale, pad, LIGHT.floor)
