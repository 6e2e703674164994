"""A search from its command line: what is meant for it, what every trial trains, and what is searched."""

from pathlib import Path

from hydra.core.override_parser.types import ChoiceSweep, IntervalSweep, Override, RangeSweep
from omegaconf import OmegaConf

from rcdsac_trl.config.compose import compose, parse
from rcdsac_trl.config.experiment_settings import SearchSettings
from rcdsac_trl.config.typed import read
from rcdsac_trl.errors import UserInputError
from rcdsac_trl.experiments.optuna_search import Choice, Number, Search, Searched
from rcdsac_trl.experiments.sweep import Job
from rcdsac_trl.training.setup import check_training

CONFIG = "search"
_OWN = ("search", "space")


def make_search(overrides: list[str]) -> Search:
    """Make the search that a call asks for; checks two corners of what it may train, and writes nothing.

    Args:
        overrides: of the command line.

    Raises:
        UserInputError: for whatever cannot work.
    """
    own = [override for override in overrides if _is_own(override)]
    values = OmegaConf.to_container(compose(CONFIG, own), resolve=True)
    assert isinstance(values, dict)
    settings = read(SearchSettings, values["search"], "search")
    given = {_key(o): o for o in [*values["space"]["values"], *overrides] if o not in own}
    for key in given:
        if key == "resume" or key.startswith("hydra"):
            raise UserInputError(f"{given[key]} has no effect on a search: leave it out")
    searched = {o.get_key_element(): _searched(o) for o in parse(list(given.values())) if o.is_sweep_override()}
    if not searched:
        raise UserInputError("nothing is searched: choose space=<name>, or give a key a value such as interval(0,1)")
    fixed = [o for o in given.values() if not parse([o])[0].is_sweep_override()]
    for end in ("low", "high"):
        cfg = compose("train", [*fixed, *(f"{key}={getattr(kind, end)}" for key, kind in searched.items())])
        check_training(cfg)
    folder = Path("multirun") / f"search-{settings.name}"
    trial = Job("", None, cfg.algo.name, cfg.sensor.name, cfg.seed, tuple(fixed), evaluate=None, folder=folder)
    return Search(folder, settings, trial, searched)


def _searched(override: Override) -> Searched:
    value = override.value()
    if isinstance(value, IntervalSweep):
        assert value.start is not None
        assert value.end is not None
        return Number(value.start, value.end, log="log" in value.tags)
    if isinstance(value, RangeSweep):
        return Choice(tuple(str(number) for number in value.range()))
    assert isinstance(value, ChoiceSweep)
    return Choice(tuple(override.sweep_string_iterator()))


def _is_own(override: str) -> bool:
    return _key(override).split(".")[0] in _OWN


def _key(override: str) -> str:
    return override.lstrip("+~").partition("=")[0]
