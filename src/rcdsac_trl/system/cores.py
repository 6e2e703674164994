"""How many cores this process may use: the one answer to every ``auto``."""

import os

from rcdsac_trl.errors import UserInputError
from rcdsac_trl.system import cgroups

SHARE = "RCDSAC_TRL_CORES"
"""Environment variable: the share of a machine that a process and those it starts have been given."""


def usable_cores() -> int:
    """Return the cores this process may use: the least of those the system lets it run on, of the whole cores' time
    that its container grants, and of its share.

    Raises:
        UserInputError: if the share is no number.
    """
    there = allowed_cores()
    if (quota := cgroups.processor_quota()) is not None:
        there = min(there, quota)
    share = os.environ.get(SHARE)
    if share is None:
        return there
    if not share.isdecimal() or int(share) < 1:
        raise UserInputError(f"{SHARE}={share} is not a whole number of at least 1: set it to that, or unset it")
    return min(there, int(share))


def allowed_cores() -> int:
    """Return the cores this process may run on, for however little of their time: what libraries count by."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
