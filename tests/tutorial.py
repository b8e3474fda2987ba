"""Runs tutorial.ipynb from top to bottom, and keeps what it prints and draws.

    python -m tests.tutorial

A digest of the code that ran is kept with the outputs: tests/test_notebook.py compares it with the
code that stands there.
"""

import argparse
import hashlib
from collections.abc import Sequence
from pathlib import Path

import nbformat
from nbclient import NotebookClient

TUTORIAL = Path(__file__).parents[1] / "tutorial.ipynb"


def digest(notebook: nbformat.NotebookNode) -> str:
    """The SHA-256 of the code of all cells."""
    sources = [cell.source for cell in notebook.cells if cell.cell_type == "code"]
    return hashlib.sha256("\n".join(sources).encode()).hexdigest()


def as_it_ended(text: str) -> str:
    """A text in which progress bars stand as they ended, and not as they went."""
    lines = []
    for line in text.split("\n"):
        states = [state for state in line.split("\r") if state.strip()]
        lines.append(states[-1] if states else "")
    return "\n".join(lines)


def join_streams(cell: nbformat.NotebookNode) -> None:
    """Puts together what a cell wrote to stdout, and what it wrote to stderr."""
    outputs, streams = [], {}
    for output in cell.outputs:
        if output.output_type == "stream" and output.name in streams:
            streams[output.name].text += output.text
            continue
        if output.output_type == "stream":
            streams[output.name] = output
        outputs.append(output)
    for stream in streams.values():
        stream.text = as_it_ended(stream.text)
    cell.outputs = outputs


def parse(argv: Sequence[str] | None) -> argparse.Namespace:
    return argparse.ArgumentParser(description=__doc__.splitlines()[0]).parse_args(argv)


def main(argv: Sequence[str] | None = None) -> None:
    parse(argv)
    notebook = nbformat.read(TUTORIAL, as_version=4)
    folder = {"metadata": {"path": str(TUTORIAL.parent)}}
    NotebookClient(notebook, timeout=3600, kernel_name="python3", resources=folder).execute()
    for place, cell in enumerate(notebook.cells):
        cell["id"] = f"cell-{place:02d}"
        if cell.cell_type == "code":
            join_streams(cell)
            cell.metadata.pop("execution", None)  # when it ran
    notebook.metadata["executed_sha256"] = digest(notebook)
    nbformat.write(notebook, TUTORIAL)


if __name__ == "__main__":
    main()
