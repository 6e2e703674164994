"""The thread that drives: in step with the clock, whatever the browser does. It takes orders and hands out views."""

import queue
import threading
import time
import traceback
from collections import deque
from collections.abc import Callable, Sequence
from dataclasses import dataclass

from rcdsac_trl.errors import UserInputError
from rcdsac_trl.evaluation.film.recording import Moment
from rcdsac_trl.playground.offers import Offers
from rcdsac_trl.playground.play_drive import Drive, Robot
from rcdsac_trl.playground.scene_choice import SceneChoice
from rcdsac_trl.playground.view_state import RobotView, ValueView, robot_view, value_view
from rcdsac_trl.world.maps.shapes import Box, Map
from rcdsac_trl.world.render import Scene

SPEEDS = (0.5, 1.0, 2.0, 4.0)
"""How many times as fast as real the drive may be shown."""
KEPT_S = 30.0
"""A film shows so much of the drive."""

Change = Callable[[SceneChoice], SceneChoice]
"""Makes another scene of one."""

# Between two pictures of all actions' values passes so much time, whatever the drive's speed.
_VALUES_PERIOD_S = 0.4
# Who is later than this does not catch up.
_LATEST_S = 0.3


@dataclass(frozen=True)
class View:
    """Everything that a page shows at one moment.

    Attributes:
        number: counts views.
        scene_number: counts scenes: with another one, walls are drawn anew.
        choice: the scene, as a link says it.
        num_orders: so many were carried out, or refused.
        map: what stands.
        glass: of it, what cameras do not see.
        robots: one or two.
        running: whether it drives.
        speed: how many times as fast as real.
        message: a sentence for the visitor; None: all is well.
        steps_per_s: agent steps, of all robots together, of the last seconds.
    """

    number: int
    scene_number: int
    choice: SceneChoice
    num_orders: int
    map: Map
    glass: Sequence[Box]
    robots: tuple[RobotView, ...]
    running: bool
    speed: float
    message: str | None
    steps_per_s: float


class DriveClock:
    """Drives a scene in a thread of its own, from its start until it is closed.

    Args:
        choice: the first scene.
        offers: what there is to choose from.
        running: whether it drives at once, or waits to be told so.

    Attributes:
        newest: the latest view; None until the first scene stands.
        num_orders: so many were given.
        refused: why the first scene cannot be had; None: it can.
    """

    def __init__(self, choice: SceneChoice, offers: Offers, running: bool = True) -> None:
        self.newest: View | None = None
        self.num_orders = 0
        self.refused: str | None = None
        self._offers = offers
        self._orders: queue.SimpleQueue[Callable[[], None] | None] = queue.SimpleQueue()
        self._changes: deque[Change] = deque()
        self._opening = False
        self._num_done = 0
        self._running, self._speed = running, 1.0
        self._message: str | None = None
        self._scene_number = 0
        self._due_s = 0.0
        self._values: list[ValueView | None] = []
        self._values_s = 0.0
        self._scenes: list[Scene] = []
        self._moments: list[deque[Moment]] = []
        self._step_times_s: deque[float] = deque(maxlen=32)
        self._thread = threading.Thread(target=self._live, args=[choice], name="drive", daemon=True)

    def start(self) -> None:
        """Make the scene, and drive it."""
        self._thread.start()

    @property
    def opening(self) -> bool:
        """Whether another scene was asked for that does not stand yet."""
        return self._opening or bool(self._changes)

    @property
    def alive(self) -> bool:
        """Whether it has started, and its physics is not freed yet."""
        return self._thread.is_alive()

    # ------------------------------------------------------------------------------------------- orders
    def open(self, change: Change) -> None:
        """Drive another scene; if it cannot be had, the one before goes on, and a sentence says why.

        Args:
            change: makes it of the scene that is driven then. What is asked for meanwhile adds up.
        """
        self._changes.append(change)
        self._order(self._open)

    def tell(self, order: Callable[[Drive], None]) -> None:
        """Do something with the drive between two steps."""
        self._order(lambda: order(self._drive))

    def run(self, on: bool) -> None:
        """Go on, or pause."""
        self._order(lambda: setattr(self, "_running", on))

    def toggle(self) -> None:
        """Pause where it drives then, else go on."""
        self._order(lambda: setattr(self, "_running", not self._running))

    def step_once(self) -> None:
        """Pause, and take one step."""

        def step() -> None:
            self._running = False
            self._step()

        self._order(step)

    def set_speed(self, speed: float) -> None:
        """Set how many times as fast as real it drives, one of :data:`SPEEDS`."""
        self._order(lambda: setattr(self, "_speed", speed))

    def with_moments(self, take: Callable[[list[list[Moment]], list[str], float], None]) -> None:
        """Hand the moments of each robot, their names, and the duration of a step, s, to somebody."""
        self._order(lambda: take([list(track) for track in self._moments], self._headings(), self._drive.period_s))

    def close(self, wait_s: float | None = None) -> None:
        """End the drive and free its physics.

        Args:
            wait_s: wait for that at most so long; None: do not wait.
        """
        self._orders.put(None)
        if wait_s is not None and self.alive:
            self._thread.join(wait_s)

    def _order(self, order: Callable[[], None]) -> None:
        self.num_orders += 1
        self._orders.put(order)

    # ------------------------------------------------------------------------------------------- its thread
    def _live(self, choice: SceneChoice) -> None:
        try:
            self._begin(Drive(choice, self._offers))
            try:
                self._run()
            finally:
                self._drive.close()
        except UserInputError as error:
            self.refused = str(error)
        except Exception as error:  # nobody else would hear of it
            traceback.print_exc()
            self.refused = f"the drive has failed ({type(error).__name__}): see where the server was started"

    def _run(self) -> None:
        while (orders := self._next_orders()) is not None:
            if orders:
                self._carry_out(orders)
            # Also where orders never end, as while a slider is drawn: a step that is due is not put off.
            if self._running and time.monotonic() >= self._due_s:
                self._step()
                self._schedule()

    def _carry_out(self, orders: Sequence[Callable[[], None]]) -> None:
        """Carry out some orders, and show what came of all of them."""
        self._message = None
        for order in orders:
            try:
                order()
            except UserInputError as error:
                self._message = str(error)
        self._num_done += len(orders)
        self._values_s = 0.0  # beta may be another one
        self._publish()

    def _next_orders(self) -> list[Callable[[], None]] | None:
        """Return the orders that came, at least one unless a step is due first; None: it is to end."""
        wait_s = max(0.0, self._due_s - time.monotonic()) if self._running else None
        orders: list[Callable[[], None]] = []
        try:
            order = self._orders.get(timeout=wait_s)
            # A slider that is drawn orders faster than views are computed: one view shows what came of all.
            while order is not None:
                orders.append(order)
                order = self._orders.get_nowait()
        except queue.Empty:
            return orders
        return None

    def _schedule(self) -> None:
        now_s = time.monotonic()
        self._due_s += self._drive.period_s / self._speed
        if now_s > self._due_s + _LATEST_S:
            self._due_s = now_s

    def _open(self) -> None:
        self._opening = True
        try:
            changes = [self._changes.popleft() for _ in range(len(self._changes))]
            if changes:  # else an earlier order has opened what they make together
                drive = self._changed(changes)
                self._drive.close()
                self._begin(drive)
        finally:
            self._opening = False

    def _changed(self, changes: Sequence[Change]) -> Drive:
        """Make the scene that some changes make of what is driven."""
        choice = self._drive.choice
        try:
            for change in changes:
                choice = change(choice)
            return Drive(choice, self._offers)
        except UserInputError:
            raise
        except Exception as error:  # what is driven goes on
            traceback.print_exc()
            raise UserInputError(
                f"this scene cannot be had ({type(error).__name__}): see where the server was started"
            ) from error

    def _begin(self, drive: Drive) -> None:
        self._drive = drive
        self._scene_number += 1
        self._values = [None] * len(drive.robots)
        kept = round(KEPT_S / drive.period_s)
        self._moments = [deque(maxlen=kept) for _ in drive.robots]
        self._due_s = time.monotonic()
        self._publish()

    def _step(self) -> None:
        self._drive.step()
        self._step_times_s.append(time.monotonic())
        self._publish()
        for robot, scene, track in zip(self._drive.robots, self._scenes, self._moments, strict=True):
            track.append(_moment(robot, scene))

    def _headings(self) -> list[str]:
        return [
            robot.name if robot.driver.dial is None else f"{robot.name}  {robot.driver.dial.symbol} {robot.dialled:g}"
            for robot in self._drive.robots
        ]

    def _publish(self) -> None:
        drive, now_s = self._drive, time.monotonic()
        if now_s - self._values_s > _VALUES_PERIOD_S:
            self._values_s = now_s
            self._values = [value_view(robot) for robot in drive.robots]
        self._scenes = [robot.arena.scene() for robot in drive.robots]
        views = tuple(map(robot_view, drive.robots, self._scenes, self._values))
        times = self._step_times_s
        span_s = now_s - times[0] if times else 0.0
        self.newest = View(
            number=1 if self.newest is None else self.newest.number + 1,
            scene_number=self._scene_number,
            choice=drive.choice,
            num_orders=self._num_done,
            map=drive.robots[0].arena.map,
            glass=drive.robots[0].arena.glass,
            robots=views,
            running=self._running,
            speed=self._speed,
            message=self._message,
            steps_per_s=len(drive.robots) * (len(times) - 1) / span_s if span_s > 0.0 else 0.0,
        )


def _moment(robot: Robot, scene: Scene) -> Moment:
    command = robot.command
    return Moment(
        scene=scene,
        beta=robot.dialled,
        speed_m_per_s=robot.trail[-1][2],
        collisions=robot.collisions,
        goals=robot.goals,
        quantiles=None if command is None else command.quantiles,
    )
