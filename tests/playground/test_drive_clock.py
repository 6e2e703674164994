"""The thread that drives: it does what it is told, goes on whatever nobody looks at, and ends."""

import threading
import time
from collections.abc import Callable, Iterator

import pytest
from scenes_to_play import offers

from rcdsac_trl.playground import drive_clock
from rcdsac_trl.playground.drive_clock import DriveClock, View
from rcdsac_trl.playground.offers import Offers
from rcdsac_trl.playground.scene_choice import SceneChoice

PATIENCE_S = 120.0
CHOICE = SceneChoice("rcdsac_pow-narrow")


def until(found: Callable[[], object]) -> None:
    """Wait for something that another thread does; how long it takes does not matter."""
    end_s = time.monotonic() + PATIENCE_S
    while not found():
        assert time.monotonic() < end_s
        time.sleep(0.005)


def newest(clock: DriveClock) -> View:
    assert clock.newest is not None
    return clock.newest


@pytest.fixture
def clock() -> Iterator[DriveClock]:
    clock = DriveClock(CHOICE, offers())
    clock.start()
    until(lambda: clock.newest is not None)
    yield clock
    clock.close(PATIENCE_S)
    assert not clock.alive


def pause(clock: DriveClock) -> View:
    clock.run(False)
    until(lambda: not newest(clock).running)
    return newest(clock)


def test_it_drives_by_itself_pauses_steps_and_goes_on(clock: DriveClock) -> None:
    until(lambda: newest(clock).robots[0].steps >= 3)
    paused = pause(clock)
    clock.step_once()
    until(lambda: newest(clock).robots[0].steps > paused.robots[0].steps)
    assert newest(clock).robots[0].steps == paused.robots[0].steps + 1
    assert not newest(clock).running
    clock.set_speed(4.0)
    clock.run(True)
    until(lambda: newest(clock).robots[0].steps >= paused.robots[0].steps + 5)
    assert newest(clock).speed == 4.0


def test_orders_reach_the_drive_and_what_is_wrong_with_one_is_told_until_the_next(clock: DriveClock) -> None:
    pause(clock)
    clock.tell(lambda drive: drive.set_beta(0, -2.0))
    until(lambda: newest(clock).choice.beta == -2.0)
    assert newest(clock).robots[0].dialled == -2.0
    assert newest(clock).message is None
    clock.tell(lambda drive: drive.set_beta(0, 3.0))
    until(lambda: newest(clock).message)
    assert "outside [-2, 0]" in str(newest(clock).message)
    assert newest(clock).robots[0].dialled == -2.0
    clock.step_once()
    until(lambda: newest(clock).message is None)


def test_beta_changes_the_curve_while_it_pauses(clock: DriveClock) -> None:
    until(lambda: newest(clock).robots[0].returns is not None)
    pause(clock)
    values = []
    for beta in (-2.0, 0.0):
        clock.tell(lambda drive, beta=beta: drive.set_beta(0, beta))
        until(lambda beta=beta: newest(clock).robots[0].dialled == beta)
        returns = newest(clock).robots[0].returns
        assert returns is not None
        values.append(returns)
    assert values[0].weights[0] > values[1].weights[0] == pytest.approx(1.0)
    assert values[0].value < values[1].value


def test_another_scene_is_opened_and_one_that_cannot_be_had_changes_nothing(clock: DriveClock) -> None:
    clock.open(lambda choice: SceneChoice("sac-narrow", seed=3, second="dwa"))
    until(lambda: len(newest(clock).robots) == 2)
    opened = newest(clock)
    assert [robot.name for robot in opened.robots] == ["sac-narrow", "dwa"]
    clock.open(lambda choice: SceneChoice("nobody"))
    until(lambda: newest(clock).message)
    assert newest(clock).choice == opened.choice
    assert newest(clock).scene_number == opened.scene_number


def test_choices_made_before_a_scene_is_shown_add_up(clock: DriveClock) -> None:
    number = pause(clock).scene_number
    clock.tell(lambda drive: drive.set_stop_zone(True))
    clock.open(lambda choice: choice.changed("agent", "sac-narrow"))
    clock.open(lambda choice: choice.changed("seed", 3))
    clock.open(SceneChoice.next_map)
    until(lambda: newest(clock).num_orders == clock.num_orders)
    assert newest(clock).choice == SceneChoice("sac-narrow", seed=4, stop=True)
    assert newest(clock).scene_number <= number + 3
    assert not clock.opening


def test_a_choice_that_cannot_be_had_is_settled_with_a_sentence(clock: DriveClock) -> None:
    stood = pause(clock)
    clock.open(lambda choice: choice.changed("seed", 1.5))
    until(lambda: newest(clock).num_orders == clock.num_orders)
    assert str(newest(clock).message).startswith("seed=1.5 is no whole number")
    assert newest(clock).choice == stood.choice


def test_a_fault_in_making_a_scene_leaves_the_one_before(
    clock: DriveClock, monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]
) -> None:
    pause(clock)

    def vanish(choice: SceneChoice, offers: Offers) -> None:
        raise FileNotFoundError

    monkeypatch.setattr(drive_clock, "Drive", vanish)
    clock.open(SceneChoice.next_map)
    until(lambda: newest(clock).message)
    assert newest(clock).message == "this scene cannot be had (FileNotFoundError): see where the server was started"
    assert "FileNotFoundError" in capfd.readouterr().err
    assert newest(clock).choice.seed == 0
    assert clock.alive


def test_many_orders_at_once_cost_one_view(clock: DriveClock) -> None:
    pause(clock)
    held = threading.Event()
    clock.tell(lambda drive: held.wait(PATIENCE_S) and None)
    for beta in (-2.0, -1.5, -0.5):
        clock.tell(lambda drive, beta=beta: drive.set_beta(0, beta))
    before = newest(clock).number
    held.set()
    until(lambda: newest(clock).num_orders == clock.num_orders)
    assert newest(clock).robots[0].dialled == -0.5
    assert newest(clock).number <= before + 2


def test_orders_without_end_put_no_step_off(clock: DriveClock) -> None:
    over = threading.Event()

    def again(drive: object) -> None:
        if not over.is_set():
            clock.tell(again)

    clock.tell(again)
    steps = newest(clock).robots[0].steps
    until(lambda: newest(clock).robots[0].steps >= steps + 3)
    over.set()


def test_the_moments_of_a_film_are_of_all_steps(clock: DriveClock) -> None:
    until(lambda: newest(clock).robots[0].steps >= 4)
    paused = pause(clock)
    taken: list[tuple] = []
    clock.with_moments(lambda *given: taken.append(given))
    until(lambda: taken)
    (tracks, headings, period_s) = taken[0]
    assert [len(track) for track in tracks] == [paused.robots[0].steps]
    assert headings == ["rcdsac_pow-narrow  β -1"]
    assert 0.12 <= period_s <= 0.16
    assert tracks[0][-1].scene.pose == paused.robots[0].pose


def test_a_first_scene_that_cannot_be_had_ends_it_with_a_sentence() -> None:
    clock = DriveClock(SceneChoice("nobody"), offers())
    clock.start()
    until(lambda: not clock.alive)
    assert clock.newest is None
    assert "no agent nobody is offered" in str(clock.refused)


def test_a_fault_ends_it_with_a_sentence(capfd: pytest.CaptureFixture[str]) -> None:
    clock = DriveClock(CHOICE, offers())
    clock.start()

    def fail(drive: object) -> None:
        raise ZeroDivisionError

    clock.tell(fail)
    until(lambda: not clock.alive)
    assert "the drive has failed (ZeroDivisionError)" in str(clock.refused)
    assert "ZeroDivisionError" in capfd.readouterr().err


def test_two_clocks_share_nothing() -> None:
    clocks = [DriveClock(CHOICE, offers()) for _ in range(2)]
    for clock in clocks:
        clock.start()
        until(lambda clock=clock: clock.newest is not None)
        pause(clock)
    clocks[0].tell(lambda drive: drive.set_beta(0, 0.0))
    until(lambda: newest(clocks[0]).choice.beta == 0.0)
    assert newest(clocks[1]).robots[0].dialled == -1.0
    for clock in clocks:
        clock.close(PATIENCE_S)
