"""Compiled functions where nothing can be written beside the package or at home: elsewhere, or compiled anew."""

import ast
import os
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import pytest

import rcdsac_trl

SOURCE = Path(rcdsac_trl.__file__).parent
KERNEL = """
from rcdsac_trl.system.jit import njit
@njit
def double(x):
    return 2.0 * x
"""
CALL = """
from kernel import double
print(double(1.5))
print(len(double.stats.cache_hits))
"""
NOWHERE = "import tempfile; tempfile.tempdir = '/dev/null/nowhere'\n"
KEPT_BESIDE = "numba can keep what it compiles neither beside the package nor in the user's cache folder"


@pytest.fixture(scope="module")
def installed(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A module beside which nothing can be written, not even by root: the place is taken."""
    site = tmp_path_factory.mktemp("site")
    (site / "kernel.py").write_text(KERNEL)
    (site / "__pycache__").write_text("")
    return site


@pytest.fixture
def run(installed: Path, tmp_path: Path) -> Callable[..., tuple[list[str], list[str]]]:
    """Run a program as a user without a home; return the lines it printed, and those of stderr."""
    temporary = tmp_path / "tmp"
    temporary.mkdir()

    def run(program: str, **variables: str) -> tuple[list[str], list[str]]:
        ours = ("NUMBA_CACHE_DIR", "XDG_CACHE_HOME", "RCDSAC_TRL_NO_NUMBA_CACHE")
        inherited = {name: value for name, value in os.environ.items() if name not in ours}
        changed = {
            "HOME": "/dev/null",
            "TMPDIR": str(temporary),
            "PYTHONPATH": f"{installed}:{SOURCE.parent}",
            **variables,
        }
        done = subprocess.run(
            [sys.executable, "-uc", program], env=inherited | changed, capture_output=True, text=True, check=True
        )
        return done.stdout.splitlines(), done.stderr.splitlines()

    return run


def test_a_user_without_a_home_gets_a_private_folder_that_the_next_process_reads(run: Callable, tmp_path: Path) -> None:
    folder = tmp_path / "tmp" / f"rcdsac_trl-numba-{os.getuid()}"
    first, told = run(CALL)
    assert told == [f"rcdsac_trl: {KEPT_BESIDE}: it goes to {folder}, set NUMBA_CACHE_DIR for another place"]
    assert folder.stat().st_mode & 0o777 == 0o700
    assert list(folder.rglob("*.nbi"))
    second, told = run(CALL)
    assert len(told) == 1
    assert (first, second) == (["3.0", "0"], ["3.0", "1"])


def test_the_users_own_folder_comes_first(run: Callable, tmp_path: Path) -> None:
    assert run(CALL, NUMBA_CACHE_DIR=str(tmp_path / "mine")) == (["3.0", "0"], [])
    assert list((tmp_path / "mine").rglob("*.nbi"))
    assert list((tmp_path / "tmp").iterdir()) == []
    # One that cannot be written is no reason to stop either.
    out, told = run(CALL, NUMBA_CACHE_DIR="/dev/null/mine")
    assert out == ["3.0", "0"]
    assert len(told) == 1


def test_without_any_folder_every_process_compiles_and_one_line_says_so(run: Callable) -> None:
    alone = f"{NOWHERE}{CALL}"
    out, told = run(f"{alone}\nimport subprocess, sys\nsubprocess.run([sys.executable, '-uc', {alone!r}])")
    assert out == ["3.0", "0"] * 2
    assert len(told) == 1
    assert told[0].startswith(f"rcdsac_trl: {KEPT_BESIDE}, and no temporary one is its own: every process compiles an")


def open_to_all(folder: Path) -> None:
    folder.mkdir()
    folder.chmod(0o777)


def a_link(folder: Path) -> None:
    (folder.parent / "elsewhere").mkdir(mode=0o700)
    folder.symlink_to("elsewhere")


def a_file(folder: Path) -> None:
    folder.write_text("")


@pytest.mark.parametrize("lay", [open_to_all, a_link, a_file])
def test_nothing_is_kept_where_others_could_put_code(run: Callable, tmp_path: Path, lay: Callable) -> None:
    lay(tmp_path / "tmp" / f"rcdsac_trl-numba-{os.getuid()}")
    out, told = run(CALL)
    assert out == ["3.0", "0"]
    assert len(told) == 1
    assert "every process compiles anew" in told[0]
    assert not list(tmp_path.rglob("*.nbi"))


def test_everything_is_compiled_that_way() -> None:
    for path in SOURCE.rglob("*.py"):
        nodes = ast.walk(ast.parse(path.read_text(encoding="utf-8")))
        used = {ast.unparse(node) for node in nodes if isinstance(node, ast.Attribute)}
        assert path.name == "jit.py" or not used & {"numba.njit", "numba.jit"}, path
