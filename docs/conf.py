"""How Sphinx makes a site of these pages: ``make docs``."""

import shutil
import sys
from pathlib import Path

from sphinx.application import Sphinx

import rcdsac_trl

DOCS = Path(__file__).resolve().parent
sys.path.insert(0, str(DOCS / "extensions"))

import api_reference  # noqa: E402 (found by the line above)
import conf_reference  # noqa: E402

# Every page of the site, part by part. It stands here, not in index.md, so that the pages stay plain Markdown.
NAVIGATION = {
    "Tutorials": [
        "tutorials/drive",
        "tutorials/train",
        "tutorials/own-map",
        "tutorials/own-robot",
        "tutorials/own-measure",
    ],
    "How-to: train and measure": [
        "running",
        "continue",
        "evaluate",
        "agents",
        "report",
        "calibrate",
        "planners",
        "scaling-out",
        "python",
    ],
    "How-to: drive": [
        "play",
        "robot",
        "ros",
        "nav2",
        "replay",
        "office-course",
        "your-building",
        "your-robot",
    ],
    "Results": [
        "results",
        "results-paper",
        "results-trainings",
        "results-beta",
        "results-navigation",
        "results-calibration",
        "results-earlier",
    ],
    "Reference": [
        "run-folder",
        "reference/commands",
        "reference/configuration",
        *api_reference.PAGES,
        "reference/changelog",
    ],
    "Explanation": ["agent", "world", "differences", "study", "off-the-maps", "speed"],
}

project = "rcdsac_trl"
author = "The rcdsac_trl developers"
version = release = rcdsac_trl.__version__
html_title = f"{project} {version}"

extensions = ["myst_parser", "sphinx.ext.autodoc", "sphinx.ext.napoleon", "api_reference", "mathml"]
exclude_patterns = ["extensions"]
# Links lead to headings by the names that GitHub gives them.
myst_heading_anchors = 3
# Blocks without a language are commands and keys.
highlight_language = "none"
# Quotes stay as they are written; dashes are Sphinx's own, between a parameter and what it is.
smartquotes_action = "D"
# A single backtick is code in docstrings, as in Markdown.
default_role = "code"
autodoc_default_options = {"members": True}
autodoc_preserve_defaults = True
autodoc_member_order = "bysource"
autodoc_typehints_format = "short"
napoleon_use_ivar = True
napoleon_use_rtype = False

html_math_renderer = "mathml"
html_theme = "furo"
html_copy_source = False
html_show_copyright = False


def _write_reference(app: Sphinx) -> None:
    """Write the generated pages, and leave none of those that were before."""
    folder = Path(app.srcdir, "reference")
    shutil.rmtree(folder, ignore_errors=True)
    folder.mkdir()
    changelog = {"reference/changelog": (DOCS.parent / "CHANGELOG.md").read_text("utf-8")}
    for name, text in (conf_reference.pages() | api_reference.pages() | changelog).items():
        Path(app.srcdir, f"{name}.md").write_text(text, "utf-8")


def _add_navigation(app: Sphinx, name: str, source: list[str]) -> None:
    """Put the navigation below the front page."""
    if name == "index":
        for caption, pages in NAVIGATION.items():
            source[0] += "\n".join(["\n```{toctree}", ":hidden:", f":caption: {caption}", "", *pages, "```\n"])


def setup(app: Sphinx) -> None:
    """Connect what this file adds to Sphinx."""
    app.connect("builder-inited", _write_reference)
    app.connect("source-read", _add_navigation)
