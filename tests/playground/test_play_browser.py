"""The page in a real browser: the system's Chromium, without a window."""

import re
import shutil
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import pytest
from playwright.sync_api import BrowserContext, Page, sync_playwright
from scenes_to_play import offers

from rcdsac_trl.playground import play_server
from rcdsac_trl.playground.palette import PALETTES
from rcdsac_trl.playground.play_server import PlayServer, in_thread

CHROMIUM = shutil.which("chromium") or shutil.which("chromium-browser") or shutil.which("google-chrome")
pytestmark = pytest.mark.skipif(
    CHROMIUM is None, reason="there is no Chromium to open the page in: apt-get install chromium (make test says more)"
)
POW = "agent=rcdsac_pow-narrow"
PATIENCE_S = 300.0
# So often these tests' server looks who has left: they wait for it after every page.
LOOK_MS = 50
GOAL, OBSTACLE = PALETTES["light"]["goal"], PALETTES["light"]["obstacle"]
SWITCHES = (
    "--headless --no-sandbox --disable-gpu --disable-quic --no-first-run --disable-background-networking "
    "--disable-component-update --disable-sync"
)
# What Bokeh says of itself, and what Chromium says of a page that is a refusal.
OWN_LINES = re.compile(r"^\[bokeh|^Bokeh items were rendered|^Failed to load resource: .* status of (400|503) ")


@contextmanager
def serving(films: Path, port: int = 0, look_ms: int = LOOK_MS) -> Iterator[PlayServer]:
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(play_server, "_CHECK_UNUSED_MS", look_ms)
        with in_thread(lambda: PlayServer(offers(), host="localhost", port=port, max_sessions=2, films=films)) as made:
            yield made


@pytest.fixture(scope="module")
def server(tmp_path_factory: pytest.TempPathFactory) -> Iterator[PlayServer]:
    with serving(tmp_path_factory.mktemp("films")) as made:
        yield made


@pytest.fixture(scope="module")
def browser() -> Iterator[BrowserContext]:
    """One profile for all pages: what they load is then read and compiled once."""
    with sync_playwright() as playwright:
        opened = playwright.chromium.launch(executable_path=CHROMIUM, args=SWITCHES.split())
        profile = opened.new_context()
        profile.set_default_timeout(1000 * PATIENCE_S)
        yield profile
        opened.close()


@pytest.fixture
def opened(browser: BrowserContext, server: PlayServer) -> Iterator[Callable[..., Page]]:
    """Open pages; at the end nothing but its own lines is on their consoles, and no drive is left."""
    pages: list[Page] = []
    said: list[str] = []

    def open_(query: str = "", size: tuple[int, int] = (1280, 800), dark: bool = False) -> Page:
        page = browser.new_page()
        page.set_viewport_size({"width": size[0], "height": size[1]})
        page.emulate_media(color_scheme="dark" if dark else "light")
        page.on("console", lambda line: said.append(line.text))
        page.on("pageerror", lambda error: said.append(f"error: {error}"))
        page.on("request", lambda asked: said.append(asked.url) if str(server.port) not in asked.url else None)
        page.goto(f"{server.address}?{query}")
        pages.append(page)
        return page

    yield open_
    for page in pages:
        page.close()
    until(lambda: server.num_drives == 0)
    assert [line for line in said if not OWN_LINES.match(line) and not line.startswith("data:")] == []


def until(found: Callable[[], object]) -> None:
    end_s = time.monotonic() + PATIENCE_S
    while not found():
        assert time.monotonic() < end_s
        time.sleep(0.05)


def field(page: Page, name: str, number: int = 0) -> str:
    return page.locator(f"#robot{number} [data-field={name}]").inner_text()


def seconds(page: Page, number: int = 0) -> float:
    return float(field(page, "time", number).removesuffix(" s") or 0.0)


def driving(page: Page) -> Page:
    page.wait_for_function("parseFloat(document.querySelector('#robot0 [data-field=time]')?.textContent) > 0.5")
    return page


def standing(page: Page, steps: int = 0) -> Page:
    """Wait for a scene that was opened with paused=on, and take it some steps further."""
    for number in range(steps + 1):
        time_s = f"{0.12 * number:.1f} s"
        page.wait_for_function(
            "(told) => document.querySelector('#robot0 [data-field=time]')?.textContent === told", arg=time_s
        )
        if number < steps:
            page.keyboard.press(".")
    return page


def model(page: Page, name: str, code: str) -> Any:
    """Read something of a Bokeh model, by its name."""
    return page.evaluate(
        f"(name) => {{ const model = Bokeh.documents[0].get_model_by_name(name); return {code}; }}", name
    )


def on_map(page: Page, x: float, y: float) -> dict[str, float]:
    """Return where a place, m, is in the first map's picture, px."""
    low, high, bottom, top = model(
        page, "map0", "[model.x_range.start, model.x_range.end, model.y_range.start, model.y_range.end]"
    )
    box = page.locator("#robot0 .map").bounding_box()
    assert box is not None
    return {"x": (x - low) / (high - low) * box["width"], "y": (top - y) / (top - bottom) * box["height"]}


def filled(page: Page, color: str) -> list[list[float]]:
    """Return the places of the round things of a colour that move or mark something, m."""
    found: list[list[float]] = page.evaluate(
        """(color) => {
            const column = (data, key) => (data.get ? data.get(key) : data[key]) || [];
            const places = [];
            for (const { data_source } of Bokeh.documents[0].get_model_by_name("map0").renderers) {
                const [x, y, fill] = ["x", "y", "fill"].map((key) => column(data_source.data, key));
                Array.from(fill).forEach((each, at) => each === color && x.length && places.push([x[at], y[at]]));
            }
            return places;
        }""",
        color,
    )
    return found


def goal(page: Page) -> list[float]:
    return filled(page, GOAL)[-1]


def obstacles(page: Page) -> list[list[float]]:
    return filled(page, OBSTACLE)


def places(page: Page, name: str) -> list[list[float]]:
    """Return what is marked on a map, m: contacts, and the robot's place at the end."""
    code = "['x', 'y'].map((key) => Array.from(marks.get ? marks.get(key) : marks[key]))"
    x, y = model(page, name, f"((marks) => {code})(model.renderers.at(-2).data_source.data)")
    return [list(place) for place in zip(x, y, strict=True)]


def picture(page: Page, name: str, tmp_path: Path) -> None:
    """Keep a screenshot beside the test's other files, for who wants to look."""
    path = tmp_path / f"{name}.png"
    page.screenshot(path=path)
    assert path.stat().st_size > 20_000  # an empty page is a few kB


def test_a_robot_drives_and_beta_turns_it(opened, tmp_path) -> None:
    page = driving(opened("agent=rcdsac_cvar-narrow&beta=0.25"))
    assert field(page, "name") == "rcdsac_cvar-narrow"
    assert field(page, "beta") == "β = 0.25"
    assert re.fullmatch(r"-?\d\.\d\d m/s", field(page, "speed"))
    before = seconds(page)
    page.wait_for_function(
        f"parseFloat(document.querySelector('#robot0 [data-field=time]').textContent) > {before + 0.5}"
    )
    page.get_by_role("button", name="pause").click()
    page.get_by_role("button", name="drive").wait_for()
    told = field(page, "value")
    page.locator(".noUi-handle").first.focus()
    page.keyboard.press("End")
    page.wait_for_function("document.querySelector('#robot0 [data-field=beta]').textContent === 'β = 1.00'")
    page.wait_for_function(
        "(told) => document.querySelector('#robot0 [data-field=value]').textContent !== told", arg=told
    )
    mean, value = re.findall(r"-?\d+\.\d", field(page, "value"))
    assert mean == value  # neutral: the weighted mean is the mean
    assert "beta=1" in page.url  # the link opens what is seen
    picture(page, "one", tmp_path)


def test_keys_and_buttons_do_what_they_say(opened) -> None:
    page = driving(opened("agent=rcdsac_cvar-narrow&beta=0.5"))
    for _ in range(2):
        page.keyboard.down("Space")  # held: the second one is a repetition
    page.keyboard.up("Space")
    page.get_by_role("button", name="drive").wait_for()
    stood = seconds(page)
    page.get_by_role("button", name="step").focus()
    page.keyboard.press("Space")
    page.wait_for_function(f"parseFloat(document.querySelector('#robot0 [data-field=time]').textContent) > {stood}")
    stood = seconds(page)
    page.keyboard.press(".")
    page.wait_for_function(f"parseFloat(document.querySelector('#robot0 [data-field=time]').textContent) > {stood}")
    page.keyboard.press("ArrowRight")
    page.wait_for_function("document.querySelector('#robot0 [data-field=beta]').textContent === 'β = 0.55'")
    page.get_by_role("button", name="+ obstacle").click()
    until(lambda: obstacles(page))
    ((x, y),) = obstacles(page)
    corner = page.locator("#robot0 .map").bounding_box()
    assert corner is not None
    for number, there in enumerate((on_map(page, x, y), on_map(page, x + 3.0, y))):
        page.mouse.move(corner["x"] + there["x"], corner["y"] + there["y"], steps=4)
        (page.mouse.up if number else page.mouse.down)()
        page.wait_for_timeout(0 if number else 500)  # who holds it for a moment drags it, too
    until(lambda: obstacles(page) != [[x, y]])
    assert obstacles(page)[0] == pytest.approx([x + 3.0, y], abs=0.15)
    box = page.locator("#robot0 .map").bounding_box()
    assert box is not None
    there = on_map(page, *obstacles(page)[0])
    page.keyboard.down("Shift")
    page.mouse.click(box["x"] + there["x"], box["y"] + there["y"])
    page.keyboard.up("Shift")
    until(lambda: obstacles(page) == [[-1000.0, -1000.0]])  # away
    page.get_by_role("button", name="stop zone").click()
    page.get_by_role("button", name="◐").click()
    page.wait_for_function("window.location.search.endsWith('&stop=on&theme=dark')")


def test_a_click_sets_the_goal(opened) -> None:
    page = driving(opened("agent=sac-narrow"))
    page.get_by_role("button", name="pause").click()
    page.get_by_role("button", name="drive").wait_for()
    before = goal(page)
    x, y = 5.0, 5.0
    page.locator("#robot0 .map").click(position=on_map(page, x, y))  # type: ignore[arg-type]
    until(lambda: goal(page) != before)
    assert goal(page) == pytest.approx([x, y], abs=1.0)  # the nearest place that the robot can get to


def test_a_bad_link_ends_in_one_sentence_and_leads_to_two_robots_side_by_side(opened) -> None:
    page = opened("beta=<b>1</b>")
    assert page.locator("#sentence").inner_text().startswith("beta=<b>1</b> is no number")
    page.get_by_role("link", name="Open the usual scene.").click()
    driving(page)
    assert field(page, "name", 0) == field(page, "name", 1)
    assert float(field(page, "beta", 0)[4:]) < float(field(page, "beta", 1)[4:])


def test_choices_add_up_and_one_that_cannot_be_had_is_taken_back(opened) -> None:
    page = standing(opened("agent=sac-narrow&paused=on"))
    page.locator("#scene summary").click()
    agent, second, map_ = (page.locator("select").nth(number) for number in (0, 1, 2))
    agent.select_option("rcdsac_pow-narrow")
    second.select_option("mppi")
    page.get_by_role("button", name="next map").click()
    page.get_by_role("button", name="next map").click()
    page.wait_for_function("window.location.search === '?agent=rcdsac_pow-narrow&beta=-1&seed=2&second=mppi&zoom=off'")
    sensor = page.locator("select").nth(3)
    sensor.select_option("full")
    page.wait_for_function("window.location.search.includes('sensor=full')")
    map_.select_option("office")
    page.locator("#message", has_text="the office is driven by four cameras").wait_for()
    until(lambda: model(page, "map", "model.value") == "mixed")
    seed = page.locator("#scene input").first
    for typed, sentence in (("", "seed is empty"), ("1.5", "seed=1.5 is no whole number"), ("-5", "seed=-5")):
        seed.fill(typed)
        seed.press("Enter")
        page.locator("#message", has_text=sentence).wait_for()
        until(lambda: model(page, "seed", "model.value") == 2)


def test_a_film_is_made_while_it_pauses(opened, server: PlayServer) -> None:
    page = standing(opened("agent=sac-narrow&paused=on"), steps=2)
    page.get_by_role("button", name="save film").click()
    link = page.get_by_role("link", name="GIF")
    link.wait_for()
    answer = page.request.get(f"{server.address}{link.get_attribute('href')}")
    assert answer.body()[:4] == b"GIF8"


def test_who_has_left_makes_room(browser: BrowserContext, tmp_path: Path) -> None:
    with serving(tmp_path, look_ms=3_600_000) as server:  # nobody looks who has left before another one comes
        page = browser.new_page()
        page.goto(f"{server.address}?agent=sac-narrow&paused=on")
        standing(page)
        for _ in range(3):  # of two pages that may drive
            page.reload()
            page.wait_for_function("document.querySelector('#robot0 [data-field=time]')?.textContent")
        until(lambda: server.num_drives == 2)
        page.close()


def test_sessions_share_nothing_one_too_many_is_told_so_and_a_closed_tab_ends_its_drive(
    opened, server: PlayServer
) -> None:
    first, second = driving(opened(f"{POW}&beta=-2")), driving(opened(f"{POW}&beta=0&seed=2"))
    assert server.num_drives == 2
    assert [field(page, "beta") for page in (first, second)] == ["β = -2.00", "β = 0.00"]
    third = opened()
    assert third.locator("#sentence").inner_text().startswith("max_sessions=2, and so many")
    third.close()  # it would come in by itself
    second.close()
    until(lambda: server.num_drives == 1)
    drives = [thread for thread in threading.enumerate() if thread.name == "drive"]
    assert len(drives) == 1
    before = seconds(first)
    first.wait_for_function(f"parseFloat(document.querySelector('#robot0 [data-field=time]').textContent) > {before}")


def test_two_robots_start_equal_in_two_tabs_and_one_that_ends_leaves_the_other(opened, server: PlayServer) -> None:
    first, second = (standing(opened("map=hard&paused=on"), steps=3) for _ in range(2))
    assert places(first, "map0") == places(second, "map0")
    first.close()
    until(lambda: server.num_drives == 1)
    second.keyboard.press(".")
    second.wait_for_function("document.querySelector('#robot0 [data-field=time]').textContent === '0.5 s'")


def test_zoomed_in_each_map_follows_its_robot_and_a_message_moves_nothing(opened) -> None:
    page = standing(
        opened("map=hard&beta=0.26&beta2=1&second=rcdsac_cvar-narrow&agent=rcdsac_cvar-narrow&paused=on"), 2
    )
    assert [field(page, "word", number) for number in (0, 1)] == ["careful", "neutral"]
    before = page.locator("#stage").bounding_box()
    for name in ("map0", "map1"):
        until(lambda name=name: model(page, name, "model.x_range.end - model.x_range.start") == pytest.approx(9.0))
        middle = model(page, name, "(model.x_range.start + model.x_range.end) / 2")
        assert middle == pytest.approx(places(page, name)[-1][0])
    page.get_by_role("button", name="zoom in").click()
    until(lambda: model(page, "map1", "model.x_range.end - model.x_range.start") == pytest.approx(20.8))
    for _ in range(2):
        page.keyboard.press("o")
    page.locator("#message", has_text="an obstacle stands there already").wait_for()
    assert page.locator("#stage").bounding_box() == before


def test_a_server_that_ends_is_said_to_and_one_that_answers_again_opens_the_scene(
    browser: BrowserContext, tmp_path: Path
) -> None:
    page = browser.new_page()
    with serving(tmp_path) as server:
        page.goto(f"{server.address}?agent=sac-narrow&seed=4&theme=dark&paused=on")
        standing(page, 2)
    page.locator("#message", has_text="The server does not answer").wait_for()
    with serving(tmp_path, server.port) as again:
        driving(page)
        assert again.num_drives == 1
        assert page.url.endswith("?agent=sac-narrow&seed=4&theme=dark")
        page.go_back()
        page.go_forward()
        driving(page)  # its own drive, not what a cache has kept of the one before
        page.close()


def test_two_robots_stand_side_by_side_in_a_narrow_window_too(opened, tmp_path) -> None:
    page = driving(opened("agent=rcdsac_pow-narrow&beta=-2&second=mppi&seed=3", dark=True))
    beside = (
        "() => document.querySelector('#robot1 .map').getBoundingClientRect().left"
        " >= document.querySelector('#robot0 .map').getBoundingClientRect().right"
    )
    assert page.evaluate(beside)
    assert page.evaluate("document.documentElement.dataset.theme") == "dark"
    assert field(page, "name", 1) == "mppi"
    picture(page, "two-dark", tmp_path)
    page.set_viewport_size({"width": 420, "height": 900})
    page.wait_for_function("document.querySelector('#robot0 .plot').getBoundingClientRect().width > 350")
    assert page.evaluate(beside)
    assert page.evaluate("document.documentElement.scrollWidth") <= 420  # nothing sticks out
    picture(page, "narrow", tmp_path)


LAID_OUT = """() => {
    const inside = (element) => [...element.children, ...(element.shadowRoot ? element.shadowRoot.children : [])];
    const leaves = (element) => element.matches("span, button, .bk-slider-title, .noUi-target")
        ? [element] : inside(element).flatMap(leaves);
    const boxes = leaves(document.querySelector("#bar")).map((element) => [element, element.getBoundingClientRect()])
        .filter(([element, box]) => box.width && element.textContent.trim() !== "" || element.matches(".noUi-target"))
        .filter(([, box]) => box.width);
    const wrong = [];
    boxes.forEach(([one, a], number) => boxes.slice(number + 1).forEach(([other, b]) => {
        const across = Math.min(a.right, b.right) - Math.max(a.left, b.left);
        if (across > 1.5 && Math.min(a.bottom, b.bottom) - Math.max(a.top, b.top) > 1.5)
            wrong.push([one.textContent, other.textContent, across]);
    }));
    return { count: boxes.length, wrong, width: document.documentElement.scrollWidth };
}"""


def test_nothing_in_the_bar_lies_over_anything_else_at_any_width(opened) -> None:
    page = standing(opened("agent=rcdsac_pow_wide-narrow&second=rcdsac_cvar-narrow&paused=on"))
    for width in (1280, 1000, 870, 768, 620, 390):
        page.set_viewport_size({"width": width, "height": 800})
        page.wait_for_function("(width) => window.innerWidth === width", arg=width)
        until(lambda width=width: page.evaluate(LAID_OUT)["width"] <= width)
        laid_out = page.evaluate(LAID_OUT)
        assert laid_out["wrong"] == [], width
        assert laid_out["count"] >= 18  # buttons, sliders with their titles, and what their ends mean
