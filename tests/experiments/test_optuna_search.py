"""The search: trials are worth what their validations say, bad ones are pruned, and a killed search goes on."""

import fcntl
import importlib.util
from collections.abc import Callable
from pathlib import Path

import pandas as pd
import pytest

from rcdsac_trl.errors import UserInputError
from rcdsac_trl.experiments import optuna_search as search
from rcdsac_trl.experiments.optuna_search import Search, make_search
from rcdsac_trl.experiments.search_space import Choice, Number
from rcdsac_trl.experiments.sweep import Job, State
from rcdsac_trl.system.invocation import program
from tiny import SMALL, Calls

pytest.importorskip("optuna")

ASKED = ["+algo=sac", "space=none", "learner.gamma=interval(0.5,0.9)", "search.name=mine"]
ASKED += ["search.collision_cost=10", "search.startup_trials=2", "search.warmup_iterations=1"]


def write(folder: Path, validations: list[tuple[float, float]]) -> None:
    """Write a validation table: two episodes a validation, whose mean reward and collisions are given."""
    rows = [
        {"iteration": n, "updates": n, "beta": None, "reward": reward + off, "collisions": collisions + off / 10}
        for n, (reward, collisions) in enumerate(validations)
        for off in (-5.0, 5.0)
    ]
    folder.mkdir(parents=True, exist_ok=True)
    pd.DataFrame(rows).to_csv(folder / "validation_episodes.csv", index=False)


@pytest.fixture
def trained(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> Callable:
    """Replace training by a list of what each trial in turn is to do; return the jobs that were run."""
    monkeypatch.chdir(tmp_path)

    def plan(*trials: object) -> list[Job]:
        left, jobs = list(trials), []

        def execute(job: Job, should_stop: Callable[[], bool]) -> State:
            jobs.append(job)
            what = left.pop(0)
            if isinstance(what, State):
                return what
            if callable(what):
                what()
                return State("interrupted")
            assert isinstance(what, list)
            for done in range(1, len(what) + 1):
                write(job.folder, what[:done])
                if should_stop():
                    return State("stopped")
            return State("finished")

        monkeypatch.setattr(search, "execute", execute)
        return jobs

    return plan


def made(*overrides: str) -> Search:
    return make_search([*ASKED, *overrides])


GOOD = [(100.0, 1.0), (200.0, 2.0), (300.0, 1.0)]


def test_a_trial_is_worth_the_mean_of_its_last_validations(trained: Callable, capsys: pytest.CaptureFixture) -> None:
    jobs = trained(GOOD, [(0.0, 0.0), (50.0, 1.0), (70.0, 0.0)], State("failed", "exit code 1: nan"))
    mine = made("search.trials=3")
    mine.run()
    assert [job.name for job in jobs] == ["trial-0000", "trial-0001", "trial-0002"]
    assert [job.overrides[0] for job in jobs] == ["+algo=sac"] * 3
    gammas = [float(job.overrides[-1].removeprefix("learner.gamma=")) for job in jobs]
    assert len(set(gammas)) == 3
    assert all(0.5 <= gamma <= 0.9 for gamma in gammas)
    # (200 - 20 + 300 - 10) / 2 and (50 - 10 + 70) / 2
    assert [trial.value for trial in mine.study.trials] == [235.0, 55.0, None]
    assert mine.study.trials[0].intermediate_values == {1: 90.0, 2: 180.0, 3: 290.0}
    out = capsys.readouterr().out.splitlines()
    assert out[0] == f"1/3 finished 235.0 trial-0000: learner.gamma={gammas[0]}"
    assert out[2] == f"3/3 failed trial-0002: learner.gamma={gammas[2]} (exit code 1: nan)"
    assert out[-2] == "best 235.0 multirun/search-mine/trial-0000"
    assert out[-1] == f"{program()} train +algo=sac learner.gamma={gammas[0]}"
    assert len(pd.read_csv("multirun/search-mine/trials.csv")) == 3


def test_what_is_worse_than_the_median_is_pruned_once_it_has_warmed_up(trained: Callable) -> None:
    bad = [(0.0, 0.0), (0.0, 0.0), (1000.0, 0.0)]
    trained(GOOD, GOOD, GOOD, bad, GOOD)
    mine = made("search.trials=5")
    mine.run()
    assert [trial.state.name for trial in mine.study.trials] == ["COMPLETE"] * 3 + ["PRUNED", "COMPLETE"]
    assert mine.study.trials[3].intermediate_values == {1: 0.0, 2: 0.0}  # not after the first: that is the warm-up


def test_collisions_alone_can_prune(trained: Callable) -> None:
    many = [(100.0, 1.0), (200.0, 12.0), (300.0, 1.0)]
    trained(GOOD, GOOD, GOOD, many)
    mine = made("search.trials=4")
    mine.run()
    assert mine.study.trials[3].state.name == "PRUNED"


def test_a_killed_search_goes_on_with_the_trial_that_was_lost(trained: Callable) -> None:
    jobs = trained(GOOD, State("interrupted"))
    with pytest.raises(KeyboardInterrupt):
        made("search.trials=3").run()
    more = trained(GOOD, GOOD)
    again = made("search.trials=3")
    again.run()
    assert [job.name for job in more] == ["trial-0001", "trial-0003"]  # number 2 is 1 once more
    assert more[0].overrides == jobs[1].overrides
    assert more[1].overrides not in [job.overrides for job in jobs]
    assert sorted(again._done()) == ["trial-0000", "trial-0001", "trial-0003"]
    trained()
    made("search.trials=3").run()  # nothing is left to do


@pytest.mark.parametrize(
    ("changed", "told"),
    [
        (["learner.batch_size=8"], r"has trials with learner\.batch_size not given, and now it is 8: ask for the same"),
        (
            ["learner.gamma=interval(0.1,0.9)"],
            r"learner\.gamma interval\(0\.5,0\.9\), and now it is interval\(0\.1,0\.9\)",
        ),
        (["learner.gamma=choice(0.5,0.9)"], r"now it is choice\(0\.5,0\.9\)"),
        (["search.collision_cost=20"], r"search\.collision_cost 10, and now it is 20"),
    ],
)
def test_a_search_does_not_go_on_as_another_one(trained: Callable, changed: list[str], told: str) -> None:
    jobs = trained(GOOD, GOOD)
    made("search.trials=1").run()
    with pytest.raises(UserInputError, match=told):
        made("search.trials=2", *changed).run()
    assert len(jobs) == 1
    made("search.trials=2", "search.startup_trials=1").run()  # which changes no trial's worth
    assert len(jobs) == 2


def test_searches_side_by_side_propose_different_trials(trained: Callable) -> None:
    trained()
    one, other = made(), made()
    assert not one.study.trials
    assert not other.study.trials
    asked = [search._ask() for search in (one, other, one, other)]
    gammas = [trial.suggest_float("learner.gamma", 0.5, 0.9) for trial in asked]
    assert [trial.number for trial in asked] == [0, 1, 2, 3]
    assert len(set(gammas)) == 4


def test_a_search_whose_journal_was_cut_goes_on(trained: Callable, capsys: pytest.CaptureFixture) -> None:
    """The disk filled up while the first trial's end was written: that trial is taken up again."""
    jobs = trained(GOOD)
    made("search.trials=1").run()
    journal = Path("multirun/search-mine/optuna.journal")
    journal.write_bytes(journal.read_bytes()[:-30])
    more = trained(GOOD, GOOD)
    again = made("search.trials=2")
    again.run()
    assert f"the last line of {journal.absolute()} was cut" in capsys.readouterr().err
    assert [job.name for job in more] == ["trial-0000", "trial-0002"]
    assert more[0].overrides == jobs[0].overrides
    assert [trial.state.name for trial in again.study.trials] == ["FAIL", "COMPLETE", "COMPLETE"]


def test_a_row_that_is_being_written_is_worth_nothing_yet(trained: Callable, tmp_path: Path) -> None:
    write(tmp_path, GOOD)
    table = tmp_path / "validation_episodes.csv"
    whole = table.read_bytes()
    table.write_bytes(whole + b"3,3,,1")  # 1000.0 to be
    assert made()._values(tmp_path) == {1: 90.0, 2: 180.0, 3: 290.0}
    table.write_bytes(whole[:8])
    assert made()._values(tmp_path) == {}


def test_a_trial_whose_search_lives_is_nobody_elses(trained: Callable) -> None:
    """From its first moment on: the training that it starts takes its own lock only seconds later."""
    others: list[str] = []

    def look() -> None:
        other = made("search.trials=9")
        other._take_up_what_was_lost()
        others.extend(trial.state.name for trial in other.study.trials)

    trained(look)
    with pytest.raises(KeyboardInterrupt):
        made("search.trials=1").run()
    assert others == ["RUNNING"]
    look()
    assert others[1:] == ["FAIL", "WAITING"]
    look()
    assert others[3:] == ["FAIL", "WAITING"]


def test_a_search_that_was_killed_between_two_lines_starts_no_trial_twice(trained: Callable) -> None:
    trained(State("interrupted"))
    with pytest.raises(KeyboardInterrupt):
        made("search.trials=1").run()
    made("search.trials=1")._take_up_what_was_lost()
    journal = Path("multirun/search-mine/optuna.journal")
    *before, last = journal.read_bytes().splitlines(keepends=True)
    assert b'"state":3' in last  # that the lost one has failed
    journal.write_bytes(b"".join(before))
    jobs = trained(GOOD)
    again = made("search.trials=1")
    again.run()
    assert [job.name for job in jobs] == ["trial-0000"]
    assert [trial.state.name for trial in again.study.trials] == ["FAIL", "COMPLETE"]


def test_storage_may_be_a_database(trained: Callable) -> None:
    trained(GOOD)
    made("search.trials=1", "search.storage='sqlite:///all.db'").run()
    trained(GOOD)
    again = made("search.trials=2", "search.storage='sqlite:///all.db'")
    again.run()
    assert len(again.study.trials) == 2
    again.study._storage.remove_session()


def test_a_trial_in_another_folder_is_not_lost(
    trained: Callable, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    """Another node, with a disk of its own: only the storage is common."""
    shared = f"search.storage='sqlite:///{tmp_path / 'all.db'}'"
    seen: list[str] = []

    def look() -> None:
        (tmp_path / "elsewhere").mkdir()
        monkeypatch.chdir(tmp_path / "elsewhere")
        other = made("search.trials=9", shared)
        other._take_up_what_was_lost()
        seen.extend(trial.state.name for trial in other.study.trials)
        other.study._storage.remove_session()
        monkeypatch.chdir(tmp_path)

    trained(look)
    mine = made("search.trials=1", shared)
    with pytest.raises(KeyboardInterrupt):
        mine.run()
    assert seen == ["RUNNING"]
    mine._take_up_what_was_lost()
    assert [trial.state.name for trial in mine.study.trials] == ["FAIL", "WAITING"]
    mine.study._storage.remove_session()


def test_no_search_looks_while_another_takes_a_trial(trained: Callable, monkeypatch: pytest.MonkeyPatch) -> None:
    """A trial that was lost is running as soon as it is asked for, and held only then."""
    trained(State("interrupted"))
    with pytest.raises(KeyboardInterrupt):
        made("search.trials=1").run()
    ask, waits = Search._ask, []

    def asking(mine: Search) -> object:
        trial = ask(mine)
        with (mine.folder / "turn.lock").open("a") as file, pytest.raises(BlockingIOError):
            fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        waits.append(trial.user_attrs["folder"])
        return trial

    monkeypatch.setattr(Search, "_ask", asking)
    trained(GOOD)
    made("search.trials=1").run()
    assert waits == ["trial-0000"]


def test_three_real_trials_and_a_restart(calls: Calls, tmp_path: Path) -> None:
    asked = [*ASKED, *SMALL, "search.averaged_validations=1"]
    make_search([*asked, "search.trials=2"]).run()
    make_search([*asked, "search.trials=3"]).run()
    names = [f"trial-000{n}" for n in range(3)]
    assert calls == [("train", name) for name in names]
    folder = tmp_path / "multirun" / "search-mine"
    for name, trial in zip(names, make_search([*asked, "search.trials=3"]).study.trials, strict=True):
        rows = pd.read_csv(folder / name / "validation_episodes.csv")
        assert trial.value == pytest.approx((rows["reward"] - 10 * rows["collisions"]).mean())
        assert f"gamma: {trial.params['learner.gamma']}" in (folder / name / "config.yaml").read_text()


# ------------------------------------------------------------------------------------------------ what is searched
def test_what_the_command_line_can_say() -> None:
    made = make_search(
        [
            "+algo=sac",
            "space=none",
            "seed=3",
            "learner.gamma=interval(0.5,0.9)",
            "learner.actor_lr=tag(log,interval(1e-4,1e-2))",
            "learner.batch_size=int(interval(8,64))",
            "learner.burn_in=range(0,3)",
            "learner.sequence_length=choice(8,16)",
            "sensor=narrow,sparse",
        ]
    )
    assert made.searched == {
        "learner.gamma": Number(0.5, 0.9),
        "learner.actor_lr": Number(1e-4, 1e-2, log=True),
        "learner.batch_size": Number(8, 64),
        "learner.burn_in": Choice(("0", "1", "2")),
        "learner.sequence_length": Choice(("8", "16")),
        "sensor": Choice(("narrow", "sparse")),
    }
    assert isinstance(made.searched["learner.batch_size"].low, int)
    assert made.trial.overrides == ("+algo=sac", "seed=3")


def test_the_command_line_takes_the_place_of_the_space() -> None:
    made = make_search(["+algo=sac", "learner.actor_lr=1e-3", "learner.batch_size=choice(2,4)"])
    assert "learner.actor_lr" not in made.searched
    assert made.searched["learner.batch_size"] == Choice(("2", "4"))
    assert "learner.critic_lr" in made.searched


@pytest.mark.parametrize(
    ("overrides", "sentence"),
    [
        (["+algo=sac", "space=none"], "nothing is searched: choose space=<name>, or give a key a value such as interv"),
        (["space=learner"], "no algorithm chosen"),
        (["+algo=sac", "space=all"], "space=all does not exist: choose one of learner, none"),
        (["+algo=sac", "search.trials=0"], "search.trials=0 must be at least 1"),
        (["+algo=sac", "search.collision_cost=-1"], "search.collision_cost=-1 must be at least 0"),
        (["+algo=sac", "search.trails=3"], "there is no key search.trails: did you mean search.trials?"),
        (["+algo=sac", "learner.gamma=interval(0.5,2)"], "learner.gamma=2.0 is outside [0, 1)"),
        (["+algo=sac", "learner.gamma=interval(0.9,0.5)"], "interval(0.9,0.5) is no range: give the smaller value fir"),
        (["+algo=sac", "learner.gamma=tag(log,interval(0,1))"], "interval(0,1) has no logarithm: begin above 0"),
        (["+algo=sac", "resume=auto"], "resume=auto has no effect on a search: leave it out"),
        (["+algo=sac", "hydra.run.dir=x"], "hydra.run.dir=x has no effect on a search: leave it out"),
    ],
)
def test_what_cannot_be_searched_is_refused(overrides: list[str], sentence: str) -> None:
    with pytest.raises(UserInputError) as caught:
        make_search(overrides)
    assert str(caught.value).startswith(sentence)


def test_a_missing_optuna_is_named_with_what_installs_it(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(importlib.util, "find_spec", lambda name: None)
    with pytest.raises(UserInputError) as caught:
        made()
    assert str(caught.value) == "search needs optuna, which is not installed: pip install 'rcdsac-trl[search]'"
