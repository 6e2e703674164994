"""The colours of all pictures, by what they mean: maps, films, the page of `play`, figures, notebooks.

Blue is the robot's: itself, its trail, what it sees and remembers. Green is where it shall go, red what it touches,
purple what walks, amber what no plan knows, grey what the plan knows, and what is darkest (in the dark: light grey) is
wall.

They are chosen for readers who cannot tell red from green, too. What stands or drives on a map contrasts with its floor
by 3:1 or more, texts with what is behind them by 4.5:1 or more (WCAG 2.2). Under deuteranopia, simulated at full
severity (Machado, Oliveira and Fernandes 2009), any two such things stay 0.10 or more apart in OKLab, under protanopia
0.06, under tritanopia 0.05; verdicts, which are words, too, stay 0.045 apart. About 0.02 is what an eye just sees.
`tests/test_colors.py` computes all of it.

Example:
    >>> LIGHT.robot, rgb(LIGHT.robot)
    ('#1567c6', (21, 103, 198))
    >>> mixed(LIGHT.card, LIGHT.ink, 0.5)
    '#95989c'
    >>> len(set(beta_shades(4)))
    4
"""

from collections.abc import Mapping
from dataclasses import asdict, dataclass


@dataclass(frozen=True)
class Palette:
    """Colours of one theme, each as ``#rrggbb``.

    Attributes:
        page: behind everything.
        card: behind figures and texts.
        edge: of cards, and lines between them.
        grid: lines that help to read, on floors and in figures.
        ink: texts.
        faint: texts and lines that stand back.
        accent: what can be clicked, and curves of what is expected.
        alarm: texts that warn, and the worst part of what is expected.
        good: texts of what holds.
        unsure: texts of what cannot be told.
        outside: around a map.
        floor: of a map.
        wall: mapped, as all walls are.
        inner_wall: where figures tell it from walls around a map.
        mapped: clutter that the planner knows.
        mapped_edge: its outline.
        unmapped: clutter that only the sensor shows.
        unmapped_edge: its outline.
        glass: what cameras do not see.
        mover: what walks.
        mover_edge: its outline.
        obstacle: what a visitor of the page put.
        robot: itself.
        robot_edge: its outline.
        arrow: on the robot, where its front is.
        seen: what the sensor sees up to the nearest thing; drawn translucent.
        silent: where the sensor looks and nothing is within reach; drawn translucent.
        hit: the nearest thing that the sensor sees in a direction.
        remembered: what an agent with a memory is told that it saw before.
        trail_slow: where the robot was, and slow.
        trail: where the robot was.
        way: waypoints, and the way ahead over them.
        goal: where it shall go.
        touching: a robot in contact, and places where contacts began.
    """

    page: str
    card: str
    edge: str
    grid: str
    ink: str
    faint: str
    accent: str
    alarm: str
    good: str
    unsure: str
    outside: str
    floor: str
    wall: str
    inner_wall: str
    mapped: str
    mapped_edge: str
    unmapped: str
    unmapped_edge: str
    glass: str
    mover: str
    mover_edge: str
    obstacle: str
    robot: str
    robot_edge: str
    arrow: str
    seen: str
    silent: str
    hit: str
    remembered: str
    trail_slow: str
    trail: str
    way: str
    goal: str
    touching: str


LIGHT = Palette(
    page="#f4f5f7",
    card="#ffffff",
    edge="#dfe2e8",
    grid="#e9ebef",
    ink="#2b303a",
    faint="#666e7c",
    accent="#1567c6",
    alarm="#c81e1e",
    good="#00755a",
    unsure="#5e3a10",
    outside="#dee1e6",
    floor="#fafaf8",
    wall="#373d4a",
    inner_wall="#5b6272",
    mapped="#868fa2",
    mapped_edge="#5d677c",
    unmapped="#ce7f06",
    unmapped_edge="#8f5600",
    glass="#7fc4d8",
    mover="#5b2a91",
    mover_edge="#3a1663",
    obstacle="#5e3a10",
    robot="#1567c6",
    robot_edge="#0a3566",
    arrow="#ffffff",
    seen="#3b86dc",
    silent="#7aa7d9",
    hit="#1567c6",
    remembered="#2f93ea",
    trail_slow="#a9cdf3",
    trail="#0d4a94",
    way="#00755a",
    goal="#00755a",
    touching="#c81e1e",
)
"""On white: pictures, films, figures, and the page by day."""

DARK = Palette(
    page="#12151b",
    card="#1b1f27",
    edge="#313743",
    grid="#2a303b",
    ink="#e3e6ec",
    faint="#98a1b0",
    accent="#6aa9f7",
    alarm="#ff7d6e",
    good="#3fdca2",
    unsure="#ffd27f",
    outside="#12151b",
    floor="#1e232b",
    wall="#959eaf",
    inner_wall="#7e889b",
    mapped="#626c83",
    mapped_edge="#838da4",
    unmapped="#f0b548",
    unmapped_edge="#ffd27f",
    glass="#7fc4d8",
    mover="#f3c6f5",
    mover_edge="#ffffff",
    obstacle="#96622c",
    robot="#3f8def",
    robot_edge="#d3e6ff",
    arrow="#ffffff",
    seen="#3f8def",
    silent="#3f5f8a",
    hit="#6aa9f7",
    remembered="#7abaff",
    trail_slow="#2f5687",
    trail="#a9d2ff",
    way="#3fdca2",
    goal="#3fdca2",
    touching="#ff5442",
)
"""On black: the page by night."""

CAPTIONS: Mapping[str, str] = {
    "wall": "wall",
    "mapped": "known to the planner",
    "unmapped": "only sensed",
    "mover": "walking",
    "robot": "robot",
    "way": "way to the goal",
    "goal": "goal",
    "seen": "what it sees",
    "hit": "nearest thing",
    "remembered": "what it remembers",
    "trail": "where it was",
    "touching": "contact",
}
"""What legends call the colours of a palette."""

SERIES = (LIGHT.robot, LIGHT.unmapped, LIGHT.way, LIGHT.mover, LIGHT.mapped, LIGHT.touching)
"""For things that have a name and no order, such as agents."""

BETA_SCALE = ("#1b2f6b", "#2f7f9b", "#ce7f06")
"""From averse over the middle to neutral, and for other values that have an order."""


def rgb(color: str) -> tuple[int, int, int]:
    """Return red, green and blue of ``#rrggbb``, each from 0 to 255."""
    red, green, blue = bytes.fromhex(color.removeprefix("#"))
    return red, green, blue


def mixed(first: str, second: str, share: float) -> str:
    """Return the colour between two of which the second has a share in [0, 1]."""
    parts = zip(rgb(first), rgb(second), strict=True)
    return "#" + "".join(f"{round((1.0 - share) * one + share * other):02x}" for one, other in parts)


def faded(color: str, opacity: float) -> str:
    """Return a colour that lets through what is behind it, as ``#rrggbbaa``; an opacity of 1 lets nothing through."""
    return f"{color}{round(255 * opacity):02x}"


def css_variables(palette: Palette) -> str:
    """Return a palette as CSS variables: ``--wall: #373d4a;`` and so on."""
    return " ".join(f"--{name}: {color};" for name, color in asdict(palette).items())


def beta_shades(number: int) -> list[str]:
    """Return so many colours for betas in rising order, from averse to neutral; one alone is averse.

    Example:
        >>> beta_shades(3) == list(BETA_SCALE)
        True
    """
    return shades(BETA_SCALE, number)


def shades(scale: tuple[str, ...], number: int) -> list[str]:
    """Return so many colours at equal distances along a scale."""
    places = [(len(scale) - 1) * i / max(number - 1, 1) for i in range(number)]
    pieces = [min(int(place), len(scale) - 2) for place in places]
    return [mixed(scale[piece], scale[piece + 1], place - piece) for place, piece in zip(places, pieces, strict=True)]
