"""Damages files and kills commands at random: `python -m tests.fuzz --files 2000 --kills 200`.

A damaged recording or checkpoint is refused in one line, or reads exactly as before (a bit that
means nothing, in the padding of a zip). Collecting, training, evaluating and adapting, killed and
started again until they end, leave the same results as when left alone, no process and no temporary
file.
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

    AssertionError for one that is read and differs; whatever else than ValueError comes through.
    """
    content, whole, refused = path.read_bytes(), read(path), 0
    rng = random.Random(seed)
    with tempfile.TemporaryDirectory() as folder:
        copy = Path(folder) / path.name
        for case in range(cases):
            copy.write_bytes(damage(content, rng, kind))
            try:
                found = read(copy)
            except ValueError as error:
                assert "\n" not in str(error), (case, error)
                refused += 1
            else:
                assert same(found, whole), f"case {case} was read, and is not what was written"
    return refused


def result(path: Path) -> object:
    """What must be equal in two results: all but dates, seconds and commands."""
    if path.suffix == ".npz":
        return {**read_recording(path), "meta": None}
    if path.suffix == ".json":
        return json.loads(path.read_text())["successes"]
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


def fuzz_stage(folder: Path, whole: Path, stage: str, data: Path, rng: random.Random) -> list[str]:
    """Kills one command until it ends by itself; returns the signals. Its result must be `whole`'s.

    A signal goes to the process alone, or to all of its session, as from a closed terminal.
    """
    command, left, ended = *STAGES[stage], []
    script, *argv = command.format(data=data).split()
    words = [sys.executable, str(ROOT / script), *argv]
    while True:
        resume = ["--resume"] if stage == "training" and (folder / left).exists() else []
        options = {"stdout": subprocess.DEVNULL, "stderr": subprocess.PIPE, "text": True}
        began = subprocess.Popen([*words, *resume], cwd=folder, start_new_session=True, **options)
        try:
            error = began.communicate(timeout=rng.uniform(2, 20))[1]
        except subprocess.TimeoutExpired:
            number, everyone = rng.choice(SIGNALS), rng.random() < 0.5
            (os.killpg if everyone else os.kill)(began.pid, number)
            error = began.communicate()[1]
            ended.append(f"{stage} {number.name}")
        deadline = time.monotonic() + 20
        while processes_of(began.pid):
            assert time.monotonic() < deadline, f"{stage}: processes are left after {ended[-1]}"
            time.sleep(0.1)
        importing = began.returncode in (-2, -15, -1)  # before any of our code ran
        assert importing or "Traceback" not in error, error
        assert importing or began.returncode in (0, 130, -9), (began.returncode, error)
        if began.returncode == 0:
            break
    assert same(result(folder / left), result(whole / left)), f"{stage} has another result"
    assert not list((folder / left).parent.glob(".*")), f"{stage} left a temporary file"
    return ended


def fuzz_commands(folder: Path, data: Path, kills: int, seed: int = 0) -> list[str]:
    """All stages, one after the other, again and again until `kills` signals were sent."""
    rng, ended, whole = random.Random(seed), [], folder / "whole"
    whole.mkdir()
    for command, _ in STAGES.values():
        script, *argv = command.format(data=data).split()
        words = [sys.executable, str(ROOT / script), *argv]
        subprocess.run(words, cwd=whole, check=True, capture_output=True)
    while len(ended) < kills:
        killed = Path(tempfile.mkdtemp(dir=folder))
        for stage in STAGES:
            ended += fuzz_stage(killed, whole, stage, data, rng)
            print(f"{len(ended)} signals, {stage} ended as if there had been none", flush=True)
    return ended


def main(argv: list[str] | None = None) -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--files", type=int, default=2000, help="damaged files of each kind (2000)")
    parser.add_argument("--kills", type=int, default=200, help="killed commands (200)")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--data", default="data", help="demonstrations of ml10 (data)")
    args = parser.parse_args(argv)
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
            print(f"{len(ended)} commands ended by {counts}: the same results, nothing left behind")


if __name__ == "__main__":
    main()
