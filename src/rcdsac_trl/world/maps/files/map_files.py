"""Which files hold maps, and whether they are still what they were."""

import hashlib
import re
from collections.abc import Sequence
from pathlib import Path

from rcdsac_trl.errors import UserInputError
from rcdsac_trl.world.maps.files.map_server import image_of

SUFFIXES = (".yaml", ".yml", ".map", ".world", ".sdf", ".json")
"""How the names of files end that maps are read from."""


def map_files(path: str | Sequence[str] | None) -> list[Path]:
    """Return the files that ``map.path`` names; those of a folder in the order of their names, numbers by their value.

    Raises:
        UserInputError: there is none, or one of another kind.
    """
    files: list[Path] = []
    for name in [path] if isinstance(path, str) else path or ():
        if Path(name).is_dir():
            of_folder = [file for file in Path(name).iterdir() if file.suffix.lower() in SUFFIXES and file.is_file()]
            if not of_folder:
                raise UserInputError(f"map.path={name} is a folder without a map: one ends in {', '.join(SUFFIXES)}")
            files += sorted(of_folder, key=_by_numbers)
        elif not Path(name).is_file():
            seen = "" if Path(name).is_absolute() else f" in {Path.cwd()}"
            raise UserInputError(f"map.path={name} does not exist{seen}: name a file or a folder")
        elif Path(name).suffix.lower() not in SUFFIXES:
            hint = ": name the YAML file that belongs to it" if Path(name).suffix.lower() in (".pgm", ".png") else ""
            raise UserInputError(f"map.path={name} is no map, which ends in {', '.join(SUFFIXES)}{hint}")
        else:
            files.append(Path(name))
    return files


def _by_numbers(file: Path) -> list[tuple[int, str]]:
    return [(int(part), "") if part.isdigit() else (0, part) for part in re.split(r"(\d+)", file.name)]


def digests(files: Sequence[Path]) -> tuple[str, ...]:
    """Return a line for each file, and for the images that they name, as ``sha256sum`` prints it.

    Raises:
        UserInputError: a file cannot be read.
    """
    read: list[Path] = []
    for file in files:
        read += [file, image_of(file)] if file.suffix.lower() in (".yaml", ".yml") else [file]
    return tuple(f"{hashlib.sha256(file.read_bytes()).hexdigest()}  {file.as_posix()}" for file in read)


def check_digests(noted: Sequence[str] | None, files: Sequence[Path], *, all_of_them: bool = False) -> None:
    """Refuse files that are not what they were.

    Args:
        noted: what :func:`digests` returned then; None: nobody wants to know.
        files: some of those, or all.
        all_of_them: whether there may be no others.

    Raises:
        UserInputError: naming the file.
    """
    if noted is None:
        return
    now = digests(files)
    changed = [line for line in now if line not in noted]
    missing = [line for line in noted if line not in now] if all_of_them else []
    for line in [*changed, *missing]:
        digest, _, name = line.partition("  ")
        before = next((old.partition("  ")[0] for old in noted if old.partition("  ")[2] == name), None)
        was = "was not there" if before is None else f"had sha256 {before[:12]}.., and now has {digest[:12]}.."
        was = "was there, and now is not" if line in missing else was
        raise UserInputError(
            f"map.path: {name} {was}, since map.sha256 was noted: bring the old file back, or begin anew "
            "with map.sha256=null"
        )
