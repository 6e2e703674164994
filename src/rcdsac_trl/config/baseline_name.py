"""What ``baseline=`` of an evaluation may name; without torch, so that a mistyped name is told at once."""

import re
from typing import NamedTuple

from rcdsac_trl.errors import UserInputError

PURSUIT = "pursuit"
BASELINES = (PURSUIT, "dwa", "mppi")
_OWN = re.compile(r"(?P<module>\w+(\.\w+)*):(?P<name>\w+)")


class OwnClass(NamedTuple):
    """Where a user's controller is imported from."""

    module: str
    name: str


def own_class(baseline: str) -> OwnClass | None:
    """Read which class of the user a baseline is; None if it is one of :data:`BASELINES`.

    Raises:
        UserInputError: if it is neither.

    Example:
        >>> own_class("my_controllers:Cautious"), own_class("dwa")
        (OwnClass(module='my_controllers', name='Cautious'), None)
    """
    if baseline in BASELINES:
        return None
    if (match := _OWN.fullmatch(baseline)) is None:
        raise UserInputError(
            f"baseline={baseline} is unknown: choose one of {', '.join(BASELINES)}, or <module>:<class>"
        )
    return OwnClass(match["module"], match["name"])
