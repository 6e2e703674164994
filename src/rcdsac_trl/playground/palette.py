"""The page's colours, light and dark; those of what stands and drives are the films' own where it is light."""

from collections.abc import Mapping

from rcdsac_trl.world import render
from rcdsac_trl.world.render import Color

THEMES = ("light", "dark")


def _hex(color: Color) -> str:
    return "#" + "".join(f"{part:02x}" for part in color[:3])


_LIGHT = {
    "page": "#f4f5f7",
    "card": "#ffffff",
    "edge": "#dfe2e8",
    "ink": "#2b303a",
    "faint": "#6d7583",
    "accent": "#1c62be",
    "alarm": "#c8372b",
    "outside": _hex(render.OUTSIDE),
    "floor": _hex(render.FLOOR),
    "wall": _hex(render.WALL),
    "mapped": _hex(render.MAPPED),
    "unmapped": _hex(render.UNMAPPED_EDGE),
    "mover": _hex(render.MOVER),
    "obstacle": "#8a5a2b",
    "seen": _hex(render.SEEN),
    "silent": "#7aa7d9",
    "hit": _hex(render.HIT),
    "remembered": _hex(render.HIT),
    "way": _hex(render.PATH),
    "goal": _hex(render.GOAL),
    "robot": _hex(render.ROBOT),
    "robot_edge": _hex(render.ROBOT_EDGE),
    "touching": _hex(render.TOUCHING),
    "arrow": "#ffffff",
}
_DARK = _LIGHT | {
    "page": "#12151b",
    "card": "#1b1f27",
    "edge": "#313743",
    "ink": "#e3e6ec",
    "faint": "#98a1b0",
    "accent": "#6aa9f7",
    "alarm": "#ff7d6e",
    "outside": "#1b1f27",
    "floor": "#232832",
    "wall": "#a7b0c0",
    "mapped": "#66718a",
    "unmapped": "#d9a24a",
    "mover": "#e07070",
    "obstacle": "#c58a52",
    "seen": "#4f8fe0",
    "silent": "#3f5f8a",
    "hit": "#8cc0ff",
    "remembered": "#8cc0ff",
    "way": "#b58ad6",
    "goal": "#c08cf0",
    "robot": "#3cc48c",
    "robot_edge": "#d6f5e6",
}
PALETTES: Mapping[str, Mapping[str, str]] = {"light": _LIGHT, "dark": _DARK}
"""Colours by what they are for, of each theme."""


def style_sheet() -> str:
    """Return the palettes as CSS variables, ``--wall`` and so on, which follow the page's ``data-theme``."""
    return "\n".join(
        f":root[data-theme={theme}] {{ {' '.join(f'--{name}: {color};' for name, color in PALETTES[theme].items())} }}"
        for theme in THEMES
    )
