"""Film the page: a careful and a neutral robot on the same map, step by step. Writes play.gif and play.png beside it.

    python docs/images/play_film.py

It needs the packages of the extra `dev`, and Chromium. The scene is the one with which the page opens, unless its
neutral robot touches nothing within the time, or the careful one something: then it is the next seed without that.
"""

import io
import re
import shutil
import subprocess
import sys
import tempfile
from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from PIL import Image
from playwright.sync_api import Page, sync_playwright

from rcdsac_trl.config.compose import compose
from rcdsac_trl.config.play_settings import PlaySettings
from rcdsac_trl.config.run_config import read_config
from rcdsac_trl.evaluation.film.video import write_video
from rcdsac_trl.playground.page_link import usual_scene
from rcdsac_trl.playground.play_drive import Drive
from rcdsac_trl.playground.play_session import offers_of
from rcdsac_trl.playground.scene_choice import SceneChoice

HERE = Path(__file__).parent
MOST_SEEDS = 100
SIZE = {"width": 1280, "height": 800}
# The film is of so many steps before the contact, and after it.
BEFORE, AFTER, STEPS_A_FRAME = 26, 28, 2
LATEST = 300
SWITCHES = ["--headless", "--no-sandbox", "--disable-gpu", "--disable-background-networking", "--disable-sync"]


@dataclass(frozen=True)
class Shot:
    """What is filmed: a scene, the step in which the neutral robot touches something, and the duration of a step."""

    scene: SceneChoice
    contact: int
    period_s: float


def find_shot() -> Shot:
    """Drive scenes without a page until one has what is to be shown."""
    offers = offers_of(read_config(compose("play", []), PlaySettings))
    usual = usual_scene(offers)
    for seed in range(usual.seed, usual.seed + MOST_SEEDS):
        scene = replace(usual, seed=seed)
        drive = Drive(scene, offers)
        contact = first_contact(drive)
        period_s = drive.period_s
        drive.close()
        if contact is not None:
            return Shot(scene, contact, period_s)
    raise SystemExit(f"in {MOST_SEEDS} scenes the neutral robot alone touches nothing: choose another map")


def first_contact(drive: Drive) -> int | None:
    """Return the step in which the second robot alone touches something; None if that is not to be shown."""
    contact: int | None = None
    for step in range(1, LATEST + AFTER):
        drive.step()
        careful, neutral = drive.robots
        if careful.collisions or (neutral.collisions and step <= BEFORE):
            return None
        if contact is None and neutral.collisions:
            contact = step
        if contact is not None and step == contact + AFTER:
            return contact
    return None


def step_to(page: Page, first: int, last: int, period_s: float) -> None:
    """Take the robots on the page from one step to another."""
    for _ in range(first, last):
        page.keyboard.press(".")
    page.wait_for_function(
        "(told) => document.querySelector('#robot0 [data-field=time]').textContent === told",
        arg=f"{last * period_s:.1f} s",
    )


def frames(page: Page, shot: Shot) -> Iterator[NDArray[np.uint8]]:
    """Yield pictures of the page; the still is of the contact."""
    before = 0
    for number in range(shot.contact - BEFORE, shot.contact + AFTER + 1, STEPS_A_FRAME):
        step_to(page, before, number, shot.period_s)
        before = number
        page.wait_for_timeout(500)  # the critics' figures follow the map
        shown = page.screenshot()
        if number == shot.contact:
            (HERE / "play.png").write_bytes(shown)
        yield np.asarray(Image.open(io.BytesIO(shown)).convert("RGB"))


def main() -> None:
    """Find a scene, serve, open, drive, film."""
    shot = find_shot()
    print(f"filming {shot.scene.query}, around step {shot.contact}")
    chromium = next(path for name in ("chromium", "google-chrome") if (path := shutil.which(name)))
    with tempfile.TemporaryDirectory() as folder:
        command = [sys.executable, "-m", "rcdsac_trl.play", "browser=false", "port=0"]
        server = subprocess.Popen(command, cwd=folder, stdout=subprocess.PIPE, text=True)
        try:
            assert server.stdout is not None
            address = re.match(r"\S+", server.stdout.readline())
            assert address is not None
            with sync_playwright() as playwright:
                browser = playwright.chromium.launch(executable_path=chromium, args=SWITCHES)
                page = browser.new_page(viewport=SIZE)
                page.set_default_timeout(300_000)
                page.goto(f"{address[0]}?{shot.scene.query}&paused=on")
                page.wait_for_function("document.querySelector('#robot1 [data-field=time]').textContent")
                fps = 1.0 / (STEPS_A_FRAME * shot.period_s)
                _, film = write_video(frames(page, shot), Path(folder) / "play", fps)
                browser.close()
            shutil.copyfile(film, HERE / "play.gif")
        finally:
            server.terminate()


if __name__ == "__main__":
    main()
