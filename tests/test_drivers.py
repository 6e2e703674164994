"""Maps over processes: each driven once, and nobody left behind however it ends."""

import contextlib
import multiprocessing
import os
from collections.abc import Iterator

import pytest

from rcdsac_trl.errors import FaultError, UserInputError
from rcdsac_trl.pipeline.drivers import Drive, Rows, drive_maps, resolve_processes


@contextlib.contextmanager
def counting() -> Iterator[Drive]:
    yield lambda map_index: [{"map": map_index, "process": os.getpid()}]


@contextlib.contextmanager
def breaking() -> Iterator[Drive]:
    def drive(map_index: int) -> Rows:
        os._exit(7)

    yield drive


def test_every_map_is_driven_once_and_by_a_process_of_its_own() -> None:
    rows = [row for rows in drive_maps(counting, 7, processes=2) for row in rows]
    assert sorted(row["map"] for row in rows) == list(range(7))
    assert os.getpid() not in {row["process"] for row in rows}
    assert list(drive_maps(counting, 2, processes=0)) == [[{"map": i, "process": os.getpid()}] for i in range(2)]


def test_a_process_that_dies_ends_the_evaluation_and_leaves_none_behind() -> None:
    with pytest.raises(FaultError, match="exit code 7"):
        list(drive_maps(breaking, 4, processes=2))
    assert not multiprocessing.active_children()


def test_processes_end_with_whoever_stops_asking() -> None:
    maps = drive_maps(counting, 1000, processes=2)
    next(maps)
    assert len(multiprocessing.active_children()) == 2
    maps.close()  # as on Ctrl-C
    assert not multiprocessing.active_children()


def test_no_more_processes_than_maps() -> None:
    assert [resolve_processes(n, num_maps=3) for n in (0, 1, 2, 8)] == [0, 0, 2, 3]
    for wrong in (-1, 1.5, "all"):
        with pytest.raises(UserInputError, match="is not a number of processes"):
            resolve_processes(wrong, 3)  # type: ignore[arg-type]
