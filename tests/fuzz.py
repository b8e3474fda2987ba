"""Damages files and kills commands at random: `python -m tests.fuzz --files 2000 --kills 200`.

A damaged recording or checkpoint is refused in one line, or reads exactly as before (a bit that
means nothing, in the padding of a zip). Collecting, training, evaluating and adapting, killed and
started again until they end, leave the same results as when left alone, and no process. A process
that was killed while it wrote may leave a hidden folder (`.unfinished-...`): no other process
removes what it did not make.
"""

import argparse
import json
import os
import random
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path

import torch

import data
import model

ROOT = Path(__file__).parents[1]
SIGNALS = (signal.SIGKILL, signal.SIGTERM, signal.SIGINT, signal.SIGHUP)
STAGES = {  # what is killed -> command, and what it leaves
    "collecting": ("simulator.py --task reach --episodes 2 --data demos", "demos/reach.npz"),
    "training": (
        "train.py --suite ml10 --preset tiny --steps 30 --checkpoint-every 5 --evaluate-every 15 "
        "--demonstrations 2 --episodes 1 --clip-weights random --data {data} --out run",
        "run/last.pt",
    ),
    "evaluating": (
        "evaluate.py --checkpoint run --task reach --demonstrations 2 --episodes 4 --data demos "
        "--out measured --overwrite",
        "measured/success.json",
    ),
    "adapting": (
        "finetune.py --checkpoint run --task reach --demonstrations 2 --steps 30 --episodes 2 "
        "--data demos --out adapted --overwrite",
        "adapted/adapted.pt",
    ),
}


def damage(content: bytes, rng: random.Random, kind: str) -> bytes:
    """One bit flipped, a quarter of them in the last kilobyte (a zip's directory); or a cut end."""
    if kind == "cut":
        return content[: rng.randrange(len(content))]
    first = len(content) - 1000 if rng.random() < 0.25 else 0
    where, bit = rng.randrange(max(first, 0), len(content)), 1 << rng.randrange(8)
    return content[:where] + bytes([content[where] ^ bit]) + content[where + 1 :]


def same(a: object, b: object) -> bool:
    """Whether what two files hold is equal, bit for bit."""
    if isinstance(a, dict):
        return a.keys() == b.keys() and all(same(a[key], b[key]) for key in a)
    if isinstance(a, (list, tuple)):
        return len(a) == len(b) and all(map(same, a, b))
    if hasattr(a, "tobytes"):
        return a.dtype == b.dtype and a.shape == b.shape and a.tobytes() == b.tobytes()
    return torch.equal(a, b) if isinstance(a, torch.Tensor) else a == b


def read_checkpoint(path: Path) -> object:
    policy, info = model.load(path)
    return dict(policy.state_dict()), info


def read_recording(path: Path) -> object:
    return vars(data.load_demonstrations(path))


def fuzz_file(
    path: Path, read: Callable[[Path], object], cases: int, kind: str, seed: int = 0
) -> int:
    """Reads `cases` damaged copies, of kind flip or cut; returns how many were refused.

    Raises AssertionError for a copy that is read and differs, and whatever `read` raises that is
    not meant for a user.
    """
    content, whole = path.read_bytes(), read(path)
    rng, refused = random.Random(seed), 0
    with tempfile.TemporaryDirectory() as folder:
        copy = Path(folder) / path.name
        for case in range(cases):
            copy.write_bytes(damage(content, rng, kind))
            try:
                content_read = read(copy)
            except (data.RecordingError, model.CheckpointError) as error:
                assert "\n" not in str(error), (case, error)
                refused += 1
            else:
                assert same(content_read, whole), f"case {case} was read, and differs"
    return refused


def result(path: Path) -> object:
    """What must be equal in two results: all but dates, seconds and commands."""
    if path.suffix == ".npz":
        return {**read_recording(path), "meta": None}
    if path.suffix == ".json":
        report = json.loads(path.read_text())
        return report["successes"], report["successes at the end"]
    weights, info = read_checkpoint(path)
    return weights, info.get("training"), info["step"]


def processes_of(session: int) -> list[int]:
    """The processes of a session that are alive."""
    alive = []
    for stat in Path("/proc").glob("[0-9]*/stat"):
        with suppress(OSError):
            fields = stat.read_text().rpartition(")")[2].split()  # state, parent, group, session
            if int(fields[3]) == session and fields[0] != "Z":
                alive.append(int(stat.parent.name))
    return alive


def visible_files(folder: Path) -> set[str]:
    """The names in a folder, without the hidden ones: locks, and what a killed process left."""
    return {path.name for path in folder.iterdir() if not path.name.startswith(".")}


def command_of(stage: str, data: Path) -> list[str]:
    """The words of a stage's command; `data` is the folder of demonstrations of ml10."""
    command, _ = STAGES[stage]
    script, *argv = command.format(data=data).split()
    return [sys.executable, str(ROOT / script), *argv]


def run_once(
    words: list[str], folder: Path, seconds: float, rng: random.Random
) -> tuple[int, str | None]:
    """Starts a command in a folder, and sends it a signal unless it ends within some seconds.

    A signal goes to the process alone, or to all of its session, as from a closed terminal. Returns
    the exit code, and the name of the signal. No process of the session may be left, and the
    command may end with an exit code of its own only, without a traceback.
    """
    process = subprocess.Popen(
        words,
        cwd=folder,
        start_new_session=True,
        stdout=subprocess.DEVNULL,
        stderr=subprocess.PIPE,
        text=True,
    )
    sent = None
    try:
        _, error = process.communicate(timeout=seconds)
    except subprocess.TimeoutExpired:
        number, to_all = rng.choice(SIGNALS), rng.random() < 0.5
        send = os.killpg if to_all else os.kill
        send(process.pid, number)
        _, error = process.communicate()
        sent = number.name

    deadline = time.monotonic() + 20
    while processes_of(process.pid):
        assert time.monotonic() < deadline, f"{words}: processes are left after {sent}"
        time.sleep(0.1)
    bars = ("collecting", "training", "evaluating", "adapting")  # of progress, once our code runs
    importing = process.returncode in (-2, -15, -1) and not any(bar in error for bar in bars)
    assert importing or "Traceback" not in error, error
    assert importing or process.returncode in (0, 130, -9), (process.returncode, error)
    return process.returncode, sent


def fuzz_stage(
    stage: str, folder: Path, *, data: Path, whole: Path, seconds: float, rng: random.Random
) -> list[str]:
    """Kills one command again and again until it ends by itself; returns what ended it before.

    Its result, and the files beside it, must then be those in the folder `whole`, where the same
    command was left alone and took so many seconds.
    """
    _, left = STAGES[stage]
    ended, code = [], None
    while code != 0:
        words = command_of(stage, data)
        if stage == "training" and (folder / left).exists():
            words.append("--resume")
        code, sent = run_once(words, folder, rng.uniform(0.1, 1.5) * seconds, rng)
        if sent is not None:
            ended.append(f"{stage} {sent}")
    assert same(result(folder / left), result(whole / left)), f"{stage} has another result"
    files, expected = (visible_files((root / left).parent) for root in (folder, whole))
    assert files == expected, f"{stage} left {files}, not {expected}"
    return ended


def fuzz_commands(folder: Path, data: Path, kills: int, seed: int = 0) -> list[str]:
    """All stages, one after the other, again and again until `kills` signals were sent."""
    whole = folder / "whole"
    whole.mkdir()
    seconds = {}
    for stage in STAGES:
        began = time.monotonic()
        subprocess.run(command_of(stage, data), cwd=whole, check=True, capture_output=True)
        seconds[stage] = time.monotonic() - began

    rng, ended = random.Random(seed), []
    while len(ended) < kills:
        killed = Path(tempfile.mkdtemp(dir=folder))
        for stage in STAGES:
            ended += fuzz_stage(
                stage, killed, data=data, whole=whole, seconds=seconds[stage], rng=rng
            )
            print(f"{len(ended)} signals, {stage} ended as if there had been none", flush=True)
    return ended


def parse(argv: list[str] | None) -> argparse.Namespace:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--files", type=int, default=2000, help="damaged files of each kind (2000)")
    parser.add_argument("--kills", type=int, default=200, help="killed commands (200)")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--data", default="data", help="demonstrations of ml10 (data)")
    return parser.parse_args(argv)


def main(argv: list[str] | None = None) -> None:
    args = parse(argv)
    with tempfile.TemporaryDirectory() as name:
        folder, recordings = Path(name), Path(args.data).resolve()
        policy = model.DAMIPolicy(model.PRESETS["tiny"])
        model.save(folder / "policy.pt", policy, step=1)
        small = data.load_demonstrations(recordings / "reach.npz").take(1)
        data.save_demonstrations(folder / "reach.npz", small)
        for path, read in (("policy.pt", read_checkpoint), ("reach.npz", read_recording)):
            for kind in ("flip", "cut"):
                refused = fuzz_file(folder / path, read, args.files, kind, args.seed)
                print(f"{path}: {args.files} x {kind}, {refused} refused, the rest read as before")
        if args.kills:
            ended = fuzz_commands(folder, recordings, args.kills, args.seed)
            counts = {name: ended.count(name) for name in sorted(set(ended))}
            print(f"{len(ended)} commands ended by {counts}: the same results, no process left")


if __name__ == "__main__":
    main()
