"""Who drives a scene: its choice, checked against what is offered, before any world is made."""

from dataclasses import dataclass

from rcdsac_trl.errors import UserInputError
from rcdsac_trl.evaluation.course.entries import check_sensor
from rcdsac_trl.playground.drivers import AgentDriver, Driver, PlannerDriver
from rcdsac_trl.playground.offers import OFFICE, PLANNERS, Offers
from rcdsac_trl.playground.scene_choice import AS_TRAINED, NOBODY, SceneChoice, shortened
from rcdsac_trl.robot.range_sensor import SENSORS
from rcdsac_trl.robot.robot_settings import PAPER, RobotSettings
from rcdsac_trl.world.office.depth_cameras import Lens

NARROW = "narrow"
"""The sensor of planners, and of the office's cameras."""


@dataclass(frozen=True)
class Part:
    """One robot's driver.

    Attributes:
        name: of who drives.
        driver: likewise.
        dialled: beta, or the collision weight; None where there is neither.
    """

    name: str
    driver: Driver
    dialled: float | None


def cast(choice: SceneChoice, offers: Offers) -> list[Part]:
    """Return who drives a scene, one or two; this takes some milliseconds.

    Raises:
        UserInputError: for what is not offered, a beta outside of the trained range, a sensor that does not exist, an
            agent that cannot drive the office, and two that do not drive the same robot.
    """
    names = [choice.agent] + ([] if choice.second == NOBODY else [choice.second])
    drivers = _drivers(names, choice, offers)
    betas = [("beta", choice.beta), ("beta2", choice.beta2)]
    if len(drivers) == 1 and choice.beta2 is not None:
        raise UserInputError(f"beta2={choice.beta2:g} is for a second robot, and there is none: choose second, too")
    parts = [
        Part(name, driver, _dialled(driver, *beta)) for name, driver, beta in zip(names, drivers, betas, strict=False)
    ]
    for part in parts:
        if choice.map == OFFICE:
            _check_office(part)
        part.driver.guarded = choice.stop
        part.driver.set_detours(choice.detours)
    return parts


def _drivers(names: list[str], choice: SceneChoice, offers: Offers) -> list[Driver]:
    """Make who drives; a planner drives the robot, and sees with the sensor, of the agent beside it."""
    if choice.map not in offers.places:
        offers.source(choice.map)  # says so
    if choice.sensor != AS_TRAINED and choice.sensor not in SENSORS:
        known = ", ".join([AS_TRAINED, *sorted(SENSORS)])
        raise UserInputError(f"sensor={shortened(choice.sensor)} does not exist: choose one of {known}")
    sensor = None if choice.sensor == AS_TRAINED else choice.sensor
    agents = {name: AgentDriver(offers.weights(name), sensor) for name in dict.fromkeys(names) if name not in PLANNERS}
    first = next(iter(agents.values()), None)
    robot: RobotSettings = PAPER if first is None else first.robot
    beside = sensor or (NARROW if first is None else first.sensor)
    drivers: list[Driver] = []
    for name in names:
        if name in PLANNERS:
            drivers.append(PlannerDriver(name, robot, beside, choice.seed))
        elif name in names[: len(drivers)]:  # the same agent twice has two memories
            drivers.append(AgentDriver(offers.weights(name), sensor))
        else:
            drivers.append(agents[name])
    for name, driver in zip(names, drivers, strict=True):
        if driver.robot != robot:
            raise UserInputError(
                f"{name} drives robot={driver.robot.name} and {names[0]} robot={robot.name}: choose two of one robot"
            )
    return drivers


def _dialled(driver: Driver, key: str, value: float | None) -> float | None:
    if driver.dial is not None:
        return driver.dial.check(key, value)
    if value is not None and value != getattr(driver, "fixed_beta", None):
        raise UserInputError(f"{key}={value:g} means nothing to who drives: leave it out")
    return None


def _check_office(part: Part) -> None:
    robot = part.driver.robot
    if robot != PAPER:
        raise UserInputError(f"the office is the paper's robot's, and this one is {robot.name}: choose a map")
    if isinstance(part.driver, AgentDriver):
        try:
            check_sensor(part.name, part.driver.policy, Lens().view_deg)
        except UserInputError:  # its remedies are those of the course
            raise UserInputError(
                f"the office is driven by four cameras, which leave most of sensor={part.driver.sensor} dark: choose "
                f"sensor={NARROW}, or a map"
            ) from None
