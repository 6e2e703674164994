"""Compiled functions: numba's, kept on the disk wherever there is a place for them.

numba keeps what it has compiled in ``NUMBA_CACHE_DIR``, beside the source file, or in the user's cache folder, and
raises where nothing can be written into any of them: a package that an administrator installed, a user without a home,
a container whose disk is read-only. Here such a process gets a private folder for temporary files, and where there is
none either, it compiles anew.
"""

import os
import stat
import sys
import tempfile
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

import numba

_config: Any = numba.config
_CHOSEN = "NUMBA_CACHE_DIR"
# Tells the processes that this one starts that there is no place at all, so that one line says so and not ten.
_NOWHERE = "RCDSAC_TRL_NO_NUMBA_CACHE"


def njit(function: Callable[..., Any] | None = None, /, **options: Any) -> Any:
    """Compile a function as ``numba.njit`` does, and keep the result for later processes if that is possible.

    Args:
        function: what to compile; None returns a decorator with the options.
        options: of ``numba.njit``, but ``cache``.

    Example:
        >>> @njit
        ... def double(x):
        ...     return 2.0 * x
        >>> double(1.5)
        3.0
    """
    if function is None:
        return partial(njit, **options)
    if function.__code__.co_filename.startswith("<"):  # typed in: no later process compiles that again
        return numba.njit(**options)(function)
    try:
        return numba.njit(cache=_NOWHERE not in os.environ, **options)(function)
    except RuntimeError as error:
        if "no locator" not in str(error):
            raise
    _look_elsewhere()
    return njit(function, **options)


def _look_elsewhere() -> None:
    """Choose a private folder for what is compiled, or none if that has been tried or there is none; and say so."""
    cannot = "numba can keep what it compiles neither beside the package nor in the user's cache folder"
    folder = _private_folder()
    if folder is not None and str(folder) != _config.CACHE_DIR:
        _config.CACHE_DIR = os.environ[_CHOSEN] = str(folder)
        told = f"{cannot}: it goes to {folder}, set {_CHOSEN} for another place"
    else:
        os.environ[_NOWHERE] = "1"
        told = f"{cannot}, and no temporary one is its own: every process compiles anew, set {_CHOSEN} to a folder"
    print(f"rcdsac_trl: {told}", file=sys.stderr)


def _private_folder() -> Path | None:
    """Return a folder that nobody else can write into, since what lies in it is run; None if there can be none."""
    try:
        folder = Path(tempfile.gettempdir()) / f"rcdsac_trl-numba-{os.getuid()}"
        folder.mkdir(mode=0o700, exist_ok=True)
        found = folder.lstat()
    except OSError:
        return None
    is_own = stat.S_ISDIR(found.st_mode) and found.st_uid == os.getuid() and not found.st_mode & 0o077
    return folder if is_own else None
