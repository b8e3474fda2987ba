"""Every command in README.md exists and takes the options given, and every name is there."""

import importlib
import json
import re
import shlex
from pathlib import Path

import numpy as np
import pytest

import convert
import data
import model

ROOT = Path(__file__).parents[1]
README = (ROOT / "README.md").read_text()
RESULTS = (ROOT / "RESULTS.md").read_text()
PYTHON_BLOCKS = re.findall(r"^```python\n(.*?)^```", README, re.M | re.S)


def commands_of(page):
    """The commands of a page, in its blocks and in its text."""
    commands = set()
    for block in re.findall(r"^```bash\n(.*?)^```", page, re.M | re.S):
        commands.update(re.split(r"\s+# ", line)[0].strip() for line in block.splitlines())
    commands.update(re.findall(r"(?<!`)`((?:python|torchrun)\s[^`]+)`", page))
    return sorted({re.sub(r"\s+", " ", command) for command in commands if command})


COMMANDS = commands_of(README)


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


def test_a_policy_is_used_from_python_as_the_readme_says(tmp_path, monkeypatch):
    [script] = [block for block in PYTHON_BLOCKS if "sample_actions" in block]
    monkeypatch.chdir(tmp_path)
    rng = np.random.default_rng(0)
    recording = data.Demonstrations(
        task="stir",
        instruction="Stir the soup.",
        points=rng.normal(size=(30, 64, 3)).astype(np.float16),
        state=rng.normal(size=(30, 9)).astype(np.float32),
        action=rng.normal(size=(30, 4)).astype(np.float32),
        episode_ends=np.array([30]),
        meta={},
    )
    data.save_demonstrations("new/stir.npz", recording)
    Path("runs/finetune/stir-seed0").mkdir(parents=True)
    policy = model.build_policy(model.PRESETS["tiny"])
    info = {"suite": "own", "preset": "tiny", "arguments": {}, "step": 1}
    info["text_weights"] = "random-seed-0"
    model.save("runs/finetune/stir-seed0/adapted.pt", policy, **info)
    observed = {
        "last_two_clouds": rng.normal(size=(2, 300, 3)),  # float64
        "last_two_states": rng.normal(size=(2, 9)),
    }
    exec(script, observed)
    assert observed["actions"].shape == (8, 4)


def test_the_cameras_file_in_the_readme_can_be_read():
    [block] = re.findall(r"^```json\n(.*?)^```", README, re.M | re.S)
    assert convert.Camera(**json.loads(block)).crop_low_m == [0.1, -0.4, -0.02]


@pytest.mark.parametrize("command", sorted({*COMMANDS, *commands_of(RESULTS)}))
def test_every_command_parses(command, capsys, monkeypatch):
    words = [word for word in shlex.split(command) if not re.fullmatch(r"[A-Z_]+=\S+", word)]
    if words[:2] == ["pip", "install"]:
        assert all((ROOT / file).is_file() for file in re.findall(r"-r (\S+)", command))
    elif words[0] == "rlbench-generate-dataset":
        pass  # RLBench's own
    elif words[1] == "baselines.py":
        monkeypatch.setattr("sys.argv", words[1:])
        importlib.import_module("baselines").main()
        assert "mamba" in capsys.readouterr().out
    elif words[1:3] == ["-X", "dev"]:
        assert words[3:] == ["train.py", "..."]
    elif words[1:3] == ["-m", "pytest"]:
        importlib.import_module("xdist")  # which knows -n and --dist
    elif words[0] == "torchrun":
        importlib.import_module("train").parse(words[words.index("train.py") + 1 :])
    elif words[1] == "-m":
        importlib.import_module(words[2]).parse(words[3:])
    else:
        importlib.import_module(words[1].removesuffix(".py")).parse(words[2:])
