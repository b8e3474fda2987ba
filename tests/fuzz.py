"""Damages files and kills processes at random: `python -m tests.fuzz --files 2000 --kills 200`.

A damaged recording or checkpoint is refused in one line, or reads exactly as before (a bit that
means nothing, in the padding of a zip). A killed training, resumed until it ends, ends with the
same bits as one that was left alone, and leaves no process and no temporary file behind.
"""

import argparse
import random
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path

import torch

import data
import model
import scripts

ROOT = Path(__file__).parents[1]
SIGNALS = (signal.SIGKILL, signal.SIGTERM, signal.SIGINT)
TRAINING = (
    "--suite ml10 --preset tiny --steps 30 --checkpoint-every 5 --evaluate-every 15 "
    "--demonstrations 2 --episodes 1 --clip-weights random --device cpu --workers 2"
).split()


def damage(content: bytes, rng: random.Random) -> bytes:
    """One bit flipped, or the end cut off."""
    if rng.random() < 0.25:
        return content[: rng.randrange(len(content))]
    where, bit = rng.randrange(len(content)), 1 << rng.randrange(8)
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
    policy, info = scripts.load_checkpoint(path)
    return dict(policy.state_dict()), info


def read_recording(path: Path) -> object:
    return vars(data.load_demonstrations(path))


def fuzz_file(path: Path, read: Callable[[Path], object], cases: int, seed: int = 0) -> int:
    """Reads `cases` damaged copies; returns how many were refused.

    AssertionError for one that is read and differs; whatever else than ValueError comes through.
    """
    content, whole, refused = path.read_bytes(), read(path), 0
    rng = random.Random(seed)
    with tempfile.TemporaryDirectory() as folder:
        copy = Path(folder) / path.name
        for case in range(cases):
            copy.write_bytes(damage(content, rng))
            try:
                found = read(copy)
            except ValueError as error:
                assert "\n" not in str(error), (case, error)
                refused += 1
            else:
                assert same(found, whole), f"case {case} was read, and is not what was written"
    return refused


def train(folder: Path, demonstrations: Path, resume: bool) -> subprocess.Popen:
    argv = ["--data", str(demonstrations), "--out", str(folder), *["--resume"] * resume]
    command = [sys.executable, str(ROOT / "train.py"), *TRAINING, *argv]
    return subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=subprocess.PIPE, text=True)


def fuzz_training(folder: Path, demonstrations: Path, kills: int, seed: int = 0) -> list[str]:
    """Kills trainings at random moments until `kills` is reached; returns what ended each.

    Each is resumed until it ends. The first is left alone, and is what the others must equal.
    """
    rng, ended, run = random.Random(seed), [], 0
    began = time.monotonic()
    assert train(folder / "whole", demonstrations, False).wait() == 0
    seconds = time.monotonic() - began
    whole = read_checkpoint(folder / "whole" / "last.pt")
    while len(ended) < kills:
        out, finished, run = folder / f"run{run}", False, run + 1
        while not finished:
            process = train(out, demonstrations, (out / "last.pt").exists())
            try:
                error = process.communicate(timeout=rng.uniform(0.1, 1.2) * seconds)[1]
            except subprocess.TimeoutExpired:
                number = rng.choice(SIGNALS)
                process.send_signal(number)
                error = process.communicate()[1]
                ended.append(number.name)
            assert "Traceback" not in error, error
            finished = process.returncode == 0
            assert finished or process.returncode in (130, -signal.SIGKILL), process.returncode
        policy, info = read_checkpoint(out / "last.pt")
        for name, value in {"policy": policy, "training": info["training"]}.items():
            expected = whole[0] if name == "policy" else whole[1]["training"]
            assert same(value, expected), f"{out}: {name} differs"
        assert (out / "success.json").exists()
        assert not list(out.glob(".*")), "a temporary file was left"
    return ended


def main(argv: list[str] | None = None) -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--files", type=int, default=2000, help="damaged files of each kind (2000)")
    parser.add_argument("--kills", type=int, default=200, help="killed trainings (200)")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--data", default="data", help="demonstrations of ml10 (data)")
    args = parser.parse_args(argv)
    with tempfile.TemporaryDirectory() as name:
        folder, recordings = Path(name), Path(args.data)
        policy = model.DAMIPolicy(model.PRESETS["tiny"])
        scripts.save_checkpoint(folder / "policy.pt", policy, step=1)
        small = data.load_demonstrations(recordings / "reach.npz").take(1)
        data.save_demonstrations(folder / "reach.npz", small)
        for path, read in (("policy.pt", read_checkpoint), ("reach.npz", read_recording)):
            refused = fuzz_file(folder / path, read, args.files, args.seed)
            print(f"{path}: {args.files} damaged, {refused} refused, the rest read as before")
        ended = fuzz_training(folder, recordings, args.kills, args.seed)
        counts = {name: ended.count(name) for name in sorted(set(ended))}
        print(f"{len(ended)} trainings ended by {counts}: the same bits, nothing left behind")


if __name__ == "__main__":
    main()
