"""The jobs of a sweep from its command line: what is meant for the sweep, what for its runs, which runs that makes."""

import re
from collections.abc import Iterable, Iterator
from pathlib import Path

from omegaconf import DictConfig

from rcdsac_trl.config.algo_settings import AlgoSettings
from rcdsac_trl.config.command_line import key_of
from rcdsac_trl.config.compose import combinations, compose, parse, sweep_folder
from rcdsac_trl.config.experiment_settings import ExperimentSettings
from rcdsac_trl.config.run_config import plain, settings_of_new_run
from rcdsac_trl.config.training_settings import TrainingSettings
from rcdsac_trl.config.typed import read
from rcdsac_trl.errors import UserInputError
from rcdsac_trl.experiments.launchers import read_launcher
from rcdsac_trl.experiments.sweep import Job, Sweep
from rcdsac_trl.training.resume import differing_keys

CONFIG = "sweep"
_GROUPS = ("experiment", "launcher")
_FOLDER = "hydra.sweep.dir"
# What every name of a run says by itself.
_NAMED = ("algo", "sensor", "seed")


def is_meant_for_a_sweep(override: str) -> bool:
    """Whether an override chooses runs, or where they run, and not what one of them does."""
    key = key_of(override)
    return key == _FOLDER or key.split(".")[0] in _GROUPS


def check_single(overrides: Iterable[str]) -> None:
    """Refuse what only a sweep understands where one run is asked for.

    Raises:
        UserInputError: naming it.
    """
    for override in overrides:
        if is_meant_for_a_sweep(override):
            raise UserInputError(f"{override} is about several runs: add -m, or leave it out")


def make_sweep(overrides: list[str]) -> Sweep:
    """Make the sweep that a call of ``train -m`` asks for; checks all of its runs and writes nothing.

    Args:
        overrides: of the command line.

    Raises:
        UserInputError: for whatever cannot work, in any of the runs.
    """
    own = [_without_plus(override) for override in overrides if is_meant_for_a_sweep(override)]
    given = [override for override in overrides if not is_meant_for_a_sweep(override)]
    for override in given:
        if re.match(r"hydra\b", key_of(override)):
            raise UserInputError(f"{override} has no effect on a sweep: leave it out, and choose launcher=<name>")
        if key_of(override) == "resume":
            raise UserInputError(
                f"{override} continues one run: leave -m out; a sweep goes on when its call is repeated with its "
                f"{_FOLDER}"
            )
    values = plain(compose(CONFIG, own))
    experiment = read(ExperimentSettings, values["experiment"], "experiment")
    launcher = read_launcher(values["launcher"])
    # As composed once: its default name is the time.
    folder = sweep_folder(CONFIG, [*own, f"experiment.name='{experiment.name}'"]).absolute()
    found = _one_seed_first(_jobs(experiment, given, folder))
    jobs = [job for job, _ in found]
    _check_names(jobs)

    from rcdsac_trl.training.machine_check import check_machine  # late: whatever needs no torch is told by then

    for _, trained in found:
        check_machine(trained)
    return Sweep(folder, experiment.name, jobs, launcher)


def _one_seed_first(jobs: Iterable[tuple[Job, TrainingSettings]]) -> list[tuple[Job, TrainingSettings]]:
    """Let every run have its first seed before any has its second: what breaks off has a whole table the sooner."""
    found = list(jobs)
    seeds = list(dict.fromkeys(job.seed for job, _ in found))
    return sorted(found, key=lambda entry: seeds.index(entry[0].seed))


def _jobs(experiment: ExperimentSettings, given: list[str], folder: Path) -> Iterator[tuple[Job, TrainingSettings]]:
    """Yield the jobs of an experiment, changed by the overrides of the command line, and what each trains with."""
    if experiment.only is not None and (unknown := set(experiment.only) - experiment.runs.keys()):
        raise UserInputError(
            f"experiment.only={sorted(unknown)[0]} is no run of the experiment: choose among "
            f"{', '.join(experiment.runs) or 'none, it has no named runs'}"
        )
    if not experiment.runs:
        yield from _combined(experiment, None, _merged(experiment.every, given), folder)
    for name, own in experiment.runs.items():
        if experiment.only is not None and name not in experiment.only:
            continue
        _check_not_contradicted(name, own, given)
        yield from _combined(experiment, name, _merged(experiment.every, own, given), folder)


def _check_not_contradicted(name: str, own: Iterable[str], given: Iterable[str]) -> None:
    makes = {key_of(override): override for override in own}
    for override in given:
        if key_of(override) in makes:
            raise UserInputError(
                f"{override} contradicts {makes[key_of(override)]}, which makes the run {name} what it is: leave it "
                "out, or choose other runs with experiment.only=[<name>]"
            )


def _merged(*layers: Iterable[str]) -> list[str]:
    """Let later overrides take the place of earlier ones of the same key."""
    found: dict[str, str] = {}
    for layer in layers:
        for override in layer:
            found[key_of(override)] = override
    return list(found.values())


def _combined(
    experiment: ExperimentSettings, run: str | None, overrides: list[str], folder: Path
) -> Iterator[tuple[Job, TrainingSettings]]:
    varied = {key_of(o.input_line or "") for o in parse(overrides) if o.is_sweep_override()}
    for combination in combinations(overrides):
        cfg = compose("train", combination)
        settings = settings_of_new_run(cfg)
        name = _name(run, cfg, [o for o in combination if key_of(o) in varied and key_of(o) not in _NAMED])
        if differing := differing_keys(folder / name, cfg):
            raise UserInputError(
                f"{folder / name} holds a run of another config ({', '.join(differing[:3])}): choose another {_FOLDER}"
            )
        job = Job(
            name=name,
            run=run,
            algo=cfg.algo.name,
            sensor=cfg.sensor.name,
            seed=cfg.seed,
            overrides=tuple(combination),
            evaluate=_evaluate(experiment, settings.algo),
            folder=folder / name,
        )
        yield job, settings


def _name(run: str | None, cfg: DictConfig, varied: Iterable[str]) -> str:
    """Name a job's folder by what tells it from others; stays the same when an experiment gets further runs."""
    algo = cfg.algo.name
    named = [] if run is None else [run]
    if run is None or not run.startswith(algo):
        named.append(algo)
    words = [*named, cfg.sensor.name, f"s{cfg.seed}"]
    for override in varied:
        key, _, value = override.lstrip("+").partition("=")
        words.insert(-1, f"{key.split('.')[-1]}_{value}")
    return re.sub(r"[^\w.+-]+", "_", "-".join(words))


def _check_names(jobs: Iterable[Job]) -> None:
    seen: dict[str, Job] = {}
    for job in jobs:
        if job.name in seen:
            raise UserInputError(
                f"two runs would share the folder {job.name} ({' '.join(seen[job.name].overrides)} and "
                f"{' '.join(job.overrides)}): leave one out"
            )
        seen[job.name] = job


def _evaluate(experiment: ExperimentSettings, algo: AlgoSettings) -> tuple[str, ...] | None:
    """Return the overrides of a job's `evaluate`; a risk-conditioned agent must be given its betas."""
    if experiment.evaluate is None:
        return None
    betas = algo.distortion.evaluation_betas if algo.conditioning == "per_episode" else ()
    contexts = [f"beta=[{','.join(f'{beta:g}' for beta in betas)}]"] if betas else []
    return tuple(_merged(contexts, experiment.evaluate))


def _without_plus(override: str) -> str:
    """Read +experiment=<name>, which looks like +algo=<name>, as experiment=<name>."""
    return override.lstrip("+") if key_of(override) in _GROUPS else override
