"""What a page shows, as a link says it: who drives where, with how much risk."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, fields, replace
from typing import Any
from urllib.parse import urlencode

from rcdsac_trl.errors import UserInputError

AS_TRAINED = "trained"
"""The sensor that an agent was trained with."""
NOBODY = "none"
"""No second robot."""
LARGEST_SEED = 10**9

_SWITCHES = {"on": True, "off": False}
_LONGEST_VALUE = 100


@dataclass(frozen=True)
class SceneChoice:
    """A scene that can be opened again; every field is a key of the link's query.

    Attributes:
        agent: who drives, by a name of :class:`~rcdsac_trl.playground.offers.Offers`.
        beta: how much risk it takes (of agents that are told a collision weight, that one); None: its default.
        map: name of a map set, of a map that the server offers, or ``office``.
        seed: root seed of the map, its movers and goals.
        sensor: what the robot sees with; :data:`AS_TRAINED`: what the agent was trained with.
        second: who drives a second robot in a world of the same seed; :data:`NOBODY`: nobody.
        beta2: how much risk that one takes.
        stop: whether a stop zone stands between who drives and the wheels.
        detours: whether agents are led around what blocks their way, and helped where they stand.

    Raises:
        UserInputError: for a seed that is none.

    Example:
        >>> choice = SceneChoice.of_query({"agent": "sac-narrow", "beta": "-0.5", "stop": "on"})
        >>> choice.beta, choice.stop, choice.query
        (-0.5, True, 'agent=sac-narrow&beta=-0.5&stop=on')
    """

    agent: str
    beta: float | None = None
    map: str = "mixed"
    seed: int = 0
    sensor: str = AS_TRAINED
    second: str = NOBODY
    beta2: float | None = None
    stop: bool = False
    detours: bool = False

    def __post_init__(self) -> None:
        """Refuse what is no seed."""
        if not isinstance(self.seed, int) or not 0 <= self.seed <= LARGEST_SEED:
            raise _no_seed(f"={self.seed}")

    @classmethod
    def of_query(cls, query: Mapping[str, str], agent: str = "", others: Sequence[str] = ()) -> "SceneChoice":
        """Read a link's query.

        Args:
            query: values by key.
            agent: who drives where the query does not say it.
            others: keys that a link may have besides, for the sentence that names all.

        Raises:
            UserInputError: for an unknown key, or a value that cannot be read.
        """
        known = [field.name for field in fields(cls)]
        values: dict[str, str | float | int | bool] = {"agent": agent}
        for key, text in query.items():
            if key not in known:
                raise UserInputError(
                    f"the link has no key {shortened(key)}: it may have {', '.join([*known, *others])}"
                )
            values[key] = _read(key, text)
        return cls(**values)  # type: ignore[arg-type]

    @property
    def query(self) -> str:
        """The link's query; what is as usual is left out."""
        usual = type(self)(agent="")
        told = {field.name: getattr(self, field.name) for field in fields(self)}
        return urlencode({key: _written(value) for key, value in told.items() if value != getattr(usual, key)})

    def changed(self, key: str, value: Any) -> "SceneChoice":
        """Return the scene with another value of a field, as a form gives it; betas go with whom they belong to.

        Args:
            key: of the field.
            value: that it has now; None: its field is empty.

        Raises:
            UserInputError: for a seed that is none.

        Example:
            >>> SceneChoice("a", beta=-1.0, second="b").changed("agent", "b").changed("seed", 3.0).query
            'agent=b&seed=3&second=b'
        """
        if key == "seed":
            if value is None:
                raise _no_seed(" is empty, which")
            value = int(value) if isinstance(value, float) and value.is_integer() else value
        lost = {"agent": {"beta": None}, "second": {"beta2": None}}
        changes: dict[str, Any] = {key: value, **lost.get(key, {})}
        return replace(self, **changes)

    def next_map(self) -> "SceneChoice":
        """Return the scene with the next seed; after the largest comes 0."""
        return replace(self, seed=(self.seed + 1) % (LARGEST_SEED + 1))

    def with_betas(self, betas: Sequence[float | None]) -> "SceneChoice":
        """Return the scene with other betas, one or two."""
        return replace(self, beta=betas[0], beta2=betas[1] if len(betas) > 1 else None)


def shortened(text: str) -> str:
    """Return what somebody wrote, as a sentence can bear it."""
    text = "".join(letter if letter.isprintable() else "?" for letter in text[: _LONGEST_VALUE + 1])
    if not text:
        return "''"
    return text if len(text) <= _LONGEST_VALUE else f"{text[:_LONGEST_VALUE]}.."


def _read(key: str, text: str) -> str | float | int | bool:
    if key in ("beta", "beta2"):
        try:
            value = float(text)
        except ValueError:
            value = math.nan
        if not math.isfinite(value):
            raise UserInputError(f"{key}={shortened(text)} is no number: give one, such as -1")
        return value
    if key == "seed":
        if not (text.isascii() and text.isdigit() and len(text) <= len(str(LARGEST_SEED))):
            raise _no_seed(f"={shortened(text)}" if text else " is empty, which")
        return int(text)
    if key in ("stop", "detours"):
        if text not in _SWITCHES:
            raise UserInputError(f"{key}={shortened(text)} is neither on nor off: choose one of them")
        return _SWITCHES[text]
    return text


def _no_seed(told: str) -> UserInputError:
    return UserInputError(f"seed{told} is no whole number from 0 to {LARGEST_SEED}: give one")


def _written(value: str | float | int | bool | None) -> str:
    if isinstance(value, bool):
        return "on" if value else "off"
    return f"{value:g}" if isinstance(value, float) else str(value)
