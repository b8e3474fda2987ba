"""The tutorial runs from top to bottom, with what ships in the repository."""

import ast
import base64
import builtins
import re
from pathlib import Path

import nbformat
from nbclient import NotebookClient

from metaworld_env import INSTRUCTIONS
from tests.tutorial import TUTORIAL, digest

ROOT = Path(__file__).parents[1]
QUICK = "QUICK: trainings and rollouts are cut short"  # what a run that is cut short prints


def sections():
    """Title -> syntax tree of each of the section's cells, the set-up first."""
    found = {}
    for cell in nbformat.read(TUTORIAL, as_version=4).cells:
        if cell.cell_type == "markdown":
            for title in re.findall("^## (.*)$", cell.source, re.M):
                found[title] = []
        else:
            code = re.sub("^%.*$", "", cell.source, flags=re.M)  # IPython's own commands
            found[title].append(ast.parse(code))
    return found


def names(tree):
    """(names that are bound somewhere in a cell, names that are read)."""
    bound, read = set(), set()
    for node in ast.walk(tree):
        if isinstance(node, ast.Name) and isinstance(node.ctx, ast.Store):
            bound.add(node.id)
        elif isinstance(node, ast.Name):
            read.add(node.id)
        elif isinstance(node, (ast.FunctionDef, ast.ClassDef)):
            bound.add(node.name)
        elif isinstance(node, ast.arg):
            bound.add(node.arg)
        elif isinstance(node, ast.alias):
            bound.add(node.asname or node.name)
    return bound, read


class Bound(ast.NodeVisitor):
    """Collects the names that later cells can read: not those of functions and comprehensions."""

    def __init__(self):
        self.names = set()

    def visit_Name(self, node):
        if isinstance(node.ctx, ast.Store):
            self.names.add(node.id)

    def visit_FunctionDef(self, node):
        self.names.add(node.name)

    visit_ClassDef = visit_FunctionDef

    def visit_alias(self, node):
        self.names.add(node.asname or node.name)

    def skip(self, node):
        pass

    visit_Lambda = visit_ListComp = visit_SetComp = visit_DictComp = visit_GeneratorExp = skip


def bound_for_later_cells(tree):
    visitor = Bound()
    visitor.visit(tree)
    return visitor.names


def printed(notebook):
    """All text that the cells wrote to stdout."""
    outputs = (output for cell in notebook.cells for output in cell.get("outputs", []))
    return "".join(output.text for output in outputs if output.get("name") == "stdout")


def pictures(notebook):
    """Width in pixels of each PNG among the outputs."""
    outputs = (output for cell in notebook.cells for output in cell.get("outputs", []))
    held = [output.get("data", {}).get("image/png") for output in outputs]
    return [int.from_bytes(base64.b64decode(png)[16:20], "big") for png in held if png]


def test_the_tutorials_outputs_are_committed_as_it_ran():
    notebook = nbformat.read(TUTORIAL, as_version=4)
    code = [cell for cell in notebook.cells if cell.cell_type == "code"]
    assert TUTORIAL.stat().st_size < 7e6
    assert notebook.metadata["executed_sha256"] == digest(
        notebook
    )  # else: python -m tests.tutorial
    assert [cell.execution_count for cell in code] == list(range(1, len(code) + 1))
    assert QUICK not in printed(notebook)  # in full length, so all assertions were made
    widths = pictures(notebook)
    assert len(widths) >= 18 and min(widths) >= 800  # pixels: 7 inches at 120 dpi
    assert not any(output.output_type == "error" for cell in code for output in cell.outputs)
    kinds = [kind for cell in code for output in cell.outputs for kind in output.get("data", {})]
    assert kinds.count("image/gif") == 2  # a rollout, and two goals from one start
    assert any("animation" in str(cell.outputs) for cell in code)  # the cloud to be turned
    for cell in code:  # a progress bar as it ended, not as it went
        streams = [output for output in cell.outputs if output.output_type == "stream"]
        assert len({stream.name for stream in streams}) == len(streams)
        assert "\r" not in "".join(stream.text for stream in streams)


def test_a_section_of_the_tutorial_needs_the_set_up_and_nothing_else():
    setup, *others = sections().values()
    known = set(dir(builtins)).union(*(bound_for_later_cells(tree) for tree in setup))
    for cells in others:
        here = set(known)
        for tree in cells:
            bound, read = names(tree)
            assert read <= here | bound, read - here - bound
            here.update(bound_for_later_cells(tree))


def test_a_task_is_named_in_one_cell_of_the_tutorial():
    setup, *others = sections().values()
    for tree in [*setup[1:], *(tree for cells in others for tree in cells)]:
        strings = {node.value for node in ast.walk(tree) if isinstance(node, ast.Constant)}
        assert not strings & set(INSTRUCTIONS)


def test_the_tutorial_runs(monkeypatch):
    """Trainings and rollouts are cut short, as are its assertions that need the full length."""
    monkeypatch.setenv("DAMI_TUTORIAL_QUICK", "1")  # the kernel inherits it
    notebook = nbformat.read(TUTORIAL, as_version=4)
    NotebookClient(notebook, timeout=300, resources={"metadata": {"path": str(ROOT)}}).execute()
    assert QUICK in printed(notebook)
