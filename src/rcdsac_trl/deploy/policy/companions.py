"""What drives with an agent, a guard and a navigator: refused where they are of another robot than the agent's."""

from typing import TYPE_CHECKING, Literal

from rcdsac_trl.errors import UserInputError
from rcdsac_trl.robot.guard import Guard
from rcdsac_trl.robot.robot_settings import RobotSettings

if TYPE_CHECKING:
    from rcdsac_trl.deploy.navigation.navigator import Navigator


def guard_of(robot: RobotSettings, guard: Guard | Literal["robot"] | None) -> Guard | None:
    """Return the guard of a robot's policy.

    Raises:
        UserInputError: if the one that was given is another robot's.
    """
    if guard == "robot":
        return Guard.of(robot)
    if not isinstance(guard, Guard | None):
        raise UserInputError(f"guard={guard!r} is none: give Guard.of(robot), None to drive without, or leave it out")
    if guard is not None and guard.robot != robot:
        raise UserInputError(
            f"the guard has the limits of robot={guard.robot.name}, and this agent drives robot={robot.name}: give "
            "Guard.of(policy.robot, ..), or leave it out"
        )
    return guard


def navigator_of(robot: RobotSettings, navigator: "Navigator | None") -> "Navigator | None":
    """Return the navigator of a robot's policy.

    Raises:
        UserInputError: if the one that was given is none, or another robot's.
    """
    if navigator is None:
        return None
    of = getattr(navigator, "robot", None)  # its class takes numba to import
    if not isinstance(of, RobotSettings):
        raise UserInputError(f"navigator={navigator!r} is none: give Navigator(NavigatorSettings(), policy.robot)")
    if of != robot:
        raise UserInputError(
            f"the navigator is of robot={of.name}, and this agent drives robot={robot.name}: give "
            "Navigator(NavigatorSettings(), policy.robot)"
        )
    return navigator
