"""What the colours of figures and pages become on dark paper."""

import numpy as np
from numpy.typing import NDArray

from rcdsac_trl.colors import DARK, LIGHT, rgb

# Of the palette, those that stand in figures and pages. What a figure draws in white is its paper. Where two are one
# colour by day, the later counts: curves in `touching` stay farther from the others than in `alarm`.
_NAMED = (
    *("card", "ink", "faint", "grid", "edge", "alarm", "good", "unsure"),
    *("wall", "inner_wall", "mapped", "unmapped", "glass", "mover", "robot", "way", "touching"),
)
_NIGHT = {getattr(LIGHT, name): getattr(DARK, name) for name in _NAMED}
# All others are told from the dark by a lightness in OKLab between these two, the lighter the darker they were.
_DARKEST, _LIGHTEST = 0.93, 0.60
# Ottosson (2020): from linear RGB, and from there to OKLab.
TO_CONES = np.array(
    [
        [0.4122214708, 0.5363325363, 0.0514459929],
        [0.2119034982, 0.6806995451, 0.1073969566],
        [0.0883024619, 0.2817188376, 0.6299787005],
    ]
)
TO_OKLAB = np.array(
    [
        [0.2104542553, 0.7936177850, -0.0040720468],
        [1.9779984951, -2.4285922050, 0.4505937099],
        [0.0259040371, 0.7827717662, -0.8086757660],
    ]
)


def linear(color: str) -> NDArray[np.float64]:
    """Return linear RGB in [0, 1] of ``#rrggbb``, [3]."""
    stored = np.array(rgb(color)) / 255.0
    return np.where(stored <= 0.04045, stored / 12.92, ((stored + 0.055) / 1.055) ** 2.4)


def at_night(color: str) -> str:
    """Return what a colour becomes on dark paper.

    The palette's become those of its dark theme. Of all others the lightness is turned round in OKLab (Ottosson, 2020):
    they keep their hue, and colours in an order stay in one.

    Args:
        color: ``#rrggbb``.

    Example:
        >>> at_night(LIGHT.ink) == DARK.ink, at_night("#000000")
        (True, '#e8e8e8')
    """
    if color in _NIGHT:
        return str(_NIGHT[color])
    lab = TO_OKLAB @ np.cbrt(TO_CONES @ linear(color))
    lab[0] = _DARKEST + (_LIGHTEST - _DARKEST) * lab[0]
    turned = np.linalg.solve(TO_CONES, np.linalg.solve(TO_OKLAB, lab) ** 3).clip(0.0, 1.0)
    shown = np.where(turned <= 0.0031308, 12.92 * turned, 1.055 * turned ** (1 / 2.4) - 0.055)
    return "#" + bytes((255.0 * shown).round().astype(np.uint8).tolist()).hex()
