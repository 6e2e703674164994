"""One HTML file that holds the whole report."""

import base64
import io
from collections.abc import Sequence
from html import escape

import pandas as pd
from matplotlib.figure import Figure

from rcdsac_trl.colors import LIGHT, css_variables
from rcdsac_trl.report.table import html

_STYLE = (
    f":root {{ {css_variables(LIGHT)} }}"
    """
body { font: 16px/1.5 system-ui, sans-serif; color: var(--ink); max-width: 68rem; margin: 2rem auto; padding: 0 1rem; }
h1, h2 { font-weight: 600; line-height: 1.2; }
img { max-width: 100%; }
.table { overflow-x: auto; }
table { border-collapse: collapse; font-size: 0.85rem; font-variant-numeric: tabular-nums; }
th, td { text-align: left; padding: 0.2rem 0.6rem; border-bottom: 1px solid var(--edge); white-space: nowrap; }
th { border-bottom: 1px solid var(--faint); }
"""
)

Part = str | pd.DataFrame | Figure


def page(title: str, sections: Sequence[tuple[str, Sequence[Part]]]) -> str:
    """Return a self-contained page.

    Args:
        title: of the page.
        sections: headings, each with paragraphs, tables of text, and figures.
    """
    body = [f"<h1>{escape(title)}</h1>"]
    for heading, parts in sections:
        body.append(f"<h2>{escape(heading)}</h2>")
        body += [_part(part) for part in parts]
    return (
        f'<!DOCTYPE html>\n<html lang="en">\n<head>\n<meta charset="utf-8">\n<title>{escape(title)}</title>\n'
        f'<meta name="viewport" content="width=device-width">\n<style>{_STYLE}</style>\n</head>\n<body>\n'
        + "\n".join(body)
        + "\n</body>\n</html>\n"
    )


def _part(part: Part) -> str:
    if isinstance(part, str):
        return f"<p>{escape(part)}</p>"
    if isinstance(part, pd.DataFrame):
        return f'<div class="table">{html(part)}</div>'
    data = io.BytesIO()
    part.savefig(data, format="png", dpi=110)
    return f'<img alt="" src="data:image/png;base64,{base64.b64encode(data.getvalue()).decode()}">'
