"""The frames of a film: episodes side by side, each with its map, its context, and what its critics expect."""

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np
from PIL import Image, ImageDraw

from rcdsac_trl.colors import CAPTIONS, LIGHT, faded
from rcdsac_trl.deploy.policy.distortion import fractions_of
from rcdsac_trl.evaluation.film.recording import Moment
from rcdsac_trl.evaluation.film.video import Frame
from rcdsac_trl.world.canvas import font
from rcdsac_trl.world.legend import legend
from rcdsac_trl.world.render import SEEN_OPACITY, Renderer

# A film is at most four episodes wide, of which the fewer the larger.
COLUMNS = 4
_SIDES_PX = {1: 720, 2: 640, 3: 512}
_SMALLEST_SIDE_PX = 480
# How many times finer curves are drawn than shown.
_FINE = 2
# The worst of the return, marked in the panel of quantiles.
_TAIL = 0.1
_SHOWN = ("robot", "seen", "trail", "way", "wall", "mapped", "unmapped", "mover", "touching")
_LEGEND = {name: CAPTIONS[name] for name in _SHOWN}


@dataclass(frozen=True)
class Track:
    """One episode of a film.

    Attributes:
        heading: what drives.
        moments: one a frame.
    """

    heading: str
    moments: Sequence[Moment]


def film(tracks: Sequence[Track], period_s: float) -> Iterator[Frame]:
    """Yield the frames, uint8 RGB ``[height, width, 3]``, one a step.

    Above each map stands what drives; below it speed, collisions and goals so far; and, where the critics know them,
    the quantiles of the return over their fractions, with the worst tenth in red. All share one scale.

    Args:
        tracks: episodes of equal length.
        period_s: of a step.
    """
    columns = min(len(tracks), COLUMNS)
    lines = math.ceil(len(tracks) / columns)
    side = _SIDES_PX.get(columns, _SMALLEST_SIDE_PX)
    panel, renderer = _Panel(side, _limits(tracks)), Renderer(side)
    meanings = legend(_LEGEND, columns * side, 0.026 * side)
    sheet = Image.new("RGB", (columns * side, lines * panel.height + meanings.height), LIGHT.card)
    sheet.paste(meanings, (0, lines * panel.height))
    turned = [len({moment.beta for moment in track.moments}) > 1 for track in tracks]
    for step, moments in enumerate(zip(*(track.moments for track in tracks), strict=True)):
        for number, (track, moment) in enumerate(zip(tracks, moments, strict=True)):
            beta = f"β {moment.beta:+.2f}   " if turned[number] else ""
            drawn = panel.draw(track.heading, f"{beta}{step * period_s:.0f} s", moment, renderer)
            sheet.paste(drawn, (number % columns * side, number // columns * panel.height))
        yield np.array(sheet)


def _limits(tracks: Sequence[Track]) -> tuple[float, float] | None:
    """Return the scale of all returns; None where none are known."""
    known = [moment.quantiles for track in tracks for moment in track.moments if moment.quantiles is not None]
    if not known:
        return None
    low, high = float(np.min(known)), float(np.max(known))
    margin = 0.05 * max(high - low, 1e-3)
    return low - margin, high + margin


def counted(number: int, what: str) -> str:
    """Return a number with the name of what it counts, as in ``"2 goals"``."""
    return f"{number} {what}{'' if number == 1 else 's'}"


class _Panel:
    """Draws one episode at one step.

    Args:
        side: width, px.
        limits: of the returns; None leaves the quantiles out.
    """

    def __init__(self, side: int, limits: tuple[float, float] | None) -> None:
        self._side = side
        self._limits = limits
        self._head, self._foot = round(0.09 * side), round(0.075 * side)
        self._curve = 0 if limits is None else round(0.26 * side)
        self._pad = round(0.022 * side)
        self._large, self._normal, self._small = font(0.042 * side), font(0.033 * side), font(0.025 * side * _FINE)
        self.height = self._head + side + self._foot + self._curve

    def draw(self, heading: str, right: str, moment: Moment, renderer: Renderer) -> Image.Image:
        """Return the panel, [height, side], with two texts at its upper edge."""
        image = Image.new("RGB", (self._side, self.height), LIGHT.card)
        image.paste(Image.fromarray(renderer.draw(moment.scene)), (0, self._head))
        draw = ImageDraw.Draw(image)
        middle = self._head // 2
        draw.text((self._pad, middle), heading, LIGHT.ink, font=self._large, anchor="lm")
        draw.text((self._side - self._pad, middle), right, LIGHT.faint, font=self._normal, anchor="rm")
        middle = self._head + self._side + self._foot // 2
        speed = f"{moment.speed_m_per_s + 0.0:.2f} m/s"
        draw.text((self._pad, middle), speed, LIGHT.ink, font=self._normal, anchor="lm")
        hit = LIGHT.alarm if moment.scene.in_contact else LIGHT.ink
        draw.text(
            (0.42 * self._side, middle), counted(moment.collisions, "collision"), hit, font=self._normal, anchor="lm"
        )
        draw.text(
            (self._side - self._pad, middle), counted(moment.goals, "goal"), LIGHT.ink, font=self._normal, anchor="rm"
        )
        if self._limits is not None and moment.quantiles is not None:
            curve = self._quantiles(moment.quantiles, self._limits)
            image.paste(curve, (0, self._head + self._side + self._foot))
        return image

    def _quantiles(self, quantiles: np.ndarray, limits: tuple[float, float]) -> Image.Image:
        """Draw the return's quantiles over their fractions."""
        width, height = self._side * _FINE, self._curve * _FINE
        left, right = round(0.14 * width), width - self._pad * _FINE
        top, bottom = round(0.06 * height), round(0.80 * height)
        image = Image.new("RGB", (width, height), LIGHT.card)
        draw = ImageDraw.Draw(image, "RGBA")
        low, high = limits

        def line_of(value: float) -> float:
            return bottom - (value - low) / (high - low) * (bottom - top)

        fractions = fractions_of(len(quantiles)).tolist()
        points = [(left + x * (right - left), line_of(y)) for x, y in zip(fractions, quantiles.tolist(), strict=True)]
        tail = left + _TAIL * (right - left)
        draw.rectangle((left, top, tail, bottom), faded(LIGHT.alarm, 0.14))
        draw.line((left, bottom, right, bottom), LIGHT.grid, 2 * _FINE)
        draw.polygon([(points[0][0], bottom), *points, (points[-1][0], bottom)], faded(LIGHT.accent, SEEN_OPACITY))
        draw.line(points, LIGHT.accent, 2 * _FINE, joint="curve")
        if low < 0 < high:
            draw.line((left, line_of(0), right, line_of(0)), LIGHT.faint, _FINE)
        for value in (quantiles[0], quantiles[-1]):
            draw.line((left - 4 * _FINE, line_of(value), left, line_of(value)), LIGHT.accent, _FINE)
        lowest, highest = line_of(quantiles[0]), line_of(quantiles[-1])
        apart = max(0.0, self._small.size - (lowest - highest)) / 2  # so that neither covers the other
        for value, line in ((quantiles[0], lowest + apart), (quantiles[-1], highest - apart)):
            draw.text((left - 6 * _FINE, line), f"{value:.1f}", LIGHT.ink, font=self._small, anchor="rm")
        caption = "return from here on, higher is better: worst (red) to best"
        draw.text(((left + right) / 2, (bottom + height) / 2), caption, LIGHT.faint, font=self._small, anchor="mm")
        return image.reduce(_FINE)
