"""What navigates around an agent, in `course` and `evaluate`."""

from dataclasses import dataclass


@dataclass(frozen=True)
class NavigationSettings:
    """Every field is a key of ``navigation`` in ``conf/course.yaml`` and ``conf/evaluate.yaml``.

    Attributes:
        replan: hand out other waypoints where the way is blocked.
        watchdog: help an agent that gets nowhere.
    """

    replan: bool = False
    watchdog: bool = False
