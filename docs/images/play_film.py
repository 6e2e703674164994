"""Film the page: a careful and a neutral robot on the same map, step by step. Writes play.gif and play.png beside it.

It needs the packages of the extra `dev`, and Chromium: ``python docs/images/play_film.py``.
"""

import io
import re
import shutil
import subprocess
import sys
import tempfile
from collections.abc import Iterator
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from PIL import Image
from playwright.sync_api import Page, sync_playwright

from rcdsac_trl.evaluation.film.video import write_video

HERE = Path(__file__).parent
SCENE = "agent=rcdsac_pow-narrow&beta=-2&second=rcdsac_pow-narrow&beta2=0&map=hard&seed=3"
SIZE = {"width": 1280, "height": 800}
# The neutral robot touches something in step 135.
FIRST_STEP, LAST_STEP, STEPS_A_FRAME = 92, 150, 2
STEP_S = 0.12
STILL_STEP = 134
SWITCHES = ["--headless", "--no-sandbox", "--disable-gpu", "--disable-background-networking", "--disable-sync"]


def drive(page: Page, first: int, last: int) -> None:
    """Take the robots from one step to another."""
    for _ in range(first, last):
        page.keyboard.press(".")
    page.wait_for_function(
        "(told) => document.querySelector('#robot0 [data-field=time]').textContent === told",
        arg=f"{last * STEP_S:.1f} s",
    )


def frames(page: Page) -> Iterator[NDArray[np.uint8]]:
    """Yield pictures of the page."""
    before = 0
    for number in range(FIRST_STEP, LAST_STEP + 1, STEPS_A_FRAME):
        drive(page, before, number)
        before = number
        page.wait_for_timeout(500)  # the critics' figures follow the map
        shown = page.screenshot()
        if number == STILL_STEP:
            (HERE / "play.png").write_bytes(shown)
        yield np.asarray(Image.open(io.BytesIO(shown)).convert("RGB"))


def main() -> None:
    """Serve, open, drive, film."""
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
                page.goto(f"{address[0]}?{SCENE}&paused=on")
                page.wait_for_function("document.querySelector('#robot1 [data-field=time]').textContent")
                fps = 1.0 / (STEPS_A_FRAME * STEP_S)
                _, film = write_video(frames(page), Path(folder) / "play", fps)
                browser.close()
            shutil.copyfile(film, HERE / "play.gif")
        finally:
            server.terminate()


if __name__ == "__main__":
    main()
