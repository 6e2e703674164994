"""Telling what a visitor changes from what the page itself writes into a model."""

from collections.abc import Callable
from types import TracebackType
from typing import Any

Listener = Callable[[str, Any, Any], None]


class Silence:
    """While it is entered, the listeners that it made hear nothing.

    Example:
        >>> heard, silence = [], Silence()
        >>> listener = silence.unless_silent(lambda attr, old, new: heard.append(new))
        >>> with silence:
        ...     listener("value", 0, 1)
        >>> listener("value", 1, 2)
        >>> heard
        [2]
    """

    def __init__(self) -> None:
        self._depth = 0

    def __enter__(self) -> None:
        """Begin to be silent."""
        self._depth += 1

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        """Hear again."""
        self._depth -= 1

    def unless_silent(self, listener: Listener) -> Listener:
        """Make a listener that hears visitors alone."""

        def changed(attr: str, old: Any, new: Any) -> None:
            if not self._depth:
                listener(attr, old, new)

        return changed
