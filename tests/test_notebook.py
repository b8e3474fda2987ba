"""The tutorial runs from top to bottom, with what ships in the repository."""

from pathlib import Path

import nbformat
from nbclient import NotebookClient

ROOT = Path(__file__).parents[1]
TUTORIAL = ROOT / "tutorial.ipynb"


def execute():
    """Runs all cells; raises what one of them raises. Its cells assert what their texts claim."""
    notebook = nbformat.read(TUTORIAL, as_version=4)
    NotebookClient(notebook, timeout=300, resources={"metadata": {"path": str(ROOT)}}).execute()


def test_the_tutorials_outputs_are_committed_as_it_ran():
    notebook = nbformat.read(TUTORIAL, as_version=4)
    code = [cell for cell in notebook.cells if cell.cell_type == "code"]
    assert len(notebook.cells) <= 45 and TUTORIAL.stat().st_size < 5e6
    assert [cell.execution_count for cell in code] == list(range(1, len(code) + 1))
    assert sum("image/png" in str(cell.outputs) for cell in code) >= 13
    assert not any(output.output_type == "error" for cell in code for output in cell.outputs)


def test_the_tutorial_runs(pytestconfig):
    error = pytestconfig.tutorial.communicate(timeout=600)[1]  # conftest.py started it
    assert pytestconfig.tutorial.returncode == 0, error


if __name__ == "__main__":
    execute()
