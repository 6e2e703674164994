"""Where the configuration lies: inside an installed package, or at the root of an editable checkout."""

from pathlib import Path


def _find_conf_dir() -> Path:
    package = Path(__file__).resolve().parents[1]
    # The wheel carries conf/ inside the package; a checkout keeps it beside src/, where people look for it.
    installed = package / "conf"
    return installed if installed.is_dir() else package.parents[1] / "conf"


CONF_DIR = _find_conf_dir()
"""The folder of the Hydra configuration; a string of it is what ``hydra.main(config_path=...)`` takes."""
