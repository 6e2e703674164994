"""What a container leaves a process: limits of Linux's control groups, version 1, version 2, and both side by side.

A process is in a group of each hierarchy (``/proc/self/cgroup``), at a path below where that is mounted
(``/proc/self/mountinfo``). A limit of any group above it binds it as well, so the least of them counts. What cannot be
read limits nothing. See ``cgroups(7)`` and the kernel's ``admin-guide/cgroup-v1`` and ``cgroup-v2``.
"""

import re
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path, PurePosixPath

SYSTEM = Path("/")
"""Where ``proc`` and ``sys`` are."""
# Version 1 says a number near the largest one where there is no limit.
_NO_LIMIT = 1 << 60


@dataclass(frozen=True)
class _Hierarchy:
    """A mounted tree of groups: of one controller or more (version 1), or of all others (version 2, no names)."""

    controllers: frozenset[str]
    root: PurePosixPath
    point: Path


def processor_quota(system: Path = SYSTEM) -> int | None:
    """Return how many cores' time this process may use at most, whole ones and at least 1; None without a limit."""
    quotas = []
    for is_unified, group in _groups("cpu", system):
        if is_unified:
            quota, _, period = _text(group / "cpu.max").partition(" ")
        else:
            quota, period = (_text(group / f"cpu.cfs_{name}_us") for name in ("quota", "period"))
        time_us, period_us = _number(quota), _number(period)
        if time_us is not None and time_us > 0 and period_us:
            quotas.append(max(1, time_us // period_us))
    return min(quotas, default=None)


def memory_room_bytes(system: Path = SYSTEM) -> int | None:
    """Return how much memory this process can still take within its groups' limits; None without a limit."""
    rooms = []
    for is_unified, group in _groups("memory", system):
        names = ("max", "current") if is_unified else ("limit_in_bytes", "usage_in_bytes")
        limit, used = (_number(_text(group / f"memory.{name}")) for name in names)
        if limit is None or not 0 <= limit < _NO_LIMIT:
            continue
        stat = dict(line.partition(" ")[::2] for line in _text(group / "memory.stat").splitlines())
        # Files that were read count as used, but give way.
        files = _number(stat.get("inactive_file" if is_unified else "total_inactive_file", ""))
        rooms.append(max(0, limit - (used or 0) + (files or 0)))
    return min(rooms, default=None)


def _groups(controller: str, system: Path) -> Iterator[tuple[bool, Path]]:
    """Yield the groups that bind this process, from its own upwards, and whether they are of version 2."""
    member = _memberships(system)
    for hierarchy in _hierarchies(system):
        is_unified = not hierarchy.controllers
        if not is_unified and controller not in hierarchy.controllers:
            continue
        path = member.get("" if is_unified else controller, PurePosixPath("/"))
        # What is mounted may begin at the process's own group, and a path outside of it cannot be followed.
        inside = path.is_relative_to(hierarchy.root) and ".." not in path.parts
        group = hierarchy.point / path.relative_to(hierarchy.root) if inside else hierarchy.point
        while True:
            yield is_unified, group
            if group == hierarchy.point:
                break
            group = group.parent


def _memberships(system: Path) -> dict[str, PurePosixPath]:
    """Return this process's group by controller; that of version 2 under the empty name."""
    found: dict[str, PurePosixPath] = {}
    for line in _text(system / "proc/self/cgroup").splitlines():
        _, _, rest = line.partition(":")
        controllers, _, path = rest.partition(":")
        found |= dict.fromkeys(controllers.split(","), PurePosixPath(path))
    return found


def _hierarchies(system: Path) -> list[_Hierarchy]:
    found = []
    for line in _text(system / "proc/self/mountinfo").splitlines():
        place, _, kind = line.partition(" - ")
        fields, (name, *options) = place.split(" "), kind.split(" ")
        if name in ("cgroup", "cgroup2") and len(fields) > 4:
            controllers = frozenset(options[-1].split(",")) if name == "cgroup" and options else frozenset()
            root, point = (_unescaped(field) for field in fields[3:5])
            found.append(_Hierarchy(controllers, PurePosixPath(root), system / point.lstrip("/")))
    if found:
        return found
    # Nobody says what is mounted where: the usual places.
    usual = system / "sys/fs/cgroup"
    separate = [_Hierarchy(frozenset([name]), PurePosixPath("/"), usual / name) for name in ("cpu", "memory")]
    return [_Hierarchy(frozenset(), PurePosixPath("/"), usual), *separate]


def _unescaped(field: str) -> str:
    r"""Read a path of ``mountinfo``, in which a space is ``\040``."""
    return re.sub(r"\\([0-7]{3})", lambda match: chr(int(match[1], 8)), field)


def _text(path: Path) -> str:
    """Read a file; nothing where it cannot be read."""
    try:
        return path.read_text(encoding="utf-8", errors="surrogateescape").strip()
    except OSError:
        return ""


def _number(text: str) -> int | None:
    """Read a whole number; None for ``max``, and for what is none."""
    try:
        return int(text)
    except ValueError:
        return None
