"""Where the runs of a sweep run: one class for each file of ``conf/launcher``, whose keys are its fields."""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Literal

from rcdsac_trl.pipeline.sweep import Job, Launcher, State, execute
from rcdsac_trl.pipeline.typed import read


@dataclass(frozen=True)
class LocalLauncher:
    """One run after another, on this machine."""

    name: Literal["local"]

    def run(self, jobs: Sequence[Job]) -> Iterator[tuple[Job, State]]:
        """Run every job, see :class:`~rcdsac_trl.pipeline.sweep.Launcher`."""
        for job in jobs:
            yield job, execute(job)


LAUNCHERS: Mapping[str, type[Launcher]] = {"local": LocalLauncher}


def read_launcher(values: Mapping[str, Any]) -> Launcher:
    """Make a launcher of its section.

    Raises:
        UserInputError: for what it does not understand, and if its package is missing.
    """
    return read(LAUNCHERS[values["name"]], values, "launcher")
