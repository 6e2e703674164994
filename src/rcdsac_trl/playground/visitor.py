"""What a visitor does, as orders to the drive."""

import math
from collections.abc import Callable
from typing import Any

from bokeh.events import Tap

from rcdsac_trl.playground.drive_clock import SPEEDS, DriveClock
from rcdsac_trl.playground.play_drive import Drive
from rcdsac_trl.playground.scene_choice import SceneChoice
from rcdsac_trl.playground.view_state import RobotView

# An obstacle is put this far ahead of the first robot.
_AHEAD_M = 1.2


class Visitor:
    """Gives orders; none waits for what comes of it.

    Args:
        clock: the drive.
    """

    def __init__(self, clock: DriveClock) -> None:
        self._clock = clock

    def turn(self, number: int, beta: float) -> None:
        """Turn a robot's beta."""
        self._tell(lambda drive: drive.set_beta(number, beta))

    def pause(self, on: bool) -> None:
        """Pause, or go on."""
        self._clock.run(not on)

    def step(self) -> None:
        """Pause, and take one step."""
        self._clock.step_once()

    def choose_speed(self, number: int) -> None:
        """Choose one of the speeds."""
        self._clock.set_speed(SPEEDS[number])

    def switch_stop_zone(self, on: bool) -> None:
        """Put a stop zone between who drives and the wheels, or take it away."""
        self._tell(lambda drive: drive.set_stop_zone(on))

    def switch_detours(self, on: bool) -> None:
        """Lead agents around what blocks their way, and help where they stand, or let them alone."""
        self._tell(lambda drive: drive.set_detours(on))

    def push(self, side: float) -> None:
        """Push the robots aside: to their left for 1.0, to their right for -1.0."""
        self._tell(lambda drive: drive.push(side))

    def tap(self, event: Tap) -> None:
        """Send the robots somewhere, or put an obstacle there, or take the one away that is there."""
        x, y = event.x, event.y
        if x is None or y is None or not (math.isfinite(x) and math.isfinite(y)):
            return
        if event.modifiers is not None and event.modifiers["shift"]:
            self._tell(lambda drive: drive.put_or_take_obstacle(x, y))
        else:
            self._tell(lambda drive: drive.set_goal(x, y))

    def put_ahead(self) -> None:
        """Put an obstacle into the first robot's way."""
        if self._clock.newest is not None:
            x, y = _ahead(self._clock.newest.robots[0])
            self._tell(lambda drive: drive.put_obstacle(x, y))

    def move_obstacle(self, number: int, x: float, y: float) -> None:
        """Move an obstacle that was put, counted from 0."""
        self._tell(lambda drive: drive.move_obstacle(number, x, y))

    def choose(self, key: str, value: Any) -> None:
        """Open a scene that differs in one field."""
        self._clock.open(lambda choice: choice.changed(key, value))

    def choose_next_map(self) -> None:
        """Open the scene with the next seed."""
        self._clock.open(SceneChoice.next_map)

    def press(self, key: str) -> None:
        """Do what a key stands for."""
        match key:
            case " ":
                self._clock.toggle()
            case ".":
                self.step()
            case "o":
                self.put_ahead()
            case "a" | "d":
                self.push(1.0 if key == "a" else -1.0)

    def _tell(self, order: Callable[[Drive], None]) -> None:
        self._clock.tell(order)


def _ahead(robot: RobotView) -> tuple[float, float]:
    """Return the place on a robot's way that is so far ahead that it can still evade."""
    (x, y), (x_1, y_1) = robot.way[:2].tolist()
    length = max(((x_1 - x) ** 2 + (y_1 - y) ** 2) ** 0.5, 1e-6)
    share = _AHEAD_M / length
    return x + share * (x_1 - x), y + share * (y_1 - y)
