"""The page's colours, light and dark: those of all pictures."""

from collections.abc import Mapping
from dataclasses import asdict

from rcdsac_trl.colors import DARK, LIGHT, css_variables, shades

THEMES = ("light", "dark")
_OF_THEMES = dict(zip(THEMES, (LIGHT, DARK), strict=True))
PALETTES: Mapping[str, Mapping[str, str]] = {theme: asdict(palette) for theme, palette in _OF_THEMES.items()}
"""Colours by what they are for, of each theme."""
_SPEEDS = 64


def style_sheet() -> str:
    """Return the palettes as CSS variables, ``--wall`` and so on, which follow the page's ``data-theme``."""
    return "\n".join(
        f":root[data-theme={theme}] {{ {css_variables(palette)} }}" for theme, palette in _OF_THEMES.items()
    )


def trail_shades(colors: Mapping[str, str]) -> list[str]:
    """Return the colours of a trail, from slow to fast."""
    return shades((colors["trail_slow"], colors["trail"]), _SPEEDS)
