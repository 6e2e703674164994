"""Maps over processes: each driven once, and nobody left behind however it ends."""

import contextlib
import multiprocessing
import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from functools import partial
from pathlib import Path

import pytest
from endless_drive import endless

from rcdsac_trl.errors import FaultError, UserInputError
from rcdsac_trl.rollout.evaluation_pool import Drive, EvaluationPool, Rows, evaluate_maps
from rcdsac_trl.system import process_pool
from rcdsac_trl.system.process_pool import ProcessPool
from rcdsac_trl.system.processes import WorkerError, resolve_processes, resolve_processes_beside
from rcdsac_trl.training.machine_check import check_machine
from rcdsac_trl.world.task.env import make_env
from tiny import tiny_settings


@contextlib.contextmanager
def counting() -> Iterator[Drive]:
    yield lambda map_index, before_step: [{"map": map_index, "process": os.getpid()}]


@contextlib.contextmanager
def breaking() -> Iterator[Drive]:
    def drive(map_index: int, before_step: Callable[[], None]) -> Rows:
        os._exit(7)

    yield drive


@contextlib.contextmanager
def refusing(when: str) -> Iterator[Drive]:
    """Find that the input is wrong as the drive is made, or as it drives."""

    def drive(map_index: int, before_step: Callable[[], None]) -> Rows:
        raise UserInputError("there are no such maps: give others")

    if when == "made":
        drive(0, lambda: None)
    yield drive


def test_every_map_is_driven_once_and_by_a_process_of_its_own() -> None:
    rows = [row for rows in evaluate_maps(counting, 7, processes=2) for row in rows]
    assert sorted(row["map"] for row in rows) == list(range(7))
    assert os.getpid() not in {row["process"] for row in rows}
    assert list(evaluate_maps(counting, 2, processes=0)) == [[{"map": i, "process": os.getpid()}] for i in range(2)]


@pytest.fixture
def daemonic(monkeypatch: pytest.MonkeyPatch) -> None:
    """Make this process what a worker of `multiprocessing.Pool` is."""
    monkeypatch.setitem(multiprocessing.current_process()._config, "daemon", True)  # type: ignore[attr-defined]


@pytest.mark.usefixtures("daemonic")
def test_a_daemonic_process_is_told_what_to_do_where_it_cannot_start_others() -> None:
    asked: list[Callable[[], object]] = [
        lambda: list(evaluate_maps(counting, 2, processes=2)),
        lambda: make_env(num_agents=2, num_workers=2),
        lambda: check_machine(tiny_settings("sac", "collector.num_processes=2")),
        lambda: check_machine(tiny_settings("sac", "validation.processes=1")),
        lambda: check_machine(tiny_settings("sac", "collector=parallel_env", "world.num_workers=2")),
    ]
    for ask in asked:
        with pytest.raises(UserInputError, match=r"daemonic process.* may start no processes: use concurrent"):
            ask()
    assert len(list(evaluate_maps(counting, 2, processes=0))) == 2
    check_machine(tiny_settings("sac", "collector.num_processes=0", "validation.processes=0"))


def test_a_process_that_dies_ends_the_evaluation_and_leaves_none_behind() -> None:
    with pytest.raises(FaultError, match="exit code 7"):
        list(evaluate_maps(breaking, 4, processes=2))
    assert not multiprocessing.active_children()


@pytest.mark.parametrize("when", ["made", "driving"])
def test_wrong_input_that_a_process_finds_is_told_in_its_sentence_alone(
    monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str], when: str
) -> None:
    monkeypatch.setattr(process_pool, "START_METHOD", "fork")  # starts at once, and says what it says here
    with pytest.raises(UserInputError, match=r"^there are no such maps: give others$"):
        list(evaluate_maps(partial(refusing, when), 4, processes=2))
    assert capfd.readouterr().err == ""
    assert not multiprocessing.active_children()


def test_whoever_asks_a_process_that_has_found_its_input_wrong_is_told_that(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(process_pool, "START_METHOD", "fork")
    pool = ProcessPool([partial(refusing, "made")], ["it"], module="rcdsac_trl.errors", timeout_s=None)
    assert pool._connections[0].poll(None)  # it has said so
    for _ in range(2):
        pool.send(0, bytes(10_000_000))  # more than a pipe holds
    with pytest.raises(UserInputError, match="no such maps"):
        list(pool.answers(until_done=True))
    pool.close()


def test_processes_end_with_whoever_stops_asking() -> None:
    maps = evaluate_maps(counting, 1000, processes=2)
    next(maps)
    assert len(multiprocessing.active_children()) == 2
    maps.close()  # as on Ctrl-C
    assert not multiprocessing.active_children()


def test_whoever_does_not_wait_gets_what_there_is() -> None:
    drivers = EvaluationPool(counting, 5, processes=2, at_once=True)
    found: list[Rows] = []
    while len(found) < 5:
        before = time.monotonic()
        found.extend(drivers.receive(until_done=False))
        assert time.monotonic() - before < 60
    assert sorted(rows[0]["map"] for rows in found) == list(range(5))
    # Given out at the start: every other map is the other process's.
    by = {rows[0]["map"]: rows[0]["process"] for rows in found}
    assert by[0] == by[2] == by[4] != by[1] == by[3]
    assert list(drivers.receive(until_done=True)) == []
    drivers.close()
    assert not multiprocessing.active_children()


def wait_for(path: Path) -> int:
    """Wait until a process has written its number."""
    while not path.exists() or not path.read_text():
        time.sleep(0.01)
    return int(path.read_text())


def test_a_process_that_hangs_counts_as_dead(tmp_path: Path) -> None:
    drivers = EvaluationPool(partial(endless, tmp_path / "process"), 1, processes=1, timeout_s=0.5)
    process = wait_for(tmp_path / "process")
    os.kill(process, signal.SIGSTOP)
    with pytest.raises(WorkerError, match=r"driving process 1 of 1 made no step within 0\.5 s"):
        list(drivers.receive(until_done=True))
    drivers.close()
    with pytest.raises(ProcessLookupError):
        os.kill(process, 0)


def test_a_process_ends_by_itself_when_the_main_one_is_killed(tmp_path: Path) -> None:
    program = (
        "import sys, time\n"
        "from functools import partial\n"
        "from pathlib import Path\n"
        "from rcdsac_trl.rollout import evaluation_pool as drivers\n"
        "from endless_drive import endless\n"
        "drivers._PRELOADED = 'endless_drive'\n"
        "drivers.EvaluationPool(partial(endless, Path(sys.argv[1])), 1, processes=1)\n"
        "time.sleep(1000)\n"
    )
    path = os.pathsep.join([str(Path(__file__).parent), *sys.path])
    command = [sys.executable, "-c", program, str(tmp_path / "process")]
    main = subprocess.Popen(command, env=os.environ | {"PYTHONPATH": path})
    process = wait_for(tmp_path / "process")
    main.kill()
    main.wait()
    while Path(f"/proc/{process}").exists():  # else this test does not end
        time.sleep(0.01)


def test_training_leaves_a_core_to_validation(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("rcdsac_trl.system.processes.usable_cores", lambda: 4)
    assert [resolve_processes_beside("auto", 9, threads) for threads in (1, 2, 4)] == [3, 2, 1]
    assert resolve_processes_beside("auto", 2, threads=1) == 2
    assert [resolve_processes_beside(given, 3, threads=1) for given in (0, 1, 8)] == [0, 1, 3]
    monkeypatch.setattr("rcdsac_trl.system.processes.usable_cores", lambda: 1)
    assert resolve_processes_beside("auto", 9, threads=1) == 0


def test_no_more_processes_than_maps() -> None:
    assert [resolve_processes(n, 3) for n in (0, 1, 2, 8)] == [0, 0, 2, 3]
    for wrong in (-1, 1.5, "all"):
        with pytest.raises(UserInputError, match="is not a number of processes"):
            resolve_processes(wrong, 3)  # type: ignore[arg-type]
