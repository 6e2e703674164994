"""What a search may search: numbers between two others, and choices among values."""

from dataclasses import dataclass
from typing import TYPE_CHECKING

from hydra.core.override_parser.types import ChoiceSweep, IntervalSweep, Override, RangeSweep

from rcdsac_trl.errors import UserInputError

if TYPE_CHECKING:
    import optuna


@dataclass(frozen=True)
class Number:
    """A number between two others.

    Attributes:
        low: smallest value.
        high: largest value; where both are whole numbers, so is every one between them.
        log: whether equal factors count alike, and not equal differences.
    """

    low: float
    high: float
    log: bool = False

    def __post_init__(self) -> None:
        """Refuse what is no range."""
        if not self.low < self.high:
            raise UserInputError(f"interval({self.low:g},{self.high:g}) is no range: give the smaller value first")
        if self.log and self.low <= 0:
            raise UserInputError(f"interval({self.low:g},{self.high:g}) has no logarithm: begin above 0")

    def __str__(self) -> str:
        """Write it as on the command line."""
        written = f"interval({self.low!r},{self.high!r})"
        return f"tag(log,{written})" if self.log else written

    def suggest(self, trial: "optuna.Trial", key: str) -> str:
        """Let a trial choose, and write it as an override's value."""
        if isinstance(self.low, int) and isinstance(self.high, int):
            return str(trial.suggest_int(key, self.low, self.high, log=self.log))
        return repr(trial.suggest_float(key, self.low, self.high, log=self.log))


@dataclass(frozen=True)
class Choice:
    """One of several values, written as on the command line."""

    values: tuple[str, ...]

    def __str__(self) -> str:
        """Write it as on the command line."""
        return f"choice({','.join(self.values)})"

    @property
    def low(self) -> str:
        """The first value."""
        return self.values[0]

    @property
    def high(self) -> str:
        """The last value."""
        return self.values[-1]

    def suggest(self, trial: "optuna.Trial", key: str) -> str:
        """Let a trial choose, and write it as an override's value."""
        value = trial.suggest_categorical(key, self.values)
        assert isinstance(value, str)
        return value


Searched = Number | Choice


def searched_in(override: Override) -> Searched:
    """Return what an override of several values searches."""
    value = override.value()
    if isinstance(value, IntervalSweep):
        assert value.start is not None
        assert value.end is not None
        return Number(value.start, value.end, log="log" in value.tags)
    if isinstance(value, RangeSweep):
        return Choice(tuple(str(number) for number in value.range()))
    assert isinstance(value, ChoiceSweep)
    return Choice(tuple(override.sweep_string_iterator()))
