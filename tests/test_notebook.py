"""The tutorial runs from top to bottom, with what ships in the repository."""

from pathlib import Path

import nbformat
from nbclient import NotebookClient

ROOT = Path(__file__).parents[1]


def test_the_tutorial_runs_and_its_outputs_are_committed():
    path = ROOT / "tutorial.ipynb"
    notebook = nbformat.read(path, as_version=4)
    code = [cell for cell in notebook.cells if cell.cell_type == "code"]
    assert len(notebook.cells) <= 40 and path.stat().st_size < 3e6
    assert all(
        cell.execution_count == i for i, cell in enumerate(code, start=1)
    )  # committed as it ran, in order
    assert sum("image/png" in str(cell.outputs) for cell in code) >= 12
    assert not any(output.output_type == "error" for cell in code for output in cell.outputs)
    client = NotebookClient(notebook, timeout=300, resources={"metadata": {"path": str(ROOT)}})
    client.execute()  # raises if a cell does
