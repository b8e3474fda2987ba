"""What several test files share: real demonstrations, one short run of train.py, small helpers."""

import functools
import hashlib
import os
import re
import shutil
import signal
from contextlib import contextmanager
from pathlib import Path

os.environ["OMP_NUM_THREADS"] = "1"  # before torch; on small matrices threads wait

import filelock
import pytest
import torch

import baselines  # noqa: F401  its policies are registered
import clip
import common
import evaluate
import metaworld_env
import model
import report
import simulator
import train
from clip import TextWeightsError
from data import RecordingError
from model import CheckpointError

BASE, NOVEL = ["reach", "drawer-close", "window-open"], ["door-close"]
SMALL_ML10 = {"train": [f"{task}-v3" for task in BASE], "test": [f"{task}-v3" for task in NOVEL]}
FEW = (
    "--suite ml10 --preset tiny --steps 6 --checkpoint-every 3 --demonstrations 2 --episodes 0 "
    "--clip-weights random --device cpu"
).split()

# In which order files are tested, so that no process is left with a long one at the end. That of
# the robot mostly waits, since it needs real time.
ORDER = (
    "robot model maml clip convert notebook train camera baselines finetune evaluate common "
    "hidden_goals fuzz metaworld simulator seams rl rlbench unnamed_tasks data report readme "
    "results house"
).split()


def pytest_configure(config):
    config.option.loadscopereorder = False  # otherwise xdist sorts files by their number of tests


def pytest_collection_modifyitems(items):
    places = {f"test_{name}.py": place for place, name in enumerate(ORDER)}
    items.sort(key=lambda item: places.get(item.path.name, len(ORDER)))


def made_once(factory, name, make):
    """A folder that `make(folder)` fills, once for all processes of pytest-xdist."""
    root = factory.getbasetemp()
    if "PYTEST_XDIST_WORKER" in os.environ:
        root = root.parent
    folder, done = root / name, root / f"{name}.done"
    with filelock.FileLock(root / f"{name}.lock"):
        if not done.exists():
            shutil.rmtree(folder, ignore_errors=True)
            folder.mkdir()
            make(folder)
            done.touch()
    return folder


@pytest.fixture(scope="session")
def recorded(tmp_path_factory):
    """A folder with two expert demonstrations of each task in BASE and NOVEL."""

    def make(folder):
        simulator.collect(metaworld_env.MetaWorld(), BASE + NOVEL, folder, episodes=2)

    return made_once(tmp_path_factory, "demonstrations", make)


@contextmanager
def three_tasks():
    """ML10 with three of its ten base tasks; the text tower is built once, not at every call."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setitem(metaworld_env.SUITES, "ml10", SMALL_ML10)
        patch.setattr(clip, "load_clip_text_encoder", load_once)
        yield patch


load_once = functools.cache(clip.load_clip_text_encoder)


@pytest.fixture
def small_suite():
    """`three_tasks` for one test."""
    with three_tasks():
        yield


@pytest.fixture(autouse=True)
def nothing_kept(monkeypatch):
    """No test meets a policy or an environment that an earlier one left in this process."""
    evaluate.cached_policy.cache_clear()
    evaluate.cached_policy_of_task.cache_clear()
    monkeypatch.setattr(simulator, "kept", simulator.KeptEnvironments())


@pytest.fixture
def no_pictures(monkeypatch):
    """No charts are drawn, which takes a third of a second each; their files are empty."""
    monkeypatch.setattr(report, "save_png", lambda figure, path, **_: Path(path).touch())


@pytest.fixture
def own_folder(tmp_path, monkeypatch):
    """The test runs in an empty folder, and leaves the process as it was."""
    numbers = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)
    handlers, threads = [signal.getsignal(n) for n in numbers], torch.get_num_threads()
    signal.signal(signal.SIGINT, signal.default_int_handler)  # `nohup python -m pytest` ignores it
    monkeypatch.chdir(tmp_path)
    yield tmp_path
    for number, handler in zip(numbers, handlers):
        signal.signal(number, handler)
    torch.set_num_threads(threads)


@pytest.fixture(scope="session")
def run(recorded, tmp_path_factory):
    """The folder of a run of train.py with evaluation, to be left as it is."""

    def make(folder):
        with three_tasks() as patch:
            patch.chdir(folder)
            patch.setattr(evaluate, "EPISODES_A_JOB", 1)  # jobs enough for both workers
            options = "--episodes 2 --evaluate-every 6 --workers 2".split()
            train.main([*FEW, *options, "--data", str(recorded)])

    return made_once(tmp_path_factory, "trained", make) / "runs" / "ml10-tiny-seed0"


def fails(script, argv, capsys):
    """Runs a script that must end with exit code 2 and one line on stderr; returns the line.

    Of exceptions only those become a line that the script itself names at its end.
    """
    capsys.readouterr()
    known = {error.__name__: error for error in (RecordingError, CheckpointError, TextWeightsError)}
    end_of_script = Path(script.__file__).read_text().rpartition("command_line(main")[2]
    errors = tuple(known[name] for name in re.findall(r"\w+Error", end_of_script))
    with pytest.raises(SystemExit) as end:
        common.command_line(lambda: script.main([str(arg) for arg in argv]), errors=errors)
    error = capsys.readouterr().err.split("\r")[-1]  # after a progress bar
    line = error.strip("\n").split("\n")[-1]
    assert end.value.code == 2 and line.startswith("error: ") and "Traceback" not in error, error
    return line


def weights(path):
    """A checkpoint's state_dict and information."""
    policy, info = model.load(path)
    return policy.state_dict(), info


def same_bits(a, b):
    """Whether two nested checkpoints are equal, bit for bit."""
    if isinstance(a, torch.Tensor):
        return torch.equal(a, b)
    if isinstance(a, dict):
        return a.keys() == b.keys() and all(same_bits(a[key], b[key]) for key in a)
    if isinstance(a, list):
        return len(a) == len(b) and all(map(same_bits, a, b))
    return a == b


def whole_state(folder):
    """Policy, EMA, optimizer and step of a run's last.pt; not the seconds."""
    policy, info = weights(folder / "last.pt")
    return {"ema": dict(policy), "training": info["training"], "step": info["step"]}


def fingerprint(folder):
    """File -> SHA-256 of its content."""
    files = sorted(path for path in folder.rglob("*") if path.is_file())
    return {path: hashlib.sha256(path.read_bytes()).hexdigest() for path in files}


def metrics(folder):
    """The lines of a run's metrics.jsonl."""
    return common.read_json_lines(folder / "metrics.jsonl")
