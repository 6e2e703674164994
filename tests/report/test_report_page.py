"""The page of a report: what it is made of, and how a browser shows it."""

import itertools
import re
import shutil
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
from matplotlib.figure import Figure
from playwright.sync_api import Browser, Page, sync_playwright

from rcdsac_trl.colors import DARK, SERIES, shades
from rcdsac_trl.report.comparison_figures import THING_COLORS
from rcdsac_trl.report.night import at_night
from rcdsac_trl.report.page import Card, Figures, Folded, Heading, Picture, Section, page, svg
from rcdsac_trl.report.style import FAINT, GRID, INK, PAPER, VERDICTS, series, style
from vision import BLINDNESS, apart, contrast, luminance

CHROMIUM = shutil.which("chromium") or shutil.which("chromium-browser") or shutil.which("google-chrome")


@pytest.mark.parametrize("color", [INK, *VERDICTS.values()])
def test_texts_can_be_read_by_day_and_by_night(color: str) -> None:
    assert contrast(color, PAPER) > 4.5
    assert contrast(at_night(color), DARK.card) > 4.5


def test_lines_can_be_seen_by_night_and_stay_in_their_order() -> None:
    by_day = shades(("#440154", "#9bd93c"), 6)  # none of the palette
    assert np.diff([luminance(color) for color in by_day]).min() > 0.0
    by_night = [at_night(color) for color in by_day]
    assert np.diff([luminance(color) for color in by_night]).max() < 0.0
    named = [at_night(color) for color in series(len(SERIES))]
    assert min(contrast(color, DARK.card) for color in [*by_night, *named, at_night(FAINT)]) > 3.0
    assert contrast(at_night(GRID), DARK.card) < 2.0


@pytest.mark.parametrize("blindness", BLINDNESS)
@pytest.mark.parametrize("by_day", [SERIES, tuple(THING_COLORS.values()), tuple(VERDICTS.values())])
def test_colours_are_told_apart_by_night_too(by_day: tuple[str, ...], blindness: str) -> None:
    for one, other in itertools.combinations(map(at_night, by_day), 2):
        assert apart(one, other, blindness) >= 0.05, (one, other)


def test_walls_and_clutter_stand_back_by_night_in_the_order_of_the_day() -> None:
    things = [THING_COLORS[name] for name in ("outer_wall", "inner_wall", "mapped_clutter")]
    for theme, colors in ((PAPER, things), (DARK.card, [at_night(color) for color in things])):
        contrasts = [contrast(color, theme) for color in colors]
        assert contrasts == sorted(contrasts, reverse=True)
        assert contrasts[-1] > 3.0


def figure() -> Figure:
    drawn = Figure(figsize=(4.6, 3.3), layout="constrained")
    axes = drawn.subplots()
    axes.plot([0, 1, 2], [1, 0, 2], marker="o", color=INK)
    style(axes, "collisions & <reward>", "β")
    return drawn


def test_a_figure_is_text_and_names_of_colours() -> None:
    element = svg(figure())
    assert 'aria-label="collisions &amp; &lt;reward&gt;"' in element
    assert "β</text>" in element
    assert not re.findall(r' id="(?:figure|axes|text)', element)  # would stand in every figure of a page
    assert svg(figure()) == element


TABLE = pd.DataFrame(
    [["RC-DSAC (resample) CVaR β = 0.25", *("12.34 [10.00, 14.00]",) * 8, "a word"]],
    columns=pd.MultiIndex.from_tuples([("", "agent"), *(("narrow", f"number {i}") for i in range(8)), ("", "said")]),
)


def sections() -> list[Section]:
    card = Card("A claim <of> many words that need more than one line of a telephone", "does not hold", "1 or 2", ["!"])
    picture = Figure(figsize=(11.0, 3.0))
    picture.subplots()
    return [
        Section("Do they hold?", ["A & B.", Heading("Narrow"), [card], Folded("more", ["Folded in."])]),
        Section("Figures", [Figures([figure(), figure()]), TABLE, Picture(picture, "many points")]),
    ]


def test_the_page_is_escaped_and_its_contents_lead_somewhere() -> None:
    text = page("A <title>", ["Lead & more."], sections())
    assert "<title>A &lt;title&gt;</title>" in text
    assert "<p>Lead &amp; more.</p>" in text
    assert '<li><a href="#do-they-hold">Do they hold?</a></li>' in text
    assert '<h2 id="do-they-hold">' in text
    assert "<b>does not hold</b>" in text
    assert '<th class="group" colspan="8">narrow</th>' in text
    assert "<td>12.34 [10.00, 14.00]</td>" in text
    assert '<td class="text">a word</td>' in text
    assert "<summary>more</summary>" in text


# ------------------------------------------------------------------------------------------------ in a browser
@pytest.fixture(scope="module")
def browser() -> Iterator[Browser]:
    if CHROMIUM is None:
        pytest.skip("there is no Chromium to open the page in: apt-get install chromium (make test says more)")
    with sync_playwright() as playwright:
        opened = playwright.chromium.launch(executable_path=CHROMIUM, args=["--headless", "--no-sandbox"])
        yield opened
        opened.close()


def shown(browser: Browser, folder: Path, width: int, scheme: str) -> Page:
    """Open the page offline."""
    (folder / "report.html").write_text(page("Title", ["Lead."], sections()), encoding="utf-8")
    context = browser.new_context(
        viewport={"width": width, "height": 800},
        color_scheme="dark" if scheme == "dark" else "light",
        offline=True,
    )
    opened = context.new_page()
    opened.set_default_timeout(300_000)
    opened.goto(f"file://{folder / 'report.html'}")
    return opened


def color_of(opened: Page, selector: str, what: str) -> str:
    found = str(opened.evaluate(f"getComputedStyle(document.querySelector('{selector}')).{what}"))
    return "#" + bytes(map(int, re.findall(r"\d+", found)[:3])).hex()


def test_a_telephone_by_night(browser: Browser, tmp_path: Path) -> None:
    opened = shown(browser, tmp_path, 390, "dark")
    assert opened.evaluate("document.documentElement.scrollWidth") == 390  # tables scroll, the page does not
    assert color_of(opened, "body", "backgroundColor") == DARK.card
    assert color_of(opened, "svg text", "fill") == at_night(INK)
    assert opened.locator(".table .cue").is_visible()
    assert opened.locator(".picture .cue").is_visible()
    # Texts of figures are as large as can be read: 9 points of 4.6 inches of which 358 pixels are left.
    assert opened.evaluate("document.querySelector('svg text').getBoundingClientRect().height") > 9.0
    opened.evaluate("document.querySelector('.table .scroll').scrollTo(99999, 0)")
    opened.wait_for_selector(".table.at-end")
    first = "document.querySelector('tbody th').getBoundingClientRect().left"
    assert opened.evaluate(first) >= 0.0  # what names the row stays


def test_a_desk_by_day(browser: Browser, tmp_path: Path) -> None:
    opened = shown(browser, tmp_path, 1920, "light")
    assert color_of(opened, "body", "backgroundColor") == PAPER
    tops = opened.evaluate("[...document.querySelectorAll('.figures svg')].map(one => one.getBoundingClientRect().top)")
    assert tops[0] == tops[1]  # side by side
    assert not opened.locator(".picture .cue").is_visible()
    assert not opened.locator("text=Folded in.").is_visible()
    opened.click("summary")
    assert opened.locator("text=Folded in.").is_visible()
