"""The colours: legible for colour-blind readers, and spelled in one place."""

import ast
import itertools
import json
import re
from dataclasses import asdict
from pathlib import Path

import matplotlib
import matplotlib.colors
import pytest

import rcdsac_trl
from rcdsac_trl.colors import BETA_SCALE, CAPTIONS, DARK, LIGHT, SERIES, Palette, beta_shades, faded, mixed, shades
from vision import BLINDNESS, apart, contrast

SOURCE = Path(rcdsac_trl.__file__).parent
THEMES = pytest.mark.parametrize("palette", [LIGHT, DARK], ids=["light", "dark"])
# What a reader of a map has to tell apart.
THINGS = ("wall", "mapped", "unmapped", "mover", "robot", "way", "touching", "remembered", "obstacle")
# How near two things may come in OKLab: the module's docstring says so.
NEAREST = {"none": 0.10, "deuteranopia": 0.10, "protanopia": 0.06, "tritanopia": 0.05}


def test_the_measures_are_those_of_their_authors() -> None:
    assert contrast("#000000", "#ffffff") == pytest.approx(21.0)
    assert contrast("#777777", "#ffffff") == pytest.approx(4.48, abs=0.005)
    assert apart("#000000", "#ffffff", "none") == pytest.approx(1.0, abs=1e-3)
    # To an eye without its middle cones, these are the same yellow; to others, red is not green.
    assert apart("#c04000", "#6c6c00", "deuteranopia") < 0.05 < 0.15 < apart("#c04000", "#6c6c00", "none")


@THEMES
def test_things_contrast_with_the_floor(palette: Palette) -> None:
    colors = asdict(palette)
    weak = {name: contrast(colors[name], palette.floor) for name in (*THINGS, "goal", "hit", "trail")}
    assert min(weak.values()) >= 3.0, weak
    for name in ("ink", "faint", "accent", "alarm", "good", "unsure"):
        for behind in ("page", "card"):
            assert contrast(colors[name], colors[behind]) >= 4.5, (name, behind)
    assert contrast(palette.arrow, palette.robot) >= 3.0


@THEMES
@pytest.mark.parametrize("blindness", BLINDNESS)
def test_things_are_told_apart_by_colour_blind_readers(palette: Palette, blindness: str) -> None:
    colors = asdict(palette)
    near = {pair: apart(colors[pair[0]], colors[pair[1]], blindness) for pair in itertools.combinations(THINGS, 2)}
    assert min(near.values()) >= NEAREST[blindness], min(near, key=near.__getitem__)


@THEMES
@pytest.mark.parametrize("blindness", BLINDNESS)
def test_verdicts_are_told_apart_by_colour_blind_readers(palette: Palette, blindness: str) -> None:
    for one, other in itertools.combinations((palette.good, palette.alarm, palette.unsure, palette.faint), 2):
        assert apart(one, other, blindness) >= 0.045, (one, other)


def test_curves_are_told_apart_by_colour_blind_readers() -> None:
    for one, other in itertools.combinations(SERIES, 2):
        assert apart(one, other, "deuteranopia") >= 0.1, (one, other)
    for color in (*SERIES, *BETA_SCALE):
        assert contrast(color, LIGHT.card) >= 3.0, color
    # Four betas are what an agent is evaluated at.
    for blindness in BLINDNESS:
        for one, other in itertools.pairwise(beta_shades(4)):
            assert apart(one, other, blindness) >= 0.08, (one, other, blindness)


def test_scales_go_from_end_to_end() -> None:
    assert beta_shades(1) == [BETA_SCALE[0]]
    assert beta_shades(3) == list(BETA_SCALE)
    assert shades(("#000000", "#0000c8"), 5) == ["#000000", "#000032", "#000064", "#000096", "#0000c8"]
    assert mixed("#000000", "#ff8000", 0.25) == "#402000"
    assert faded("#112233", 0.2) == "#11223333"


def test_captions_are_of_colours() -> None:
    assert CAPTIONS.keys() <= asdict(LIGHT).keys()


# ------------------------------------------------------------------------------------------------ one place
ROOT = Path(__file__).parents[1]
PROGRAMS = (ROOT / "docs" / "images", ROOT / "benchmarks")
SOURCES = sorted(path for path in SOURCE.rglob("*") if path.suffix in (".py", ".css", ".html", ".js"))
HEXADECIMAL = re.compile(r"#(?:[0-9a-fA-F]{3,4}){1,2}\b|\brgba?\(|\bhsla?\(")
# Names of colours and of colour maps; of the one letter that Matplotlib takes, none is told from text.
NAMES = {
    *matplotlib.colors.CSS4_COLORS,
    *matplotlib.colors.TABLEAU_COLORS,
    *matplotlib.colormaps,
    *(f"C{number}" for number in range(10)),
}
NAMED_IN_STYLES = re.compile(rf":[^;{{}}]*\b(?:{'|'.join(matplotlib.colors.CSS4_COLORS)})\b(?!-)")


def spelled_in_python(text: str) -> list[int]:
    """Return the lines that spell a colour: in hexadecimal, by name, or as numbers given for one."""
    tree = ast.parse(text)
    documented = {id(node.value) for node in ast.walk(tree) if isinstance(node, ast.Expr)}
    lines = []
    for node in ast.walk(tree):
        if isinstance(node, ast.Constant) and isinstance(node.value, str) and id(node) not in documented:
            if node.value in NAMES or HEXADECIMAL.search(node.value):
                lines.append(node.lineno)
        elif isinstance(node, ast.Tuple) and len(node.elts) in (3, 4):
            parts = [part.value for part in node.elts if isinstance(part, ast.Constant) and type(part.value) is int]
            # As bytes: what counts things is smaller, and as an alpha it would show nothing.
            if len(parts) == len(node.elts) and max(parts) <= 255 and sum(parts) > 96 and (parts[3:] or [255])[0] > 15:
                lines.append(node.lineno)
    return lines


def spelled_in_style(text: str) -> list[int]:
    """Return the lines of a style sheet, a page or a script that spell a colour."""
    return [
        number
        for number, line in enumerate(text.splitlines(), start=1)
        if HEXADECIMAL.search(re.sub(r"querySelector\([^)]*\)|href=\S+", "", line)) or NAMED_IN_STYLES.search(line)
    ]


def test_what_spells_a_colour_is_found() -> None:
    lines = ['"""#123456"""', 'c = "#12ab9f"', 'c = "white"', 'm = "viridis"', "c = (250, 250, 248)", "n = (6, 7, 8)"]
    assert spelled_in_python("\n".join(lines)) == [2, 3, 4, 5]
    lines = ["a { color: var(--ink); }", "b { color: white; }", ".c { white-space: pre; }", "d { fill: #fff; }"]
    assert spelled_in_style("\n".join(lines)) == [2, 4]


def test_no_other_module_spells_a_colour() -> None:
    spelled = {
        path.relative_to(SOURCE).as_posix(): lines
        for path in SOURCES
        if (lines := (spelled_in_python if path.suffix == ".py" else spelled_in_style)(path.read_text("utf-8")))
    }
    assert spelled.pop("colors.py")
    assert not spelled


def test_nor_does_a_program_or_a_notebook() -> None:
    texts = {path.name: path.read_text("utf-8") for folder in PROGRAMS for path in folder.glob("*.py")}
    for path in (ROOT / "notebooks").glob("*.ipynb"):
        cells = [cell["source"] for cell in json.loads(path.read_text("utf-8"))["cells"] if cell["cell_type"] == "code"]
        # IPython's own commands are not Python.
        texts[path.name] = "\n".join(re.sub(r"^%.*", "", "".join(cell), flags=re.M) for cell in cells)
    assert len(texts) > 10
    assert not {name: lines for name, text in texts.items() if (lines := spelled_in_python(text))}
