"""The environment's name in Gymnasium's registry, in whichever order the two are imported.

Nothing heavy is imported for it: who only drives a robot needs no Gymnasium, whose import takes longer than all else.
"""

import sys
from collections.abc import Sequence
from importlib.abc import MetaPathFinder
from importlib.machinery import ModuleSpec
from importlib.util import find_spec
from types import ModuleType

ENV_ID = "RCDSACNavigation-v0"
_GYMNASIUM = "gymnasium"


def register_with_gymnasium() -> None:
    """Register :data:`ENV_ID` where Gymnasium is imported already, else as soon as it is.

    Gymnasium 1 looks for no plug-ins by itself.
    """
    if _GYMNASIUM in sys.modules:
        _register(sys.modules[_GYMNASIUM])
    elif not any(isinstance(finder, _Register) for finder in sys.meta_path):
        sys.meta_path.insert(0, _Register())


def _register(gymnasium: ModuleType) -> None:
    if ENV_ID not in gymnasium.registry:
        gymnasium.register(ENV_ID, entry_point="rcdsac_trl.config.named_world:gymnasium_env")


class _Register(MetaPathFinder):
    """Finds Gymnasium as everybody else would, and registers the name when it has been loaded."""

    def find_spec(
        self, fullname: str, path: Sequence[str] | None, target: ModuleType | None = None
    ) -> ModuleSpec | None:
        if fullname != _GYMNASIUM:
            return None
        place = sys.meta_path.index(self)
        sys.meta_path.remove(self)  # while the others look
        spec = find_spec(fullname)
        sys.meta_path.insert(place, self)  # some only ask whether it is installed
        if spec is None or spec.loader is None:
            return spec
        load = spec.loader.exec_module

        def load_and_register(module: ModuleType) -> None:
            load(module)
            _register(module)
            sys.meta_path.remove(self)

        spec.loader.exec_module = load_and_register  # type: ignore[method-assign]
        return spec
