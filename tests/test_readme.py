"""Every command in README.md exists and takes the options given, and every name is there."""

import importlib
import re
import shlex
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
README = (ROOT / "README.md").read_text()
BLOCKS = re.findall(r"^```bash\n(.*?)^```", README, re.M | re.S)
LINES = [re.split(r"\s+# ", line)[0].strip() for block in BLOCKS for line in block.splitlines()]
INLINE = re.findall(r"(?<!`)`((?:OMP_NUM_THREADS=\d+ )?(?:python|torchrun)\s[^`]+)`", README)
COMMANDS = sorted({re.sub(r"\s+", " ", command) for command in LINES + INLINE if command})
PARSERS = ("simulator", "train", "finetune", "evaluate", "robot", "convert")


def test_the_readme_has_the_two_commands_and_many_more():
    assert {"python finetune.py --task shelf-place", "python train.py --suite ml10"} <= {*COMMANDS}
    assert len(COMMANDS) > 15


def test_the_names_that_the_pages_mention_exist():
    """As `file.name`, or as `Class.name` of a class in any file."""
    files = re.findall(r"^\| `(\w+)\.py` \|", README, re.M)  # not what a user put beside them
    owners = {name: importlib.import_module(name) for name in files}
    for module in list(owners.values()):
        owners.update({name: x for name, x in vars(module).items() if isinstance(x, type)})
    mentioned = set()
    for page in (README, (ROOT / "RESULTS.md").read_text()):
        for owner, name in re.findall(r"\b(\w+)\.(\w+)\b", page):
            if owner in owners and name not in ("py", "json", "npz"):
                assert hasattr(owners[owner], name), f"{owner}.{name}"
                mentioned.add(f"{owner}.{name}")
    assert {"model.split", "simulator.SIMULATORS", "DAMIPolicy.sample_actions"} <= mentioned


@pytest.mark.parametrize("command", COMMANDS)
def test_every_command_parses(command, capsys, monkeypatch):
    words = [word for word in shlex.split(command) if not re.fullmatch(r"[A-Z_]+=\S+", word)]
    if words[:2] == ["pip", "install"]:
        assert all((ROOT / file).is_file() for file in re.findall(r"-r (\S+)", command))
    elif words[0] == "torchrun":
        importlib.import_module("train").parse(words[words.index("train.py") + 1 :])
    elif words[1].removesuffix(".py") in PARSERS:
        importlib.import_module(words[1].removesuffix(".py")).parse(words[2:])
    elif words[1] == "-m":
        module = importlib.import_module(words[2])
        if words[2] in ("tests.bench", "tests.emulator"):
            with pytest.raises(SystemExit) as end:
                module.main([*words[3:], "--help"])
            assert end.value.code == 0
    elif words[1] == "baselines.py":
        monkeypatch.setattr("sys.argv", words[1:])
        importlib.import_module("baselines").main()
        assert "mamba" in capsys.readouterr().out
    else:
        assert words[1:3] == ["-X", "dev"]
