"""A page's link, read and checked before anything of the page is made."""

from collections.abc import Mapping
from dataclasses import dataclass, replace

from rcdsac_trl.errors import UserInputError
from rcdsac_trl.playground.cast import cast
from rcdsac_trl.playground.offers import Offers
from rcdsac_trl.playground.palette import THEMES
from rcdsac_trl.playground.scene_choice import NOBODY, SceneChoice, shortened

_CAREFUL = 0.25
_EVENTFUL = "hard"
# With the agents that ship, the neutral robot alone touches something there within 15 seconds.
_SHOWS_BETA = 28
# What a link may say of the page itself.
_SWITCH = ("on", "off")
_OWN_KEYS: Mapping[str, tuple[str, ...]] = {"theme": THEMES, "paused": _SWITCH, "zoom": _SWITCH}


@dataclass(frozen=True)
class PageLink:
    """What a link asks for.

    Attributes:
        choice: the scene.
        theme: one of :data:`~rcdsac_trl.playground.palette.THEMES`; None: as the browser has it.
        running: whether it drives at once.
        zoomed: whether it begins with what is around each robot.
    """

    choice: SceneChoice
    theme: str | None
    running: bool
    zoomed: bool


def read_link(query: Mapping[str, str], offers: Offers) -> PageLink:
    """Read a link's query.

    Args:
        query: by key: those of a scene, ``theme``, ``paused`` and ``zoom``.
        offers: what can be chosen.

    Raises:
        UserInputError: for what it cannot say, and for a scene that is not offered.
    """
    own = {key: query[key] for key in _OWN_KEYS if key in query}
    for key, value in own.items():
        if value not in _OWN_KEYS[key]:
            raise UserInputError(f"{key}={shortened(value)} is none of {', '.join(_OWN_KEYS[key])}: choose one of them")
    scene = {key: value for key, value in query.items() if key not in own}
    choice = SceneChoice.of_query(scene, next(iter(offers.agents)), [*_OWN_KEYS]) if scene else usual_scene(offers)
    cast(choice, offers)
    zoomed = own["zoom"] == "on" if "zoom" in own else zoomed_usually(choice)
    return PageLink(choice, own.get("theme"), running=own.get("paused") != "on", zoomed=zoomed)


def zoomed_usually(choice: SceneChoice) -> bool:
    """Return whether a scene begins with what is around each robot: two maps side by side are small."""
    return choice.second != NOBODY


def usual_scene(offers: Offers) -> SceneChoice:
    """Return what is shown unless a link says it: the first agent twice, side by side, careful and as bold as can be.

    Careful is a quarter above the lowest value that it was trained with: at the very end some agents hardly move. Where
    much stands in the way, there is much to be careful of; the seed is one in which that shows soon.
    """
    alone = SceneChoice(next(iter(offers.agents)), map=_EVENTFUL)
    (part,) = cast(alone, offers)
    dial = part.driver.dial
    if dial is None or part.driver.measure is None:  # without a measure, what is dialled is no beta
        return alone
    careful = round(dial.low + _CAREFUL * (dial.high - dial.low), 2)
    return replace(alone, seed=_SHOWS_BETA, beta=careful, second=part.name, beta2=dial.high)
