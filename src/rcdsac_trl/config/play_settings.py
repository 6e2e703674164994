"""What the page of ``python -m rcdsac_trl.play`` may choose, checked."""

import re
from dataclasses import dataclass

from rcdsac_trl.errors import UserInputError
from rcdsac_trl.system.checks import check_least
from rcdsac_trl.system.extras import needs

_LARGEST_PORT = 65535


@dataclass(frozen=True)
class PlaySettings:
    """The root of ``conf/play.yaml``, which explains the keys.

    Raises:
        UserInputError: a value is outside its limits, or what serves pages is not installed.
    """

    run: str | tuple[str, ...] | None
    maps: tuple[str, ...]
    host: str
    port: int
    origins: tuple[str, ...]
    browser: bool
    max_sessions: int
    films: str

    def __post_init__(self) -> None:
        """Refuse what is outside its limits."""
        if not 0 <= self.port <= _LARGEST_PORT:
            raise UserInputError(
                f"port={self.port} is no port: choose one from 1 to {_LARGEST_PORT}, or 0 for a free one"
            )
        if not self.host.strip():
            raise UserInputError("host names nothing to listen on: use localhost")
        for origin in self.origins:
            if not re.fullmatch(r"[\w.-]+:\d+", origin):
                raise UserInputError(
                    f"origins holds {origin!r}: give <name>:<port>, as a browser's address bar shows it"
                )
        check_least("max_sessions", self.max_sessions, 1)
        for key, values in (("run", self.runs), ("maps", self.maps)):
            for value in values:
                if values.count(value) > 1:
                    raise UserInputError(f"{key}={value} is given more than once: name every one once")
        needs("bokeh", "play", extra="play", instead="`evaluate record=true`, which writes films")

    @property
    def runs(self) -> tuple[str, ...]:
        """The runs that are named, none or several."""
        return () if self.run is None else (self.run,) if isinstance(self.run, str) else self.run
