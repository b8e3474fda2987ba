"""The structure of the project: who imports whom, and what README says of the files."""

import ast
import re
import subprocess
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
README = (ROOT / "README.md").read_text()
FILES = re.findall(r"^\| `(\w+)\.py` \|", README, re.M)
ALONE = ("model", "clip", "maml", "data", "camera", "geometry", "common")


def imported(name):
    """The project's files that a file imports, also inside functions."""
    found = set()
    for node in ast.walk(ast.parse((ROOT / f"{name}.py").read_text())):
        if isinstance(node, ast.Import):
            found |= {alias.name.split(".")[0] for alias in node.names}
        elif isinstance(node, ast.ImportFrom):
            found.add(node.module.split(".")[0])
    return found & set(FILES)


def test_the_readme_lists_the_files_of_the_project():
    """Those that git keeps: a user's own scripts may stand beside them."""
    assert len(FILES) == len(set(FILES))
    assert all((ROOT / f"{name}.py").is_file() for name in FILES)
    listed = subprocess.run(["git", "-C", ROOT, "ls-files", "*.py"], capture_output=True, text=True)
    if listed.returncode == 0 and listed.stdout:
        assert set(FILES) == {Path(name).stem for name in listed.stdout.split() if "/" not in name}


@pytest.mark.parametrize("name", ALONE)
def test_a_file_that_can_be_copied_alone_imports_nothing_of_the_project(name):
    assert name in FILES and not imported(name)


def test_no_two_files_import_each_other_not_even_inside_functions():
    imports = {name: imported(name) for name in FILES}
    while leaves := [name for name, others in imports.items() if not others & set(imports)]:
        for name in leaves:
            del imports[name]
    assert not imports, f"these files import each other in a circle: {imports}"


def test_what_needs_no_simulator_imports_none():
    def reached(name):
        return {name}.union(*(reached(other) for other in imported(name)))

    for name in ("robot", "convert"):
        assert not reached(name) & {"simulator", "metaworld_env", "camera", "evaluate"}
    assert not reached("convert") & {"robot", "model"}
