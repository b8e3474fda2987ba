"""Tests of simulator.py with a simulator of a page: see toy_simulator.py."""

import errno
import subprocess
import sys
import threading
import time
from dataclasses import dataclass, replace
from pathlib import Path
from types import SimpleNamespace

import filelock
import numpy as np
import pytest
from toy_simulator import ToyEnvironment, ToySimulator

import simulator
from common import UserError, command_line
from data import RecordingError, load_demonstrations, save_demonstrations
from metaworld_env import MetaWorld
from simulator import collect, demonstration_seed, evaluation_seed, made_by_simulator

ROOT = Path(simulator.__file__).resolve().parent
TASK = "touch-red"


@pytest.fixture(scope="module")
def recording(tmp_path_factory):
    """The file of two demonstrations."""
    folder = tmp_path_factory.mktemp("recording")
    return collect(ToySimulator(), [TASK], folder, episodes=2, workers=1)[TASK]


@pytest.fixture
def no_process(monkeypatch):
    """Recording anything would fail."""

    def fail(job, jobs, **options):
        assert not jobs, "a recording was made"

    monkeypatch.setattr(simulator, "run_jobs", fail)


# ---- Seeds ---------------------------------------------------------------------------------------


def test_demonstrations_and_evaluation_never_share_a_seed():
    meta_world = MetaWorld()
    seeds = {
        demonstration_seed(meta_world, task, seed, attempt)
        for task in meta_world.instructions
        for seed in (0, 999)
        for attempt in range(2000)
    }
    assert len(seeds) == 50 * 2 * 2000 and max(seeds) < 10**8 <= evaluation_seed(0, 0)
    assert len({evaluation_seed(seed, e) for seed in (0, 1, 2) for e in range(50)}) == 150


def test_the_seeds_of_a_task_end_where_those_of_the_next_one_begin():
    meta_world = MetaWorld()
    first, second, *_ = meta_world.instructions
    last = demonstration_seed(meta_world, first, seed=3, attempt=1999)
    assert demonstration_seed(meta_world, second, seed=3, attempt=0) == last + 1
    with pytest.raises(ValueError, match=f"attempt 2000 at a demonstration of {first} is out of"):
        demonstration_seed(meta_world, first, seed=3, attempt=2000)


def test_a_simulator_of_more_tasks_than_metaworld_has_seeds_for_each_of_them():
    many = SimpleNamespace(instructions={f"task-{i}": "Go." for i in range(130)})
    seeds = [demonstration_seed(many, "task-129", seed=2, attempt=a) for a in (0, 768)]
    assert seeds == [2 * 100_000 + 129 * 769, 2 * 100_000 + 129 * 769 + 768]
    assert max(seeds) < demonstration_seed(many, "task-0", seed=3, attempt=0)


@pytest.mark.parametrize(
    "seed, episode, message",
    [
        (-1, 0, "seed -1 is out of range: use a seed from 0 to 999"),
        (1000, 0, "seed 1000 is out of range: use a seed from 0 to 999"),
        (0, 100_000, "episode 100000 is out of range: a seed has 100000 episodes"),
    ],
)
def test_what_is_out_of_range_is_named(seed, episode, message):
    with pytest.raises(UserError, match=message):
        evaluation_seed(seed, episode)


# ---- Without a simulator -------------------------------------------------------------------------

BLOCKED = """
import sys
from importlib.abc import MetaPathFinder

class Blocker(MetaPathFinder):
    def find_spec(self, name, path=None, target=None):
        if name.split(".")[0] in ("metaworld", "mujoco", "gymnasium"):
            raise ModuleNotFoundError(f"No module named {name!r}", name=name)

sys.meta_path.insert(0, Blocker())
import simulator
from common import command_line
print("imported", flush=True)
command_line(lambda: simulator.main(["--task", "reach"]))
"""


def test_it_imports_without_metaworld_which_is_asked_for_in_one_line():
    done = subprocess.run([sys.executable, "-c", BLOCKED], cwd=ROOT, capture_output=True, text=True)
    assert done.stdout == "imported\n" and done.returncode == 2
    assert "is not installed: pip install -r requirements.txt" in done.stderr
    assert done.stderr.count("\n") == 1


# ---- Collecting ----------------------------------------------------------------------------------


def test_a_recording_is_what_the_expert_saw_and_did(recording):
    recorded, toy = load_demonstrations(recording), ToySimulator()
    assert (recorded.task, recorded.instruction) == (TASK, "Touch the red ball.")
    assert recorded.episode_ends.tolist() == [12, 24] and made_by_simulator(recorded)
    assert recorded.meta["episode_seeds"] == [demonstration_seed(toy, TASK, 0, i) for i in (0, 1)]
    assert toy.recipe.items() <= recorded.meta.items()

    env = toy.make(TASK, num_points=64)
    for index, seed in enumerate(recorded.meta["episode_seeds"]):
        env.begin(seed)
        success = []
        for frame in range(*recorded.episode(index).indices(24)):
            observation = env.observe()
            cloud = observation["point_cloud"].astype(np.float16)
            np.testing.assert_array_equal(recorded.points[frame], cloud)
            np.testing.assert_array_equal(recorded.state[frame], observation["agent_pos"])
            np.testing.assert_array_equal(recorded.action[frame], env.expert_action())
            success.append(env.advance(recorded.action[frame])[2]["success"])
        assert success.index(True) == recorded.meta["success_frames"][index] > 0


def test_points_keep_their_colours(tmp_path):
    path = tmp_path / "touch-green.npz"
    simulator.collect_task(ToySimulator(colored=True), path.stem, path, episodes=1, seed=0)
    points = load_demonstrations(path).points
    assert points.shape == (12, 64, 6) and (points[..., 3:] == (0, 1, 0)).all()


class HardEnvironment(ToyEnvironment):
    """Its expert moves only in the last of every so many seeds."""

    def begin(self, seed):
        super().begin(seed)
        self.solvable = seed % self.every == self.every - 1

    def expert_action(self):
        return super().expert_action() if self.solvable else np.zeros(3, np.float32)


@dataclass(frozen=True)
class HardSimulator(ToySimulator):
    every: int = 2

    def make(self, task, num_points):
        env = HardEnvironment(None, num_points, self.episode_steps)
        env.every = self.every
        return env


def test_failed_attempts_are_not_kept_but_counted(tmp_path):
    path = collect(HardSimulator(), [TASK], tmp_path, episodes=2, seed=4, workers=1)[TASK]
    recorded = load_demonstrations(path)
    assert recorded.meta["episode_seeds"] == [400_001, 400_003] and len(recorded) == 2
    assert recorded.meta["seed"] == 4
    assert recorded.meta["expert_success_rate"] == 0.5


class BlindEnvironment(ToyEnvironment):
    """Nothing is seen in the middle of episodes of even seeds."""

    def begin(self, seed):
        super().begin(seed)
        self.blind_at = 5 if seed % 2 == 0 else None

    def observe(self):
        if self.steps == self.blind_at:
            raise simulator.OutOfSightError("nothing is seen")
        return super().observe()


def test_an_attempt_in_which_nothing_is_seen_has_failed():
    env = BlindEnvironment(None, num_points=64, episode_steps=12)
    assert simulator.record_episode(env, seed=4) is None
    assert simulator.record_episode(env, seed=5) is not None


def test_an_expert_that_hardly_ever_succeeds_is_given_up(tmp_path):
    with pytest.raises(UserError, match="in 1 of 40 episodes; ask for fewer"):
        collect(HardSimulator(every=30), [TASK], tmp_path, episodes=2, workers=1)
    assert not (tmp_path / f"{TASK}.npz").exists()


def test_a_finished_file_is_kept_and_a_shorter_one_is_made_again(recording, no_process):
    before = recording.stat().st_mtime_ns
    for episodes in (2, 1):
        kept = collect(ToySimulator(), [TASK], recording.parent, episodes=episodes)
        assert kept == {TASK: recording}
    assert recording.stat().st_mtime_ns == before
    with pytest.raises(AssertionError, match="a recording was made"):
        collect(ToySimulator(), [TASK], recording.parent, episodes=3)


def test_a_recording_made_otherwise_is_never_overwritten(recording, tmp_path):
    recorded = load_demonstrations(recording)
    path = tmp_path / recording.name
    older = {name: value for name, value in recorded.meta.items() if name != "simulator"}
    cases = [
        (replace(recorded, meta=older), 0, "recorded by an older version, or is a recording of"),
        (replace(recorded, meta={**recorded.meta, "num_points": 8}), 0, "another num_points: move"),
        (replace(recorded, meta={**recorded.meta, "simulator": "b"}), 0, "another simulator: move"),
        (replace(recorded, task="touch-green"), 0, "is a recording of touch-green: move it"),
        (recorded, 1, "recorded with another seed: move it or use another --data"),
    ]
    for other, seed, message in cases:
        save_demonstrations(path, other)
        before = path.read_bytes()
        with pytest.raises(UserError, match=message):
            collect(ToySimulator(), [TASK], tmp_path, episodes=3, seed=seed)
        assert path.read_bytes() == before


def test_a_second_process_waits_says_so_and_finds_what_the_first_one_made(
    recording, tmp_path, no_process, capsys
):
    found, said = [], ""
    waiting = threading.Thread(
        target=lambda: found.append(collect(ToySimulator(), [TASK], tmp_path, episodes=2))
    )
    with filelock.FileLock(tmp_path / ".collecting.lock"):
        waiting.start()
        for _ in range(200):
            said += capsys.readouterr().out
            if "another process collects into" in said:
                break
            time.sleep(0.05)
        assert f"another process collects into {tmp_path}: waiting" in said and not found
        (tmp_path / recording.name).write_bytes(recording.read_bytes())
    waiting.join(timeout=30)
    assert found == [{TASK: tmp_path / recording.name}]


def test_collecting_leaves_everything_else_in_the_folder_alone(tmp_path):
    names = [".2024-11-02.notes.md", ".1.touch-red.npz", "notes.txt"]
    for name in names:
        (tmp_path / name).write_text("mine")
    (tmp_path / ".2024.d").mkdir()
    collect(ToySimulator(), [TASK], tmp_path, episodes=1, workers=1)
    assert all((tmp_path / name).read_text() == "mine" for name in names)
    assert (tmp_path / ".2024.d").is_dir()


def test_what_is_there_is_found_in_a_folder_that_cannot_be_written_to(
    recording, tmp_path, no_process, monkeypatch
):
    (tmp_path / recording.name).write_bytes(recording.read_bytes())
    monkeypatch.setattr(filelock, "FileLock", None)  # nothing is locked, as nothing is written
    assert collect(ToySimulator(), [TASK], tmp_path, episodes=2)


def test_a_read_only_folder_is_refused_in_one_line(tmp_path, monkeypatch):
    def acquire(*_, **__):  # root, as whom tests may run, would be allowed
        raise PermissionError(errno.EACCES, "Permission denied")

    monkeypatch.setattr(filelock.FileLock, "acquire", acquire)
    with pytest.raises(UserError, match=r"written to \(Permission denied\): use another --data"):
        collect(ToySimulator(), [TASK], tmp_path, episodes=1)


# ---- Command line --------------------------------------------------------------------------------


def test_the_command_collects_a_suite_and_prints_a_table(tmp_path, monkeypatch, capsys):
    monkeypatch.setitem(simulator.SIMULATORS, "toy", ToySimulator)
    simulator.main(["--suite", "toy", "--episodes", "1", "--data", str(tmp_path)])
    table = capsys.readouterr().out.splitlines()
    tasks = ["touch-red", "touch-green", "touch-blue"]
    assert [line.split()[1] for line in table[2:]] == tasks
    assert table[0].split("|")[1:4] == [" task        ", " episodes ", " expert "]
    assert table[2].split()[3:8:2] == ["1", "100%", "12"]  # episodes, expert, frames
    assert {path.stem for path in tmp_path.glob("*.npz")} == {*tasks}


@pytest.mark.parametrize(
    "argv, message",
    [
        (["--task", "raech"], "unknown task 'raech': did you mean 'reach'?"),
        (["--suite", "ml11"], "unknown suite 'ml11': did you mean 'ml10'?"),
        (["--task", "reach", "--episodes", "0"], "0 demonstrations of a task: use at least 1"),
        (
            ["--task", "reach", "--episodes", "2001"],
            "2001 demonstrations of a task: use at most 2000",
        ),
        (["--task", "reach", "--workers", "0"], "--workers is 0: use at least 1"),
        (["--task", "reach", "--seed", "1000"], "use a seed from 0 to 999"),
        (["--task", "reach", "--data", "requirements.txt"], "requirements.txt cannot be written"),
        (["--task", "reach", "--data", "damaged"], "reach.npz is truncated or no .npz file"),
    ],
)
def test_what_the_user_gets_wrong_ends_in_one_line_and_exit_code_2(
    argv, message, tmp_path, monkeypatch, capsys
):
    monkeypatch.chdir(tmp_path)
    Path("requirements.txt").write_text("a file")
    Path("damaged").mkdir()
    Path("damaged/reach.npz").write_text("no recording")
    with pytest.raises(SystemExit) as end:
        command_line(lambda: simulator.main(argv), errors=(RecordingError,))
    error = capsys.readouterr().err
    assert end.value.code == 2 and message in error and error.count("\n") == 1


def test_who_interrupts_collecting_is_told_what_is_kept(tmp_path, monkeypatch):
    def interrupt(job, jobs, **options):
        raise KeyboardInterrupt

    monkeypatch.setattr(simulator, "run_jobs", interrupt)
    with pytest.raises(KeyboardInterrupt, match=f"finished are kept in {tmp_path}, the same"):
        collect(ToySimulator(), [TASK], tmp_path)


def test_environments_are_used_again_where_they_fit():
    class Changing(ToySimulator):
        def make(self, task, num_points):
            environment = super().make(task, num_points)
            environment.change_task = lambda task: task != "touch-blue"
            return environment

    def environments(toy, task, number=1, num_points=64):
        return simulator.environments_of(toy, task, number, num_points)

    two = environments(ToySimulator(), "touch-red", 2)
    assert environments(ToySimulator(), "touch-red", 3)[:2] == two  # the same objects
    assert environments(ToySimulator(), "touch-red") == two[:1]
    (green,) = environments(ToySimulator(), "touch-green")
    assert green not in two
    assert environments(ToySimulator(), "touch-green", num_points=32) != [green]

    (first,) = environments(Changing(), "touch-red")
    assert environments(Changing(), "touch-green") == [first]
    assert environments(Changing(), "touch-blue") != [first]
