"""What page.js writes on the page: numbers with their units, sentences, the link."""

from collections.abc import Sequence
from typing import Any

from rcdsac_trl.playground.drive_clock import View
from rcdsac_trl.playground.page_link import zoomed_usually
from rcdsac_trl.playground.scene_choice import NOBODY, SceneChoice
from rcdsac_trl.playground.view_state import RobotView

OPENING = "Making the scene .."
"""Said until it stands."""


def refusal_words(theme: str, sentence: str) -> dict[str, Any]:
    """Return what a page says that shows nothing but a sentence."""
    return {
        "number": 0,
        "theme": theme,
        "refused": sentence,
        "robots": [],
        "message": "",
        "waits": False,
        "rate": "",
        "scene": "",
        "glass": False,
        "query": "",
        "zoom": "off",
        "usual_zoom": "off",
        "film": {"told": "", "files": []},
    }


def view_words(
    theme: str, zoomed: bool, view: View, opening: bool, shown_per_s: float, film: tuple[str, Sequence[str]]
) -> dict[str, Any]:
    """Return what a page says of a view.

    Args:
        theme: of the page.
        zoomed: whether what is around each robot is shown.
        view: that is shown.
        opening: whether another scene is being made.
        shown_per_s: how many agent steps a second the browser draws.
        film: a sentence about the latest film, and the names of its files.
    """
    choice = view.choice
    return {
        "number": view.number,
        "theme": theme,
        "refused": None,
        "message": OPENING if opening else view.message or "",
        "waits": opening,
        "query": choice.query,
        "zoom": "on" if zoomed else "off",
        "usual_zoom": "on" if zoomed_usually(choice) else "off",
        "scene": f"{_drivers(choice)}, {choice.map}, seed {choice.seed}",
        "glass": bool(view.glass),
        "rate": f"{shown_per_s:.0f} agent steps/s shown, {view.steps_per_s:.0f} driven" if view.running else "",
        "film": {"told": film[0], "files": list(film[1])},
        "robots": [robot_words(robot) for robot in view.robots],
    }


def _drivers(choice: SceneChoice) -> str:
    if choice.second == NOBODY:
        return choice.agent
    return f"{choice.agent} twice" if choice.second == choice.agent else f"{choice.agent} beside {choice.second}"


def _dial_words(robot: RobotView) -> dict[str, Any]:
    dial, dialled = robot.dial, robot.dialled
    if dial is None or dialled is None:
        return {"beta": "", "word": "", "ends": ["", ""]}
    return {"beta": f"{dial.symbol} = {dialled:.2f}", "word": dial.word(dialled), "ends": list(dial.words)}


def _help_words(robot: RobotView) -> list[str]:
    """Return what stands between who drives and the wheels now."""
    held = [] if robot.limited is None else [f"held by {robot.limited}"]
    return held if robot.helped is None else [*held, robot.helped]


def robot_words(robot: RobotView) -> dict[str, Any]:
    """Return what a page says of a robot."""
    returns = robot.returns
    value = ""
    if returns is not None:
        value = f"mean {returns.mean:.1f} (dotted), at this β {returns.value:.1f} (dashed)"
        value += ", recalibrated" if returns.recalibrated else ""
    nothing = ""
    if robot.values is None and robot.wanted is not None:
        nothing = "A planner: it expects no return."
    elif returns is None and robot.wanted is not None:
        nothing = "Its critics know the mean return alone, no distribution."
    return {
        "name": robot.name,
        **_dial_words(robot),
        "limited": ", ".join(_help_words(robot)),
        "speed": f"{robot.speed_m_per_s + 0.0:.2f} m/s",
        "clearance": f"{robot.clearance_m:.2f} m",
        "reward": "–" if robot.reward is None else f"{robot.reward:.1f}",
        "time": f"{robot.time_s:.1f} s",
        "goals": str(robot.goals),
        "collisions": str(robot.collisions),
        "value": value,
        "nothing": nothing,
        "blind": returns is None,
        "deaf": robot.values is None,
        "touching": robot.in_contact,
    }
