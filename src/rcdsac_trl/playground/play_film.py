"""Films of what a page has shown, made one after another, to be fetched by their names."""

import itertools
import threading
import traceback
from pathlib import Path
from weakref import WeakKeyDictionary

from rcdsac_trl.errors import FaultError, UserInputError
from rcdsac_trl.evaluation.film.episode_film import Track, film
from rcdsac_trl.evaluation.film.recording import Moment
from rcdsac_trl.evaluation.film.video import check_extra, write_video
from rcdsac_trl.playground.drive_clock import DriveClock

_FILMING = "filming .."


class FilmStudio:
    """Makes films of drives.

    Args:
        folder: takes the files; made with the first film.
    """

    def __init__(self, folder: Path) -> None:
        self._folder = folder
        self._numbers = itertools.count(1)
        self._one_at_a_time = threading.Lock()
        self._made: dict[str, Path] = {}
        self._states: WeakKeyDictionary[DriveClock, tuple[str, list[str]]] = WeakKeyDictionary()

    def queue(self, clock: DriveClock | None) -> tuple[str, list[str]]:
        """Begin a film of the latest seconds of a drive, and say so; see :meth:`told`."""
        if clock is None or self.told(clock)[0] == _FILMING:
            return self.told(clock)
        try:
            check_extra()
        except UserInputError as error:
            return self._tell(clock, str(error))
        clock.with_moments(
            lambda tracks, headings, period_s: threading.Thread(
                target=self._make, args=[clock, tracks, headings, period_s], name="film", daemon=True
            ).start()
        )
        return self._tell(clock, _FILMING)

    def _next_stem(self) -> Path:
        """Return what a film is called that is none of an earlier server's."""
        while any(self._folder.glob(f"{(name := f'play-{next(self._numbers)}')}.*")):
            pass
        return self._folder / name

    def told(self, clock: DriveClock | None) -> tuple[str, list[str]]:
        """Return a sentence about a drive's latest film, and the names of its files."""
        return ("", []) if clock is None else self._states.get(clock, ("", []))

    def path(self, name: str) -> Path | None:
        """Return a film that was made here; None for every other name."""
        return self._made.get(name)

    def _tell(self, clock: DriveClock, sentence: str, files: list[str] | None = None) -> tuple[str, list[str]]:
        self._states[clock] = sentence, files or []
        return self._states[clock]

    def _make(self, clock: DriveClock, tracks: list[list[Moment]], headings: list[str], period_s: float) -> None:
        with self._one_at_a_time:
            try:
                if tracks and not tracks[0]:
                    raise UserInputError("nothing was driven yet: let it drive, or take a step")
                self._folder.mkdir(parents=True, exist_ok=True)
                stem = self._next_stem()
                named = [Track(heading, track) for heading, track in zip(headings, tracks, strict=True)]
                files = write_video(film(named, period_s), stem, 1.0 / period_s)
            except (UserInputError, FaultError, OSError) as error:
                self._tell(clock, f"no film: {error}")
                return
            except Exception as error:  # nobody else would hear of it
                traceback.print_exc()
                self._tell(clock, f"no film ({type(error).__name__}): see where the server was started")
                return
            self._made |= {file.name: file for file in files}
            self._tell(clock, f"{self._folder}:", [file.name for file in files])
