"""Hydra's composition with a memory: conf/ does not change while tests run, and most of them ask for the same of it.

Hydra reads every file and puts every choice of files together anew, in each of a thousand compositions. Here it does so
once, and each composition begins with a copy. Overrides are read and applied by Hydra as ever.
"""

import pickle
from typing import Any

from hydra._internal import defaults_list
from hydra._internal.config_loader_impl import ConfigLoaderImpl
from hydra._internal.config_repository import CachingConfigRepository
from hydra.core.default_element import InputDefault, ResultDefault
from hydra.plugins.config_source import ConfigResult
from omegaconf import DictConfig

_read: dict[Any, ConfigResult | None] = {}
_put_together: dict[Any, bytes] = {}


def remember_compositions() -> None:
    """Let all later compositions of this process share what they begin with."""
    read = CachingConfigRepository.load_config
    put_together = ConfigLoaderImpl._compose_config_from_defaults_list
    choices = defaults_list._create_interpolation_map

    def load_config(self: CachingConfigRepository, config_path: str) -> ConfigResult | None:
        """Read a file; what looks for defaults only looks at it."""
        if (places := _places(self)) is None:
            return read(self, config_path)
        key = (places, config_path)
        if key not in _read:
            _read[key] = self.delegate.load_config(config_path=config_path)
        return _read[key]

    def compose(self: ConfigLoaderImpl, defaults: list[ResultDefault], repo: CachingConfigRepository) -> DictConfig:
        if (places := _places(repo)) is None:
            return put_together(self, defaults, repo)
        key = (places, *(tuple(vars(default).items()) for default in defaults))
        if key not in _put_together:
            # From the files themselves: sections are moved, not copied, into what is made of them.
            _put_together[key] = pickle.dumps(put_together(self, defaults, repo.delegate))
        copy: DictConfig = pickle.loads(_put_together[key])
        return copy

    def choices_if_asked_for(overrides: Any, defaults: list[InputDefault], self_added: bool) -> DictConfig | None:
        """Leave out what only defaults that are named by a choice are told: it took as long as all else of them."""
        asked = any(default.is_interpolation() for default in defaults)
        return choices(overrides, defaults, self_added) if asked else None

    CachingConfigRepository.load_config = load_config  # type: ignore[method-assign]
    ConfigLoaderImpl._compose_config_from_defaults_list = compose  # type: ignore[method-assign, assignment]
    defaults_list._create_interpolation_map = choices_if_asked_for


def _places(repo: CachingConfigRepository) -> tuple[str, ...] | None:
    """Return where Hydra looks; None if in a folder of the test's own, too, whose files may change."""
    sources = repo.get_sources()
    own = any(source.provider.startswith("hydra.searchpath") for source in sources)
    return None if own else tuple(source.full_path() for source in sources)
