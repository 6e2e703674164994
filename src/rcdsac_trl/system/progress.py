"""What a program tells whoever waits for it: nothing that takes longer than ten seconds is silent.

All of it goes to stderr: a bar in a terminal, and lines anywhere else.
"""

import sys
import threading
import time
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from typing import Self, TypeVar

from tqdm import tqdm

SILENCE_S = 10.0
"""Nothing is silent for longer."""
# After so long a first guess is worth something.
_FORETOLD_S = 3.0
# The first steps may wait for a compiler: the pace is measured from this share of the work on, and told from the other.
_MEASURED_SHARE = 0.01
_FORETOLD_SHARE = 0.05

# What a program does while it has no work to tell of.
_BEFORE_WORK = ": it imports and reads, and the first call after an installation compiles"

Watch = Callable[[int], None]
"""Is told, again and again, how many steps are done so far."""
Part = TypeVar("Part")

_under_way: list["Work | _Service"] = []


class Work:
    """Work in units of about one length: says at the start how many there are, and then how long they will take.

    Args:
        doing: what is done, told at the start.
        total: how many units.
        unit: what one is called.

    Example:
        >>> with Work("two sums", 2, "sum") as work:
        ...     work.end_unit()
        ...     print(work)
        1 of 2 sums
    """

    def __init__(self, doing: str, total: int, unit: str) -> None:
        self.ended = 0
        self._doing = doing
        self._total = total
        self._unit = unit
        self._reached = 0.0
        self._foretold = False
        self._began: tuple[float, float] | None = None  # when the first share was done, and how much that was

    def __enter__(self) -> Self:
        """Say what begins."""
        tqdm.write(f"rcdsac_trl: {self._doing}", file=sys.stderr)
        self._bar = tqdm(total=self._total, unit=self._unit, disable=None)
        _under_way.append(self)
        return self

    def __exit__(self, *_: object) -> None:
        """Say no more of it."""
        _under_way.remove(self)
        self._bar.close()

    def reach(self, units: float) -> None:
        """Take note of how many units are done, the parts of those under way included; it may be a guess."""
        self._reached = max(self._reached, min(units, self._total))
        if self._began is None and self._reached >= _MEASURED_SHARE * self._total:
            self._began = time.monotonic(), self._reached
        if self._foretold or self._began is None or time.monotonic() - self._began[0] < _FORETOLD_S:
            return
        if self.left_s() is not None:
            self._foretold = True
            self.tell()

    def end_unit(self) -> None:
        """Count a unit that has ended."""
        self.ended += 1
        self.reach(self.ended)
        self._bar.update()

    def within(self, parts: Iterable[Part], number: int) -> Iterator[Part]:
        """Pass the parts of a unit on, and take note of them."""
        for done, part in enumerate(parts):
            self.reach(self.ended + done / number)
            yield part

    def left_s(self) -> float | None:
        """Guess how long the rest will take, s; None where nobody knows yet."""
        if self._began is None or self._reached < _FORETOLD_SHARE * self._total or self._reached == self._began[1]:
            return None
        pace_s = (time.monotonic() - self._began[0]) / (self._reached - self._began[1])
        return pace_s * (self._total - self._reached)

    def __str__(self) -> str:
        """Say how far it is."""
        done = f"{self.ended} of {counted(self._total, self._unit)}" if self._total > 1 else f"{self._reached:.0%}"
        left_s = self.left_s()
        return done if left_s is None else f"{done}, about {duration(left_s)} left"

    def tell(self, how_long: str | None = None) -> None:
        """Show how far it is, in the bar or in a line."""
        if self._bar.disable:
            print(f"rcdsac_trl: {self}{'' if how_long is None else f' ({how_long})'}", file=sys.stderr)
        else:
            self._bar.set_postfix_str(str(self))


class _Service:
    """What nobody waits for."""

    def tell(self, how_long: str) -> None:
        """Say nothing."""


@contextmanager
def serving() -> Iterator[None]:
    """Let a program be silent that serves until somebody ends it."""
    service = _Service()
    _under_way.append(service)
    try:
        yield
    finally:
        _under_way.remove(service)


@contextmanager
def never_silent(silence_s: float = SILENCE_S) -> Iterator[None]:
    """Tell again and again, from a thread of its own, that this program is at work, and how far."""
    over = threading.Event()
    began_s = time.monotonic()

    def tell() -> None:
        what = _BEFORE_WORK
        while not over.wait(silence_s):
            how_long = f"at work for {duration(time.monotonic() - began_s)}"
            if _under_way:
                _under_way[-1].tell(how_long)
            else:
                print(f"rcdsac_trl: {how_long}{what}", file=sys.stderr)
                what = ""  # said once

    teller = threading.Thread(target=tell, daemon=True)
    teller.start()
    try:
        yield
    finally:
        over.set()
        teller.join()


def counted(number: int, unit: str) -> str:
    """Put a number of units into words.

    Example:
        >>> counted(1, "map"), counted(12, "run")
        ('1 map', '12 runs')
    """
    return f"{number} {unit}{'' if number == 1 else 's'}"


def duration(seconds: float) -> str:
    """Put a duration into words.

    Example:
        >>> duration(12.4), duration(590.0), duration(9000.0)
        ('12 s', '10 min', '2.5 h')
    """
    if seconds < 100:
        return f"{seconds:.0f} s"
    return f"{seconds / 60:.0f} min" if seconds < 6000 else f"{seconds / 3600:.1f} h"
