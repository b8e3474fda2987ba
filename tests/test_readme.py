"""Every command in the README exists, and takes the options that the README gives it."""

import importlib
import re
import shlex
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
README = (ROOT / "README.md").read_text()
BLOCKS = re.findall(r"^```bash\n(.*?)^```", README, re.M | re.S)
LINES = [re.split(r"\s+# ", line)[0].strip() for block in BLOCKS for line in block.splitlines()]
INLINE = re.findall(r"`((?:OMP_NUM_THREADS=\d+ )?(?:python|torchrun)\s[^`]+)`", README)
COMMANDS = sorted({re.sub(r"\s+", " ", command) for command in LINES + INLINE if command})
PARSERS = {f"{name}.py": name for name in ("data", "train", "finetune", "evaluate", "robot")}


def test_the_readme_has_the_two_commands_and_many_more():
    assert {"python finetune.py --task shelf-place", "python train.py --suite ml10"} <= set(COMMANDS)
    assert len(COMMANDS) > 20


@pytest.mark.parametrize("command", COMMANDS)
def test_every_command_parses(command, capsys):
    words = [word for word in shlex.split(command) if not re.fullmatch(r"[A-Z_]+=\S+", word)]
    if words[0] == "pip":
        assert command.startswith("pip install ")
        assert all((ROOT / file).is_file() for file in re.findall(r"-r (\S+)", command))
    elif words[0] == "torchrun":
        importlib.import_module("train").parse(words[words.index("train.py") + 1 :])
    elif words[1] in PARSERS:
        importlib.import_module(PARSERS[words[1]]).parse(words[2:])
    elif words[1:3] == ["-m", "tests.results"]:  # it takes folders
        assert all(word.startswith("runs/") for word in words[3:])
    elif words[1] == "-m":
        module = importlib.import_module(words[2])
        if words[2].startswith("tests."):
            with pytest.raises(SystemExit) as end:
                module.main([*words[3:], "--help"])
            assert end.value.code == 0
    else:
        assert words[1] == "model.py"
        if "--half" not in words:
            importlib.import_module("model").main(words[2:])
            assert "parameters" in capsys.readouterr().out
