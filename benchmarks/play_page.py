"""How soon the page of ``play`` shows a robot that moves, and how many steps a second it shows.

Server and headless Chromium, which draws by software, share the same cores: ``--cores=0`` is one, ``--cores=0,1`` two.
It needs the packages of the extra `dev`, and Chromium. Wall time, so nothing else may run; the first call after an
installation includes what Python and numba compile.
"""

import argparse
import json
import os
import re
import shutil
import subprocess
import sys
import tempfile
import time
import urllib.request
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass

from playwright.sync_api import Page, sync_playwright

from rcdsac_trl.robot.limits import MEAN_PERIOD_S

SCENES = {
    "one robot": "agent=rcdsac_cvar-narrow&map=hard",
    "as it opens": "",
    "an agent and MPPI": "agent=rcdsac_cvar-narrow&map=hard&second=mppi",
}
BROWSERS = ("chromium", "chromium-browser", "google-chrome")
SETTLE_S = 2.0
PATIENCE_MS = 300_000
SWITCHES = ("--headless", "--no-sandbox", "--disable-gpu")
_MOVES = "parseFloat(document.querySelector('#robot0 [data-field=time]')?.textContent) > 0.2"
# The server sends views through one model; the browser counts those that it has drawn.
_COUNT = """() => {
  window.shown = 0;
  const wire = Bokeh.documents[0].get_model_by_name('wire');
  wire.properties.tags.change.connect(() => window.shown++);
}"""


@dataclass(frozen=True)
class Rates:
    """Of one scene, at 4 times real time.

    Attributes:
        shown_per_second: views that the browser has drawn.
        robots: on the page.
        driven_per_second: steps of all robots.
    """

    shown_per_second: float
    robots: int
    driven_per_second: float


@contextmanager
def served() -> Iterator[str]:
    """Start ``play``, and give its address once it answers."""
    command = [sys.executable, "-m", "rcdsac_trl.play", "browser=false", "port=0"]
    with (
        tempfile.TemporaryDirectory() as folder,
        subprocess.Popen(command, cwd=folder, stdout=subprocess.PIPE, text=True) as server,
    ):
        try:
            assert server.stdout is not None
            address = re.match(r"\S+", server.stdout.readline())
            if address is None:
                raise SystemExit("the server has ended: start rcdsac-trl play by itself, and read what it says")
            yield address[0]
        finally:
            server.terminate()


def rates(page: Page, address: str, query: str, seconds: float) -> Rates:
    """Measure a scene."""
    page.goto(f"{address}?{query}")
    page.wait_for_function(_MOVES)
    page.get_by_role("button", name="4×").click()
    page.evaluate(_COUNT)
    page.wait_for_timeout(1000 * SETTLE_S)
    robots = sum(page.locator(f"#robot{number}").is_visible() for number in (0, 1))
    before, start = _so_far(page), time.perf_counter()
    page.wait_for_timeout(1000 * seconds)
    shown, driven_s = (now - then for now, then in zip(_so_far(page), before, strict=True))
    elapsed_s = time.perf_counter() - start
    return Rates(shown / elapsed_s, robots, robots * driven_s / MEAN_PERIOD_S / elapsed_s)


def _so_far(page: Page) -> tuple[float, float]:
    """Return the views drawn, and the drive's time."""
    told = page.locator("#robot0 [data-field=time]").inner_text()
    return page.evaluate("window.shown"), float(told.split()[0])


def main() -> None:
    """Start, open, count."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--cores", default="0,1", help="that server and browser share (default: 0,1)")
    parser.add_argument("--seconds", type=float, default=8.0, help="that a scene is counted (default: 8)")
    parser.add_argument("--json", action="store_true", help="print one JSON object instead of lines")
    options = parser.parse_args()
    cores = {int(core) for core in options.cores.split(",")}
    chromium = next((path for name in BROWSERS if (path := shutil.which(name))), None)
    if chromium is None:
        raise SystemExit("there is no Chromium: apt-get install chromium")
    result = measured(chromium, cores, options.seconds)
    print(
        json.dumps(result) if options.json else "\n".join(f"{name:40} {value:8.1f}" for name, value in result.items())
    )


def measured(chromium: str, cores: set[int], seconds: float) -> dict[str, float]:
    """Return seconds to the page and to a moving robot, and the rates of each scene."""
    os.sched_setaffinity(0, cores)  # server and browser inherit it
    start = time.perf_counter()
    with served() as address, sync_playwright() as playwright:
        urllib.request.urlopen(address, timeout=PATIENCE_MS / 1000).read()
        result = {"page_sent_s": time.perf_counter() - start}
        browser = playwright.chromium.launch(executable_path=chromium, args=SWITCHES)
        page = browser.new_page(viewport={"width": 1280, "height": 800})
        page.set_default_timeout(PATIENCE_MS)
        page.goto(address)
        page.wait_for_function(_MOVES)
        result["robot_moves_s"] = time.perf_counter() - start
        for name, query in SCENES.items():
            found = rates(page, address, query, seconds)
            result[f"{name}: shown a second"] = found.shown_per_second * found.robots
            result[f"{name}: driven a second"] = found.driven_per_second
        browser.close()
    return result


if __name__ == "__main__":
    main()
