"""Every command in the README exists, and takes the options that the README gives it."""

import importlib.util
import re
import shlex
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
README = (ROOT / "README.md").read_text()
BLOCKS = re.findall(r"^```bash\n(.*?)^```", README, re.M | re.S)
LINES = [re.split(r"\s+# ", line)[0].strip() for block in BLOCKS for line in block.splitlines()]
INLINE = re.findall(r"`((?:OMP_NUM_THREADS=\d+ )?(?:python|torchrun) [^`]+)`", README)
COMMANDS = sorted({re.sub(r"\s+", " ", command) for command in LINES + INLINE if command})
PARSERS = {f"{name}.py": name for name in ("data", "train", "finetune", "evaluate", "robot")}


def test_the_readme_has_the_two_commands_and_many_more():
    assert {"python finetune.py --task shelf-place", "python train.py --suite ml10"} <= set(COMMANDS)
    assert len(COMMANDS) > 20


@pytest.mark.parametrize("command", COMMANDS)
def test_every_command_parses(command):
    words = [word for word in shlex.split(command) if not re.fullmatch(r"[A-Z_]+=\S+", word)]
    if words[0] == "pip":
        assert command.startswith("pip install ")
        for file in re.findall(r"-r (\S+)", command):
            assert (ROOT / file).is_file()
    elif words[0] == "torchrun":
        importlib.import_module("train").parse(words[words.index("train.py") + 1 :])
    elif words[1] in PARSERS:
        importlib.import_module(PARSERS[words[1]]).parse(words[2:])
    elif words[1] == "-m":
        assert importlib.util.find_spec(words[2]) is not None
        if words[2].startswith("tests.") and words[2] != "tests.results":  # that one takes folders
            subprocess.run([sys.executable, *words[1:], "--help"], cwd=ROOT, check=True, capture_output=True)
    else:
        assert (ROOT / words[1]).is_file() and words[1].endswith(".py")
        if "--half" not in words:
            subprocess.run([sys.executable, *words[1:]], cwd=ROOT, check=True, capture_output=True)
