"""The lines below a picture that say what its colours mean."""

import itertools
from collections.abc import Mapping

from PIL import Image, ImageDraw

from rcdsac_trl.colors import LIGHT, mixed
from rcdsac_trl.world.canvas import font
from rcdsac_trl.world.render import GOAL_OPACITY, SEEN_OPACITY

_AREAS = ("wall", "mapped", "unmapped", "seen")
# Rings have no colour of their own: where a mover is expected, and where a contact began.
_RINGS = {"expected": "remembered", "contact": "touching"}
_TRAIL_PIECES = 6
# In letters: a key with the gap behind it, the gap between two of them, and the height of a line.
_KEY, _GAP, _LINE = 1.6, 1.8, 1.7
# How many times finer a legend is drawn than shown.
_FINE = 2


def legend(captions: Mapping[str, str], width_px: int, size_px: float) -> Image.Image:
    """Draw a legend, in as many lines as its width asks for.

    Args:
        captions: what is said of colours, by their names in :class:`rcdsac_trl.colors.Palette`; of rings around places,
            by `expected` and `contact`.
        width_px: of the picture.
        size_px: of its letters.

    Returns:
        RGB, of that width.
    """
    size, width = size_px * _FINE, width_px * _FINE
    text = font(size)
    needed = {name: _KEY * size + text.getlength(caption) for name, caption in captions.items()}
    lines = _balanced(needed, width - 2 * size, _GAP * size)
    image = Image.new("RGB", (width, round(len(lines) * _LINE * size_px) * _FINE), LIGHT.card)
    draw = ImageDraw.Draw(image)
    for number, line in enumerate(lines):
        middle = (number + 0.5) * _LINE * size
        left = (width - sum(needed[name] for name in line) - (len(line) - 1) * _GAP * size) / 2
        for name in line:
            _draw_key(draw, name, (left, middle - size / 2, left + size, middle + size / 2))
            draw.text((left + _KEY * size, middle), captions[name], LIGHT.faint, font=text, anchor="lm")
            left += needed[name] + _GAP * size
    return image.reduce(_FINE)


def _balanced(needed: Mapping[str, float], width: float, gap: float) -> list[list[str]]:
    """Put things into as few lines as a width allows, of about the same length."""
    most = len(_filled(needed, width, gap))
    shares = (share / 20 for share in range(1, 21))
    return next(lines for share in shares if len(lines := _filled(needed, share * width, gap)) <= most)


def _filled(needed: Mapping[str, float], width: float, gap: float) -> list[list[str]]:
    """Put things one after another into lines that are not wider, but for one that is so alone."""
    lines: list[list[str]] = []
    for name in needed:
        if not lines or sum(needed[other] + gap for other in lines[-1]) + needed[name] > width:
            lines.append([])
        lines[-1].append(name)
    return lines


def _draw_key(draw: ImageDraw.ImageDraw, name: str, box: tuple[float, float, float, float]) -> None:
    """Draw a thing as the picture has it."""
    color: str = getattr(LIGHT, _RINGS.get(name, name))
    left, top, right, bottom = box
    side, middle = right - left, (top + bottom) / 2
    thick = round(side / 6)
    if name == "trail":
        edges = [left + side * piece / _TRAIL_PIECES for piece in range(_TRAIL_PIECES + 1)]
        for piece, (start, end) in enumerate(itertools.pairwise(edges), start=1):
            draw.line((start, middle, end, middle), mixed(LIGHT.floor, color, piece / _TRAIL_PIECES), thick)
    elif name == "way":
        radius = side / 4
        draw.line((left, middle, right, middle), color, thick)
        ring = (left + side / 2 - radius, middle - radius, left + side / 2 + radius, middle + radius)
        draw.ellipse(ring, LIGHT.card, color, thick)
    elif name == "hit":  # at the end of what is seen
        draw.rectangle(box, mixed(LIGHT.floor, LIGHT.seen, SEEN_OPACITY))
        draw.line((right - thick / 2, top, right - thick / 2, bottom), color, 2 * thick)
    elif name == "remembered":
        radius = side / 8
        for part, line in ((0.15, 0.35), (0.5, 0.6), (0.85, 0.4)):
            x, y = left + part * side, top + line * side
            draw.ellipse((x - radius, y - radius, x + radius, y + radius), color)
    elif name in _AREAS:
        # What is seen is drawn translucent.
        draw.rectangle(box, mixed(LIGHT.floor, color, SEEN_OPACITY) if name == "seen" else color)
    elif name in _RINGS:
        draw.ellipse(box, None, color, thick)
    elif name == "goal":
        draw.ellipse(box, mixed(LIGHT.floor, color, GOAL_OPACITY), color, thick)
    else:
        draw.ellipse(box, color)
