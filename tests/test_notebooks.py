"""The notebooks run from top to bottom, and are saved with what they show."""

import copy
from collections.abc import Callable, Iterator
from pathlib import Path

import nbformat
import pytest
from nbclient import NotebookClient
from nbformat.v4 import new_code_cell, new_notebook

FOLDER = Path(__file__).parents[1] / "notebooks"
NOTEBOOKS = sorted(path.name for path in FOLDER.glob("*.ipynb"))
# What its training takes in a test instead of a minute: as many iterations, each of them short.
SHORT = {
    "3_your_own_risk_measure.ipynb": {
        "task.episode_steps=200": "task.episode_steps=20",
        "updates_per_iteration: 40": "updates_per_iteration: 1",
    }
}


def shortened(notebook: nbformat.NotebookNode, name: str) -> nbformat.NotebookNode:
    """Return the notebook with what takes long made small."""
    short = copy.deepcopy(notebook)
    for long, quick in SHORT.get(name, {}).items():
        (cell,) = [cell for cell in short.cells if cell.cell_type == "code" and long in cell.source]
        cell.source = cell.source.replace(long, quick)
    return short


def outputs(notebook: nbformat.NotebookNode) -> list[nbformat.NotebookNode]:
    return [output for cell in notebook.cells if cell.cell_type == "code" for output in cell.outputs]


def figures(notebook: nbformat.NotebookNode) -> int:
    return sum("image/png" in output.get("data", {}) for output in outputs(notebook))


@pytest.fixture(scope="module")
def execute() -> Iterator[Callable[[nbformat.NotebookNode], None]]:
    """Run notebooks in one kernel, which imports once; each begins in their folder, with nothing defined."""
    client = NotebookClient(new_notebook(), timeout=600, resources={"metadata": {"path": str(FOLDER)}})

    def run(notebook: nbformat.NotebookNode) -> None:
        """Run all cells; raises a cell's error, should there be one."""
        client.nb = copy.deepcopy(notebook)
        client.nb.cells.insert(0, new_code_cell(f"%reset -f\n%cd -q {FOLDER}"))
        client.execute(cleanup_kc=False)
        notebook.cells = client.nb.cells[1:]

    yield run
    client.nb = new_notebook()
    client.execute()  # and end the kernel


def test_there_are_three_stories() -> None:
    assert NOTEBOOKS == ["1_quantile_curves.ipynb", "2_from_runs_to_the_table.ipynb", "3_your_own_risk_measure.ipynb"]


@pytest.mark.parametrize("name", NOTEBOOKS)
def test_it_runs_and_shows_what_was_saved(name: str, execute: Callable[[nbformat.NotebookNode], None]) -> None:
    saved = nbformat.read(FOLDER / name, as_version=4)
    nbformat.validate(saved)
    code = [cell for cell in saved.cells if cell.cell_type == "code"]
    assert [cell.execution_count for cell in code] == list(range(1, len(code) + 1)), "saved after one run of all cells"
    assert not any("/home/" in str(output) or "/root/" in str(output) for output in outputs(saved))
    executed = shortened(saved, name)
    for cell in executed.cells:
        if cell.cell_type == "code":
            cell.outputs = []
    execute(executed)
    assert figures(executed) == figures(saved) > 0


def test_outside_the_checkout_the_second_names_what_it_misses(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    notebook = nbformat.read(FOLDER / "2_from_runs_to_the_table.ipynb", as_version=4)
    first = next(cell.source for cell in notebook.cells if cell.cell_type == "code")
    monkeypatch.chdir(tmp_path)
    with pytest.raises(FileNotFoundError, match=r"^there is no results/ here: .* or set RESULTS to a folder"):
        exec("\n".join(line for line in first.splitlines() if not line.startswith("%")), {})
