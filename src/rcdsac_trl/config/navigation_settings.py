"""What navigates around an agent, in `course` and `evaluate`."""

from dataclasses import dataclass


@dataclass(frozen=True)
class NavigationSettings:
    """Every field is a key of ``navigation`` in ``conf/course.yaml`` and ``conf/evaluate.yaml``.

    Attributes:
        replan: hand out other waypoints where the way is blocked.
        watchdog: help an agent that stands still.
    """

    replan: bool = False
    watchdog: bool = False


@dataclass(frozen=True)
class EvaluationNavigationSettings(NavigationSettings):
    """The same in ``conf/evaluate.yaml``, where agents and planners drive without a stop zone unless it is asked for.

    Attributes:
        stop_zone: keep the robot's stop zone between the agent, or planner, and the wheels.
    """

    stop_zone: bool = False

    @property
    def is_on(self) -> bool:
        """Whether anything stands between the agent, or planner, and the wheels."""
        return self.replan or self.watchdog or self.stop_zone


@dataclass(frozen=True)
class CourseNavigationSettings(NavigationSettings):
    """The same in ``conf/course.yaml``, where a robot also knows a map.

    Attributes:
        static_layer: let detours and the stop zone keep clear of what the planner's map shows, seen or not.
    """

    static_layer: bool = False
