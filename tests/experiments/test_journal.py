"""The journal of a search: cut anywhere, left locked by the dead, and held by the living."""

import fcntl
import json
import os
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import IO, Any

import pytest

from rcdsac_trl.errors import FaultError, UserInputError

optuna = pytest.importorskip("optuna")

from rcdsac_trl.experiments import journal  # noqa: E402  needs Optuna
from rcdsac_trl.experiments.journal import JournalLock, open_journal  # noqa: E402

HERE = Path(__file__).parent


@pytest.fixture(autouse=True)
def _quiet() -> None:
    optuna.logging.set_verbosity(optuna.logging.WARNING)


def study(path: Path) -> Any:
    return optuna.create_study(study_name="mine", storage=open_journal(path), load_if_exists=True)


def add_trial(path: Path, value: float = 1.0) -> None:
    mine = study(path)
    trial = mine.ask()
    trial.suggest_float("x", 0.0, 1.0)
    mine.tell(trial, value)


def operations(path: Path) -> list[dict[str, Any]]:
    return [json.loads(line) for line in path.read_bytes().splitlines()]


# ------------------------------------------------------------------------------------------------ cut lines
def test_a_last_line_that_was_cut_is_dropped_wherever_it_was_cut(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path = tmp_path / "journal"
    add_trial(path, value=2.0)
    whole = path.read_bytes()
    *before, last = whole.splitlines(keepends=True)
    assert '"values":[2.0]' in last.decode()
    for kept in range(1, len(last)):
        path.write_bytes(b"".join(before) + last[:kept])
        mine = study(path)
        told = capsys.readouterr().err.splitlines()
        assert told == [
            f"rcdsac_trl: the last line of {path} was cut, as a full disk does it: its {kept} bytes are dropped, and "
            "the search goes on"
        ]
        assert operations(path)[: len(before)] == [json.loads(line) for line in before]
        assert [trial.state.name for trial in mine.trials] == ["RUNNING"]
        mine.tell(0, 3.0)
        assert [trial.value for trial in study(path).trials] == [3.0]
        assert capsys.readouterr().err == ""


def test_a_journal_of_which_the_first_line_was_cut_begins_anew(tmp_path: Path) -> None:
    path = tmp_path / "journal"
    for content in (b'{"op_code":0,"wor', b"\0" * 5000):  # the latter after a loss of power
        path.write_bytes(content)
        add_trial(path)
        assert len(study(path).trials) == 1
        path.unlink()


def test_a_line_that_was_cut_long_ago_is_named(tmp_path: Path) -> None:
    """As Optuna leaves it, which writes the next line behind what is left of one."""
    path = tmp_path / "journal"
    add_trial(path)
    lines = path.read_bytes().splitlines(keepends=True)
    path.write_bytes(b"".join(lines[:2]) + lines[2][:10] + b"".join(lines[3:]))
    with pytest.raises(UserInputError) as caught:
        study(path)
    assert str(caught.value).startswith(f"line 3 of {path} cannot be read (")
    assert str(caught.value).endswith(
        "): remove what follows line 2 to go on from there, or choose another search.name"
    )
    path.write_bytes(b"".join(lines[:2]))
    add_trial(path)


# ------------------------------------------------------------------------------------------------ locks
HOLD = """
import sys, time
from pathlib import Path
from rcdsac_trl.experiments.journal import JournalLock
lock = JournalLock(Path(sys.argv[1]))
lock.acquire()
print("held", flush=True)
time.sleep(1000)
"""


class Clock:
    """A clock that only sleeping moves on, and what happens when it shows a time."""

    def __init__(self) -> None:
        self.now = 0.0
        self.then: tuple[float, Callable[[], None]] | None = None

    def monotonic(self) -> float:
        return self.now

    def sleep(self, seconds: float) -> None:
        self.now += seconds
        if self.then is not None and self.now >= self.then[0]:
            self.then[1]()


@pytest.fixture
def clock(monkeypatch: pytest.MonkeyPatch) -> Clock:
    made = Clock()
    monkeypatch.setattr(journal, "time", made)
    return made


def held(path: Path) -> IO[bytes]:
    """Lock a journal as another process does: what counts is that the file was opened anew."""
    file = path.open("ab")
    fcntl.flock(file, fcntl.LOCK_EX)
    return file


def test_a_killed_process_leaves_no_lock(tmp_path: Path, clock: Clock) -> None:
    path = tmp_path / "journal"
    add_trial(path)
    with subprocess.Popen([sys.executable, "-c", HOLD, path], stdout=subprocess.PIPE) as process:
        try:
            assert process.stdout is not None
            assert process.stdout.readline() == b"held\n"
            with pytest.raises(FaultError):
                JournalLock(path).acquire()
        finally:
            process.kill()
    clock.now = 0.0
    add_trial(path)
    assert clock.now == 0.0  # nobody waited
    assert len(study(path).trials) == 2


def test_a_lock_that_an_earlier_version_left_is_none(
    tmp_path: Path, clock: Clock, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Optuna's own: a link to the journal's path, which leads nowhere from the folder it lies in."""
    monkeypatch.chdir(tmp_path)
    path = Path("multirun/optuna.journal")
    path.parent.mkdir()
    os.symlink(path, f"{path}.lock")
    assert not Path(f"{path}.lock").exists()
    add_trial(path)
    monkeypatch.chdir("/")  # a path is what it was when the journal was opened
    assert len(study(tmp_path / path).trials) == 1
    assert clock.now == 0.0


def test_a_lock_that_is_held_is_waited_for(tmp_path: Path, clock: Clock, capsys: pytest.CaptureFixture[str]) -> None:
    path = tmp_path / "journal"
    add_trial(path)
    with held(path) as file:
        clock.then = (20.0, file.close)
        add_trial(path)
    assert clock.now == pytest.approx(20.0, abs=0.02)
    told = capsys.readouterr().err.splitlines()
    assert told == [f"rcdsac_trl: waiting for {path}, which another process has locked"]
    assert len(study(path).trials) == 2


def test_a_lock_that_nobody_lets_go_of_is_named(tmp_path: Path, clock: Clock) -> None:
    path = tmp_path / "journal"
    add_trial(path)
    before = path.read_bytes()
    with held(path), pytest.raises(FaultError) as caught:
        study(path)
    assert str(caught.value) == (
        f"another process has locked {path} for 60 s: end it (`fuser` names it), then repeat the call, which goes on "
        "with this search"
    )
    assert clock.now == pytest.approx(60.0, abs=0.1)
    assert path.read_bytes() == before
    add_trial(path)  # whoever failed has not kept half of it


def test_a_disk_without_locks_is_named(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def none(*_: object) -> None:
        raise OSError(37, "No locks available")

    monkeypatch.setattr(fcntl, "flock", none)
    with pytest.raises(FaultError, match=r"journal cannot be locked \(No locks available\): search on another"):
        study(tmp_path / "journal")


WRITE = """
import sys
sys.path.insert(0, sys.argv[2])
from pathlib import Path
from test_journal import add_trial, optuna
optuna.logging.set_verbosity(optuna.logging.WARNING)
for _ in range(15):
    add_trial(Path(sys.argv[1]))
"""


def test_processes_that_search_together_lose_no_line(tmp_path: Path) -> None:
    path = tmp_path / "journal"
    started = [subprocess.Popen([sys.executable, "-c", WRITE, path, HERE]) for _ in range(2)]
    assert [process.wait() for process in started] == [0, 0]
    trials = study(path).trials
    assert [trial.number for trial in trials] == list(range(30))
    assert {trial.state.name for trial in trials} == {"COMPLETE"}
