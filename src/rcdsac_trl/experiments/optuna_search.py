"""A search for hyper-parameters with Optuna: TPE proposes, a training of its own tries, validation decides.

Hydra's own Optuna sweeper wants an Optuna that is years old, and knows nothing of a trial before it has ended. Here
Optuna is asked and told; a trial is a job as a sweep has them, and its validation table is read while it trains, so
that it can be pruned. Everything Optuna knows is in its storage: a search that was killed goes on with the trials that
were lost, from their checkpoints, and several processes may search together.
"""

import contextlib
import importlib.util
from collections.abc import Mapping
from dataclasses import replace
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING

from rcdsac_trl.config.command_line import key_of
from rcdsac_trl.config.compose import compose, parse
from rcdsac_trl.config.experiment_settings import SearchSettings
from rcdsac_trl.config.run_config import plain, settings_of_new_run
from rcdsac_trl.config.typed import read
from rcdsac_trl.errors import UserInputError
from rcdsac_trl.experiments.search_space import Searched, searched_in
from rcdsac_trl.experiments.sweep import Job, State, execute
from rcdsac_trl.seeding import torch_seed
from rcdsac_trl.storage.atomic import FolderLock
from rcdsac_trl.system.invocation import program
from rcdsac_trl.system.progress import Work, counted, never_silent
from rcdsac_trl.tables import read_growing

if TYPE_CHECKING:
    import optuna

CONFIG = "search"
_OWN = ("search", "space")
_FOLDER, _ASKED = "folder", "asked"
_TURN = "turn.lock"
_LOCK = "search.lock"  # held by the search whose trial it is: the training takes its own only seconds later
_WORTH = ("collision_cost", "averaged_validations")  # what a trial is worth depends on these
_SILENCE_S = 60.0  # a trial takes many minutes, and its own folder tells more
_NEIGHBOURS = 3  # trials that must have come as far before a median says anything


def make_search(overrides: list[str]) -> "Search":
    """Make the search that a call asks for; checks two corners of what it may train, and writes nothing.

    Args:
        overrides: of the command line.

    Raises:
        UserInputError: for whatever cannot work.
    """
    own = [override for override in overrides if key_of(override).split(".")[0] in _OWN]
    values = plain(compose(CONFIG, own))
    settings = read(SearchSettings, values["search"], "search")
    given = {key_of(o): o for o in [*values["space"]["values"], *overrides] if o not in own}
    for key in given:
        if key == "resume" or key.startswith("hydra"):
            raise UserInputError(f"{given[key]} has no effect on a search: leave it out")
    searched = {o.get_key_element(): searched_in(o) for o in parse(list(given.values())) if o.is_sweep_override()}
    if not searched:
        raise UserInputError("nothing is searched: choose space=<name>, or give a key a value such as interval(0,1)")
    fixed = [o for o in given.values() if not parse([o])[0].is_sweep_override()]
    corners = [[f"{key}={getattr(kind, end)}" for key, kind in searched.items()] for end in ("low", "high")]
    tried = [settings_of_new_run(compose("train", [*fixed, *corner])) for corner in corners]
    folder = Path("multirun") / f"search-{settings.name}"
    one = tried[-1]
    trial = Job("", None, one.algo.name, one.sensor.name, one.seed, tuple(fixed), evaluate=None, folder=folder)
    search = Search(folder, settings, trial, searched)

    from rcdsac_trl.training.machine_check import check_machine  # late: whatever needs no torch is told by then

    for trained in tried:
        check_machine(trained)
    return search


class Search:
    """Trials, and where they are.

    Args:
        folder: holds the trials' run folders, and Optuna's journal.
        settings: how to search.
        trial: what all trials have in common; each gets a name, a folder and further overrides.
        searched: the keys that are searched.

    Raises:
        UserInputError: if Optuna is not installed.
    """

    def __init__(self, folder: Path, settings: SearchSettings, trial: Job, searched: Mapping[str, Searched]) -> None:
        if importlib.util.find_spec("optuna") is None:
            raise UserInputError("search needs optuna, which is not installed: pip install 'rcdsac-trl[search]'")
        self.folder = folder
        self.settings = settings
        self.trial = trial
        self.searched = searched

    @cached_property
    def study(self) -> "optuna.Study":
        """Optuna's study, made or loaded."""
        import optuna

        from rcdsac_trl.experiments.journal import open_journal

        optuna.logging.set_verbosity(optuna.logging.WARNING)
        settings = self.settings
        self.folder.mkdir(parents=True, exist_ok=True)
        study = optuna.create_study(
            study_name=settings.name,
            storage=settings.storage or open_journal(self.folder / "optuna.journal"),
            direction="maximize",
            load_if_exists=True,
            pruner=optuna.pruners.MedianPruner(
                n_startup_trials=settings.startup_trials,
                n_warmup_steps=settings.warmup_iterations + 1,  # Optuna prunes at this step already
                n_min_trials=_NEIGHBOURS,
            ),
        )
        _check_same(study, self._asked)
        return study

    @property
    def _asked(self) -> dict[str, str]:
        """What trials of one study have in common, by key: what they train, where they differ, what they are worth."""
        fixed = {key_of(override): override.partition("=")[2] for override in self.trial.overrides}
        searched = {key: str(kind) for key, kind in self.searched.items()}
        return fixed | searched | {f"search.{key}": f"{getattr(self.settings, key):g}" for key in _WORTH}

    def _ask(self) -> "optuna.Trial":
        """Begin a trial whose proposals follow from its number: searches side by side propose different ones."""
        import optuna

        trial = self.study.ask()
        seed = torch_seed(self.settings.seed, "search", trial.number) % 2**32
        self.study.sampler = optuna.samplers.TPESampler(seed=seed, n_startup_trials=self.settings.startup_trials)
        return trial

    def run(self) -> None:
        """Try until there are as many trials as asked for; then tell the best one."""
        settings = self.settings
        left = max(0, settings.trials - len(self._done()))
        doing = (
            f"{counted(left, 'trial')}, each a training, in {self.folder}; search.name={settings.name} goes on there"
        )
        with never_silent(_SILENCE_S), Work(doing, left, "trial") as work:
            while (done := len(self._done())) < settings.trials:
                # One search of this folder chooses at a time: a trial is there before it is held.
                with contextlib.closing(FolderLock(self.folder, _TURN, wait=True)):
                    self._take_up_what_was_lost()
                    trial = self._ask()
                    claim = self._claim(trial)
                try:
                    state = self._try(trial)
                finally:
                    claim.close()
                value = self._tell(trial, state)
                print(f"{done + 1}/{settings.trials} {self._described(trial, state, value)}", flush=True)
                if state.name == "interrupted":
                    raise KeyboardInterrupt
                work.end_unit()
        self._conclude()

    def _claim(self, trial: "optuna.Trial") -> FolderLock:
        """Make the folder of a trial and hold it; what is not held is lost."""
        name = trial.user_attrs.get(_FOLDER, f"trial-{trial.number:04d}")
        folder = self.folder / name
        folder.mkdir(parents=True, exist_ok=True)
        lock = FolderLock(folder, _LOCK)
        if _FOLDER not in trial.user_attrs:
            trial.set_user_attr(_FOLDER, name)
        return lock

    def _done(self) -> set[str]:
        """Name the folders of the trials that need no more; a lost one shares its with the one that takes it up."""
        trials = [t for t in self.study.get_trials(deepcopy=False) if _FOLDER in t.user_attrs]
        open_ones = {t.user_attrs[_FOLDER] for t in trials if not t.state.is_finished()}
        return {t.user_attrs[_FOLDER] for t in trials} - open_ones

    def _take_up_what_was_lost(self) -> None:
        """Put trials whose process is gone in line again, to go on in their folders."""
        from optuna.trial import TrialState

        trials = self.study.get_trials(deepcopy=False, states=(TrialState.RUNNING, TrialState.WAITING))
        in_line = {trial.user_attrs.get(_FOLDER) for trial in trials if trial.state == TrialState.WAITING}
        for trial in trials:
            folder = trial.user_attrs.get(_FOLDER)
            if trial.state == TrialState.WAITING or folder is None or self._is_alive(self.folder / folder):
                continue
            if folder not in in_line:  # else whoever put it there was stopped before it could say so
                self.study.enqueue_trial(trial.params, user_attrs={_FOLDER: folder})
            self.study.tell(trial.number, state=TrialState.FAIL, skip_if_finished=True)

    @staticmethod
    def _is_alive(folder: Path) -> bool:
        if not folder.is_dir():
            return True  # for all that is known here: it is of a search in another folder, or on another disk
        try:
            for name in (_LOCK, "lock"):  # a training that lost its search ends with its checkpoint
                FolderLock(folder, name).close()
        except UserInputError:
            return True
        return False

    def _try(self, trial: "optuna.Trial") -> State:
        overrides = [f"{key}={kind.suggest(trial, key)}" for key, kind in self.searched.items()]
        name = trial.user_attrs[_FOLDER]
        job = replace(
            self.trial, name=name, folder=(self.folder / name).absolute(), overrides=(*self.trial.overrides, *overrides)
        )
        reported: set[int] = set()

        def is_hopeless() -> bool:
            for iteration, value in self._values(job.folder).items():
                if iteration not in reported:
                    reported.add(iteration)
                    trial.report(value, iteration)
            return bool(reported) and trial.should_prune()

        return execute(job, should_stop=is_hopeless)

    def _values(self, folder: Path) -> dict[int, float]:
        """Read what each validation of a run is worth, by iterations done."""
        try:
            rows = read_growing(folder / "validation_episodes.csv").dropna(subset=["collisions", "reward"])
        except (OSError, ValueError, KeyError):  # not there yet, or being written
            return {}
        worth = rows["reward"] - self.settings.collision_cost * rows["collisions"]
        means = worth.groupby(rows["iteration"] + 1).mean()
        return dict(zip(means.index.tolist(), means.tolist(), strict=True))

    def _tell(self, trial: "optuna.Trial", state: State) -> float | None:
        """Tell Optuna how a trial ended, unless it goes on later; return its value."""
        import optuna

        ends = {"stopped": optuna.trial.TrialState.PRUNED, "failed": optuna.trial.TrialState.FAIL}
        if state.name in ends:
            self.study.tell(trial, state=ends[state.name])
        if state.name != "finished":
            return None
        values = self._values(self.folder / trial.user_attrs[_FOLDER])
        last = [values[iteration] for iteration in sorted(values)][-self.settings.averaged_validations :]
        value = sum(last) / len(last)
        self.study.tell(trial, value)
        return value

    def _described(self, trial: "optuna.Trial", state: State, value: float | None) -> str:
        reason = f" ({state.sentence})" if state.sentence is not None else ""
        ended = "pruned" if state.name == "stopped" else state.name
        worth = "" if value is None else f" {value:.1f}"
        return f"{ended}{worth} {trial.user_attrs[_FOLDER]}: {self._as_overrides(trial.params)}{reason}"

    @staticmethod
    def _as_overrides(params: Mapping[str, object]) -> str:
        return " ".join(f"{key}={value}" for key, value in params.items())

    def _conclude(self) -> None:
        import optuna

        self.study.trials_dataframe().to_csv(self.folder / "trials.csv", index=False)
        print(f"trials: {self.folder / 'trials.csv'}")
        if not self.study.get_trials(deepcopy=False, states=(optuna.trial.TrialState.COMPLETE,)):
            print("no trial was finished")
            return
        best = self.study.best_trial
        print(f"best {best.value:.1f} {self.folder / best.user_attrs[_FOLDER]}")
        print(f"{program()} train {' '.join(self.trial.overrides)} {self._as_overrides(best.params)}")


def _check_same(study: "optuna.Study", asked: Mapping[str, str]) -> None:
    """Note in a new study what its trials have in common; refuse to go on with one whose trials have something else.

    Raises:
        UserInputError: naming the first key that differs.
    """
    noted = study.user_attrs.get(_ASKED)
    if noted is None:
        study.set_user_attr(_ASKED, dict(asked))
    elif differing := sorted(key for key in noted.keys() | asked.keys() if noted.get(key) != asked.get(key)):
        here, there = (values.get(differing[0], "not given") for values in (asked, noted))
        raise UserInputError(
            f"search.name={study.study_name} has trials with {differing[0]} {there}, and now it is {here}: ask for the "
            "same again, or give another search.name"
        )
