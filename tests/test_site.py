"""The documentation as a site: what its navigation and its reference name, and that it builds and can be searched."""

import doctest
import re
import runpy
import shutil
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest
import yaml
from playwright.sync_api import sync_playwright

from rcdsac_trl.config.paths import CONF_DIR
from rcdsac_trl.config.verb_help import explained_defaults, explained_keys

ROOT = Path(__file__).resolve().parents[1]
DOCS = ROOT / "docs"
CHROMIUM = shutil.which("chromium") or shutil.which("chromium-browser") or shutil.which("google-chrome")
ESCAPES = re.compile(r"\\(?=[\W_])")


@pytest.fixture(scope="module")
def configuration() -> dict[str, Any]:
    """What docs/conf.py defines; it also makes its extensions importable."""
    return runpy.run_path(str(DOCS / "conf.py"))


def test_the_navigation_names_every_page_once(configuration: dict[str, Any]) -> None:
    named = [page for pages in configuration["NAVIGATION"].values() for page in pages]
    generated = configuration["conf_reference"].pages() | configuration["api_reference"].pages()
    # Those of the groups are listed by the page on the configuration.
    listed = re.findall(r"^conf-.*$", generated["reference/configuration"], re.M)
    written = {path.relative_to(DOCS).with_suffix("").as_posix() for path in DOCS.rglob("*.md")}
    written = {name for name in written if name != "index" and not name.startswith("reference/")}
    assert sorted([*named, *(f"reference/{name}" for name in listed)]) == sorted(
        [*written, *generated, "reference/changelog"]
    )


def test_the_reference_has_every_key_with_its_comment(configuration: dict[str, Any]) -> None:
    pages = configuration["conf_reference"].pages()
    paths = sorted(CONF_DIR.rglob("*.yaml"))
    assert len(paths) > 50
    for path in paths:
        group = path.parent.relative_to(CONF_DIR).as_posix()
        page = pages["reference/commands" if group == "." else f"reference/conf-{group.replace('/', '-')}"]
        (section,) = re.findall(rf"^## {path.stem}\n(.*?)(?=^## |\Z)", page, re.M | re.S)
        rows = [line for line in ESCAPES.sub("", section).splitlines() if line.startswith("| `")]
        if path.read_text() and not yaml.safe_load(path.read_text()):
            assert rows == []
            continue
        keys = [key for key in explained_keys(path) if key.comment or not key.name.startswith("hydra")]
        explained = [*explained_defaults(path), *keys]
        assert len(rows) == len(explained), path
        for row, found in zip(rows, explained, strict=True):
            assert row.startswith(f"| `{found.name}` |"), path
            assert found.comment in row, path


def test_what_is_written_of_a_file(configuration: dict[str, Any], tmp_path: Path) -> None:
    (tmp_path / "robot").mkdir()
    (tmp_path / "robot" / "own.yaml").write_text(
        "# @package _global_\n# Ours: a_b | c.\ndefaults:\n  - paper\n  - _self_\n\n# [tb4] `a|b`,\n# m\nname: own\n"
        "lidar:\n  # <deg>\n  field: [[-1.0, 2.0]]\nlast: null\n"
    )
    (tmp_path / "robot" / "paper.yaml").write_text("# name of it\nname: paper\n")
    assert configuration["conf_reference"].pages(tmp_path)["reference/conf-robot"] == (
        "# robot\n\n## own\n\nOurs: a\\_b \\| c.\n\nWhat is not said here is as in `paper`.\n\n"
        "| key | value | meaning |\n|---|---|---|\n"
        "| `name` | `own` | \\[tb4\\] `a\\|b`, m |\n"
        "| `lidar` |  |  |\n"
        "| `lidar.field` | `[[-1.0, 2.0]]` | \\<deg\\> |\n"
        "| `last` | `null` |  |\n\n"
        "\n## paper\n\n"
        "| key | value | meaning |\n|---|---|---|\n"
        "| `name` | `paper` | name of it |\n\n"
    )


@pytest.mark.parametrize("name", ["api_reference", "conf_reference"])
def test_examples_of_the_extensions(configuration: dict[str, Any], name: str) -> None:
    outcome = doctest.testmod(configuration[name])
    assert outcome.attempted > 0
    assert outcome.failed == 0


@pytest.fixture(scope="module")
def site(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The site as `make docs` builds it, every warning an error."""
    folder = tmp_path_factory.mktemp("site")
    command = [sys.executable, "-m", "sphinx", "-W", "--keep-going", "-q", "-d", str(folder / "doctrees")]
    done = subprocess.run([*command, str(DOCS), str(folder / "html")], capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    return folder / "html"


@pytest.mark.slow
def test_the_site_builds_and_fetches_nothing(site: Path, configuration: dict[str, Any]) -> None:
    front = (site / "index.html").read_text("utf-8")
    for caption, names in configuration["NAVIGATION"].items():
        assert caption in front
        assert [name for name in names if f'href="{name}.html"' not in front] == []
    for page in site.rglob("*.html"):
        tags = re.findall(r"<(?:link|script|img|iframe|source)\b[^>]*>", page.read_text("utf-8"))
        assert [tag for tag in tags if re.search(r"""=["']?(?:https?:)?//""", tag)] == [], page
    for style in site.rglob("*.css"):
        assert not re.search(r"url\(.?(?:https?:)?//|@import", style.read_text("utf-8")), style
    learner = (site / "reference" / "learner.html").read_text("utf-8")
    assert "<msub>" in learner  # formulas are MathML
    assert 'id="rcdsac_trl.agent.risk.CVaR"' in learner
    assert 'id="rcdsac_trl.deploy.Policy.act"' in (site / "reference" / "deploy.html").read_text("utf-8")


@pytest.mark.slow
@pytest.mark.skipif(CHROMIUM is None, reason="there is no Chromium to search in: apt-get install chromium")
def test_the_search_finds_pages_without_a_server(site: Path) -> None:
    asked: list[str] = []
    with sync_playwright() as playwright:
        browser = playwright.chromium.launch(executable_path=CHROMIUM, args=["--headless", "--no-sandbox"])
        page = browser.new_page()
        page.set_default_timeout(120_000)
        page.on("request", lambda request: asked.append(request.url))
        page.goto((site / "index.html").as_uri())
        page.locator("input[type=search], input.sidebar-search").first.fill("watchdog")
        page.keyboard.press("Enter")
        page.wait_for_selector("#search-results li a")
        titles = page.locator("#search-results li a").all_inner_texts()
        browser.close()
    assert "On a robot" in " ".join(titles)
    assert [url for url in asked if not url.startswith(("file:", "data:"))] == []
