"""Limits of containers, on made-up ``/proc`` and ``/sys``: both versions, nested, side by side, and unreadable."""

import os
from collections.abc import Mapping
from pathlib import Path

import pytest

from rcdsac_trl.system import cgroups, cores, runtime
from rcdsac_trl.system.cores import SHARE, usable_cores

V2 = "31 23 0:28 / /sys/fs/cgroup rw,nosuid - cgroup2 cgroup2 rw,nsdelegate"
V1_NO_LIMIT = "9223372036854771712"


def v1(*controllers: str, root: str = "/", at: str | None = None) -> str:
    names = ",".join(controllers)
    return f"33 31 0:30 {root} {at or f'/sys/fs/cgroup/{names}'} rw,relatime shared:9 - cgroup cgroup rw,{names}"


def laid_out(folder: Path, member: str, mounts: list[str] | None, files: Mapping[str, str]) -> Path:
    """Write ``/proc/self`` and files below ``/sys/fs/cgroup``; return the root they lie in."""
    (folder / "proc/self").mkdir(parents=True)
    (folder / "proc/self/cgroup").write_text(member)
    if mounts is not None:
        other = "23 1 8:1 / / rw,relatime - ext4 /dev/root rw"
        (folder / "proc/self/mountinfo").write_text("\n".join([other, *mounts]) + "\n")
    for name, content in files.items():
        path = folder / "sys/fs/cgroup" / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(content + "\n")
    return folder


def v1_cpu(folder: str, quota_us: int, period_us: int = 100_000) -> dict[str, str]:
    return {f"{folder}/cpu.cfs_quota_us": str(quota_us), f"{folder}/cpu.cfs_period_us": str(period_us)}


# ------------------------------------------------------------------------------------------------ processor time
@pytest.mark.parametrize(
    ("quota", "whole_cores"),
    [
        ("200000 100000", 2),  # docker run --cpus=2
        ("50000 100000", 1),  # half a core
        ("1000 100000", 1),
        ("150000 100000", 1),  # whole ones: a second process would stand still half of the time
        ("100000 50000", 2),
        ("6400000 100000", 64),
        ("max 100000", None),
        ("max", None),
        ("", None),
        ("200000", None),
        ("0 100000", None),
        ("200000 0", None),
        ("lots 100000", None),
    ],
)
def test_a_quota_of_version_2_in_whole_cores(tmp_path: Path, quota: str, whole_cores: int | None) -> None:
    system = laid_out(tmp_path, "0::/\n", [V2], {"cpu.max": quota})
    assert cgroups.processor_quota(system) == whole_cores


@pytest.mark.parametrize(
    ("quota_us", "period_us", "whole_cores"),
    [(200_000, 100_000, 2), (50_000, 100_000, 1), (-1, 100_000, None), (0, 100_000, None), (200_000, 0, None)],
)
def test_a_quota_of_version_1_in_whole_cores(
    tmp_path: Path, quota_us: int, period_us: int, whole_cores: int | None
) -> None:
    member, mount = "4:cpu,cpuacct:/\n3:memory:/\n", v1("cpu", "cpuacct")
    system = laid_out(tmp_path, member, [mount], v1_cpu("cpu,cpuacct", quota_us, period_us))
    assert cgroups.processor_quota(system) == whole_cores


def test_the_least_quota_from_the_own_group_to_the_root_counts(tmp_path: Path) -> None:
    files = {"cpu.max": "800000 100000", "a/cpu.max": "300000 100000", "a/b/cpu.max": "max 100000"}
    files |= {"a/b/c/cpu.max": "500000 100000", "other/cpu.max": "100000 100000"}
    system = laid_out(tmp_path, "0::/a/b/c\n", [V2], files)
    assert cgroups.processor_quota(system) == 3


def test_a_group_whose_name_holds_spaces_and_colons_is_found(tmp_path: Path) -> None:
    mount = "31 23 0:28 / /sys/fs/cgroup/my\\040groups rw - cgroup2 cgroup2 rw"
    system = laid_out(tmp_path, "0::/a:b c\n", [mount], {"my groups/a:b c/cpu.max": "200000 100000"})
    assert cgroups.processor_quota(system) == 2


@pytest.mark.parametrize(
    ("member", "root", "folder"),
    [
        # A container that sees the host's paths, but of the tree only its own part.
        ("4:cpu:/docker/abc\n", "/docker/abc", "cpu"),
        ("4:cpu:/docker/abc/inner\n", "/docker/abc", "cpu/inner"),
        # The path leads to where nothing is mounted, or out of it.
        ("4:cpu:/docker/abc\n", "/", "cpu"),
        ("4:cpu:/elsewhere\n", "/docker/abc", "cpu"),
        ("4:cpu:/../sibling\n", "/", "cpu"),
        ("", "/", "cpu"),
    ],
)
def test_a_mount_may_begin_below_the_root_of_the_tree(tmp_path: Path, member: str, root: str, folder: str) -> None:
    system = laid_out(tmp_path, member, [v1("cpu", root=root)], v1_cpu(folder, 200_000))
    assert cgroups.processor_quota(system) == 2


def test_both_versions_side_by_side(tmp_path: Path) -> None:
    unified = "38 31 0:41 / /sys/fs/cgroup/unified rw,relatime - cgroup2 cgroup2 rw"
    member = "4:memory:/job\n2:cpuset:/\n1:cpu:/job\n0::/user.slice\n"
    files = v1_cpu("cpu/job", 400_000) | {"unified/user.slice/cpu.max": "max 100000", "memory/job/cpu.max": "1 1"}
    system = laid_out(tmp_path, member, [v1("memory"), v1("cpuset"), v1("cpu"), unified], files)
    assert cgroups.processor_quota(system) == 4
    (tmp_path / "sys/fs/cgroup/unified/user.slice/cpu.max").write_text("300000 100000\n")
    assert cgroups.processor_quota(system) == 3


@pytest.mark.parametrize("files", [{"cpu.max": "200000 100000"}, v1_cpu("cpu", 200_000)])
def test_the_usual_places_are_looked_at_where_mounts_are_not_told(tmp_path: Path, files: dict[str, str]) -> None:
    assert cgroups.processor_quota(laid_out(tmp_path, "", None, files)) == 2


def test_what_cannot_be_read_limits_nothing(tmp_path: Path) -> None:
    assert cgroups.processor_quota(tmp_path) is None
    assert cgroups.memory_room_bytes(tmp_path) is None
    system = laid_out(tmp_path, "nonsense\n\n", [V2, "- cgroup", "a - cgroup2", v1("cpu")], {})
    (tmp_path / "sys/fs/cgroup/cpu.max").mkdir(parents=True)  # reading it fails
    (tmp_path / "sys/fs/cgroup/memory.max").write_bytes(b"\xff\xfe")
    assert cgroups.processor_quota(system) is None
    assert cgroups.memory_room_bytes(system) is None


@pytest.mark.parametrize(
    ("quota", "share", "found"),
    [(2, None, 2), (1, None, 1), (None, None, 64), (2, "8", 2), (16, "4", 4), (99, None, 64)],
)
def test_usable_cores_are_the_least_of_all_limits(
    monkeypatch: pytest.MonkeyPatch, quota: int | None, share: str | None, found: int
) -> None:
    monkeypatch.setattr(os, "sched_getaffinity", lambda _: set(range(64)), raising=False)
    monkeypatch.setattr(cgroups, "processor_quota", lambda: quota)
    monkeypatch.delenv(SHARE, raising=False)
    if share is not None:
        monkeypatch.setenv(SHARE, share)
    assert usable_cores() == found
    assert runtime.resolve_threads("auto") == found


@pytest.mark.parametrize(
    ("usable", "users", "found"), [(2, None, "2"), (64, None, None), (2, "7", "7")], ids=["quota", "none", "the user's"]
)
def test_libraries_are_told_of_cores_that_they_cannot_count(
    monkeypatch: pytest.MonkeyPatch, usable: int, users: str | None, found: str | None
) -> None:
    monkeypatch.setattr(runtime, "usable_cores", lambda: usable)
    monkeypatch.setattr(runtime, "allowed_cores", lambda: 64)
    monkeypatch.setenv("OMP_NUM_THREADS", users or "")
    if users is None:
        monkeypatch.delenv("OMP_NUM_THREADS")
    runtime.bound_threads()
    assert os.environ.get("OMP_NUM_THREADS") == found
    assert cores.allowed_cores() >= 1


# ------------------------------------------------------------------------------------------------ memory
def v2_memory(folder: str, limit: str, used: int, files: int) -> dict[str, str]:
    at = f"{folder}/" if folder else ""
    return {
        f"{at}memory.max": limit,
        f"{at}memory.current": str(used),
        f"{at}memory.stat": f"anon 5\ninactive_file {files}\nactive_file 7",
    }


def v1_memory(folder: str, limit: str, used: int, files: int) -> dict[str, str]:
    return {
        f"{folder}/memory.limit_in_bytes": limit,
        f"{folder}/memory.usage_in_bytes": str(used),
        # Without "total" it is that of this group alone.
        f"{folder}/memory.stat": f"inactive_file 1\ntotal_inactive_file {files}",
    }


def test_memory_of_version_2_at_every_height(tmp_path: Path) -> None:
    files = v2_memory("a", "9000", 5000, 500) | v2_memory("a/b", "6000", 4000, 250) | v2_memory("a/b/c", "max", 4000, 0)
    assert cgroups.memory_room_bytes(laid_out(tmp_path, "0::/a/b/c\n", [V2], files)) == 6000 - 4000 + 250


def test_memory_of_version_1_at_every_height(tmp_path: Path) -> None:
    files = v1_memory("memory", V1_NO_LIMIT, 8000, 0) | v1_memory("memory/pod", "9000", 7000, 600)
    files |= v1_memory("memory/pod/job", "7000", 2000, 300)
    system = laid_out(tmp_path, "9:memory:/pod/job\n", [v1("memory")], files)
    assert cgroups.memory_room_bytes(system) == 9000 - 7000 + 600


@pytest.mark.parametrize("limit", [V1_NO_LIMIT, "9223372036854775807", "-1"])
def test_version_1_writes_no_limit_as_a_number(tmp_path: Path, limit: str) -> None:
    system = laid_out(tmp_path, "9:memory:/\n", [v1("memory")], v1_memory("memory", limit, 10, 0))
    assert cgroups.memory_room_bytes(system) is None


def test_memory_of_both_versions_side_by_side(tmp_path: Path) -> None:
    """As where this was written: groups of version 1 below the root, and an empty tree of version 2 beside them."""
    unified = "38 31 0:41 / /sys/fs/cgroup/unified rw,relatime - cgroup2 cgroup2 rw"
    member = "9:name=systemd:/\n4:memory:/job/1\n1:cpu:/\n0::/\n"
    files = v1_memory("memory/job/1", "8000", 1000, 0) | v1_memory("memory/job", V1_NO_LIMIT, 1000, 0)
    system = laid_out(tmp_path, member, [v1("cpu"), v1("memory"), unified], files)
    assert cgroups.memory_room_bytes(system) == 7000


def test_a_group_above_its_limit_has_no_room(tmp_path: Path) -> None:
    system = laid_out(tmp_path, "0::/\n", [V2], v2_memory("", "1000", 1500, 100))
    assert cgroups.memory_room_bytes(system) == 0


def test_a_limit_alone_is_room_at_most(tmp_path: Path) -> None:
    assert cgroups.memory_room_bytes(laid_out(tmp_path, "0::/\n", [V2], {"memory.max": "1000"})) == 1000
