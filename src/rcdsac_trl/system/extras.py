"""Packages that only some choices need: the extras of ``pyproject.toml``."""

import importlib.util

from rcdsac_trl.errors import UserInputError


def needs(package: str, asked: str, *, extra: str, instead: str) -> None:
    """Refuse a choice whose package is missing.

    Args:
        package: what the choice imports.
        asked: the choice, as on the command line.
        extra: brings the package.
        instead: a choice that needs none.

    Raises:
        UserInputError: with the line that installs it.
    """
    if importlib.util.find_spec(package) is None:
        raise UserInputError(
            f"{asked} needs {package}, which is not installed: pip install 'rcdsac-trl[{extra}]', or use {instead}"
        )
