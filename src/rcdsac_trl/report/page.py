"""One HTML file that holds the whole report: by day and by night, on a desk and on a telephone, without a network."""

import base64
import io
import re
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from html import escape
from itertools import groupby

import matplotlib
import pandas as pd
from matplotlib.figure import Figure

from rcdsac_trl.report.night import at_night
from rcdsac_trl.report.style import FAINT, GRID, INK, PAPER, VERDICTS

_LONG = 44
"""Letters that a text in a table may have on one line."""
_COLOR = re.compile(r"#[0-9a-f]{6}(?![0-9a-z])")

_STYLE = f"""
:root {{ color-scheme: light dark; }}
* {{ box-sizing: border-box; }}
body {{ font: 16px/1.55 system-ui, sans-serif; color: {INK}; background: {PAPER}; max-width: 72rem; margin: 0 auto;
  padding: 1.5rem 1rem 4rem; }}
h1, h2, h3 {{ font-weight: 650; line-height: 1.25; text-wrap: balance; }}
h1 {{ font-size: 1.75rem; margin: 0 0 0.75rem; }}
h2 {{ font-size: 1.3rem; margin: 3rem 0 0.75rem; padding-top: 1rem; border-top: 1px solid {GRID}; }}
h3 {{ font-size: 1.05rem; margin: 1.75rem 0 0.5rem; }}
p, li {{ max-width: 46rem; }}
a {{ color: inherit; text-underline-offset: 0.2em; }}
nav ol {{ columns: 18rem; padding-left: 1.4rem; margin: 1rem 0 0; }}
nav li {{ padding: 0.1rem 0; }}
.wide {{ margin: 1rem 0; }}
.scroll {{ width: fit-content; max-width: 100%; overflow-x: auto; border: 1px solid {GRID}; border-radius: 6px; }}
.cue {{ display: none; margin: 0 0 0.3rem; font-size: 0.85rem; }}
.goes-on > .cue {{ display: block; }}
.goes-on > .scroll {{ border-right: 3px dashed {FAINT}; }}
.at-end > .scroll {{ border-right: 1px solid {GRID}; }}
table {{ border-collapse: separate; border-spacing: 0; font-size: 0.875rem; font-variant-numeric: tabular-nums; }}
th, td {{ padding: 0.3rem 0.7rem; border-bottom: 1px solid {GRID}; white-space: nowrap; text-align: right; }}
th {{ font-weight: 600; }}
thead th {{ vertical-align: bottom; }}
thead th.group {{ text-align: center; }}
.text {{ text-align: left; }}
.long {{ white-space: normal; min-width: 16rem; }}
tbody th {{ text-align: left; position: sticky; left: 0; background: {PAPER}; font-weight: 500; }}
.picture img {{ display: block; min-width: 52rem; max-width: 100%; }}
tbody tr:last-child > * {{ border-bottom: 0; }}
.figures {{ display: grid; grid-template-columns: repeat(auto-fit, minmax(min(100%, 28rem), 1fr)); gap: 1rem 2rem;
  margin: 1rem 0; align-items: start; }}
.figures svg {{ width: 100%; max-width: 36rem; height: auto; }}
svg text {{ font-family: system-ui, sans-serif !important; fill: {INK}; }}
.cards {{ display: grid; grid-template-columns: repeat(auto-fill, minmax(min(100%, 30rem), 1fr)); gap: 0.75rem;
  margin: 0.75rem 0; }}
.card {{ border: 1px solid {GRID}; border-left: 4px solid var(--told); border-radius: 6px; padding: 0.7rem 0.9rem; }}
.card b {{ color: var(--told); }}
.card h4 {{ margin: 0 0 0.3rem; font-size: 1rem; line-height: 1.35; }}
.card p {{ margin: 0.35rem 0 0; font-size: 0.9rem; }}
.card .note {{ font-size: 0.82rem; }}
details {{ margin: 1rem 0; }}
summary {{ cursor: pointer; }}
@media (max-width: 40rem) {{ tbody th, tbody th.long {{ white-space: normal;
  min-width: 8.5rem; max-width: 9.5rem; }} h1 {{ font-size: 1.4rem; }} }}
@media print {{ .cue {{ display: none !important; }} details > * {{ display: block; }} }}
"""

# Says beside a table that it goes on to the right, while it does.
_SCRIPT = """
for (const wide of document.querySelectorAll('.wide')) {
  const inner = wide.querySelector('.scroll');
  const look = () => {
    wide.classList.toggle('goes-on', inner.scrollWidth > inner.clientWidth + 1);
    wide.classList.toggle('at-end', inner.scrollLeft + inner.clientWidth >= inner.scrollWidth - 1);
  };
  inner.addEventListener('scroll', look, {passive: true});
  new ResizeObserver(look).observe(inner);
}
"""


@dataclass(frozen=True)
class Figures:
    """Figures that stand side by side where there is room.

    Attributes:
        figures: they.
        legend: stands above them; None: they have none.
    """

    figures: Sequence[Figure]
    legend: Figure | None = None


@dataclass(frozen=True)
class Picture:
    """A large figure of many points, on white paper by night, too; small screens scroll it sideways.

    Attributes:
        figure: it.
        says: what a reader who cannot see it is told.
    """

    figure: Figure
    says: str


@dataclass(frozen=True)
class Card:
    """A verdict with what it is of.

    Attributes:
        heading: the claim.
        verdict: a key of :data:`rcdsac_trl.report.style.VERDICTS`.
        text: the numbers.
        notes: smaller, one a line.
    """

    heading: str
    verdict: str
    text: str
    notes: Sequence[str] = ()


@dataclass(frozen=True)
class Heading:
    """A heading inside a section."""

    text: str


@dataclass(frozen=True)
class Folded:
    """What is shown when its line is clicked."""

    line: str
    parts: "Sequence[Part]"


Part = str | pd.DataFrame | Figures | Picture | Sequence[Card] | Heading | Folded


@dataclass(frozen=True)
class Section:
    """A heading, which the contents list, and what stands below it."""

    heading: str
    parts: Sequence[Part]


def page(title: str, lead: Sequence[str], sections: Sequence[Section]) -> str:
    """Return a self-contained page.

    Args:
        title: of the page, which says what it is of.
        lead: paragraphs before the contents.
        sections: in their order.
    """
    entries = [f'<li><a href="#{_anchor(one.heading)}">{escape(one.heading)}</a></li>' for one in sections]
    body = [
        f"<header>\n<h1>{escape(title)}</h1>",
        *(f"<p>{escape(text)}</p>" for text in lead),
        '<nav aria-label="Contents"><ol>',
        *entries,
        "</ol></nav>\n</header>\n<main>",
    ]
    for section in sections:
        body.append(f'<section>\n<h2 id="{_anchor(section.heading)}">{escape(section.heading)}</h2>')
        body += [_part(part) for part in section.parts]
        body.append("</section>")
    content, colors = _themed("\n".join(body))
    styled, of_style = _themed(_STYLE)
    return (
        f'<!DOCTYPE html>\n<html lang="en">\n<head>\n<meta charset="utf-8">\n<title>{escape(title)}</title>\n'
        f'<meta name="viewport" content="width=device-width, initial-scale=1">\n<style>{_themes(colors | of_style)}'
        f"{styled}</style>\n</head>\n<body>\n{content}\n</main>\n<script>{_SCRIPT}</script>\n</body>\n</html>\n"
    )


def svg(figure: Figure) -> str:
    """Return a figure as an SVG element, whose texts are texts and whose paper is what is behind it.

    Args:
        figure: its first title is what a reader who cannot see it is told.
    """
    written = io.StringIO()
    with matplotlib.rc_context({"svg.fonttype": "none", "svg.hashsalt": "rcdsac_trl"}):
        figure.savefig(written, format="svg", transparent=True, metadata={"Date": None, "Creator": None})
    text = written.getvalue()
    element = text[text.index("<svg") :]
    # What is drawn is described by its title, not by matplotlib's names, which stand in every figure again.
    element = re.sub(r"<metadata>.*?</metadata>", "", element, flags=re.DOTALL)
    element = re.sub(r'<g id="[^"]*"', "<g", element)
    size = re.search(r'viewBox="[^"]*"', element)
    assert size is not None
    title = next((axes.get_title(loc="left") for axes in figure.axes), "")
    inside = element[element.index(">") + 1 :]
    return f'<svg {size.group()} role="img" aria-label="{escape(" ".join(title.split()))}">{inside}'


def _part(part: Part) -> str:
    if isinstance(part, str):
        return f"<p>{escape(part)}</p>"
    if isinstance(part, pd.DataFrame):
        return _table(part)
    if isinstance(part, Figures):
        rows = [[part.legend] if part.legend else [], part.figures]
        return "\n".join(f'<div class="figures">{"".join(map(svg, figures))}</div>' for figures in rows if figures)
    if isinstance(part, Picture):
        return _picture(part)
    if isinstance(part, Heading):
        return f"<h3>{escape(part.text)}</h3>"
    if isinstance(part, Folded):
        inside = "\n".join(map(_part, part.parts))
        return f"<details><summary>{escape(part.line)}</summary>\n{inside}\n</details>"
    return '<div class="cards">\n' + "\n".join(map(_card, part)) + "\n</div>"


def _picture(picture: Picture) -> str:
    written = io.BytesIO()
    picture.figure.savefig(written, format="png", dpi=110)
    data = base64.b64encode(written.getvalue()).decode()
    return _scrolling("picture", picture.says, f'<img alt="{escape(picture.says)}" src="data:image/png;base64,{data}">')


def _scrolling(what: str, says: str, inside: str) -> str:
    """Return what scrolls sideways where it is wider than the page, and says so."""
    return (
        f'<div class="wide {what}"><p class="cue">This {what} goes on to the right: scroll it sideways \u2192</p>'
        f'<div class="scroll" tabindex="0" role="region" aria-label="{escape(says)}">{inside}</div></div>'
    )


def _card(card: Card) -> str:
    notes = "".join(f'<p class="note">{_unbroken(note)}</p>' for note in card.notes if note)
    text = f"<p>{_unbroken(card.text)}</p>" if card.text else ""
    return (
        f'<article class="card" style="--told: {VERDICTS[card.verdict]}"><h4>{_unbroken(card.heading)}: '
        f"<b>{escape(card.verdict)}</b></h4>{text}{notes}</article>"
    )


def _table(table: pd.DataFrame) -> str:
    """Return a table of text whose first column names its rows; pairs of columns get a row of headings for groups."""
    columns = [column if isinstance(column, tuple) else ("", str(column)) for column in table.columns]
    kinds = [_kind(table.iloc[:, number].astype(str).tolist()) for number in range(len(columns))]
    head = []
    if any(group for group, _ in columns):
        spans = [(group, len(list(of))) for group, of in groupby(group for group, _ in columns)]
        cells = (f'<th class="group" colspan="{span}">{escape(group)}</th>' for group, span in spans)
        head.append(f"<tr>{''.join(cells)}</tr>")
    names = (f"<th{kind} scope=col>{escape(name)}</th>" for (_, name), kind in zip(columns, kinds, strict=True))
    head.append(f"<tr>{''.join(names)}</tr>")
    rows = []
    for first, *rest in table.astype(str).to_numpy().tolist():
        cells = (f"<td{kind}>{_unbroken(cell)}</td>" for cell, kind in zip(rest, kinds[1:], strict=True))
        rows.append(f"<tr><th{kinds[0]} scope=row>{_unbroken(first)}</th>{''.join(cells)}</tr>")
    inside = f"<table><thead>{''.join(head)}</thead><tbody>{''.join(rows)}</tbody></table>"
    return _scrolling("table", f"Table: {', '.join(name for _, name in columns)}", inside)


def _kind(cells: Sequence[str]) -> str:
    """Return the class of a column: numbers, with intervals and units or not, have none; long texts are broken."""
    if all(re.match(r"$|-$|\[?[-+<]?\d", cell) for cell in cells):
        return ""
    return ' class="text long"' if max(map(len, cells)) > _LONG else ' class="text"'


def _unbroken(text: str) -> str:
    """Return an escaped text that keeps a symbol on one line with its value."""
    return escape(text).replace(" = ", "\u00a0=\u00a0")


def _anchor(heading: str) -> str:
    return re.sub(r"[^a-z0-9]+", "-", heading.lower()).strip("-")


def _themed(text: str) -> tuple[str, set[str]]:
    """Name all colours of a text, so that they can be others by night, and return them."""
    return _COLOR.sub(lambda color: f"var(--c{color.group()[1:]})", text), set(_COLOR.findall(text))


def _themes(colors: Iterable[str]) -> str:
    """Return what the names of colours stand for, by day and by night."""
    by_day = "".join(f"--c{color[1:]}:{color};" for color in sorted(colors))
    by_night = "".join(f"--c{color[1:]}:{at_night(color)};" for color in sorted(colors))
    return f"\n:root {{{by_day}}}\n@media (prefers-color-scheme: dark) {{ :root {{{by_night}}} }}"
