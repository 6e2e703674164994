"""Films that visitors save: made of what was driven, told about, and fetched by the names that were told."""

from pathlib import Path

import pytest
from PIL import Image
from scenes_to_play import offers
from test_drive_clock import PATIENCE_S, until

from rcdsac_trl.playground.drive_clock import DriveClock
from rcdsac_trl.playground.play_film import FilmStudio
from rcdsac_trl.playground.scene_choice import SceneChoice


def test_a_film_is_made_of_what_was_driven_and_found_by_its_name(tmp_path: Path) -> None:
    clock = DriveClock(SceneChoice("rcdsac_pow-narrow", second="dwa"), offers(), running=False)
    clock.start()
    studio = FilmStudio(tmp_path / "films")
    until(lambda: clock.newest is not None)
    assert studio.told(clock) == ("", [])
    for steps in (1, 2, 3, 4):
        clock.step_once()
        until(lambda steps=steps: clock.newest is not None and clock.newest.robots[0].steps == steps)
    assert studio.queue(clock)[0] == "filming .."
    until(lambda: studio.told(clock)[1])
    _, names = studio.told(clock)
    assert names == ["play-1.mp4", "play-1.gif"]
    film = studio.path("play-1.gif")
    assert film == tmp_path / "films" / "play-1.gif"
    with Image.open(film) as shown:
        # Of 8 steps a second a GIF has about three: of these steps the first and the fourth.
        assert shown.n_frames == 2  # type: ignore[attr-defined]
    assert studio.path("../films/play-1.gif") is None
    clock.close(PATIENCE_S)


def test_a_film_of_nothing_is_refused_in_a_sentence(tmp_path: Path) -> None:
    clock = DriveClock(SceneChoice("dwa"), offers(), running=False)
    clock.start()
    studio = FilmStudio(tmp_path)
    until(lambda: clock.newest is not None)
    studio.queue(clock)
    until(lambda: "no film" in studio.told(clock)[0])
    assert "nothing was driven yet" in studio.told(clock)[0]
    clock.close(PATIENCE_S)


def test_whatever_fails_in_filming_ends_in_a_sentence(tmp_path: Path, capfd: pytest.CaptureFixture[str]) -> None:
    clock = DriveClock(SceneChoice("dwa"), offers())
    studio = FilmStudio(tmp_path)
    studio._make(clock, [], [], 0.12)  # a drive of no robot: there is no sheet to draw on
    assert studio.told(clock) == ("no film (ZeroDivisionError): see where the server was started", [])
    assert "ZeroDivisionError" in capfd.readouterr().err


def test_a_film_of_an_earlier_server_stays(tmp_path: Path) -> None:
    (tmp_path / "play-1.gif").touch()
    studio = FilmStudio(tmp_path)
    assert [studio._next_stem().name for _ in range(2)] == ["play-2", "play-3"]
